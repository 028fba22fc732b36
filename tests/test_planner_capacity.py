"""How many slots a scene has changes nothing: not g, not J, not what is drawn, nor how the target is taken out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax import planner
from mechsearch_jax.config.config import PlannerConfig, Weights
from mechsearch_jax.dynamics.quasi_static import QuasiStatic
from mechsearch_jax.geometry.superquadric import empty, pad
from mechsearch_jax.grasping.graspability import INFEASIBLE, graspability, pairs
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner.rollout import present_state
from mechsearch_jax.workspace import scenario

CAPACITIES = (8, 12)


@pytest.fixture(scope="module")
def objects():
    return scenario.superquadrics(scenario.load_scenario(scenario.example_scenarios()["crowded-shelf"]).objects)


def same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_g_and_j_are_the_same(problem):
    rng = np.random.default_rng(0)
    belief = planner.initial_belief(problem)
    found_belief = belief.replace(found=jnp.array(True))
    rows = pairs(problem.grasps, belief.grasps.feasible)
    count = problem.poses.shape[0]
    exists, somewhere = jnp.asarray(rng.random(count) < 0.3), jnp.arange(count) == 400
    # Of eight objects and the target; more than there were counted as one more than there can be.
    hits = jnp.asarray(rng.random((rows.pose.shape[0], 9)) < 0.8).at[:, 8].set(False)
    wider = jnp.concatenate([hits[:, :8], jnp.zeros((len(hits), 4), bool), hits[:, 8:]], axis=1)
    g = np.asarray(graspability(rows, hits))
    np.testing.assert_array_equal(g, graspability(rows, wider))
    nothing = ~np.isin(np.arange(len(g)), np.asarray(rows.pose)[np.asarray(rows.allowed)])
    assert nothing.any()
    assert (g[nothing] == 1 - INFEASIBLE).all()
    assert g[~nothing].min() > 1 - INFEASIBLE
    for objective in (planner.search_for_grasp().objective, planner.search_and_grasp().objective):
        # Where a found target is hidden, no grasp counts.
        for known, at in (
            (belief, jnp.zeros_like(somewhere)),
            (found_belief, jnp.zeros_like(somewhere)),
            (found_belief, somewhere),
        ):
            state = present_state(problem, known, empty(8), PlannerConfig())
            state = state.replace(exists=exists | somewhere, target_at=at)
            costs = [float(objective.cost(problem, known, state.replace(hits=h), Weights())) for h in (hits, wider)]
            assert costs[0] == costs[1]


@pytest.mark.slow
def test_two_capacities_make_one_decision(problem, objects):
    policy = planner.search_for_grasp(sequences=6, horizon=2, push_model=QuasiStatic(), later_push_model=QuasiStatic())
    for found in (False, True):
        decisions = []
        for capacity in CAPACITIES:
            seen = Observation(pad(objects, capacity), jnp.array(found), jnp.float32([0.6, 0.1, 0.0]))
            belief = planner.update_belief(problem, planner.initial_belief(problem), seen)
            decisions.append(policy(jax.random.key(5), problem, belief, seen))
        one, other = decisions
        same(one.sequences.actions.kind, other.sequences.actions.kind)
        # The target's slot is the last one, whichever that is.
        moved = [
            -1 if int(decision.action.object) == capacity else int(decision.action.object)
            for decision, capacity in zip(decisions, CAPACITIES, strict=True)
        ]
        assert moved[0] == moved[1]
        actions = (decision.action.replace(object=0) for decision in decisions)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), *actions)
        np.testing.assert_allclose([one.value, one.cost], [other.value, other.cost], rtol=1e-5)
