"""Objects seen from above: a rectangle or an ellipse and a range of heights."""

from __future__ import annotations

import math

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mechsearch_jax.geometry.superquadric import Superquadrics

ROUND_EXPONENT = 0.6
QUARTER_TURN = math.pi / 2


class Footprints(flax.struct.PyTreeNode):
    """Objects seen from above: a rectangle or an ellipse and a range of heights, every field with leading axis N."""

    half: jax.Array
    round: jax.Array
    position: jax.Array
    yaw: jax.Array
    low: jax.Array
    high: jax.Array
    valid: jax.Array


def footprints(scene: Superquadrics) -> Footprints:
    """Footprints of objects; of one that lies tilted, those of its bounding box's projection.

    An approximation: exponents e2 above 0.6 about a vertical axis count as round, everything else as a rectangle.
    """
    rows = jnp.arange(scene.capacity)
    vertical = jnp.argmax(jnp.abs(scene.rotation[:, 2, :]), axis=-1)
    first, second = (vertical + 1) % 3, (vertical + 2) % 3
    axis = scene.rotation[rows, :, first]
    yaw = jnp.arctan2(axis[:, 1], axis[:, 0])
    along = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
    across = jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)], axis=-1)
    upright = jnp.abs(scene.rotation[rows, 2, vertical]) > 0.98
    # Each object has directions of its own here.
    one_by_one = jax.vmap(lambda one, u: extents(jax.tree.map(lambda a: a[None], one), u)[0])
    level = jnp.stack([along, across], axis=-1)
    projected = one_by_one(scene, jnp.concatenate([level, jnp.zeros_like(level[:, :1])], axis=1))
    own = [scene.size[rows, first], scene.size[rows, second]]
    half = jnp.where(upright[:, None], jnp.stack(own, axis=-1), projected)
    height = bounding_half_extents(scene)[:, 2]
    z = scene.position[:, 2]
    is_round = upright & (vertical == 2) & (scene.exponents[:, 1] > ROUND_EXPONENT)
    return Footprints(half, is_round, scene.position[:, :2], yaw, z - height, z + height, scene.valid)


def turned(yaw: Float[Array, "..."], v: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
    """Planar vectors turned by angles that belong to their first axes [rad]."""
    c, s = (a.reshape(a.shape + (1,) * (v.ndim - 1 - a.ndim)) for a in (jnp.cos(yaw), jnp.sin(yaw)))
    return jnp.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], axis=-1)


def dot(a, b):
    """Product of planar vectors, written out: a sum over an axis would be a kernel of its own on a GPU."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def extents(scene: Superquadrics, directions: Float[Array, "3 d"]) -> Float[Array, "n d"]:
    """How far objects reach from their centres along directions [m].

    An approximation: the objects are taken as elliptic cylinders if their exponent e2 is above 0.6, else as boxes; both
    hold the superquadric, however it is turned.

    Args:
      scene: the objects, fields (N, ...).
      directions: unit vectors in the world, as columns.
    """
    local = jnp.sum(scene.rotation[:, :, :, None] * directions[None, :, None, :], axis=1)
    x, y, z = (jnp.abs(local[:, i]) * scene.size[:, i, None] for i in range(3))
    square = x**2 + y**2
    plane = jnp.sqrt(jnp.where(square > 0, square, 1.0)) * (square > 0)
    return jnp.where((scene.exponents[:, 1] > ROUND_EXPONENT)[:, None], plane, x + y) + z


def bounding_half_extents(scene: Superquadrics) -> Float[Array, "n 3"]:
    """Half-extents of the objects' bounding boxes along the world's axes [m]; see `extents`."""
    return extents(scene, jnp.eye(3))
