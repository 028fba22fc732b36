"""The planner: equation 2, decisions that repeat, no retracing, and the rules of the two methods."""

import dataclasses
import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax import planner
from mechsearch_jax.actions import ActionConfig, ActionKind
from mechsearch_jax.actions.candidates import contact_probability
from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.types import Prediction, Sample
from mechsearch_jax.belief.belief import possible_space
from mechsearch_jax.config.config import Weights
from mechsearch_jax.dynamics.learned import LearnedPush
from mechsearch_jax.dynamics.quasi_static import QuasiStatic
from mechsearch_jax.existence import ExistenceConfig
from mechsearch_jax.geometry import masked, superquadric
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.grasping.graspability import pairs
from mechsearch_jax.grasping.retrieval import best_grasp
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import PlannerConfig, policies
from mechsearch_jax.planner import rollout as rollouts
from mechsearch_jax.planner.objective import SearchAndGrasp, SearchForGrasp
from mechsearch_jax.planner.prediction import PredictByKind
from mechsearch_jax.planner.proposal import ALONE, DEPTH, blame, propagate_blame, sampling_weights
from mechsearch_jax.planner.rollout import Rollout, plan, prefix_values, present_state, repeated, sequence_values
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace import scenario

CONFIG = PlannerConfig()
POLICY = planner.search_for_grasp()
# Its programs on a CPU.
PARTS_OF_A_PLAN = (
    policies._begun, policies._weights, policies._decided, rollouts.candidates_of, rollouts.first_draws,
)  # fmt: skip


def load(name):
    loaded = scenario.load_scenario(scenario.example_scenarios()[name])
    return loaded, scenario.superquadrics(loaded.objects)


def look(problem, objects, found=False, pose=(0.0, 0.0, 0.0)):
    return planner.update_belief(problem, planner.initial_belief(problem), seen(objects, found, pose))


def seen(objects, found=False, pose=(0.0, 0.0, 0.0)):
    return Observation(objects, jnp.array(found), jnp.float32(pose))


def evenly(problem, belief, objective, guided_fraction, state):
    return jnp.ones(state.scene.capacity)


def rollout_of(problem, belief, policy=POLICY):
    """What a decision of the engine begins with."""
    return policy.rollout(problem, belief)


@pytest.fixture(scope="module")
def decision(problem):
    _, objects = load("first-light")
    belief = look(problem, objects)
    return objects, belief, POLICY(jax.random.key(0), problem, belief, seen(objects))


@pytest.fixture(scope="module")
def root(decision, problem):
    """The first state of the decision, brought up to date, with what can be done in it."""
    objects, belief, _ = decision

    @jax.jit
    def begin(problem, belief, objects):
        rollout = rollout_of(problem, belief)
        return rollout.up_to_date(rollout.root(objects))

    return begin(problem, belief, objects)


def test_a_block_is_moved_alike_however_a_fit_describes_it(problem):
    decided = []
    for e2, half, yaw in ((0.2, 0.03, 0.0), (1.9, 0.03 * 2**0.5, np.pi / 4)):
        c, s = np.cos(yaw), np.sin(yaw)
        block = superquadric.Superquadrics(
            size=jnp.float32([[half, half, 0.06]]),
            exponents=jnp.float32([[0.2, e2]]),
            position=jnp.float32([[0.58, 0.1, 0.4645]]),
            rotation=jnp.float32([[[c, -s, 0], [s, c, 0], [0, 0, 1]]]),
            valid=jnp.ones(1, bool),
        )
        objects = superquadric.pad(block, 8)
        belief = look(problem, objects)
        decided.append((belief, POLICY(jax.random.key(0), problem, belief, seen(objects))))
    (_, box), (_, turned) = decided
    assert int(box.action.kind) == int(turned.action.kind) == ActionKind.PICK_AND_PLACE
    kinds = [set(np.unique(decision.sequences.actions.kind[:, 0]).tolist()) for _, decision in decided]
    assert kinds[0] == kinds[1]
    allowed = [int(jnp.sum(belief.exists)) for belief, _ in decided]
    assert abs(allowed[0] - allowed[1]) <= 0.05 * allowed[0]


