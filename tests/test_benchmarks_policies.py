"""The policies that are examples: tree search, and the object that occludes most first."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax import planner
from mechsearch_jax.actions import ActionKind, no_action
from mechsearch_jax.actions.types import Prediction, Sample
from mechsearch_jax.benchmarks.policies.occlusion import (
    EACH,
    most_occluding,
    most_occluding_first,
)
from mechsearch_jax.benchmarks.policies.tree_search import mctx, tree_plan
from mechsearch_jax.dynamics.quasi_static import QuasiStatic
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


def evenly(problem, belief, objective, guided_fraction, state):
    return jnp.ones(state.scene.capacity)


def to_either_side(key, problem, state, possible, weights, wanted):
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
            rollout = Line(problem, belief, config, evenly, predict, None, to_either_side, start=start)
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


# Far from each other: one that hides much, one that hides less, one that hides little.
SIZES = {"wide": ((0.03, 0.06, 0.08), 0.1), "narrow": ((0.025, 0.03, 0.06), 0.3), "low": ((0.02, 0.02, 0.05), -0.15)}
ORDERS = (("wide", "narrow", "low"), ("low", "wide", "narrow"), ("narrow", "low", "wide"))
POLICY = most_occluding(push_model=QuasiStatic(), sequences=12)


def body(name):
    half_size, y = SIZES[name]
    return scenario.Body("box", half_size, (0.5, y, 0.4045 + half_size[2]), (1.0, 0.0, 0.0, 0.0))


def seen(names, pose=None):
    """What is observed of objects, and of a target at a pose; of a hidden target without one."""
    objects = scenario.superquadrics([body(name) for name in names])
    return Observation(objects, jnp.array(pose is not None), jnp.float32(pose or (0.0, 0.0, 0.0)))


def look(problem, observation):
    return planner.update_belief(problem, planner.initial_belief(problem), observation)


def decided(problem, names, seed=0, policy=POLICY, pose=None):
    observation = seen(names, pose)
    return policy.planned(jax.random.key(seed), problem, look(problem, observation), observation)


def object_of(decision, names):
    assert int(decision.action.kind) in (ActionKind.PUSH, ActionKind.PICK_AND_PLACE)
    return names[int(decision.action.object)]


def test_actions_come_by_their_objects_and_few_of_each():
    push, none = int(ActionKind.PUSH), int(ActionKind.NONE)
    index = jnp.int32([1, 0, 0, 0, 2, 0, 0, 0, 1])
    kind = jnp.int32([push, push, none, push, push, push, push, push, push])
    value = np.asarray(most_occluding_first(kind, index, jnp.float32([30.0, 5.0, 0.0])))
    assert EACH == 4
    # The impossible one counts for nothing, and the fifth possible one of object 0 is left out.
    np.testing.assert_array_equal(value, [-5.0, -30.0, np.inf, -30.0, 0.0, -30.0, -30.0, np.inf, -5.0])


@pytest.mark.slow
def test_the_object_that_hides_most_is_moved_in_any_order_of_the_objects(problem):
    alone = {name: int(look(problem, seen((name,))).exists.sum()) for name in SIZES}
    assert alone["wide"] > 1.5 * alone["narrow"] > 1.5 * alone["low"]
    for names in ORDERS:
        for seed in range(3):
            decision = decided(problem, names, seed)
            assert object_of(decision, names) == "wide"
        hidden = {names[i]: -float(v) for i, v in first_values(decision).items()}
        assert sorted(hidden, key=hidden.get, reverse=True) == [n for n in ("wide", "narrow", "low") if n in hidden]
        # It hides about as much as where it stands alone.
        assert hidden["wide"] == pytest.approx(alone["wide"], rel=0.4)
        assert float(decision.cost) == int(look(problem, seen(names)).exists.sum())
        assert float(decision.predicted_cost) == float(decision.cost) - hidden["wide"]


def first_values(decision):
    """The value of the first action of each object."""
    sequences = jax.device_get(decision.sequences)
    rows = [(int(i), v) for i, v in zip(sequences.actions.object[:, 0], sequences.value, strict=True) if np.isfinite(v)]
    return dict(reversed(rows))


@pytest.mark.slow
def test_once_the_target_is_found_the_object_that_blocks_most_of_its_grasps_is_moved(problem):
    for names in ORDERS[:2]:
        for behind in ("narrow", "wide"):
            pose = (0.62, SIZES[behind][1], 0.0)
            decision = decided(problem, names, pose=pose)
            assert object_of(decision, names) == behind
            assert float(decision.value) < 0.0
        # The target itself is never moved.
        assert not (decision.sequences.actions.object == len(decision.predicted.valid)).any()
