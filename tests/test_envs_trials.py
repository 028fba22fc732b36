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

from mechsearch_jax.actions import ActionKind, kind_of, no_action
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, oracle, true_target_pose
from mechsearch_jax.envs.episode.many_slots import ManySlots
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.trials import native
from mechsearch_jax.envs.trials.attempt import TrialScene
from mechsearch_jax.envs.trials.native import NativeTrials
from mechsearch_jax.envs.trials.nearby import Perturbations
from mechsearch_jax.envs.trials.order import in_order
from mechsearch_jax.envs.world.outcome import Failure
from mechsearch_jax.envs.world.world import bodies_of, from_scenario
from mechsearch_jax.grasping.retrieval import ALIKE, ALIKE_WRIST, TRIES, best_grasp, top_grasps
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Decision, initial_belief, search_for_grasp, update_belief
from mechsearch_jax.planner.rollout import no_sequences
from mechsearch_jax.planner.step import DRAWS, SearchState, decide
from mechsearch_jax.planner.trials import TrialResult, TrialScenes, choose, scenes_of
from mechsearch_jax.runtime.errors import InputError

TARGET = standing("cylinder", (0.02, 0.02, 0.05), 0.6, 0.0)
MODEL = NativeTrials()
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


def objects_and_pose(problem, objects):
    """The objects, and the target's pose."""
    world = from_scenario(begin(objects))
    return objects_on_the_board(Snapshot(problem.camera, problem.shelf, world)), true_target_pose(world)


EDGE = (standing("cylinder", (0.024, 0.024, 0.067), 0.43, 0.1), standing("box", (0.054, 0.025, 0.054), 0.6, 0.2))
SCENES = {"open": OPEN, "loose": LOOSE, "firm": FIRM}
DONE, FAILED, HARM, UNKNOWN = TrialResult.SUCCEEDED, TrialResult.FAILED, TrialResult.HARMFUL, TrialResult.UNKNOWN
UNSURE = TrialResult.UNSURE


