"""How a recorded episode ended, and if the target was lost, why: the sentences of the card at the top of its page."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool

from mechsearch_jax.actions import KINDS, Action, kind_of
from mechsearch_jax.envs.episode.protocols import REACHED
from mechsearch_jax.envs.episode.records import ActionRecord, Episode
from mechsearch_jax.envs.known_target.in_the_way import blocking, grasps_in_words, objects_in_words
from mechsearch_jax.envs.page.pictures import hidden_behind, last_world, target_pixels
from mechsearch_jax.envs.pushing.pushes import toppled
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.world.world import TARGET, World
from mechsearch_jax.planner.noted_trials import nothing_tried
from mechsearch_jax.planner.trials import TrialResult
from mechsearch_jax.workspace.detector import found_pixels
from mechsearch_jax.workspace.shelf import Shelf

# Failures of retrievals in the words of a page, and of other actions.
_RETRIEVAL = {
    "missed": "the hand missed the target",
    "inside": "the target did not leave the shelf",
    "unreachable": "the arm cannot follow the grasp",
    "unstable": "the simulation diverged",
}
_ACTION = {
    "unreachable": "the arm cannot follow the action",
    "dropped": "the object slipped out of the hand",
    "unstable": "the simulation diverged",
}
# Objects that hide a smaller share of the target are not named.
LEAST_SHARE = 0.05
# What moved less at an action counts as where it was [m].
DISPLACED = 0.01
# A candidate that lowers J by less promises nothing.
LEAST_GAIN = 0.05
# Objects in the way whose moves are counted, at most.
MOST_NAMED = 3


class Ending(NamedTuple):
    """How an episode ended.

    Attributes:
      good: whether the episode reached what its protocol asks for; None if nothing says so.
      title: in a few words.
      sentences: what was believed and why it failed.
      blockers: the objects that the best grasps of the target hit; empty if none does or nothing is known.
    """

    good: bool | None
    title: str
    sentences: list[str]
    blockers: tuple[int, ...]


def ending(recording: Recording) -> Ending:
    """How a recording's episode ended."""
    episode, last = recording.episode, recording.steps[-1]
    if episode is None:
        heading = recording.heading.partition(": ")[2] or recording.heading
        return Ending(None, heading, _believed(recording, last), _blockers(last))
    if episode.retrieved:
        tipped = _tipped(recording)
        fell = "off the board" if tipped else "over or off the board"
        taken = f"{_seen(episode)} and taken out of the shelf by action {len(episode.steps)}; no object fell {fell}."
        return Ending(True, "Retrieved", [taken, *tipped], ())
    if episode.failure == REACHED:
        reached = f"{_seen(episode)}, and a grasp of it is free. The protocol of the published code ends here"
        return Ending(True, "Graspable", [f"{reached}: nothing is taken out."], ())
    failure = plain(episode.failure or "not retrieved")
    sentences = [_what_happened(recording, episode), *_tipped(recording)]
    if _is_open(failure):
        sentences += [*_displaced(recording), *_believed(recording, last), *_moves_of(recording, last)]
    elif not episode.found_step and not last.found:
        sentences += _belief_in_words(recording, last)
    return Ending(False, f"Lost: {failure}", sentences, _blockers(last) if _is_open(failure) else ())


def plain(failure: str) -> str:
    """A failure in plain words."""
    reason = failure.removeprefix("retrieval: ")
    return (_ACTION if reason == failure else _RETRIEVAL).get(reason, reason)


def _is_open(failure: str) -> bool:
    """Whether the target still stood where it could have been taken out, had nothing been in the way."""
    return not any(word in failure for word in ("fell", "error"))


