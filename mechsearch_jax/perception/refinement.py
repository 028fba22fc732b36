"""Fit recognised superquadrics to the depth image by damped Gauss-Newton steps, for all objects in parallel.

The recognition network uses a few hundred points; refinement compares its result with every pixel. There are two kinds
of evidence. The object's points lie on its surface. And rays are free up to their ends: no ray may pass through the
object before its measured depth, which bounds the silhouette from outside and the depth of the object from above and
the sides. Where there is no evidence, behind the object and behind what hides it, the network's result is a prior,
together with facts about objects on a shelf: most stand upright on the board, and none is inside the walls.

The distance of a point to the surface is `(gauge - 1) / |gradient of the gauge|`: exact for flat faces, of first order
elsewhere. The gauge depends on a point only by its coordinates over the half-extents, so the Jacobian follows from the
gauge's gradient.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.superquadric import ROUND_EXPONENT, Superquadrics
from mechsearch_jax.geometry.transforms import exponential, make, matmul, rotate, transform, yaw_rotation
from mechsearch_jax.images.cloud import MARGIN, above_board
from mechsearch_jax.perception.scores import EDGE
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.camera import Camera, pixel_rays, project
from mechsearch_jax.workspace.shelf import Shelf

PARAMETERS = 9
BISECTIONS = 12
DAMPING_FACTOR = 4.0
# Length to which a ray that ends on nothing is free [m].
FAR = 3.0
# Largest step: relative change of the half-extents, centre [m], rotation [rad].
LARGEST_STEP = (0.3,) * 3 + (0.03,) * 3 + (0.3,) * 3
HALF_EXTENTS = (0.004, 0.3)
# A point this near to the surface is explained, one twice as far is not, and rays may pass this deep [m].
EXPLAINED = 0.005


class Hypothesis(PyTreeNode):
    """A shape class that an object may have; every field may have leading axes."""

    exponents: jax.Array
    yaw: jax.Array


@dataclasses.dataclass(frozen=True)
class RefinementConfig:
    """How recognised shapes are refined; lengths in metres, angles in radians.

    The defaults are for the recognition network, which is mostly right to half a millimetre: with much looser priors,
    less noise or a wider loss, stray points at the edges of a time-of-flight image make its results worse (`python -m
    mechsearch_jax.benchmarks.lab recognition` measures it). For worse initial shapes there is `rough`.

    Attributes:
      hypotheses: shapes that are tried for every object, as (e1, e2, turn about the object's z from the recognised
        heading); the one that explains the image best is kept. If empty, the recognised exponents stay. With rounder
        edges than the true ones, objects become too large, since points near an edge pull the faces outwards.
      points: largest number of an object's points that are used.
      rays: number of pixels in and around the object's image whose rays are used.
      border: how far those pixels reach beyond the image of the object's bounding box, relative to its size.
      stages: numbers of steps, each with the scale of its robust loss, beyond which a residual loses its weight.
      damping: at the start of a stage, relative to the diagonal of the normal equations. Sharp edges make kinks in the
        distances, and large first steps end in poor local minima.
      noise: standard deviation of a point's distance to the surface, relative to which priors are weighted. More than
        the sensor's, because the errors of neighbouring points are not independent.
      ray_noise: standard deviation of how deep a ray seems to pass through the object: pixels determine silhouettes
        better than depths.
      tolerance: the last part of a ray that need not be free, for the noise of its end.
      size_prior: standard deviation of the recognised half-extents, relative to them.
      position_prior: standard deviation of the recognised centre.
      yaw_prior: standard deviation of the recognised heading.
      tilt_prior: standard deviation of the angle between the vertical and the upright axis.
      upright_within: largest angle between the vertical and an axis of an upright object.
      contact: standard deviation of the height of the lowest point over the board.
      switch: by how much another exponent than the recognised one must lower the cost, in halves of squared standard
        deviations.
      minimum_points: an object with fewer points is not changed.
    """

    hypotheses: tuple[tuple[float, float, float], ...] = ((0.03, 0.03, 0.0), (0.03, 1.0, 0.0))
    points: int = 256
    rays: int = 512
    border: float = 0.25
    stages: tuple[tuple[int, float], ...] = ((16, 0.002),)
    damping: float = 1.0
    noise: float = 0.002
    ray_noise: float = 0.001
    tolerance: float = 0.003
    size_prior: float = 0.03
    position_prior: float = 0.003
    yaw_prior: float = 0.05
    tilt_prior: float = 0.01
    upright_within: float = 0.3
    contact: float = 0.001
    switch: float = 4.0
    minimum_points: int = 10

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, int | float) and not (math.isfinite(value) and value > 0):
                raise InputError(f"RefinementConfig: {field.name} ({value}) must be positive")
        if not self.stages or any(steps < 1 or scale <= 0 for steps, scale in self.stages):
            raise InputError(f"RefinementConfig: stages {self.stages} must be pairs of a number of steps and a length")
        most = 2.0 - ROUND_EXPONENT
        if any(not (0 < e1 <= most and 0 < e2 <= most) for e1, e2, _ in self.hypotheses):
            raise InputError(
                f"RefinementConfig: exponents in hypotheses {self.hypotheses} must be above 0 and at most {most:g}; a "
                "box of another heading has its turn for that"
            )

    @classmethod
    def rough(cls, **changes: Any) -> RefinementConfig:
        """For initial shapes that are wrong by a tenth of a size or by 1 cm: weak priors, and at first a wide loss."""
        weak = {"size_prior": 0.15, "position_prior": 0.015, "yaw_prior": 0.2}
        sure = {"noise": 0.001, "ray_noise": 0.0005, "stages": ((6, 0.01), (10, 0.003))}
        return cls(**{**weak, **sure, **changes})


class Refined(PyTreeNode):
    """Refined superquadrics and diagnostics.

    Attributes:
      scene: the superquadrics, in their original slots.
      cost: half the sum of robust squared residuals at the end, in units of the noise, shape (N,).
      initial_cost: the same for the initial shapes with the chosen hypothesis' exponents, shape (N,).
      points: number of the object's points that were used, int32, shape (N,); with too few, the object is unchanged.
      hypothesis: index of the chosen hypothesis, int32, shape (N,).
      misfit: how badly the image is explained, shape (N,): the share of the object's points that are not on its
        surface, and the pixels whose rays pass through it over the number of its points.
    """

    scene: Superquadrics
    cost: jax.Array
    initial_cost: jax.Array
    points: jax.Array
    hypothesis: jax.Array
    misfit: jax.Array


class _Shape(PyTreeNode):
    """The fitted parameters: logarithms of the half-extents, centre and rotation; the exponents are fixed."""

    log_size: jax.Array
    position: jax.Array
    rotation: jax.Array
    exponents: jax.Array


class _Evidence(PyTreeNode):
    """The image's evidence about one object: its points, and rays with the depth to which they are free."""

    points: jax.Array
    point_weight: jax.Array
    directions: jax.Array
    free: jax.Array
    ray_weight: jax.Array
    ray_pixels: jax.Array


