"""The closed loop: verdicts on the true state, failures that cost a step, and a record that says what happened."""

import dataclasses
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from stage import (
    BOX,
    CYLINDER,
    HIDDEN,
    OPEN,
    TWO,
    Shuffled,
    Stage,
    grab,
    grab_nearest,
    idle,
    push_off,
    reveal,
    topple,
)

from mechsearch_jax.actions import kind_of
from mechsearch_jax.belief.moved_target import nearest_candidate
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.envs.camera.snapshot import (
    Snapshot,
    informed,
    nearest_bodies,
    oracle,
    true_target_pose,
    truth_of,
    truth_unseen,
)
from mechsearch_jax.envs.episode.closed_loop import RunSettings, Start
from mechsearch_jax.envs.episode.endings import events, verdict
from mechsearch_jax.envs.episode.episodes import run_episode
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.episode.numbering import named_observation
from mechsearch_jax.envs.episode.records import load_episode, save_episode
from mechsearch_jax.envs.episode.slots import sizes_and_truths
from mechsearch_jax.envs.recording.narration import Narrator
from mechsearch_jax.envs.recording.pictures import frame
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.envs.world.outcome import Failure
from mechsearch_jax.envs.world.world import TARGET, from_scenario
from mechsearch_jax.geometry.superquadric import Superquadrics, empty
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import search_for_grasp
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Scenario

METHOD = Method().options()
# Heavy boxes on both sides of the target and one before it: it is hidden, and every grasp hits something.
BLOCKED = Scenario(
    "blocked",
    (BOX, *(dataclasses.replace(BOX, half_size=(0.12, 0.02, 0.08), position=(0.6, y, 0.4845)) for y in (0.0, 0.14))),
    CYLINDER,
)


class Diary:
    def __init__(self):
        self.stages, self.decided_at, self.moments = [], [], []

    def busy(self, stage):
        self.stages.append(stage)

    def decided(self, moment):
        self.decided_at.append(moment.index)

    def acted(self, moment):
        self.moments.append(moment)


def run(problem, scenario, stage, policy=grab, watcher=None, **settings):
    return run_episode(Start(scenario, 0), problem, policy, stage, RunSettings(max_steps=2, **settings), watcher)


def test_a_target_in_sight_is_taken_out_at_once(problem):
    episode = run(problem, OPEN, NativeSimulator(), search_for_grasp(), options={"recognition": "oracle"})
    assert (episode.found_step, episode.graspable_step, episode.retrieved, episode.failure) == (0, 0, True, None)
    (step,) = episode.steps
    assert (step.found, step.graspable, step.belief_size, step.sequences) == (True, True, 1, 0)
    assert (step.cost, step.predicted_cost) == (1.0, None)
    assert step.action.kind == "retrieve"
    assert step.action.object is None
    assert set(step.timings) - {"compile"} == {"recognise", "plan", "judge", "simulate"}
    assert episode.config == {
        "recognition": "oracle",
        "target": "cylinder",
        "simulator": "NativeSimulator",
        "seed": 0,
    }


def test_an_informed_planner_has_found_a_hidden_target_before_the_first_action(problem):
    """It clears the way and takes the target out; what is graspable is still judged on the true state."""
    diary = Diary()
    episode = run(problem, HIDDEN, Stage(reveal), recogniser=informed, watcher=diary)
    assert not Snapshot(problem.camera, problem.shelf, from_scenario(HIDDEN)).target_seen
    assert (episode.found_step, episode.steps[0].found, episode.retrieved) == (0, True, True)
    truth = (*HIDDEN.target.position[:2], 0.0)
    for moment in diary.moments:
        assert bool(moment.belief.found)
        np.testing.assert_allclose(moment.belief.found_pose, truth, atol=1e-6)
    uninformed = run(problem, HIDDEN, Stage(reveal))
    assert uninformed.found_step == 1
    blocked = run(problem, BLOCKED, Stage(), recogniser=informed)
    assert (blocked.found_step, blocked.graspable_step, blocked.retrieved) == (0, None, False)
    assert blocked.failure == "found, but not graspable"


