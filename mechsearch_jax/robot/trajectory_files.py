"""Trajectories as files: CSV, and the JSON of ROS messages."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mechsearch_jax.robot.robot_trajectory import RobotTrajectory
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing

JOINT_NAMES = tuple(f"panda_joint{i}" for i in range(1, 8))
GRIPPER_NAME = "panda_gripper"


def csv_header() -> list[str]:
    """Names and units of the columns of a CSV file."""
    positions, velocities = [f"q{i} [rad]" for i in range(1, 8)], [f"v{i} [rad/s]" for i in range(1, 8)]
    return ["time [s]", *positions, *velocities, "width [m]", "force [N]"]


def save_csv(trajectory: RobotTrajectory, path: PathLike, overwrite: bool = False) -> None:
    """Write a trajectory as CSV: one line with names and units, then one for each row.

    Raises:
      InputError: the file exists and `overwrite` is False, or it cannot be written.
    """
    columns = (trajectory.time[:, None], trajectory.position, trajectory.velocity)
    table = np.concatenate([*columns, trajectory.width[:, None], trajectory.force[:, None]], axis=1)
    text = io.StringIO()
    text.write(",".join(csv_header()) + "\n")
    np.savetxt(text, table, fmt="%.9g", delimiter=",")
    _write(text.getvalue(), path, overwrite)


def ros_messages(
    trajectory: RobotTrajectory,
    joint_names: Sequence[str] = JOINT_NAMES,
    gripper_name: str = GRIPPER_NAME,
) -> dict[str, Any]:
    """A trajectory as JSON values in the layout of ROS messages.

    `arm` is a `trajectory_msgs/JointTrajectory`: `joint_names` and `points` with `positions` [rad], `velocities`
    [rad/s], `accelerations` [rad/s2] and `time_from_start` (`secs`, `nsecs`). `gripper` has the same layout with one
    joint, whose position is the width between the fingers [m] and whose effort is the grip force [N]; only rows where
    either changes, and the ends. `stop` has the bounds at which a controller should stop.

    Raises:
      InputError: `joint_names` are not seven different names.
    """
    names = [str(name) for name in joint_names]
    if len(set(names)) != len(JOINT_NAMES) or len(names) != len(JOINT_NAMES):
        raise InputError(f"joint_names: {names} must be {len(JOINT_NAMES)} different names")
    times = [_time(t) for t in trajectory.time]
    points = [
        {"positions": q, "velocities": v, "accelerations": a, "effort": [], "time_from_start": t}
        for q, v, a, t in zip(
            trajectory.position.tolist(),
            trajectory.velocity.tolist(),
            trajectory.acceleration.tolist(),
            times,
            strict=True,
        )
    ]
    bounds = trajectory.bounds
    return {
        "arm": {"header": _header(), "joint_names": names, "points": points},
        "gripper": {
            "header": _header(),
            "joint_names": [gripper_name],
            "points": [
                {
                    "positions": [float(trajectory.width[i])],
                    "velocities": [],
                    "accelerations": [],
                    "effort": [float(trajectory.force[i])],
                    "time_from_start": times[i],
                }
                for i in _changes(trajectory)
            ],
        },
        "stop": {"tracking": bounds.tracking, "effort": list(bounds.effort), "force": bounds.force},
    }


def save_ros(trajectory: RobotTrajectory, path: PathLike, overwrite: bool = False, **names: Any) -> None:
    """Write `ros_messages` as JSON; `names` are its `joint_names` and `gripper_name`.

    Raises:
      InputError: as `save_csv` and `ros_messages`.
    """
    _write(json.dumps(ros_messages(trajectory, **names), allow_nan=False) + "\n", path, overwrite)


def _time(seconds: float) -> dict[str, int]:
    nanoseconds = round(float(seconds) * 1e9)
    return {"secs": nanoseconds // 10**9, "nsecs": nanoseconds % 10**9}


def _header() -> dict[str, Any]:
    return {"seq": 0, "stamp": {"secs": 0, "nsecs": 0}, "frame_id": ""}


def _changes(trajectory: RobotTrajectory) -> list[int]:
    """The first and the last row, and those next to a change of the fingers' width or force."""
    grip = np.stack([trajectory.width, trajectory.force], axis=1)
    differs = np.any(np.diff(grip, axis=0) != 0.0, axis=1)
    kept = np.zeros(len(grip), bool)
    kept[[0, -1]] = True
    kept[1:] |= differs
    kept[:-1] |= differs
    return np.flatnonzero(kept).tolist()


def _write(text: str, path: PathLike, overwrite: bool) -> None:
    if not overwrite and Path(path).exists():
        raise InputError(f"{path}: is there already; name another file, or allow to overwrite it")
    with replacing(path) as file:
        file.write(text.encode())