class _Fit(PyTreeNode):
    """A shape with the normal equations of its residuals."""

    shape: _Shape
    normal: jax.Array
    gradient: jax.Array
    cost: jax.Array
    damping: jax.Array


def select(labels: Int[Array, " p"], label: Int[Array, ""], count: int) -> tuple[Int[Array, " c"], Float[Array, " c"]]:
    """Indices of `count` points with a label, spread evenly over all; and weights, 0 for surplus indices."""
    rank = jnp.cumsum(labels == label)
    j = jnp.arange(count)
    total = rank[-1]
    # A stride that drifts, so that it never keeps step with the rows of an image.
    drift = jnp.asarray((np.arange(count) * 0.6180339887) % 1.0, jnp.float32)
    spread = jnp.floor((j + drift) * (total / count)).astype(jnp.int32)
    wanted = jnp.where(total > count, spread, j)
    index = jnp.searchsorted(rank, wanted + 1)
    return jnp.minimum(index, labels.shape[0] - 1), (j < total).astype(jnp.float32)


def _plane_points(count: int) -> np.ndarray:
    """Points spread evenly over the unit square, without the rows and columns of a grid: an additive recurrence."""
    ratio = 1.32471795724
    return ((0.5 + np.arange(1, count + 1)[:, None] / ratio ** np.arange(1.0, 3.0)) % 1.0).astype(np.float32)


