"""Choose the objects that account for an image at the least cost: points on no object, rays through one, overlaps."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.geometry.masked import masked_vmap, on_cpu
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.images.cloud import above_board, draw
from mechsearch_jax.images.labels import OTHER
from mechsearch_jax.perception.hypotheses import WAYS
from mechsearch_jax.perception.recognition import LabelledImage
from mechsearch_jax.perception.refinement import FAR
from mechsearch_jax.perception.solids import entries, penetrations, surface_distance
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode, static
from mechsearch_jax.workspace.camera import Camera, pixel_rays
from mechsearch_jax.workspace.shelf import Shelf


@dataclasses.dataclass(frozen=True)
class Costs:
    """What an explanation costs; lengths in metres, costs in view pixels.

    Attributes:
      points: number of points that an explanation is judged by.
      rays: at most about so many rays, spread evenly over the view.
      exact: a point this near to an object's surface is explained, or one that is so many times as near as ...
      deviations: ... the median of the points of the segments.
      wrong: a point that is farther by this is not; between the two its cost grows evenly.
      faces: points within this distance of the shelf's faces are not judged: with a camera that is a little off they
        may be the shelf's.
      shrink: rays may pass this deep below an object's faces.
      object: price of an object.
      gain: by how much another explanation must be better, and ...
      gain_share: ... by which share of the pixels of the segments that it changes.
      overlap: objects may be so deep in each other, and in the target; recognition's own error.
      overlap_cost: of each further centimetre.
    """

    points: int = 4096
    rays: int = 16384
    exact: float = 0.003
    deviations: float = 2.5
    wrong: float = 0.005
    faces: float = 0.008
    shrink: float = 0.005
    object: float = 8.0
    gain: float = 4.0
    gain_share: float = 0.01
    overlap: float = 0.01
    overlap_cost: float = 20.0

    def __post_init__(self):
        check_numbers(self, positive=("points", "rays", "wrong"))


def check_numbers(config: Any, positive: tuple[str, ...]) -> None:
    """Check that all numbers of a configuration are finite and at least 0, and some of them more.

    Args:
      config: what is checked, a dataclass.
      positive: names of those that must be more than 0.

    Raises:
      InputError: one is not.
    """
    for field in dataclasses.fields(config):
        value, least = getattr(config, field.name), "positive" if field.name in positive else "at least 0"
        if not (math.isfinite(value) and value >= 0 and (value > 0 or field.name not in positive)):
            raise InputError(f"{type(config).__name__}: {field.name} ({value}) must be {least}")


class Sample(PyTreeNode):
    """Points and rays that an explanation is judged by.

    Attributes:
      points: of segments [m], shape (M, 3).
      label: of each point.
      index: the pixel of each point.
      weight: pixels for each point.
      origin: of the rays, shape (3,).
      directions: of rays, shape (R, 3).
      free: length up to which each ray is free; 0 if nothing was measured.
      exact: a point this near to a surface is explained [m].
      judged: the pixels that an explanation is judged by, shape (h, w).
      ray_weight: pixels for each ray; static.
    """

    points: jax.Array
    label: jax.Array
    index: jax.Array
    weight: jax.Array
    origin: jax.Array
    directions: jax.Array
    free: jax.Array
    exact: jax.Array
    judged: jax.Array
    ray_weight: float = static()


def sample_of(
    key: Array, image: LabelledImage, base: Superquadrics, camera: Camera, shelf: Shelf, costs: Costs
) -> Sample:
    """Points and rays of an image; `base` are the objects of its segments."""
    judged = above_board(shelf, image.points, costs.faces) & ~image.of_target
    # What belongs to no segment speaks for no object.
    index, total = draw(key, ((image.labels >= 0) & judged).reshape(-1), costs.points)
    height, width = image.labels.shape
    step = max(1, math.ceil(math.sqrt(height * width / costs.rays)))
    rows, columns = (jnp.arange(step // 2, size, step) for size in (height, width))
    seen = image.depth[rows[:, None], columns[None, :]].reshape(-1)
    grid = jnp.meshgrid(rows * 1.0, columns * 1.0, indexing="ij")
    free = jnp.where(jnp.isnan(seen), 0.0, jnp.minimum(seen, FAR))
    label = jnp.where(total > 0, image.labels.reshape(-1)[index], OTHER).astype(jnp.int32)
    points = jnp.where(total > 0, image.points.reshape(-1, 3)[index], 0.0)
    off = jnp.abs(surface_distance(base, points))[jnp.maximum(label, 0), jnp.arange(costs.points)]
    usual = jnp.nanmedian(jnp.where((label >= 0) & base.valid[jnp.maximum(label, 0)], off, jnp.nan))
    return Sample(
        points=points,
        label=label,
        index=index,
        weight=total / costs.points,
        origin=jnp.array(camera.position),
        directions=pixel_rays(camera, *grid).reshape(-1, 3),
        free=free,
        exact=jnp.maximum(costs.exact, costs.deviations * jnp.nan_to_num(usual)),
        judged=judged,
        ray_weight=float(step**2),
    )


def point_cost(distance: Array, sample: Sample, costs: Costs) -> Array:
    """0 for a point on a surface, 1 for one that is far from it."""
    return jnp.clip((jnp.abs(distance) - sample.exact) / costs.wrong, 0.0, 1.0)


def passed(scene: Superquadrics, sample: Sample, costs: Costs) -> Float[Array, " n"]:
    """Number of pixels whose measured rays pass through each object."""
    enter = entries(scene, sample.origin, sample.directions, costs.shrink)
    return jnp.sum(enter < sample.free[None] - costs.shrink, axis=1) * sample.ray_weight


class Moves(PyTreeNode):
    """Changes of an explanation, each from one set of objects to another, shape (Q, C), and which are possible.

    The objects are those of the segments, both parts of every division, the unions, and the target.
    """

    removed: jax.Array
    added: jax.Array
    possible: jax.Array


def moves_of(
    slots: int,
    chosen: Int[Array, " k"],
    divided: Bool[Array, " d"],
    pair: tuple[Array, Array],
    joined: Bool[Array, " m"],
    drops: bool = True,
) -> Moves:
    """Divide a segment into two objects or one of them, join a pair, or drop an object; the target stays.

    Args:
      slots: number of segments' objects.
      chosen: segments that are divided, each in `WAYS` ways.
      divided: which of the divisions are tried.
      pair: first and second segment of each union.
      joined: which of the unions are tried.
      drops: whether objects are dropped.
    """
    count = len(divided)
    capacity = slots + 2 * count + len(joined) + 1
    of_segment = jax.nn.one_hot(jnp.repeat(chosen, WAYS), capacity, dtype=bool)
    first, second = (jax.nn.one_hot(slots + 2 * jnp.arange(count) + i, capacity, dtype=bool) for i in (0, 1))
    merged = [jax.nn.one_hot(each, capacity, dtype=bool) for each in pair]
    union = jax.nn.one_hot(slots + 2 * count + jnp.arange(len(joined)), capacity, dtype=bool)
    each = jnp.eye(capacity, dtype=bool)[:-1]
    return Moves(
        removed=jnp.concatenate([of_segment, of_segment, of_segment, merged[0] | merged[1], each]),
        added=jnp.concatenate([first | second, first, second, union, jnp.zeros_like(each)]),
        possible=jnp.concatenate([divided, divided, divided, joined, jnp.full(len(each), drops)]),
    )


class Selection(PyTreeNode):
    """The objects that explain an image at the least cost.

    Attributes:
      selected: which objects, shape (C,).
      margin: by how many pixels each object is better than what would stand for it otherwise, shape (C,); infinite
        where nothing was tried.
    """

    selected: jax.Array
    margin: jax.Array


def select_objects(
    scene: Superquadrics, moves: Moves, sample: Sample, pixels: Int[Array, " n"], costs: Costs
) -> Selection:
    """Which objects explain the image at the least cost, by the best change at a time from those of the segments.

    Args:
      scene: the objects, in the order of `Moves`.
      moves, sample: of the image.
      pixels: of the segments.
      costs: static.
    """
    capacity, slots = scene.capacity, len(pixels)
    of_target = jnp.arange(capacity) == capacity - 1
    cost = jnp.where(scene.valid[:, None], point_cost(surface_distance(scene, sample.points), sample, costs), 1.0)
    price = jnp.where(of_target, 0.0, costs.object + passed(scene, sample, costs))
    overlap = costs.overlap_cost * 100.0 * jnp.maximum(penetrations(scene) - costs.overlap, 0.0)

    # What a change must gain, for those that begin with a segment.
    size = jnp.concatenate([pixels, jnp.zeros(capacity - slots)])
    needed = costs.gain + costs.gain_share * jnp.sum(moves.removed * size[None], axis=1)
    table = (cost, price, overlap, sample.weight)

    def gains_from(selected, present):
        after = (selected[None] & ~moves.removed) | (moves.added & scene.valid[None])
        possible = moves.possible & jnp.all(~moves.removed | selected[None], axis=1)
        possible &= jnp.all(~moves.added | scene.valid[None], axis=1)
        possible &= jnp.sum(after & ~of_target[None], axis=1) <= slots
        block = 1 if on_cpu() else slots
        costs_after = masked_vmap(
            lambda _, table, row: explanation_cost(table, row), possible, None, table, after, block=block
        )
        return after, jnp.where(possible, present - costs_after, -jnp.inf)

    def step(state):
        selected, present, _, rounds, margin, _ = state
        after, gains = gains_from(selected, present)
        best = jnp.argmax(gains - needed)
        better = gains[best] > needed[best]
        margin = jnp.where(better & moves.added[best], jnp.minimum(margin, gains[best]), margin)
        selected = jnp.where(better, after[best], selected)
        return selected, jnp.where(better, present - gains[best], present), better, rounds + 1, margin, gains

    start = scene.valid & ((jnp.arange(capacity) < slots) | of_target)
    unlimited, nothing = jnp.full(capacity, jnp.inf), jnp.full(len(needed), -jnp.inf)
    state = (start, explanation_cost(table, start), jnp.array(True), 0, unlimited, nothing)
    selected, _, _, _, margin, gains = jax.lax.while_loop(lambda state: state[2] & (state[3] < slots), step, state)
    left = jnp.min(jnp.where(moves.removed, -gains[:, None], jnp.inf), axis=0)
    return Selection(selected, jnp.minimum(margin, left))


def explanation_cost(table: tuple[Array, Array, Array, Array], selected: Bool[Array, " c"]) -> Array:
    """The cost of an explanation; `table` has each object's cost of each point, its price, its overlaps, and a point's
    number of pixels."""
    cost, price, overlap, weight = table
    left = jnp.min(jnp.where(selected[:, None], cost, 1.0), axis=0)
    both = jnp.sum(jnp.where(selected[:, None] & selected[None], overlap, 0.0)) / 2.0
    return jnp.sum(left) * weight + jnp.sum(jnp.where(selected, price, 0.0)) + both