@dataclasses.dataclass(frozen=True)
class Hasty:
    """A recogniser that detects the target by itself, and takes it for visible wherever it is."""

    detects_target: bool = True

    def __call__(self, key, snapshot):
        return informed(key, snapshot)


def test_a_detected_target_counts_as_found_once_it_is_truly_in_sight(problem):
    episode = run(problem, HIDDEN, Stage(reveal), recogniser=Hasty())
    assert (episode.found_step, episode.graspable_step, episode.retrieved) == (1, 1, True)
    first, second = episode.steps
    assert (first.found, first.graspable, second.found, second.graspable) == (False, False, True, True)
    # The planner goes by what it takes for the target.
    assert first.belief_size == 1
    blind = run(problem, HIDDEN, Stage(), recogniser=Hasty())
    assert (blind.found_step, blind.failure) == (None, "not found")


def test_objects_are_named_after_the_nearest_bodies(problem):
    world = from_scenario(BLOCKED)
    snapshot = Snapshot(problem.camera, problem.shelf, world)
    seen = oracle(jax.random.key(0), snapshot)
    order = np.array([2, 5, 0, 1, 3, 4, 6, 7])
    bodies, there = (np.asarray(a) for a in nearest_bodies(world, jax.tree.map(lambda a: a[order], seen.objects)))
    np.testing.assert_array_equal(bodies[[0, 2, 3]], [2, 0, 1])
    assert sorted(bodies) == list(range(8))
    np.testing.assert_array_equal(there, np.isin(order, [0, 1, 2]))
    np.testing.assert_array_equal(truth_of(oracle, snapshot, seen).bodies, np.arange(8))
    np.testing.assert_array_equal(truth_of(Shuffled(tuple(order)), snapshot, seen).bodies[:3], [0, 1, 2])
    # One that is recognised where nothing is stands for no body, and has the number of an empty slot.
    astray = seen.objects.replace(position=seen.objects.position.at[1, 2].add(0.11))
    bodies, there = (np.asarray(a) for a in nearest_bodies(world, astray))
    np.testing.assert_array_equal(bodies[[0, 2]], [0, 2])
    assert bodies[1] >= 3
    np.testing.assert_array_equal(there[:3], [True, False, True])


def test_how_sure_an_object_is_keeps_to_the_object():
    bodies = np.array([2, 0, 1])
    place = np.arange(9.0).reshape(3, 3)
    objects = Superquadrics(np.ones((3, 3)), np.ones((3, 2)), place, np.ones((3, 3, 3)), np.ones(3, bool))
    seen = Observation(objects, np.array(False), np.zeros(3), np.array([0.9, 0.5, 0.7]))
    named = named_observation(seen, bodies)
    np.testing.assert_array_equal(named.confidence, [0.5, 0.7, 0.9])
    np.testing.assert_array_equal(named.objects.position, place[[1, 2, 0]])
    assert named_observation(seen.replace(confidence=None), bodies).confidence is None


def test_the_sum_of_distances_decides_which_body_an_object_stands_for(problem):
    world = from_scenario(BLOCKED)
    place = world.position[0]
    world = world.replace(
        position=world.position.at[:3].set(place[None] + jnp.array([[0, 0, 0], [0, 0.03, 0], [0, 0.3, 0]]))
    )
    seen = oracle(jax.random.key(0), Snapshot(problem.camera, problem.shelf, world))
    # The first is nearest to body 0, but the second can be nothing else: body 1 is too far from it.
    y = place[None] + jnp.array([[0.0, 0.01, 0.0], [0.0, -0.08, 0.0], [0.0, 0.31, 0.0]])
    bodies, there = nearest_bodies(world, seen.objects.replace(position=seen.objects.position.at[:3].set(y)))
    np.testing.assert_array_equal(bodies[:3], [1, 0, 2])
    assert np.asarray(there)[:3].all()