def counted(count: int, noun: str) -> str:
    """A number of things."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _seen(episode: Episode) -> str:
    """When the target was seen first; a sentence without its end."""
    first = "at the first look" if not episode.found_step else f"after {counted(episode.found_step, 'action')}"
    return f"The target was seen {first}"


def _what_happened(recording: Recording, episode: Episode) -> str:
    """The event that ended an episode without a retrieval."""
    failure, acts = episode.failure or "", [i for i, step in enumerate(recording.steps) if step.action is not None]
    every, were = ("The only action", "was") if len(acts) == 1 else (f"All {len(acts)} actions", "were")
    used = f"{every} that an episode may have {were} used up"
    if failure == "not found":
        return f"{used}, and the target was never found.{_undetected(recording)}"
    if failure == "found, but not graspable":
        return f"{_seen(episode)}. {used} before any grasp of it was free."
    fatal = _fatal(episode, acts)
    if fatal is None:
        return f"The episode ended: {failure or 'nothing says why'}."
    words = f"action {fatal + 1}, “{executed_words(recording, fatal)}”"
    fallen, more = episode.steps[fatal].fallen or (), _moved_meanwhile(recording, fatal) + _warned(recording, fatal)
    if failure.startswith("retrieval: ") and not fallen:
        return f"The target was to be taken out by action {fatal + 1}, but {plain(failure)}.{more}"
    if fallen:
        return f"{objects_in_words(fallen).capitalize()} fell off the board at {words}.{more}"
    if "the target fell" in failure:
        return f"{failure.capitalize()} at {words}.{more}"
    return f"The episode ended after {words}: {failure}."


def _undetected(recording: Recording) -> str:
    """That the camera showed enough of a target that was not detected at the last look; empty if it did not."""
    shown = target_pixels(recording.steps[-1], recording.camera, recording.shelf)
    if shown <= found_pixels(recording.camera):
        return ""
    return f" It showed {shown} pixels at the last look and was not detected."


def _fatal(episode: Episode, acts: list[int]) -> int | None:
    """The step at whose action what counts as the end happened: something fell, or else the last action."""
    fell = [i for i in acts if episode.steps[i].fallen or episode.steps[i].target_fallen]
    return fell[0] if fell else acts[-1] if acts else None


def _moved_meanwhile(recording: Recording, i: int) -> str:
    """Which objects moved while the target was to be taken out; empty at other actions, or where none did."""
    step = recording.steps[i]
    if not takes_target(step) or not len(step.trace.time):
        return ""
    shifts = np.linalg.norm(np.asarray(step.trace.position)[:, :TARGET] - step.world.position[:TARGET], axis=-1)
    moved = np.flatnonzero((shifts.max(axis=0) > DISPLACED) & step.world.valid[:TARGET]).tolist()
    return f" {objects_in_words(moved).capitalize()} moved meanwhile." if moved else ""


def _warned(recording: Recording, i: int) -> str:
    """Whether trials had shown that an action would do harm."""
    step = recording.steps[i]
    if (
        step.evidence is None
        or not len(step.evidence.tried.result)
        or executed_words(recording, i) != action_words(step)
    ):
        return ""
    result = trial_of(step, step.action)
    hidden = " The target was hidden then, and a trial knows nothing of what is hidden." if not step.found else ""
    if result is TrialResult.SUCCEEDED and takes_target(step):
        hits = step.evidence.hits
        touched = "" if free(hits) or not len(hits) else f" No grasp was free: {grasps_in_words(hits)}."
        return f" In its trial this grasp had taken the target out.{touched}"
    if result is TrialResult.UNSURE:
        return " In its trial this grasp had taken the target out, but not in every scene nearby: a last resort."
    if result is TrialResult.SUCCEEDED:
        return f" It had been tried out beforehand and did no harm in the trial.{hidden}"
    if result is TrialResult.FAILED:
        return f" In its trial it was not carried out as intended, but nothing fell.{hidden}"
    return ""


def trial_of(step: RecordedStep, action: Action | None) -> TrialResult | None:
    """What the trial of an action came to at a step; None if it was not tried."""
    if step.evidence is None or action is None:
        return None
    tried = step.evidence.tried
    for k in range(len(tried.result)):
        if _same_motion(action, jax.tree.map(lambda a, k=k: a[k], tried.action)):
            return TrialResult(int(tried.result[k]))
    return None


def same_action(step: RecordedStep, actions: Action, k: int) -> bool:
    """Whether the k-th of many actions is the one that the step decided on."""
    return step.action is not None and _same_motion(step.action, jax.tree.map(lambda a: a[k], actions))


def _same_motion(action: Action | ActionRecord, other: Action) -> bool:
    """Whether two actions are the same motion."""
    kind = action.kind if isinstance(action.kind, str) else kind_of(int(action.kind)).name
    names = ("T_world_gripper", "T_world_place", "displacement", "q7")
    return kind == kind_of(int(other.kind)).name and all(
        np.allclose(getattr(action, name), getattr(other, name), atol=1e-6) for name in names
    )


def _displaced(recording: Recording) -> list[str]:
    """Which action that was to move an object, or to push the target, moved the target most; empty if none did."""
    moved = [
        float(np.linalg.norm(np.asarray(then.position)[TARGET] - np.asarray(step.world.position)[TARGET]))
        if step.action is not None and _moves(step.action)
        else 0.0
        for step, then in zip(recording.steps, _worlds_after(recording), strict=True)
    ]
    i = int(np.argmax(moved))
    if moved[i] < DISPLACED:
        return []
    return [f"Action {i + 1}, “{executed_words(recording, i)}”, moved the target by {100 * moved[i]:.0f} cm."]


def _tipped(recording: Recording) -> list[str]:
    """Which actions tipped which objects that stay on the board; empty if none did."""
    records = () if recording.episode is None else recording.episode.steps
    off = [i for record in records for i in record.fallen or ()]
    tips = []
    for i, (step, then) in enumerate(zip(recording.steps, _worlds_after(recording), strict=True)):
        over = np.asarray(toppled(step.world, then))[:TARGET]
        if objects := [k for k in np.flatnonzero(over).tolist() if k not in off]:
            tips.append(f"action {i + 1} tipped {objects_in_words(objects)}")
    return [f"On the board, {', '.join(tips)}."] if tips else []


def _worlds_after(recording: Recording) -> list[World]:
    """The true state after each step."""
    return [*(step.world for step in recording.steps[1:]), last_world(recording.steps[-1])]


def _believed(recording: Recording, step: RecordedStep) -> list[str]:
    """What was believed of the target at the last look, what hides it, and what its grasps meet."""
    sentences = [] if step.found else _belief_in_words(recording, step)
    hits = None if step.evidence is None else step.evidence.hits
    if hits is None:
        return [*sentences, "Which objects its grasps meet was not recorded."]
    if free(hits):
        return [*sentences, "At the last look a grasp of it would have hit nothing."]
    where = f"; {_at_wall(recording.shelf, step)}" if step.found else ""
    return [*sentences, f"At the last look {grasps_in_words(hits)}{where}."]


def _at_wall(shelf: Shelf, step: RecordedStep) -> str:
    """How far the target truly is from the nearest wall, in words."""
    x, y, _ = np.asarray(step.world.position)[TARGET]
    walls = {"the back wall": shelf.back - x, "a side wall": min(shelf.left - y, y - shelf.right)}
    nearest = min(walls, key=lambda wall: walls[wall])
    return f"the target’s middle is {100 * walls[nearest]:.1f} cm from {nearest}"


def _moves_of(recording: Recording, last: RecordedStep) -> list[str]:
    """How many candidates and actions were to move what was in the way: of the target, or of the view of it.

    Candidates are those that a decision chose from and those that trials refused.
    """
    objects = _blockers(last) if last.found else tuple(i for i, _ in _hiding(recording, last))
    since = [step for step in recording.steps if step.found == last.found]
    considered = [pair for step in since for pair in _candidates(step)]
    made = [int(step.action.object) for step in since if step.action is not None and _moves(step.action)]
    if not considered:
        return []
    when = " since it was seen" if last.found else ""
    return [*(_moves_in_words(i, considered, made, when) for i in objects[:MOST_NAMED]), *_hopeless(since, last.found)]


def _hopeless(steps: Sequence[RecordedStep], found: bool) -> list[str]:
    """That since the target was found no candidate promised anything; empty if one did, or if no cost is minded."""
    value, cost = (np.concatenate([getattr(step.sampled, name) for step in steps]) for name in ("value", "cost"))
    if not found or not cost.any() or value.min() < -LEAST_GAIN:
        return []
    return ["No candidate since it was seen was expected to lower J."]


def _moves_in_words(i: int, considered: list[tuple[int, bool]], made: list[int], when: str) -> str:
    """How many candidates were to move an object, how many of these trials refused, and how many were carried out.

    Args:
      i: the object.
      considered: of every candidate the object that it was to move, and whether trials refused it.
      made: the objects that actions were to move.
      when: since when is counted; empty for the whole episode.
    """
    to_move = [refused for moved, refused in considered if moved == i]
    if not to_move:
        every = f"None of the {len(considered)} candidates" if len(considered) > 1 else "No candidate"
        return f"{every}{when} was to move object {i}."
    refused = f" ({sum(to_move)} refused after trials)" if any(to_move) else ""
    candidates, actions = (
        _share_in_words(*s)
        for s in ((len(to_move), len(considered), "candidate"), (made.count(i), len(made), "action"))
    )
    return f"Object {i} was to be moved by {candidates}{refused} and by {actions}{when}."


def _share_in_words(count: int, of: int, noun: str) -> str:
    if of <= 1:
        return f"the only {noun}" if count else f"no {noun}"
    return f"{count or 'none'} of {of} {noun}s"


def _candidates(step: RecordedStep) -> list[tuple[int, bool]]:
    """Of every candidate of a step, refused ones included, the object that it was to move, and if it was refused."""
    tried = nothing_tried() if step.evidence is None else step.evidence.tried
    singles = [jax.tree.map(lambda a, k=k: a[k], tried.action) for k in range(len(tried.result))]
    refused = [
        action
        for action, result in zip(singles, tried.result.tolist(), strict=True)
        if result <= TrialResult.HARMFUL and _moves(action)
    ]
    left = [step.sampled.single(k) for k in range(len(step.sampled))]
    if takes_target(step):
        # A retrieval leaves the sequences as they are, refused ones among them.
        return [(int(action.object), any(_same_motion(action, other) for other in refused)) for action in left]
    return [(int(action.object), False) for action in left] + [(int(action.object), True) for action in refused]


def _moves(action: Action) -> bool:
    """Whether an action is to move an object, or to push the target."""
    return kind_of(int(action.kind)).moves_object


def target_is_out(recording: Recording) -> bool:
    """Whether the target is in front of the shelf at the end."""
    return bool(np.asarray(last_world(recording.steps[-1]).position)[TARGET, 0] < recording.shelf.front)


def takes_target(step: RecordedStep) -> bool:
    """Whether a step's action is to take the target out."""
    return step.action is not None and kind_of(int(step.action.kind)).takes_target


