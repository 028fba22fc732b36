"""The joint trajectory of an action, for a robot's controller."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions.kind import Kind
from mechsearch_jax.actions.registry import kind_of
from mechsearch_jax.actions.types import Action
from mechsearch_jax.geometry.bodies import grasped_shape
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.observation import Observation
from mechsearch_jax.robot.acting import Rows, acting, joined, opening_to
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.hand import (
    Grip,
    HandConfig,
    HandEvent,
    checked_width,
    grip_of,
    grip_of_any_yaw,
    grip_of_anything,
    longest_way,
)
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.robot.motion import MotionConfig, Reference, motion_with
from mechsearch_jax.robot.pads import grip_between
from mechsearch_jax.robot.robot_trajectory import derivatives
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.own_settings import in_own_settings
from mechsearch_jax.runtime.pytree import PyTreeNode, static
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target


class Setting(Protocol):
    """What the motion of an action needs of a problem; `Problem` fulfils it."""

    @property
    def shelf(self) -> Shelf: ...
    @property
    def gripper(self) -> Gripper: ...
    @property
    def target(self) -> Target: ...


class JointTrajectory(PyTreeNode):
    """The motion of the arm and the fingers, one row for each time step.

    It begins and ends outside the shelf. The caller plans the motion between there and the home configuration, in front
    of the shelf.

    Attributes:
      time: time since the motion began [s], shape (T,).
      position: joint angles [rad], shape (T, 7).
      velocity: joint velocities [rad/s], shape (T, 7).
      gripper: distance between the fingers [m], shape (T,), as a hand that executes the events has it.
      events: what the hand does, in order; the arm stands still meanwhile. Static.
    """

    time: jax.Array
    position: jax.Array
    velocity: jax.Array
    gripper: jax.Array
    events: tuple[HandEvent, ...] = static(default=())


class Grasped(NamedTuple):
    """What an action grasps.

    Attributes:
      T_world_object: its pose before the action.
      size: half-extents [m].
      exponents: (e1, e2).
      seen: False for a target that is not visible, which is assumed between the fingers, with arbitrary yaw.
    """

    T_world_object: Float[np.ndarray, "4 4"]
    size: tuple[float, float, float]
    exponents: tuple[float, float]
    seen: bool


def grasped(problem: Setting, observation: Observation, action: Action) -> Grasped:
    """The object, or the target, that an action grasps; an object's index beyond the slots stands for the target."""
    kind, scene, i = kind_of(int(action.kind)), observation.objects, int(action.object)
    if kind.holds_object and i < scene.capacity:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.asarray(scene.rotation[i]), np.asarray(scene.position[i])
        x, y, z = np.asarray(scene.size[i], float).tolist()
        e1, e2 = np.asarray(scene.exponents[i], float).tolist()
        return Grasped(T, (x, y, z), (e1, e2), True)
    T, seen = target_pose(problem, observation), bool(observation.target_visible)
    if not seen:
        T[:3, 3] = np.asarray(action.T_world_gripper, float)[:3, 3]
    return Grasped(T, problem.target.half_size, problem.target.exponents, seen)


def target_pose(problem: Setting, observation: Observation) -> Float[np.ndarray, "4 4"]:
    """`T_world_target` as observed; arbitrary if the target is not visible."""
    pose = jnp.asarray(observation.target_pose, jnp.float32)
    return np.array(upright_pose(pose, problem.target.height(problem.shelf)), float)


