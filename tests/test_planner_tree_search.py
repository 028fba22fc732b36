"""Tree search: it looks ahead, never chooses what is impossible, and decides in the form that every policy does."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax import planner
from mechsearch_jax.actions import ActionKind, no_action
from mechsearch_jax.actions.types import Prediction, Sample
from mechsearch_jax.benchmarks.policies.tree_search import mctx, tree_plan
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner.rollout import Rollout, no_sequences
from mechsearch_jax.workspace import scenario

CONFIG = planner.PlannerConfig(horizon=2, sequences=64)
# J by how far the first object was moved: one step to the left gains a little, two to the right much more.
COSTS = np.float32([10.0, 9.0, 10.0, 10.5, 4.0])
STEP = 0.05


@pytest.fixture(autouse=True)
def installed():
    pytest.importorskip("mctx")


@pytest.fixture(scope="module")
def objects():
    return scenario.superquadrics(scenario.load_scenario(scenario.example_scenarios()["first-light"]).objects)


@dataclasses.dataclass(frozen=True, eq=False)
class Line(Rollout):
    """A world in which the first object moves along a line, of which nothing is computed but where it is."""

    start: float = 0.0

    def update(self, state):
        return state

    def candidates(self, state):
        return state.candidates

    def cost(self, state):
        place = jnp.round((state.scene.position[0, 1] - self.start) / STEP).astype(jnp.int32)
        return jnp.asarray(COSTS)[jnp.clip(place + 2, 0, 4)]


def to_either_side(key, problem, belief, objective, guided_fraction, state, wanted):
    side = jnp.where(jax.random.bernoulli(key), STEP, -STEP)
    action = no_action().replace(kind=jnp.int32(ActionKind.PUSH), displacement=jnp.array([0.0, 1.0, 0.0]) * side)
    return Sample(action, jnp.int32(0))


def moves(problem, state, sample, first):
    scene = state.scene
    after = scene.replace(position=scene.position + sample.action.displacement[None])
    return Prediction(after, scene.valid, jnp.array(True))


def never(problem, state, sample, first):
    return Prediction(state.scene, jnp.zeros_like(state.moved), jnp.array(False))


def only_left(problem, state, sample, first):
    prediction = moves(problem, state, sample, first)
    possible = sample.action.displacement[1] < 0
    scene = jax.tree.map(lambda a, b: jnp.where(possible, a, b), prediction.scene, state.scene)
    return Prediction(scene, prediction.moved & possible, possible)


@pytest.fixture(scope="module")
def decide(problem, objects):
    belief, start = planner.initial_belief(problem), float(objects.position[0, 1])

    @functools.cache
    def compiled(predict, horizon):
        def decided(key, gamma, objects):
            config = dataclasses.replace(CONFIG, gamma=gamma, horizon=horizon)
            rollout = Line(problem, belief, config, to_either_side, predict, None, start=start)
            return tree_plan(rollout, key, objects)

        return jax.jit(decided)

    return lambda predict=moves, seed=0, gamma=0.9, horizon=2: compiled(predict, horizon)(
        jax.random.key(seed), gamma, objects
    )


def test_it_looks_ahead_as_far_as_the_horizon(decide):
    for seed in range(3):
        far = decide(seed=seed)
        assert far.action.displacement[1] > 0
        assert (float(far.cost), float(far.predicted_cost)) == (10.0, 10.5)
        assert float(far.value) < 0
        near = decide(seed=seed, horizon=1)
        assert near.action.displacement[1] < 0
        assert (float(near.predicted_cost), float(near.value)) == (9.0, -1.0)


def test_what_is_impossible_is_never_chosen(decide):
    decision = decide(only_left)
    assert decision.action.displacement[1] < 0
    kinds, value = np.asarray(decision.sequences.actions.kind)[:, 0], np.asarray(decision.sequences.value)
    assert (np.isfinite(value) == (kinds == ActionKind.PUSH)).all()
    assert (kinds == ActionKind.NONE).any()
    none = decide(never)
    assert int(none.action.kind) == ActionKind.NONE
    assert np.isinf(none.sequences.value).all()
    assert float(none.predicted_cost) == float(none.cost) == 10.0


def test_a_decision_has_the_form_of_any_other(decide, objects):
    decision = decide()
    expected = no_sequences(CONFIG, objects)
    assert jax.tree.map(lambda a: (a.shape, a.dtype), decision.sequences) == jax.tree.map(
        lambda a: (a.shape, a.dtype), expected
    )
    assert decision.predicted.capacity == objects.capacity
    assert float(decision.predicted.position[0, 1] - objects.position[0, 1]) == pytest.approx(STEP, abs=1e-6)
    cost = np.asarray(decision.sequences.cost)
    assert np.isfinite(cost[np.isfinite(decision.sequences.value), 0]).all()
    assert np.isnan(cost[:, 1:]).all()
    again = decide()
    jax.tree.map(np.testing.assert_array_equal, decision, again)


@pytest.mark.slow
def test_a_decision_on_a_shelf(problem, objects):
    seen = Observation(objects, jnp.array(False), jnp.zeros(3))
    belief = planner.update_belief(problem, planner.initial_belief(problem), seen)
    policy = mctx(sequences=8, horizon=2)
    decision = policy(jax.random.key(0), problem, belief, seen)
    assert int(decision.action.kind) in (ActionKind.PUSH, ActionKind.PICK_AND_PLACE)
    assert float(decision.value) < 0
    assert float(decision.predicted_cost) < float(decision.cost)
    assert float(decision.cost) == float(planner.search_for_grasp()(jax.random.key(0), problem, belief, seen).cost)