@pytest.mark.parametrize("visible", [True, False])
@pytest.mark.parametrize("before", [True, False])
@pytest.mark.parametrize("now", [True, False])
def test_what_is_taken_for_the_target_last_is_what_counts(visible, before, now):
    observation = Observation(empty(8), jnp.array(visible), jnp.zeros(3))
    truth = truth_unseen(shown=now and visible).since(truth_unseen(shown=before), observation)
    assert bool(truth.shown) == ((now and visible) if visible else before)


def test_a_detection_is_the_target_only_where_the_target_is_in_sight(problem):
    hasty = Hasty()
    shown = {}
    for name, scenario in {"hidden": HIDDEN, "open": OPEN}.items():
        snapshot = Snapshot(problem.camera, problem.shelf, from_scenario(scenario))
        seen = hasty(jax.random.key(0), snapshot)
        elsewhere = seen.replace(target_pose=seen.target_pose + jnp.array([0.0, 0.15, 0.0]))
        unseen = seen.replace(target_visible=jnp.array(False))
        shown[name] = [bool(truth_of(hasty, snapshot, look).shown) for look in (seen, elsewhere, unseen)]
        assert truth_of(informed, snapshot, seen).shown
    assert shown == {"hidden": [False, False, False], "open": [True, False, False]}


def test_objects_in_any_order_give_the_same_decisions_and_names_follow_the_bodies(problem):
    diaries, stages, records = [], [], []
    for recogniser in (oracle, Shuffled((1, 2, 0, 3, 4, 5, 6, 7)), Shuffled((7, 6, 5, 4, 3, 2, 1, 0))):
        diary, stage = Diary(), Stage()
        episode = run(problem, BLOCKED, stage, grab_nearest, diary, recogniser=recogniser)
        diaries.append(diary)
        stages.append(stage)
        records.append([dataclasses.replace(step, timings={}) for step in episode.steps])
    assert [step.action.object for step in records[0][:2]] == [0, 0]
    moved = [[int(action.object) for action in stage.actions] for stage in stages]
    for i in (1, 2):
        assert records[i] == records[0]
        assert moved[i] == moved[0]
        for plain, shuffled in zip(diaries[0].moments, diaries[i].moments, strict=True):
            jax.tree.map(np.testing.assert_array_equal, plain.observation, shuffled.observation)
            if plain.decision is not None:
                jax.tree.map(np.testing.assert_array_equal, plain.decision, shuffled.decision)
                assert frame(plain, problem).title == frame(shuffled, problem).title


@pytest.mark.parametrize("policy", ["grab", "search-for-grasp"])
def test_a_search_goes_on_until_the_target_is_out(problem, tmp_path, policy):
    diary = Diary()
    decides = grab if policy == "grab" else search_for_grasp()
    episode = run(problem, HIDDEN, Stage(reveal), decides, watcher=diary)
    assert (episode.found_step, episode.graspable_step, episode.retrieved) == (1, 1, True)
    first, second = episode.steps
    assert not first.found
    assert 1 < first.belief_size < 792
    assert first.cost > first.belief_size
    assert first.sequences >= 1
    assert first.observed_cost == second.cost == 1.0
    assert second.predicted_cost is None
    assert diary.decided_at == [0, 1]
    assert [moment.record.action.kind for moment in diary.moments][-1] == "retrieve"
    for moment in diary.moments:
        assert kind_of(int(moment.decision.action.kind)).name == moment.record.action.kind
    assert [bool(moment.outcome.retrieved) for moment in diary.moments] == [False, True]
    assert diary.stages == ["recognise", "plan", "simulate", "recognise", "plan", "judge", "simulate"]
    save_episode(episode, tmp_path / "episode.json")
    assert load_episode(tmp_path / "episode.json").steps == episode.steps