def _window(camera: Camera, scene_object: Superquadrics, config: RefinementConfig) -> tuple[Array, Array, Array]:
    """Rows and columns of pixels in and around the image of an object's bounding box, and for how many each stands."""
    corners = jnp.stack(jnp.meshgrid(*[jnp.array([-1.0, 1.0])] * 3, indexing="ij"), axis=-1).reshape(8, 3)
    T_world_object = make(scene_object.rotation, scene_object.position)
    pixels, _ = project(camera, transform(T_world_object, corners * scene_object.size[None]))
    low, high = jnp.min(pixels, axis=0), jnp.max(pixels, axis=0)
    low, high = low - config.border * (high - low), high + config.border * (high - low)
    # All pixels lie inside the image.
    edge = jnp.array([camera.height - 1.0, camera.width - 1.0])
    low, high = jnp.clip(low, 0.0, edge), jnp.clip(high, 0.0, edge)
    pixels = jnp.round(low[None] + jnp.asarray(_plane_points(config.rays)) * (high - low)[None]).astype(jnp.int32)
    return pixels[:, 0], pixels[:, 1], jnp.prod(high - low + 1.0) / config.rays


def _evidence(camera, scene_object, label, points, labels, depth, config) -> _Evidence:
    index, weight = select(labels, label, config.points)
    object_points = points[index]
    finite = jnp.all(jnp.isfinite(object_points), axis=-1)
    rows, columns, ray_pixels = _window(camera, scene_object, config)
    seen = depth[rows, columns]
    free = jnp.where(seen > FAR, FAR, seen) - config.tolerance
    informative = ~jnp.isnan(seen) & (free > 0.0)
    return _Evidence(
        points=jnp.where(finite[:, None], object_points, 0.0),
        point_weight=weight * finite,
        directions=pixel_rays(camera, rows * 1.0, columns * 1.0),
        free=jnp.where(informative, free, 0.0),
        ray_weight=informative.astype(jnp.float32),
        # A point stands for so many pixels of the object.
        ray_pixels=ray_pixels / jnp.maximum(jnp.sum(labels == label) / jnp.maximum(jnp.sum(weight), 1.0), 1.0),
    )


def _value_and_gradient(size: Array, exponents: Array, points: Array) -> tuple[Array, Array]:
    """The gauge and its gradient at points in the object's frame; the gradient is not differentiated."""

    def gauge(point):
        return superquadric.gauge(size, exponents, point)

    value, gradient = jax.vmap(jax.value_and_grad(gauge))(points)
    return value, jax.lax.stop_gradient(gradient)


def _local(shape: _Shape, vectors: Array) -> Array:
    return rotate(shape.rotation.T, vectors)


def _closest_approach(shape: _Shape, origin: Array, evidence: _Evidence) -> Array:
    """The world point of every ray's free part with the least gauge, which is convex along the ray, by bisection."""
    size = jnp.exp(shape.log_size)
    start, direction = _local(shape, origin - shape.position), _local(shape, evidence.directions)
    square = jnp.sum(direction**2, axis=-1)
    middle = -jnp.sum(start[None] * direction, axis=-1) / square
    reach = superquadric.bounding_radius(size) / jnp.sqrt(square)
    low, high = (jnp.clip(middle + s * reach, 0.0, evidence.free) for s in (-1.0, 1.0))

    def bisect(_, bracket):
        low, high = bracket
        half = (low + high) / 2.0
        _, gradient = _value_and_gradient(size, shape.exponents, start[None] + half[:, None] * direction)
        falling = jnp.sum(gradient * direction, axis=-1) < 0.0
        return jnp.where(falling, half, low), jnp.where(falling, high, half)

    low, high = jax.lax.fori_loop(0, BISECTIONS, bisect, (low, high))
    depth = jax.lax.stop_gradient((low + high) / 2.0)
    return origin[None] + depth[:, None] * evidence.directions


