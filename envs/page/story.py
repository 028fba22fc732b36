"""How a target was lost, as a story of three short paragraphs: what was believed, what was done, why it failed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from mechsearch_jax.envs.known_target.in_the_way import grasps_in_words, objects_in_words
from mechsearch_jax.envs.page import facts
from mechsearch_jax.envs.page.places import groups, groups_in_words, possible
from mechsearch_jax.envs.page.reasons import moved_in_words, reasons
from mechsearch_jax.envs.page.replays import trial_stop
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.planner.trials import TrialResult
from mechsearch_jax.workspace.shelf import Shelf

# A target that is believed to be farther than this from where it is counts as wrongly seen [m].
WRONG = 0.02
# The label of what only adds numbers.
NUMBERS = "Why not, in numbers"
# Objects in the way of which it is said why they stayed there, at most.
MOST_NAMED = 2


class Paragraph(NamedTuple):
    """What stands under a label.

    Attributes:
      label, sentences: as they are shown.
      details: whether it only adds numbers to what is said before.
    """

    label: str
    sentences: list[str]
    details: bool = False

    @property
    def text(self) -> str:
        """In one line."""
        return " ".join(self.sentences)


def story(
    recording: Recording, fatal: int | None, obstacles: Sequence[int], explained: bool = False
) -> list[Paragraph]:
    """What was believed, what was done and why it failed, of a lost target; paragraphs that say nothing are left out.

    Args:
      recording: of the episode, with its record.
      fatal: the step whose action did what cannot be mended; None if the target could still have been taken out.
      obstacles: the objects that block or hide it at the last look.
      explained: whether the physical cause is said before.
    """
    failed = _failed(recording, obstacles) if fatal is None else warned(recording, fatal)
    paragraphs = (
        Paragraph("Believed", _believed(recording, fatal)),
        Paragraph("Done", _done(recording, fatal, obstacles)),
        Paragraph("Failed because", failed) if fatal is not None or not explained else Paragraph(NUMBERS, failed, True),
    )
    return [paragraph for paragraph in paragraphs if paragraph.sentences]


def came_into_view(recording: Recording) -> int | None:
    """The action after which the target was found first; None if it was at the first look, or never."""
    found = [i for i, step in enumerate(recording.steps) if step.found]
    return found[0] - 1 if found and found[0] else None


def belief_in_words(recording: Recording, step: RecordedStep) -> list[str]:
    """Where a target that is not found was believed to be, whether rightly, and what hides it."""
    sentences = [f"The robot believed that it can be {_places(recording, step)}."]
    if facts.believed_elsewhere(step):
        sentences = ["The robot took something else for the target, and looked for it no more."]
    if hiding := facts.hiding(recording, step):
        sentences.append(f"From the camera it is hidden by {_shares(hiding)}.")
    return sentences


def _shares(hiding: Sequence[tuple[int, float]]) -> str:
    return " and ".join(f"object {i} ({100 * share:.0f} % of it)" for i, share in hiding)


def _places(recording: Recording, step: RecordedStep, first: RecordedStep | None = None) -> str:
    """Where a target could be in words, and whether rightly.

    Args:
      recording: of the episode.
      step: of the belief.
      first: an earlier step, whose number of places is named if it is another.
    """
    can = possible(recording, step)
    size, count = int(can.sum()), len(can)
    at_first = int(possible(recording, first).sum()) if first is not None else size
    before = f" ({at_first} at first)" if at_first != size else ""
    listed = groups_in_words(groups(recording, step))
    of = f"{size} of {count} places{before}"
    return f"{listed}: {of}{_rightly(recording, step)}" if listed else f"at {of}{_rightly(recording, step)}"


def _rightly(recording: Recording, step: RecordedStep) -> str:
    """Whether the true place is one of those that were thought possible; empty if that is not recorded."""
    record = None if recording.episode is None else recording.episode.steps[recording.steps.index(step)]
    right = None if record is None else record.truth_possible
    return {True: ", the true one among them", False: ", the true one not among them", None: ""}[right]


def _believed(recording: Recording, fatal: int | None) -> list[str]:
    """Where the target was believed to be, and since when it was known."""
    steps, came = recording.steps, came_into_view(recording)
    last = steps[-1] if fatal is None else steps[fatal]
    if not last.found:
        when = "At the last look" if fatal is None else f"Before action {fatal + 1}"
        if facts.believed_elsewhere(last):
            return [f"{when} the robot took something else for the target, and looked for it no more."]
        can = "can" if fatal is None else "could"
        sentences = [f"{when} the robot believed that the target {can} be {_places(recording, last, steps[0])}."]
        hidden = facts.hiding(recording, last) if fatal is not None else []
        return [*sentences, f"It was hidden by {_shares(hidden)}."] if hidden else sentences
    known = _known(last)
    if came is None:
        return [f"The target was seen at the first look{f'; from then on {known}' if known else ''}."]
    where = f"the robot believed that it could be {_places(recording, steps[came])}"
    hidden = facts.hiding(recording, steps[came])
    behind = f"hidden by {_shares(hidden)}" if hidden else "not seen"
    sentences = [f"Up to action {came + 1} the target was {behind}; {where}."]
    return [*sentences, f"From then on {known}."] if known else sentences


def _known(step: RecordedStep) -> str:
    """That the robot knew where the found target is, or how wrongly; empty if that is not recorded."""
    believed = None if step.evidence is None else step.evidence.believed_pose
    if believed is None or not np.isfinite(believed).all():
        return ""
    off = float(np.linalg.norm(believed[:2] - np.asarray(step.world.position)[TARGET, :2]))
    return f"the robot took it to be {100 * off:.0f} cm from where it was" if off > WRONG else "its place was known"


def _done(recording: Recording, fatal: int | None, obstacles: Sequence[int]) -> list[str]:
    """What the actions did: what brought the target into view, moved it, and since when J fell no more."""
    came, sentences = came_into_view(recording), []
    if fatal is not None:
        return _fatal_action(recording, fatal)
    if came is not None:
        sentences.append(_revealed(recording, came, obstacles))
    elif handled := [int(step.action.object) for step in recording.steps if step.action and facts.moves(step.action)]:
        named = sorted({k for k in handled if 0 <= k < recording.steps[-1].scene.capacity})
        sentences += [f"The actions were to move {objects_in_words(named)}."] if named and len(handled) > 1 else []
    return [*sentences, *_displaced(recording, came), *_course(recording)]


def _revealed(recording: Recording, i: int, obstacles: Sequence[int]) -> str:
    """What the action that brought the target into view did to it, and to what is in its way now."""
    moved = facts.shifts(recording, i)
    acted = f"Action {i + 1}, “{facts.executed_words(recording, i)}”, brought the target into view"
    if moved[TARGET] > facts.DISPLACED:
        acted += f" and moved it by {100 * moved[TARGET]:.0f} cm"
    left = [k for k in obstacles if moved[k] > facts.DISPLACED]
    if left:
        lengths = " and ".join(f"{100 * moved[k]:.0f} cm" for k in left)
        it = "it" if len(left) == 1 else "them"
        acted += f"; it moved {objects_in_words(left)} by {lengths}, but left {it} in the way"
    return f"{acted}."


def _displaced(recording: Recording, came: int | None) -> list[str]:
    """Which action that was to move an object, or to push the target, moved the target most; empty if none did.

    Args:
      recording: of the episode.
      came: the action that brought the target into view, of which it is said anyway.
    """
    moved = [
        float(facts.shifts(recording, i)[TARGET])
        if step.action is not None and facts.moves(step.action) and i != came
        else 0.0
        for i, step in enumerate(recording.steps)
    ]
    i = int(np.argmax(moved))
    if moved[i] < facts.DISPLACED:
        return []
    return [f"Action {i + 1}, “{facts.executed_words(recording, i)}”, moved the target by {100 * moved[i]:.0f} cm."]


def _course(recording: Recording) -> list[str]:
    """How J went, and since when it fell no more; empty if that is not recorded."""
    costs, since, number = facts.costs_of(recording), facts.stalled(recording), facts.number
    if len(costs) < 2:
        return _mindless(recording)
    if since is None:
        fell = f"J fell from {number(costs[0])} to {number(costs[-1])} (step {len(costs)})"
        return [f"{fell}."] if costs[-1] < costs[0] - facts.LEAST_GAIN else []
    rest, fell = costs[since:], ""
    hardly = rest[0] - min(rest) > facts.LEAST_GAIN
    if since and costs[since] < costs[0] - facts.LEAST_GAIN:
        # To a digit more where what it hardly fell to is compared with it.
        least = f"{costs[since]:.1f}" if hardly else number(costs[since])
        fell = f"J fell from {number(costs[0])} to {least} by step {since + 1}; "
    j, on = "it" if fell else "J", f"{'f' if fell else 'F'}rom action {since + 1} on"
    if hardly:
        return [f"{fell}{on} {j} hardly fell: at best to {min(rest):.1f}.", *_all_the_same(recording, since)]
    level = max(rest) - rest[0] <= facts.LEAST_GAIN
    there = f"at each of steps {since + 1} to {len(costs)}" if level else f"at step {len(costs)}"
    return [f"{fell}{on} nothing lowered {j} ({number(rest[-1])} {there}).", *_all_the_same(recording, since)]


def _all_the_same(recording: Recording, since: int) -> list[str]:
    """How many decisions from a step on had nothing left that promised anything."""
    acted = [step for step in recording.steps[since:] if step.action is not None]
    count = sum(map(facts.promises_nothing, acted))
    if not count:
        return []
    decisions = f"In {count} of the {facts.counted(len(acted), 'decision')} since then"
    return [f"{decisions} no action that was left was expected to lower it, and one was made all the same."]


def _mindless(recording: Recording) -> list[str]:
    """That a policy minds no J; empty of one that does, or where that is not recorded."""
    episode = recording.episode
    acted = [] if episode is None else [step for step in episode.steps if step.action and step.cost is not None]
    if episode is None or not acted or any(step.compares_costs for step in acted) or "policy" not in episode.config:
        return []
    return [f"The policy, {episode.config['policy']}, does not mind J."]


def _fatal_action(recording: Recording, i: int) -> list[str]:
    """What the action that ended an episode was expected to do, and what it did."""
    record = None if recording.episode is None else recording.episode.steps[i]
    sentences = []
    if record is not None and record.compares_costs and record.cost is not None and record.predicted_cost is not None:
        before, expected = facts.number(record.cost), facts.number(record.predicted_cost)
        sentences.append(f"Action {i + 1} was expected to bring J from {before} to {expected}.")
    if moved := moved_in_words(recording, i, target=not facts.takes_target(recording.steps[i])):
        tips = facts.tipped(recording, i)
        over = f", and tipped {objects_in_words(tips)}" if tips else ""
        sentences.append(f"In the run {'it' if sentences else f'action {i + 1}'} moved {moved}{over}.")
    return sentences


def warned(recording: Recording, i: int) -> list[str]:
    """Whether trials had shown that an action would do harm."""
    step = recording.steps[i]
    if (
        step.evidence is None
        or not len(step.evidence.tried.result)
        or facts.executed_words(recording, i) != facts.action_words(step)
    ):
        return []
    result = facts.trial_of(step, step.action)
    hidden = [_unseen(step)] if not step.found else []
    if result is TrialResult.SUCCEEDED and facts.takes_target(step):
        hits = step.evidence.hits
        touched = [] if facts.free(hits) or not len(hits) else [f"No grasp was free: {grasps_in_words(hits)}."]
        return ["In its trial this grasp had taken the target out.", *touched]
    if result is TrialResult.UNSURE:
        return ["In its trial this grasp had taken the target out, but not in every scene nearby: a last resort."]
    if result is TrialResult.SUCCEEDED:
        record = None if recording.episode is None else recording.episode.steps[i]
        other = record is not None and record.failure and not facts.takes_target(step)
        went = "In its trial that had not happened: it went as intended" if other else "Its trial had gone as intended"
        return [f"{went}, and nothing fell off the board.", *hidden]
    if result is TrialResult.FAILED:
        tried = step.evidence.tried.action
        row = next(k for k in range(len(tried.kind)) if facts.same_action(step, tried, k))
        stop = trial_stop(recording, i, row)
        why = "it was not carried out as intended, but nothing fell" if stop is None else stop.words
        return [f"In its trial {why}.", *hidden]
    return []


def _unseen(step: RecordedStep) -> str:
    """That a trial knew nothing of the target, and how near it stood to the object of the action."""
    k = -1 if step.action is None or not facts.moves(step.action) else int(step.action.object)
    near = ""
    if 0 <= k < TARGET and step.world.valid[k]:
        apart = np.linalg.norm(np.asarray(step.world.position)[k, :2] - np.asarray(step.world.position)[TARGET, :2])
        near = f", its middle {100 * apart:.0f} cm from that of object {k}"
    return f"The target was hidden then{near}, and a trial knows nothing of what is hidden."


def _failed(recording: Recording, obstacles: Sequence[int]) -> list[str]:
    """What kept a target that could have been taken out from being taken out."""
    last = recording.steps[-1]
    hits = None if last.evidence is None else last.evidence.hits
    if hits is None:
        return ["Which objects its grasps meet was not recorded."]
    if last.found and facts.free(hits):
        return ["At the last look a grasp of it would have hit nothing."]
    sentences = [] if last.found else _grasps_of_hidden(hits, facts.blockers(last), obstacles)
    if last.found and not len(hits):
        sentences = _lost_grasps(recording)
    return [*sentences, *reasons(recording, obstacles[:MOST_NAMED])]


def _grasps_of_hidden(hits: Bool[np.ndarray, "grasps n"], blocking: Sequence[int], hiding: Sequence[int]) -> list[str]:
    """What grasps of a hidden target meet, unless it is what hides it."""
    if facts.free(hits) or (blocking and set(blocking) <= set(hiding)):
        return []
    return [f"At the last look {grasps_in_words(hits)}."]


def _lost_grasps(recording: Recording) -> list[str]:
    """The last action before which the arm could reach grasps of the target, which at the end it cannot; and the wall.

    Grasps that hit something count, too.
    """
    last = recording.steps[-1]
    had = [i for i, step in enumerate(recording.steps) if step.evidence is not None and len(step.evidence.hits)]
    if not had or had[-1] + 1 >= len(recording.steps):
        return [f"At the last look {at_wall(recording.shelf, last)}."]
    i = had[-1]
    before, evidence = recording.steps[i], recording.steps[i].evidence
    assert evidence is not None
    clear = int((~evidence.hits.any(axis=1)).sum())
    met = f"{clear} of which hit nothing" if clear else "each of which hit something"
    words = f"Before action {i + 1} the arm could reach {facts.counted(len(evidence.hits), 'grasp')} of it, {met}"
    walls = at_wall(recording.shelf, last, before)
    sentences = [f"{words}; after it none: {walls}."]
    if not before.found and facts.trial_of(before, before.action) is not None:
        sentences.append(_unseen(before))
    return sentences


def at_wall(shelf: Shelf, step: RecordedStep, before: RecordedStep | None = None) -> str:
    """How far the target truly is from the nearest wall, in words, and how far it was from that at a step before."""

    def distances(at: RecordedStep) -> dict[str, float]:
        x, y, _ = np.asarray(at.world.position)[TARGET]
        return {"the back wall": float(shelf.back - x), "a side wall": float(min(shelf.left - y, y - shelf.right))}

    now = distances(step)
    nearest = min(now, key=lambda wall: now[wall])
    words = f"the target’s middle is {100 * now[nearest]:.1f} cm from {nearest}"
    return words if before is None else f"{words}, and was {100 * distances(before)[nearest]:.1f} cm"
