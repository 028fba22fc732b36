"""Retrievals that are simulated before they are made: a grasp that pushes aside what is free to move takes the target
out, one that runs into what is not does not."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_envs_simulator import scene, standing

from mechsearch_jax.actions import ActionKind, no_action
from mechsearch_jax.envs import physics_retrieval
from mechsearch_jax.envs.native import NativeWorld
from mechsearch_jax.envs.physics_retrieval import NativeRetrieval
from mechsearch_jax.envs.retrieval_models import retrieval_model
from mechsearch_jax.envs.snapshot import Snapshot, objects_on_the_board, true_target_pose
from mechsearch_jax.envs.world import from_scenario
from mechsearch_jax.errors import InputError
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Config, Decision, initial_belief, search_for_grasp, update_belief
from mechsearch_jax.planner.retrieval import ALIKE, ALIKE_WRIST, TRIES, graspable_at, take_out, worth_trying
from mechsearch_jax.planner.rollout import no_sequences

TARGET = standing("cylinder", (0.02, 0.02, 0.05), 0.6, 0.0)
MODEL = NativeRetrieval()
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


def do_nothing(rollout, key, objects):
    nan = jnp.float32(jnp.nan)
    return Decision(no_action(), nan, nan, nan, objects, no_sequences(rollout.config))


@pytest.fixture(scope="module")
def told(problem):
    """What there is to be tried in each scene, and what the model says of it."""
    found = {}
    for name, objects in (("open", OPEN), ("loose", LOOSE), ("firm", FIRM)):
        seen, pose = known(problem, objects)
        tried = worth_trying(problem, seen, pose)
        found[name] = tried, MODEL(problem, seen, pose, tried.action, tried.hits <= seen.capacity)
    return found


def test_the_grasps_that_are_tried_differ_and_the_clearest_come_first(problem, told):
    for name, (tried, _) in told.items():
        way, q7 = tried.action.T_world_gripper[:, :3, 2], tried.action.q7
        assert len(q7) == TRIES
        apart = np.arccos(np.clip(way @ way.T, -1.0, 1.0))
        wrist = np.abs(q7[:, None] - q7[None])
        alike = (apart < ALIKE) & (wrist < ALIKE_WRIST) & ~np.eye(TRIES, dtype=bool)
        assert not alike.any(), name
        best = graspable_at(problem, *known(problem, {"open": OPEN, "loose": LOOSE, "firm": FIRM}[name]))
        assert bool(tried.success[0]) == bool(best.success)
    open_first = told["open"][0].action.T_world_gripper[0]
    np.testing.assert_array_equal(open_first, graspable_at(problem, *known(problem, OPEN)).action.T_world_gripper)


def test_what_is_free_to_move_may_be_hit_and_what_is_not_may_not(told):
    assert (told["loose"][0].hits > 0).all()
    assert bool(told["loose"][1].any())
    assert (told["firm"][0].hits > 0).all()
    assert not bool(told["firm"][1].any())
    assert bool(told["open"][1][0])


def test_what_the_model_says_is_what_the_simulator_does(problem, told):
    world = NativeWorld()
    for name, objects in (("loose", LOOSE), ("firm", FIRM)):
        tried, works = told[name]
        world.reset(begin(objects))
        first = int(jnp.argmax(works))
        outcome = world.execute(jax.tree.map(lambda a, i=first: a[i], tried.action))
        assert bool(outcome.retrieved) == bool(works.any())


def test_the_policy_takes_out_what_the_model_says_and_searches_on_where_it_says_no(problem):
    bold, plain = (search_for_grasp(retrieval_model=m).replace(plan=do_nothing) for m in (MODEL, None))
    for objects, takes in ((LOOSE, True), (FIRM, False), (OPEN, True)):
        seen, pose = known(problem, objects)
        choice = take_out(MODEL, problem, seen, pose)
        assert bool(choice.success) == takes
        assert bool(take_out(None, problem, seen, pose).success) == (objects is OPEN)
        observation = Observation(seen, jnp.array(True), pose)
        belief = update_belief(problem, initial_belief(problem), observation)
        kinds = [int(policy(jax.random.key(0), problem, belief, observation).action.kind) for policy in (bold, plain)]
        assert (kinds[0] == ActionKind.RETRIEVE, kinds[1] == ActionKind.RETRIEVE) == (takes, objects is OPEN)


def test_mapped_over_it_says_the_same_and_nothing_where_it_is_not_asked(problem, told):
    scenes = [known(problem, objects) for objects in (OPEN, LOOSE, FIRM)]
    seen, poses = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    actions = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(told[name][0].action for name in told))
    asked = jnp.stack([jnp.arange(TRIES) < 1, jnp.ones(TRIES, bool), jnp.zeros(TRIES, bool)])
    mapped = jax.jit(jax.vmap(lambda *row: MODEL(problem, *row)))(seen, poses, actions, asked)
    assert mapped[0].tolist() == [True] + [False] * (TRIES - 1)
    assert int(jnp.argmax(mapped[1])) == int(jnp.argmax(told["loose"][1]))
    assert not bool(mapped[2].any())


def test_a_scene_that_is_none_does_not_succeed_and_leaves_the_others_alone(problem, told):
    seen, pose = known(problem, LOOSE)
    broken = seen.replace(position=seen.position.at[0, 0].set(jnp.nan))
    actions = told["loose"][0].action
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), broken, seen)
    asked = jnp.arange(TRIES) < 2
    said = jax.vmap(lambda here: MODEL(problem, here, pose, actions, asked))(both)
    assert not bool(said[0].any())
    assert bool(said[1].any())


def test_the_first_that_succeeds_is_the_same_with_any_number_of_threads(problem, told, monkeypatch):
    made = []
    monkeypatch.setattr(physics_retrieval, "_succeeds", lambda *at: made.append(1) or float(at[3].q[0, 0]) > 2.5)
    seen, pose = known(problem, OPEN)
    world, reference, _ = physics_retrieval._prepared(problem, seen, pose, told["open"][0].action, MODEL.simulation)
    q = np.zeros((2, TRIES, *np.shape(reference.q)[1:]), np.float32)
    q[0, 3:], q[1, 6:] = 3.0, 3.0
    two = jax.tree.map(lambda a: np.stack([a, a]), jax.device_get((world, reference)))
    for threads in (1, 3, 16):
        made.clear()
        found = physics_retrieval._first_successes(
            problem.shelf, MODEL.simulation, threads, two[0], two[1].replace(q=q), np.ones((2, TRIES), bool)
        )
        assert found.argmax(axis=1).tolist() == [3, 6]
        assert found.any(axis=1).all()
        assert threads == 16 or len(made) < 2 * TRIES


def test_names():
    assert retrieval_model("collision-free") is None
    assert retrieval_model("physics") is retrieval_model("physics")
    assert retrieval_model("physics") == MODEL
    with pytest.raises(InputError, match='retrieval model "guess" is unknown; use collision-free, physics'):
        retrieval_model("guess")
    with pytest.raises(InputError, match='retrieval_model "guess" is unknown; use collision-free, physics'):
        dataclasses.replace(Config(), retrieval_model="guess")
    assert math.isclose(MODEL.simulation.motion.timestep, NativeWorld().config.motion.timestep)
