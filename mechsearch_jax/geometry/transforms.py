"""Rigid transforms as (..., 4, 4) matrices named `T_a_b`: the pose of frame b in frame a.

Leading axes broadcast against each other, whatever their number. Products are written as explicit sums: XLA fuses them,
and no GPU rounds their factors to TF32, which would move points by millimetres.
"""

from __future__ import annotations

import functools
import operator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def align(*arrays_and_ranks: tuple[Array, int]) -> list[Array]:
    """Arrays with equal numbers of leading axes, from pairs of an array and the number of its trailing axes."""
    leading = max(a.ndim - rank for a, rank in arrays_and_ranks)
    return [a.reshape((1,) * (leading - (a.ndim - rank)) + a.shape) for a, rank in arrays_and_ranks]


def rotate(rotation: Float[Array, "... 3 3"], vectors: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """`rotation @ vector`."""
    rotation, vectors = align((rotation, 2), (vectors, 1))
    terms = (rotation[..., :, k] * vectors[..., None, k] for k in range(3))
    return functools.reduce(operator.add, terms)


def transform(T_a_b: Float[Array, "... 4 4"], points: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Points given in frame b, in frame a."""
    T_a_b, points = align((T_a_b, 2), (points, 1))
    return rotate(T_a_b[..., :3, :3], points) + T_a_b[..., :3, 3]


def transform_rows(
    T_a_b: Float[Array, "*batch 4 4"], cloud: Float[Array, "*#batch 3 p"]
) -> list[Float[Array, "*batch p"]]:
    """x, y and z in frame a of a cloud given as rows of coordinates in frame b.

    Separate expressions for the coordinates fuse into a sum or a minimum over the points, without a cloud in memory.
    """
    x, y, z = (cloud[..., k, :] for k in range(3))
    rows = (T_a_b[..., row, :, None] for row in range(3))
    return [r[..., 0, :] * x + r[..., 1, :] * y + r[..., 2, :] * z + r[..., 3, :] for r in rows]


def compose(T_a_b: Float[Array, "... 4 4"], T_b_c: Float[Array, "... 4 4"]) -> Float[Array, "... 4 4"]:
    """`T_a_c`."""
    return matmul(T_a_b, T_b_c)


def matmul(a: Float[Array, "... i j"], b: Float[Array, "... j k"]) -> Float[Array, "... i k"]:
    """Product of small matrices, as explicit sums: a batched 3 x 3 product is slower than the arithmetic around it."""
    a, b = align((a, 2), (b, 2))
    terms = (a[..., :, k : k + 1] * b[..., k : k + 1, :] for k in range(a.shape[-1]))
    return functools.reduce(operator.add, terms)


def make(rotation: Float[Array, "*batch 3 3"], position: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4 4"]:
    """The transform of a rotation and a position."""
    top = jnp.concatenate([rotation, position[..., None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0], top.dtype), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


def inverse(T_a_b: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 4 4"]:
    """`T_b_a`."""
    rotation = jnp.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return make(rotation, -rotate(rotation, T_a_b[..., :3, 3]))


def translate(T_a_b: Float[Array, "*#batch 4 4"], offset: Float[Array, "*#batch 3"]) -> Float[Array, "*batch 4 4"]:
    """The same frame moved by an offset given in frame a."""
    return _moved(T_a_b, offset[..., None])


def back_off(T_a_b: Float[Array, "*#batch 4 4"], distance: Float[Array, "*#batch"]) -> Float[Array, "*batch 4 4"]:
    """The same frame moved by a distance along its own -z."""
    return _moved(T_a_b, -distance[..., None, None] * T_a_b[..., :3, 2:3])


def _moved(T_a_b: Float[Array, "... 4 4"], offset: Float[Array, "... 3 1"]) -> Float[Array, "... 4 4"]:
    """The frame moved by an offset: a sum, which fuses with what reads it, unlike an update in place."""
    T_a_b, offset = align((T_a_b, 2), (offset, 2))
    width = [(0, 0, 0)] * (offset.ndim - 2) + [(0, 1, 0), (3, 0, 0)]
    return T_a_b + jax.lax.pad(offset, jnp.zeros((), offset.dtype), width)


def yaw_rotation(yaw: Float[Array, "*batch"]) -> Float[Array, "*batch 3 3"]:
    """Rotation about the vertical by an angle [rad]."""
    c, s, zero, unit = jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw), jnp.ones_like(yaw)
    rows = [[c, -s, zero], [s, c, zero], [zero, zero, unit]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def exponential(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The rotation about a vector's direction by its length [rad] (Rodrigues); smooth at zero."""
    square = jnp.sum(vector**2)
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    a = jnp.where(small, 1.0 - square / 6.0, jnp.sin(angle) / angle)
    b = jnp.where(small, 0.5 - square / 24.0, (1.0 - jnp.cos(angle)) / angle**2)
    x, y, z = vector
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    return jnp.eye(3) + a * cross + b * matmul(cross, cross)


def upright_pose(pose: Float[Array, "*batch 3"], z: float | Array) -> Float[Array, "*batch 4 4"]:
    """`T_world_target` of a target upright at `pose` = x, y [m], yaw [rad], with its centre at height `z` [m]."""
    height = jnp.full(pose.shape[:-1], z, pose.dtype)
    return make(yaw_rotation(pose[..., 2]), jnp.stack([pose[..., 0], pose[..., 1], height], axis=-1))
