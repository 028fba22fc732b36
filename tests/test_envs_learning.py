"""What a push does tells the friction, trials assume it from then on, and an arm that is held up may go back."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_envs_simulator import pose, push, scene, standing

from mechsearch_jax.actions import no_action
from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board
from mechsearch_jax.envs.episode.slots import OneSlot
from mechsearch_jax.envs.simulators.native_world import NativeWorld
from mechsearch_jax.envs.trials.learning import FRICTIONS, Hypothesis, LearningTrials
from mechsearch_jax.envs.trials.named import rehearsal
from mechsearch_jax.envs.trials.native import NativeTrials
from mechsearch_jax.envs.world.mismatch import ASSUMED_CELL
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import initial_belief, search_for_grasp
from mechsearch_jax.planner.learning import LEAST, LearnedPhysics, LearnsPhysics, posterior, restored
from mechsearch_jax.planner.trials import scenes_of
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.state import beginning, load_state, save_state
from mechsearch_jax.workspace.shelf import Shelf

# Falls over in front of so high a hand; where it comes to lie hangs on the friction.
TALL = standing("cylinder", (0.03, 0.03, 0.09), 0.55, 0.1)
BEFORE = scene(TALL, target=standing("cylinder", (0.02, 0.02, 0.05), 0.7, -0.2))
PUSH = push(pose(0.56, 0.1 - 0.07, 0.1), (0.0, 0.15, 0.0))
# A box that cannot move as far to the left as the hand is to go.
WEDGED = standing("box", (0.078, 0.048, 0.1), 0.6, Shelf().left - 0.078)
START = pose(0.62, WEDGED.position[1] - 0.048 - 0.1125, 0.06, tilt=math.radians(30))
SHOVE = push(START, (0.0, 0.05, 0.0)).replace(
    displacement=jnp.array([0.0, 0.12, 0.0]), T_world_place=START.at[1, 3].add(0.12)
)


def seen(problem, world):
    objects = objects_on_the_board(Snapshot(problem.camera, problem.shelf, world))
    return Observation(objects, jnp.array(False), jnp.zeros(3))


def pushed(problem, friction):
    """What is seen before and after a push in a world of some friction."""
    simulator = NativeWorld()
    before = simulator.reset(BEFORE, ASSUMED_CELL._replace(friction=friction))
    simulator.execute(PUSH)
    return seen(problem, before), seen(problem, simulator.world)


@pytest.mark.parametrize("friction", [1.0, 2.0])
def test_a_push_tells_the_friction(problem, friction):
    before, after = pushed(problem, friction)
    physics = LearnedPhysics(LearningTrials(NativeTrials(threads=1)), 1)
    physics.learn_first(problem, initial_belief(problem), before, PUSH, after)
    best = FRICTIONS[int(physics.probabilities[0].argmax())]
    assert (best.friction > 1.0) == (friction > 1.0)
    assert physics.probabilities[0].sum() == pytest.approx(1.0)
    assert physics.probabilities[0].min() > 0.0


def test_trials_assume_what_is_most_probable(problem):
    model = LearningTrials()
    assumed = []

    class Spy(NativeTrials):
        def __call__(self, problem, scenes, actions, wanted):
            assumed.append(scenes)
            return np.zeros((2, 1), np.int32)

    spy = dataclasses.replace(model, trials=Spy())
    physics = LearnedPhysics(spy, 2)
    physics.probabilities[1] = [0.0, 0.0, 0.1, 0.2, 0.7]
    two = jax.tree.map(lambda a: np.stack([a, a]), scenes_of(initial_belief(problem), pushed(problem, 1.0)[0]))
    physics.trials([0, 1])(problem, two, no_action(), np.ones((2, 1), bool))
    assert np.asarray(assumed[0].friction).tolist() == [1.0, 2.0]
    physics.forget(np.array([False, True]))
    assert physics.probabilities[1] == pytest.approx(model.prior)


def test_nothing_is_learned_where_nothing_was_done(problem):
    before, after = pushed(problem, 2.0)
    physics = LearnedPhysics(LearningTrials(), 1)
    physics.learn_first(problem, initial_belief(problem), before, no_action(), after)
    assert physics.probabilities[0] == pytest.approx(LearningTrials().prior)


def test_what_cannot_be_simulated_teaches_nothing(problem):
    before, after = pushed(problem, 2.0)
    physics = LearnedPhysics(LearningTrials(NativeTrials(threads=1)), 1)
    out_of_reach = PUSH.replace(T_world_gripper=pose(3.0, 0.0, 0.1))
    physics.learn_first(problem, initial_belief(problem), before, out_of_reach, after)
    assert physics.probabilities[0] == pytest.approx(LearningTrials().prior)


def test_the_posterior_is_bayes_rule_of_the_nearest_objects():
    prior, spread = np.array([0.25, 0.75], np.float32), np.float32(0.01)
    ends = np.zeros((2, 2, 2, 3), np.float32)
    # The first hypothesis is right in its second way; the second is a spread off in both. The second object is none.
    ends[0, 0, 0, 0], ends[1, :, 0, 0], ends[:, :, 1] = 0.5, 0.01, 9.0
    there, visible = np.array([True, False]), np.array([False, True, True])
    places = np.array([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0], [0.3, 0.0, 0.0]], np.float32)
    after = np.asarray(posterior(prior, ends, there, places, visible, spread))
    odds = 0.25 / (0.75 * 2.0**-1.5)
    assert after[0] / after[1] == pytest.approx(odds, rel=1e-4)
    blind = posterior(prior, ends, there, places, np.zeros(3, bool), spread)
    assert np.asarray(blind) == pytest.approx(prior)
    ends[1] += 1e3
    assert np.asarray(posterior(prior, ends, there, places, visible, spread)).min() == pytest.approx(LEAST, rel=0.01)


def test_slots_learn_between_looks_and_forget(problem):
    slot = OneSlot(
        problem, search_for_grasp(tries=True), lambda key, snapshot: seen(problem, snapshot.world), LearningTrials()
    )
    before = jax.tree.map(lambda a: a[None], from_scenario(BEFORE))
    simulator = NativeWorld()
    simulator.reset(BEFORE, ASSUMED_CELL._replace(friction=2.0))
    simulator.execute(PUSH)
    keys = jax.random.split(jax.random.key(0), 1)
    slot.look(before, keys, [0])
    slot.took({0: PUSH})
    slot.look(jax.tree.map(lambda a: a[None], simulator.world), keys, [0])
    assert slot._physics.probabilities[0].argmax() > 2
    slot.forget(np.array([True]))
    assert slot._physics.probabilities[0] == pytest.approx(LearningTrials().prior)


def test_only_trials_that_learn_are_asked_to():
    assert isinstance(rehearsal("learning"), LearnsPhysics)
    assert not isinstance(rehearsal("physics"), LearnsPhysics)
    assert restored(rehearsal("physics"), ()) is None
    assert restored(rehearsal("learning"), [0.2] * 5).probabilities[0] == pytest.approx(0.2)
    with pytest.raises(InputError, match="2 probabilities for 5 hypotheses"):
        restored(rehearsal("learning"), [0.5, 0.5])


def test_what_was_learned_is_saved(problem, tmp_path):
    saved = dataclasses.replace(beginning(problem), physics=(0.25, 0.75))
    save_state(saved, "digest", tmp_path / "search.npz")
    assert load_state(problem, "digest", tmp_path / "search.npz").physics == (0.25, 0.75)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"hypotheses": FRICTIONS[:1]}, "two at least"),
        ({"hypotheses": (Hypothesis(0.0), Hypothesis())}, "positive numbers"),
        ({"spread": 0.0}, "spread 0.0"),
    ],
)
def test_hypotheses_are_checked(wrong, message):
    with pytest.raises(InputError, match=message):
        LearningTrials(**wrong)


def test_an_arm_that_is_held_up_may_stop_and_go_back():
    """As `test_an_arm_that_shoves_a_box_against_the_wall_is_held_up`, but it stops, and the hand lets go of the box."""
    outcomes = []
    for arm_stop in (0.0, 0.03):
        simulator = NativeWorld()
        simulator.reset(scene(WEDGED), ASSUMED_CELL._replace(arm_stop=arm_stop))
        outcomes.append(simulator.execute(SHOVE))
    on, back = outcomes
    assert on.reason() == back.reason() == "the arm was held up"
    assert back.tracking_error < 0.05 < on.tracking_error
    assert not back.fallen.any()


def test_an_arm_that_may_stop_does_as_any_other_where_it_is_not_held_up():
    box = standing("box", (0.078, 0.022, 0.096), 0.55, 0.1)
    action = push(pose(0.595, 0.1 - 0.1345, 0.04, tilt=math.radians(30)), (0.0, 0.15, 0.0))
    places = []
    for arm_stop in (0.0, 0.03):
        simulator = NativeWorld()
        simulator.reset(scene(box), ASSUMED_CELL._replace(arm_stop=arm_stop))
        assert simulator.execute(action).reason() is None
        places.append(np.asarray(simulator.world.position))
    assert np.abs(places[1] - places[0]).max() < 2e-3


def test_trials_say_where_objects_end_if_the_arm_goes_on_and_if_it_goes_back(problem):
    observation = seen(problem, from_scenario(scene(WEDGED)))
    row = jax.tree.map(lambda a: np.asarray(a)[None], (scenes_of(initial_belief(problem), observation), SHOVE))
    ends = NativeTrials(threads=1).ends(problem, *row)[0]
    assert ends.shape == (2, observation.objects.capacity, 3)
    assert np.abs(ends[0, 0] - ends[1, 0]).max() > 1e-3