def grip_for(problem: Setting, observation: Observation | None, action: Action) -> Grip:
    """How wide what an action grasps is between the fingers; of anything without an observation."""
    opening = float(action.opening)
    kind = kind_of(int(action.kind))
    if observation is None or not (kind.holds_object or kind.takes_target):
        return grip_of_anything(opening)
    observation = observation.with_boxes()
    what = grasped(problem, observation, action)
    closing = np.asarray(action.T_world_gripper, float)[:3, 1]
    objects, i = observation.objects, int(action.object)
    if kind.holds_object and i < objects.capacity and objects.parts is not None:
        shape = grasped_shape(objects, jnp.int32(i), jnp.asarray(action.T_world_gripper)[:3, 3])
        rotation, size, exponents = (np.asarray(a) for a in (shape.rotation, shape.size, shape.exponents))
        return grip_of(closing, rotation, size, exponents, opening)
    compound = problem.target.compound
    if what.seen and compound is not None and not (kind.holds_object and i < objects.capacity):
        T_target_gripper = np.linalg.inv(what.T_world_object) @ np.asarray(action.T_world_gripper, float)
        return grip_of_any_yaw((*grip_between(compound, T_target_gripper, opening), 0.0), opening)
    x, y, _ = what.size
    any_yaw = grip_of_any_yaw((x, y, 0.0), opening)
    if not what.seen:
        return any_yaw
    seen = grip_of(closing, what.T_world_object[:3, :3], np.array(what.size), np.array(what.exponents), opening)
    if (kind.holds_object and i < objects.capacity) or problem.target.round:
        return seen
    # From one side, a target's yaw and one a quarter of a turn from it may fit equally well.
    return Grip(min(seen.low, any_yaw.low), max(seen.high, any_yaw.high))


@cached_jit(static_argnames=("kind", "config"), on_host=True)
def reference_motion(kind: Kind, action: Action, config: MotionConfig) -> tuple[Reference, Bool[Array, ""]] | None:
    """`Kind.reference`, compiled: the motion of an action and whether the arm reaches all of it, or None.

    Computed on the host even if there is a GPU, which is slower at the many small steps of a single motion.

    Args:
      kind: kind of the action; static.
      action: a single action.
      config: lengths and durations; static.
    """
    return kind.reference(action, config)


@in_own_settings
def joint_trajectory(
    problem: Setting,
    action: Action,
    config: MotionConfig | None = None,
    *,
    observation: Observation | None = None,
    width: Any = None,
    hand: HandConfig | None = None,
) -> JointTrajectory:
    """The joint trajectory of a decision's action: a push, a pick-and-place or a retrieval.

    The arm waits while the hand moves, at first for its opening from `width` to what the action begins with.

    Not for use inside `jit`: its length depends on the action. For the action that does nothing it is a single row, the
    home configuration.

    Args:
      problem: the problem, with the gripper.
      action: a single action.
      config: lengths and durations; default: the problem's gripper and default durations.
      observation: that the action was decided on, which says how wide what it grasps is; without it, the grasp takes
        whatever is between the fingers.
      width: present distance between the fingers [m]; if left out, they are taken to be open, and there is time for
        the longest way that they may have.
      hand: how the real hand is used; the default if None.

    Raises:
      InputError: the kind of action is unknown, the width is impossible, or the arm does not reach all of the motion,
        or not in time.
    """
    config, hand = motion_with(problem.gripper, config), hand or HandConfig()
    widest = problem.gripper.max_opening
    present = widest if width is None else checked_width(width, widest)
    kind = kind_of(int(action.kind))
    motion = reference_motion(kind, action, config)
    if motion is None:
        still = jnp.float32(HOME)[None]
        return JointTrajectory(jnp.zeros(1), still, jnp.zeros_like(still), jnp.full(1, present))
    reference, reachable = motion
    if not reachable:
        raise InputError(f"{kind.name}: the arm does not reach all of this motion; decide anew")
    reference = jax.device_get(reference)
    start = np.asarray(reference.start, float)
    opened = 2.0 * max(float(start[7]), 0.0)
    farthest = longest_way(opened, widest) if width is None else 0.0
    first = opening_to(start[:7], present, opened, hand, config.timestep, farthest)
    parts: list[Rows] = [first, acting(reference, grip_for(problem, observation, action), config, hand)]
    rows = joined(parts, config.timestep)
    velocity, _ = derivatives(np.concatenate([start[None, :7], rows.position]), config.timestep, rows.rests)
    return JointTrajectory(
        time=(jnp.arange(len(rows.width)) + 1.0) * config.timestep,
        position=jnp.asarray(rows.position, jnp.float32),
        velocity=jnp.asarray(velocity[1:], jnp.float32),
        gripper=jnp.asarray(rows.width, jnp.float32),
        events=rows.events,
    )
