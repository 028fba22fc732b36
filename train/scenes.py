"""Random scenes, generated and ray-cast into images of points on the accelerator; all functions are vmappable."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.envs.camera.colour_image import scene_key
from mechsearch_jax.envs.camera.recognisers import true_labels
from mechsearch_jax.envs.camera.sensors import SENSORS, Sensor, surfaces_of
from mechsearch_jax.envs.camera.simulated_camera import SHELF, cast_body, cast_shelf
from mechsearch_jax.envs.scenes.generator import CATALOGUE
from mechsearch_jax.envs.world.world import BODIES, TARGET, World
from mechsearch_jax.geometry.transforms import matmul, yaw_rotation
from mechsearch_jax.images.cloud import View, shelf_view
from mechsearch_jax.images.noise import NoiseModel, RandomDirection, TimeOfFlight, no_noise
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.shapes import by_shape, shape_of
from mechsearch_jax.workspace.camera import Camera, rays
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Steps of `_slide`; each shortens the gap to at most about a third.
_SLIDES = 8
# Least number of pixels of the full image of an object that is scored.
PIXELS = 100
# Codes of the shapes of objects of random size, in an order that must not change: random numbers index it. Then the
# targets, and codes and half-extents of the paper's objects.
_OBJECT_KINDS = np.array([shape_of(name).code for name in ("box", "cylinder")], np.int32)
_TARGETS = tuple(Target.of(name) for name in ("cylinder", "box"))
_CATALOGUE = np.array(
    [(shape_of(name).code, *half) for name, (x, y, z) in CATALOGUE for half in ((x, y, z), (y, x, z))], np.float32
)


@dataclasses.dataclass(frozen=True)
class SceneConfig:
    """Distribution of scenes. Sizes are full sizes [m]; ranges are sampled log-uniformly.

    Attributes:
      objects: least and largest number of objects; objects without room are left out.
      known: share of objects that are one of the paper's eleven.
      sides: range of the width and depth of objects that are not round.
      heights: range of heights.
      diameters: range of the diameter of round objects.
      lying: share of objects that lie on their side.
      leaning: share of objects that lean, none of whose faces is level.
      lean: range of the angle by which they lean [rad].
      touching: share of objects that are pushed against another.
      target: share of scenes with a target, whose points belong to no object.
      placements: number of places that are tried at once for an object.
      noises: each scene's sensor is one of these, drawn uniformly.
    """

    objects: tuple[int, int] = (2, 8)
    known: float = 0.5
    sides: tuple[float, float] = (0.022, 0.17)
    heights: tuple[float, float] = (0.04, 0.23)
    diameters: tuple[float, float] = (0.03, 0.1)
    lying: float = 0.07
    leaning: float = 0.03
    lean: tuple[float, float] = (0.05, 0.6)
    touching: float = 0.2
    target: float = 0.3
    placements: int = 24
    noises: tuple[NoiseModel, ...] = (no_noise, RandomDirection(), TimeOfFlight())

    def __post_init__(self):
        low, high = self.objects
        if not 1 <= low <= high <= TARGET:
            raise InputError(f"SceneConfig: objects {self.objects} must be a range within 1 to {TARGET}")
        for name in ("known", "lying", "leaning", "touching", "target"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"SceneConfig: {name} {getattr(self, name)} must be between 0 and 1")
        for name in ("sides", "heights", "diameters", "lean"):
            if not 0 < getattr(self, name)[0] <= getattr(self, name)[1]:
                raise InputError(f"SceneConfig: {name} {getattr(self, name)} must be a range of positive numbers")
        if self.placements < 1 or not self.noises:
            raise InputError("SceneConfig: placements must be at least 1 and noises not empty")


def origin(config: SceneConfig) -> dict[str, Any]:
    """The source of examples from these scenes, for the card of a network's weights."""
    noises = [
        repr(noise) if name == type(noise).__name__ else name
        for noise, name in zip(config.noises, noise_names(config), strict=True)
    ]
    return {"source": "random scenes, ray-cast as they were needed", **dataclasses.asdict(config), "noises": noises}


