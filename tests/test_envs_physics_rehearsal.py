"""Actions that are tried out before one is made: what would throw an object down is not done, a grasp that pushes aside
what is free to move takes the target out, and one that runs into what is not does not."""

import dataclasses
import functools
import math
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_envs_simulator import pose, push, scene, standing
from test_envs_simulator import take_out as retrieval

from mechsearch_jax.actions import ActionKind, kind_of, no_action
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.envs import physics_rehearsal
from mechsearch_jax.envs.native import NativeWorld
from mechsearch_jax.envs.outcome import Failure
from mechsearch_jax.envs.physics_rehearsal import NativeRehearsal, _world
from mechsearch_jax.envs.rehearsals import rehearsal
from mechsearch_jax.envs.snapshot import Snapshot, objects_on_the_board, true_target_pose
from mechsearch_jax.envs.trials.order import in_order
from mechsearch_jax.envs.trials.scene import TrialScene
from mechsearch_jax.envs.world import bodies_of, from_scenario
from mechsearch_jax.errors import InputError
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Config, Decision, initial_belief, search_for_grasp, update_belief
from mechsearch_jax.planner.rehearsal import TRIES, Rehearsed
from mechsearch_jax.planner.retrieval import ALIKE, ALIKE_WRIST, graspable_at, take_out, worth_trying
from mechsearch_jax.planner.rollout import no_sequences

TARGET = standing("cylinder", (0.02, 0.02, 0.05), 0.6, 0.0)
MODEL = NativeRehearsal()
OPEN = ()
# Light cylinders on either side of the target: every grasp hits one, and pushes it aside.
LOOSE = (
    *(standing("cylinder", (0.025, 0.025, 0.08), 0.6, y) for y in (-0.09, 0.09)),
    *(standing("cylinder", (0.03, 0.03, 0.06), 0.45, y) for y in (-0.13, 0.13)),
)
# Heavy boxes close to it.
FIRM = tuple(standing("box", (0.12, 0.02, 0.08), 0.55, y) for y in (-0.075, 0.075))


def begin(objects):
    return scene(*objects, target=TARGET)


def known(problem, objects):
    """The objects, and the target's pose."""
    world = from_scenario(begin(objects))
    return objects_on_the_board(Snapshot(problem.camera, problem.shelf, world)), true_target_pose(world)


EDGE = (standing("cylinder", (0.024, 0.024, 0.067), 0.43, 0.1), standing("box", (0.054, 0.025, 0.054), 0.6, 0.2))
SCENES = {"open": OPEN, "loose": LOOSE, "firm": FIRM}
PUSHES, GRASPS = (ActionKind.PUSH,), (ActionKind.RETRIEVE,)
DONE, FAILED, HARM = Rehearsed.SUCCEEDED, Rehearsed.FAILED, Rehearsed.HARMFUL


