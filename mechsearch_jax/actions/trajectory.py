"""The joint trajectory of an action, for a robot's controller."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from mechsearch_jax.actions.kind import Kind
from mechsearch_jax.actions.registry import kind_of
from mechsearch_jax.actions.types import Action
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.robot.motion import MotionConfig, Reference
from mechsearch_jax.runtime.compiled import kept
from mechsearch_jax.runtime.errors import InputError


class JointTrajectory(flax.struct.PyTreeNode):
    """The motion of the arm and the fingers, one row for each time step.

    It begins and ends outside the shelf. The caller plans the motion between there and the home configuration, in front
    of the shelf. A width of 0 with an object between the fingers means grip.

    Attributes:
      time: time since the motion began [s], shape (T,).
      position: joint angles [rad], shape (T, 7).
      velocity: joint velocities [rad/s], shape (T, 7).
      gripper: distance between the fingers [m], shape (T,).
    """

    time: jax.Array
    position: jax.Array
    velocity: jax.Array
    gripper: jax.Array


@kept(static_argnames=("kind", "config"), on_host=True)
def reference_motion(kind: Kind, action: Action, config: MotionConfig) -> tuple[Reference, Bool[Array, ""]] | None:
    """`Kind.reference`, compiled: the motion of an action and whether the arm reaches all of it, or None.

    Computed on the host even if there is a GPU, which is slower at the many small steps of a single motion.

    Args:
      kind: kind of the action; static.
      action: a single action.
      config: lengths and durations; static.
    """
    return kind.reference(action, config)


def joint_trajectory(problem, action: Action, config: MotionConfig | None = None) -> JointTrajectory:
    """The joint trajectory of a decision's action: a push, a pick-and-place or a retrieval.

    Not for use inside `jit`: its length depends on the action. For the action that does nothing it is a single row, the
    home configuration.

    Args:
      problem: the problem, with the gripper.
      action: a single action.
      config: lengths and durations; default: the problem's gripper and default durations.

    Raises:
      InputError: the kind of action is unknown, or the arm does not reach all of the motion, or not in time.
    """
    config = config or MotionConfig(gripper=problem.gripper)
    kind = kind_of(int(action.kind))
    motion = reference_motion(kind, action, config)
    if motion is None:
        still = jnp.float32(HOME)[None]
        return JointTrajectory(jnp.zeros(1), still, jnp.zeros_like(still), jnp.zeros(1))
    reference, reachable = motion
    if not reachable:
        raise InputError(f"{kind.name}: the arm does not reach all of this motion; decide anew")
    steps = int(reference.length)
    return JointTrajectory(
        time=(jnp.arange(steps) + 1.0) * config.timestep,
        position=reference.q[:steps],
        velocity=reference.velocity[:steps],
        gripper=2.0 * jnp.maximum(reference.fingers[:steps], 0.0),
    )