def test_the_default_is_the_preset_standard_field_by_field():
    assert planner.standard() == planner.Config()
    assert planner.standard().options() == {
        "gamma": 0.9,
        "horizon": 1,
        "sequences": 100,
        "move_target": False,
        "retrieval_contact": True,
        "actions": ["push", "pick-and-place"],
        "push_directions": pytest.approx(np.radians([90, -90, 0, 35, -35, 65, -65]).tolist()),
        "push_distances": [0.05, 0.1, 0.15],
        "push_model": "learned",
        "trials": "physics",
        "max_steps": 10,
    }
    # What is no option.
    search, problem = PlannerConfig(), planner.standard().problem
    assert (search.unseen_contact_penalty, search.guided_fraction, search.crowding_weight) == (1.0, 0.7, 0.02)
    assert search.draws == (4, 1)
    assert not any(settings.as_in_paper for settings in (search, problem.existence, problem.actions))
    degrees = [(20, 25, 30), 45, (20, 25, 30), 75, (10, 20, 30), 90]
    angles = [(grasps.tilts, grasps.max_yaw) for grasps in (problem.grasps, problem.retrieval, problem.actions.grasps)]
    for given, expected in zip(itertools.chain(*angles), degrees, strict=True):
        np.testing.assert_allclose(np.degrees(given), expected)
    assert (ActionConfig().contact_tolerance, ActionConfig().topple) == (0.003, 0.5)
    assert (QuasiStatic().max_penetration, LearnedPush().max_penetration) == (0.006, 0.026)
    assert (GraspConfig().yaws, len(GraspConfig().wrists), GraspConfig.dense().yaws) == (7, 3, 41)
    assert (ExistenceConfig().found_pixels, len(ExistenceConfig().places)) == (100, 5)


def test_the_papers_preset_is_as_the_paper_describes_it():
    config = planner.paper()
    search, actions = config.planner, config.problem.actions
    assert (search.horizon, search.sequences, config.max_steps) == (3, 30, 10)
    assert (search.guided_fraction, search.unseen_contact_penalty, search.crowding_weight) == (0.0, 0.0, 0.0)
    assert not search.move_target
    assert search.draws == (8, 8)
    assert search.as_in_paper
    assert config.problem.existence.as_in_paper
    assert actions.as_in_paper
    assert (actions.push_distances, set(actions.actions)) == ((0.05, 0.10, 0.15), {"push", "pick-and-place"})
    assert actions.push_directions == (np.pi / 2, -np.pi / 2)
    assert config.problem.grasps.tilts == config.problem.retrieval.tilts == (np.radians(20),)
    assert (config.problem.retrieval.yaws, config.problem.retrieval.max_yaw) == (25, np.radians(45))
    assert actions.grasps.tilts == (np.radians(20),)
    assert config.trials == "none"
    # Where the paper is silent.
    assert search.gamma == planner.standard().planner.gamma
    assert planner.paper(gamma=0.5).planner.gamma == 0.5


def test_what_is_in_the_way_of_a_grasp_weighs_as_much_as_is_said(problem):
    belief = planner.initial_belief(problem)
    rows = pairs(problem.grasps, belief.grasps.feasible)
    hits = jnp.zeros((rows.pose.shape[0], 9), bool).at[:, :2].set(True)
    exists = jnp.arange(problem.poses.shape[0]) % 7 == 0
    state = present_state(problem, belief, superquadric.empty(8), PlannerConfig()).replace(exists=exists, hits=hits)

    def cost(objective, known):
        return float(objective.cost(problem, known, state, Weights()))

    assert cost(SearchForGrasp(), belief) > cost(SearchAndGrasp(), belief) == exists.sum()
    # Once it is found, the two differ in the pose itself alone.
    found_belief = belief.replace(found=jnp.array(True))
    assert cost(SearchForGrasp(), found_belief) == pytest.approx(cost(SearchAndGrasp(), found_belief) + 1.0)