class Footprint(PyTreeNode):
    """Footprints of bodies, seen from above: a rectangle, or a disc if `radius` is not 0.

    Attributes:
      centre: [m], shape (..., 2).
      half: half-extents of the rectangle along its own axes [m], shape (..., 2); 0 for a disc.
      yaw: of the rectangle [rad], shape (...).
      radius: of the disc [m], shape (...).
    """

    centre: jax.Array
    half: jax.Array
    yaw: jax.Array
    radius: jax.Array


def _axes(yaw: Array) -> Array:
    """A rectangle's axes as rows, shape (..., 2, 2)."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([jnp.stack([c, s], axis=-1), jnp.stack([-s, c], axis=-1)], axis=-2)


def gap(a: Footprint, b: Footprint) -> Float[Array, "..."]:
    """A lower bound of the distance between footprints [m]; positive exactly if they are apart.

    For rectangles it is the gap along the axis that separates them most, exact if one side faces the other; for discs
    it is exact.
    """
    offset = b.centre - a.centre
    axes_a, axes_b = _axes(a.yaw), _axes(b.yaw)

    def along(axes):
        reach = sum(
            jnp.sum(jnp.abs(jnp.sum(axes[..., :, None, :] * rows[..., None, :, :], axis=-1)) * f.half[..., None, :], -1)
            for f, rows in ((a, axes_a), (b, axes_b))
        )
        return jnp.max(jnp.abs(jnp.sum(axes * offset[..., None, :], axis=-1)) - reach, axis=-1)

    def to_rectangle(axes, half):
        outside = jnp.abs(jnp.sum(axes * offset[..., None, :], axis=-1)) - half
        return jnp.linalg.norm(jnp.maximum(outside, 0.0), axis=-1) + jnp.minimum(jnp.max(outside, axis=-1), 0.0)

    rectangles = jnp.maximum(along(axes_a), along(axes_b))
    round_a, round_b = a.radius > 0, b.radius > 0
    mixed = jnp.where(round_a, to_rectangle(axes_b, b.half), to_rectangle(axes_a, a.half))
    discs = jnp.linalg.norm(offset, axis=-1)
    apart = jnp.where(round_a & round_b, discs, jnp.where(round_a | round_b, mixed, rectangles))
    return apart - a.radius - b.radius


class _Shape(PyTreeNode):
    """A body at the origin, its lowest point at height 0: shape, orientation and footprint."""

    kind: jax.Array
    half_size: jax.Array
    rotation: jax.Array
    height: jax.Array
    half: jax.Array
    radius: jax.Array


def _log_uniform(key: Array, limits: tuple[float, float], shape: tuple[int, ...] = ()) -> Array:
    return jnp.exp(jax.random.uniform(key, shape, minval=np.log(limits[0]), maxval=np.log(limits[1])))


def _tilt(angle: Array) -> Array:
    """Rotation about the x axis."""
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.stack([jnp.stack(r) for r in ([one, zero, zero], [zero, c, -s], [zero, s, c])])


def _draw_shape(key: Array, config: SceneConfig) -> _Shape:
    """A random body, before its yaw is applied."""
    keys = jax.random.split(key, 8)
    of_catalogue = jnp.array(_CATALOGUE)[jax.random.randint(keys[0], (), 0, len(_CATALOGUE))]
    is_catalogue = jax.random.bernoulli(keys[1], config.known)
    drawn = jnp.asarray(_OBJECT_KINDS)[jax.random.randint(keys[2], (), 0, len(_OBJECT_KINDS))]
    kind = jnp.where(is_catalogue, of_catalogue[0].astype(jnp.int32), drawn)
    width, depth = _log_uniform(keys[3], config.sides, (2,)) / 2
    radius = _log_uniform(keys[4], config.diameters) / 2
    height = _log_uniform(keys[5], config.heights) / 2
    is_round = by_shape(kind, lambda shape: shape.round, jnp)
    free = jnp.where(is_round, jnp.stack([radius, radius, height]), jnp.stack([width, depth, height]))
    half = jnp.where(is_catalogue, of_catalogue[1:], free)
    pose = jax.random.uniform(keys[6])
    angle = jnp.where(
        pose < config.leaning,
        jax.random.uniform(keys[7], minval=config.lean[0], maxval=config.lean[1]),
        jnp.where(pose < config.leaning + config.lying, jnp.pi / 2, 0.0),
    )
    rotation = _tilt(angle)
    return _shape(kind, half, rotation)


def _shape(kind: Array, half: Array, rotation: Array) -> _Shape:
    extent = by_shape(kind, lambda shape: shape.reach(rotation, half[None, :], jnp), jnp)
    standing = by_shape(kind, lambda shape: shape.round, jnp) & (rotation[2, 2] > 0.999)
    return _Shape(
        kind, half, rotation, extent[2], jnp.where(standing, 0.0, extent[:2]), jnp.where(standing, half[0], 0.0)
    )


def _slide(moving: Footprint, other: Footprint) -> Footprint:
    """The footprint moved towards another until they almost touch; `gap` bounds each step from below."""

    def step(_, moved):
        offset = other.centre - moved.centre
        towards = offset / jnp.maximum(jnp.linalg.norm(offset), 1e-6)
        return moved.replace(centre=moved.centre + towards * jnp.maximum(gap(moved, other), 0.0))

    return jax.lax.fori_loop(0, _SLIDES, step, moving)


def _row(vector: np.ndarray, like: Array) -> Array:
    return jnp.asarray(vector, jnp.float32).reshape(*[1] * (like.ndim - 1), -1)


def _within(shelf: Shelf, footprint: Footprint, clearance: float = 0.002) -> Array:
    """Whether a footprint lies on the board, and its centre in the area where objects are dropped."""
    centre = footprint.centre
    reach = jnp.sum(jnp.abs(jnp.swapaxes(_axes(footprint.yaw), -1, -2)) * footprint.half[..., None, :], axis=-1)
    reach = reach + footprint.radius[..., None]
    low, high = centre - reach, centre + reach
    on_board = (low[..., 0] > shelf.front) & (high[..., 0] < shelf.back - clearance)
    on_board &= (low[..., 1] > shelf.right + clearance) & (high[..., 1] < shelf.left - clearance)
    low, high = (np.array(ends) for ends in zip(shelf.spawn_x, shelf.spawn_y, strict=True))
    centred = (centre > _row(low - 0.01, centre)) & (centre < _row(high + 0.01, centre))
    return on_board & centred.all(axis=-1)


def _draw_places(
    slot: Int[Array, ""], key: Key[Array, ""], shape: _Shape, config: SceneConfig, shelf: Shelf
) -> tuple[Footprint, Int[Array, " tries"], Bool[Array, ""]]:
    """Footprints where a body may stand, which body before it each may touch, and whether it is to touch one."""
    tries = config.placements
    low = jnp.array([shelf.spawn_x[0], shelf.spawn_y[0]])
    high = jnp.array([shelf.spawn_x[1], shelf.spawn_y[1]])
    draws, turns, pick, touch = jax.random.split(key, 4)
    centre = low[None] + (high - low)[None] * jax.random.uniform(draws, (tries, 2))
    yaw = jax.random.uniform(turns, (tries,), minval=-jnp.pi, maxval=jnp.pi)
    places = Footprint(centre, jnp.broadcast_to(shape.half, (tries, 2)), yaw, jnp.broadcast_to(shape.radius, (tries,)))
    neighbour = jax.random.randint(pick, (tries,), 0, jnp.maximum(slot, 1)) % BODIES
    return places, neighbour, jax.random.bernoulli(touch, config.touching)


def random_world(key: Key[Array, ""], config: SceneConfig | None = None, shelf: Shelf | None = None) -> World:
    """A random scene: bodies that rest on the board and do not overlap.

    Bodies are placed in sequence, each at one of `config.placements` random places; a body that fits nowhere is left
    out. An approximation: leaning bodies are not supported by anything.

    Args:
      key: PRNG key.
      config: distribution of scenes; static.
      shelf: the shelf; static.
    """
    config, shelf = config or SceneConfig(), shelf or Shelf()
    keys = jax.random.split(key, 5)
    count = jax.random.randint(keys[0], (), config.objects[0], config.objects[1] + 1)
    shapes = jax.vmap(lambda k: _draw_shape(k, config))(jax.random.split(keys[1], TARGET))
    hidden = jax.random.randint(keys[2], (), 0, len(_TARGETS))
    target = _shape(
        jnp.array([shape_of(target.shape).code for target in _TARGETS])[hidden],
        jnp.array([target.half_size for target in _TARGETS], jnp.float32)[hidden],
        jnp.eye(3),
    )
    shapes = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), shapes, target)
    wanted = (jnp.arange(BODIES) < count).at[TARGET].set(jax.random.bernoulli(keys[3], config.target))

    def place(placed, one_body):
        footprints, present = placed
        slot, wanted, (candidates, neighbour, touch) = one_body
        beside = jax.vmap(_slide)(candidates, jax.tree.map(lambda a: a[neighbour], footprints))
        touches = touch & present[neighbour]
        candidates = candidates.replace(centre=jnp.where(touches[:, None], beside.centre, candidates.centre))
        gaps = jax.vmap(lambda candidate: jax.vmap(lambda other: gap(candidate, other))(footprints))(candidates)
        clear = jnp.all((gaps > 0.0) | ~present[None, :], axis=1)
        fits = clear & jax.vmap(lambda candidate: _within(shelf, candidate))(candidates)
        best = jnp.argmax(fits)
        chosen = jax.tree.map(lambda a: a[best], candidates)
        footprints = jax.tree.map(lambda a, b: a.at[slot].set(b), footprints, chosen)
        return (footprints, present.at[slot].set(fits[best] & wanted)), None

    nowhere = Footprint(jnp.zeros((BODIES, 2)), jnp.zeros((BODIES, 2)), jnp.zeros(BODIES), jnp.zeros(BODIES))
    # Random numbers are drawn for all bodies at once: only the places depend on earlier bodies.
    draw = jax.vmap(lambda slot, key, shape: _draw_places(slot, key, shape, config, shelf))
    drawn = draw(jnp.arange(BODIES), jax.random.split(keys[4], BODIES), shapes)
    (footprints, present), _ = jax.lax.scan(
        place, (nowhere, jnp.zeros(BODIES, bool)), (jnp.arange(BODIES), wanted, drawn)
    )
    position = jnp.concatenate([footprints.centre, (shelf.board + shapes.height)[:, None]], axis=1)
    return World(
        kind=shapes.kind,
        half_size=shapes.half_size,
        position=position,
        rotation=matmul(yaw_rotation(footprints.yaw), shapes.rotation),
        valid=present,
    )


class Capture(PyTreeNode):
    """A sensor's image of a scene.

    Attributes:
      points: as measured [m], shape (h, w, 3); NaN where nothing was measured.
      labels: int8, shape (h, w): 0 to 7 an object's slot, 8 the target, FREE the shelf, OTHER the shelf
        where noise has lifted it, MISSING nothing.
      pixels: number of pixels of each object, int32, shape (8,).
      alone: number of its pixels if it stood there alone.
      sensor: index of the noise in `SceneConfig.noises`.
    """

    points: jax.Array
    labels: jax.Array
    pixels: jax.Array
    alone: jax.Array
    sensor: jax.Array


def cast_world(
    camera: Camera, shelf: Shelf, world: World
) -> tuple[Float[Array, "h w"], Int[Array, "h w"], Int[Array, " bodies"]]:
    """Depth [m], the slot of the visible body (-1 for none), and each body's number of pixels if it were alone."""
    directions = rays(camera)

    def nearer(slot, best):
        depth, owner, alone = best
        candidate = cast_body(camera, world, slot, directions)
        alone = alone.at[slot].set(jnp.sum(jnp.isfinite(candidate)))
        return jnp.minimum(depth, candidate), jnp.where(candidate < depth, slot.astype(jnp.int8), owner), alone

    behind = cast_shelf(camera, shelf, directions)
    none = jnp.full(behind.shape, -1, jnp.int8)
    return jax.lax.fori_loop(0, BODIES, nearer, (behind, none, jnp.zeros(BODIES, jnp.int32)))


