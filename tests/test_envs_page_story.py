"""The story of a lost target: its direct cause, what was believed, what was done, and why it failed."""

import dataclasses
import re

import numpy as np
import pytest
from recordings import EPISODE, FAR, LOST, OBJECTS, POSES, PUSH, RECORDING, RETRIEVAL, STEPS, evidence, record, stacked
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.page.ending import ending
from mechsearch_jax.envs.page.facts import idle, stalled
from mechsearch_jax.envs.page.page import page
from mechsearch_jax.envs.page.reasons import moved_in_words, reasons
from mechsearch_jax.envs.page.steps import came_of_it, candidates, label, over, troubles, unmoved
from mechsearch_jax.envs.page.story import NUMBERS, came_into_view
from mechsearch_jax.envs.recording.sampled import Sampled
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.planner.noted_trials import TriedActions
from mechsearch_jax.planner.trials import TrialResult

QUARTER = Rotation.from_euler("x", 90, degrees=True).as_matrix().astype(np.float32)


def words(text):
    """What a reader sees, without the pictures."""
    return " ".join(re.sub(r"<(style|script).*?</\1>|<[^>]*>", " ", text, flags=re.S).split())


def of(steps, records=EPISODE.steps, **changes):
    """A recording of these steps and records."""
    return dataclasses.replace(LOST, steps=steps, episode=dataclasses.replace(EPISODE, steps=records, **changes))


def hidden(step, **changes):
    """A step at which the target is not found."""
    return dataclasses.replace(step, **{"found": False, "evidence": evidence(), **changes})


def paragraph(recording, label):
    return next(p.text for p in ending(recording).story if p.label == label)


def sampled(*rows):
    """Candidates of these objects and values, the best first."""
    count = len(rows)
    action = stacked(*(PUSH.replace(object=np.int32(i), q7=np.float32(k)) for k, (i, _) in enumerate(rows)))
    positions, rotations = (np.stack([np.asarray(a)] * count) for a in (OBJECTS.position, OBJECTS.rotation))
    values = np.array([value for _, value in rows])
    return Sampled(action, values, 100.0 + values, positions, rotations)


def course(*costs, **changes):
    """An episode with these values of J at its steps, whose target is never found."""
    after = [*costs[1:], None]
    records = [
        record(PUSH, cost=c, observed_cost=o, predicted_cost=c, **changes) for c, o in zip(costs, after, strict=True)
    ]
    steps = [hidden(STEPS[0], world=RECORDING.steps[0].world) for _ in costs]
    end = record(None, cost=None, predicted_cost=None, observed_cost=None)
    return of((*steps, hidden(STEPS[1])), (*records, end), failure="not found", found_step=None)


def test_the_direct_cause_comes_first():
    first = record(PUSH, failure="dropped", target_fallen=True)
    fell = ending(of(STEPS, (first, EPISODE.steps[1]), failure="the target fell over"))
    assert fell.sentences[0].endswith("to the left”, before it was seen: object 0 slipped out of the hand.")
    assert [p.label for p in fell.story] == ["Believed", "Done", "Failed because"]
    assert (fell.decisive, fell.believing) == (0, 0)
    failed = fell.story[-1].text
    assert failed.startswith("In its trial (simulated before acting) that had not happened: it went as intended")
    assert re.search(r"The target was hidden then, its middle \d+ cm from that of object 0, and a trial knows", failed)
    last = (record(PUSH, failure="dropped"), EPISODE.steps[1])
    assert ending(of(STEPS, last, failure="dropped")).sentences[0].endswith("”: object 0 slipped out of the hand.")