def test_later_actions_are_drawn_in_the_predicted_scene(problem):
    _, objects = load("first-light")
    belief, shift = planner.initial_belief(problem), jnp.float32([0.0, 0.05, 0.0])

    def draws_where_it_stands(key, problem, state, possible, weights, wanted):
        T = jnp.eye(4).at[:3, 3].set(state.scene.position[0])
        action = no_action().replace(kind=jnp.int32(ActionKind.PUSH), T_world_gripper=T)
        return Sample(action, jnp.int32(0))

    def moves(problem, state, sample, first):
        scene = state.scene
        after = scene.replace(position=scene.position + shift[None])
        return Prediction(after, scene.valid, jnp.array(True))

    @dataclasses.dataclass(frozen=True)
    class Drawn(Rollout):
        """What is drawn and predicted, and nothing computed of it."""

        def update(self, state):
            return state

        def candidates(self, state):
            return state.candidates

        def cost(self, state):
            return jnp.sum(state.scene.position[0])

    config = dataclasses.replace(CONFIG, horizon=3, sequences=2)
    rollout = Drawn(problem, belief, config, evenly, moves, POLICY.objective, draws_where_it_stands)
    planned = jax.jit(lambda key, objects: plan(rollout, key, objects))(jax.random.key(0), objects)
    np.testing.assert_allclose(np.diff(planned.sequences.cost[0]), 0.05, atol=1e-6)
    starts = np.asarray(planned.sequences.actions.T_world_gripper)[0, :, 1, 3] - float(objects.position[0, 1])
    np.testing.assert_allclose(starts, [0.0, 0.05, 0.1], atol=1e-6)


def test_an_action_is_drawn_again_until_it_is_possible_and_the_first_more_often(problem, root):
    belief = planner.initial_belief(problem)

    def counts(key, problem, state, possible, weights, wanted):
        return Sample(no_action().replace(q7=jax.random.uniform(key)), jnp.int32(0))

    def seldom(problem, state, sample, first):
        return Prediction(state.scene, state.scene.valid, sample.action.q7 < 0.3)

    def share(first, **changes):
        config = dataclasses.replace(CONFIG, **changes)
        rollout = Rollout(problem, belief, config, evenly, seldom, POLICY.objective, counts)
        keys = jax.random.split(jax.random.key(0), 4000)
        # Compiled, all else that an action comes with is left out.
        alive = jax.jit(jax.vmap(lambda key: rollout.act(first, root, key)[0]["alive"]))(keys)
        return float(jnp.mean(alive))

    for as_in_paper, first, later in ((False, 4, 1), (True, 8, 8)):
        assert share(True, as_in_paper=as_in_paper) == pytest.approx(1 - 0.7**first, abs=0.03)
        assert share(False, as_in_paper=as_in_paper) == pytest.approx(1 - 0.7**later, abs=0.03)


@pytest.mark.parametrize("on_cpu", [True, False])
def test_an_attempt_has_something_to_do_only_where_no_other_was_possible(problem, root, monkeypatch, on_cpu):
    monkeypatch.setattr(rollouts, "on_cpu", lambda: on_cpu)
    rows, draws, rounds = 200, 4, []

    def counts(key, problem, state, possible, weights, wanted):
        return Sample(no_action().replace(q7=jax.random.uniform(key), object=wanted.astype(jnp.int32)), jnp.int32(0))

    def note(q7, wanted):
        rounds.append((q7 < 0.3, wanted == 1))
        return q7 < 0.3

    def seldom(problem, state, sample, first):
        seen = (sample.action.q7, sample.action.object)
        possible = jax.pure_callback(note, jax.ShapeDtypeStruct((), bool), *seen, vmap_method="broadcast_all")
        return Prediction(state.scene, state.scene.valid, possible)

    rollout = Rollout(problem, planner.initial_belief(problem), CONFIG, evenly, seldom, POLICY.objective, counts)
    keys = jax.random.split(jax.random.key(0), rows)
    # The last is a sequence that has ended.
    states = repeated(root, rows).replace(alive=jnp.arange(rows) < rows - 1)
    act = jax.jit(jax.vmap(lambda state, key: rollout.act(True, state, key)[0]["alive"]))
    acted = np.asarray(act(states, keys))
    works, busy = (np.stack(part) for part in zip(*rounds, strict=True))
    alive = np.asarray(states.alive)
    if on_cpu:
        # One after the other: only those go on that have no action yet.
        has_action = np.cumsum(works, axis=0) > 0
        assert busy.shape == (draws, rows)
        np.testing.assert_array_equal(busy[0], alive)
        np.testing.assert_array_equal(busy[1:], alive & ~has_action[:-1])
        assert 0 < busy[-1].sum() < busy[0].sum() / 2
    else:
        # The first, and then all others at once.
        first, others = works[0][:, 0], works[1]
        np.testing.assert_array_equal(busy[0], alive[:, None] & [True, False, False])
        np.testing.assert_array_equal(busy[1], np.repeat((alive & ~first)[:, None], draws - 1, axis=1))
        has_action = [first | others.any(axis=1)]
    np.testing.assert_array_equal(acted, has_action[-1] & alive)


