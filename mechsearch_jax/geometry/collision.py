"""Collision tests of point clouds with superquadrics.

A cloud collides with an object if one of its points is inside, where the gauge is below 1 (paper equations 14 to 17).
Powers are by far the most expensive part of that test, and rarely needed: bounding boxes separate most pairs, and the
p-norms of the gauge lie between norms without powers, which decide every cloud that does not graze the surface.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Integer, UInt8

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.bodies import any_part, boxed, per_part, world_parts
from mechsearch_jax.geometry.collision_kernel import collide, uses_kernel
from mechsearch_jax.geometry.masked import block_size, entry_of, for_each, merged, put, taken
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import inverse, make, matmul
from mechsearch_jax.runtime.pytree import PyTreeNode

# Pairs that a CPU tests together: by boxes, by bounds, by bounds of groups of points, and by gauges.
BOXES, CLOUDS, GROUPS, GAUGES = 1024, 128, 512, 32
# Pairs of a cloud and a body of several parts that a CPU tests together.
BODIES = 512
# `_numbers` of what is absent: a sphere out of reach of any cloud.
ABSENT = np.array([1, 0, 0, 1e3, 0, 1, 0, 1e3, 0, 0, 1, 1e3, 1e-3, 1e-3, 1e-3, 1, 1], np.float32)
# With at most so many pairs, bounds do not pay: gauges decide at once.
FEW = 1024
# Points of a group of `Dense`, and of several groups that are near each other: a step of the kernel.
GROUP, STEP = 64, 256
# State of a pair: apart, undecided, or colliding.
APART, OPEN, HIT = np.uint8(0), np.uint8(1), np.uint8(2)


class Clouds(PyTreeNode):
    """Point clouds, each in its own frame.

    Attributes:
      points: as rows of coordinates, shape (C, 3, P) [m].
      low, high: corners of their bounding boxes, shape (C, 3) [m].
      dense: what helps to test clouds of many points, which a whole batch shares; else None.
    """

    points: jax.Array
    low: jax.Array
    high: jax.Array
    dense: Dense | None = None


class Dense(PyTreeNode):
    """A part of each of C clouds that is tested first, and groups of points that are near each other.

    Attributes:
      coarse: F points of each cloud that cover it evenly, as rows of coordinates, shape (C, 3, F) [m].
      gap: largest distance of a point of a cloud from the nearest of these, shape (C,) [m].
      groups: corners of boxes around `GROUP` points each, in their order, shape (C, L, 2, 3) [m].
    """

    coarse: jax.Array
    gap: jax.Array
    groups: jax.Array


def clouds_of(points: Float[Array, "c 3 p"]) -> Clouds:
    """Clouds from their points, as rows of coordinates [m]."""
    return Clouds(points, jnp.min(points, axis=-1), jnp.max(points, axis=-1))


def dense_clouds(points: Float[np.ndarray, "c p 3"], coarse: int) -> Clouds:
    """Clouds of many points, the first `coarse` of which cover each evenly [m]."""
    from scipy.spatial import KDTree

    gap = [KDTree(cloud[:coarse]).query(cloud)[0].max() for cloud in points]
    ordered = np.stack([_grouped(cloud).T for cloud in points])
    groups = ordered.reshape(*ordered.shape[:2], -1, GROUP)
    boxes = np.stack([groups.min(axis=-1), groups.max(axis=-1)], axis=1).transpose(0, 3, 1, 2)
    first = points[:, :coarse].transpose(0, 2, 1)
    dense = Dense(*(jnp.asarray(a, jnp.float32) for a in (first, np.array(gap), boxes)))
    return clouds_of(jnp.asarray(ordered, jnp.float32)).replace(dense=dense)


def _grouped(points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "q 3"]:
    """Points in groups of `GROUP` that are near each other, in larger groups of `STEP`; the last is repeated until all
    are full."""

    def halves(rows: np.ndarray, unit: int) -> list[np.ndarray]:
        if len(rows) <= unit:
            return [rows]
        axis = np.argmax(np.ptp(points[rows], axis=0))
        rows, half = rows[np.argsort(points[rows, axis], kind="stable")], len(rows) // unit // 2 * unit
        return halves(rows[:half], unit) + halves(rows[half:], unit)

    rows = np.pad(np.arange(len(points)), (0, -len(points) % STEP), mode="edge")
    return points[np.concatenate([group for large in halves(rows, STEP) for group in halves(large, GROUP)])]


def collisions(
    clouds: Clouds,
    cloud: Int[Array | np.ndarray, " m"],
    T_world_cloud: Float[Array, "m 4 4"],
    scene: Superquadrics,
    mask: Bool[Array, "m n"],
    own: bool = False,
) -> Bool[Array, "m n"]:
    """Which placed clouds collide with which objects: hits of a body are hits of any of its parts.

    Args:
      clouds: C point clouds.
      cloud: index of each placed cloud.
      T_world_cloud: pose of each placed cloud.
      scene: the objects, fields (N, ...).
      mask: pairs to test; the result is False for the others.
      own: whether the clouds differ along a batch. If not, they are not copied. Static.

    Returns:
      True where a masked pair collides.
    """
    objects = _numbers(world_parts(scene))
    if scene.parts is not None:
        # On a CPU no mask tells which parts are absent, whose fields may hold anything, a rotation of zeros too.
        objects = jnp.where(scene.parts.valid.reshape(-1, 1), objects, ABSENT)
    boxes = jnp.stack([clouds.low, clouds.high], axis=1)
    table = (clouds.points, boxes, clouds.dense)
    rows = (jnp.asarray(cloud, jnp.uint32), T_world_cloud, objects, table[:2] if own else None)
    # The kernel needs an index for each placed cloud, not for each pair.
    indices = 1 / max(len(objects), 1) if uses_kernel() else 1.0
    if scene.parts is None:
        return merged(_collide, indices)(mask, None if own else table, rows)
    if uses_kernel():
        of_parts = per_part(scene, mask) & scene.parts.valid.reshape(1, -1)
        return any_part(scene, merged(_collide, indices)(of_parts, None if own else table, rows))
    run = functools.partial(_collide_bodies, scene.parts.capacity)
    rows = (_numbers(boxed(scene)), *rows)
    return merged(run, indices=float(scene.parts.capacity))(mask, None if own else table, rows)


def _numbers(scene: Superquadrics) -> Float[Array, "n 17"]:
    """`T_object_world`, half-extents and exponents of superquadrics."""
    T_object_world = inverse(make(scene.rotation, scene.position))[:, :3].reshape(-1, 12)
    return jnp.concatenate([T_object_world, scene.size, scene.exponents], axis=1)


def _collide(mask: Bool[Array, "*batch m n"], shared: tuple | None, rows: tuple) -> Array:
    """`collisions` with leading batch axes."""
    if mask.size == 0:
        return mask
    if uses_kernel():
        cloud, T_world_cloud, objects, own = rows
        points, boxes, dense = (*own, None) if shared is None else shared
        if shared is not None:
            lead = [1] * (mask.ndim - 2)
            points, boxes, dense = jax.tree.map(lambda a: a.reshape(*lead, *a.shape), (points, boxes, dense))
        return collide(mask, points, boxes, dense, cloud, T_world_cloud, objects)
    m, n = mask.shape[-2:]
    pairs = _AllPairs(mask.shape, shared, *rows)
    state = pairs.decided(jnp.full(mask.size, APART), _near, BOXES, mask=mask.reshape(-1))
    if shared is not None and shared[2] is not None:
        state = pairs.decided(state, _bounded_by_coarse, CLOUDS)
        return (pairs.decided_by_groups(state) == HIT).reshape(mask.shape)
    if m * n > FEW:
        state = pairs.decided(state, _bounded, CLOUDS)
    state = pairs.decided(state, _gauged, GAUGES)
    return (state == HIT).reshape(mask.shape)


def _collide_bodies(parts: int, mask: Bool[Array, "*batch m n"], shared: tuple | None, rows: tuple) -> Array:
    """`collisions` of bodies with `parts` parts each on a CPU, with leading batch axes.

    Few bodies are near a cloud, and few of their parts: a table of all clouds and parts would take longer to look
    through than to test.
    """
    boxes, cloud, T_world_cloud, objects, own = rows
    if mask.size == 0:
        return mask
    bodies = _AllPairs(mask.shape, shared, cloud, T_world_cloud, boxes, own)
    pairs = _AllPairs((*mask.shape[:-1], mask.shape[-1] * parts), shared, cloud, T_world_cloud, objects, own)
    state = bodies.decided(jnp.full(mask.size, APART), _near, BOXES, mask=mask.reshape(-1))
    tests = [(_bounded, CLOUDS), (_gauged, GAUGES)]
    if shared is not None and shared[2] is not None:
        tests = [(_bounded_by_coarse, CLOUDS), *tests]

    def body(state, index, active):
        pair = jax.lax.min(index, jnp.uint32(len(state) - 1))
        each = (pair[:, None] * jnp.uint32(parts) + jnp.arange(parts, dtype=jnp.uint32)[None]).reshape(-1)
        of_parts = jnp.where(jnp.repeat(active, parts), _near(pairs.at(each)), APART)
        for test, block in tests:
            of_parts = pairs.decided(of_parts, test, block, each)
        return put(state, index, jnp.max(of_parts.reshape(-1, parts), axis=1))

    return (for_each(state == OPEN, body, state, block_size(BODIES, len(state))) == HIT).reshape(mask.shape)


class _Pairs(NamedTuple):
    """K pairs of a placed cloud, or of a group of its points, and an object.

    Attributes:
      relative: the cloud's pose in the object's frame, shape (K, 3, 4).
      size, exponents: of the object.
      points, box: give the cloud's points and its box, with a leading axis K.
      coarse: gives those of `Dense` and their gap.
    """

    relative: Float[Array, "k 3 4"]
    size: Float[Array, "k 3"]
    exponents: Float[Array, "k 2"]
    points: Callable[[], Array]
    box: Callable[[], Array]
    coarse: Callable[[], tuple[Array, Array]]

    def coordinates(self, points: Float[Array, "k 3 p"]) -> Float[Array, "3 k p"]:
        """Magnitudes of the coordinates of points in half-extents."""
        rows = jnp.moveaxis(self.relative / self.size[:, :, None], 1, 0)
        x, y, z = jnp.moveaxis(points, 1, 0)
        return jnp.abs(rows[..., :1] * x[None] + rows[..., 1:2] * y[None] + (rows[..., 2:3] * z[None] + rows[..., 3:]))


# Numbers of pairs, or of pairs and of a group of each.
Numbers = Integer[Array, " k"] | tuple[Integer[Array, " k"], Integer[Array, " k"]]


@dataclasses.dataclass(frozen=True, eq=False)
class _AllPairs:
    """All pairs of placed clouds and objects, for a CPU, which tests fewer and fewer pairs more and more closely.

    Attributes:
      shape: of the mask.
      shared: points, boxes and `Dense` of clouds that a whole batch shares.
      clouds, T_world_cloud, objects, own: see `collisions`, with leading batch axes.
    """

    shape: tuple[int, ...]
    shared: tuple | None
    clouds: Array
    T_world_cloud: Array
    objects: Array
    own: tuple | None

    def decided(
        self,
        state: UInt8[Array, " some"],
        test: Callable[[_Pairs], Array],
        block: int,
        which: Numbers | None = None,
        mask: Bool[Array, " some"] | None = None,
    ) -> UInt8[Array, " some"]:
        """The states of the pairs after a test of the undecided ones, or of those of a mask; `which` has their numbers
        if they are not all."""
        last = jnp.uint32(len(state) - 1)

        def body(state, index, active):
            number = jax.lax.min(index, last)
            chosen = number if which is None else jax.tree.map(lambda numbers: taken(numbers, number), which)
            return put(state, index, test(self.at(chosen)))

        return for_each(state == OPEN if mask is None else mask, body, state, block_size(block, len(state)))

    def decided_by_groups(self, state: UInt8[Array, " some"]) -> UInt8[Array, " some"]:
        """The states of all pairs, from those groups of the undecided ones' points that are near the object."""
        assert self.shared is not None
        count = self.shared[2].groups.shape[1]

        def body(state, index, active):
            pair = jnp.repeat(jax.lax.min(index, jnp.uint32(len(state) - 1)), count)
            each = pair, jnp.tile(jnp.arange(count, dtype=jnp.uint32), len(index))
            of_groups = jnp.where(jnp.repeat(active, count), _near(self.at(each)), APART)
            for test, block in ((_bounded, GROUPS), (_gauged, GAUGES)):
                of_groups = self.decided(of_groups, test, block, each)
            return put(state, index, jnp.max(of_groups.reshape(-1, count), axis=1))

        return for_each(state == OPEN, body, state, block_size(CLOUDS, len(state)))

    def at(self, index: Numbers) -> _Pairs:
        """The pairs of these numbers."""
        index, group = index if isinstance(index, tuple) else (index, None)
        batch, (m, n) = self.shape[:-2], self.shape[-2:]
        entry, width = entry_of(index, batch, m * n), jnp.uint32(n)
        j = jax.lax.rem(index, width)
        k = jax.lax.rem(jax.lax.div(index, width), jnp.uint32(m))
        numbers, cloud = entry.of(self.objects, (j, n)), entry.of(self.clouds, (k, m))
        relative = matmul(numbers[:, :12].reshape(-1, 3, 4), entry.of(self.T_world_cloud, (k, m)))

        def of(i: int) -> Array:
            if self.shared is None:
                assert self.own is not None
                return entry.of(self.own[i], (cloud, self.own[i].shape[len(batch)]))
            if group is None:
                return taken(self.shared[i], cloud)
            points, _, dense = self.shared
            count = dense.groups.shape[1]
            grouped = jnp.moveaxis(points.reshape(*points.shape[:2], count, -1), 2, 1) if i == 0 else dense.groups
            return taken(grouped.reshape(-1, *grouped.shape[2:]), cloud * jnp.uint32(count) + group)

        def coarse() -> tuple[Array, Array]:
            assert self.shared is not None
            return taken(self.shared[2].coarse, cloud), taken(self.shared[2].gap, cloud)

        points, box = functools.partial(of, 0), functools.partial(of, 1)
        return _Pairs(relative, numbers[:, 12:15], numbers[:, 15:], points, box, coarse)