def test_what_was_believed_is_said_wherever_the_target_was_found():
    later = paragraph(LOST, "Believed")
    assert later.startswith(
        "Up to action 1 the target was hidden by object 0 (100 % of it); the robot believed that it "
    )
    assert later.endswith(f"of {POSES} places, the true one among them. From then on its place was known.")
    first = dataclasses.replace(STEPS[0], found=True, evidence=evidence(found=True))
    at_once = paragraph(of((first, STEPS[1]), found_step=0), "Believed")
    assert at_once == "The target was seen at the first look; from then on its place was known."
    pose = np.array([0.62, 0.17, 0.0], np.float32)
    wrong = dataclasses.replace(STEPS[1], evidence=dataclasses.replace(evidence(found=True), believed_pose=pose))
    assert "the robot took it to be 10 cm from where it was" in paragraph(of((STEPS[0], wrong)), "Believed")
    elsewhere = hidden(STEPS[1], evidence=evidence(found=True))
    lost = of((STEPS[0], elsewhere), failure="not found", found_step=None)
    assert "took something else for the target" in paragraph(lost, "Believed")
    falls = of(STEPS, (record(PUSH, target_fallen=True), EPISODE.steps[1]), failure="the target fell over")
    believed = paragraph(falls, "Believed")
    assert believed.startswith("Before action 1 the robot believed that the target could be at ")
    assert believed.endswith("It was hidden by object 0 (100 % of it).")


def test_the_action_that_brought_the_target_into_view_and_left_its_blocker_is_named():
    world = STEPS[1].world
    position = np.array(world.position)
    position[0, 1] += 0.1
    moved = dataclasses.replace(STEPS[1], world=world.replace(position=position))
    left = "brought the target into view; it moved object 0 by 10 cm, but left it in the way."
    assert left in paragraph(of((STEPS[0], moved)), "Done")
    assert "brought the target into view." in paragraph(LOST, "Done")
    assert came_into_view(LOST) == 0
    assert came_into_view(course(5.0, 5.0)) is None


@pytest.mark.parametrize(
    ("costs", "since", "said"),
    [
        ((59.0, 11.0, 11.0, 11.0), 1, "by step 2; from action 2 on nothing lowered it (11.0 at each of steps 2 to 4)."),
        ((11.0, 11.0, 11.0), 0, "From action 1 on nothing lowered J (11.0 at each of steps 1 to 3)."),
        ((11.0, 13.0, 12.0), 0, "From action 1 on nothing lowered J (12.0 at step 3)."),
        (
            (90.0, 50.0, 49.0, 48.5),
            1,
            "J fell from 90 to 50.0 by step 2; from action 2 on it hardly fell: at best to 48.5.",
        ),
        ((90.0, 50.0, 30.0), None, "J fell from 90 to 30 (step 3)."),
    ],
)
def test_since_when_nothing_lowered_j_is_said(costs, since, said):
    recording = course(*costs)
    assert stalled(recording) == since
    assert said in paragraph(recording, "Done")
    assert ending(recording).decisive == (since if since is not None else len(costs) - 1)


def test_how_many_decisions_had_nothing_that_promised_anything_is_said():
    recording = course(59.0, 11.0, 11.0, 11.0)
    kept = recording.steps[0].sampled
    nothing = dataclasses.replace(kept, value=np.zeros_like(kept.value))
    said = "decisions since then no action that was left was expected to lower it, and one was made all the same."
    for hopeless in ((1, 2), (0, 1), (0,)):
        steps = [
            dataclasses.replace(step, sampled=nothing) if i in hopeless else step
            for i, step in enumerate(recording.steps)
        ]
        later = sum(i >= 1 for i in hopeless)
        done = paragraph(dataclasses.replace(recording, steps=steps), "Done")
        assert (f"In {later} of the 3 {said}" in done) == (later > 0)


def test_steps_that_lowered_j_not_or_hardly_are_grey():
    recording = course(90.0, 50.0, 49.0, 48.5)
    assert [idle(recording, i) for i in range(5)] == [False, True, True, True, False]
    drawn = page(recording)
    assert drawn.count('class="idle ') == 3
    assert "push 0</small>" in drawn
    assert [idle(course(0.0, 0.0, 0.0), i) for i in range(3)] == [False] * 3
    assert stalled(course(0.0, 0.0, 0.0)) is None
    assert "The policy, search-for-grasp, does not mind J." in paragraph(course(0.0, 0.0, 0.0), "Done")


def promised(*rows, tried=None, **config):
    """What is said of object 2, in the way of a target that was never found, of candidates at steps like these."""
    steps = [hidden(STEPS[0], sampled=s, action=s.single(0), evidence=evidence(tried=tried)) for s in rows]
    records = tuple(record(PUSH) for _ in steps)
    ended = {"failure": "not found", "found_step": None, "config": {**EPISODE.config, **config}}
    return " ".join(reasons(of((*steps, hidden(STEPS[1])), (*records, EPISODE.steps[1]), **ended), [2]))


