"""Objects seen from above: a rectangle or an ellipse and a range of heights."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.bodies import world_parts
from mechsearch_jax.geometry.superquadric import ROUND_EXPONENT, Superquadrics
from mechsearch_jax.runtime.pytree import PyTreeNode

QUARTER_TURN = math.pi / 2

Numbers = Array | np.ndarray

# Gap below which things count as touching [m].
TOUCH = 0.004
# What stands on something may be recognised so far above or below its top [m].
STACKED = 0.01


class Footprints(PyTreeNode):
    """Objects seen from above: a rectangle or an ellipse and a range of heights, every field with leading axis N.

    Attributes:
      half: half-extents along its own axes [m], shape (N, 2).
      round: whether it is an ellipse, shape (N,).
      position: of its centre [m], shape (N, 2).
      yaw: of its first axis [rad], shape (N,).
      low, high: of its heights [m], shape (N,).
      valid: whether the slot holds an object, shape (N,).
      parts: footprints of the parts of each body, placed in its own footprint's axes, fields (N, P, ...); None if every
        body is a single superquadric. See `in_world`.
    """

    half: jax.Array
    round: jax.Array
    position: jax.Array
    yaw: jax.Array
    low: jax.Array
    high: jax.Array
    valid: jax.Array
    parts: Footprints | None = None


def footprints(scene: Superquadrics) -> Footprints:
    """Footprints of objects; for a tilted object, that of its bounding box.

    An approximation: exponents e2 above 0.6 about a vertical axis count as round, everything else as a rectangle.
    """
    whole = _footprints(scene)
    if scene.parts is None:
        return whole
    parts = jax.tree.map(lambda a: a.reshape(scene.capacity, -1, *a.shape[1:]), _footprints(world_parts(scene)))
    low, high = (
        sign * jnp.min(jnp.where(parts.valid, sign * side, jnp.inf), axis=1)
        for sign, side in ((1.0, parts.low), (-1.0, parts.high))
    )
    return whole.replace(
        low=jnp.where(whole.valid, low, whole.low),
        high=jnp.where(whole.valid, high, whole.high),
        parts=parts.replace(
            position=turned(-whole.yaw[:, None], parts.position - whole.position[:, None]),
            yaw=parts.yaw - whole.yaw[:, None],
        ),
    )


def in_world(prints: Footprints) -> Footprints:
    """The footprints of all parts in the world, fields (N P, ...), in the order of `bodies.world_parts`."""
    if prints.parts is None:
        return prints
    parts = prints.parts
    placed = parts.replace(
        position=turned(prints.yaw[:, None], parts.position) + prints.position[:, None],
        yaw=parts.yaw + prints.yaw[:, None],
    )
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), placed)


def _footprints(scene: Superquadrics) -> Footprints:
    """`footprints` of superquadrics, and of those that bound bodies."""
    heading = headings(scene.rotation, scene.exponents)
    c, s, zero = jnp.cos(heading.yaw), jnp.sin(heading.yaw), jnp.zeros_like(heading.yaw)
    # Along its yaw, across it, and upwards.
    rows = [jnp.stack(row, axis=-1) for row in ((c, -s, zero), (s, c, zero), (zero, zero, zero + 1.0))]
    reach = extents(scene, jnp.stack(rows, axis=-2))
    half_upright = jnp.sum(scene.size[:, None] * heading.level, axis=-1)
    half = jnp.where(heading.upright[:, None], half_upright, reach[:, :2])
    z, height = scene.position[:, 2], reach[:, 2]
    return Footprints(half, heading.round, scene.position[:, :2], heading.yaw, z - height, z + height, scene.valid)


class Headings(NamedTuple):
    """Orientations of objects as seen from above; see `footprints`.

    Attributes:
      yaw: of the first level axis [rad].
      level: one-hot indices of the first and the second level axis, shape (..., 2, 3).
      upright: whether one axis is vertical.
      round: whether they are round seen from above.
    """

    yaw: Float[Array, "*batch"]
    level: Float[Array, "*batch 2 3"]
    upright: Bool[Array, "*batch"]
    round: Bool[Array, "*batch"]


def headings(rotation: Float[Numbers, "*batch 3 3"], exponents: Float[Numbers, "*batch 2"]) -> Headings:
    """The orientations of objects from `R_world_object` and exponents."""
    up = jnp.abs(rotation[..., 2, :])
    vertical = jnp.argmax(up, axis=-1)
    order = (vertical[..., None] + jnp.arange(1, 3).reshape(*[1] * vertical.ndim, 2)) % 3
    level = jax.nn.one_hot(order, 3)
    axis = jnp.sum(rotation[..., :2, :] * level[..., :1, :], axis=-1)
    upright = jnp.max(up, axis=-1) > 0.98
    is_round = upright & (vertical == 2) & (exponents[..., 1] > ROUND_EXPONENT)
    return Headings(jnp.arctan2(axis[..., 1], axis[..., 0]), level, upright, is_round)


def turned(yaw: Float[Array, "..."], v: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
    """Planar vectors turned by angles [rad] that correspond to their first axes."""
    c, s = (a.reshape(a.shape + (1,) * (v.ndim - 1 - a.ndim)) for a in (jnp.cos(yaw), jnp.sin(yaw)))
    return jnp.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], axis=-1)


def dot(a, b):
    """Dot product of planar vectors, written out: a sum over an axis would be a separate kernel on a GPU."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def _overlapping(prints: Footprints) -> Bool[Array, "n n"]:
    """Which footprints, without parts, overlap by more than `TOUCH`, whatever their heights.

    Along the axes of both and the line between their centres. An approximation: an ellipse that passes the corner of a
    rectangle within about a centimetre may count, too.
    """
    n, c, s = prints.yaw.shape[0], jnp.cos(prints.yaw), jnp.sin(prints.yaw)
    axes = jnp.stack([c, s, -s, c], axis=-1).reshape(n, 2, 2)
    arms = axes * prints.half[..., None]
    offset = prints.position[None] - prints.position[:, None]
    apart = jnp.sqrt(jnp.maximum(dot(offset, offset), 1e-12))[..., None]
    of_first = jnp.broadcast_to(axes[:, None], (n, n, 2, 2))
    normals = jnp.concatenate([(offset / apart)[:, :, None], of_first, jnp.swapaxes(of_first, 0, 1)], axis=2)

    def reach(arms: Float[Array, "*#pairs 2 2"], is_round: Bool[Array, "*#pairs"]) -> Float[Array, "n n k"]:
        along = jnp.abs(jnp.sum(normals[..., None, :] * arms[:, :, None], axis=-1))
        ellipse = jnp.sqrt(jnp.maximum(jnp.sum(along**2, axis=-1), 1e-12))
        return jnp.where(is_round[..., None], ellipse, jnp.sum(along, axis=-1))

    both = reach(arms[:, None], prints.round[:, None]) + reach(arms[None], prints.round[None])
    common = both - jnp.abs(jnp.sum(normals * offset[:, :, None], axis=-1))
    # Between equal centres there is no line.
    common = jnp.minimum(jnp.where(apart[..., 0] > 1e-4, common[..., 0], jnp.inf), jnp.min(common[..., 1:], axis=-1))
    return common > TOUCH