def _near(pairs: _Pairs) -> UInt8[Array, " k"]:
    """Which bounding boxes of clouds and objects overlap, along the axes of the clouds."""
    box, rotation = pairs.box(), pairs.relative[:, :, :3]
    # Products of small matrices: a CPU takes five times as long for sums over an axis of three.
    reach = matmul(pairs.size[:, None], jnp.abs(rotation))[:, 0]
    centre = -matmul(pairs.relative[:, None, :, 3], rotation)[:, 0]
    return jnp.where(jnp.all((centre - reach < box[:, 1]) & (centre + reach > box[:, 0]), axis=1), OPEN, APART)


def _bounded(pairs: _Pairs) -> UInt8[Array, " k"]:
    """The states by bounds on the gauge of all points."""
    least, most = _bounds(pairs.coordinates(pairs.points()), pairs.exponents)
    return jnp.where(most < 1.0, HIT, jnp.where(least < 1.0, OPEN, APART))


def _bounded_by_coarse(pairs: _Pairs) -> UInt8[Array, " k"]:
    """The states by bounds on the gauge of the points that cover a cloud evenly."""
    points, gap = pairs.coarse()
    least, most = _bounds(pairs.coordinates(points), pairs.exponents)
    # The gauge is a norm, at most the length over the least half-extent, or twice that below 2-norms.
    twice = jnp.where(jnp.max(pairs.exponents, axis=1) > 1.0, 2.0, 1.0)
    least = least - twice * gap / jnp.min(pairs.size, axis=1)
    return jnp.where(most < 1.0, HIT, jnp.where(least < 1.0, OPEN, APART))


