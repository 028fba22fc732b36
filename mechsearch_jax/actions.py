"""Actions: pushes and pick-and-places, which of them are possible, and how they are sampled (paper appendix B.5)."""

from __future__ import annotations

import enum

import flax.struct
import jax
import jax.numpy as jnp


class ActionKind(enum.IntEnum):
    NONE = 0
    PUSH = 1
    PICK_AND_PLACE = 2


@flax.struct.dataclass
class Action:
    """One action of the robot; every field may carry leading batch axes.

    Attributes:
      kind: an `ActionKind`, int32.
      object: index of the object that is pushed or picked, int32.
      T_world_gripper: gripper pose where the push starts, or where the object is grasped, shape (..., 4, 4).
      displacement: translation of the gripper while it pushes, in the world [m], shape (..., 3); zero for a pick-and-place.
      T_world_place: gripper pose where the object is released, shape (..., 4, 4); for a push, the pose where it ends.
      q7: angle of joint 7 during the whole motion [rad].
      opening: distance between the fingers while the gripper approaches [m]; 0 is closed.
    """

    kind: jax.Array
    object: jax.Array
    T_world_gripper: jax.Array
    displacement: jax.Array
    T_world_place: jax.Array
    q7: jax.Array
    opening: jax.Array


def no_action() -> Action:
    """The action that does nothing."""
    return Action(
        kind=jnp.int32(ActionKind.NONE),
        object=jnp.int32(0),
        T_world_gripper=jnp.eye(4),
        displacement=jnp.zeros(3),
        T_world_place=jnp.eye(4),
        q7=jnp.float32(0.0),
        opening=jnp.float32(0.0),
    )