def supports(prints: Footprints) -> Bool[Array, "n n"]:
    """Which object (row) carries which (column).

    The lowest point of what is carried is within `STACKED` of a top, and above the middle of what has it; from above
    both overlap. Bodies of several parts carry with any part, and stand on those that reach down to their lowest point.
    Nothing whose lowest point is on the board is carried, however it leans.
    """
    shapes, parts = in_world(prints), 1 if prints.parts is None else prints.parts.valid.shape[1]
    foot = jnp.repeat(prints.low, parts) if parts > 1 else prints.low
    stands = shapes.valid & (shapes.low < foot + STACKED)
    carries = shapes.valid[:, None] & stands[None] & _overlapping(shapes)
    carries &= jnp.abs(foot[None] - shapes.high[:, None]) < STACKED
    carries &= foot[None] > 0.5 * (foot + shapes.high)[:, None]
    return jnp.any(carries.reshape(-1, parts, prints.valid.shape[0], parts), axis=(1, 3)) if parts > 1 else carries


def extents(scene: Superquadrics, directions: Float[Array, "*#n 3 d"]) -> Float[Array, "n d"]:
    """How far objects reach from their centres along directions [m].

    An approximation: an object is an elliptic cylinder if its exponent e2 is above 0.6, else a box; both contain the
    superquadric.

    Args:
      scene: the objects, fields (N, ...).
      directions: unit vectors in the world, as columns; the same for all objects, or for each object its own.
    """
    directions = directions[None] if directions.ndim == 2 else directions
    local = jnp.sum(scene.rotation[:, :, :, None] * directions[:, :, None, :], axis=1)
    x, y, z = jnp.moveaxis(jnp.abs(local) * scene.size[:, :, None], 1, 0)
    square = x**2 + y**2
    plane = jnp.sqrt(jnp.where(square > 0, square, 1.0)) * (square > 0)
    return jnp.where((scene.exponents[:, 1] > ROUND_EXPONENT)[:, None], plane, x + y) + z


def lowest_points(scene: Superquadrics) -> Float[Array, " n"]:
    """Heights of the objects' lowest points [m], as of `footprints`."""
    shapes = world_parts(scene)
    z = shapes.position[:, 2] - extents(shapes, jnp.array([[0.0], [0.0], [1.0]]))[:, 0]
    if scene.parts is None:
        return z
    return jnp.min(jnp.where(shapes.valid, z, jnp.inf).reshape(scene.capacity, -1), axis=1)


def bounding_half_extents(scene: Superquadrics) -> Float[Array, "n 3"]:
    """Half-extents of the objects' bounding boxes along the world's axes [m]; see `extents`."""
    return extents(scene, jnp.eye(3))
