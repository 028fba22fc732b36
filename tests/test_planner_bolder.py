"""Actions for where no other has a gain: pushes by a hand on edge, and grasps of what seems to be locked in."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stage import CYLINDER, SILL
from test_search import IMAGES, one_push, searcher_of
from test_stacks import scene_of

from mechsearch_jax import planner
from mechsearch_jax.actions.candidates import all_candidates, free_candidates
from mechsearch_jax.actions.kinds.push import Push
from mechsearch_jax.actions.registry import SAMPLED_KINDS
from mechsearch_jax.belief.belief import possible_space
from mechsearch_jax.robot.grasp_frames import WRIST_ORIGIN
from mechsearch_jax.workspace.scenario import Scenario

NAMES = [kind.name for kind in SAMPLED_KINDS]


@pytest.fixture(scope="module")
def free(problem):
    """The candidates of each kind that are free for object 0 of a scene, and all their poses, with both problems."""

    @jax.jit
    def evaluated(problem, scene):
        nowhere = jnp.zeros(problem.poses.shape[0], bool)
        space = possible_space(problem, planner.initial_belief(problem), nowhere)
        return all_candidates(problem.space, scene, space)

    def of(problem, scene):
        rows = jax.device_get(evaluated(problem, scene))
        return {
            name: (np.asarray(free_candidates(c))[0].any(-1), c.T_world_gripper[0])
            for name, c in zip(NAMES, rows, strict=True)
        }

    return lambda scene: (of(problem, scene), of(problem.bolder, scene))


def test_beside_a_wall_a_hand_on_edge_has_room_to_push(problem, free):
    """A box as wide as the hand opens, 3 cm from a side wall: nothing else moves it."""
    y = problem.shelf.left - 0.03 - 0.04
    level, on_edge = free(scene_of(((0.04, 0.04, 0.065), 0.6, y, 0.0, np.eye(3), False)))
    assert not any(which.any() for which, _ in level.values())
    which, T = on_edge["push"]
    assert which.any()
    np.testing.assert_allclose(T[which][:, 2, 1] ** 2, np.cos(problem.config.actions.push_tilt) ** 2, atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(T[which][:, :3, :3]), 1.0, atol=1e-5)
    np.testing.assert_array_equal(level["push"][1][:, :3, 2], T[:, :3, 2])
    q7 = np.asarray(problem.bolder.actions.q7)[1] - WRIST_ORIGIN
    np.testing.assert_allclose(q7, np.array(problem.config.actions.push_wrists) - np.pi / 2, atol=1e-6)


def test_what_is_recognised_a_little_inside_another_is_not_locked_in(free):
    """Two boxes, one behind the other, that overlap by 6 mm."""
    first, behind = (((0.03, 0.03, 0.06), x, 0.1, 0.0, np.eye(3), False) for x in (0.55, 0.604))
    usual, bolder = free(scene_of(first, behind))
    assert not usual["pick-and-place"][0].any()
    assert bolder["pick-and-place"][0].any()
    # Deeper ones are.
    assert not free(scene_of(first, (behind[0], 0.598, *behind[2:])))[1]["pick-and-place"][0].any()


def test_a_searcher_tries_them_last_and_says_how_it_pushes(problem):
    push, asked = one_push(problem), []

    def plan(rollout, key, objects):
        horizon = rollout.config.horizon
        asked.append(horizon)
        decision, on_edge = push(rollout, key, objects), rollout.problem.actions.turn[1] < -0.5
        after = jnp.where(on_edge, 4.0, 9.0)
        sequences = decision.sequences.replace(cost=jnp.broadcast_to(after, decision.sequences.cost.shape))
        return decision.replace(predicted_cost=after, sequences=sequences)

    policy = planner.search_for_grasp(sequences=4).replace(plan=plan)
    # High enough for all grasps, and not to hide the target.
    high = dataclasses.replace(SILL.objects[0], half_size=(0.01, 0.2, 0.043), position=(0.52, 0.07, 0.4475))
    step = searcher_of(problem, Scenario("high", (high,), CYLINDER), policy=policy).next(IMAGES.depth)
    assert asked == [1, 2]
    assert "cost 9, 4 expected afterwards" in step.reason
    action = step.decision.action
    T = np.asarray(action.T_world_gripper).copy()
    assert "edge" not in Push().describe(action)
    T[:3, :2] = T[:3, [1, 0]] * [1.0, -1.0]
    assert Push().describe(action.replace(T_world_gripper=T)) == f"{Push().describe(action)}, the hand on edge"
