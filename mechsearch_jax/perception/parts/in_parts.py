"""Bodies of several parts: segments that one superquadric does not explain are explained by the union of up to four.

Each segment has a superquadric. Where many of its points do not lie on it, or rays pass through it, other shapes are
fitted to parts of the points: to those that lie on no shape yet, and to both sides of the cuts that divide the points
of the worst part into the most uniform halves. Of all these and of what there was, the union is kept that explains the
segment's points and the free rays around it best, at a price for each part. That is repeated, and at last every part
is fitted again to the points that are nearest to it. Bodies that then float may be joined to those that they touch.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.bodies import PARTS, bodies_of, with_parts
from mechsearch_jax.geometry.masked import masked_vmap, on_cpu
from mechsearch_jax.geometry.superquadric import Superquadrics, standard_edges
from mechsearch_jax.perception.confidence import confidence_of
from mechsearch_jax.perception.explanation import Fitted, Fitter, as_segmented
from mechsearch_jax.perception.parts.divisions import Frame, frame_of, guesses, halves, in_frame
from mechsearch_jax.perception.parts.joining import Joining, separate
from mechsearch_jax.perception.parts.unions import (
    Evidence,
    UnionCosts,
    distance,
    select_union,
    table_of,
    union_cost,
    union_misfit,
)
from mechsearch_jax.perception.recognition import LabelledImage, ShapeNetwork
from mechsearch_jax.perception.refinement import FAR, RefinementConfig, refine, select
from mechsearch_jax.perception.selection import check_numbers
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.workspace.camera import Camera, pixel_rays
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# How far a shape may reach into the shelf's faces [m].
INTO_WALLS = 0.005
# How shapes are fitted that are tried, and those that are kept.
QUICK = RefinementConfig(
    hypotheses=(),
    points=128,
    rays=192,
    stages=((10, 0.004),),
    size_prior=0.2,
    position_prior=0.02,
    yaw_prior=0.1,
)
FINE = RefinementConfig(hypotheses=(), size_prior=0.1, position_prior=0.01, yaw_prior=0.1)


@dataclasses.dataclass(frozen=True)
class PartsConfig(UnionCosts):
    """How segments are explained by parts; lengths in metres, costs in view pixels.

    Attributes:
      rounds: how often other parts are tried.
      refits: how often every part is fitted again at last.
      points: largest number of a segment's points that are used.
      rays: number of pixels in and around a segment's image whose rays are used.
      border: how far those reach beyond the segment's bounding box, as a share of its sides.
      doubtful: a segment is tried in parts if one shape costs more, and ...
      doubtful_share: ... more than this share of its pixels.
    """

    rounds: int = 3
    refits: int = 2
    points: int = 512
    rays: int = 768
    border: float = 0.25
    doubtful: float = 12.0
    doubtful_share: float = 0.03

    def __post_init__(self):
        check_numbers(self, positive=("wrong", "points", "rays"))


@dataclasses.dataclass(frozen=True)
class InParts:
    """The `Fitter` that explains the segments of another one by bodies of up to four parts.

    Attributes:
      of: the other one.
      config: of the parts.
      joining: which of the bodies are one; by default each keeps its segment. With `join_floating` a mask's segment
        may be left without a body. With a function of one's own every process compiles anew.
    """

    of: Fitter = as_segmented
    config: PartsConfig = dataclasses.field(default_factory=PartsConfig)
    joining: Joining = separate

    def __call__(
        self,
        keys: Key[Array, "2"],
        image: LabelledImage,
        shapes: ShapeNetwork,
        camera: Camera,
        shelf: Shelf,
        target: Target,
        refinement: RefinementConfig,
        least: Float[Array, ""] | float = 0.0,
    ) -> Fitted:
        fitted = self.of(keys, image, shapes, camera, shelf, target, refinement, least)
        return in_parts(image, fitted, camera, shelf, self.config, self.joining)


@cached_jit(static_argnames=("config", "joining"))
def in_parts(
    image: LabelledImage,
    fitted: Fitted,
    camera: Camera,
    shelf: Shelf,
    config: PartsConfig,
    joining: Joining = separate,
) -> Fitted:
    """What was made of an image, with its objects as bodies of parts in the same slots.

    The confidence in a body of several parts is that of an object with the misfit of all parts together.

    Args:
      image: of the camera.
      fitted: what was made of it.
      camera, shelf: of the image.
      config, joining: as of `InParts`, static.
    """
    base = fitted.objects
    eye = jnp.array(camera.position)
    noise = depth_noise(image, fitted.labels)
    slots = jnp.arange(base.capacity)
    evidence = jax.vmap(lambda slot: evidence_of(image, fitted.labels, slot, noise, camera, config))(slots)
    frames = jax.vmap(lambda body: frame_of(body, eye, jnp.float32(shelf.board)))(base)
    parts = jax.tree.map(lambda a: jnp.stack([a] * PARTS, axis=1), base)
    parts = parts.replace(valid=parts.valid & (jnp.arange(PARTS) == 0)[None])
    cost = jax.vmap(lambda p, e: _cost(p, e, config))(parts, evidence)
    doubtful = base.valid & (cost > jnp.maximum(config.doubtful, config.doubtful_share * evidence.pixels))
    scene = (camera, shelf, image.depth)

    def attempt(_, state):
        parts, cost, active = state
        members, tried = _each(_trials, config, active, parts, evidence, frames)
        tried = _refined(tried, members, active, evidence, scene, QUICK)
        after, found = _each(_chosen, config, active, parts, tried, evidence)
        better = active & (found < cost)
        return _where(better, after, parts), jnp.where(better, found, cost), better

    parts, cost, _ = jax.lax.fori_loop(0, config.rounds, attempt, (parts, cost, doubtful))
    several = jnp.sum(parts.valid, axis=1) > 1
    for _ in range(config.refits):
        members = jax.vmap(_nearest)(parts, evidence)
        again = _refined(parts, members, several, evidence, scene, FINE)
        after, found = _each(_chosen, config, several, parts, again, evidence)
        better = several & (found < cost)
        parts, cost = _where(better, after, parts), jnp.where(better, found, cost)
    misfit = jax.vmap(lambda p, e: union_misfit(table_of(p, e, config), p.valid, e))(parts, evidence)
    parts, owner = joining(parts, evidence, jnp.float32(shelf.board))
    several = jnp.sum(parts.valid, axis=1) > 1
    of_body = owner[None] == slots[:, None]
    misfit, pixels = (jnp.sum(jnp.where(of_body, each[None], 0.0), axis=1) for each in (misfit, evidence.pixels))
    misfit = misfit / jnp.maximum(pixels, 1.0)
    stands = base.valid & (owner == slots)
    measures = fitted.measures.replace(misfit=jnp.where(several, misfit, fitted.measures.misfit))
    confidence = jnp.where(several, confidence_of(measures), fitted.confidence)
    confidence = jnp.where(stands | ~base.valid, confidence, 0.0)
    joined = jnp.sum(of_body & base.valid[None], axis=1) != 1
    of_object = (fitted.labels >= 0) & (fitted.labels < base.capacity)
    return fitted.replace(
        objects=_bodies(base.replace(valid=stands), parts, frames),
        measures=measures,
        confidence=confidence,
        labels=jnp.where(of_object, owner[jnp.clip(fitted.labels, 0, base.capacity - 1)], fitted.labels).astype(
            fitted.labels.dtype
        ),
        changed=fitted.changed | (joined & base.valid),
    )


def _each(function: Callable[..., Any], config: PartsConfig, active: Bool[Array, " n"], *rows: Any) -> Any:
    """A function of a segment's rows and the costs, for each segment that is active; zeros for the others."""

    def run(_, element, row):
        return function(*row, config)

    return masked_vmap(run, active, None, None, rows, block=1 if on_cpu() else len(active))


