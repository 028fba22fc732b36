"""A found target that may be pushed: where it counts as standing, what it costs there, and what moves it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax import planner
from mechsearch_jax.actions import ActionKind
from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import SAMPLED_KINDS
from mechsearch_jax.actions.types import Prediction, Sample
from mechsearch_jax.belief.belief import possible_poses, with_target
from mechsearch_jax.belief.moved_target import candidate_of
from mechsearch_jax.config.config import Weights
from mechsearch_jax.grasping.graspability import INFEASIBLE, crowding, grasp_hits, graspability, pairs
from mechsearch_jax.observation import Observation
from mechsearch_jax.workspace import scenario

POLICY = planner.search_for_grasp(move_target=True)
POSE = (0.469, -0.058, 0.0)
# How far the target is pushed, in predicted states [m].
PUSH = np.float32([0.0, 0.05, 0.0])


def boxes(*rows):
    """Boxes by x, y and half sizes [m]."""
    bodies = [scenario.Body("box", half, (x, y, 0.4045 + half[2]), (1.0, 0.0, 0.0, 0.0)) for x, y, half in rows]
    return scenario.superquadrics(bodies)


def seen(objects, found=True):
    return Observation(objects, jnp.array(found), jnp.float32(POSE))


@pytest.fixture(scope="module")
def objects():
    """A box beside the target, which every grasp of it hits, and two behind them."""
    return boxes(
        (0.455, -0.132, (0.028, 0.048, 0.08)),
        (0.543, -0.088, (0.048, 0.028, 0.08)),
        (0.543, -0.17, (0.054, 0.025, 0.054)),
    )


@pytest.fixture(scope="module")
def belief(problem, objects):
    return planner.update_belief(problem, planner.initial_belief(problem), seen(objects))


def rollout_of(problem, belief, policy=POLICY):
    return policy.rollout(problem, belief)


@pytest.fixture(scope="module")
def states(problem, belief, objects):
    """The state before a push of the target, of which nothing is computed, and the one after it, with its cost."""
    rollout = rollout_of(problem, belief)
    root = rollout.root(objects)
    pushed = root.scene.replace(position=root.scene.position + root.is_target[:, None] * PUSH[None])
    action = no_action().replace(kind=jnp.int32(ActionKind.PUSH), object=jnp.int32(8))
    moving = dataclasses.replace(
        rollout,
        propose=lambda *_: Sample(action, jnp.int32(0)),
        predict=lambda *_: Prediction(pushed, root.is_target, jnp.array(True)),
    )
    changes, _, _ = moving.act(True, root, jax.random.key(0))

    @jax.jit
    def evaluated(problem, belief, after):
        rollout = rollout_of(problem, belief)
        after = rollout.update(after.replace(moved=after.scene.valid))
        return after, rollout.cost(after)

    return root, *jax.device_get(evaluated(problem, belief, root.replace(**changes)))


def test_a_pushed_target_stands_at_the_nearest_candidate(problem, belief, objects, states):
    root, after, _ = states
    scene, is_target = with_target(problem, belief, objects)
    nearest = lambda place: np.argmin(np.linalg.norm(np.asarray(problem.poses)[:, :2] - place, axis=1))  # noqa: E731
    assert np.flatnonzero(candidate_of(problem, scene, is_target)).tolist() == [nearest(POSE[:2])]
    assert np.flatnonzero(after.target_at).tolist() == [nearest(POSE[:2] + PUSH[:2])]
    assert not root.target_at.any()


def test_only_the_place_of_a_found_target_counts(problem, belief):
    exists = jnp.arange(problem.poses.shape[0]) < 5
    nowhere, at = jnp.zeros_like(exists), jnp.arange(len(exists)) == 7
    hidden = belief.replace(found=jnp.array(False))
    for given, where, expected in (
        (hidden, nowhere, range(5)),
        (belief, nowhere, [len(exists)]),
        (belief, at, [7]),
    ):
        assert np.flatnonzero(possible_poses(given, exists, where)).tolist() == list(expected)


def test_the_cost_of_a_pushed_target_is_that_of_its_candidate(problem, objects, states):
    _, after, cost = states
    pose = int(np.argmax(after.target_at))
    rows = pairs(problem.grasps)
    hits = grasp_hits(problem.grasps, objects, jnp.asarray(after.target_at))
    of_pose = np.asarray(rows.pose) == pose
    np.testing.assert_array_equal(after.hits[: len(of_pose), :8][of_pose], np.asarray(hits)[of_pose])
    g, crowd = (float(of(rows, hits)[pose]) for of in (graspability, crowding))
    assert crowd > 0
    assert not after.exists.any()
    assert float(cost) == pytest.approx(2.0 - g + POLICY.config.crowding_weight * crowd, rel=1e-6)


@pytest.mark.parametrize("objective", [planner.search_for_grasp().objective, planner.search_and_grasp().objective])
def test_where_a_pushed_target_could_be_hidden_no_grasp_counts(problem, belief, states, objective):
    _, after, _ = states
    at, hits = jnp.asarray(after.target_at), jnp.zeros(after.hits.shape, bool)
    after = jax.tree.map(jnp.asarray, after.replace(target_at=at, hits=hits))

    def cost(exists):
        return float(objective.cost(problem, belief, after.replace(exists=exists), Weights(crowding=0.02)))

    assert cost(jnp.zeros_like(at)) == objective.reached
    assert cost(at) == objective.reached + INFEASIBLE


def test_the_target_may_be_pushed_once_but_not_picked(states):
    root, after, _ = states
    able = {kind.name: row.tolist() for kind, row in zip(SAMPLED_KINDS, np.asarray(root.able), strict=True)}
    assert able == {"push": [True] * 3 + [False] * 5 + [True], "pick-and-place": [True] * 3 + [False] * 6}
    assert not after.available[8]


@pytest.mark.slow
def test_a_found_target_is_pushed_where_that_frees_it(objects):
    # From farther to the side it is grasped past the box.
    config = planner.standard().problem
    from_the_front = dataclasses.replace(config.retrieval, max_yaw=np.radians(45))
    problem = planner.build_problem(config=dataclasses.replace(config, retrieval=from_the_front))
    belief = planner.update_belief(problem, planner.initial_belief(problem), seen(objects))
    decision = POLICY(jax.random.key(0), problem, belief, seen(objects))
    # Since 100 first actions are compared, a push of object 0 that frees the target as well is among them.
    assert (int(decision.action.kind), int(decision.action.object)) in {(ActionKind.PUSH, 8), (ActionKind.PUSH, 0)}
    assert float(decision.predicted_cost) < float(decision.cost) - 0.5
    kind, index = (np.asarray(a) for a in (decision.sequences.actions.kind, decision.sequences.actions.object))
    of_target = index == 8
    assert np.mean(of_target[:, 0]) > 0.1
    freed = np.asarray(decision.sequences.cost)[of_target[:, 0] & (kind[:, 0] == ActionKind.PUSH), 0]
    assert freed.min() < float(decision.cost) - 0.5
    assert set(kind[of_target].tolist()) <= {ActionKind.PUSH, ActionKind.NONE}
