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
from mechsearch_jax.runtime.pytree import PyTreeNode, static

# Pairs that a CPU tests together: by boxes, by bounds, and by gauges.
BOXES, CLOUDS, GAUGES = 1024, 128, 32
# Pairs of a cloud and a body of several parts that a CPU tests together.
BODIES = 512
# `_numbers` of what is absent: a sphere out of reach of any cloud.
ABSENT = np.array([1, 0, 0, 1e3, 0, 1, 0, 1e3, 0, 0, 1, 1e3, 1e-3, 1e-3, 1e-3, 1, 1], np.float32)
# With at most so many pairs, bounds do not pay: gauges decide at once.
FEW = 1024
# State of a pair: apart, undecided, or colliding.
APART, OPEN, HIT = np.uint8(0), np.uint8(1), np.uint8(2)


class Clouds(PyTreeNode):
    """Point clouds, each in its own frame.

    Attributes:
      points: as rows of coordinates, shape (C, 3, P) [m].
      low, high: corners of their bounding boxes, shape (C, 3) [m].
      gap: largest distance of a point from the nearest of the first `first` points of its cloud [m].
      first: number of points that are tested first, for clouds that a whole batch shares; 0 to test all at once.
        Static.
    """

    points: jax.Array
    low: jax.Array
    high: jax.Array
    gap: jax.Array | float = 0.0
    first: int = static(default=0)


def clouds_of(points: Float[Array, "c 3 p"]) -> Clouds:
    """Clouds from their points, as rows of coordinates [m]."""
    return Clouds(points, jnp.min(points, axis=-1), jnp.max(points, axis=-1))


def gap_of(points: Float[np.ndarray, "p 3"], first: int) -> float:
    """`Clouds.gap` of a cloud: how far a point is at most from the nearest of the first ones [m]."""
    from scipy.spatial import KDTree

    return float(KDTree(points[:first]).query(points)[0].max()) if len(points) > first else 0.0


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
    table = (clouds.points, boxes, clouds.gap)
    rows = (jnp.asarray(cloud, jnp.uint32), T_world_cloud, objects, table[:2] if own else None)
    if scene.parts is None:
        return merged(functools.partial(_collide, clouds.first))(mask, None if own else table, rows)
    if uses_kernel():
        of_parts = per_part(scene, mask) & scene.parts.valid.reshape(1, -1)
        hits = merged(functools.partial(_collide, clouds.first))(of_parts, None if own else table, rows)
        return any_part(scene, hits)
    run = functools.partial(_collide_bodies, clouds.first, scene.parts.capacity)
    rows = (_numbers(boxed(scene)), *rows)
    return merged(run, indices=scene.parts.capacity)(mask, None if own else table, rows)


def _numbers(scene: Superquadrics) -> Float[Array, "n 17"]:
    """`T_object_world`, half-extents and exponents of superquadrics."""
    T_object_world = inverse(make(scene.rotation, scene.position))[:, :3].reshape(-1, 12)
    return jnp.concatenate([T_object_world, scene.size, scene.exponents], axis=1)


def _collide(first: int, mask: Bool[Array, "*batch m n"], shared: tuple | None, rows: tuple) -> Array:
    """`collisions` with leading batch axes."""
    if mask.size == 0:
        return mask
    if uses_kernel():
        lead = mask.ndim - 2
        cloud, T_world_cloud, objects, own = rows
        points, boxes = own if shared is None else (a.reshape(*[1] * lead, *a.shape) for a in shared[:2])
        # Clouds that differ along a batch have no gaps, which are not needed where `first` is 0.
        gap = 0.0 if shared is None else shared[2]
        return collide(mask, points, boxes, gap, cloud, T_world_cloud, objects, 0 if shared is None else first)
    m, n = mask.shape[-2:]
    pairs = _AllPairs(mask.shape, shared, *rows)
    state = jnp.where(mask.reshape(-1), OPEN, APART)
    state = pairs.decided(state, _near, BOXES)
    if first:
        state = pairs.decided(state, functools.partial(_bounded, count=first), CLOUDS)
    if m * n > FEW:
        state = pairs.decided(state, _bounded, CLOUDS)
    state = pairs.decided(state, _gauged, GAUGES)
    return (state == HIT).reshape(mask.shape)


def _collide_bodies(
    first: int, parts: int, mask: Bool[Array, "*batch m n"], shared: tuple | None, rows: tuple
) -> Array:
    """`collisions` of bodies with `parts` parts each on a CPU, with leading batch axes.

    Few bodies are near a cloud, and few of their parts: a table of all clouds and parts would take longer to look
    through than to test.
    """
    boxes, cloud, T_world_cloud, objects, own = rows
    if mask.size == 0:
        return mask
    bodies = _AllPairs(mask.shape, shared, cloud, T_world_cloud, boxes, own)
    pairs = _AllPairs((*mask.shape[:-1], mask.shape[-1] * parts), shared, cloud, T_world_cloud, objects, own)
    state = jnp.where(mask.reshape(-1), OPEN, APART)
    state = bodies.decided(state, _near, BOXES)
    tests = [(_bounded, CLOUDS), (_gauged, GAUGES)]
    tests = [(functools.partial(_bounded, count=first), CLOUDS), *tests] if first else tests

    def body(state, index, active):
        pair = jax.lax.min(index, jnp.uint32(len(state) - 1))
        each = (pair[:, None] * jnp.uint32(parts) + jnp.arange(parts, dtype=jnp.uint32)[None]).reshape(-1)
        of_parts = jnp.where(jnp.repeat(active, parts), _near(pairs.at(each)), APART)
        for test, block in tests:
            of_parts = pairs.decided(of_parts, test, block, each)
        return put(state, index, jnp.max(of_parts.reshape(-1, parts), axis=1))

    return (for_each(state == OPEN, body, state, block_size(BODIES, len(state))) == HIT).reshape(mask.shape)