def object_pixels(owner: Int[Array, "h w"]) -> Int[Array, " objects"]:
    """Number of pixels of each object, from the slots of the visible bodies."""
    return jnp.sum(owner[..., None] == jnp.arange(TARGET).reshape(1, 1, -1), axis=(0, 1))


def capture(
    key: Key[Array, ""],
    world: World,
    config: SceneConfig | None = None,
    shelf: Shelf | None = None,
    view: View | None = None,
) -> Capture:
    """The image of a scene by one of the sensors of `config.noises`.

    Args:
      key: PRNG key.
      world: the scene.
      config: distribution of scenes; static.
      shelf: the shelf; static.
      view: which part of the camera's image, by default `shelf_view()`; static.
    """
    config, shelf = config or SceneConfig(), shelf or Shelf()
    camera = (view or shelf_view()).camera
    which, sensing = jax.random.split(key)
    depth, owner, alone = cast_world(camera, shelf, world)

    def by(noise, key):
        if not isinstance(noise, Sensor):
            return noise(key, camera, depth)
        shown = jnp.where((owner < 0) & jnp.isfinite(depth), SHELF, owner)
        return noise(key, camera, depth, surfaces_of(scene_key(world), camera, shelf, world, shown, depth))

    sensors = [functools.partial(by, noise) for noise in config.noises]
    sensor = jax.random.randint(which, (), 0, len(sensors))
    points = jax.lax.switch(sensor, sensors, sensing)
    return Capture(
        points=points,
        labels=true_labels(points, owner, shelf),
        pixels=object_pixels(owner),
        alone=alone[:TARGET],
        sensor=sensor,
    )