def _distances(shape: _Shape, points: Array) -> tuple[Array, Array]:
    """Signed distances of world points to the surface, negative inside, and their Jacobians, shape (points, 9)."""
    size = jnp.exp(shape.log_size)
    offset = points - shape.position[None]
    local = _local(shape, offset)
    value, gradient = _value_and_gradient(size, shape.exponents, local)
    steep = jnp.sqrt(jnp.maximum(jnp.sum(gradient**2, axis=-1), 0.25 / jnp.max(size) ** 2))
    normal = gradient / steep[:, None]
    world_normal = rotate(shape.rotation, normal)
    turning = jnp.cross(world_normal, offset)
    return (value - 1.0) / steep, jnp.concatenate([-normal * local, -world_normal, turning], axis=-1)


def _moved(shape: _Shape, step: Float[Array, "9"]) -> _Shape:
    """A shape after a step in the parameters: log half-extents, centre, and a rotation about the world's axes."""
    return shape.replace(
        log_size=jnp.clip(shape.log_size + step[:3], *(math.log(h) for h in HALF_EXTENTS)),
        position=shape.position + step[3:6],
        rotation=matmul(exponential(step[6:]), shape.rotation),
    )


def _support(shape: _Shape, direction: tuple[float, float, float]) -> Array:
    """Support function of a shape from its centre: the dual norm of its gauge."""

    def norm(a, b, p):
        big = jnp.maximum(jnp.maximum(a, b), 1e-9)
        return big * ((a / big) ** p + (b / big) ** p) ** (1.0 / p)

    # The dual of a p-norm with p = 2/e is the one with 1/(1 - e/2); an exponent of 2 is the largest.
    dual = 1.0 / (1.0 - jnp.minimum(shape.exponents, 1.9) / 2.0)
    a, b, c = jnp.maximum(jnp.abs(jnp.exp(shape.log_size) * _local(shape, jnp.array(direction))), 1e-7)
    return norm(norm(a, b, dual[1]), c, dual[0])


def _upright(rotation: Array, config: RefinementConfig) -> Array:
    """The nearest rotation with one of the object's axes vertical, if one is nearly so; else the same rotation."""
    axis = jnp.argmax(jnp.abs(rotation[2]))
    vertical = rotation[:, axis] * jnp.where(rotation[2, axis] < 0.0, -1.0, 1.0)
    sine = jnp.sqrt(jnp.sum(vertical[:2] ** 2) + 1e-16)
    angle = jnp.arctan2(sine, vertical[2])
    turn = jnp.cross(vertical, jnp.array([0.0, 0.0, 1.0])) * (angle / sine)
    return jnp.where(angle < config.upright_within, matmul(exponential(turn), rotation), rotation)


