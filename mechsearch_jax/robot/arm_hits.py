"""Collisions of links 2 to 5 with objects. Links 6 and 7 and the hand are rigid in the gripper's frame, and are tested
as point clouds."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.bodies import any_part, world_parts
from mechsearch_jax.geometry.masked import masked_vmap, on_cpu
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
    arm, parts = (points, radius), world_parts(scene)
    if scene.parts is None and not on_cpu():
        return jax.vmap(_touches, (None, None, 0), out_axes=1)(None, arm, parts) & parts.valid[None]
    # Most parts are absent, or far away.
    reached = parts.valid & _in_boxes(points, radius, parts)
    return any_part(scene, masked_vmap(_touches, reached, None, arm, parts, block=16).T)


def _in_boxes(points: Float[Array, "w s 3"], radius: Float[Array, " s"], parts: Superquadrics) -> Bool[Array, " n"]:
    """Which parts, grown by any of the spheres, contain its centre in their boxes; none touches another part."""
    local = jnp.abs(to_object_frame(parts, points))
    return jnp.any(jnp.all(local <= parts.size[None, None] + radius[None, :, None, None], axis=-1), axis=(0, 1))


def _touches(_, arm: tuple[Float[Array, "w s 3"], Float[Array, " s"]], part: Superquadrics) -> Bool[Array, " w"]:
    """Whether spheres, given by centres in each of w configurations and radii, touch a part, without its axis [m]."""
    points, radius = arm
    size, exponents = (jnp.broadcast_to(a[None], (*radius.shape, a.shape[-1])) for a in (part.size, part.exponents))
    size, exponents = grown(size, exponents, radius)
    local = transform(inverse(make(part.rotation, part.position)), points)
    return jnp.any(gauge(size[None], exponents[None], local) < 1.0, axis=1)