def _where(mask: Bool[Array, " n"], a: Superquadrics, b: Superquadrics) -> Superquadrics:
    return jax.tree.map(lambda x, y: jnp.where(mask.reshape(-1, *[1] * (x.ndim - 1)), x, y), a, b)


def _bodies(base: Superquadrics, parts: Superquadrics, frames: Frame) -> Superquadrics:
    """Bodies of the parts; those of one part stay as they are."""
    turn = jnp.swapaxes(frames.rotation, -1, -2)[:, None]
    local = parts.replace(
        position=jnp.einsum("nkij,nkj->nki", turn, parts.position - frames.position[:, None], precision="highest"),
        rotation=jnp.matmul(turn, parts.rotation, precision="highest"),
    )
    bodies = bodies_of(standard_edges(local), frames.position, frames.rotation)
    several = (jnp.sum(parts.valid, axis=1) > 1) & base.valid
    return _where(several, bodies, with_parts(base, PARTS))


def _spread(count: int) -> np.ndarray:
    """Points spread evenly over the unit square: an additive recurrence."""
    ratio = 1.32471795724
    return ((0.5 + np.arange(1, count + 1)[:, None] / ratio ** np.arange(1.0, 3.0)) % 1.0).astype(np.float32)


def depth_noise(image: LabelledImage, labels: Int[Array, "h w"]) -> Float[Array, ""]:
    """Standard deviation of the depth's noise on the segments [m], from second differences along rows of the image,
    which surfaces that are flat or gently bent have none of; 0 without segments."""
    left, middle, right = (jax.lax.slice_in_dim(image.depth, i, labels.shape[1] - 2 + i, axis=1) for i in range(3))
    own = [jax.lax.slice_in_dim(labels, i, labels.shape[1] - 2 + i, axis=1) for i in range(3)]
    inside = (own[0] == own[1]) & (own[1] == own[2]) & (own[1] >= 0)
    bend = jnp.abs(left - 2.0 * middle + right)
    # The median of absolute values is 0.6745 standard deviations; the variances of the three pixels add up to six.
    usual = jnp.nanmedian(jnp.where(inside & jnp.isfinite(bend), bend, jnp.nan)) / (0.6745 * 6.0**0.5)
    return jnp.nan_to_num(usual)


