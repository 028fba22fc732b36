"""Where a target alone on the shelf can be grasped: against what g takes as feasible, and beside walls."""

import dataclasses
import json
import math

import jax
import numpy as np
import pytest

from mechsearch_jax.benchmarks.lab.reach.reach import bands, reach, save_reach
from mechsearch_jax.benchmarks.lab.tables import reach_table
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.grasping.graspability import feasible_grasps, grasp_tables
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.workspace.target import Target

GRASPS = GraspConfig(
    yaw_step=math.radians(22.5), tilts=(math.radians(20),), wrists=(0.0,), points=256, target_points=64
)
CELL = Workcell(target=Target(grid=(3, 9)))


@pytest.fixture(scope="module")
def rows():
    return reach(CELL, GRASPS)


def test_the_feasible_grasps_are_those_of_g(rows):
    shelf, gripper, target = CELL.shelf, CELL.gripper, CELL.target
    poses = target.candidate_poses(shelf)
    tables = grasp_tables(gripper, target, GRASPS)
    feasible = jax.jit(
        lambda tables, poses: feasible_grasps(tables, shelf, gripper, GRASPS, upright_pose(poses, target.height(shelf)))
    )(tables, poses)
    assert [row.feasible for row in rows] == np.asarray(feasible).sum(axis=1).tolist()
    np.testing.assert_allclose([[row.x, row.y, row.yaw] for row in rows], poses, atol=1e-4)
    assert all(row.hand >= row.reached >= row.feasible >= row.approaches for row in rows)
    assert 0 < sum(row.feasible > 0 for row in rows) < len(rows)


def test_a_wall_takes_approaches_that_a_wider_shelf_leaves(rows):
    wider = dataclasses.replace(CELL.shelf, right=-1.0)
    # The same poses, from a grid that begins as far from the wall as before.
    free = reach(
        dataclasses.replace(CELL, shelf=wider, target=Target(grid=(3, 9 + 15), inset=CELL.target.inset)), GRASPS
    )
    beside = [row for row in rows if row.y == min(row.y for row in rows)]
    middle = [row for row in rows if abs(row.y - 0.1) < 0.05]
    assert max(row.hand for row in beside) < min(row.hand for row in middle)
    at = [row for row in free if abs(row.y - beside[0].y) < 0.03]
    assert min(row.hand for row in at) > max(row.hand for row in beside)


def test_bands_are_means_and_files_hold_every_row(rows, tmp_path):
    lines = bands(rows, width=0.2)
    assert sum(line["poses"] for line in lines) == len(rows)
    assert [line["y"] for line in lines] == sorted(line["y"] for line in lines)
    first = [row for row in rows if row.y <= lines[0]["y"][1]]
    assert lines[0]["feasible"] == pytest.approx(np.mean([row.feasible for row in first]), abs=1e-3)
    assert lines[0]["graspable"] == pytest.approx(np.mean([row.feasible > 0 for row in first]), abs=1e-4)
    assert reach_table(rows).renderables[0].row_count == len(bands(rows))
    save_reach(rows, GRASPS, tmp_path / "reach.json")
    stored = json.loads((tmp_path / "reach.json").read_text())
    assert len(stored["rows"]) == len(rows)
    assert stored["bands"] == bands(rows)
    assert stored["grasps"]["yaw_step"] == pytest.approx(math.radians(22.5))
