"""Where a target that stands alone on the shelf can be grasped, and what rules its grasps out elsewhere.

For whoever lays out a workcell: no search gets a target out that cannot be grasped on an empty shelf, and where few
approaches are left, single objects block them all.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.benchmarks.store.json_rows import save_rows
from mechsearch_jax.geometry.transforms import compose, upright_pose
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.grasping.graspability import GraspTables, grasp_tables
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.robot.entry import FEW_CROSSINGS, way_in
from mechsearch_jax.robot.gripper import Gripper, joints_hit_shelf
from mechsearch_jax.robot.kinematics import path_joints
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.workspace.shelf import Shelf, cloud_hits_shelf
from mechsearch_jax.workspace.target import Target

# Poses of the target that are tested together.
AT_ONCE = 32


@dataclasses.dataclass(frozen=True)
class ReachRow:
    """The grasps of a target at one candidate pose of an empty shelf.

    Attributes:
      x, y, yaw: the pose [m, rad].
      hand: number of grasps at which neither the swept gripper nor the target on its way out touches the shelf.
      reached: how many of these the arm can follow on the whole way in.
      feasible: how many of these leave links 2 to 5 clear of the shelf, too: those that g counts.
      approaches: number of different directions of approach, seen from above, among the feasible ones.
    """

    x: float
    y: float
    yaw: float
    hand: int
    reached: int
    feasible: int
    approaches: int


def reach(cell: Workcell, config: GraspConfig) -> list[ReachRow]:
    """The rows of all candidate poses of a workcell's target.

    Args:
      cell: the workcell.
      config: the grasps.

    Raises:
      InputError: the target is too wide for the gripper.
    """
    tables = grasp_tables(cell.gripper, cell.target, config)
    poses = cell.target.candidate_poses(cell.shelf)
    chunks = np.array_split(np.arange(len(poses)), range(AT_ONCE, len(poses), AT_ONCE))
    tests = []
    for chunk in chunks:
        # All chunks have one size, so that nothing is compiled twice.
        rows = poses[np.resize(chunk, AT_ONCE)]
        tested = _tests(tables, cell.shelf, jnp.asarray(rows), cell.gripper, cell.target, config)
        tests.append([np.asarray(test)[: len(chunk)] for test in tested])
    hand, follows, clear, yaw = (np.concatenate(parts) for parts in zip(*tests, strict=True))
    reached = hand & follows
    feasible = reached & clear
    return [
        ReachRow(
            *(round(float(place), 4) for place in poses[i]),
            hand=int(hand[i].sum()),
            reached=int(reached[i].sum()),
            feasible=int(feasible[i].sum()),
            approaches=len(np.unique(np.round(yaw[i][feasible[i]], 3))),
        )
        for i in range(len(poses))
    ]


@functools.partial(jax.jit, static_argnames=("gripper", "target", "config"))
def _tests(
    tables: GraspTables,
    shelf: Shelf,
    poses: Float[Array, "n 3"],
    gripper: Gripper,
    target: Target,
    config: GraspConfig,
) -> tuple[Bool[Array, "n g"], Bool[Array, "n g"], Bool[Array, "n g"], Float[Array, "n g"]]:
    """The tests of `graspability.feasible_grasps` one by one, without any object.

    Returns:
      Whether hand and target clear the shelf, whether the arm follows the way in, whether its links clear the shelf;
      and the direction of approach, seen from above [rad].
    """

    def tested(T_world_gripper, q7, cloud):
        path = way_in(T_world_gripper, gripper.nearest_outside, gripper, FEW_CROSSINGS, config.waypoints)
        q, follows = path_joints(path, q7)
        yaw = jnp.arctan2(T_world_gripper[1, 2], T_world_gripper[0, 2])
        ahead = jnp.abs(yaw) <= config.max_yaw + 1e-4
        clear = ~jnp.any(joints_hit_shelf(q, shelf))
        return ~cloud_hits_shelf(shelf, T_world_gripper, cloud) & ahead, follows, clear, yaw

    T_world_target = upright_pose(poses, target.height(shelf))
    T = compose(T_world_target[:, None], tables.T_target_gripper[None])
    return jax.vmap(jax.vmap(tested), (0, None, None))(T, tables.q7, tables.swept.points)


def bands(rows: Sequence[ReachRow], width: float = 0.05) -> list[dict[str, Any]]:
    """Means over bands across the shelf, from right to left: y from the outermost position in steps of `width` [m]."""
    y = np.array([row.y for row in rows])
    band = np.floor((y - y.min()) / width + 1e-6).astype(int)
    lines = []
    for index in np.unique(band):
        inside = [row for row, at in zip(rows, band, strict=True) if at == index]
        line: dict[str, Any] = {"y": [min(row.y for row in inside), max(row.y for row in inside)], "poses": len(inside)}
        line["graspable"] = round(float(np.mean([row.feasible > 0 for row in inside])), 4)
        for name in ("hand", "reached", "feasible", "approaches"):
            line[name] = round(float(np.mean([getattr(row, name) for row in inside])), 3)
        lines.append(line)
    return lines


def save_reach(rows: Sequence[ReachRow], config: GraspConfig, path: PathLike) -> None:
    """Write rows and their means as JSON.

    Raises:
      InputError: the file cannot be written.
    """
    about = {"code": present_code(), "versions": versions(), "grasps": dataclasses.asdict(config), "bands": bands(rows)}
    save_rows(about, rows, path)
