"""Where the target that was taken out is put down: ways of the hand down to the place, and back from it.

The place is a point, on which the target is to stand upright, or a configuration of the arm, in which the hand opens.
For a point the hand keeps its tilt; how it is turned about the vertical is tried in turn, the least turn first.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from mechsearch_jax.robot.arm_config import PANDA, Arm
from mechsearch_jax.robot.free_motion import WAYPOINTS
from mechsearch_jax.robot.kinematics import gripper_pose, line_poses, path_kinematics
from mechsearch_jax.runtime.errors import InputError

# From how far above the target is brought down, how far above its place it is let go, and how far the hand backs away
# along its own axis before it leaves [m].
ABOVE, RELEASE, BACK = 0.05, 0.003, 0.1
# Turns of the hand about the vertical that are tried [rad], and angles of joint 7.
TURNS = np.radians(sorted(range(-180, 180, 15), key=lambda degrees: (abs(degrees), degrees)))
WRISTS = 9
# Ways that are tried until one is free.
MOST = 12


@dataclasses.dataclass(frozen=True, eq=False)
class PlaceWay:
    """A way to the place and back.

    Attributes:
      down: joint angles from above the place to where the hand opens [rad], shape (n, 7); one row if that is all.
      back: from there to where the hand is clear of what it put down, shape (m, 7).
      T_world_placed: pose of the target where it is put down; None if only the arm's place is given.
    """

    down: Float[np.ndarray, "n 7"]
    back: Float[np.ndarray, "m 7"]
    T_world_placed: Float[np.ndarray, "4 4"] | None


def place_ways(
    place: tuple[float, ...],
    T_world_gripper: Float[np.ndarray, "4 4"],
    T_world_target: Float[np.ndarray, "4 4"] | None,
    half_height: float,
    arm: Arm = PANDA,
) -> list[PlaceWay]:
    """Ways to a place and back that the arm reaches, the best first; whether they are free is not tested.

    Args:
      place: see `ArmConfig.place`.
      T_world_gripper: pose of the gripper where it grasped the target.
      T_world_target: pose of the target then; None if it is not known.
      half_height: of the target [m].
      arm: whose limits hold.

    Raises:
      InputError: there is none.
    """
    if len(place) == 7:
        return [_of_joints(np.array(place, float), arm)]
    if T_world_target is None:
        raise InputError("place: the target was not seen, and how it lies in the hand is not known")
    x, y, z = place
    turns = np.tile(np.eye(4), (len(TURNS), 1, 1))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(TURNS)
    turns[:, 1, 0], turns[:, 0, 1] = np.sin(TURNS), -np.sin(TURNS)
    placed = turns @ np.asarray(T_world_target, float)
    placed[:, :3, 3] = (x, y, z + half_height + RELEASE)
    grippers = placed @ np.linalg.inv(T_world_target) @ T_world_gripper
    # Joint 7 rests on the way down and back; the way to it is planned.
    wrists = np.linspace(arm.lower[6], arm.upper[6], WRISTS + 2)[1:-1].astype(np.float32)
    paths = np.stack([_path(T) for T in grippers])
    q, reached = path_kinematics(np.repeat(paths, WRISTS, axis=0), np.tile(wrists, len(TURNS)), arm)
    q, reached = np.asarray(q, float), np.asarray(reached)
    reachable = np.flatnonzero(reached)
    if not len(reachable):
        raise InputError(f"place: the arm does not reach {list(place)} with the target as it is grasped")
    return [PlaceWay(q[i, :WAYPOINTS], q[i, WAYPOINTS - 1 :], placed[i // WRISTS]) for i in reachable[:MOST].tolist()]


def _path(T: np.ndarray) -> np.ndarray:
    """Gripper poses straight down to a pose, and back from it along the gripper's axis."""
    down = np.tile(T, (WAYPOINTS, 1, 1))
    down[:, 2, 3] += ABOVE * np.linspace(1.0, 0.0, WAYPOINTS)
    back = np.asarray(line_poses(T, np.array(BACK, np.float32), WAYPOINTS), float)[::-1]
    return np.concatenate([down, back[1:]]).astype(np.float32)


def _of_joints(q: np.ndarray, arm: Arm) -> PlaceWay:
    """The way back from joint angles, straight along the gripper's axis, if the arm can go it from there."""
    back = np.asarray(line_poses(gripper_pose(q), np.array(BACK, np.float32), WAYPOINTS))[::-1]
    angles, reached = path_kinematics(back, np.float32(q[6]), arm)
    angles = np.asarray(angles, float)
    if not bool(reached) or np.abs(angles[0] - q).max() > 1e-2:
        return PlaceWay(q[None], q[None], None)
    angles[0] = q
    return PlaceWay(q[None], angles, None)