def test_failed_actions_cost_steps_and_nothing_is_rolled_back(problem):
    stage = Stage(failures=Failure.DROPPED)
    diary = Diary()
    episode = run(problem, HIDDEN, stage, watcher=diary)
    assert len(stage.actions) == 2
    assert [step.failure for step in episode.steps] == ["dropped", "dropped", None]
    assert (episode.found_step, episode.graspable_step, episode.retrieved) == (None, None, False)
    assert episode.failure == "not found"
    sizes = [step.belief_size for step in episode.steps]
    assert sizes == sorted(sizes, reverse=True)
    last = diary.moments[-1]
    assert (last.index, last.decision, last.outcome, last.record.action) == (2, None, None, None)
    assert diary.decided_at == [0, 1]


def test_a_missed_retrieval_is_tried_again_while_steps_are_left(problem):
    episode = run(problem, OPEN, Stage(retrievals=Failure.MISSED))
    assert [step.action.kind for step in episode.steps] == ["retrieve"] * 3
    assert (episode.graspable_step, episode.retrieved, episode.failure) == (0, False, "retrieval: missed")


@pytest.mark.parametrize("failure", [Failure.UNREACHABLE, Failure.FALLEN])
def test_what_trying_again_would_not_mend_is_not_tried_again(problem, failure):
    episode = run(problem, OPEN, Stage(retrievals=failure))
    assert len(episode.steps) == 1
    assert episode.failure == f"retrieval: {failure.name.lower()}"


def test_once_an_object_has_left_the_board_nothing_is_retrieved(problem):
    """The episode goes on until it is known whether the target is found and graspable."""
    diary, stage = Diary(), Stage(push_off)
    episode = run(problem, HIDDEN, stage, watcher=diary)
    assert (episode.found_step, episode.graspable_step, episode.retrieved) == (1, 1, False)
    assert episode.failure == "an object fell off the board at action 1"
    first, second = episode.steps
    assert (first.fallen, first.target_fallen, first.failure) == ((0,), False, None)
    assert (second.graspable, second.action, second.fallen) == (True, None, None)
    assert len(stage.executed) == 1
    assert (diary.moments[-1].decision, diary.moments[-1].outcome) == (None, None)


def test_a_search_goes_on_after_an_object_has_left_the_board(problem):
    """At the second action it has long been off it, and the target is not found."""

    def away(world):
        """The other box, which hides nothing."""
        return world.replace(position=world.position.at[1].set(jnp.array([0.39, -0.2, 0.4845])))

    episode = run(problem, TWO, Stage(away))
    assert [step.action is not None for step in episode.steps] == [True, True, False]
    assert [step.fallen for step in episode.steps] == [(1,), (), None]
    assert (episode.found_step, episode.failure) == (None, "an object fell off the board at action 1")


def test_an_object_that_falls_in_a_retrieval_is_blamed_on_it(problem):
    """Thrown down, it has the failure of its own action; before or beside that, it does not."""
    stage = Stage(retrievals=Failure.FALLEN)
    stage.replace = lambda scenarios: off(Stage.replace(stage, scenarios))

    def off(world):
        stage._worlds[0] = push_off(stage._worlds[0])
        return world

    episode = run(problem, OPEN, stage)
    assert [(step.fallen, step.failure) for step in episode.steps] == [((0,), "retrieval: fallen")]
    assert episode.failure == "retrieval: an object fell off the board at action 1"


@pytest.mark.parametrize("failing", ["failures", "retrievals"])
def test_an_arm_that_is_held_up_has_failed(problem, failing):
    """A target that is out of the shelf all the same cannot be taken out once more."""
    start = HIDDEN if failing == "failures" else OPEN
    episode = run(problem, start, Stage(**{failing: Failure.HELD_UP}))
    retrieval = "" if failing == "failures" else "retrieval: "
    assert episode.steps[0].failure == f"{retrieval}the arm was held up"
    assert episode.steps[0].held_up
    assert episode.steps[0].tracking_error == pytest.approx(0.001)
    assert not episode.retrieved
    assert len(episode.steps) == (3 if failing == "failures" else 1)
    assert episode.failure == ("not found" if failing == "failures" else "retrieval: the arm was held up")