def test_why_what_is_in_the_way_was_not_moved_is_said():
    worse = promised(sampled((0, -9.0), (2, 36.0)), sampled((0, -5.0), (0, -4.0)))
    counted = "1 of the 4 candidate actions was to move object 2 (none from action 2 on)"
    assert worse.startswith(f"{counted}, each of which was expected to raise J, by at least 36. None of the 2 actions")
    assert worse.endswith("None of the 2 actions was to move object 2, and it stayed where it was.")
    dear = dataclasses.replace(sampled((0, -9.0), (2, 36.0)), cost=np.array([91.0, 60.0]))
    counts = "(J would fall from 100 to 60, but that it may touch the hidden target counts as 76)"
    assert f"expected to raise J, by at least 36 {counts}." in promised(dear, horizon=1)
    assert "by at least 36." in promised(dear, horizon=3)
    assert "by at least 36." in promised(sampled((0, -9.0), (2, 36.0)), horizon=1)
    nothing = promised(sampled((0, -9.0), (2, 0.0)))
    assert nothing.startswith(
        "1 of the 2 candidate actions was to move object 2, none of which was expected to lower J."
    )
    tried = TriedActions(stacked(PUSH.replace(object=np.int32(2))), np.array([TrialResult.HARMFUL], np.int32))
    others = promised(sampled((0, -9.0), (2, 0.0)), tried=tried)
    assert "(1 refused after simulation), none of the others was expected to lower J." in others
    less = promised(sampled((0, -9.0), (2, -2.0)))
    assert "; the best was expected to lower J by 2.0 (at step 1, where 9.0 was expected of the chosen action)." in less
    late = promised(sampled((0, -9.0), (2, 3.0)), sampled((2, -4.0), (0, -3.0)))
    assert ", and none before action 2 was expected to lower J; the best, by 4.0, was action 2." in late
    assert late.endswith("Action 2 was to move object 2, and it stayed where it was.")


def test_trials_that_stood_against_moving_it_are_counted():
    def of_results(*results):
        action = stacked(*(PUSH.replace(object=np.int32(2)) for _ in results), RETRIEVAL.replace(object=np.int32(2)))
        tried = TriedActions(action, np.array([*results, TrialResult.FAILED], np.int32))
        return promised(sampled((0, -9.0), (2, -2.0)), tried=tried)

    failed, harmful, good = TrialResult.FAILED, TrialResult.HARMFUL, TrialResult.SUCCEEDED
    why = "(why is not known)"
    assert f"The only trial of moving object 2 failed {why}." in of_results(failed)
    assert f"All 2 trials of moving object 2 failed {why}." in of_results(failed, failed)
    assert f"Of 3 trials of moving object 2, 1 failed {why} and 1 did harm" in of_results(failed, harmful, good)
    assert f"1 of the 2 trials of moving object 2 failed {why}." in of_results(failed, good)
    assert "trial" not in of_results(good)


def test_what_an_action_moved_along_is_not_hidden():
    world = STEPS[1].world
    position = np.array(world.position)
    position[0, 1] += 0.015
    other = sampled((3, -9.0), (0, -2.0))
    first = hidden(STEPS[0], sampled=other, action=other.single(0))
    recording = of(
        (first, hidden(STEPS[1], world=world.replace(position=position))), failure="not found", found_step=None
    )
    assert "The only action was not to move object 0; action 1 moved it along, by 1.5 cm." in reasons(recording, [0])
    assert moved_in_words(recording, 0) == "object 0 by 2 cm"
    assert came_of_it(recording, 0) == "In the run it moved object 0 by 2 cm."
    assert came_of_it(LOST, 0) == "In the run it moved nothing by more than 1 cm."
    assert came_of_it(RECORDING, 0) == ""


