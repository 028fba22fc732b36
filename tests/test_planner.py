"""The planner: equation 2, decisions that repeat, no retracing, and the rules of the two methods."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax import planner
from mechsearch_jax.actions import ActionKind
from mechsearch_jax.dynamics.quasi_static import QuasiStatic
from mechsearch_jax.dynamics.rigid import moved_objects
from mechsearch_jax.errors import InputError
from mechsearch_jax.geometry import masked, superquadric
from mechsearch_jax.planner import PlannerConfig
from mechsearch_jax.workspace import scenario

CONFIG = PlannerConfig.paper()


def load(name):
    loaded = scenario.load_scenario(scenario.example_scenarios()[name])
    return loaded, scenario.superquadrics(loaded.objects)


def look(problem, objects, found=False, pose=(0.0, 0.0, 0.0)):
    start = planner.initial_belief(problem)
    return planner.observe_belief(problem, start, objects, jnp.array(found), jnp.float32(pose), CONFIG)


@pytest.fixture(scope="module")
def decision(problem):
    _, objects = load("first-light")
    belief = look(problem, objects)
    return objects, belief, planner.plan(jax.random.key(0), problem, belief, objects, CONFIG)


def test_the_papers_settings():
    config = PlannerConfig.paper()
    assert (config.gamma, config.horizon, config.sequences, config.max_steps) == (0.9, 3, 30, 10)
    assert config.push_distances == (0.05, 0.10, 0.15)
    assert config.method == "search-for-grasp"


def test_prefix_values_are_equation_2():
    gamma, cost = 0.9, np.array([20.0, 15.0, 18.0, 3.0])
    # The right-hand side of equation 2, for every T.
    expected = [
        gamma**T * cost[T] + (1 - gamma) / gamma * sum(gamma**t * cost[t] for t in range(1, T + 1)) - cost[0]
        for T in (1, 2, 3)
    ]
    for acted, best in (([True] * 3, np.argmin(expected)), ([True, False, False], 0)):
        value, length = planner._prefix_values(jnp.float32(cost), jnp.zeros(3), jnp.array(acted), gamma)
        np.testing.assert_allclose(value, expected[best], rtol=1e-5)
        assert int(length) == best + 1
    nothing, _ = planner._prefix_values(jnp.float32(cost), jnp.zeros(3), jnp.zeros(3, bool), gamma)
    assert np.isinf(nothing)


def test_what_is_in_the_way_alone_matters_most():
    rng = np.random.default_rng(0)
    rows, counts = rng.random((200, 6)) < 0.3, rng.random(200) < 0.7
    rows[:, 4] = False
    expected = np.zeros(6)
    for row in rows[counts]:
        expected[row] += planner.ALONE ** (1.0 - row.sum())
    share = np.asarray(planner._blame(jnp.asarray(rows), jnp.asarray(counts)))
    np.testing.assert_allclose(share, expected / expected.sum(), rtol=1e-5)
    assert share[4] == 0
    assert not np.asarray(planner._blame(jnp.asarray(rows), jnp.zeros(200, bool))).any()


def test_draws_go_to_what_hides_the_target(decision, problem):
    objects, belief, _ = decision
    space = planner.action_space(problem, CONFIG)
    root = planner._root(problem, belief, planner._with_target(problem, belief, objects), space)
    weights_of = jax.jit(
        lambda node: planner._object_weights(
            problem, belief, CONFIG, planner._update(problem, belief, CONFIG, node, node.moved)
        )
    )
    weights = np.asarray(weights_of(root))
    valid = np.asarray(root.available)
    assert weights.sum() == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(weights[~valid], (1.0 - CONFIG.focus) / len(weights), rtol=1e-5)
    assert (weights[valid] > weights[~valid].max()).any()


def test_a_decision_is_the_first_action_of_the_best_sequence(decision):
    _, belief, plan = decision
    values = np.asarray(plan.sequences.value)
    assert np.all(values[:-1] <= values[1:])
    assert float(plan.value) == values[0]
    assert int(plan.action.kind) == int(plan.sequences.actions.kind[0, 0]) != ActionKind.NONE
    assert float(plan.cost) >= float(jnp.sum(belief.exists))
    assert not bool(plan.overflow)


def test_an_object_moves_at_most_once_in_a_sequence(decision):
    actions = decision[2].sequences.actions
    for kinds, objects in zip(np.asarray(actions.kind), np.asarray(actions.object), strict=True):
        moved = objects[kinds != ActionKind.NONE]
        assert len(set(moved.tolist())) == len(moved)


def test_the_same_key_and_state_give_the_same_decision(decision, problem):
    objects, belief, plan = decision
    again = planner.plan(jax.random.key(0), problem, belief, objects, CONFIG)
    jax.tree.map(np.testing.assert_array_equal, plan, again)


def test_nothing_is_compiled_anew_when_objects_come_go_or_move(decision, problem):
    objects = decision[0]
    counts = [f._cache_size() for f in (planner.plan, planner.observe_belief, planner.graspable_at)]
    fewer = objects.replace(valid=objects.valid.at[0].set(False))
    moved = objects.replace(position=objects.position.at[1].add(jnp.float32([0.01, 0.02, 0.0])))
    _, other = load("crowded-shelf")
    for scene in (fewer, moved, other):
        seen = look(problem, scene)
        planner.plan(jax.random.key(1), problem, seen, scene, CONFIG)
    found = look(problem, objects, True, (0.7, 0.2, 0.0))
    plan = planner.plan(jax.random.key(1), problem, found, objects, CONFIG)
    assert float(plan.cost) < superquadric.empty(8).capacity + 3
    planner.graspable_at(problem, objects, jnp.float32([0.7, 0.2, 0.0]))
    planner.graspable_at(problem, fewer, jnp.float32([0.6, 0.0, 0.0]))
    after = [f._cache_size() for f in (planner.plan, planner.observe_belief, planner.graspable_at)]
    assert after[:2] == counts[:2]
    assert after[2] <= counts[2] + 1


def test_a_found_target_is_one_pose_and_stays_found(problem):
    _, objects = load("first-light")
    belief = look(problem, objects, True, (0.7, 0.2, 0.0))
    assert bool(belief.found)
    hidden_again = planner.observe_belief(problem, belief, objects, jnp.array(False), jnp.zeros(3), CONFIG)
    assert bool(hidden_again.found)
    np.testing.assert_allclose(hidden_again.found_pose, [0.7, 0.2, 0.0])


def test_the_state_that_a_plan_begins_with_has_the_shapes_of_every_other(decision, problem):
    objects, belief, _ = decision
    space = planner.action_space(problem, CONFIG)
    root = planner._root(problem, belief, planner._with_target(problem, belief, objects), space)

    def known(node):
        node = planner._update(problem, belief, CONFIG, node, node.moved)
        return node.replace(options=planner.candidates(space, problem.actions, node.scene, possible))

    possible = planner._possible_space(problem, belief, belief.exists)
    shapes = lambda tree: jax.tree.map(lambda a: (a.shape, a.dtype), tree)  # noqa: E731
    assert shapes(jax.eval_shape(known, root)) == shapes(root)


@pytest.mark.slow
def test_a_decision_is_the_same_in_the_blocks_of_a_gpu(decision, problem, monkeypatch):
    objects, belief, plan = decision
    monkeypatch.setattr(masked, "on_cpu", lambda: False)
    again = jax.jit(lambda key: planner.plan.__wrapped__(key, problem, belief, objects, CONFIG))(jax.random.key(0))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), plan, again)


@dataclasses.dataclass(frozen=True)
class Shaky:
    """The quasi-static model, which fears that everything it moves may topple, or does not know what becomes of it."""

    chance: float | jax.Array
    residual: float | jax.Array

    def __call__(self, shelf, scene, pusher, T_world_gripper, displacement, q7):
        told = QuasiStatic()(shelf, scene, pusher, T_world_gripper, displacement, q7)
        feared = jnp.where(moved_objects(scene, told.scene), self.chance, 0.0)
        return told.replace(topples=jnp.maximum(told.topples, feared), residual=told.residual + self.residual)


# The first is executed nevertheless.
CHANCES = jnp.float32([0.4, 0.6, np.nan, 0.0, 0.0])
RESIDUALS = jnp.float32([0.0, 0.0, 0.0, np.nan, np.inf])


@pytest.fixture(scope="module")
def drawn(decision, problem):
    """What is drawn first in many sequences, what models say of it, and what is charged for it."""
    objects, belief, _ = decision
    space = planner.action_space(problem, CONFIG)
    dear = dataclasses.replace(CONFIG, topple_charge=2.0)

    @jax.jit
    def draw(keys):
        root = planner._root(problem, belief, planner._with_target(problem, belief, objects), space)
        root = planner._update(problem, belief, CONFIG, root, root.moved)
        root = root.replace(options=planner._options(problem, belief, space, root, root.moved))
        possible = planner._possible_space(problem, belief, root.exists)
        weights = planner._object_weights(problem, belief, CONFIG, root)

        def one(key):
            sample = planner.sample_action(
                key, space, problem.actions, root.scene, possible, root.options, root.available, weights
            )
            predict = lambda *shaky: planner._predict(problem, space, Shaky(*shaky), root.scene, sample)[1:]  # noqa: E731
            told = planner._predict(problem, space, QuasiStatic(), root.scene, sample)[1:]
            shaky = jax.vmap(predict)(CHANCES, RESIDUALS)
            return sample, told, shaky, planner._act(problem, belief, dear, space, Shaky(0.4, 0.0), root, key)[2]

        return jax.vmap(one)(keys)

    return jax.device_get(draw(jax.random.split(jax.random.key(0), 30)))


def test_what_may_topple_is_charged_for(drawn):
    sample, (sure, nothing), (possible, topples), dear = drawn
    possible, topples = possible[:, 0], topples[:, 0]
    pushes = sure & (sample.action.kind == ActionKind.PUSH)
    picks = sure & (sample.action.kind == ActionKind.PICK_AND_PLACE)
    assert pushes.any()
    assert picks.any()
    np.testing.assert_array_equal(possible, sure)
    assert (nothing[sure] == 0).all()
    # Every push moves one object at least.
    assert (topples[pushes] > 0.39).all()
    assert (topples[picks] == 0).all()
    np.testing.assert_allclose(dear[sure], (CONFIG.caution * sample.risk + 2.0 * topples)[sure], rtol=1e-6)


def test_what_is_dear_is_not_chosen():
    # A push that would make J half of what it is, and a pick that takes off a quarter.
    cost = jnp.float32([[20.0, 10.0], [20.0, 15.0]])
    for price, best in ((0.0, 0), (0.5 * 0.4, 0), (2.0 * 0.4, 1)):
        charge = jnp.float32([[price * 20.0], [0.0]])
        value = [planner._prefix_values(c, h, jnp.array([True]), 0.9)[0] for c, h in zip(cost, charge, strict=True)]
        assert int(np.argmin(value)) == best


def test_a_push_that_likely_topples_something_or_is_not_understood_is_ruled_out(drawn):
    sample, _, (possible, _), _ = drawn
    for row in range(1, 5):
        assert set(sample.action.kind[possible[:, row]].tolist()) == {ActionKind.PICK_AND_PLACE}


def test_an_empty_shelf_leaves_nothing_to_do(problem):
    empty = superquadric.empty(8)
    plan = planner.plan(jax.random.key(0), problem, look(problem, empty), empty, CONFIG)
    assert int(plan.action.kind) == ActionKind.NONE
    assert np.all(np.isinf(plan.sequences.value))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gamma": 0.0}, r"gamma 0.0 is outside \(0, 1\]"),
        ({"gamma": 1.5}, "gamma 1.5"),
        ({"horizon": 0}, "horizon 0 must be at least 1"),
        ({"sequences": 0}, "sequences 0"),
        ({"focus": 1.0}, r"focus 1.0 is outside \[0, 1\)"),
        ({"focus": -0.1}, "0 draws evenly"),
        ({"topple_charge": -0.5}, "topple_charge -0.5 must be a number that is not negative"),
        ({"topple_charge": float("nan")}, "topple_charge nan"),
        ({"push_model": "guess"}, 'push model "guess" is unknown; use quasi-static, learned, physics'),
        ({"method": "guess"}, 'use "search-for-grasp" or "search-and-grasp"'),
        ({"actions": "throw"}, 'use "both", "push" or "pick-and-place"'),
        ({"criterion": "guess"}, 'criterion "guess" is unknown'),
    ],
)
def test_impossible_options_are_refused_with_what_would_do(changes, message):
    with pytest.raises(InputError, match=message):
        PlannerConfig.paper(**changes)


@pytest.mark.slow
def test_a_decision_with_pushes_predicted_by_geometry_is_one_too(decision, problem):
    objects, belief, learned = decision
    geometric = dataclasses.replace(CONFIG, push_model="quasi-static")
    plan = planner.plan(jax.random.key(0), problem, belief, objects, geometric)
    assert float(plan.value) < 0
    assert float(plan.predicted_cost) < float(plan.cost) == float(learned.cost)
    assert not np.array_equal(np.asarray(plan.sequences.cost), np.asarray(learned.sequences.cost))


@pytest.mark.slow
def test_decisions_in_a_batch_are_those_made_alone(problem):
    _, first = load("first-light")
    _, second = load("crowded-shelf")
    scenes = jax.tree.map(lambda *a: jnp.stack(a), first, second)
    beliefs = jax.tree.map(lambda *a: jnp.stack(a), look(problem, first), look(problem, second))
    keys = jnp.stack([jax.random.key(3), jax.random.key(4)])
    batch = jax.vmap(lambda k, b, s: planner.plan(k, problem, b, s, CONFIG))
    together = jax.jit(batch)(keys, beliefs, scenes)
    for i, scene in enumerate((first, second)):
        alone = planner.plan(keys[i], problem, look(problem, scene), scene, CONFIG)
        assert int(together.action.kind[i]) == int(alone.action.kind)
        assert int(together.action.object[i]) == int(alone.action.object)
        np.testing.assert_allclose(together.action.T_world_gripper[i], alone.action.T_world_gripper, atol=1e-4)