def evidence_of(
    image: LabelledImage,
    labels: Int[Array, "h w"],
    slot: Int[Array, ""],
    noise: Float[Array, ""],
    camera: Camera,
    config: PartsConfig,
) -> Evidence:
    """What the segment of a slot is judged by; `noise` is of the depth [m]."""
    member = labels == slot
    height, width = labels.shape
    index, weight = select(labels.reshape(-1), slot, config.points)
    points = image.points.reshape(-1, 3)[index]
    pixels = jnp.sum(member).astype(jnp.float32)
    finite = jnp.all(jnp.isfinite(points), axis=-1)
    weight = weight * finite

    def reach(used, size):
        low, high = jnp.argmax(used), size - 1 - jnp.argmax(used[::-1])
        margin = 2.0 + config.border * (high - low)
        return jnp.maximum(low - margin, 0.0), jnp.minimum(high + margin, size - 1.0)

    (top, bottom), (left, right) = reach(member.any(axis=1), height), reach(member.any(axis=0), width)
    place = jnp.asarray(_spread(config.rays))
    rows = jnp.round(top + place[:, 0] * (bottom - top)).astype(jnp.int32)
    columns = jnp.round(left + place[:, 1] * (right - left)).astype(jnp.int32)
    seen = image.depth[rows, columns]
    return Evidence(
        points=jnp.where(finite[:, None], points, 0.0),
        point_weight=weight * pixels / jnp.maximum(jnp.sum(weight), 1.0),
        origin=jnp.array(camera.position),
        directions=pixel_rays(camera, rows * 1.0, columns * 1.0),
        free=jnp.where(jnp.isnan(seen), 0.0, jnp.minimum(seen, FAR)),
        ray_weight=(bottom - top + 1.0) * (right - left + 1.0) / config.rays,
        pixels=pixels,
        exact=jnp.maximum(config.exact, config.deviations * noise),
    )


def _cost(parts: Superquadrics, evidence: Evidence, config: PartsConfig) -> Float[Array, ""]:
    return union_cost(table_of(parts, evidence, config), parts.valid, evidence, config)


def _nearest(parts: Superquadrics, evidence: Evidence) -> Bool[Array, "k m"]:
    """The points that are nearer to each part than to any other."""
    off = jnp.where(parts.valid[:, None], jnp.abs(distance(parts, evidence.points)), jnp.inf)
    return (jnp.argmin(off, axis=0)[None] == jnp.arange(PARTS)[:, None]) & (evidence.point_weight > 0)[None]


