"""Point clouds against superquadrics: the one place where collisions are looked for.

A cloud collides with an object if one of its points is inside it, where the gauge is below 1 (paper equations 14 to
17). Powers are by far the most expensive part of that test, and almost never needed: most pairs are told apart by boxes
around them, and the p-norms of the gauge lie between norms without powers, which decide every cloud except those that
graze the surface.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.collision_kernel import collide, kernel_available
from mechsearch_jax.geometry.masked import Entry, block_size, entry_of, for_each, merged, on_cpu, put, taken
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import inverse, make, matmul

# How many pairs a CPU looks at together: at boxes, at whole clouds, and at gauges.
BOXES, CLOUDS, GAUGES = 1024, 128, 32
# Of so few pairs, those that are near are decided by gauges at once: it would not pay to look at bounds first.
FEW = 1024
# What is known of a pair: it is apart, not decided yet, or it collides.
APART, OPEN, HIT = jnp.uint8(0), jnp.uint8(1), jnp.uint8(2)


class Clouds(flax.struct.PyTreeNode):
    """Point clouds, each in a frame of its own.

    Attributes:
      points: as rows of coordinates, shape (C, 3, P) [m].
      low, high: boxes around them, shape (C, 3) [m].
      gap: how far a point may be from the nearest one of the first `first` of its cloud [m].
      first: so many points of a cloud that all of a batch share are looked at first; all where it is 0. Static.
    """

    points: jax.Array
    low: jax.Array
    high: jax.Array
    gap: jax.Array | float = 0.0
    first: int = flax.struct.field(pytree_node=False, default=0)


def clouds_of(points: Float[Array, "c 3 p"]) -> Clouds:
    """Clouds from their points, as rows of coordinates [m]."""
    return Clouds(points, jnp.min(points, axis=-1), jnp.max(points, axis=-1))


def collisions(
    clouds: Clouds,
    cloud: Int[Array | np.ndarray, " m"],
    T_world_cloud: Float[Array, "m 4 4"],
    scene: Superquadrics,
    mask: Bool[Array, "m n"],
    own: bool = False,
) -> Bool[Array, "m n"]:
    """Which placed clouds collide with which objects.

    Args:
      clouds: what is placed.
      cloud: which of them each placed cloud is.
      T_world_cloud: where it is.
      scene: the objects, fields (N, ...).
      mask: pairs that are worth a look; the others are reported as free of collision.
      own: whether the clouds differ along a batch. If they do not they are not copied; static.

    Returns:
      True where a masked pair collides.
    """
    T_object_world = inverse(make(scene.rotation, scene.position))[:, :3].reshape(-1, 12)
    objects = jnp.concatenate([T_object_world, scene.size, scene.exponents], axis=1)
    boxes = jnp.stack([clouds.low, clouds.high], axis=1)
    table = (clouds.points, boxes, clouds.gap)
    rows = (jnp.asarray(cloud, jnp.uint32), T_world_cloud, objects, table[:2] if own else None)
    return merged(functools.partial(_collide, clouds.first))(mask, None if own else table, rows)


def _collide(first: int, mask: Bool[Array, "*batch m n"], shared: tuple | None, rows: tuple) -> Array:
    """See `collisions`; the axes of a batch may be in front."""
    batch, (m, n), total = mask.shape[:-2], mask.shape[-2:], mask.size
    clouds, T_world_cloud, objects, own = rows
    if not on_cpu() and kernel_available():
        if shared is not None:
            own = tuple(a.reshape(*[1] * len(batch), *a.shape) for a in shared[:2])
        return collide(mask, *own, clouds, T_world_cloud, objects)

    class Pairs(NamedTuple):
        """Pairs of a cloud and an object, and the cloud's pose in the object's frame, as 3 x 4 numbers."""

        relative: Array
        size: Array
        exponents: Array
        entry: Entry
        cloud: Array

        def table(self, i: int) -> Array:
            if shared is not None:
                return taken(shared[i], self.cloud)
            return self.entry.of(own[i], (self.cloud, own[i].shape[len(batch)]))

    def pairs(index):
        entry, width = entry_of(index, batch, m * n), jnp.uint32(n)
        j = jax.lax.rem(index, width)
        k = jax.lax.rem(jax.lax.div(index, width), jnp.uint32(m))
        numbers = entry.of(objects, (j, n))
        relative = matmul(numbers[:, :12].reshape(-1, 3, 4), entry.of(T_world_cloud, (k, m)))
        return Pairs(relative, numbers[:, 12:15], numbers[:, 15:], entry, entry.of(clouds, (k, m)))

    def near(index):
        """Whether the boxes around clouds and objects overlap, along the axes of the clouds'."""
        here = pairs(index)
        box = here.table(1)
        rotation = here.relative[:, :, :3]
        reach = jnp.sum(jnp.abs(rotation) * here.size[:, :, None], axis=1)
        centre = -jnp.sum(rotation * here.relative[:, :, 3:], axis=1)
        return jnp.where(jnp.all((centre - reach < box[:, 1]) & (centre + reach > box[:, 0]), axis=1), OPEN, APART)

    def coordinates(here, count):
        """Magnitudes of the points' coordinates in half-extents, (3, K, P)."""
        points = here.table(0)
        points = points[..., :count] if count else points
        rows = jnp.moveaxis(here.relative / here.size[:, :, None], 1, 0)
        x, y, z = jnp.moveaxis(points, 1, 0)
        return jnp.abs(rows[..., :1] * x[None] + rows[..., 1:2] * y[None] + (rows[..., 2:3] * z[None] + rows[..., 3:]))

    def bounded(count):
        def bounds(index):
            here = pairs(index)
            least, most = _bounds(coordinates(here, count), here.exponents)
            if count:
                assert shared is not None
                # The gauge is a norm, at most the length over the least half-extent, or twice that below 2-norms.
                twice = jnp.where(jnp.max(here.exponents, axis=1) > 1.0, 2.0, 1.0)
                least = least - twice * shared[2] / jnp.min(here.size, axis=1)
            return jnp.where(most < 1.0, HIT, jnp.where(least < 1.0, OPEN, APART))

        return bounds

    def gauged(index):
        here = pairs(index)
        least = jnp.min(superquadric.unit_gauge(coordinates(here, 0), here.exponents.T[:, :, None]), axis=1)
        return jnp.where(least < 1.0, HIT, APART)

    def decide(state, test, block):
        """Look closer at what is open."""

        def body(state, index, active):
            return put(state, index, test(jax.lax.min(index, jnp.uint32(total - 1))))

        return for_each(state == OPEN, body, state, block_size(block))

    state = decide(jnp.where(mask.reshape(-1), OPEN, APART), near, BOXES)
    if first:
        state = decide(state, bounded(first), CLOUDS)
    if m * n > FEW:
        state = decide(state, bounded(0), CLOUDS)
    state = decide(state, gauged, GAUGES)
    return (state == HIT).reshape(mask.shape)


def _bounds(scaled: Float[Array, "3 k p"], exponents: Float[Array, "k 2"]) -> tuple[Float[Array, " k"], ...]:
    """Bounds on the least gauge of points, with no power evaluated per point.

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