def _priors(step: Array, shape: _Shape, guess: _Shape, shelf: Shelf, config: RefinementConfig) -> Array:
    """Residuals of the priors, in units of their standard deviations."""
    shape = _moved(shape, step)
    turned = matmul(shape.rotation, guess.rotation.T)
    angle = 0.5 * jnp.stack([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
    deviation = jnp.array([config.tilt_prior, config.tilt_prior, config.yaw_prior])
    x, y, z = shape.position
    height = (z - _support(shape, (0.0, 0.0, 1.0)) - shelf.board) / config.contact
    walls = shelf.walls
    beyond = jnp.stack(
        [
            x + _support(shape, (1.0, 0.0, 0.0)) - walls.back,
            y + _support(shape, (0.0, 1.0, 0.0)) - walls.left,
            walls.right - y + _support(shape, (0.0, 1.0, 0.0)),
            -height * config.contact,
        ]
    )
    out_of_round = (shape.log_size[0] - shape.log_size[1]) * jnp.where(shape.exponents[1] > EDGE, 100.0, 0.0)
    return jnp.concatenate(
        [
            (shape.log_size - guess.log_size) / config.size_prior,
            (shape.position - guess.position) / config.position_prior,
            angle / deviation,
            jnp.maximum(beyond, 0.0) / config.noise,
            # Bounded, so that objects on other objects are not pulled down to the board.
            5.0 * jnp.arctan(height / 5.0)[None],
            out_of_round[None],
        ]
    )


def _evaluate(
    shape: _Shape,
    guess: _Shape,
    origin: Array,
    evidence: _Evidence,
    scale: Array,
    shelf: Shelf,
    config: RefinementConfig,
) -> tuple[Array, Array, Array]:
    """The cost of a shape, its gradient, and the Gauss-Newton approximation of its second derivatives."""
    surface, surface_jacobian = _distances(shape, evidence.points)
    blocked, blocked_jacobian = _distances(shape, _closest_approach(shape, origin, evidence))
    sharpness = config.noise / config.ray_noise
    blocked = jnp.minimum(blocked, 0.0) * sharpness
    blocked_jacobian = blocked_jacobian * (blocked < 0.0)[:, None] * sharpness
    residual = jnp.concatenate([surface, blocked]) / config.noise
    jacobian = jnp.concatenate([surface_jacobian, blocked_jacobian]) / config.noise
    weight = jnp.concatenate([evidence.point_weight, evidence.ray_weight])
    # Cauchy's loss: quadratic up to the scale, logarithmic beyond.
    square = (scale / config.noise) ** 2
    cost = 0.5 * square * jnp.sum(weight * jnp.log1p(residual**2 / square))
    weight = weight / (1.0 + residual**2 / square)

    prior_residual = _priors(jnp.zeros(PARAMETERS), shape, guess, shelf, config)
    prior_jacobian = jax.jacfwd(_priors)(jnp.zeros(PARAMETERS), shape, guess, shelf, config)
    rows = jnp.concatenate([jacobian, prior_jacobian])
    right = jnp.concatenate([residual, prior_residual])
    weighted = rows * jnp.concatenate([weight, jnp.ones_like(prior_residual)])[:, None]
    dot = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
    return cost + 0.5 * jnp.sum(prior_residual**2), dot(weighted.T, right), dot(weighted.T, rows)


def _misfit(shape: _Shape, origin: Array, evidence: _Evidence) -> Array:
    """`Refined.misfit` of a shape."""
    off, _ = _distances(shape, evidence.points)
    deep, _ = _distances(shape, _closest_approach(shape, origin, evidence))
    badly = jnp.sum(evidence.point_weight * jnp.clip(jnp.abs(off) / EXPLAINED - 1.0, 0.0, 1.0))
    passed = jnp.sum(evidence.ray_weight * (deep < -EXPLAINED)) * evidence.ray_pixels
    return (badly + passed) / jnp.maximum(jnp.sum(evidence.point_weight), 1.0)


def _fit(
    guess: _Shape, origin: Array, evidence: _Evidence, shelf: Shelf, config: RefinementConfig
) -> tuple[_Shape, Array, Array]:
    """Levenberg and Marquardt's method from an initial shape: the fitted shape, its cost and the initial cost."""

    def evaluated(shape, scale, damping):
        cost, gradient, normal = _evaluate(shape, guess, origin, evidence, scale, shelf, config)
        return _Fit(shape, normal, gradient, cost, damping)

    def improve(fit, schedule):
        scale, restart = schedule
        regular = fit.normal + jnp.diag(fit.damping * jnp.diagonal(fit.normal) + 1e-6)
        limit = jnp.array(LARGEST_STEP)
        step = jnp.clip(jnp.linalg.solve(regular, -fit.gradient), -limit, limit)
        shape = _moved(fit.shape, jnp.where(restart, 0.0, step))
        candidate = evaluated(shape, scale, jnp.where(restart, config.damping, fit.damping / DAMPING_FACTOR))
        better = restart | (candidate.cost < fit.cost)
        refused = fit.replace(damping=fit.damping * DAMPING_FACTOR)
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), candidate, refused), candidate.cost

    # One loop for everything, so that the residuals are compiled once: first the initial cost at the last scale, then
    # the stages, each of which begins with the cost at the new scale.
    last = config.stages[-1][1]
    schedule = [(last, True), *((scale, i == 0) for steps, scale in config.stages for i in range(steps + 1))]
    scales, restarts = (jnp.array(column) for column in zip(*schedule, strict=True))
    n = PARAMETERS
    fit = _Fit(guess, jnp.zeros((n, n)), jnp.zeros(n), jnp.float32(jnp.inf), jnp.float32(1.0))
    fit, costs = jax.lax.scan(improve, fit, (scales, restarts))
    return fit.shape, fit.cost, costs[0]


