"""Collisions of links 2 to 5 with objects. Links 6 and 7 and the hand are rigid in the gripper's frame, and are tested
as point clouds."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.bodies import any_part, world_parts
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics, gauge, to_object_frame
from mechsearch_jax.geometry.transforms import inverse, make, transform
from mechsearch_jax.robot.gripper import arm_points

# Exponent that a superquadric grown by a sphere tends to; a little below an ellipsoid's, so that the grown superquadric
# contains the Minkowski sum up to millimetres (see the tests).
ROUND = 0.7


def grown(
    size: Float[Array, "*batch 3"], exponents: Float[Array, "*batch 2"], radius: Float[Array, "*batch"]
) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 2"]]:
    """Approximate Minkowski sum of superquadrics and spheres as superquadrics, larger and with rounder edges [m].

    Returns:
      size and exponents.
    """
    across = jnp.stack([jnp.sum(size, axis=-1) / 3.0, jnp.sum(size[..., :2], axis=-1) / 2.0], axis=-1)
    share = (radius[..., None] / (across + radius[..., None])).astype(exponents.dtype)
    rounder = jnp.minimum(exponents, ROUND) * (1.0 - share) + ROUND * share
    return size + radius[..., None], jnp.maximum(exponents, rounder)


def arm_hits(q: Float[Array, "w 7"], scene: Superquadrics, count: int = 5) -> Bool[Array, "w n"]:
    """Which objects links 2 to 5 touch in each of w configurations.

    Args:
      q: joint angles [rad], so close to each other that no link passes an object between them.
      scene: the objects, fields (N, ...).
      count: spheres for each capsule, see `arm_points`.
    """
    points, radius = arm_points(q, count)
    if scene.parts is not None:
        parts = world_parts(scene)
        # Most parts are absent.
        near = masked_vmap(_touches, parts.valid, None, (points, radius), parts, block=16)
        return any_part(scene, near.T)
    n = scene.capacity
    radii = jnp.broadcast_to(radius[:, None], (radius.shape[0], n))
    size, exponents = grown(
        jnp.broadcast_to(scene.size[None], (*radii.shape, 3)),
        jnp.broadcast_to(scene.exponents[None], (*radii.shape, 2)),
        radii,
    )
    near = gauge(size[None], exponents[None], to_object_frame(scene, points)) < 1.0
    return jnp.any(near, axis=1) & scene.valid[None]


def _touches(_, arm: tuple[Float[Array, "w s 3"], Float[Array, " s"]], part: Superquadrics) -> Bool[Array, " w"]:
    """Whether spheres, given by centres in each of w configurations and radii, touch a part, without its axis [m]."""
    points, radius = arm
    size, exponents = (jnp.broadcast_to(a[None], (*radius.shape, a.shape[-1])) for a in (part.size, part.exponents))
    size, exponents = grown(size, exponents, radius)
    local = transform(inverse(make(part.rotation, part.position)), points)
    return jnp.any(gauge(size[None], exponents[None], local) < 1.0, axis=1)
