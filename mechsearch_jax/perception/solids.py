"""Recognised boxes and cylinders in closed form: distances of points, and where rays enter them.

Refinement fits boxes and elliptic cylinders with nearly sharp edges, so that many of them can be compared with an image
at the cost of a few operations for each pixel. All functions take objects without a batch axis, fields (N, ...).
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.perception.scores import EDGE

# Level directions that are tested as separating axes, beside the objects' axes.
_SPREAD = 16
# An object that is shrunk keeps at least this share of its size.
_LEAST = 0.3


def local(objects: Superquadrics, vectors: Float[Array, "p 3"]) -> tuple[Array, Array, Array]:
    """The components of world vectors in every object's frame, each of the shape (N, P)."""
    x, y, z = (vectors[None, :, k] for k in range(3))
    turn = objects.rotation
    first, second, third = (
        turn[:, 0, i, None] * x + turn[:, 1, i, None] * y + turn[:, 2, i, None] * z for i in range(3)
    )
    return first, second, third


def relative(objects: Superquadrics, points: Float[Array, "p 3"]) -> list[Array]:
    """The coordinates of world points in every object's frame [m], each of the shape (N, P)."""
    centre = jnp.einsum("nki,nk->ni", objects.rotation, objects.position, precision="highest")
    return [part - centre[:, i, None] for i, part in enumerate(local(objects, points))]


def surface_distance(objects: Superquadrics, points: Float[Array, "p 3"]) -> Float[Array, "n p"]:
    """Approximate signed distance of world points from every object's surface [m], negative inside."""
    x, y, z = relative(objects, points)
    a, b, c = (objects.size[:, i, None] for i in range(3))
    across = (jnp.sqrt((x / a) ** 2 + (y / b) ** 2) - 1.0) * jnp.minimum(a, b)
    is_round = (objects.exponents[:, 1] > EDGE)[:, None]
    past_x = jnp.where(is_round, across, jnp.abs(x) - a)
    past_y = jnp.where(is_round, across, jnp.abs(y) - b)
    past_z = jnp.abs(z) - c
    zero = jnp.float32(0.0)
    # A round object's distance across counts once.
    out_y = jnp.where(is_round, zero, jnp.maximum(past_y, zero))
    outside = jnp.sqrt(jnp.maximum(past_x, zero) ** 2 + out_y**2 + jnp.maximum(past_z, zero) ** 2)
    return outside + jnp.minimum(jnp.maximum(jnp.maximum(past_x, past_y), past_z), zero)


def entries(
    objects: Superquadrics, origin: Float[Array, " 3"], directions: Float[Array, "p 3"], shrink: float = 0.0
) -> Float[Array, "n p"]:
    """How far along each ray it enters every object, in lengths of its direction; infinite for a miss.

    Args:
      objects: absent ones are missed.
      origin: where all rays start.
      directions: of the rays.
      shrink: by how much the objects' half-extents are reduced [m].
    """
    size = jnp.maximum(objects.size - shrink, _LEAST * objects.size)
    start = [part for part in relative(objects, origin[None])]
    way = [jnp.where(jnp.abs(part) < 1e-9, 1e-9, part) for part in local(objects, directions)]
    ends = [
        jnp.stack([(-size[:, i, None] - start[i]) / way[i], (size[:, i, None] - start[i]) / way[i]]) for i in range(3)
    ]
    low, high = [jnp.min(e, axis=0) for e in ends], [jnp.max(e, axis=0) for e in ends]

    (u, v), (du, dv) = ([part / size[:, i, None] for i, part in enumerate(parts[:2])] for parts in (start, way))
    square = jnp.maximum(du**2 + dv**2, 1e-12)
    half = u * du + v * dv
    root = half**2 - square * (u**2 + v**2 - 1.0)
    spread = jnp.sqrt(jnp.maximum(root, 0.0))
    in_tube, out_tube = (-half - spread) / square, (-half + spread) / square
    is_round = (objects.exponents[:, 1] > EDGE)[:, None]
    enter = jnp.maximum(jnp.where(is_round, in_tube, jnp.maximum(low[0], low[1])), low[2])
    leave = jnp.minimum(jnp.where(is_round, out_tube, jnp.minimum(high[0], high[1])), high[2])
    hit = (enter < leave) & (leave > 0.0) & objects.valid[:, None] & ~(is_round & (root <= 0.0))
    return jnp.where(hit, enter, jnp.inf)


def reach(objects: Superquadrics, directions: Float[Array, "n d 3"]) -> Float[Array, "n d"]:
    """How far every object reaches from its centre along its own directions, unit vectors [m]."""
    along = jnp.abs(jnp.einsum("nki,ndk->ndi", objects.rotation, directions, precision="highest"))
    along = along * objects.size[:, None, :]
    level = jnp.sqrt(along[..., 0] ** 2 + along[..., 1] ** 2)
    is_round = (objects.exponents[:, 1] > EDGE)[:, None]
    return jnp.where(is_round, level, along[..., 0] + along[..., 1]) + along[..., 2]


def penetrations(objects: Superquadrics) -> Float[Array, "n n"]:
    """Upper bound of how deep every two objects are in each other [m]; negative if apart, and for absent ones.

    The least overlap of their projections on several directions, as `overlaps.depth_in_each_other`.
    """
    n = objects.capacity
    turn = np.pi * np.arange(_SPREAD) / _SPREAD
    level = jnp.asarray(np.stack([np.cos(turn), np.sin(turn), np.zeros(_SPREAD)], axis=1), jnp.float32)
    axes = jnp.swapaxes(objects.rotation, -1, -2)
    pairs = (n, n)
    directions = jnp.concatenate(
        [
            jnp.broadcast_to(axes[:, None], (*pairs, 3, 3)),
            jnp.broadcast_to(axes[None], (*pairs, 3, 3)),
            jnp.broadcast_to(level[None, None], (*pairs, _SPREAD, 3)),
        ],
        axis=2,
    )
    first = reach(objects, directions.reshape(n, -1, 3)).reshape(n, n, -1)
    second = reach(objects, jnp.swapaxes(directions, 0, 1).reshape(n, -1, 3)).reshape(n, n, -1)
    offset = objects.position[None] - objects.position[:, None]
    apart = jnp.abs(jnp.sum(directions * offset[:, :, None, :], axis=-1))
    depth = jnp.min(first + jnp.swapaxes(second, 0, 1) - apart, axis=-1)
    both: Bool[Array, "n n"] = objects.valid[:, None] & objects.valid[None]
    return jnp.where(both & ~jnp.eye(n, dtype=bool), depth, -jnp.inf)