def _belief_in_words(recording: Recording, step: RecordedStep) -> list[str]:
    """Where a target that is not found was believed to be, whether rightly, and what hides it."""
    size, poses = int(step.existence.sum()), len(step.existence)
    truth = _truth(recording, step)
    right = {True: ", and its true pose is one of them", False: ", and none of them is its true pose", None: ""}[truth]
    sentences = [f"The robot believed that it can be at {size} of {poses} poses{right}."]
    if believed_elsewhere(step):
        sentences = ["The robot took something else for the target, and looked for it no more."]
    if hiding := _hiding(recording, step):
        named = " and ".join(f"object {i} ({100 * share:.0f} % of it)" for i, share in hiding)
        sentences.append(f"From the camera it is hidden by {named}.")
    return sentences


def _hiding(recording: Recording, step: RecordedStep) -> list[tuple[int, float]]:
    """The objects that hide much of the target from the camera, with its share."""
    hiding = hidden_behind(step, recording.camera, recording.shelf)
    return [(i, share) for i, share in hiding if share > LEAST_SHARE]


def _truth(recording: Recording, step: RecordedStep) -> bool | None:
    if recording.episode is None:
        return None
    return recording.episode.steps[recording.steps.index(step)].truth_possible


def believed_elsewhere(step: RecordedStep) -> bool:
    """Whether the robot takes something else for the target."""
    return not step.found and step.evidence is not None and bool(np.isfinite(step.evidence.believed_pose).all())


