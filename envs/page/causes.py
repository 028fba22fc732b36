"""The physical cause of a loss in a sentence or two: what stood where, what touched what, and what could not be moved.

Nothing is said that the recording, or a trial simulated once more, does not show.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import jax
import numpy as np

from mechsearch_jax.actions import kind_of
from mechsearch_jax.envs.known_target.in_the_way import numbers_in_words, objects_in_words
from mechsearch_jax.envs.page import choices, facts, places
from mechsearch_jax.envs.page.contacts import WALLS, Party, named, pressed
from mechsearch_jax.envs.page.replays import Stop, knocks, run_stop, touched, trial_stop
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.planner.trials import TrialResult

# A target whose surface is farther from a wall is not said to stand at it [m].
AT_WALL = 0.04
# What is said of most trials is true of at least this share.
MOST = 0.5


def cause(recording: Recording, fatal: int | None, obstacles: Sequence[int]) -> str:
    """Why a target was lost, physically; empty if nothing shows that.

    Args:
      recording: of the episode.
      fatal: the step whose action did what cannot be mended; None if the target could still have been taken out.
      obstacles: the objects that block or hide it at the last look.
    """
    last = recording.steps[-1]
    if fatal is not None:
        return _of_harm(recording, fatal)
    if last.evidence is None or facts.believed_elsewhere(last):
        return ""
    if not last.found:
        return _hidden(recording, obstacles) if obstacles else ""
    if not len(last.evidence.hits):
        return _no_grasp(recording)
    return _blocked(recording, obstacles) if obstacles else ""


def _of_harm(recording: Recording, i: int) -> str:
    """What touched what at the action that ended an episode."""
    step, record = recording.steps[i], None if recording.episode is None else recording.episode.steps[i]
    if record is None or step.action is None:
        return ""
    if facts.takes_target(step) and not record.fallen:
        stop = run_stop(recording, i)
        if stop is None or not stop.path:
            return ""
        return f"On the way to the target {pressed(stop.path)}, and {facts.plain(record.failure or '')}."
    failed = "" if recording.episode is None else recording.episode.failure or ""
    victim = record.fallen[0] if record.fallen else TARGET
    fell = "fell over" if victim == TARGET and not record.target_fallen else "fell off the board"
    if victim == TARGET and "the target fell" not in failed:
        return ""
    path = knocks(recording, i, victim)
    return f"{_pushed(path, step)}, which {fell}." if path else ""


def _pushed(path: Sequence[Party], step: RecordedStep) -> str:
    """How the robot moved a body, by a chain of `contacts.knocked`, as the begin of a sentence."""
    first, *bodies = (named(party, not step.found) for party in path)
    action = step.action
    held = action is not None and kind_of(int(action.kind)).holds_object and path[1] == int(action.object)
    if len(bodies) == 1:
        words = f"{first} moved {bodies[0]}" if held or _own(step, path[1]) else f"{first} ran into {bodies[0]}"
    elif held:
        words = f"{bodies[0]}, in the hand, ran into {bodies[1]}"
    else:
        words = f"{first} pushed {bodies[0]} into {bodies[1]}"
    words += "".join(f", and that into {body}" for body in bodies[2:])
    return words[0].upper() + words[1:]


def _own(step: RecordedStep, k: Party) -> bool:
    """Whether the action of a step was to move a body."""
    return step.action is not None and facts.moves(step.action) and int(step.action.object) == k


def _no_grasp(recording: Recording) -> str:
    """Where a target stands of which the arm can reach no grasp, and how it came there."""
    last, shelf = recording.steps[-1], recording.shelf
    wall, gap = next(iter(places.walls(shelf, last.world, TARGET).items()))
    at = f"{100 * gap:.0f} cm from {wall}" if gap < AT_WALL else places.area(shelf, last.world.position[TARGET, :2])
    stuck = " A found target is not pushed in this search." if _never_pushed(recording) else ""
    moved = [i for i in range(len(recording.steps) - 1) if facts.shifts(recording, i)[TARGET] > facts.DISPLACED]
    path = knocks(recording, moved[-1], TARGET) if moved else ()
    if not path:
        return f"The target stands {at}, and there the arm can reach no grasp of it.{stuck}"
    i, far = moved[-1], facts.shifts(recording, moved[-1])[TARGET]
    pushed = _pushed(path, recording.steps[i])
    return (
        f"{pushed} (action {i + 1}), which then stood {at}, {100 * far:.0f} cm from before:"
        f" there the arm can reach no grasp of it.{stuck}"
    )


def _never_pushed(recording: Recording) -> bool:
    return recording.episode is not None and recording.episode.config.get("move_target") is False


def _blocked(recording: Recording, obstacles: Sequence[int]) -> str:
    """What is in the way of each grasp of a target, what the hand met there, and why it was not moved."""
    last = recording.steps[-1]
    stand = "stands" if len(obstacles) == 1 else "stand"
    things = objects_in_words(obstacles)
    at = f" {places.beside_wall(recording.shelf, last.world, obstacles[0])}" if len(obstacles) == 1 else ""
    words = f"{things[0].upper()}{things[1:]} {stand}{at.rstrip()} in the way of each grasp of the target"
    met = _met_by_grasps(recording, len(recording.steps) - 1, obstacles)
    return " ".join(sentence for sentence in (f"{words}{met}.", _not_moved(recording, obstacles)) if sentence)


def _met_by_grasps(recording: Recording, i: int, obstacles: Sequence[int]) -> str:
    """What the hand met in most trials of taking the target out at a step; empty if that is not clear."""
    stops = trial_stops(recording, [i], None)
    paths = Counter(stop.path for stop in stops if stop.path and stop.path[1] in obstacles)
    if not paths:
        return ""
    path, count = paths.most_common(1)[0]
    if count < MOST * len(stops):
        return ""
    of = f"in {count} of {len(stops)} trials" if len(stops) > 1 else "in the only trial"
    every = f"in each of {len(stops)} trials" if count == len(stops) > 1 else of
    return f": {every} of taking it out at the last look {pressed(path)}, and the arm was held up"


def trial_stops(recording: Recording, steps: Sequence[int], k: int | None) -> list[Stop]:
    """Why trials failed, simulated once more; those of which that is not clear are left out.

    Args:
      recording: of the episode.
      steps: at which they were made.
      k: the object that they were to move; None for those that were to take the target out.
    """
    stops = []
    for i in steps:
        evidence = recording.steps[i].evidence
        for row in range(0 if evidence is None else len(evidence.tried.result)):
            assert evidence is not None
            action = jax.tree.map(lambda a, row=row: a[row], evidence.tried.action)
            taking = kind_of(int(action.kind)).takes_target
            wanted = taking if k is None else facts.moves(action) and int(action.object) == k
            stop = trial_stop(recording, i, row) if wanted else None
            stops += [] if stop is None else [stop]
    return stops


def _hidden(recording: Recording, obstacles: Sequence[int]) -> str:
    """Behind what a target stands that was never seen, and why that was not moved."""
    last = recording.steps[-1]
    at = places.where(recording.shelf, last.world, TARGET)
    words = f"The target stands {at} behind {objects_in_words(obstacles)}, seen from the camera."
    return " ".join(sentence for sentence in (words, _not_moved(recording, obstacles)) if sentence)


def _not_moved(recording: Recording, obstacles: Sequence[int]) -> str:
    """Why the first of some objects that can be explained stayed in the way; a sentence, or empty."""
    for k in obstacles:
        if words := _stayed(recording, k):
            return words
    return ""


def _stayed(recording: Recording, k: int) -> str:
    """Why an object stayed in the way: what became of moving it, or why nothing could move it."""
    since = since_found(recording)
    own = [i for i in since if _own(recording.steps[i], k)]
    none = impossible(recording, k)
    stops = trial_stops(recording, since, k)
    if own and len(own) * 2 > len(none):
        return _moved_in_vain(recording, own, k, stops)
    if stops and not own:
        return _never_carried_out(stops, k)
    parts = [_could_not(recording, none, k)] if none else []
    if own:
        far = sum(float(facts.shifts(recording, i)[k]) for i in own)
        late = ", the last one" if own[0] == last_action(recording) else ""
        parts.append(f"{actions_in_words(own).capitalize()}{late} moved it, by {100 * far:.0f} cm")
    return f"{'. '.join(part for part in parts if part)}." if any(parts) else ""


def _moved_in_vain(recording: Recording, own: Sequence[int], k: int, stops: Sequence[Stop]) -> str:
    """How far the actions moved an object that were to, and if they pushed it against a wall."""
    far = sum(float(facts.shifts(recording, i)[k]) for i in own)
    met = Counter(wall for i in own for wall in WALLS if any({k, wall} in row for row in touched(recording, i)))
    wall = f", until it met {met.most_common(1)[0][0]}" if met else ""
    words = f"{actions_in_words(own).capitalize()} moved object {k} by {100 * far:.0f} cm{' in all' * (len(own) > 1)}"
    return f"{words}{wall}, and it was still in the way."


def _never_carried_out(stops: Sequence[Stop], k: int) -> str:
    """How the trials ended that stood against moving an object."""
    words, count = Counter(stop.words for stop in stops).most_common(1)[0]
    if len(stops) == 1:
        return f"In the only failed trial of moving object {k} {words}."
    every = "each of" if count == len(stops) else f"{count} of"
    return f"In {every} the {len(stops)} failed trials of moving object {k} {words}."


def _could_not(recording: Recording, none: Sequence[int], k: int) -> str:
    """Why nothing could move an object at some steps; empty if that is not known, or other at most of them."""
    capacity = recording.steps[-1].scene.capacity
    known = {i: each for i in none if (each := choices.ways(recording, i, k)) is not None}
    why = Counter(choices.none_in_words(each, capacity) for each in known.values())
    why.pop("", None)
    if not why:
        return ""
    words, count = why.most_common(1)[0]
    if count < MOST * len(none):
        return ""
    at = [i for i in known if choices.none_in_words(known[i], capacity) == words]
    return f"{_when(recording, at)} nothing could move object {k}: {words}{_put_there(recording, at[0], k)}"


def _when(recording: Recording, steps: Sequence[int]) -> str:
    """Some steps in words, as the begin of a sentence."""
    every = [i for i in since_found(recording) if recording.steps[i].action is not None]
    within = [i for i in every if steps[0] <= i <= steps[-1]]
    if list(steps) == every:
        return "At no step"[:2] + " every step"
    if list(steps) == within and steps[-1] == every[-1] and len(steps) > 1:
        return f"From action {steps[0] + 1} on"
    if list(steps) == within and steps[0] == every[0] and len(steps) > 1:
        return f"Up to action {steps[-1] + 1}"
    return f"At step{'s' if len(steps) > 1 else ''} {numbers_in_words([i + 1 for i in steps])}"


def _put_there(recording: Recording, i: int, k: int) -> str:
    """That the action before a step moved what has been in the way of moving an object since; empty if none did."""
    before, now = choices.ways(recording, i - 1, k) if i else None, choices.ways(recording, i, k)
    if before is None or now is None or not choices.begun(before):
        return ""
    shifts = facts.shifts(recording, i - 1)
    moved = [b for each in now for b in each.blockers if b < TARGET and shifts[b] > facts.DISPLACED]
    return f", where action {i} had put {'it' if len(set(moved)) == 1 else 'them'}" if moved else ""


def impossible(recording: Recording, k: int) -> list[int]:
    """The steps with candidates, none of which was to move an object."""
    return [
        i
        for i in since_found(recording)
        if len(recording.steps[i].sampled) and not _any_of(recording.steps[i], k)
    ]


def _any_of(step: RecordedStep, k: int) -> bool:
    """Whether a candidate was to move an object, refused ones included."""
    refused = step.evidence is not None and any(
        result <= TrialResult.HARMFUL and int(moved) == k and kind_of(int(kind)).moves_object
        for result, moved, kind in zip(
            step.evidence.tried.result.tolist(), step.evidence.tried.action.object, step.evidence.tried.action.kind,
            strict=True,
        )
    )
    return refused or bool((np.asarray(step.sampled.action.object) == k).any())


def since_found(recording: Recording) -> list[int]:
    """The steps that count for what is in the way at the end: those at which the target was found, or all."""
    found = recording.steps[-1].found
    return [i for i, step in enumerate(recording.steps) if step.found == found]


def last_action(recording: Recording) -> int:
    """The last step with an action; -1 without one."""
    return max((i for i, step in enumerate(recording.steps) if step.action is not None), default=-1)


def actions_in_words(indices: Sequence[int]) -> str:
    """Actions by their numbers."""
    return f"{'action' if len(indices) == 1 else 'actions'} {numbers_in_words([i + 1 for i in indices])}"
