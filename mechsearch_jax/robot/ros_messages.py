"""Trajectories as ROS 2 messages: dictionaries with the fields of the message types, for a node, a bag or JSON.

| what | type |
|---|---|
| the arm | `trajectory_msgs/msg/JointTrajectory`, also as the goal of `control_msgs/action/FollowJointTrajectory` |
| the hand | goals of `franka_msgs/action/Move` and `Grasp`, or of `control_msgs/action/GripperCommand` |

ROS itself is not needed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from mechsearch_jax.robot.hand import HandEvent, HandGrasp
from mechsearch_jax.robot.robot_trajectory import RobotTrajectory
from mechsearch_jax.runtime.errors import InputError

# Type of the action of each kind of event.
ACTION_TYPES = {"move": "franka_msgs/action/Move", "grasp": "franka_msgs/action/Grasp"}
# Position of a `GripperCommand` for each metre between the fingers: Franka's server takes that of one finger.
FINGER_SHARE = 0.5
# Effort of a `GripperCommand` that grasps nothing [N]: Franka's server closes the fingers by a grasp with it.
MOVE_EFFORT = 20.0


@dataclasses.dataclass(frozen=True)
class Leg:
    """What arm and hand do at the same time; the next leg begins when both have ended.

    Attributes:
      first, last: rows of the trajectory that the arm moves along, both included; equal if it stands still.
      event: what the hand does; None if nothing.
    """

    first: int
    last: int
    event: HandEvent | None


def legs(trajectory: RobotTrajectory) -> list[Leg]:
    """A trajectory in pieces from rest to rest.

    Who executes them in turn waits for the real hand, however long it takes, and learns at once if a grasp failed.
    """
    timestep = float(trajectory.time[1]) if len(trajectory.time) > 1 else 1.0
    pieces: list[Leg] = []
    row, last = 0, len(trajectory.time) - 1
    for event in trajectory.events:
        begins = round(event.start / timestep)
        if begins > row:
            pieces.append(Leg(row, begins, None))
        # An event for which the arm does not wait ends with the part that it begins with, where the arm comes to rest.
        end = begins if event.waits else _part_end(trajectory, begins)
        pieces.append(Leg(begins, end, event))
        row = round((event.start + event.duration) / timestep) if event.waits else end
    if last > row:
        pieces.append(Leg(row, last, None))
    return pieces


def _part_end(trajectory: RobotTrajectory, row: int) -> int:
    """The last row of the part that a row belongs to."""
    others = np.flatnonzero(trajectory.part[row:] != trajectory.part[row])
    return row + int(others[0]) - 1 if len(others) else len(trajectory.time) - 1


def joint_trajectory_message(
    trajectory: RobotTrajectory,
    joint_names: Sequence[str] = (),
    first: int = 0,
    last: int | None = None,
    *,
    backward: bool = False,
) -> dict[str, Any]:
    """Rows of a trajectory as a `trajectory_msgs/msg/JointTrajectory`, with times from the first of them.

    Sequences of numbers are arrays of double precision, as `rosbags` takes them; `rclpy` takes their `tolist()`.

    Args:
      trajectory: of the arm.
      joint_names: of the seven joints, from the base; the arm's own if left out.
      first, last: rows, both included, where the arm stands still; all of them by default.
      backward: whether it goes from `last` to `first`, along the same way.

    Raises:
      InputError: `joint_names` are not seven different names.
    """
    names = [str(name) for name in joint_names or trajectory.arm.joint_names]
    if len(set(names)) != 7 or len(names) != 7:
        raise InputError(f"joint_names: {names} must be 7 different names")
    rows = slice(first, None if last is None else last + 1)
    way = (trajectory.position[rows], trajectory.velocity[rows], trajectory.acceleration[rows])
    if backward:
        way = (way[0][::-1], -way[1][::-1], way[2][::-1])
    points = [
        {"positions": q, "velocities": v, "accelerations": a, "effort": np.zeros(0), "time_from_start": duration(t)}
        for q, v, a, t in zip(*way, trajectory.time[rows] - trajectory.time[first], strict=True)
    ]
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return {"header": header, "joint_names": names, "points": points}


def hand_goal(event: HandEvent) -> dict[str, Any]:
    """An event as the goal of `franka_msgs/action/Move` or `Grasp` [m, m/s, N]."""
    # Fields of messages refuse whole numbers and numbers of 32 bits.
    goal: dict[str, Any] = {"width": float(event.width), "speed": float(event.speed)}
    if isinstance(event, HandGrasp):
        goal |= {"epsilon": {"inner": float(event.inner), "outer": float(event.outer)}, "force": float(event.force)}
    return goal


def gripper_command_goal(
    event: HandEvent, share: float = FINGER_SHARE, *, effort: float = MOVE_EFFORT, widest: float | None = None
) -> dict[str, Any]:
    """An event as the goal of `control_msgs/action/GripperCommand`; speed and tolerances are the server's.

    Args:
      event: of the hand.
      share: position of the command for each metre between the fingers: 0.5 where it is that of one finger, as for
        Franka's `gripper_action`, 1 where it is the distance between them.
      effort: with which the fingers move where nothing is grasped [N]; Franka's server closes with it.
      widest: largest distance between the fingers that is commanded [m]; a server refuses more than what it measured
        when the hand was homed, which may be a little less than the gripper's opening.
    """
    force = event.force if isinstance(event, HandGrasp) else effort
    width = event.width if widest is None else min(event.width, widest)
    return {"command": {"position": float(share * width), "max_effort": float(force)}}


def ros_messages(trajectory: RobotTrajectory, joint_names: Sequence[str] = ()) -> dict[str, Any]:
    """A trajectory and what the hand does as JSON values: lists instead of arrays.

    `arm` is a `trajectory_msgs/msg/JointTrajectory` of all rows. `gripper` lists the hand's events: `type` of the
    action and its `goal`, the `start` and `duration` in the arm's time [s], whether the arm `waits`, and the same as
    the goal of a `gripper_command`. `legs` says which of the arm's points (`first`, `last`) and which event (`gripper`,
    or null) go together. `stop` has the bounds at which a controller should stop.

    Raises:
      InputError: `joint_names` are not seven different names.
    """
    bounds = trajectory.bounds
    number = {id(event): i for i, event in enumerate(trajectory.events)}
    arm = joint_trajectory_message(trajectory, joint_names)
    for point in arm["points"]:
        point |= {name: value.tolist() for name, value in point.items() if isinstance(value, np.ndarray)}
    return {
        "arm": arm,
        "gripper": [
            {
                "type": ACTION_TYPES[event.kind],
                "start": event.start,
                "duration": event.duration,
                "waits": event.waits,
                "goal": hand_goal(event),
                "gripper_command": gripper_command_goal(event),
            }
            for event in trajectory.events
        ],
        "legs": [
            {"first": leg.first, "last": leg.last, "gripper": None if leg.event is None else number[id(leg.event)]}
            for leg in legs(trajectory)
        ],
        "stop": {"tracking": bounds.tracking, "effort": list(bounds.effort), "force": bounds.force},
    }


def duration(seconds: float) -> dict[str, int]:
    """A `builtin_interfaces/msg/Duration`."""
    nanoseconds = round(float(seconds) * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