def _trials(
    parts: Superquadrics, evidence: Evidence, frame: Frame, config: PartsConfig
) -> tuple[Bool[Array, "t m"], Superquadrics]:
    """Subsets of a segment's points, and the shapes that are tried for each."""
    table = table_of(parts, evidence, config)
    near = _nearest(parts, evidence)
    misfit = jnp.min(table.misfit, axis=0)
    bad = jnp.sum(near * (misfit * evidence.point_weight)[None], axis=1)
    bad = bad + jnp.sum(table.through, axis=1) * evidence.ray_weight
    worst = near[jnp.argmax(jnp.where(parts.valid, bad, -1.0))]
    unexplained = (misfit > 0.5) & (evidence.point_weight > 0)
    local = in_frame(frame, evidence.points)
    low, high = halves(frame, local, worst, 2)
    subsets = [
        unexplained,
        *halves(frame, local, unexplained, 2),
        low,
        high,
        *halves(frame, local, low, 2),
        *halves(frame, local, high, 2),
        *halves(frame, local, worst, 0),
        *halves(frame, local, worst, 1),
    ]
    members = jnp.stack(subsets)
    tried = jax.vmap(lambda member: guesses(frame, local, member))(members)
    tried = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), tried)
    members = jnp.repeat(members, tried.valid.shape[0] // len(subsets), axis=0)
    return jnp.concatenate([members, near]), jax.tree.map(lambda a, b: jnp.concatenate([a, b]), tried, parts)


def _refined(
    tried: Superquadrics,
    members: Bool[Array, "n t m"],
    active: Bool[Array, " n"],
    evidence: Evidence,
    scene: tuple[Camera, Shelf, Float[Array, "h w"]],
    config: RefinementConfig,
) -> Superquadrics:
    """Shapes fitted to their points; those of few points, or of segments that are not active, are not valid."""
    camera, shelf, depth = scene
    slots, count = members.shape[:2]

    def fit(shared, element, row):
        camera, shelf = shared
        depth, points = element
        guess, member, segment = row
        one = jax.tree.map(lambda a: a[None], guess)
        labels = jnp.where(member, 0, -1)
        return jax.tree.map(lambda a: a[0], refine(camera, shelf, one, points[segment], labels, depth, config).scene)

    flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), (tried, members))
    segment = jnp.repeat(jnp.arange(slots), count)
    used = (jnp.sum(members, axis=-1) >= config.minimum_points) & tried.valid & active[:, None]
    block = 1 if on_cpu() else slots
    rows = (*flat, segment)
    fits = masked_vmap(fit, used.reshape(-1), (camera, shelf), (depth, evidence.points), rows, block=block)
    fits = fits.replace(size=jnp.where(used.reshape(-1, 1), fits.size, 0.01))
    fits = jax.tree.map(lambda a: a.reshape(slots, count, *a.shape[1:]), fits)
    return fits.replace(valid=used & fits.valid & _fits_in(fits, shelf))


def _fits_in(parts: Superquadrics, shelf: Shelf) -> Bool[Array, "*batch"]:
    """Which shapes reach into the board, the back or a side by less than `INTO_WALLS`: no ray says that they do not."""
    # The rows of the rotation are the world's axes in the shape's frame.
    reach = superquadric.support(parts.size[..., None, :], parts.exponents[..., None, :], parts.rotation)
    low, high = parts.position - reach + INTO_WALLS, parts.position + reach - INTO_WALLS
    walls = shelf.walls
    stands = (low[..., 2] >= shelf.board) & (high[..., 0] <= walls.back)
    return stands & (low[..., 1] >= walls.right) & (high[..., 1] <= walls.left)


def _chosen(
    parts: Superquadrics, tried: Superquadrics, evidence: Evidence, config: PartsConfig
) -> tuple[Superquadrics, Float[Array, ""]]:
    """The best union of the parts that there are and those that were tried, in as many slots, and its cost."""
    pool = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), parts, tried)
    table = table_of(pool, evidence, config)
    start = jnp.where(parts.valid, jnp.arange(PARTS), pool.capacity)
    slots, cost = select_union(table, start, evidence, config)
    there = slots < pool.capacity
    order = jnp.argsort(~there, stable=True)
    slots = jnp.minimum(slots[order], pool.capacity - 1)
    after = jax.tree.map(lambda a: a[slots], pool)
    return after.replace(valid=there[order]), cost