def in_catalogue(world: World) -> Bool[Array, " bodies"]:
    """Which bodies are of the shape and size of one of the paper's eleven objects."""
    bodies = jnp.concatenate([world.kind[:, None].astype(jnp.float32), world.half_size], axis=1)
    return (jnp.abs(bodies[:, None] - jnp.asarray(_CATALOGUE)[None]) < 1e-5).all(axis=-1).any(axis=-1)


def noise_names(config: SceneConfig) -> list[str]:
    """Names of the sensors, as `Capture.sensor` numbers them."""
    sensors: dict[Any, str] = {sensor: name for name, sensor in SENSORS.items()}
    return [sensors.get(noise) or getattr(noise, "__name__", type(noise).__name__) for noise in config.noises]


def visible_share(seen: Capture) -> Float[Array, " objects"]:
    """The share of its pixels that each object shows; 0 if it has none."""
    return jnp.where(seen.alone > 0, seen.pixels / jnp.maximum(seen.alone, 1), 0.0)


def surface_points(
    key: Key[Array, ""], kind: Int[Array, ""], half_size: Float[Array, "3"], count: int
) -> Float[Array, "count 3"]:
    """Uniform random points of the surface of a body, in its own frame [m]."""
    faces, flat, sign = jax.random.split(key, 3)
    area = by_shape(kind, lambda shape: shape.areas(half_size, jnp), jnp)
    face = jax.random.categorical(faces, jnp.log(jnp.maximum(area, 1e-12)), shape=(count,))
    u = jax.random.uniform(flat, (count, 3), minval=-1.0)
    side = jnp.where(jax.random.bernoulli(sign, shape=(count,)), 1.0, -1.0)
    return by_shape(kind, lambda shape: shape.spread(face, u, side, jnp), jnp) * half_size[None]


def worth_seeing(seen: Capture, view: View, pixels: int = PIXELS) -> Bool[Array, " objects"]:
    """Which objects show at least `pixels` pixels of the full image."""
    return seen.pixels * view.stride**2 >= pixels