def test_options_are_changed_by_name_and_survive_json():
    config = planner.standard(gamma=0.5, push_model="quasi-static", push_distances=(0.05, 0.2), max_steps=3)
    again = planner.Config().with_options(**json.loads(json.dumps(config.options())))
    assert again == config
    with pytest.raises(InputError, match="option focus is unknown; there are gamma, "):
        planner.standard(focus=0.3)


def test_prefix_values_are_equation_2():
    gamma, cost = 0.9, np.array([20.0, 15.0, 18.0, 3.0])
    # The right-hand side of equation 2, for every T.
    expected = [
        gamma**T * cost[T] + (1 - gamma) / gamma * sum(gamma**t * cost[t] for t in range(1, T + 1)) - cost[0]
        for T in (1, 2, 3)
    ]
    for acted, best in (([True] * 3, np.argmin(expected)), ([True, False, False], 0)):
        value, length = prefix_values(jnp.float32(cost), jnp.zeros(3), jnp.array(acted), gamma)
        np.testing.assert_allclose(value, expected[best], rtol=1e-5)
        assert int(length) == best + 1
    nothing, _ = prefix_values(jnp.float32(cost), jnp.zeros(3), jnp.zeros(3, bool), gamma)
    assert np.isinf(nothing)


def test_what_is_in_the_way_alone_matters_most():
    rng = np.random.default_rng(0)
    rows, counts = rng.random((200, 6)) < 0.3, rng.random(200) < 0.7
    rows[:, 4] = False
    expected = np.zeros(6)
    for row in rows[counts]:
        expected[row] += ALONE ** (1.0 - row.sum())
    share = np.asarray(blame(jnp.asarray(rows), jnp.asarray(counts)))
    np.testing.assert_allclose(share, expected / expected.sum(), rtol=1e-5)
    assert share[4] == 0
    assert not np.asarray(blame(jnp.asarray(rows), jnp.zeros(200, bool))).any()


def test_the_share_of_what_cannot_be_moved_yet_goes_to_what_is_in_the_way(root):
    rng = np.random.default_rng(0)
    n = root.scene.capacity
    given = jax.jit(propagate_blame, static_argnames="partly")
    for chance, partly in ((0.1, False), (0.5, False), (0.8, False), (0.1, True)):
        by_kind = [
            w.replace(reached=rng.random(w.reached.shape) < 0.05, hits=rng.random(w.hits.shape) < chance)
            for w in root.candidates
        ]
        state = root.replace(candidates=tuple(by_kind), available=jnp.asarray(rng.random(n) < 0.8))
        able, share = np.asarray(state.able), rng.random(n)
        hits_of = [[] for _ in range(n)]
        for kind, can in zip(by_kind, able, strict=True):
            for i in range(n):
                hits_of[i] += [
                    hits for hits, at in zip(kind.hits[i], kind.reached[i], strict=True) if can[i] and at.any()
                ]
        blocked = np.array([np.mean(list(map(np.any, w))) if w else 1.0 for w in hits_of])
        expected = share.astype(float)
        stuck = np.where(able.any(axis=0), blocked if partly else blocked == 1.0, 0.0)
        for _ in range(DEPTH):
            held, expected = stuck * expected, (1.0 - stuck) * expected
            for i in np.flatnonzero(stuck):
                blames = sum((np.where(hits, ALONE ** (1.0 - hits.sum()), 0.0) for hits in hits_of[i]), np.zeros(n))
                expected += held[i] * blames / max(blames.sum(), 1e-12)
        np.testing.assert_allclose(given(state, jnp.float32(share), partly), expected, rtol=1e-4, atol=1e-6)
        assert chance < 0.8 or stuck.any()
        assert not partly or ((stuck > 0.0) & (stuck < 1.0)).any()


def test_draws_go_to_what_hides_the_target(decision, root, problem):
    _, belief, _ = decision
    weights_of = jax.jit(lambda *state: sampling_weights(*state[:2], POLICY.objective, 0.7, state[2]))
    weights, valid = jax.device_get((weights_of(problem, belief, root), root.available))
    assert weights.sum() == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(weights[~valid], (1.0 - CONFIG.guided_fraction) / len(weights), rtol=1e-5)
    assert (weights[valid] > weights[~valid].max()).any()