def test_where_the_arm_can_reach_no_grasp_any_more_it_is_said_since_when():
    none = dataclasses.replace(evidence(found=True), hits=np.zeros((0, OBJECTS.capacity), bool))
    said = paragraph(of((STEPS[0], dataclasses.replace(STEPS[1], evidence=none))), NUMBERS)
    assert said.startswith(
        "Before action 1 the arm could reach 2 grasps of it, each of which hit something; after it none"
    )
    assert "a trial (simulated before acting) knows nothing of what is hidden" in said
    clear = hidden(STEPS[0], evidence=evidence(hits=((), (0,))))
    said = paragraph(of((clear, dataclasses.replace(STEPS[1], evidence=none))), NUMBERS)
    assert "2 grasps of it, 1 of which hit nothing" in said
    never = tuple(dataclasses.replace(step, evidence=none, found=True) for step in STEPS)
    said = paragraph(of(never, found_step=0), NUMBERS)
    assert said.startswith("At the last look the target’s middle is")
    assert said.endswith("None of the 2 candidate actions since it was seen was to push the target itself.")


def test_an_action_that_tips_something_is_not_only_said_to_have_gone_as_intended():
    world = STEPS[1].world
    rotation, position = np.array(world.rotation), np.array(world.position)
    rotation[0], position[0, 1] = QUARTER @ rotation[0], position[0, 1] + 0.06
    tips = of((STEPS[0], dataclasses.replace(STEPS[1], world=world.replace(rotation=rotation, position=position))))
    said = "In the run it moved object 0 by 6 cm, and tipped object 0. Its trial went as intended; it does not matter"
    assert said in words(page(tips))
    assert list(ending(tips).remarks) == ["In the run, action 1 tipped object 0."]
    assert 'class="odd"' in page(tips)


def test_after_a_fall_no_grasps_are_counted():
    world = STEPS[1].world
    rotation = np.array(world.rotation)
    rotation[TARGET] = QUARTER
    last = dataclasses.replace(STEPS[1], world=world.replace(rotation=rotation))
    records = (record(PUSH, target_fallen=True), EPISODE.steps[1])
    fell = of((STEPS[0], last), records, failure="the target fell over")
    assert over(fell, last) == "The episode had ended: the target fell over."
    assert over(fell, STEPS[0]) == ""
    assert troubles(fell, 0) == ["the target fell off the board"]
    tipped = of(fell.steps, failure="the target fell over")
    assert troubles(tipped, 0) == ["the target fell over"]
    assert troubles(LOST, 0) == troubles(RECORDING, 0) == []
    section = page(fell).split('<section class="step"')[2]
    assert "The episode had ended" in words(section)
    assert "inside the shelf" not in words(section)


def test_a_runner_up_that_reads_the_same_makes_room_for_what_is_in_the_way():
    same = dataclasses.replace(STEPS[0], evidence=None)
    chosen = sampled((0, -9.0), (0, -9.0), (3, -5.0), (2, -1.0))
    step = dataclasses.replace(same, sampled=chosen, action=chosen.single(0))
    assert [c.role for c in candidates(step)] == ["chosen"]
    assert [(c.role, c.row) for c in candidates(step, (2,))][1:] == [("best of object 2, in the way at the end", 3)]
    assert [c.role for c in candidates(step, (0,))] == ["chosen"]
    none = "No candidate of this step was to move object 1, which is in the way at the end"
    assert unmoved(step, (1,)) == f"{none}; why is not known."
    assert unmoved(step, (1,), "object 2 is in the way") == f"{none}: object 2 is in the way."
    assert unmoved(step, (2,)) == unmoved(step, ()) == ""


def test_labels_name_what_is_moved():
    assert label(STEPS[0]) == "push 0"
    assert label(STEPS[1]) == "end"
    assert label(dataclasses.replace(STEPS[1], action=RETRIEVAL)) == "take out"
    assert label(dataclasses.replace(STEPS[0], action=FAR.replace(object=np.int32(OBJECTS.capacity)))) == "push target"


def test_a_page_opens_where_it_was_decided_and_shows_the_belief_first():
    lost = page(course(90.0, 50.0, 50.0, 50.0))
    assert ": 1);\n})();" in lost
    head = lost.partition("<nav")[0]
    assert head.count("<img") == 3
    assert "What was believed at the end. Coloured: where the target can be, and what" in words(head)
    assert "added up (less is better)" in words(head)
    found = page(LOST)
    assert "What was believed at step 1, and the action that was chosen." in words(found)
    assert found.count('stroke-width="1.6"') == 1
    won = dataclasses.replace(LOST, episode=dataclasses.replace(EPISODE, retrieved=True, failure=None))
    assert page(won).partition("<nav")[0].count("<img") == 2
    assert not ending(won).story
