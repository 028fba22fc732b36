"""Points against superquadrics, and points against the shelf.

A cloud collides with an object if one of its points is inside it (paper equations 14 to 17). Powers are by far the most
expensive part of that test, and almost never needed: the p-norms of the gauge lie between norms without powers, which
decide every cloud except those that graze the surface.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax import superquadric
from mechsearch_jax.masked import masked_vmap
from mechsearch_jax.shelf import Shelf
from mechsearch_jax.superquadric import Superquadrics


def rotate(rotation: Float[Array, "*#batch 3 3"], vectors: Float[Array, "*#batch 3"]) -> Float[Array, "*batch 3"]:
    """`rotation @ vector`, as explicit sums so that float32 is not rounded to TF32 on an accelerator."""
    return sum(rotation[..., :, k] * vectors[..., None, k] for k in range(3))


def compose(a: Float[Array, "*#batch 4 4"], b: Float[Array, "*#batch 4 4"]) -> Float[Array, "*batch 4 4"]:
    """`T_a @ T_b` at full float32 precision."""
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def relative_pose(
    rotation: Float[Array, "*#batch 3 3"], position: Float[Array, "*#batch 3"], T_world_cloud: Float[Array, "*#batch 4 4"]
) -> Float[Array, "*batch 4 4"]:
    """`T_object_cloud` from an object's rotation and position and a cloud's pose, both in the world."""
    shape = jnp.broadcast_shapes(rotation.shape[:-2], position.shape[:-1], T_world_cloud.shape[:-2])
    rotation = jnp.broadcast_to(rotation, (*shape, 3, 3))
    T_world_cloud = jnp.broadcast_to(T_world_cloud, (*shape, 4, 4))
    inverse = jnp.swapaxes(rotation, -1, -2)
    turned = jnp.matmul(inverse, T_world_cloud[..., :3, :3], precision=jax.lax.Precision.HIGHEST)
    moved = rotate(inverse, T_world_cloud[..., :3, 3] - position)
    top = jnp.concatenate([turned, moved[..., None]], axis=-1)
    return jnp.concatenate([top, jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0]), (*shape, 1, 4))], axis=-2)


def _transform_cloud(T, cloud):
    """Coordinates of a cloud stored as three rows, after a rigid transform: three arrays of its length."""
    return [sum(T[i, k] * cloud[k] for k in range(3)) + T[i, 3] for i in range(3)]


def _bounds(clouds, entry):
    """Whether a cloud certainly is clear of an object, and whether it certainly hits it: no power evaluated per point."""
    index, T_object_cloud, size, exponents = entry
    p, r = 2.0 / exponents[1], 2.0 / exponents[0]
    x, y, z = (jnp.abs(q) / size[k] for k, q in enumerate(_transform_cloud(T_object_cloud, clouds[index])))
    most, two = jnp.maximum(x, y), jnp.sqrt(x * x + y * y)
    below = jnp.where(p > 2.0, most, two)
    above = jnp.where(p >= 2.0, jnp.minimum(two, 2.0 ** (1.0 / p) * most), x + y)
    lower = jnp.min(jnp.maximum(below, z))
    upper = jnp.min(jnp.maximum(above, z)) * 2.0 ** (1.0 / r)
    return lower, upper


def _least_gauge(clouds, entry):
    index, T_object_cloud, size, exponents = entry
    points = jnp.stack(_transform_cloud(T_object_cloud, clouds[index]), axis=-1)
    return jnp.min(superquadric.gauge(size[None], exponents[None], points))


def any_inside(
    clouds: Float[Array, "c 3 p"],
    index: Int[Array, " n"],
    T_object_cloud: Float[Array, "n 4 4"],
    size: Float[Array, "n 3"],
    exponents: Float[Array, "n 2"],
    mask: Bool[Array, " n"],
) -> Bool[Array, " n"]:
    """Whether any point of a cloud lies inside a superquadric, for `n` pairs of them.

    Args:
      clouds: point clouds as three rows of coordinates, in their own frames [m].
      index: which cloud each pair uses.
      T_object_cloud: pose of the cloud in the object's frame.
      size, exponents: the superquadric of each pair.
      mask: pairs that are worth a look; the others are reported as free of collision.

    Returns:
      True where a masked pair collides.
    """
    arguments = (index, T_object_cloud, size, exponents)
    lower, upper = masked_vmap(_bounds, mask, clouds, arguments)
    grazes = mask & (lower < 1.0) & (upper >= 1.0)
    least = masked_vmap(_least_gauge, grazes, clouds, arguments, block=64)
    return mask & ((upper < 1.0) | (grazes & (least < 1.0)))


def points_inside(scene: Superquadrics, points: Float[Array, "*batch 3"]) -> Bool[Array, "*batch n"]:
    """Whether world points lie inside each of the scene's objects; never inside an absent one."""
    local = superquadric.to_object_frame(scene, points)
    return (superquadric.gauge(scene.size, scene.exponents, local) < 1.0) & scene.valid


def hits_shelf(shelf: Shelf, points: Float[Array, "*batch 3"], radius: float | Array = 0.0) -> Bool[Array, "*batch"]:
    """Whether spheres about world points touch the shelf, whose sides and ceiling are taken closer by their margins.

    Everything beyond the front edge has to be inside the free box. That is exact except below the board and behind the
    walls, where nothing can be without having passed through them.
    """
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    inside = (
        (x + radius <= shelf.back)
        & (y - radius >= shelf.right + shelf.side_margin)
        & (y + radius <= shelf.left - shelf.side_margin)
        & (z - radius >= shelf.board)
        & (z + radius <= shelf.ceiling - shelf.ceiling_margin)
    )
    return (x + radius > shelf.front) & ~inside