def test_a_decision_is_the_first_action_of_the_best_sequence(decision):
    _, belief, plan = decision
    values = np.asarray(plan.sequences.value)
    assert np.all(values[:-1] <= values[1:])
    assert float(plan.value) == values[0]
    assert int(plan.action.kind) == int(plan.sequences.actions.kind[0, 0]) != ActionKind.NONE
    assert float(plan.cost) >= float(jnp.sum(belief.exists))


def test_an_object_moves_at_most_once_in_a_sequence(decision):
    actions = decision[2].sequences.actions
    for kinds, objects in zip(np.asarray(actions.kind), np.asarray(actions.object), strict=True):
        moved = objects[kinds != ActionKind.NONE]
        assert len(set(moved.tolist())) == len(moved)


def test_the_same_key_and_state_give_the_same_decision(decision, problem):
    objects, belief, plan = decision
    again = POLICY(jax.random.key(0), problem, belief, seen(objects))
    jax.tree.map(np.testing.assert_array_equal, plan, again)


def test_nothing_is_compiled_anew_when_objects_come_go_or_move(decision, problem):
    objects = decision[0]
    functions = (*PARTS_OF_A_PLAN, planner.update_belief, best_grasp)
    counts = [f._cache_size() for f in functions]
    assert all(counts[:-1])
    fewer = objects.replace(valid=objects.valid.at[0].set(False))
    moved = objects.replace(position=objects.position.at[1].add(jnp.float32([0.01, 0.02, 0.0])))
    _, other = load("crowded-shelf")
    for scene in (fewer, moved, other):
        POLICY(jax.random.key(1), problem, look(problem, scene), seen(scene))
    found_belief = look(problem, objects, True, (0.7, 0.2, 0.0))
    planned = POLICY(jax.random.key(1), problem, found_belief, seen(objects, True, (0.7, 0.2, 0.0)))
    assert float(planned.cost) < superquadric.empty(8).capacity + 3
    best_grasp(problem.target_grasps, fewer, jnp.float32([0.6, 0.0, 0.0]))
    after = [f._cache_size() for f in functions]
    assert after[:-1] == counts[:-1]
    assert after[-1] <= counts[-1] + 1


@pytest.mark.slow
def test_candidate_poses_do_not_count_once_a_target_is_found_that_stays(decision, problem):
    objects, pose = decision[0], (0.7, 0.2, 0.0)
    belief = look(problem, objects, True, pose)
    key = jax.random.key(3)
    with_all = policies._plan(POLICY._planning, key, problem, belief, objects)
    alone = POLICY.planned(key, problem, belief, seen(objects, True, pose))
    jax.tree.map(np.testing.assert_array_equal, alone, with_all)
    # One that may be pushed is judged where it would then be.
    pushed = POLICY.replace(config=dataclasses.replace(POLICY.config, move_target=True))
    assert pushed._planned_with(problem, belief)[1].exists.shape == belief.exists.shape


def test_continuous_settings_are_data_and_compile_nothing(decision, problem):
    objects, belief, usual = decision
    counts = [part._cache_size() for part in PARTS_OF_A_PLAN]
    changes = {"gamma": 0.5, "unseen_contact_penalty": 0.0, "guided_fraction": 0.1}
    other = planner.search_for_grasp(**changes, crowding_weight=0.0)
    changed = other(jax.random.key(0), problem, belief, seen(objects))
    assert [part._cache_size() for part in PARTS_OF_A_PLAN] == counts
    assert float(changed.cost) != float(usual.cost)
    assert not np.array_equal(np.asarray(changed.sequences.value), np.asarray(usual.sequences.value))


def test_a_found_target_is_one_pose_and_stays_found_where_it_may_be_hidden(problem):
    hidden, objects = load("first-light")
    pose = (*hidden.target.position[:2], 0.0)
    belief = look(problem, objects, True, pose)
    assert bool(belief.found)
    hidden_again = planner.update_belief(problem, belief, seen(objects))
    assert bool(hidden_again.found)
    np.testing.assert_allclose(hidden_again.found_pose, pose, atol=1e-6)
    in_the_open = look(problem, objects, True, (0.7, 0.2, 0.0))
    assert not bool(planner.update_belief(problem, in_the_open, seen(objects)).found)