def _gauged(pairs: _Pairs) -> UInt8[Array, " k"]:
    """The states by the gauge of all points."""
    least = jnp.min(superquadric.unit_gauge(pairs.coordinates(pairs.points()), pairs.exponents.T[:, :, None]), axis=1)
    return jnp.where(least < 1.0, HIT, APART)


def _bounds(scaled: Float[Array, "3 k p"], exponents: Float[Array, "k 2"]) -> tuple[Float[Array, " k"], ...]:
    """Bounds on the least gauge of points, without a power for each point.

    Args:
      scaled: magnitudes of their coordinates in half-extents.
      exponents: of the superquadrics.
    """
    powers = 2.0 / exponents
    roots = jnp.exp2(0.5 * exponents)
    p, root = powers[:, 1:], roots[:, 1:]
    x, y, z = scaled
    most, two = jnp.maximum(x, y), jnp.sqrt(x * x + y * y)
    below = jnp.where(p > 2.0, most, two)
    above = jnp.where(p >= 2.0, jnp.minimum(two, root * most), x + y)
    # The axis and the plane are joined by an r-norm with r >= 1: at least the larger of the two, at most 2^(1/r)
    # times it.
    # Both in one reduction, which a CPU compiles to one loop over the points.
    least = jnp.min(jnp.stack([jnp.maximum(below, z), jnp.maximum(above, z)]), axis=2)
    return least[0], least[1] * roots[:, 0]