def _supposed(scene_object: Superquadrics, hypothesis: Hypothesis, config: RefinementConfig) -> _Shape:
    """An object's initial shape under a hypothesis: upright if it nearly is, a cylinder with equal radii."""
    round_ = hypothesis.exponents[1] > EDGE
    a, b, c = jnp.log(jnp.clip(scene_object.size, *HALF_EXTENTS))
    mean = (a + b) / 2.0
    turned = matmul(scene_object.rotation, yaw_rotation(hypothesis.yaw))
    return _Shape(
        log_size=jnp.stack([jnp.where(round_, mean, a), jnp.where(round_, mean, b), c]),
        position=scene_object.position,
        rotation=_upright(turned, config),
        exponents=hypothesis.exponents,
    )


@functools.partial(jax.jit, static_argnames=("config",))
def refine(
    camera: Camera,
    shelf: Shelf,
    scene: Superquadrics,
    points: Float[Array, "p 3"],
    labels: Int[Array, " p"],
    depth: Float[Array, "h w"],
    config: RefinementConfig | None = None,
    owners: Int[Array, " n"] | None = None,
) -> Refined:
    """Fit recognised superquadrics to a depth image.

    `jax.vmap` over scenes, points, labels and images refines a batch. Rays must not pass through an object, whatever
    they end on, so the rays need no labels.

    Args:
      camera: the camera of the depth image.
      shelf: with the objects.
      scene: the recognised objects, fields (N, ...).
      points: observed points in the world [m]; those that are not finite are ignored.
      labels: the slot in `scene` of each point; other numbers for none.
      depth: along the camera's axis [m]; infinite where nothing is, NaN where nothing was measured.
      config: static; the default if None.
      owners: the label of each object's points; its slot if None.

    Returns:
      the refined scene and diagnostics. Absent objects and those with too few points are unchanged. One whose centre
      lies outside the shelf's faces, by `cloud.MARGIN` for the board, or more than `cloud.OVERHANG` in front of it, is
      none, and becomes absent.
    """
    config = config or RefinementConfig()
    origin = jnp.array(camera.position)

    # Replaces objects that are not fitted, so that values and derivatives of their slots are finite.
    middle = ((shelf.front + shelf.back) / 2, (shelf.right + shelf.left) / 2, shelf.board + 0.05)
    edges = jnp.full(2, superquadric.EDGE_EXPONENT)
    stand_in = Superquadrics(jnp.full(3, 0.05), edges, jnp.array(middle), jnp.eye(3), jnp.array(False))

    def refine_object(given, label):
        finite = jnp.all(jnp.isfinite(points), axis=-1)
        usable = given.valid & (jnp.sum((labels == label) & finite) >= config.minimum_points)
        scene_object = jax.tree.map(lambda a, b: jnp.where(usable, a, b), given, stand_in)
        evidence = _evidence(camera, scene_object, label, points, labels, depth, config)
        if config.hypotheses:
            numbers = jnp.array(config.hypotheses, jnp.float32)
            hypotheses = Hypothesis(numbers[:, :2], numbers[:, 2])
        else:
            hypotheses = Hypothesis(scene_object.exponents[None], jnp.zeros(1))
        guesses = jax.vmap(lambda h: _supposed(scene_object, h, config))(hypotheses)
        shapes, costs, before = jax.vmap(lambda guess: _fit(guess, origin, evidence, shelf, config))(guesses)
        switched = (guesses.exponents[:, 1] > EDGE) != (scene_object.exponents[1] > EDGE)
        best = jnp.argmin(costs + config.switch * switched)
        shape, cost, initial = jax.tree.map(lambda a: a[best], (shapes, costs, before))
        count = jnp.sum(evidence.point_weight).astype(jnp.int32)
        misfit = _misfit(shape, origin, evidence)
        refined = Superquadrics(jnp.exp(shape.log_size), shape.exponents, shape.position, shape.rotation, given.valid)
        kept = jax.tree.map(lambda a, b: jnp.where(usable & jnp.isfinite(cost), a, b), refined, given)
        # A flat thing seems to reach as far below the board as camera and board are off.
        raised = kept.position.at[2].add(MARGIN)
        kept = kept.replace(valid=kept.valid & above_board(shelf, raised, 0.0))
        return Refined(kept, cost, initial, count, best.astype(jnp.int32), misfit)

    return jax.vmap(refine_object)(scene, jnp.arange(scene.capacity) if owners is None else owners)
