"""How the gripper is turned in a grasp or a push."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

# The angle of joint 7 that the angles of wrists are relative to [rad].
WRIST_ORIGIN = math.pi / 4


def gripper_rotation(yaw: Float[Array, "*batch"], tilt: Float[Array, "*batch"]) -> Float[Array, "*batch 3 3"]:
    """`R_world_gripper` that approaches along `yaw` from +x, points down by `tilt` and closes horizontally [rad].

    The gripper's y points to the right of the approach, as it does in the home configuration.
    """
    c, s, cosine, sine, zero = jnp.cos(yaw), jnp.sin(yaw), jnp.cos(tilt), jnp.sin(tilt), jnp.zeros_like(yaw)
    x = jnp.stack([c * sine, s * sine, cosine], axis=-1)
    y = jnp.stack([s, -c, zero], axis=-1)
    z = jnp.stack([c * cosine, s * cosine, -sine], axis=-1)
    return jnp.stack([x, y, z], axis=-1)