def test_the_state_that_a_plan_begins_with_has_the_shapes_of_every_other(decision, root, problem):
    objects, belief, _ = decision
    shapes = lambda tree: jax.tree.map(lambda a: (a.shape, a.dtype), tree)  # noqa: E731
    assert shapes(root) == shapes(rollout_of(problem, belief).root(objects))


@pytest.mark.slow
def test_a_decision_is_the_same_in_the_blocks_of_a_gpu(decision, problem, monkeypatch):
    objects, belief, plan = decision
    monkeypatch.setattr(masked, "on_cpu", lambda: False)
    again = jax.jit(lambda key: policies._plan.__wrapped__(POLICY, key, problem, belief, objects))(jax.random.key(0))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), plan, again)


@dataclasses.dataclass(frozen=True)
class Shaky:
    """The quasi-static model, which fears that everything it moves may topple, or does not know what becomes of it."""

    chance: float
    residual: float

    def __call__(self, shelf, scene, pusher, T_world_gripper, displacement, q7):
        motion = QuasiStatic()(shelf, scene, pusher, T_world_gripper, displacement, q7)
        feared = jnp.where(motion.moved, self.chance, 0.0)
        return motion.replace(topples=jnp.maximum(motion.topples, feared), residual=motion.residual + self.residual)


# The first is executed as ever, and the second nevertheless.
CHANCES = (0.0, 0.4, 0.6, np.nan, 0.0, 0.0)
RESIDUALS = (0.0, 0.0, 0.0, 0.0, np.nan, np.inf)


def foreseen(model):
    return PredictByKind(model, model)


@pytest.fixture(scope="module")
def drawn(decision, root, problem):
    """What is drawn first in many sequences, and what models say of it."""
    _, belief, _ = decision

    @jax.jit
    def draw(problem, belief, root, keys):
        def one(key):
            rollout = POLICY.rollout(problem, belief)
            possible, weights = rollout.possible(root), rollout.weights(root)
            sample = rollout.propose(key, problem, root, possible, weights, jnp.array(True))
            # One after the other: a model is static, and must not hold what is traced.
            models = [Shaky(*shaky) for shaky in zip(CHANCES, RESIDUALS, strict=True)]
            return sample, jnp.stack([foreseen(model)(problem, root, sample, True).possible for model in models])

        return jax.vmap(one)(keys)

    return jax.device_get(draw(problem, belief, root, jax.random.split(jax.random.key(0), 30)))


@pytest.mark.slow
def test_pushes_may_topple_what_they_move(drawn):
    sample, possible = drawn
    sure, feared = possible[:, 0], possible[:, 1]
    assert {ActionKind.PUSH, ActionKind.PICK_AND_PLACE} <= set(sample.action.kind[sure].tolist())
    np.testing.assert_array_equal(feared, sure)


def penalties_of(rollout, root, keys):
    act = jax.jit(jax.vmap(lambda key: rollout.act(True, root, key)[2]))
    return jax.device_get(act(keys))


def test_what_may_touch_the_target_has_a_penalty(decision, root, problem):
    action = jax.tree.map(lambda a: a[0, 0], decision[2].sequences.actions)

    def somewhere(key, *_):
        x, y = jax.random.uniform(key, (2,), minval=jnp.array([0.45, -0.2]), maxval=jnp.array([0.75, 0.4]))
        places = jnp.broadcast_to(jnp.eye(4).at[:3, 3].set(jnp.array([x, y, 0.45])), (5, 4, 4))
        return Sample(action, jnp.int32(0), places, places)

    policy = dataclasses.replace(
        POLICY,
        config=dataclasses.replace(CONFIG, unseen_contact_penalty=0.5),
        predict=lambda _, state, *__: Prediction(state.scene, state.scene.valid, jnp.array(True)),
    )
    keys = jax.random.split(jax.random.key(0), 20)
    belief = decision[1]
    possible = possible_space(problem, belief, root.exists)
    probability = jax.jit(jax.vmap(lambda s: contact_probability(problem.space, root.scene, possible, s)))
    drawn = jax.vmap(lambda key: somewhere(jax.random.fold_in(key, 0)))(keys)
    share = np.asarray(probability(drawn))
    assert len(np.unique(share[:, 0])) > 2
    rollout = dataclasses.replace(rollout_of(problem, belief, policy), propose=somewhere)
    np.testing.assert_allclose(penalties_of(rollout, root, keys), 0.5 * share, rtol=1e-6)
    rollout = dataclasses.replace(rollout, propose=lambda *_: Sample(action, jnp.int32(0)))
    assert not penalties_of(rollout, root, keys).any()


