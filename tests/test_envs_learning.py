"""What a push does tells the friction, trials assume it from then on, and an arm that is held up may go back."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_envs_simulator import pick_and_place, pose, push, scene, standing
from test_envs_trials import EDGE as EDGES
from test_envs_trials import FIRM, LOOSE, begin, proposes, pushes, slots_of, stack

from mechsearch_jax.actions import ActionKind, kind_of, no_action
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.config.presets import standard
from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.episode.slots import OneSlot
from mechsearch_jax.envs.simulators import native
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.simulators.simulator import SimulatorConfig, controls
from mechsearch_jax.envs.trials.learning import FRICTIONS, Hypothesis, LearningTrials
from mechsearch_jax.envs.trials.named import named_trials
from mechsearch_jax.envs.trials.native import NativeTrials
from mechsearch_jax.envs.world.mismatch import ASSUMED_CELL, Mismatch
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import initial_belief, search_for_grasp
from mechsearch_jax.planner.learning import LEAST, LearnedFriction, LearnsFriction, posterior, restored
from mechsearch_jax.planner.step import SearchState, unsearched
from mechsearch_jax.planner.trials import TrialResult, scenes_of
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.searcher import Searcher
from mechsearch_jax.session.state import beginning, load_state, save_state
from mechsearch_jax.workspace.shelf import Shelf

# Falls over in front of so high a hand; where it comes to lie hangs on the friction.
TALL = standing("cylinder", (0.03, 0.03, 0.09), 0.55, 0.1)
BEFORE = scene(TALL, target=standing("cylinder", (0.02, 0.02, 0.05), 0.7, -0.2))
PUSH = push(pose(0.56, 0.1 - 0.07, 0.1), (0.0, 0.15, 0.0))
# A bottle at the front edge, and a push over it.
EDGE = standing("cylinder", (0.024, 0.024, 0.067), 0.43, 0.1)
OVER = push(pose(0.505, 0.1 - 0.1365, 0.04, tilt=math.radians(30)), (-0.05, 0.12, 0.0))
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
    learned = LearnedFriction(LearningTrials(NativeTrials(threads=1)), 1)
    learned.learn_first(problem, SearchState(initial_belief(problem), before, PUSH), after)
    best = FRICTIONS[int(learned.probabilities[0].argmax())]
    assert (best.friction > 1.0) == (friction > 1.0)
    assert learned.probabilities[0].sum() == pytest.approx(1.0)
    assert learned.probabilities[0].min() > 0.0


def test_trials_assume_what_is_most_probable(problem):
    model = LearningTrials()
    assumed = []

    class Spy(NativeTrials):
        def __call__(self, problem, scenes, actions, wanted):
            assumed.append(scenes)
            return np.zeros((2, 1), np.int32)

    spy = dataclasses.replace(model, trials=Spy())
    learned = LearnedFriction(spy, 2)
    learned.probabilities[1] = [0.0, 0.0, 0.1, 0.2, 0.7]
    two = jax.tree.map(lambda a: np.stack([a, a]), scenes_of(initial_belief(problem), pushed(problem, 1.0)[0]))
    learned.trials([0, 1])(problem, two, no_action(), np.ones((2, 1), bool))
    assert np.asarray(assumed[0].friction).tolist() == [1.0, 2.0]
    learned.forget(np.array([False, True]))
    assert learned.probabilities[1] == pytest.approx(model.prior)


def test_nothing_is_learned_where_nothing_was_done(problem):
    before, after = pushed(problem, 2.0)
    learned = LearnedFriction(LearningTrials(), 1)
    learned.learn_first(problem, unsearched(problem, before), after)
    assert learned.probabilities[0] == pytest.approx(LearningTrials().prior)


def test_what_cannot_be_simulated_teaches_nothing(problem):
    before, after = pushed(problem, 2.0)
    learned = LearnedFriction(LearningTrials(NativeTrials(threads=1)), 1)
    out_of_reach = PUSH.replace(T_world_gripper=pose(3.0, 0.0, 0.1))
    learned.learn_first(problem, SearchState(initial_belief(problem), before, out_of_reach), after)
    assert learned.probabilities[0] == pytest.approx(LearningTrials().prior)


PRIOR = np.array([0.1, 0.15, 0.5, 0.15, 0.1], np.float32)
SPREAD = 0.006


def after_one(predicted, seen):
    """The posterior where each hypothesis has objects come to rest in these places of (H, N, 3), in one way."""
    predicted, seen = np.asarray(predicted, np.float32), np.asarray(seen, np.float32).reshape(-1, 3)
    there, visible = np.ones(predicted.shape[1], bool), np.ones(len(seen), bool)
    return posterior(PRIOR, predicted[:, None], there, seen, visible, SPREAD)


def test_the_posterior_is_bayes_rule():
    prior, spread = np.array([0.25, 0.75], np.float32), 0.01
    ends = np.zeros((2, 2, 2, 3), np.float32)
    # The first hypothesis is right in its second way; the second is a spread off in both. The second object is none.
    ends[0, 0, 0, 0], ends[1, :, 0, 0], ends[:, :, 1] = 0.5, 0.01, 9.0
    there, visible = np.array([True, False]), np.array([False, True, True])
    places = np.array([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0], [0.3, 0.0, 0.0]], np.float32)
    after = posterior(prior, ends, there, places, visible, spread)
    assert after[0] / after[1] == pytest.approx(0.25 / (0.75 * 2.0**-1.5), rel=1e-4)
    assert posterior(prior, ends, there, places, np.zeros(3, bool), spread) == pytest.approx(prior)
    for _ in range(3):
        ends[1], prior = 9.0, posterior(prior, ends, there, places, visible, spread)
    assert prior.min() == pytest.approx(LEAST, rel=0.01)


def test_what_fits_is_evidence_for_what_was_assumed():
    """Actions that end near where the assumed friction has them end make another less probable."""
    predicted = np.zeros((5, 1, 3))
    predicted[:, 0, 0] = 0.007, 0.007, 0.001, 0.007, 0.007
    assert after_one(predicted, [[0.0, 0.0, 0.0]])[2] > 0.6


def test_an_object_that_is_not_seen_does_not_decide_alone():
    """Whatever else is nearest to where hypotheses have it come to rest, also if that has just come into sight."""
    predicted = np.zeros((5, 2, 3))
    predicted[:, 1, 0] = 0.1, 0.1, 0.1, 0.065, 0.06
    for others in ([], [[0.15, 0.0, 0.0]]):
        assert after_one(predicted, [[0.0, 0.0, 0.0], *others]) == pytest.approx(PRIOR)


def test_two_objects_are_not_seen_in_one():
    """A hypothesis that has two objects come to rest in one place explains only one that is seen there."""
    predicted = np.zeros((5, 2, 3))
    predicted[:4, 1, 0] = 0.02
    after = after_one(predicted, [[0.0, 0.0, 0.0], [0.02, 0.0, 0.0]])
    assert after[4] < 0.01


def test_an_object_that_is_gone_is_evidence_for_its_fall_and_one_that_stays_against_it():
    predicted = np.zeros((5, 2, 3))
    predicted[:, 1, 0] = 0.08
    predicted[4, 1] = np.inf
    gone = after_one(predicted, [[0.0, 0.0, 0.0]])
    assert PRIOR[4] < gone[4] < 0.5
    assert after_one(predicted, [[0.0, 0.0, 0.0], [0.08, 0.0, 0.0]])[4] < 0.01


def test_what_diverges_does_not_keep_the_others_from_learning():
    ends = np.zeros((5, 2, 1, 3), np.float32)
    ends[0], ends[1, 1], ends[2, :, 0, 0] = np.nan, np.nan, 0.02
    visible = np.ones(1, bool)
    after = posterior(PRIOR, ends, visible, np.zeros((1, 3), np.float32), visible, SPREAD)
    assert after[0] == pytest.approx(PRIOR[0], abs=1e-3)
    assert after[2] < 0.1
    assert after[1] > PRIOR[1]
    assert after.sum() == pytest.approx(1.0)


@pytest.mark.slow
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
    slot.state = slot.state.replace(action=PUSH)
    slot.look(jax.tree.map(lambda a: a[None], simulator.world), keys, [0])
    assert slot._learned.probabilities[0].argmax() > 2
    slot.forget(np.array([True]))
    assert slot._learned.probabilities[0] == pytest.approx(LearningTrials().prior)


@dataclasses.dataclass(frozen=True)
class Spy(LearningTrials):
    """Learns of each scene its own friction, and notes from which actions, and what trials assume."""

    acts: dict[float, int] = dataclasses.field(default_factory=dict)
    frictions: dict[float, float] = dataclasses.field(default_factory=dict)

    def learned(self, problem, probabilities, scenes, actions, seen):
        names = name_of(scenes)
        self.acts.update(zip(names, np.asarray(actions.object).tolist(), strict=True))
        assert names == name_of(scenes.replace(objects=seen))
        return np.eye(len(FRICTIONS), dtype=np.float32)[[LEARNED[name] for name in names]]

    def __call__(self, problem, scenes, actions, wanted):
        self.frictions.update(zip(name_of(scenes), np.asarray(scenes.friction).tolist(), strict=True))
        return np.full(wanted.shape, TrialResult.SUCCEEDED, np.int32)


def name_of(scenes):
    """What tells scenes apart: y of the first object."""
    return [round(float(y), 3) for y in np.asarray(scenes.objects.position)[:, 0, 1]]


# The index of the hypothesis that is learned of each scene.
LEARNED = {0.1: 0, -0.075: 3, -0.09: 4}


@pytest.mark.slow
def test_each_of_many_slots_learns_from_its_own_action_and_assumes_what_it_learned(problem):
    """Three slots, two at a time, in another order than theirs."""
    over, _, aside = pushes()
    rows = [(EDGES, False), (FIRM, False), (LOOSE, False)]
    spy = Spy()
    slots, keys = slots_of(problem, proposes(over, aside), spy, rows)
    known = slots._state.search.belief
    world = stack(*(from_scenario(begin(objects)) for objects, _ in rows))
    slots.look(world, keys, [0, 1, 2])
    done = [
        over.replace(object=jnp.int32(1)),
        jax.tree.map(lambda a: a[1], slots._state.search.action),
        over.replace(object=jnp.int32(2)),
    ]
    search = slots._state.search
    slots._state = slots._state.replace(search=search.replace(action=jax.tree.map(lambda *a: jnp.stack(a), *done)))
    slots.look(world, keys, [2, 0, 1])
    assert spy.acts == {0.1: 1, -0.075: 0, -0.09: 2}
    slots._state = slots._state.replace(search=slots._state.search.replace(belief=known))
    slots.decide(keys, [2, 0, 1])
    expected = {name: FRICTIONS[index].friction for name, index in LEARNED.items()}
    assert spy.frictions == pytest.approx(expected)
    slots.forget(np.array([True, False, False]))
    slots.decide(keys, [1, 0, 2])
    assert spy.frictions == pytest.approx(expected | {0.1: 1.0})


def test_only_trials_that_learn_are_asked_to():
    assert isinstance(named_trials("learning"), LearnsFriction)
    assert not isinstance(named_trials("physics"), LearnsFriction)
    assert restored(named_trials("physics"), {}) is None


def test_what_was_learned_is_saved(problem, tmp_path):
    learned = {"friction 1, mass 1": 0.25, "friction 2, mass 1": 0.75}
    saved = dataclasses.replace(beginning(problem), executed=False, hypothesis_probabilities=learned)
    save_state(saved, "digest", tmp_path / "search.npz")
    loaded = load_state(problem, "digest", tmp_path / "search.npz")
    assert loaded.hypothesis_probabilities == learned
    assert not loaded.executed


TWO = LearningTrials(hypotheses=(Hypothesis(), Hypothesis(2.0)))


@pytest.mark.parametrize(
    ("trials", "values", "message"),
    [
        (
            named_trials("learning"),
            (0.5, 0.5),
            "friction 1, mass 1; friction 2, mass 1 were learned, but the trials have",
        ),
        (NativeTrials(), (0.5, 0.5), "the trials learn nothing"),
        (TWO, (math.nan, 0.5), "impossible"),
        (TWO, (-0.5, 1.5), "impossible"),
        (TWO, (0.0, 0.0), "impossible"),
    ],
)
def test_what_other_trials_learned_or_is_damaged_is_not_loaded(problem, trials, values, message, tmp_path):
    saver, loader = Searcher(trials=TWO), Searcher(trials=trials)
    saver.problem = loader.problem = problem
    saver._state = dataclasses.replace(
        beginning(problem), hypothesis_probabilities=dict(zip(TWO.names, values, strict=True))
    )
    saver.save(tmp_path / "search.npz")
    with pytest.raises(InputError, match=rf"search\.npz: .*{message}"):
        loader.load(tmp_path / "search.npz")
    assert loader._now.hypothesis_probabilities == {}


def test_what_was_learned_goes_on(problem, tmp_path):
    saver, loader = Searcher(trials=TWO), Searcher(trials=TWO)
    saver.problem = loader.problem = problem
    learned = dict(zip(TWO.names, (0.25, 0.75), strict=True))
    saver._state = dataclasses.replace(beginning(problem), hypothesis_probabilities=learned)
    saver.save(tmp_path / "search.npz")
    loader.load(tmp_path / "search.npz")
    assert loader._learned(unsearched(problem, loader._now.observation), loader._now.observation).first == learned


@pytest.mark.parametrize("ok", [True, False])
def test_a_searcher_learns_from_actions_that_were_executed_to_their_end(problem, ok):
    before, after = pushed(problem, 2.0)
    searcher = Searcher(trials=LearningTrials(NativeTrials(threads=1)))
    searcher.problem = problem
    searcher._state = dataclasses.replace(beginning(problem), observation=before, action=PUSH, handed=True)
    searcher.acted(ok=ok)
    state = SearchState(searcher._now.belief, before, PUSH)
    probabilities = searcher._learned(state, after).probabilities[0]
    assert (probabilities == pytest.approx(LearningTrials().prior)) == (not ok)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"hypotheses": FRICTIONS[:1]}, "two at least"),
        ({"hypotheses": (Hypothesis(0.0), Hypothesis())}, "positive numbers"),
        ({"hypotheses": (Hypothesis(), Hypothesis(weight=2.0))}, "hypotheses are equal"),
        ({"spread": 0.0}, "spread 0.0"),
        ({"arm_stop": 0.0}, "arm_stop 0.0"),
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


def test_an_arm_that_is_held_up_on_its_way_out_leaves_what_it_has_put_down(monkeypatch):
    """It is made to believe so a moment after the hand has begun to open."""
    simulator = NativeWorld()
    action = pick_and_place(pose(0.496, 0.1, 0.1), pose(0.6, 0.2, 0.1))
    reference, _ = jax.device_get(reference_motion(kind_of(ActionKind.PICK_AND_PLACE), action, simulator.config.motion))
    late = np.arange(len(reference.q)) - int(reference.opens)
    wrist = np.eye(7)[6] * ((late > 20) & (late < 30))[:, None]
    commands = controls(reference)
    monkeypatch.setattr(native, "reference_motion", lambda *_: (reference.replace(q=reference.q + wrist), True))
    monkeypatch.setattr(native, "controls", lambda _: commands)
    places = []
    for arm_stop in (0.0, 0.5):
        bottle = standing("cylinder", (0.024, 0.024, 0.067), 0.5, 0.1)
        simulator.reset(scene(bottle), ASSUMED_CELL._replace(arm_stop=arm_stop))
        assert simulator.execute(action).reason() == "the arm was held up"
        places.append(np.asarray(simulator.world.position[0]))
    assert places[0][0] > 0.58
    assert np.abs(places[1] - places[0]).max() < 3e-3


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


def test_what_leaves_the_board_ends_nowhere(problem):
    observation = seen(problem, from_scenario(scene(EDGE)))
    row = jax.tree.map(lambda a: np.asarray(a)[None], (scenes_of(initial_belief(problem), observation), OVER))
    ends = NativeTrials(threads=1).ends(problem, *row, 0.05)[0]
    assert np.isinf(ends[:, 0]).all()


def test_trials_say_where_objects_end_if_the_arm_goes_on_and_if_it_goes_back(problem):
    observation = seen(problem, from_scenario(scene(WEDGED)))
    row = jax.tree.map(lambda a: np.asarray(a)[None], (scenes_of(initial_belief(problem), observation), SHOVE))
    ends = NativeTrials(threads=1).ends(problem, *row, 0.05)[0]
    assert ends.shape == (2, observation.objects.capacity, 3)
    assert np.abs(ends[0, 0] - ends[1, 0]).max() > 1e-3


def test_predictions_stop_where_the_arm_does(problem):
    """With a bound that the arm does not reach both ways are the same, with a smaller one the box stays behind."""
    observation = seen(problem, from_scenario(scene(WEDGED)))
    row = jax.tree.map(lambda a: np.asarray(a)[None], (scenes_of(initial_belief(problem), observation), SHOVE))
    trials = NativeTrials(threads=1)
    never, early = (trials.ends(problem, *row, bound)[0] for bound in (10.0, 0.03))
    np.testing.assert_array_equal(never[0], never[1])
    np.testing.assert_array_equal(never[0], early[0])
    assert np.abs(early[0, 0] - early[1, 0]).max() > 1e-3


def test_episodes_of_an_arm_that_stops_learn_with_its_bound():
    stops, usual = (
        Method(config=standard(trials="learning"), mismatch=Mismatch(arm_stop=bound)) for bound in (0.03, 0.0)
    )
    assert stops.trials().arm_stop == 0.03
    assert usual.trials().arm_stop == SimulatorConfig().tracking_bound
    assert stops.compile_key() != usual.compile_key()
    assert Method(mismatch=Mismatch(arm_stop=0.03)).compile_key() == Method().compile_key()
