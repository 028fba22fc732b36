"""Verdicts on the true state: with the grasps that the robot uses, and with the paper's alone."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stage import HIDDEN, OPEN, SILL, Stage, grab, reveal

from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, true_target_pose
from mechsearch_jax.envs.episode import verdicts
from mechsearch_jax.envs.episode.closed_loop import Listeners, RunSettings, Start
from mechsearch_jax.envs.episode.episodes import run_episode, run_episodes
from mechsearch_jax.envs.episode.verdicts import Verdict, free_in_sets, judge, paper_grasps
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.grasping.retrieval import best_grasp, can_be_joined, found_grasps, joined, target_grasps
from mechsearch_jax.workspace.target import Target


@pytest.mark.parametrize(("shape", "count"), [("cylinder", 21), ("box", 12)])
def test_the_papers_grasps_are_10_to_30_tilted_by_20_degrees(problem, shape, count):
    grasps = paper_grasps(problem.shelf, problem.gripper, Target.of(shape))
    assert grasps.tables.q7.shape == (count,)
    approach = np.asarray(grasps.tables.T_target_gripper)[:, :3, 2]
    np.testing.assert_allclose(approach[:, 2], -math.sin(math.radians(20)), atol=1e-6)
    assert paper_grasps(problem.shelf, problem.gripper, Target.of(shape)) is grasps


REVEALING = {"hidden": reveal}


def test_steeper_grasps_reach_over_what_the_papers_do_not(problem):
    """Alone and in a batch: what stands low and wide before the target leaves only grasps tilted by more than that."""
    scenarios = [OPEN, SILL, HIDDEN]
    alone = [run_episode(Start(s, 0, max_steps=2), problem, grab, Stage(REVEALING)) for s in scenarios]
    successes = {}
    starts = [Start(s, 0) for s in scenarios]
    settings = RunSettings(max_steps=2, at_once=2)
    run_episodes(starts, problem, grab, Stage(REVEALING), 2, Listeners(successes.update), settings)
    for episodes in (alone, [successes[i] for i in range(3)]):
        steps = [(e.graspable_step, e.paper_graspable_step) for e in episodes]
        assert steps == [(0, 0), (0, None), (1, 1)]
        assert [[s.paper_graspable for s in e.steps] for e in episodes] == [[True], [False], [False, True]]


def test_the_papers_grasps_do_not_depend_on_the_methods(problem):
    steep = GraspConfig(tilts=(math.radians(30),))
    grasps = target_grasps(problem.shelf, problem.gripper, problem.target, steep)
    config = dataclasses.replace(problem.config, grasps=steep, retrieval=steep)
    other = problem.replace(retrieval=grasps.tables, config=config)
    for scenario, expected in ((OPEN, True), (SILL, False)):
        here = Snapshot(problem.camera, problem.shelf, from_scenario(scenario))
        assert judge(other, here).paper_graspable == expected


@pytest.mark.parametrize(
    "changes", [{}, pytest.param({"points": 1024}, marks=pytest.mark.slow)], ids=["alike", "points"]
)
def test_sets_of_grasps_are_judged_together_as_each_alone(problem, changes):
    own, papers = verdicts.judged_sets(problem)
    if changes:
        config = dataclasses.replace(papers.config, **changes)
        papers = target_grasps(problem.shelf, problem.gripper, problem.target, config)
    assert can_be_joined((own, papers)) == (not changes)
    for scenario in (OPEN, SILL, HIDDEN):
        here = Snapshot(problem.camera, problem.shelf, from_scenario(scenario))
        objects, pose = objects_on_the_board(here), true_target_pose(here.world)
        alone = [bool(best_grasp(grasps, objects, pose).success) for grasps in (own, papers)]
        assert [bool(free) for free in free_in_sets((own, papers), objects, pose)] == alone
    assert not any(free_in_sets((own, papers), objects, pose, jnp.array(False)))


def test_each_set_keeps_how_far_to_the_side_its_grasps_may_come_from(problem):
    """At places beside a wall only the set that comes from farther has a grasp, joined with the other or alone."""
    narrow, wide = (
        target_grasps(problem.shelf, problem.gripper, Target.of("box"), GraspConfig(max_yaw=math.radians(degrees)))
        for degrees in (45, 75)
    )
    both = joined((narrow, wide))
    count = len(narrow.tables.q7)
    found = 0
    for yaw in np.radians([0.0, 30.0, 55.0]):
        T_world_target = upright_pose(jnp.array([0.52, 0.3, yaw]), narrow.target.height(problem.shelf))
        each = [np.asarray(found_grasps(grasps, T_world_target).feasible) for grasps in (narrow, wide)]
        np.testing.assert_array_equal(np.asarray(found_grasps(both, T_world_target).feasible), np.concatenate(each))
        assert (each[0] <= each[1]).all()
        found += int(each[1].sum()) - int(each[0].sum())
    assert len(both.tables.q7) == 2 * count
    assert found > 0


def test_sets_that_are_tested_otherwise_are_not_joined(problem):
    usual = problem.target_grasps
    other = usual.replace(config=dataclasses.replace(usual.config, waypoints=3))
    assert not can_be_joined((usual, other))
    with pytest.raises(ValueError, match="waypoints"):
        joined([usual, other])


def test_nothing_is_judged_where_nothing_stands(problem):
    """The slots that fill up a batch."""
    world = jax.tree.map(lambda a: jnp.stack([a, a]), from_scenario(OPEN))
    assert verdicts.judge_many(problem, world, jnp.array([True, False])) == [Verdict(True, True), Verdict()]