def test_what_is_dear_is_not_chosen():
    # A push that would make J half of what it is, and a pick that takes off a quarter.
    cost = jnp.float32([[20.0, 10.0], [20.0, 15.0]])
    for share, best in ((0.0, 0), (0.5 * 0.4, 0), (2.0 * 0.4, 1)):
        penalty = jnp.float32([[share * 20.0], [0.0]])
        value = [prefix_values(c, h, jnp.array([True]), 0.9)[0] for c, h in zip(cost, penalty, strict=True)]
        assert int(np.argmin(value)) == best


def test_a_risk_is_taken_only_where_nothing_else_gains():
    acted = jnp.ones((2, 1), bool)
    # The first sequence gains 10 at a penalty of 19 of one kind or the other; the second 0.1 or 4 at none.
    for kind, (safe, best, value) in itertools.product((0, 1), ((19.9, 0, -10.0), (16.0, 1, -4.0))):
        risky = jnp.zeros((2, 1, 2)).at[0, 0, kind].set(19.0)
        values, length = sequence_values(jnp.float32([[20.0, 10.0], [20.0, safe]]), risky, acted, 0.9)
        assert int(jnp.argmin(values)) == best
        assert float(values[best]) == pytest.approx(value)
        assert length.tolist() == [1, 1]


def test_where_every_action_sweeps_what_was_not_measured_the_target_is_still_not_touched():
    # Both sweep it; the first gains 10 and would surely touch the target, the second gains 4 and would not.
    penalty = jnp.float32([[[20.0, 20.0]], [[0.0, 20.0]]])
    values, _ = sequence_values(jnp.float32([[20.0, 10.0], [20.0, 16.0]]), penalty, jnp.ones((2, 1), bool), 0.9)
    assert int(jnp.argmin(values)) == 1
    assert float(values[1]) == pytest.approx(-4.0)


@pytest.mark.slow
def test_a_push_that_likely_topples_something_or_is_not_understood_is_ruled_out(drawn):
    sample, possible = drawn
    for row in range(2, 6):
        assert set(sample.action.kind[possible[:, row]].tolist()) == {ActionKind.PICK_AND_PLACE}


def test_an_empty_shelf_leaves_nothing_to_do(problem):
    empty = superquadric.empty(8)
    plan = POLICY(jax.random.key(0), problem, look(problem, empty), seen(empty))
    assert int(plan.action.kind) == ActionKind.NONE
    assert np.all(np.isinf(plan.sequences.value))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gamma": 0.0}, r"gamma 0.0 is outside \(0, 1\]"),
        ({"gamma": 1.5}, "gamma 1.5"),
        ({"horizon": 0}, "horizon 0 must be at least 1"),
        ({"sequences": 0}, "sequences 0"),
        ({"guided_fraction": 0.5}, "option guided_fraction is unknown; there are gamma, "),
        ({"max_steps": 0}, "max_steps 0 must be at least 1"),
        ({"push_model": "guess"}, 'push model "guess" is unknown; use quasi-static, learned, physics'),
        ({"actions": ()}, "one or more kinds of action"),
        ({"trials": "guess"}, 'trials "guess" is unknown; use none, physics'),
    ],
)
def test_impossible_options_are_refused_with_what_would_do(changes, message):
    with pytest.raises(InputError, match=message):
        planner.standard(**changes)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "guess",
            'policy "guess" is unknown; use search-for-grasp, search-and-grasp, random, greedy',
        ),
        ("no_such_lab.policies:Mine", "cannot be imported .*no_such_lab"),
        ("mechsearch_jax.planner:Nobody", "cannot be imported .*Nobody"),
        ("mechsearch_jax.planner:OPTIONS", "is not callable"),
    ],
)
def test_policies_that_are_not_there_are_named(name, message):
    with pytest.raises(InputError, match=message):
        planner.policy_factory(name)