class _Pairs(NamedTuple):
    """K pairs of a placed cloud and an object.

    Attributes:
      relative: the cloud's pose in the object's frame, shape (K, 3, 4).
      size, exponents: of the object.
      table: gives the clouds' points (0) or boxes (1), with a leading axis K.
      gap: of `Clouds` that a whole batch shares.
    """

    relative: Float[Array, "k 3 4"]
    size: Float[Array, "k 3"]
    exponents: Float[Array, "k 2"]
    table: Callable[[int], Array]
    gap: Array | float

    def coordinates(self, count: int = 0) -> Float[Array, "3 k p"]:
        """Magnitudes of the coordinates, in half-extents, of the first `count` points, or of all if it is 0."""
        points = self.table(0)
        points = points[..., :count] if count else points
        rows = jnp.moveaxis(self.relative / self.size[:, :, None], 1, 0)
        x, y, z = jnp.moveaxis(points, 1, 0)
        return jnp.abs(rows[..., :1] * x[None] + rows[..., 1:2] * y[None] + (rows[..., 2:3] * z[None] + rows[..., 3:]))


@dataclasses.dataclass(frozen=True, eq=False)
class _AllPairs:
    """All pairs of placed clouds and objects, for a CPU, which tests fewer and fewer pairs more and more closely.

    Attributes:
      shape: of the mask.
      shared: points, boxes and gap of clouds that a whole batch shares.
      clouds, T_world_cloud, objects, own: see `collisions`, with leading batch axes.
    """

    shape: tuple[int, ...]
    shared: tuple | None
    clouds: Array
    T_world_cloud: Array
    objects: Array
    own: tuple | None

    def decided(
        self, state: UInt8[Array, " some"], test: Callable[[_Pairs], Array], block: int, which: Array | None = None
    ) -> UInt8[Array, " some"]:
        """The states of the pairs after a test of the undecided ones; `which` has their numbers if they are not all."""
        last = jnp.uint32(len(state) - 1)

        def body(state, index, active):
            number = jax.lax.min(index, last)
            return put(state, index, test(self.at(number if which is None else taken(which, number))))

        return for_each(state == OPEN, body, state, block_size(block, len(state)))

    def at(self, index: Integer[Array, " k"]) -> _Pairs:
        """The pairs of these numbers."""
        batch, (m, n) = self.shape[:-2], self.shape[-2:]
        entry, width = entry_of(index, batch, m * n), jnp.uint32(n)
        j = jax.lax.rem(index, width)
        k = jax.lax.rem(jax.lax.div(index, width), jnp.uint32(m))
        numbers, cloud = entry.of(self.objects, (j, n)), entry.of(self.clouds, (k, m))
        relative = matmul(numbers[:, :12].reshape(-1, 3, 4), entry.of(self.T_world_cloud, (k, m)))

        def table(i: int) -> Array:
            if self.shared is not None:
                return taken(self.shared[i], cloud)
            assert self.own is not None
            return entry.of(self.own[i], (cloud, self.own[i].shape[len(batch)]))

        gap = 0.0 if self.shared is None else self.shared[2]
        return _Pairs(relative, numbers[:, 12:15], numbers[:, 15:], table, gap)


def _near(pairs: _Pairs) -> UInt8[Array, " k"]:
    """Which bounding boxes of clouds and objects overlap, along the axes of the clouds."""
    box, rotation = pairs.table(1), pairs.relative[:, :, :3]
    reach = jnp.sum(jnp.abs(rotation) * pairs.size[:, :, None], axis=1)
    centre = -jnp.sum(rotation * pairs.relative[:, :, 3:], axis=1)
    return jnp.where(jnp.all((centre - reach < box[:, 1]) & (centre + reach > box[:, 0]), axis=1), OPEN, APART)


def _bounded(pairs: _Pairs, count: int = 0) -> UInt8[Array, " k"]:
    """The states by bounds on the gauge of all points, or of the first `count`."""
    least, most = _bounds(pairs.coordinates(count), pairs.exponents)
    if count:
        # The gauge is a norm, at most the length over the least half-extent, or twice that below 2-norms.
        twice = jnp.where(jnp.max(pairs.exponents, axis=1) > 1.0, 2.0, 1.0)
        least = least - twice * pairs.gap / jnp.min(pairs.size, axis=1)
    return jnp.where(most < 1.0, HIT, jnp.where(least < 1.0, OPEN, APART))


def _gauged(pairs: _Pairs) -> UInt8[Array, " k"]:
    """The states by the gauge of all points."""
    least = jnp.min(superquadric.unit_gauge(pairs.coordinates(), pairs.exponents.T[:, :, None]), axis=1)
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
    return jnp.min(jnp.maximum(below, z), axis=1), jnp.min(jnp.maximum(above, z), axis=1) * roots[:, 0]