def stack(*trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


@functools.cache
def pushes():
    """Pushes in the scene EDGE: one that throws the cylinder down, one out of reach, and one that moves the box."""
    over = push(pose(0.505, 0.1 - 0.1365, 0.04, tilt=math.radians(30)), (-0.05, 0.12, 0.0))
    away = over.replace(T_world_gripper=over.T_world_gripper.at[0, 3].set(2.0))
    aside = push(pose(0.6, 0.2 - 0.025 - 0.1125, 0.04, tilt=math.radians(30)), (0.0, 0.05, 0.0), 1)
    return over, away, aside


def planned(*actions):
    """A plan whose best sequences begin with these actions."""

    def plan(rollout, key, objects):
        empty = no_sequences(rollout.config, objects)
        n = len(actions)
        shifted = objects.position[None] + jnp.arange(n, dtype=jnp.float32)[:, None, None]
        every = empty.replace(
            actions=jax.tree.map(lambda a, b: a.at[:n, 0].set(b), empty.actions, stack(*actions)),
            cost=empty.cost.at[:n, 0].set(jnp.arange(n) + 10.0),
            value=empty.value.at[:n].set(jnp.arange(n) - 10.0),
            after=empty.after.replace(position=empty.after.position.at[:n].set(shifted)),
        )
        first = jax.tree.map(lambda a: a[0, 0], every.actions)
        return Decision(first, every.value[0], jnp.float32(20.0), every.cost[0, 0], objects, every)

    return plan


def look(problem, objects, found=True):
    """The belief and what is seen."""
    seen, at = known(problem, objects)
    observation = Observation(seen, jnp.array(found), at)
    return update_belief(problem, initial_belief(problem), observation), observation


@pytest.fixture(scope="module")
def told(problem):
    """What there is to be tried in each scene to take the target out, and what becomes of it."""
    found = {}
    for name, objects in SCENES.items():
        seen, at = known(problem, objects)
        tried = worth_trying(problem, seen, at)
        found[name] = tried, MODEL(problem, seen, at, True, tried.action, tried.feasible, GRASPS)
    return found


def test_the_grasps_that_are_tried_differ_and_the_clearest_come_first(problem, told):
    for name, (tried, _) in told.items():
        way, q7 = np.asarray(tried.action.T_world_gripper[:, :3, 2]), np.asarray(tried.action.q7)
        assert len(q7) == TRIES
        apart = np.arccos(np.clip(way @ way.T, -1.0, 1.0))
        wrist = np.abs(q7[:, None] - q7[None])
        alike = (apart < ALIKE - 1e-3) & (wrist < ALIKE_WRIST - 1e-3) & ~np.eye(TRIES, dtype=bool)
        assert not alike.any(), name
        best = graspable_at(problem, *known(problem, SCENES[name]))
        assert bool(tried.success[0]) == bool(best.success)
    first = told["open"][0].action.T_world_gripper[0]
    np.testing.assert_array_equal(first, graspable_at(problem, *known(problem, OPEN)).action.T_world_gripper)


def test_what_is_free_to_move_may_be_hit_and_what_is_not_may_not(told):
    assert (told["loose"][0].hits > 0).all()
    assert (told["loose"][1] == DONE).any()
    assert (told["firm"][0].hits > 0).all()
    assert not (told["firm"][1] == DONE).any()
    assert told["open"][1][0] == DONE


def test_what_the_rehearsal_says_is_what_the_simulator_does(problem, told):
    world = NativeWorld()
    for name in ("loose", "firm"):
        tried, said = told[name]
        world.reset(begin(SCENES[name]))
        first = int(jnp.argmax(said))
        outcome = world.execute(jax.tree.map(lambda a, i=first: a[i], tried.action))
        assert bool(outcome.retrieved) == bool(said[first] == DONE)


def test_what_throws_an_object_down_does_harm_and_what_is_out_of_reach_fails(problem):
    over, away, aside = pushes()
    seen, at = known(problem, EDGE)
    all_asked = jnp.ones(3, bool)
    assert MODEL(problem, seen, at, False, stack(over, away, aside), all_asked, PUSHES).tolist() == [HARM, FAILED, DONE]
    # After what succeeds nothing is tried any more, with one thread.
    alone = NativeRehearsal(threads=1)
    assert alone(problem, seen, at, False, stack(aside, over, away), all_asked, PUSHES).tolist() == [DONE, HARM, HARM]
    world = NativeWorld()
    world.reset(begin(EDGE))
    assert np.asarray(world.execute(over).fallen).tolist() == [True] + [False] * 8


def test_a_target_that_is_found_must_not_fall_and_one_that_is_not_is_not_there(problem):
    seen, at = known(problem, OPEN)
    # High against the target, from its side.
    tip = push(pose(0.63, -0.02 - 0.1125, 0.09, tilt=math.radians(30)), (0.0, 0.1, 0.0))
    asked = jnp.ones(1, bool)
    assert MODEL(problem, seen, at, True, stack(tip), asked, PUSHES).tolist() == [HARM]
    assert MODEL(problem, seen, at, False, stack(tip), asked, PUSHES).tolist() == [DONE]


def test_the_policy_does_the_first_thing_that_goes_well(problem):
    over, away, aside = pushes()
    belief, observation = look(problem, EDGE, found=False)
    for actions, chosen in (((aside, over), 0), ((over, aside), 1), ((over, away, aside), 2), ((over, away), 1)):
        policy = search_for_grasp(rehearsal=MODEL).replace(plan=planned(*actions))
        decision = policy(jax.random.key(0), problem, belief, observation)
        assert int(decision.action.kind) == ActionKind.PUSH
        np.testing.assert_array_equal(decision.action.T_world_gripper, actions[chosen].T_world_gripper)
        assert (float(decision.value), float(decision.predicted_cost)) == (chosen - 10.0, chosen + 10.0)
        before = observation.objects.position
        np.testing.assert_allclose(decision.predicted.position - before, chosen if chosen else 0.0, atol=1e-6)
    plain = search_for_grasp().replace(plan=planned(over, aside))
    done = plain(jax.random.key(0), problem, belief, observation)
    np.testing.assert_array_equal(done.action.T_world_gripper, over.T_world_gripper)


def says(*codes):
    """A rehearsal that says the same of the first actions, whatever they are and whether or not it is asked."""

    def rehearsal(problem, scene, pose, found, actions, asked, kinds):
        return jnp.full(asked.shape, HARM).at[: len(codes)].set(jnp.array(codes))

    return rehearsal


def test_where_everything_does_harm_nothing_is_done(problem):
    over, *_ = pushes()
    belief, observation = look(problem, EDGE, found=False)
    for actions, refused in (((over, over), 2), ((no_action(),), 0)):
        policy = search_for_grasp(rehearsal=MODEL).replace(plan=planned(*actions))
        decision = policy(jax.random.key(0), problem, belief, observation)
        assert (int(decision.action.kind), int(decision.refused)) == (ActionKind.NONE, refused)
        assert (float(decision.value), float(decision.predicted_cost)) == (math.inf, 20.0)
        jax.tree.map(np.testing.assert_array_equal, decision.predicted, observation.objects)
        assert (decision.sequences.actions.kind == ActionKind.NONE).all()


def test_what_does_harm_is_refused_and_what_is_made_comes_first(problem):
    over, _, aside = pushes()
    belief, observation = look(problem, EDGE, found=False)
    plan = planned(over, aside, over, aside)
    for codes, order, refused in (
        ((DONE, HARM, HARM, HARM), (0, 1, 2, 3), 0),
        ((HARM, FAILED, DONE, HARM), (2, 1, 3), 1),
        ((FAILED, HARM, FAILED, HARM), (0, 2), 2),
    ):
        policy = search_for_grasp(rehearsal=says(*codes)).replace(plan=plan)
        decision = policy(jax.random.key(0), problem, belief, observation)
        value, after = np.asarray(decision.sequences.value), decision.sequences.after
        assert value[: len(order)].tolist() == [i - 10.0 for i in order]
        assert np.isinf(value[len(order) :]).all()
        assert (decision.sequences.actions.kind[len(order) :] == ActionKind.NONE).all()
        assert int(decision.refused) == refused
        jax.tree.map(
            np.testing.assert_array_equal, decision.action, jax.tree.map(lambda a: a[0, 0], decision.sequences.actions)
        )
        jax.tree.map(np.testing.assert_array_equal, decision.predicted, jax.tree.map(lambda a: a[0], after))


def test_what_is_said_of_what_was_not_asked_for_counts_for_nothing(problem):
    _, _, aside = pushes()
    belief, observation = look(problem, EDGE, found=False)
    policy = search_for_grasp(rehearsal=says(FAILED, DONE)).replace(plan=planned(aside))
    decision = policy(jax.random.key(0), problem, belief, observation)
    assert (int(decision.action.kind), float(decision.value)) == (ActionKind.PUSH, -10.0)
    seen, at = known(problem, FIRM)
    far = at.at[0].set(3.0)
    assert not take_out(says(*[DONE] * TRIES), problem, seen, far).success


def test_where_no_grasp_succeeds_one_that_hits_nothing_is_made(problem):
    for objects, success in ((OPEN, True), (FIRM, False)):
        seen, at = known(problem, objects)
        told, plain = take_out(says(*[FAILED] * TRIES), problem, seen, at), graspable_at(problem, seen, at)
        assert bool(told.success) == success == bool(plain.success)
        np.testing.assert_array_equal(told.action.T_world_gripper, plain.action.T_world_gripper)


def test_a_simulation_that_diverges_at_any_time_does_harm(problem):
    seen, at = known(problem, EDGE)
    actions, asked = stack(pushes()[2]), jnp.ones(1, bool)
    # It does as everything comes to rest, long before the push is over.
    thrown = seen.replace(position=seen.position.at[0, 0].set(1e11))
    assert MODEL(problem, thrown, at, False, actions, asked, PUSHES).tolist() == [HARM]
    world = NativeWorld()
    world.reset(begin(EDGE))
    world._data.qvel[-1] = 1e12
    before = world._data.qpos.copy()
    outcome = world.execute(pushes()[2])
    assert Failure(int(outcome.failure)) is Failure.UNSTABLE
    np.testing.assert_array_equal(world._data.qpos, before)


def test_the_hand_of_the_problem_is_the_one_that_is_rehearsed(problem):
    seen, at = known(problem, EDGE)
    actions, asked = stack(pushes()[2]), jnp.ones(1, bool)
    heard = []

    def tried_alone(shelf, how, *rest):
        heard.append(how.simulation.motion.gripper)
        return np.full(1, DONE, np.int32)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(physics_rehearsal, "_tried_alone", tried_alone)
        other = problem.replace(gripper=dataclasses.replace(problem.gripper, approach=0.09))
        for here in (problem, other):
            MODEL(here, seen, at, False, actions, asked, PUSHES)
    assert heard == [problem.gripper, other.gripper]


def test_a_scene_that_cannot_be_built_costs_its_own_row_alone(problem, monkeypatch):
    seen, at = known(problem, EDGE)
    built = NativeWorld.place

    def place(world, bodies, friction):
        if bodies[0].position[0] > 0.5:
            raise ValueError("no such body")
        built(world, bodies, friction)

    monkeypatch.setattr(NativeWorld, "place", place)
    other = seen.replace(position=seen.position.at[0, 0].set(0.55))
    actions, asked = stack(pushes()[2]), jnp.ones(1, bool)
    said = jax.vmap(lambda here: MODEL(problem, here, at, False, actions, asked, PUSHES))(stack(other, seen))
    assert said.tolist() == [[HARM], [DONE]]


def test_friction(problem):
    seen, at = known(problem, EDGE)
    actions, asked = stack(pushes()[2]), jnp.ones(1, bool)
    # What is rough holds the hand up, and what is rougher still tips over.
    for friction, said in ((1.0, DONE), (4.0, FAILED), (20.0, HARM)):
        model = NativeRehearsal(friction=friction)
        assert model(problem, seen, at, False, actions, asked, PUSHES).tolist() == [said]
    for wrong in (0.0, -1.0, math.nan):
        with pytest.raises(InputError, match="must be a positive number"):
            NativeRehearsal(friction=wrong)


def test_more_objects_than_the_simulator_has_slots_for_are_refused(problem):
    with pytest.raises(InputError, match="slots for 8 objects, not for 9"):
        MODEL(problem, empty(9), jnp.zeros(3), False, stack(no_action()), jnp.ones(1, bool), PUSHES)


def test_the_policy_takes_out_what_can_be_and_searches_on_where_nothing_can(problem):
    _, _, aside = pushes()
    for objects, takes in ((LOOSE, True), (FIRM, False), (OPEN, True)):
        belief, observation = look(problem, objects)
        seen, at = observation.objects, observation.target_pose
        assert bool(take_out(MODEL, problem, seen, at).success) == takes
        assert bool(take_out(None, problem, seen, at).success) == (objects is OPEN)
        policies = [search_for_grasp(rehearsal=r).replace(plan=planned(aside)) for r in (MODEL, None)]
        kinds = [int(policy(jax.random.key(0), problem, belief, observation).action.kind) for policy in policies]
        assert [kind == ActionKind.RETRIEVE for kind in kinds] == [takes, objects is OPEN]


@pytest.mark.slow
def test_a_policy_that_rehearses_decides_the_same_alone_and_mapped_over(problem):
    over, _, aside = pushes()
    policy = search_for_grasp(rehearsal=MODEL).replace(plan=planned(over, aside))
    rows = [look(problem, EDGE, found=False), look(problem, LOOSE), look(problem, FIRM)]
    beliefs, seen = stack(*rows)
    keys = jax.random.split(jax.random.key(0), len(rows))
    mapped = jax.jit(jax.vmap(lambda *row: policy(row[0], problem, *row[1:])))(keys, beliefs, seen)
    for i, (belief, observation) in enumerate(rows):
        alone = policy(keys[i], problem, belief, observation)
        assert int(alone.action.kind) == int(mapped.action.kind[i])
        np.testing.assert_allclose(alone.action.T_world_gripper, mapped.action.T_world_gripper[i], atol=1e-6)
    assert mapped.action.kind.tolist()[:2] == [ActionKind.PUSH, ActionKind.RETRIEVE]


def test_mapped_over_it_says_the_same_and_nothing_where_it_is_not_asked(problem, told):
    over, away, aside = pushes()
    scenes = stack(*(known(problem, objects) for objects in (EDGE, LOOSE, FIRM)))
    grasps = jax.tree.map(lambda a: a[:3], told["loose"][0].action)
    actions = stack(stack(over, away, aside), grasps, grasps)
    asked = jnp.array([[True, True, True], [True, True, True], [False, False, False]])
    found = jnp.array([False, True, True])
    mapped = jax.jit(jax.vmap(lambda scene, found, *row: MODEL(problem, *scene, found, *row, PUSHES + GRASPS)))(
        scenes, found, actions, asked
    )
    assert mapped[0].tolist() == [HARM, FAILED, DONE]
    assert int(jnp.argmax(mapped[1])) == int(jnp.argmax(told["loose"][1]))
    assert mapped[2].tolist() == [HARM, HARM, HARM]


def test_a_scene_that_is_none_is_harmed_and_leaves_the_others_alone(problem):
    seen, at = known(problem, EDGE)
    broken = seen.replace(position=seen.position.at[0, 0].set(jnp.nan))
    actions, asked = stack(pushes()[2]), jnp.ones(1, bool)
    said = jax.vmap(lambda here: MODEL(problem, here, at, False, actions, asked, PUSHES))(stack(broken, seen))
    assert said.tolist() == [[HARM], [DONE]]


@pytest.mark.parametrize("threads", [1, 3, 16])
def test_the_first_that_succeeds_is_the_same_with_any_number_of_threads(threads):
    made, tried = [], []

    def attempt(scene, row, i, needed):
        assert scene == 10 * row
        tried.append((row, i))
        time.sleep(0.001)
        if not needed():
            return None
        return DONE if i >= (3, 6)[row] else FAILED

    def make(row):
        made.append(row)
        return 10 * row

    said = in_order(np.ones((2, TRIES), bool), threads, make, attempt)
    assert sorted(made) == [0, 1]
    assert said.argmax(axis=1).tolist() == [3, 6]
    assert (said.max(axis=1) == DONE).all()
    assert said[0, :3].tolist() == [FAILED] * 3
    assert said[1, :6].tolist() == [FAILED] * 6
    # The best of both scenes come before what is next.
    assert {tried[0], tried[1]} == {(0, 0), (1, 0)}
    assert threads > 1 or len(tried) == 4 + 7


def test_what_nobody_waits_for_any_more_is_stopped():
    stopped, late = [], threading.Event()

    def attempt(scene, row, i, needed):
        if i == 0:
            late.wait(10.0)
            return DONE
        late.set()
        while needed():
            time.sleep(0.001)
        stopped.append(i)
        return None

    said = in_order(np.ones((1, 3), bool), 2, lambda row: None, attempt)
    assert (said.tolist(), stopped) == ([[DONE, HARM, HARM]], [1])


def test_a_scene_is_made_once_and_trying_does_not_change_it(problem):
    seen, at = known(problem, EDGE)
    world = jax.device_get(_world(problem, seen, at, jnp.array(False)))
    scene = TrialScene(problem.shelf, MODEL.simulation, bodies_of(world))
    kind = kind_of(ActionKind.PUSH)
    over, _, aside = (jax.device_get(reference_motion(kind, a, MODEL.simulation.motion)[0]) for a in pushes())
    before = scene.positions
    for _ in range(2):
        assert scene.attempt(kind, over, 0) is HARM
        assert scene.attempt(kind, aside, 1) is DONE
        np.testing.assert_array_equal(scene.positions, before)
    assert scene.attempt(kind, aside, 1, lambda: False) is None


def test_what_is_not_touched_sleeps(problem):
    seen, at = known(problem, EDGE)
    world = jax.device_get(_world(problem, seen, at, jnp.array(False)))
    scene = TrialScene(problem.shelf, MODEL.simulation, bodies_of(world))
    # The arm alone is awake, before anything is touched.
    assert (scene._data.tree_asleep >= 0).tolist() == [False] + [True] * 9


def test_names():
    assert rehearsal("none") is None
    assert rehearsal("physics") is rehearsal("physics")
    assert rehearsal("physics") == MODEL
    for refuse in (rehearsal, lambda name: dataclasses.replace(Config(), rehearsal=name)):
        with pytest.raises(InputError, match='rehearsal "guess" is unknown; use none, physics'):
            refuse("guess")
    # What is tried out is simulated as it is executed.
    assert MODEL.simulation == NativeWorld().config
    assert retrieval(pose(0.6, 0.0, 0.05)).kind == ActionKind.RETRIEVE