def test_policies_are_found_by_name_and_by_import_path():
    assert planner.policy_factory("search-and-grasp") is planner.search_and_grasp
    assert planner.policy_factory("mechsearch_jax.planner.policies:random_action") is planner.random_action
    for factory in planner.POLICIES.values():
        assert factory(CONFIG, push_model=QuasiStatic()).predict.push_model == QuasiStatic()


def test_a_found_target_that_nothing_blocks_is_taken_out(problem):
    nothing, pose = superquadric.empty(8), (0.6, 0.1, 0.0)
    belief = look(problem, nothing, True, pose)
    for factory, cost in (
        (planner.search_for_grasp, 1.0),
        (planner.search_and_grasp, 0.0),
        (planner.random_action, 0.0),
        (planner.greedy, 0.0),
        (planner.policy_factory("mechsearch_jax.benchmarks.policies.occlusion:most_occluding"), 0.0),
    ):
        decision = factory()(jax.random.key(0), problem, belief, seen(nothing, True, pose))
        assert int(decision.action.kind) == ActionKind.RETRIEVE
        assert float(decision.cost) == cost
        np.testing.assert_allclose(decision.action.T_world_gripper[:2, 3], pose[:2], atol=1e-5)
        assert np.isinf(decision.sequences.value).all()


@pytest.mark.slow
def test_a_random_policy_is_indifferent_and_its_actions_are_possible(decision, problem):
    objects, belief, _ = decision
    policy = planner.random_action()
    chosen = [policy(jax.random.key(i), problem, belief, seen(objects)) for i in range(12)]
    assert {float(one.cost) for one in chosen} == {0.0}
    assert all(int(one.action.kind) != ActionKind.NONE for one in chosen)
    assert len({(int(one.action.kind), int(one.action.object)) for one in chosen}) > 3


@pytest.mark.slow
def test_a_greedy_policy_leaves_the_least_of_f(decision, problem):
    objects, belief, _ = decision
    greedy = planner.greedy()(jax.random.key(0), problem, belief, seen(objects))
    left = np.asarray(greedy.sequences.cost)[:, 0]
    acted = np.asarray(greedy.sequences.actions.kind)[:, 0] != ActionKind.NONE
    assert float(greedy.cost) == float(belief.exists.sum())
    assert float(greedy.predicted_cost) == left[acted].min() < float(greedy.cost)
    assert len(set(left[acted])) > 1


@pytest.mark.slow
def test_the_papers_preset_draws_until_an_action_is_possible_and_moves_objects_again(decision, problem):
    objects, _, standard = decision
    config = planner.paper()
    paper = planner.build_problem(config=config.problem)
    belief = planner.update_belief(paper, planner.initial_belief(paper), seen(objects))
    decided = planner.search_for_grasp(config.planner)(jax.random.key(0), paper, belief, seen(objects))
    kinds = np.asarray(decided.sequences.actions.kind)
    lengths = (kinds != ActionKind.NONE).sum(axis=1)
    assert lengths.mean() > (np.asarray(standard.sequences.actions.kind) != ActionKind.NONE).sum(axis=1).mean() + 0.5
    moved = np.asarray(decided.sequences.actions.object)
    assert any(len(set(o[:n])) < n for o, n in zip(moved, lengths, strict=True))
    assert float(decided.value) < 0


@pytest.mark.slow
def test_decisions_in_a_batch_are_those_made_alone(problem):
    _, first = load("first-light")
    _, second = load("crowded-shelf")
    scenes = jax.tree.map(lambda *a: jnp.stack(a), first, second)
    beliefs = jax.tree.map(lambda *a: jnp.stack(a), look(problem, first), look(problem, second))
    keys = jnp.stack([jax.random.key(3), jax.random.key(4)])
    batch = jax.vmap(lambda k, b, s: POLICY(k, problem, b, s))
    together = jax.jit(batch)(keys, beliefs, jax.vmap(seen)(scenes))
    for i, scene in enumerate((first, second)):
        alone = POLICY(keys[i], problem, look(problem, scene), seen(scene))
        assert int(together.action.kind[i]) == int(alone.action.kind)
        assert int(together.action.object[i]) == int(alone.action.object)
        np.testing.assert_allclose(together.action.T_world_gripper[i], alone.action.T_world_gripper, atol=1e-4)
