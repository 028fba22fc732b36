"""g against a brute-force reference in float64, and the grasps that it is made of."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax import planner
from mechsearch_jax.geometry import superquadric, transforms
from mechsearch_jax.grasping import graspability
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.grasping.retrieval import best_grasp, target_grasps
from mechsearch_jax.robot import kinematics
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace import scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target


@pytest.fixture(scope="module")
def objects():
    return scenario.superquadrics(scenario.load_scenario(scenario.example_scenarios()["first-light"]).objects)


@pytest.fixture(scope="module")
def hits(problem, objects):
    everywhere = jnp.ones(problem.poses.shape[0], bool)
    return np.asarray(graspability.grasp_hits(problem.grasps, objects, everywhere))


def least_implicit(objects, k, points):
    local = (points - np.asarray(objects.position[k], np.float64)) @ np.asarray(objects.rotation[k], np.float64)
    x, y, z = np.abs(local / np.asarray(objects.size[k], np.float64)).T
    e1, e2 = np.asarray(objects.exponents[k], np.float64)
    return np.min((x ** (2 / e2) + y ** (2 / e2)) ** (e2 / e1) + z ** (2 / e1))


def test_h_is_that_of_a_brute_force_reference(problem, objects, hits):
    tables = problem.grasps
    pose, grasp, T = (np.asarray(a) for a in (tables.pair_pose, tables.pair_grasp, tables.T_world_target))
    T_target_gripper = np.asarray(tables.T_target_gripper)
    chosen = np.random.default_rng(0).choice(int(tables.pair_valid.sum()), 150, replace=False)
    for pair in chosen:
        cloud = np.asarray(tables.swept.points[grasp[pair]], np.float64).T
        placed = T[pose[pair]].astype(np.float64) @ T_target_gripper[grasp[pair]].astype(np.float64)
        world = cloud @ placed[:3, :3].T + placed[:3, 3]
        for k in np.flatnonzero(objects.valid):
            least = least_implicit(objects, k, world)
            if abs(least - 1) > 1e-3:
                assert hits[pair, k] == (least < 1)


def test_g_is_one_minus_the_least_number_of_hits(problem, objects, hits):
    rows = graspability.pairs(problem.grasps)
    g, pose = np.asarray(graspability.graspability(rows, jnp.asarray(hits))), np.asarray(rows.pose)
    for x in range(0, problem.poses.shape[0], 37):
        counts = hits[pose == x].sum(axis=1)
        assert g[x] == 1 - (counts.min() if len(counts) else graspability.INFEASIBLE)
    assert set(np.unique(g)) <= set(range(1 - graspability.INFEASIBLE, 2))


def test_moving_one_object_recomputes_its_column_alone(problem, objects, hits):
    everywhere = jnp.ones(problem.poses.shape[0], bool)
    moved = objects.replace(position=objects.position.at[2].add(jnp.float32([0.0, 0.05, 0.0])))
    which = jnp.arange(objects.capacity) == 2
    update = graspability.grasp_hits(problem.grasps, moved, everywhere, jnp.asarray(hits), which)
    whole = graspability.grasp_hits(problem.grasps, moved, everywhere)
    np.testing.assert_array_equal(update, whole)
    np.testing.assert_array_equal(np.delete(np.asarray(update), 2, axis=1), np.delete(hits, 2, axis=1))


def test_nothing_is_in_the_way_on_an_empty_shelf(problem):
    belief = planner.initial_belief(problem)
    g = np.asarray(planner.graspability_map(problem, belief, superquadric.empty(8)))
    feasible = np.isin(np.arange(len(g)), np.asarray(problem.grasps.pair_pose))
    assert np.all(g[feasible] == 1)
    assert np.all(g[~feasible] == 1 - graspability.INFEASIBLE)
    assert feasible.mean() > 0.9


def test_the_arm_reaches_every_feasible_grasp_and_its_pregrasp(problem):
    tables = problem.grasps
    chosen = np.random.default_rng(0).choice(int(tables.pair_valid.sum()), 200, replace=False)
    pose, grasp = np.asarray(tables.pair_pose)[chosen], np.asarray(tables.pair_grasp)[chosen]
    T = transforms.compose(tables.T_world_target[pose], tables.T_target_gripper[grasp])
    for distance in (0.0, problem.gripper.approach):
        back = transforms.back_off(T, jnp.full(len(chosen), distance))
        _, valid = kinematics.inverse_kinematics(back, tables.q7[grasp])
        assert np.all(np.any(np.asarray(valid), axis=-1))


def test_grasps_point_into_the_shelf_and_down(problem):
    approach = np.asarray(problem.grasps.T_target_gripper)[:, :3, 2]
    assert np.all(approach[:, 0] >= np.cos(problem.config.grasps.max_yaw) * np.hypot(*approach[:, :2].T) - 1e-5)
    tilt = np.degrees(np.arcsin(-approach[:, 2]))
    assert tilt.min() >= 19.9
    assert tilt.max() <= 30.1
    np.testing.assert_allclose(np.asarray(problem.grasps.T_target_gripper)[:, 2, 1], 0.0, atol=1e-6)


def test_a_wide_target_is_refused_with_what_would_do():
    with pytest.raises(InputError, match="use a thinner target"):
        graspability.grasp_tables(Gripper(), Target(half_size=(0.05, 0.05, 0.05)), GraspConfig())
    with pytest.raises(InputError, match="waypoints"):
        GraspConfig(waypoints=1)
    assert GraspConfig(max_yaw=1.571).max_yaw == 1.571
    for wrong in ({"max_yaw": 1.7}, {"max_yaw": np.nan}, {"yaw_step": 0.0}, {"tilts": ()}, {"turn": 0.8}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            GraspConfig(**wrong)


def test_directions_are_no_farther_apart_than_their_step():
    assert [GraspConfig(max_yaw=np.radians(45), yaw_step=np.radians(s)).yaws for s in (15, 22.5, 40, 90)] == [
        7,
        5,
        5,
        3,
    ]
    assert GraspConfig(max_yaw=0.0).yaws == 1
    # As many within 45 degrees as the sets of grasps of the paper's preset always had.
    dense = GraspConfig.dense()
    assert (dense.yaws, dataclasses.replace(dense, max_yaw=np.radians(45)).yaws) == (41, 25)


@pytest.mark.parametrize("half", [(0.0225, 0.0175), (0.024, 0.035), (0.033, 0.02), (0.026, 0.024)])
def test_a_box_is_also_grasped_turned_from_square_where_it_fits_in_the_hand(half):
    config = GraspConfig(tilts=(0.3,), wrists=(0.0,), points=256, turn=np.radians(20))
    tables = graspability.grasp_tables(Gripper(), Target("box", (*half, 0.05)), config)
    yaw = np.degrees(np.arctan2(*np.asarray(tables.T_target_gripper, float)[:, 1::-1, 2].T))
    grasps = {(round(y) % 360, bool(t)) for y, t in zip(yaw, np.asarray(tables.turned), strict=True)}
    corners = np.array([(x, y) for x in (-half[0], half[0]) for y in (-half[1], half[1])])
    expected = {(yaw, False) for yaw in (0, 90, 180, 270)}
    for angle in (*range(20, 380, 90), *range(70, 430, 90)):
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        along, across = corners @ [c, s], corners @ [-s, c]
        if np.ptp(across) <= Gripper().usable_opening and along.max() <= 0.033:
            expected.add((angle % 360, True))
    assert grasps == expected


def test_only_boxes_are_grasped_turned_and_only_where_that_is_wanted():
    turned = [
        np.asarray(graspability.grasp_tables(Gripper(), target, config).turned).any()
        for target in (Target(), Target("box"))
        for config in (
            GraspConfig(points=256, yaw_step=1.0),
            GraspConfig(points=256, yaw_step=1.0, turn=np.radians(20)),
        )
    ]
    assert turned == [False, False, False, True]


def test_a_box_at_a_wall_is_grasped_turned_and_one_in_the_middle_square():
    config = GraspConfig(tilts=(np.radians(25),), turn=np.radians(20), points=512, target_points=128)
    box = target_grasps(Shelf(), Gripper(), Target("box"), config)
    for pose, by in (((0.6, 0.05, -0.25), 0.0), ((0.6, -0.193, 0.7), 20.0)):
        grasp = best_grasp(box, superquadric.empty(8), jnp.float32(pose))
        assert bool(grasp.success)
        x, y, _ = np.asarray(grasp.action.T_world_gripper, float)[:3, 2]
        from_square = (np.degrees(np.arctan2(y, x) - pose[2]) + 45.0) % 90.0 - 45.0
        assert abs(from_square) == pytest.approx(by, abs=1e-3)


def test_what_the_target_sweeps_is_the_target_and_its_way():
    target, direction = Target(), np.array([-0.9, 0.0, 0.43588989])
    points = graspability.swept_target(target, direction, 0.3, 4000, 0.0)
    t = np.clip(points @ direction, 0, 0.3)
    radius = np.hypot(*(points - t[:, None] * direction)[:, :2].T)
    assert points.shape == (4000, 3)
    assert points[:, 0].min() < -0.26
    assert points[:, 0].max() <= 0.0201
    assert np.abs(points[:, 1]).max() <= 0.0201
    assert radius.min() < 0.021


def test_a_found_target_in_the_open_is_grasped_and_one_behind_a_wall_of_boxes_is_not(problem):
    pose = jnp.float32([0.6, 0.1, 0.0])
    free = best_grasp(problem.target_grasps, superquadric.empty(8), pose)
    assert bool(free.success)
    np.testing.assert_allclose(free.action.T_world_gripper[:2, 3], pose[:2], atol=1e-5)
    wall = superquadric.empty(8)
    for i, y in enumerate(np.linspace(-0.1, 0.3, 5)):
        wall = wall.replace(
            size=wall.size.at[i].set(jnp.float32([0.02, 0.06, 0.15])),
            exponents=wall.exponents.at[i].set(jnp.float32(shape_of("box").exponents)),
            position=wall.position.at[i].set(jnp.float32([0.5, y, problem.shelf.board + 0.15])),
            valid=wall.valid.at[i].set(True),
        )
    blocked = best_grasp(problem.target_grasps, wall, pose)
    assert not bool(blocked.success)
    assert int(blocked.hits) >= 1


def test_a_round_target_that_has_spun_has_the_grasps_that_it_had(problem):
    grasps, objects = problem.target_grasps, superquadric.empty(8)
    assert problem.target.round
    still = best_grasp(grasps, objects, jnp.array([0.6, 0.05, 0.0]))
    for yaw in (0.7, 1.6, -2.5):
        spun = best_grasp(grasps, objects, jnp.array([0.6, 0.05, yaw]))
        np.testing.assert_array_equal(spun.action.T_world_gripper, still.action.T_world_gripper)
        assert bool(spun.success)
    np.testing.assert_allclose(grasps.standing(jnp.array([0.6, 0.05, 1.0]))[:2, 3], [0.6, 0.05])
    box = target_grasps(problem.shelf, problem.gripper, Target("box"), GraspConfig())
    np.testing.assert_allclose(box.standing(jnp.array([0.6, 0.05, 0.5]))[0, 0], np.cos(0.5), atol=1e-6)
