"""Trajectories as files: CSV, and the JSON of ROS 2 messages."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mechsearch_jax.robot.robot_trajectory import RobotTrajectory
from mechsearch_jax.robot.ros_messages import ros_messages
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing


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


def save_ros(
    trajectory: RobotTrajectory, path: PathLike, overwrite: bool = False, joint_names: Sequence[str] = ()
) -> None:
    """Write `ros_messages` as JSON.

    Raises:
      InputError: as `save_csv` and `ros_messages`.
    """
    _write(json.dumps(ros_messages(trajectory, joint_names), allow_nan=False) + "\n", path, overwrite)


def _write(text: str, path: PathLike, overwrite: bool) -> None:
    if not overwrite and Path(path).exists():
        raise InputError(f"{path}: is there already; name another file, or allow to overwrite it")
    with replacing(path) as file:
        file.write(text.encode())