def stack(*trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def results_of(model, problem, seen, at, found, actions, wanted=None):
    """What becomes of actions in a single scene."""
    belief = dataclasses.replace(initial_belief(problem), found=jnp.array(found), found_pose=at)
    observation = Observation(seen, jnp.array(found), at)
    one = jax.tree.map(lambda a: np.asarray(a)[None], jax.device_get((scenes_of(belief, observation), actions)))
    wanted = np.ones(one[1].kind.shape[1], bool) if wanted is None else np.asarray(wanted)
    return model(problem, *one, wanted[None])[0]


def world_of(problem, objects):
    """What is simulated of a scene whose target is not found."""
    seen, at = objects_and_pose(problem, objects)
    return jax.device_get(native.trial_world(problem.target, problem.shelf, seen, at, jnp.array(False)))


@functools.cache
def pushes():
    """Pushes in the scene EDGE: one that throws the cylinder down, one out of reach, and one that moves the box."""
    over = push(pose(0.505, 0.1 - 0.1365, 0.04, tilt=math.radians(30)), (-0.05, 0.12, 0.0))
    away = over.replace(T_world_gripper=over.T_world_gripper.at[0, 3].set(2.0))
    aside = push(pose(0.6, 0.2 - 0.025 - 0.1125, 0.04, tilt=math.radians(30)), (0.0, 0.05, 0.0), 1)
    return over, away, aside


def higher(action):
    """An action 3 cm higher, which is tried beside the other."""
    return action.replace(T_world_gripper=action.T_world_gripper.at[2, 3].add(0.03))


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
    seen, at = objects_and_pose(problem, objects)
    observation = Observation(seen, jnp.array(found), at)
    return update_belief(problem, initial_belief(problem), observation), observation


@pytest.fixture(scope="module")
def retrievals(problem):
    """What there is to be tried in each scene to take the target out, and what becomes of it."""
    by_name = {}
    for name, objects in SCENES.items():
        seen, at = objects_and_pose(problem, objects)
        tried = top_grasps(problem.target_grasps, seen, at)
        by_name[name] = tried, results_of(MODEL, problem, seen, at, True, tried.action, tried.feasible)
    return by_name


def test_the_grasps_that_are_tried_differ_and_the_clearest_come_first(problem, retrievals):
    for name, (tried, _) in retrievals.items():
        way, q7 = np.asarray(tried.action.T_world_gripper[:, :3, 2]), np.asarray(tried.action.q7)
        assert len(q7) == TRIES
        apart = np.arccos(np.clip(way @ way.T, -1.0, 1.0))
        wrist = np.abs(q7[:, None] - q7[None])
        alike = (apart < ALIKE - 1e-3) & (wrist < ALIKE_WRIST - 1e-3) & ~np.eye(TRIES, dtype=bool)
        assert not alike.any(), name
        best = best_grasp(problem.target_grasps, *objects_and_pose(problem, SCENES[name]))
        assert bool(tried.success[0]) == bool(best.success)
    first = retrievals["open"][0].action.T_world_gripper[0]
    best = best_grasp(problem.target_grasps, *objects_and_pose(problem, OPEN))
    np.testing.assert_array_equal(first, best.action.T_world_gripper)


def test_what_is_free_to_move_may_be_hit_and_what_is_not_may_not(retrievals):
    assert (retrievals["loose"][0].hits > 0).all()
    assert (retrievals["loose"][1] == DONE).any()
    assert (retrievals["firm"][0].hits > 0).all()
    assert not (retrievals["firm"][1] == DONE).any()
    assert retrievals["open"][1][0] == DONE


def test_a_grasp_has_to_succeed_in_the_scenes_nearby_too(problem, retrievals):
    names, fragile = ("open", "loose"), []
    for name in names:
        tried, results = retrievals[name]
        seen, at = objects_and_pose(problem, SCENES[name])
        alone = NativeTrials(nearby=Perturbations(scenes=0))
        plain = results_of(alone, problem, seen, at, True, tried.action, tried.feasible)
        far = NativeTrials(nearby=Perturbations(scenes=3, place=0.02))
        strict = results_of(far, problem, seen, at, True, tried.action, tried.feasible)
        done = [int(np.argmax(np.append(r, DONE) == DONE)) for r in (plain, results, strict)]
        assert done == sorted(done), name
        fragile.append(done[2] > done[0])
    assert any(fragile)


def test_a_retrieval_is_tried_in_each_scene_nearby_and_a_push_in_the_first(problem, retrievals, monkeypatch):
    seen, at = objects_and_pose(problem, OPEN)
    grasp, push = jax.tree.map(lambda a: a[:1], retrievals["open"][0].action), stack(pushes()[2])
    for codes, action, result, calls in (
        ((DONE, DONE, FAILED), grasp, UNSURE, 3),
        ((DONE, HARM), grasp, HARM, 2),
        ((DONE, UNKNOWN), grasp, UNKNOWN, 2),
        ((DONE,) * 4, grasp, DONE, 4),
        ((FAILED,), grasp, FAILED, 1),
        ((DONE, DONE), push, DONE, 2),
        ((DONE, FAILED), push, DONE, 2),
        ((DONE, HARM), push, UNSURE, 2),
        ((HARM,), push, HARM, 1),
    ):
        said = iter(codes)
        called = []

        def attempted(scene, *args, said=said, called=called):
            called.append(scene)
            return next(said)

        monkeypatch.setattr(TrialScene, "attempt", attempted)
        assert results_of(NativeTrials(threads=1), problem, seen, at, True, action).tolist() == [result]
        assert len(called) == len(set(map(id, called))) == calls


def test_what_the_trials_say_is_what_the_simulator_does(problem, retrievals):
    world = NativeWorld()
    for name in ("loose", "firm"):
        tried, results = retrievals[name]
        world.reset(begin(SCENES[name]))
        first = int(np.argmax(results == DONE))
        outcome = world.execute(jax.tree.map(lambda a, i=first: a[i], tried.action))
        assert bool(outcome.retrieved) == bool(results[first] == DONE)


def test_what_throws_an_object_down_does_harm_and_what_is_out_of_reach_fails(problem):
    over, away, aside = pushes()
    seen, at = objects_and_pose(problem, EDGE)
    assert results_of(MODEL, problem, seen, at, False, stack(over, away, aside)).tolist() == [HARM, FAILED, DONE]
    # After what succeeds nothing is tried any more, with one thread.
    alone = NativeTrials(threads=1)
    assert results_of(alone, problem, seen, at, False, stack(aside, over, away)).tolist() == [DONE, UNKNOWN, UNKNOWN]
    world = NativeWorld()
    world.reset(begin(EDGE))
    assert np.asarray(world.execute(over).fallen).tolist() == [True] + [False] * 8


def test_a_target_that_is_found_must_not_fall_and_one_that_is_not_is_not_there(problem):
    seen, at = objects_and_pose(problem, OPEN)
    # High against the target, from its side.
    tip = push(pose(0.63, -0.02 - 0.1125, 0.09, tilt=math.radians(30)), (0.0, 0.1, 0.0))
    assert results_of(MODEL, problem, seen, at, True, stack(tip)).tolist() == [HARM]
    assert results_of(MODEL, problem, seen, at, False, stack(tip)).tolist() == [DONE]


def made(policy, trials, problem, belief, observation):
    return decided(policy, trials, jax.random.key(0), problem, belief, observation)


def decided(policy, trials, key, problem, belief, observation, last=False):
    state = SearchState(belief, observation, no_action())
    return decide(policy, trials, key, problem, state, last=last).decision


def proposes(*actions):
    """A policy whose best sequences begin with these actions."""
    return search_for_grasp(tries=True).replace(plan=planned(*actions))


def test_the_first_thing_that_goes_well_is_made(problem):
    over, away, aside = pushes()
    belief, observation = look(problem, EDGE, found=False)
    for actions, chosen in (((aside, over), 0), ((over, aside), 1), ((over, away, aside), 2), ((over, away), 1)):
        decision = made(proposes(*actions), MODEL, problem, belief, observation)
        assert int(decision.action.kind) == ActionKind.PUSH
        np.testing.assert_array_equal(decision.action.T_world_gripper, actions[chosen].T_world_gripper)
        assert (float(decision.value), float(decision.predicted_cost)) == (chosen - 10.0, chosen + 10.0)
        before = observation.objects.position
        np.testing.assert_allclose(decision.predicted.position - before, chosen if chosen else 0.0, atol=1e-6)
    # What a policy proposes does not depend on what becomes of it.
    for policy in (proposes(over, aside), search_for_grasp().replace(plan=planned(over, aside))):
        done = made(policy, None, problem, belief, observation)
        np.testing.assert_array_equal(done.action.T_world_gripper, over.T_world_gripper)
        assert (done.alternatives is None) == (not policy.tries)


def says(*codes):
    """Trials that say the same of the first actions, whatever they are and whether or not they are wanted."""

    def trials(problem, scenes, actions, wanted):
        results = np.full(wanted.shape, UNKNOWN, np.int32)
        results[:, : len(codes)] = codes
        return results

    return trials


def test_where_everything_does_harm_nothing_is_done(problem):
    over, *_ = pushes()
    belief, observation = look(problem, EDGE, found=False)
    # What is like another is not tried, and refused with it.
    for actions, refused in (((over, over), 1), ((over, higher(over)), 2), ((no_action(),), 0)):
        decision = made(proposes(*actions), MODEL, problem, belief, observation)
        assert (int(decision.action.kind), int(decision.refused)) == (ActionKind.NONE, refused)
        assert (float(decision.value), float(decision.predicted_cost)) == (math.inf, 20.0)
        jax.tree.map(np.testing.assert_array_equal, decision.predicted, observation.objects)
        assert (decision.sequences.actions.kind == ActionKind.NONE).all()


def test_what_does_harm_is_refused_and_what_is_made_comes_first(problem):
    over, _, aside = pushes()
    belief, observation = look(problem, EDGE, found=False)
    for codes, order, refused in (
        ((DONE, HARM, HARM, HARM), (0, 1, 2, 3), 0),
        ((HARM, FAILED, DONE, HARM), (2, 1, 3), 1),
        ((FAILED, HARM, FAILED, HARM), (0, 2), 2),
        ((UNKNOWN, FAILED, UNKNOWN, FAILED), (1, 3), 2),
        ((FAILED, UNSURE, DONE, UNSURE), (2, 0, 1, 3), 0),
        ((FAILED, HARM, UNSURE, UNSURE), (2, 0, 3), 1),
    ):
        four = (over, aside, higher(over), higher(aside))
        decision = made(proposes(*four), says(*codes), problem, belief, observation)
        value, after = np.asarray(decision.sequences.value), decision.sequences.after
        assert value[: len(order)].tolist() == [i - 10.0 for i in order]
        assert np.isinf(value[len(order) :]).all()
        assert (decision.sequences.actions.kind[len(order) :] == ActionKind.NONE).all()
        assert int(decision.refused) == refused
        jax.tree.map(
            np.testing.assert_array_equal, decision.action, jax.tree.map(lambda a: a[0, 0], decision.sequences.actions)
        )
        jax.tree.map(np.testing.assert_array_equal, decision.predicted, jax.tree.map(lambda a: a[0], after))


def test_what_cannot_be_executed_gives_way_to_the_next_that_goes_well(problem):
    over, away, aside = pushes()
    belief, observation = look(problem, EDGE, found=False)
    state, policy = SearchState(belief, observation, no_action()), proposes(aside, over, higher(aside), away)
    trials = says(DONE, HARM, DONE, FAILED)

    def chosen(least):
        values = []

        def executable(decision):
            values.append(float(decision.value))
            return values[-1] >= least

        return decide(policy, trials, jax.random.key(0), problem, state, executable=executable), values

    decided, values = chosen(-8.0)
    np.testing.assert_array_equal(decided.decision.action.T_world_gripper, higher(aside).T_world_gripper)
    # The one between does harm; what was refused counts as failed.
    assert values == [-10.0, -8.0]
    assert decided.tried.result.tolist() == [FAILED, HARM, DONE]
    # Where none is left, all is drawn anew.
    _, values = chosen(0.0)
    assert values == [-10.0, -8.0, -10.0] * DRAWS


def test_what_is_not_known_is_never_made(problem):
    _, _, aside = pushes()
    belief, observation = look(problem, EDGE, found=False)
    decision = made(proposes(aside, higher(aside)), says(), problem, belief, observation)
    assert (int(decision.action.kind), int(decision.refused)) == (ActionKind.NONE, 2)


def test_what_is_said_of_what_was_not_wanted_counts_for_nothing(problem):
    _, _, aside = pushes()
    belief, observation = look(problem, EDGE, found=False)
    decision = made(proposes(aside), says(FAILED, DONE), problem, belief, observation)
    assert (int(decision.action.kind), float(decision.value)) == (ActionKind.PUSH, -10.0)
    # No grasp reaches a target that is far away.
    belief, observation = look(problem, FIRM)
    far = belief.replace(found_pose=belief.found_pose.at[0].set(3.0))
    decision = made(proposes(aside), says(*[DONE] * TRIES), problem, far, observation)
    assert int(decision.action.kind) == ActionKind.PUSH


def test_a_harmless_action_is_found_behind_many_that_do_harm(problem):
    _, _, aside = pushes()
    T = aside.T_world_gripper
    many = [aside.replace(T_world_gripper=T.at[2, 3].add(0.03 * i)) for i in range(13)]
    belief, observation = look(problem, EDGE, found=False)
    decision = made(proposes(*many), says(*[HARM] * 12, DONE), problem, belief, observation)
    assert float(decision.value) == 2.0
    assert int(decision.refused) == 12


def test_a_grasp_that_hits_nothing_is_made_only_if_its_trial_does_not_fail(problem):
    _, _, aside = pushes()
    plain = best_grasp(problem.target_grasps, *objects_and_pose(problem, OPEN))
    one_is_known = [UNKNOWN] * (TRIES - 1) + [FAILED]
    for objects, codes, kind in (
        (OPEN, [UNKNOWN] * TRIES, ActionKind.RETRIEVE),
        (OPEN, [FAILED] * TRIES, ActionKind.PUSH),
        (OPEN, one_is_known, ActionKind.PUSH),
        (FIRM, [FAILED] * TRIES, ActionKind.PUSH),
    ):
        belief, observation = look(problem, objects)
        decision = made(proposes(aside), grasps_fail_as(codes), problem, belief, observation)
        assert int(decision.action.kind) == kind
        if kind == ActionKind.RETRIEVE:
            np.testing.assert_array_equal(decision.action.T_world_gripper, plain.action.T_world_gripper)


def test_an_unsure_grasp_is_made_only_where_no_other_action_is_allowed(problem):
    _, _, aside = pushes()
    belief, observation = look(problem, OPEN)
    grasps = proposes(aside).retrieval(jax.random.key(0), problem, belief, observation).alternatives
    assert grasps.worth[:3].all()
    for codes, last, row in (
        ((FAILED, UNSURE, UNSURE), False, None),
        ((FAILED, UNSURE, UNSURE), True, 1),
        ((UNSURE, FAILED, DONE), True, 2),
        ((FAILED, HARM, FAILED), True, None),
    ):
        trials = grasps_fail_as([*codes, *[FAILED] * (TRIES - 3)])
        arguments = proposes(aside), trials, jax.random.key(0), problem, belief, observation
        decision = decided(*arguments, last=last)
        assert int(decision.action.kind) == (ActionKind.PUSH if row is None else ActionKind.RETRIEVE)
        if row is not None:
            expected = grasps.actions.T_world_gripper[row]
            np.testing.assert_array_equal(decision.action.T_world_gripper, expected)
        # As in many slots.
        slots, keys = slots_of(problem, proposes(aside), trials, [(OPEN, True), (OPEN, True)])
        choices = slots.decide(keys, [0, 1], [0] if last else [])
        assert int(choices[0].action.kind) == int(decision.action.kind)
        without = grasps_fail_as([FAILED if c == UNSURE else c for c in codes] + [FAILED] * (TRIES - 3))
        other = decided(proposes(aside), without, *arguments[2:])
        assert int(choices[1].action.kind) == int(other.action.kind)


def grasps_fail_as(codes):
    """Trials in which grasps have these results and all else succeeds."""

    def trials(problem, scenes, actions, wanted):
        grasps = np.asarray(codes + [DONE] * wanted.shape[1])[: wanted.shape[1]]
        return np.where(actions.kind == ActionKind.RETRIEVE, grasps[None], DONE).astype(np.int32)

    return trials


def test_a_plan_is_made_only_where_the_target_is_not_taken_out(problem):
    _, _, aside = pushes()
    plans, tried = [], []

    def plan(*args):
        plans.append(1)
        return planned(aside)(*args)

    def trials(problem, scenes, actions, wanted):
        tried.append(set(actions.kind[wanted].tolist()))
        return np.where(actions.kind == code, DONE, FAILED).astype(np.int32)

    policy = search_for_grasp(tries=True).replace(plan=plan)
    for code, planned_, kinds in (
        (ActionKind.RETRIEVE, 0, [{ActionKind.RETRIEVE}]),
        (ActionKind.PUSH, 1, [{ActionKind.RETRIEVE}, {ActionKind.PUSH}]),
    ):
        belief, observation = look(problem, FIRM)
        plans.clear(), tried.clear()
        decision = made(policy, trials, problem, belief, observation)
        assert (int(decision.action.kind), len(plans), tried) == (code, planned_, kinds)


@pytest.mark.parametrize(("objects", "found"), [(LOOSE, True), (LOOSE, False), (OPEN, True)])
def test_one_choice_among_grasps_and_actions_is_what_two_in_turn_are(problem, objects, found):
    over, _, aside = pushes()
    policy = proposes(over, aside)
    belief, observation = look(problem, objects, found=found)
    both = policy(jax.random.key(0), problem, belief, observation)
    count = TRIES if found else 0
    assert both.alternatives.sequence[:count].tolist() == [-1] * count
    assert both.alternatives.worth[:count].any() == found
    for grasps, actions in (
        ((FAILED, DONE), (DONE,)),
        ((FAILED, HARM), (HARM, DONE)),
        ((FAILED,) * TRIES, (FAILED, DONE)),
        ((), (FAILED, UNKNOWN)),
        ((), (DONE,)),
        ((), ()),
    ):
        results = np.full(len(both.alternatives.worth), UNKNOWN, np.int32)
        if found:
            results[: len(grasps)] = grasps
        results[count : count + len(actions)] = actions

        def trials(problem, scenes, proposed, wanted, results=results):
            return (results[:count] if (proposed.kind == ActionKind.RETRIEVE).any() else results[count:])[None]

        chosen = choose(both, jnp.asarray(results), jnp.array(False))
        in_turn = made(policy, trials, problem, belief, observation)
        for name in ("action", "value", "cost", "predicted_cost", "predicted", "sequences", "refused"):
            jax.tree.map(np.testing.assert_array_equal, getattr(chosen, name), getattr(in_turn, name))


def test_what_becomes_of_a_simulation_that_diverges_is_not_known(problem):
    seen, at = objects_and_pose(problem, EDGE)
    # It does as everything comes to rest, long before the push is over.
    thrown = seen.replace(position=seen.position.at[0, 0].set(1e11))
    assert results_of(MODEL, problem, thrown, at, False, stack(pushes()[2])).tolist() == [UNKNOWN]
    world = NativeWorld()
    world.reset(begin(EDGE))
    world._data.qvel[-1] = 1e12
    before = world._data.qpos.copy()
    outcome = world.execute(pushes()[2])
    assert Failure(int(outcome.failure)) is Failure.UNSTABLE
    np.testing.assert_array_equal(world._data.qpos, before)


def several(*scenes):
    """Scenes with hidden targets as `Trials` take them."""
    seen = stack(*scenes)
    count = len(scenes)
    return TrialScenes(seen, np.zeros((count, 3)), np.zeros(count, bool), np.ones(count))


def test_a_scene_that_cannot_be_built_costs_its_own_row_alone(problem, monkeypatch):
    seen, _ = objects_and_pose(problem, EDGE)
    built = NativeWorld.place

    def place(world, bodies, *args):
        if bodies[0].position[0] > 0.5:
            raise ValueError("no such body")
        built(world, bodies, *args)

    monkeypatch.setattr(NativeWorld, "place", place)
    other = seen.replace(position=seen.position.at[0, 0].set(0.55))
    broken = seen.replace(position=seen.position.at[0, 0].set(jnp.nan))
    mirrored = seen.replace(rotation=seen.rotation.at[0, 0, 0].set(-1.0))
    aside = stack(pushes()[2])
    results = MODEL(problem, several(other, seen, broken, mirrored), stack(*[aside] * 4), np.ones((4, 1), bool))
    assert results.tolist() == [[UNKNOWN], [DONE], [UNKNOWN], [UNKNOWN]]


def test_friction(problem):
    seen, at = objects_and_pose(problem, EDGE)
    aside = stack(pushes()[2])
    # What is rough holds the hand up.
    for friction, expected in ((1.0, DONE), (4.0, FAILED)):
        assert results_of(NativeTrials(friction=friction), problem, seen, at, False, aside).tolist() == [expected]
    scenes = several(seen, seen).replace(friction=np.array([1.0, 4.0]))
    expected = MODEL(problem, scenes, stack(aside, aside), np.ones((2, 1), bool))
    assert expected.tolist() == [[DONE], [FAILED]]
    for wrong in (0.0, -1.0, math.nan):
        with pytest.raises(InputError, match="must be a positive number"):
            NativeTrials(friction=wrong)


def test_what_can_be_taken_out_is_and_where_nothing_can_the_search_goes_on(problem):
    _, _, aside = pushes()
    for objects, takes in ((LOOSE, True), (FIRM, False), (OPEN, True)):
        belief, observation = look(problem, objects)
        kinds = [int(made(proposes(aside), t, problem, belief, observation).action.kind) for t in (MODEL, None)]
        assert [kind == ActionKind.RETRIEVE for kind in kinds] == [takes, objects is OPEN]


def test_without_contact_no_grasp_that_hits_something_takes_the_target_out(problem):
    _, _, aside = pushes()
    strict = search_for_grasp(tries=True, retrieval_contact=False).replace(plan=planned(aside))
    for objects, worth, takes in ((LOOSE, False, False), (FIRM, False, False), (OPEN, True, True)):
        belief, observation = look(problem, objects)
        grasps = top_grasps(problem.target_grasps, *objects_and_pose(problem, objects))
        offered = strict.retrieval(jax.random.key(0), problem, belief, observation).alternatives.worth
        np.testing.assert_array_equal(offered, grasps.feasible & (grasps.hits == 0))
        assert bool(offered.any()) == worth
        # Trials in which every grasp would succeed.
        decision = made(strict, says(*[DONE] * TRIES), problem, belief, observation)
        assert (int(decision.action.kind) == ActionKind.RETRIEVE) == takes
    # A plan does not depend on it.
    assert strict._planning == strict.replace(config=search_for_grasp().config, tries=False)


@pytest.mark.slow
def test_a_policy_proposes_the_same_alone_and_mapped_over(problem):
    over, _, aside = pushes()
    policy = proposes(over, aside)
    rows = [look(problem, EDGE, found=False), look(problem, LOOSE), look(problem, FIRM), look(problem, OPEN)]
    beliefs, seen = stack(*rows)
    keys = jax.random.split(jax.random.key(0), len(rows))
    proposed = jax.jit(jax.vmap(lambda *row: policy(row[0], problem, *row[1:])))(keys, beliefs, seen)
    alternatives = proposed.alternatives
    results = MODEL(problem, scenes_of(beliefs, seen), *jax.device_get((alternatives.actions, alternatives.worth)))
    mapped = jax.jit(jax.vmap(choose))(proposed, results, jnp.zeros(len(rows), bool))
    for i, (belief, observation) in enumerate(rows):
        alone = decided(policy, MODEL, keys[i], problem, belief, observation)
        assert int(alone.action.kind) == int(mapped.action.kind[i])
        np.testing.assert_allclose(alone.action.T_world_gripper, mapped.action.T_world_gripper[i], atol=1e-6)
    assert mapped.action.kind.tolist()[:2] == [ActionKind.PUSH, ActionKind.RETRIEVE]
    assert int(mapped.action.kind[3]) == ActionKind.RETRIEVE


def test_of_many_scenes_it_says_the_same_and_nothing_where_it_is_not_wanted(problem, retrievals):
    over, away, aside = pushes()
    beliefs, seen = stack(look(problem, EDGE, found=False), look(problem, LOOSE), look(problem, FIRM))
    alone = int(np.argmax(retrievals["loose"][1] == DONE))
    grasps = jax.tree.map(lambda a: a[np.array([alone, alone + 1, alone])], retrievals["loose"][0].action)
    actions = stack(stack(over, away, aside), grasps, grasps)
    wanted = np.array([[True, True, True], [True, True, True], [False, False, False]])
    results = MODEL(problem, scenes_of(beliefs, seen), actions, wanted)
    assert results[0].tolist() == [HARM, FAILED, DONE]
    assert results[1][0] == DONE
    assert results[2].tolist() == [UNKNOWN, UNKNOWN, UNKNOWN]


def slots_of(problem, policy, trials, rows):
    """Slots in which this is known and seen."""
    world = stack(*(from_scenario(begin(objects)) for objects, _ in rows))
    slots = ManySlots(problem, policy, oracle, world, 2, trials)
    beliefs, seen = stack(*(look(problem, *row) for row in rows))
    slots._state = slots._state.replace(search=SearchState(beliefs, seen.judged(), slots._state.search.action))
    return slots, jax.random.split(jax.random.key(0), len(rows))


def test_what_is_worth_trying_in_all_slots_is_tried_together(problem):
    over, _, aside = pushes()
    calls = []

    def trials(problem, scenes, actions, wanted):
        calls.append((len(wanted), scenes.found.tolist()))
        return MODEL(problem, scenes, actions, wanted)

    # Three slots, two at a time.
    slots, keys = slots_of(problem, proposes(over, aside), trials, [(EDGE, False), (FIRM, False), (EDGE, False)])
    choices = slots.decide(keys, [0, 1, 2])
    assert calls == [(3, [False] * 3)]
    for row, chosen in ((0, aside), (2, aside)):
        np.testing.assert_array_equal(choices[row].action.T_world_gripper, chosen.T_world_gripper)
        assert int(choices[row].refused) == 1
    np.testing.assert_array_equal(slots._state.search.action.T_world_gripper[2], aside.T_world_gripper)
    assert slots.decide(keys, []) == {}


@pytest.mark.parametrize("threads", [1, 3, 16])
def test_the_first_that_succeeds_is_the_same_with_any_number_of_threads(threads):
    tried = []

    def attempt(row, i, needed):
        tried.append((row, i))
        time.sleep(0.001)
        if not needed():
            return None
        return DONE if i >= (3, 6)[row] else FAILED

    results = in_order(np.ones((2, TRIES), bool), threads, attempt)
    assert results.argmax(axis=1).tolist() == [3, 6]
    assert (results.max(axis=1) == DONE).all()
    assert results[0, :3].tolist() == [FAILED] * 3
    assert results[1, :6].tolist() == [FAILED] * 6
    # The best of both scenes come before what is next.
    assert {tried[0], tried[1]} == {(0, 0), (1, 0)}
    assert threads > 1 or len(tried) == 4 + 7


def test_what_nobody_waits_for_any_more_is_stopped():
    stopped, late = [], threading.Event()

    def attempt(row, i, needed):
        if i == 0:
            late.wait(10.0)
            return DONE
        late.set()
        while needed():
            time.sleep(0.001)
        stopped.append(i)
        return None

    results = in_order(np.ones((1, 3), bool), 2, attempt)
    assert (results.tolist(), stopped) == ([[DONE, UNKNOWN, UNKNOWN]], [1])


def test_a_scene_is_made_once_and_trying_does_not_change_it(problem):
    scene = TrialScene(problem.shelf, MODEL.simulation, bodies_of(world_of(problem, EDGE)))
    kind = kind_of(ActionKind.PUSH)
    over, _, aside = (jax.device_get(reference_motion(kind, a, MODEL.simulation.motion)[0]) for a in pushes())
    before = scene.positions
    for _ in range(2):
        assert scene.attempt(kind, over, 0) is HARM
        assert scene.attempt(kind, aside, 1) is DONE
        np.testing.assert_array_equal(scene.positions, before)
    assert scene.attempt(kind, aside, 1, lambda: False) is None


def test_what_is_not_touched_sleeps(problem):
    scene = TrialScene(problem.shelf, MODEL.simulation, bodies_of(world_of(problem, EDGE)))
    # The arm alone is awake, before anything is touched.
    assert (scene._data.tree_asleep >= 0).tolist() == [False] + [True] * 9