def free(hits: Bool[np.ndarray, "grasps n"]) -> bool:
    """Whether a grasp hits nothing."""
    return bool(len(hits)) and not hits.any(axis=1).all()


def _blockers(step: RecordedStep) -> tuple[int, ...]:
    hits = None if step.evidence is None else step.evidence.hits
    return () if hits is None or not len(hits) else blocking(hits)


def action_words(step: RecordedStep) -> str:
    """The action that a step decided on, in words."""
    return "nothing" if step.action is None else _in_words(step.action, step.scene.capacity)


def executed_words(recording: Recording, i: int) -> str:
    """The action that a step executed, in words; the protocol of the published code may replace the decided one."""
    step = recording.steps[i]
    record = None if recording.episode is None else recording.episode.steps[i].action
    if record is None or step.action is None or _same_motion(record, step.action):
        return action_words(step)
    kinds = {kind.name: kind for kind in KINDS.values()}
    fields: dict[str, Any] = {f.name: np.asarray(getattr(record, f.name)) for f in dataclasses.fields(ActionRecord)[2:]}
    fields |= {"kind": kinds[record.kind].code, "object": -1 if record.object is None else record.object}
    return _in_words(Action(**fields), step.scene.capacity)


def _in_words(action: Action, capacity: int) -> str:
    return kind_of(int(action.kind)).describe(action, capacity)