def test_what_never_comes_to_rest_is_recorded_and_is_no_error(problem):
    episode = run(problem, HIDDEN, Stage(reveal, restless=True))
    assert episode.retrieved
    assert [step.at_rest for step in episode.steps] == [False, False]
    assert verdict(episode).endswith(": the target is out after 2 actions; something still moves")
    assert events(episode.steps[0]) == ["something still moves"]
    calm = run(problem, HIDDEN, Stage(push_off))
    assert ";" not in verdict(calm)
    assert events(calm.steps[0]) == ["object 0 fell off the board: nothing can be retrieved any more"]
    assert events(calm.steps[1]) == []


def test_every_step_says_whether_the_truth_is_possible(problem):
    """Unseen, the target moves to where it was not hidden before; and back into the open."""
    elsewhere = jnp.array([0.55, -0.1, 0.4545])
    stage = Stage(lambda world: world.replace(position=world.position.at[TARGET].set(elsewhere)))

    def blind(key, snapshot):
        return dataclasses.replace(oracle(key, snapshot), target_visible=jnp.array(False))

    episode = run(problem, HIDDEN, stage, recogniser=blind)
    assert [step.truth_possible for step in episode.steps] == [True, False, False]
    assert [step.around_possible for step in episode.steps] == [True, False, False]
    assert [step.restarts for step in episode.steps] == [0, 0, 0]
    row = EpisodeRow.of_episode(dataclasses.replace(episode, config={**METHOD, **episode.config}))
    assert (row.looks, row.truth_lost, row.truth_lost_step, row.restarts) == (3, 2, 1, 0)
    assert (row.truth_ruled_out, row.truth_ruled_out_step) == (2, 1)
    episode = run(problem, HIDDEN, Stage(reveal))
    assert [step.truth_possible for step in episode.steps] == [True, None]
    tipped = run(problem, HIDDEN, Stage(lambda world: reveal(topple(world))), recogniser=blind)
    assert [step.truth_possible for step in tipped.steps] == [True, None, None]
    assert [step.around_possible for step in tipped.steps] == [True, None, None]


