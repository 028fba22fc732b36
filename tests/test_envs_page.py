"""The page that explains an episode: what a recording keeps for it, what it says, and that it holds everything."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recordings import (
    EPISODE,
    FAR,
    LOST,
    OBJECTS,
    POSES,
    PUSH,
    RECORDING,
    RETRIEVAL,
    SEQUENCES,
    SLOTS,
    STEPS,
    evidence,
    record,
    stacked,
    step,
)
from scipy.spatial.transform import Rotation
from stage import HIDDEN

from mechsearch_jax.actions import no_action
from mechsearch_jax.commands import main as cli
from mechsearch_jax.envs.episode.numbering import named_tried
from mechsearch_jax.envs.episode.records import save_episode
from mechsearch_jax.envs.known_target.in_the_way import blocking, grasps_in_words, least_sets, objects_in_words
from mechsearch_jax.envs.page import page as pages
from mechsearch_jax.envs.page.ending import ending
from mechsearch_jax.envs.page.facts import plain
from mechsearch_jax.envs.page.page import RECORD, page, recording_with_record
from mechsearch_jax.envs.page.pictures import Painter, hidden_behind, last_world, tried_grasp
from mechsearch_jax.envs.page.steps import candidates, shapes
from mechsearch_jax.envs.recording.evidence import Forecasts, foreseen_rows
from mechsearch_jax.envs.recording.narration import verdict
from mechsearch_jax.envs.recording.recording import NAME, load_recording, save_recording
from mechsearch_jax.envs.recording.sampled import Sampled
from mechsearch_jax.envs.world.world import TARGET, from_scenario
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Decision, initial_belief
from mechsearch_jax.planner.noted_trials import NotedTrials, TriedActions
from mechsearch_jax.planner.trials import TrialResult, decide, sequences_to_try
from mechsearch_jax.runtime.errors import InputError


@pytest.fixture(scope="module")
def text():
    return page(LOST)


def words(text):
    """What a reader sees, without the pictures."""
    return " ".join(re.sub(r"<(style|script).*?</\1>|<[^>]*>", " ", text, flags=re.S).split())


def test_evidence_comes_back_as_it_was_written(tmp_path):
    save_recording(LOST, tmp_path / NAME)
    again = load_recording(tmp_path / NAME)
    assert again.episode == EPISODE
    for read, written in zip(again.steps, LOST.steps, strict=True):
        for name in ("confidence", "believed_pose", "hits"):
            np.testing.assert_array_equal(getattr(read.evidence, name), getattr(written.evidence, name))
        jax.tree.map(np.testing.assert_array_equal, read.evidence.tried, written.evidence.tried)
        for field in dataclasses.fields(Forecasts):
            ours, theirs = (getattr(each.evidence.forecasts, field.name) for each in (read, written))
            np.testing.assert_array_equal(ours, theirs)


def test_a_recording_of_an_earlier_version_opens(tmp_path):
    save_recording(RECORDING, tmp_path / NAME)
    with np.load(tmp_path / NAME) as file:
        assert not [name for name in file if name.startswith("evidence")]
        assert '"episode"' not in str(file["head"])
    again = load_recording(tmp_path / NAME)
    assert again.episode is None
    assert [step.evidence for step in again.steps] == [None] * 3


def halve_hits(arrays):
    arrays["evidence.hits"] = arrays["evidence.hits"][1:]


def forget_results(arrays):
    del arrays["evidence.result"]


def invent_results(arrays):
    arrays["evidence.result"] = arrays["evidence.result"] + 40


def negate_rows(arrays):
    arrays["evidence.foreseen.existence.rows"] = -arrays["evidence.foreseen.existence.rows"]


def retype_confidence(arrays):
    arrays["evidence.confidence"] = arrays["evidence.confidence"].astype("U3")


@pytest.mark.parametrize("spoil", [halve_hits, forget_results, invent_results, negate_rows, retype_confidence])
def test_damaged_evidence_is_refused_in_one_line(spoil, tmp_path):
    save_recording(LOST, tmp_path / NAME)
    with np.load(tmp_path / NAME) as file:
        arrays = dict(file)
    spoil(arrays)
    np.savez(tmp_path / NAME, **arrays)
    with pytest.raises(InputError, match=f"{NAME}: is no recording of an episode") as refused:
        load_recording(tmp_path / NAME)
    assert "\n" not in str(refused.value)


def test_the_card_says_why_the_target_was_lost(text):
    sentences = words(text)
    assert "Lost: found, but not graspable" in sentences
    # The second grasp hits more than the first.
    used = "The only action that an episode may have was used up before any grasp of the target was free."
    hit = "Object 0 stands in the way of each of the 2 grasps of the target that the arm can reach."
    assert f"{hit} Action 1 was to move object 0" not in sentences
    assert f"{hit} {used}" in sentences
    assert "Yellow: in the way" in sentences
    assert "J was to fall by" not in sentences
    assert "actions 1 of at most 1" in sentences


def test_a_target_that_was_taken_out_is_explained_in_the_picture(text):
    said = "Red: the target, held in front of the shelf."
    won = dataclasses.replace(LOST, episode=dataclasses.replace(EPISODE, retrieved=True, failure=None))
    assert said in words(page(won))
    assert "J was to fall by 40 in all, and fell by 5" in words(page(won))
    assert said not in words(text)


def test_captions_name_only_what_a_picture_shows(text):
    first, last = text.split('<section class="step"')[1:]
    assert "and the action (hand dark" in words(first)
    assert "since the step before" not in words(first)
    assert "What the camera saw." in words(last)
    assert "and the action (hand dark" not in words(last)
    assert "Red: the target. Yellow: in the way" in words(last)
    taken = dataclasses.replace(STEPS[1], action=RETRIEVAL)
    _, last = page(dataclasses.replace(LOST, steps=(STEPS[0], taken))).split('<section class="step"')[1:]
    assert "(hand dark; red, dashed: the target on its way out)" in words(last)
    assert "blue dashed" not in words(last)


@pytest.mark.parametrize(("gone", "opened"), [(False, False), (True, False), (True, True)])
def test_captions_name_poses_that_changed_only_where_some_did(gone, opened):
    before = np.arange(POSES) % 2 == 0
    now = before.copy()
    now[0], now[1] = not gone, opened
    steps = [
        dataclasses.replace(step, found=False, evidence=evidence(), existence=existence)
        for step, existence in zip(STEPS, (before, now), strict=True)
    ]
    _, last = page(dataclasses.replace(LOST, steps=tuple(steps))).split('<section class="step"')[1:]
    assert ("Grey crosses: ruled out" in words(last)) == gone
    assert ("Blue crosses: opened again" in words(last)) == opened


def test_a_step_shows_the_decision_beside_the_runner_up(text):
    sentences = words(text)
    assert "chosen: push object 0 by 10 cm" in sentences
    assert "runner-up, refused after its trial: push object 0 by 20 cm" in sentences
    assert f"Predicted: f at {POSES} poses, graspable at {POSES}, J 90. Counting its whole sequence" in sentences
    assert "and what it may move unseen, J changes by -30.0." in sentences
    assert "J: 100 before, 60 expected, 95 observed. It came out worse than expected." in sentences


def of_objects(*objects):
    """Candidates that move these objects, the best first; all else is alike."""
    count = len(objects)
    action = stacked(*(PUSH.replace(object=np.int32(i), q7=np.float32(k)) for k, i in enumerate(objects)))
    positions, rotations = (np.stack([np.asarray(a)] * count) for a in (OBJECTS.position, OBJECTS.rotation))
    return Sampled(action, -np.arange(count, 0.0, -1), np.full(count, 90.0), positions, rotations)


def test_the_best_candidate_that_moves_another_object_is_shown_and_foreseen():
    several = of_objects(0, 0, 2, 3)
    assert foreseen_rows(several) == [0, 1, 2]
    assert foreseen_rows(of_objects(0, 2, 0)) == [0, 1]
    assert foreseen_rows(of_objects(0)) == [0]
    everywhere = np.ones((3, POSES), bool)
    everywhere[2, 5:] = False
    forecasts = Forecasts(np.array([0, 1, 2]), everywhere, np.ones((3, POSES), int), np.full(3, -1, np.int32))
    chosen = dataclasses.replace(
        STEPS[0],
        sampled=several,
        action=several.single(0),
        evidence=dataclasses.replace(evidence(), forecasts=forecasts),
    )
    shown = candidates(chosen)
    assert [(c.role, c.row) for c in shown] == [("chosen", 0), ("runner-up", 1), ("best of another object", 2)]
    assert shown[2].belief == "f at 5 poses, graspable at 5"
    assert shown[2].words.startswith("push object 2")
    two = dataclasses.replace(chosen, sampled=of_objects(0, 2))
    assert [c.role for c in candidates(two)] == ["chosen", "runner-up"]
    tried = TriedActions(stacked(two.sampled.single(1)), np.array([TrialResult.FAILED], np.int32))
    failed = dataclasses.replace(two, evidence=dataclasses.replace(two.evidence, tried=tried))
    assert [c.role for c in candidates(failed)] == ["chosen", "runner-up, passed over after its trial"]


def test_forecasts_of_an_earlier_version_are_of_the_best_candidates(tmp_path):
    save_recording(LOST, tmp_path / NAME)
    with np.load(tmp_path / NAME) as file:
        arrays = {name: file[name] for name in file if not name.startswith("evidence.foreseen.row")}
    np.savez(tmp_path / NAME, **arrays)
    again = load_recording(tmp_path / NAME)
    assert [step.evidence.forecasts.row.tolist() for step in again.steps] == [[0, 1]] * 2


def test_a_step_says_what_trials_came_to_and_what_perception_saw(text):
    sentences = words(text)
    assert "push object 0 by 20 cm to the left harm: something fell off the board" in sentences
    assert re.search(
        r"the found target fell over refused push object 0 by 10 cm to the left went as intended chosen", sentences
    )
    assert "0 box, 10 × 6 × 16 cm 90 % 0.0 cm" in sentences


def test_an_object_that_shows_too_little_is_hidden_and_not_missed():
    nothing = dataclasses.replace(STEPS[0], scene=OBJECTS.replace(valid=np.zeros(SLOTS, bool)))
    owner = np.full((20, 20), TARGET)
    ((*_, words, _, _, wrong),) = shapes(LOST, nothing, owner)
    assert (words, wrong) == ("hidden", False)
    ((*_, words, _, _, wrong),) = shapes(LOST, nothing, np.zeros((20, 20), int))
    assert (words, wrong) == ("not recognised", True)
    given = dataclasses.replace(EPISODE, config={**EPISODE.config, "recognition": "oracle"})
    assert shapes(dataclasses.replace(LOST, episode=given), nothing, owner) == []


def test_a_page_holds_everything_and_loads_nothing(text):
    assert len(text) < 3_000_000
    sources = re.findall(r"\b(?:src|href)=\"([^\"]*)\"", text)
    assert len(sources) > 8
    assert all(source.startswith(("data:image/webp;base64,", "#step-")) for source in sources)
    assert not re.search(r"https?:|<link|@import|url\(|fetch\(|XMLHttpRequest", re.sub(r"base64,[^\"]*", "", text))


def test_what_is_shown_is_escaped():
    evil = "<script>alert(1)</script>"
    failure = f"found <b>{evil}</b>"
    steps = (dataclasses.replace(EPISODE.steps[0], failure=evil), EPISODE.steps[1])
    episode = dataclasses.replace(EPISODE, failure=failure, config={"policy": evil, "max_steps": 1}, steps=steps)
    text = page(dataclasses.replace(LOST, heading=f"{evil}: lost", episode=episode))
    assert "alert(1)" in text
    assert evil not in text
    assert "<b>" not in text


def test_what_an_earlier_recording_lacks_is_left_out_with_a_sentence():
    sentences = words(page(RECORDING))
    assert "hidden retrieved" in sentences
    assert "The recording is of an earlier version" in sentences
    assert "The record of the episode is missing" in sentences
    assert "chosen: push object 0 by 10 cm" in sentences
    assert "tried out" not in sentences
    assert "confidence off by" not in sentences


def test_the_record_beside_an_earlier_recording_is_used(tmp_path):
    earlier = dataclasses.replace(RECORDING, heading=verdict(EPISODE), steps=RECORDING.steps[:2])
    save_recording(earlier, tmp_path / NAME)
    assert recording_with_record(tmp_path).episode is None
    save_episode(EPISODE, tmp_path / RECORD)
    assert recording_with_record(tmp_path).episode == EPISODE
    for other in (RECORDING, dataclasses.replace(earlier, heading="hidden: retrieved")):
        save_recording(other, tmp_path / NAME)
        with pytest.raises(InputError, match="is of another episode"):
            recording_with_record(tmp_path)


def test_endings_name_what_happened():
    def of(failure, steps=EPISODE.steps, recorded=STEPS):
        episode = dataclasses.replace(EPISODE, failure=failure, steps=steps, found_step=None)
        return ending(dataclasses.replace(LOST, episode=episode, steps=recorded))

    fell = of("an object fell off the board at action 1", (record(PUSH, fallen=(2,)), EPISODE.steps[1]))
    assert fell.title == "Lost: an object fell off the board at action 1"
    assert "Object 2 fell off the board at action 1, “push object 0 by 10 cm" in fell.sentences[0]
    assert "Its trial (simulated before acting) had gone as intended, and nothing fell off the board." in fell.words
    assert not fell.blockers
    toppled = of("the target fell over", (record(PUSH, target_fallen=True), EPISODE.steps[1]))
    assert toppled.sentences[0].startswith("The target fell over at action 1, “push object 0")
    unseen = of("not found", recorded=(STEPS[0], dataclasses.replace(STEPS[1], found=False, evidence=evidence())))
    assert unseen.sentences[-1].endswith("and the camera never saw the target.")
    assert unseen.cause.endswith("hidden from the camera by object 0.")
    assert f"of {POSES} places, the true one among them." in unseen.words
    # The best was also chosen.
    moved = "3 of the 3 candidate actions were to move object 0 (1 refused after simulation); the best was expected to "
    assert f"{moved}lower J by 30 (action 1)." in unseen.words
    taking = dataclasses.replace(STEPS[1], action=RETRIEVAL)
    missed = of("retrieval: missed", (EPISODE.steps[0], record(RETRIEVAL, found=True)), (STEPS[0], taking))
    assert missed.title == "Lost: the hand missed the target"
    assert missed.sentences[0] == "The target was to be taken out by action 2, but the hand missed the target."
    # The first step's trace moves object 0.
    moving = dataclasses.replace(taking, trace=STEPS[0].trace)
    missed = of("retrieval: missed", (EPISODE.steps[0], record(RETRIEVAL, found=True)), (STEPS[0], moving))
    assert missed.sentences[0].endswith("the hand missed the target. Object 0 moved meanwhile.")
    won = ending(dataclasses.replace(LOST, episode=dataclasses.replace(EPISODE, retrieved=True, failure=None)))
    assert won.good
    assert not won.blockers


def lost(failure, found=False, tried=None, **changes):
    """How an episode ended after a push whose candidates were tried like this."""
    first = dataclasses.replace(STEPS[0], evidence=evidence(tried=tried), **changes)
    last = dataclasses.replace(STEPS[1], found=found, evidence=evidence(found=found))
    episode = dataclasses.replace(EPISODE, failure=failure, found_step=1 if found else None)
    return ending(dataclasses.replace(LOST, episode=episode, steps=(first, last)))


def test_candidates_that_trials_refused_are_counted_once():
    other = PUSH.replace(object=np.int32(3))
    results = np.array([TrialResult.HARMFUL, TrialResult.UNKNOWN, TrialResult.FAILED], np.int32)
    tried = TriedActions(stacked(PUSH.replace(q7=np.float32(1.0)), other, PUSH), results)
    kept = STEPS[0].sampled
    of_others = dataclasses.replace(kept, action=kept.action.replace(object=np.full(2, 3, np.int32)))
    refused = lost("not found", tried=tried, sampled=of_others).words
    assert "1 of the 4 candidate actions was to move object 0 (1 refused after simulation)" in refused
    none = lost("not found", sampled=of_others).words
    assert "None of the 2 candidate actions was to move object 0 (why none was a candidate is not known)." in none
    # The sequences of a retrieval hold those that were refused.
    twice = TriedActions(stacked(PUSH, FAR), np.array([TrialResult.HARMFUL, TrialResult.FAILED], np.int32))
    taking = lost("not found", tried=twice, action=RETRIEVAL).words
    assert "2 of the 2 candidate actions were to move object 0 (1 refused after simulation" in taking


def test_a_push_that_fails_is_no_grasp():
    assert plain("retrieval: unreachable") == "the arm cannot follow the grasp"
    assert plain("unreachable") == "the arm cannot follow the action"
    assert plain("missed") == "missed"
    steps = (dataclasses.replace(EPISODE.steps[0], failure="unreachable"), EPISODE.steps[1])
    sentences = words(page(dataclasses.replace(LOST, episode=dataclasses.replace(EPISODE, steps=steps))))
    assert "What went wrong: the arm cannot follow the action." in sentences


def test_a_target_that_shows_and_is_not_detected_is_said_so():
    uncovered = jax.tree.map(np.asarray, from_scenario(HIDDEN))
    uncovered = uncovered.replace(valid=np.arange(len(uncovered.valid)) == TARGET)
    last = dataclasses.replace(STEPS[1], found=False, evidence=evidence(), world=uncovered)
    episode = dataclasses.replace(EPISODE, failure="not found", found_step=None)
    (first, *_) = ending(dataclasses.replace(LOST, episode=episode, steps=(STEPS[0], last))).sentences
    assert re.search(r"never found\. It showed \d+ pixels at the last look and was not detected\.$", first)


def test_decisions_are_the_same_with_trials_that_are_noted(problem):
    codes = np.array([[TrialResult.HARMFUL, TrialResult.FAILED, TrialResult.UNKNOWN]], np.int32)
    objects = jax.tree.map(jnp.asarray, OBJECTS)
    sequences = jax.tree.map(jnp.asarray, SEQUENCES)
    first = jax.tree.map(lambda a: a[0, 0], sequences.actions)
    alternatives = sequences_to_try(sequences, objects, jnp.float32(0.0))
    decision = Decision(
        first,
        sequences.value[0],
        jnp.float32(100.0),
        sequences.cost[0, 0],
        objects,
        sequences,
        alternatives=alternatives,
    )
    observation = Observation(objects, jnp.array(False), jnp.zeros(3))
    for row in (codes, codes[:, ::-1], np.full_like(codes, TrialResult.SUCCEEDED)):

        def trials(problem, scenes, actions, wanted, row=row):
            return row

        noted = NotedTrials(trials)
        arguments = (jax.random.key(0), problem, initial_belief(problem), observation)
        plainly, noting = (decide(lambda *_: decision, each, *arguments) for each in (trials, noted))
        jax.tree.map(np.testing.assert_array_equal, plainly, noting)
        assert len(noted.tried().result)
    assert int(plainly.refused) == 0


def test_the_objects_that_hide_the_target_are_named():
    (first, share), *rest = hidden_behind(RECORDING.steps[0], RECORDING.camera, RECORDING.shelf)
    assert first == 0
    assert share > 0.9
    assert not rest
    gone = jax.tree.map(np.asarray, from_scenario(HIDDEN))
    gone = gone.replace(valid=np.arange(len(gone.valid)) == TARGET)
    assert hidden_behind(step("1  look", world=gone), RECORDING.camera, RECORDING.shelf) == []


def test_an_action_that_moves_the_target_is_named():
    def of(metres):
        world = STEPS[1].world
        position = np.array(world.position)
        position[TARGET, 0] += metres
        moved = dataclasses.replace(STEPS[1], world=world.replace(position=position))
        return ending(dataclasses.replace(LOST, steps=(STEPS[0], moved))).words

    assert re.search(r"Action 1, “push object 0 .*”, brought the target into view and moved it by 5 cm\.", of(0.05))
    assert "moved it by" not in of(0.004)


def test_objects_that_were_tipped_are_named_and_never_said_to_stand():
    quarter = Rotation.from_euler("x", 90, degrees=True).as_matrix().astype(np.float32)

    def of(turn, **changes):
        """The sentences of an episode whose first action turned object 0."""
        world = STEPS[1].world
        rotation = np.array(world.rotation)
        rotation[0] = turn @ rotation[0]
        episode = dataclasses.replace(EPISODE, **changes)
        turned = dataclasses.replace(STEPS[1], world=world.replace(rotation=rotation))
        return ending(dataclasses.replace(LOST, steps=(STEPS[0], turned), episode=episode)).words

    won = {"retrieved": True, "failure": None}
    said = of(quarter, **won)
    assert "no object fell off the board. In the run, action 1 tipped object 0." in said
    assert "no object fell over or off the board." in of(np.eye(3, dtype=np.float32), **won)
    yawed = Rotation.from_euler("z", 90, degrees=True).as_matrix().astype(np.float32)
    assert "no object fell over or off the board." in of(yawed, **won)
    assert "In the run, action 1 tipped object 0." in of(quarter)
    # What fell off the board is no more on it.
    off = (dataclasses.replace(EPISODE.steps[0], fallen=(0,)), EPISODE.steps[1])
    assert "tipped" not in of(quarter, steps=off, failure="an object fell off the board at action 1")


def test_a_target_that_no_grasp_reaches_is_said_to_be_near_a_wall():
    world = STEPS[1].world
    position = np.array(world.position)
    position[TARGET, :2] = RECORDING.shelf.back - 0.02, 0.1
    none = dataclasses.replace(evidence(found=True), hits=np.zeros((0, SLOTS), bool))
    last = dataclasses.replace(STEPS[1], world=world.replace(position=position), evidence=none)
    said = ending(dataclasses.replace(LOST, steps=(STEPS[0], last))).words
    assert said.startswith(
        "The target stands against the back wall, and there the arm can reach no grasp of it. The only "
    )
    assert "after it none: the target’s middle is 2.0 cm from the back wall, and was" in said
    position[TARGET, :2] = 0.6, RECORDING.shelf.left - 0.03
    last = dataclasses.replace(last, world=world.replace(position=position))
    said = ending(dataclasses.replace(LOST, steps=(STEPS[0], last))).words
    assert "3.0 cm from a side wall, and was" in said


def test_a_target_that_lies_at_the_end_is_explained_in_the_pictures():
    def of(x=0.6, **changes):
        """What is said of an episode at whose end the target lies, alone on the board or in front of it."""
        world = STEPS[1].world
        rotation, position = np.array(world.rotation), np.array(world.position)
        position[TARGET, 0] = x
        rotation[TARGET] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
        lying = world.replace(rotation=rotation, position=position, valid=np.arange(len(world.valid)) == TARGET)
        episode = dataclasses.replace(EPISODE, **changes)
        last = dataclasses.replace(STEPS[1], world=lying)
        return words(page(dataclasses.replace(LOST, steps=(STEPS[0], last), episode=episode)))

    lies = of(failure="the target fell over")
    assert "Red: the target, which no longer stands." in lies
    assert lies.count("Red: the target, which no longer stands.") == 3
    assert "is not drawn" not in lies
    assert "no longer stands" not in of(retrieved=True, failure=None)
    out = of(x=RECORDING.shelf.front - 0.05, failure="retrieval: an object fell off the board at action 2")
    assert "The target, outside the shelf, is not drawn." in out
    assert "no longer stands" not in out
    assert "no longer stands" not in words(page(LOST))


def test_where_no_candidate_promises_anything_the_card_says_so():
    def of(value, cost=2.0):
        kept = STEPS[1].sampled if len(STEPS[1].sampled) else STEPS[0].sampled
        flat = dataclasses.replace(kept, value=np.full(len(kept), value), cost=np.full(len(kept), cost))
        last = dataclasses.replace(STEPS[1], sampled=flat, evidence=evidence(found=True))
        return ending(dataclasses.replace(LOST, steps=(STEPS[0], last))).words

    said = "No candidate action since it was seen was expected to lower J. 2 of these 2 were to move object 0."
    assert said in of(-0.01)
    said = "No candidate action"
    assert said not in of(-1.0)
    # A policy that minds no cost.
    assert said not in of(0.0, 0.0)


def test_a_policy_that_minds_no_cost_is_shown_none():
    kept = STEPS[0].sampled
    flat = dataclasses.replace(kept, value=np.zeros(len(kept)), cost=np.zeros(len(kept)))
    steps = (dataclasses.replace(STEPS[0], sampled=flat), STEPS[1])
    free = dataclasses.replace(EPISODE.steps[0], cost=0.0, predicted_cost=0.0, observed_cost=0.0)
    episode = dataclasses.replace(EPISODE, steps=(free, EPISODE.steps[1]))
    said = words(page(dataclasses.replace(LOST, steps=steps, episode=episode)))
    assert f"Predicted: f at {POSES} poses, graspable at {POSES}." in said
    assert "Cost." not in said
    assert "changes J" not in said


def test_a_cost_of_a_retrieval_is_explained():
    taking = dataclasses.replace(STEPS[1], action=RETRIEVAL)
    said = words(page(dataclasses.replace(LOST, steps=(STEPS[0], taking))))
    assert "60 expected, 95 observed, as a grasp that takes the target out is known then" in said


def test_the_hand_of_a_grasp_that_was_tried_is_drawn_where_the_search_ends():
    tried = TriedActions(stacked(PUSH, RETRIEVAL), np.array([TrialResult.SUCCEEDED, TrialResult.FAILED], np.int32))
    last = dataclasses.replace(STEPS[1], evidence=evidence(found=True, tried=tried))
    np.testing.assert_array_equal(tried_grasp(last).T_world_gripper, RETRIEVAL.T_world_gripper)
    assert tried_grasp(STEPS[1]) is None
    assert tried_grasp(dataclasses.replace(last, action=PUSH)) is None
    said = "Dark, dashed: the hand at the first grasp that had a trial."
    assert words(page(dataclasses.replace(LOST, steps=(STEPS[0], last)))).count(said) == 2
    assert said not in words(page(LOST))
    recording = dataclasses.replace(LOST, steps=(STEPS[0], last))
    drawn, plain_map = (Painter(r).end(()).above for r in (recording, LOST))
    assert (drawn != plain_map).any()


def test_objects_are_listed_as_in_a_sentence():
    assert [objects_in_words(indices) for indices in ((3,), (1, 3), (1, 3, 5))] == [
        "object 3",
        "objects 1 and 3",
        "objects 1, 3 and 5",
    ]


def test_the_last_state_is_that_after_the_last_action():
    moved = last_world(RECORDING.steps[0])
    np.testing.assert_allclose(moved.position[0, 1] - RECORDING.steps[0].world.position[0, 1], 0.1, atol=1e-5)
    np.testing.assert_allclose(moved.rotation[0], np.eye(3), atol=1e-6)
    assert last_world(RECORDING.steps[1]) is RECORDING.steps[1].world


def test_least_sets_of_what_grasps_hit():
    hits = np.zeros((4, 5), bool)
    hits[0, [1]], hits[1, [1, 4]], hits[2, [2, 3]], hits[3, [2, 3, 4]] = True, True, True, True
    assert least_sets(hits) == [(1,), (2, 3)]
    assert blocking(hits) == (1,)
    assert grasps_in_words(hits) == (
        "each of the 4 grasps that the arm can reach inside the shelf hits object 1, or objects 2 and 3"
    )
    assert grasps_in_words(hits[:1]) == "the only grasp that the arm can reach inside the shelf hits object 1"
    assert grasps_in_words(hits[:0]) == "the arm can reach no grasp of the target inside the shelf"
    assert blocking(np.zeros((1, 5), bool)) == ()


def test_trials_are_noted_up_to_the_first_success_with_the_bodies_numbers():
    codes = [TrialResult.HARMFUL, TrialResult.UNKNOWN, TrialResult.SUCCEEDED, TrialResult.FAILED]
    noted = NotedTrials(lambda problem, scenes, actions, wanted: np.array([codes], np.int32))
    push = jax.tree.map(jnp.asarray, PUSH.replace(object=np.int32(1)))
    actions = jax.tree.map(lambda a: jnp.stack([a] * 4)[None], push)
    bodies = np.array([3, 5, *range(6)])[:SLOTS]
    assert len(noted.tried().result) == 0
    call = NotedTrials.__call__.__wrapped__
    results = call(noted, None, None, actions, np.array([[True, False, True, True]]))
    np.testing.assert_array_equal(results, [codes])
    tried = named_tried(noted.tried(), bodies)
    assert tried.result.tolist() == [TrialResult.HARMFUL, TrialResult.SUCCEEDED]
    assert tried.action.object.tolist() == [5, 5]
    call(noted, None, None, actions, np.array([[True, True, False, False]]))
    assert len(noted.tried().result) == 4
    assert tried.action.kind.tolist() == [int(PUSH.kind)] * 2
    assert int(no_action().kind) not in tried.action.kind.tolist()


def test_the_command_writes_the_page(tmp_path, capsys):
    save_recording(LOST, tmp_path / NAME)
    cli.parse(["view", str(tmp_path), "--save", str(tmp_path / "pages" / "page.html")])()
    assert "Lost: found, but not graspable" in (tmp_path / "pages" / "page.html").read_text(encoding="utf-8")
    assert "page.html" in capsys.readouterr().out


def test_a_film_is_shown_from_where_it_lies(tmp_path):
    from mechsearch_jax.envs.page.page import save_page

    save_page(LOST, tmp_path / "pages" / "page.html", tmp_path / "films" / "a film.mp4")
    text = (tmp_path / "pages" / "page.html").read_text(encoding="utf-8")
    assert '<video controls muted playsinline preload="metadata" src="../films/a%20film.mp4">' in text
    assert "<video" not in page(LOST)
    assert '<img src="film.webp" alt="The film' in page(LOST, "film.webp")


def test_a_page_that_cannot_be_made_leaves_what_was_there(tmp_path, monkeypatch):
    (tmp_path / "page.html").write_text("before")
    monkeypatch.setattr(pages, "page", lambda *arguments: (_ for _ in ()).throw(RuntimeError("drawn wrong")))
    with pytest.raises(RuntimeError):
        pages.save_page(LOST, tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_bad_input_is_refused_in_one_line(tmp_path):
    for arguments, message in (
        (["--save", str(tmp_path / "page.html")], "recording.npz: there is none; search once more with --record"),
        (["--save", str(tmp_path / "page.pdf")], "page.pdf: ends in neither .html nor .htm"),
    ):
        with pytest.raises(InputError, match=re.escape(message)) as refused:
            cli.parse(["view", str(tmp_path), *arguments])()
        assert "\n" not in str(refused.value)
    with pytest.raises(InputError, match=r"page.pdf: ends in neither"):
        cli.parse(["search", "first-light", "--out", str(tmp_path), "--page", str(tmp_path / "page.pdf")])()
    save_recording(LOST, tmp_path / NAME)
    with pytest.raises(InputError, match="view: --fps 0 is not between"):
        cli.parse(["view", str(tmp_path), "--save", str(tmp_path / "page.html"), "--fps", "0"])()
    for arguments, message in (
        (["--film", str(tmp_path / "film.mp4")], "view: --film is shown in a page; give --save, too"),
        (["--save", str(tmp_path / "page.html"), "--film", str(tmp_path / "film.avi")], "film.avi: ends in none of"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            cli.parse(["view", str(tmp_path), *arguments])()
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(InputError, match="cannot be written"):
        cli.parse(["view", str(tmp_path), "--save", str(tmp_path / "taken" / "page.html")])()