@pytest.mark.parametrize(("cells", "yaw", "around"), [((0, 0), 3, True), ((1, -1), 2, True), ((0, 2), 0, False)])
def test_the_truth_is_ruled_out_where_no_cell_around_it_is_possible(problem, cells, yaw, around):
    world = jax.tree.map(lambda a: a[None], from_scenario(HIDDEN))
    size, grid, yaws = problem.poses.shape[0], problem.target.grid, problem.target.yaws
    truth = int(nearest_candidate(problem.poses, true_target_pose(from_scenario(HIDDEN)), problem.target.turn))
    row, column = np.add(np.divmod(truth // yaws, grid[1]), cells)
    exists = np.zeros((1, size), bool)
    exists[0, (row * grid[1] + column) * yaws + yaw % yaws] = True
    # The first and the last cell are no neighbours of one another.
    exists[0, :yaws] = True
    sizes, _, possible = sizes_and_truths(problem, jnp.asarray(exists), world)
    assert (int(sizes[0]), bool(possible[0])) == (1 + yaws, around)


def test_an_f_that_becomes_empty_is_counted(problem):
    def nowhere(key, snapshot):
        """Nothing stands, and the target is not seen: it can be nowhere."""
        seen = oracle(key, snapshot)
        nothing = seen.objects.replace(valid=jnp.zeros_like(seen.objects.valid))
        return Observation(nothing, jnp.array(False), seen.target_pose)

    episode = run(problem, HIDDEN, Stage(), recogniser=nowhere)
    assert [step.restarts for step in episode.steps] == [1, 2, 3]


def test_after_the_last_action_only_a_retrieval_is_executed(problem):
    def never(key, problem, belief, observation):
        """Goes on pushing."""
        return grab(key, problem, belief.replace(found=jnp.array(False)), observation)

    stage = Stage()
    episode = run(problem, OPEN, stage, never)
    assert len(stage.actions) == 2
    assert (episode.found_step, episode.graspable_step, episode.failure) == (0, 0, "found, but not graspable")
    last = episode.steps[-1]
    assert (last.cost, last.action, last.predicted_cost, last.sequences) == (None, None, None, 0)


def test_where_no_action_is_possible_a_step_passes(problem):
    stage = Stage()
    episode = run(problem, HIDDEN, stage, idle)
    assert [step.failure for step in episode.steps] == ["no action is possible"] * 2 + [None]
    assert [step.action.kind for step in episode.steps[:2]] == ["none", "none"]
    assert episode.failure == "not found"


def test_an_unknown_kind_of_action_is_refused(problem):
    def odd(key, problem, belief, observation):
        decision = grab(key, problem, belief, observation)
        return decision.replace(action=decision.action.replace(kind=jnp.int32(8)))

    with pytest.raises(InputError, match="kind 8 is unknown"):
        run(problem, HIDDEN, Stage(), odd)


def test_a_target_that_fell_over_is_found_but_not_graspable(problem):
    episode = run(problem, HIDDEN, Stage(topple))
    assert (episode.found_step, episode.graspable_step, episode.retrieved) == (1, None, False)
    assert episode.failure == "the target fell over"
    assert episode.steps[-1].action is None


def test_verdicts_are_passed_on_the_truth_and_not_on_what_was_recognised(problem):
    def blind(key, snapshot):
        """Sees the target, but no object."""
        seen = oracle(key, snapshot)
        nothing = seen.objects.replace(valid=jnp.zeros_like(seen.objects.valid))
        return Observation(nothing, jnp.array(True), seen.target_pose)

    front = dataclasses.replace(BOX, position=(0.52, 0.07, 0.4845))
    stage = Stage(retrievals=Failure.MISSED)
    episode = run(problem, Scenario("blocked", (front,), CYLINDER), stage, recogniser=blind)
    assert episode.steps[0].action.kind == "retrieve"
    assert episode.graspable_step is None


def test_the_same_seed_gives_the_same_decisions_whatever_the_recogniser_draws(problem):
    def drawing(key, snapshot):
        jax.random.normal(key)
        return oracle(key, snapshot)

    chosen = []
    for recogniser in (oracle, drawing):
        stage = Stage()
        run_episode(Start(HIDDEN, 3), problem, grab, stage, RunSettings(recogniser, max_steps=2))
        chosen.append([np.asarray(action.displacement) for action in stage.actions])
    np.testing.assert_array_equal(*chosen)
    planner_key, _ = jax.random.split(jax.random.key(3))
    drawn = [jax.random.uniform(jax.random.fold_in(planner_key, i), minval=0.05, maxval=0.15) for i in range(2)]
    np.testing.assert_array_equal([d[1] for d in chosen[0]], drawn)


def test_the_oracle_leaves_out_what_fell_off_the_board(problem):
    world = from_scenario(OPEN)
    fallen = world.replace(position=world.position.at[0, 2].set(0.1))
    seen = oracle(jax.random.key(0), Snapshot(problem.camera, problem.shelf, fallen))
    assert not seen.objects.valid.any()
    assert seen.target_visible
    np.testing.assert_allclose(seen.target_pose, [0.62, 0.07, 0.0], atol=1e-6)


def test_what_is_narrated_of_an_episode_is_what_its_record_says(problem):
    console = Console(record=True, width=200, file=io.StringIO())
    narrator = Narrator(console, console.status("begins"), problem)
    episode = run(problem, HIDDEN, Stage(reveal, retrievals=Failure.MISSED), watcher=narrator)
    narrator.ended(episode)
    first, *others = console.export_text().split("step 2")
    narrated = others[0]
    assert f"no target; it can be at {episode.steps[0].belief_size} of 792 poses" in first
    assert f"cost {episode.steps[0].cost:.0f} now" in first
    assert "the target at x" in narrated
    assert "a grasp that takes it out is known" in narrated
    assert "failed  the hand missed the target" in narrated
    assert narrated.strip().endswith(verdict(episode))
    assert len(narrator.frames) == len(episode.steps)
    assert [frame.found for frame in narrator.frames] == [False, True, True]
    assert "the hand missed the target" in narrator.frames[1].caption
