"""The physical cause of a loss in a sentence or two: what stood where, what touched what, and what could not be moved.

Nothing is said that the recording, or a trial simulated once more, does not show.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from mechsearch_jax.actions import kind_of
from mechsearch_jax.envs.known_target.in_the_way import least_sets, numbers_in_words, objects_in_words
from mechsearch_jax.envs.page import choices, facts, places
from mechsearch_jax.envs.page.contacts import WALLS, Party, named, pressed
from mechsearch_jax.envs.page.replays import Stop, knocks, run_stop, touched, trial_stop
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.planner.noted_trials import nothing_tried

# What is said of most trials is true of at least this share.
MOST = 0.5


class Cause(NamedTuple):
    """Why a target was lost, physically.

    Attributes:
      words: in one sentence; empty if nothing shows that.
      evidence: sentences on what shows it.
    """

    words: str = ""
    evidence: Sequence[str] = ()


def cause(recording: Recording, fatal: int | None, obstacles: Sequence[int]) -> Cause:
    """Why a target was lost, physically.

    Args:
      recording: of the episode.
      fatal: the step whose action did what cannot be mended; None if the target could still have been taken out.
      obstacles: the objects that block or hide it at the last look.
    """
    last = recording.steps[-1]
    if fatal is not None:
        return Cause(_of_harm(recording, fatal), _unknown(recording, fatal))
    if last.evidence is None or facts.believed_elsewhere(last):
        return Cause()
    if not last.found:
        return _hidden(recording, obstacles) if obstacles else Cause()
    if not len(last.evidence.hits):
        return _no_grasp(recording)
    return _blocked(recording, obstacles) if obstacles else Cause()


def _of_harm(recording: Recording, i: int) -> str:
    """What touched what at the action that ended an episode."""
    step, record = recording.steps[i], None if recording.episode is None else recording.episode.steps[i]
    if recording.episode is None or record is None or step.action is None:
        return ""
    stop = run_stop(recording, i) if facts.takes_target(step) and not record.fallen else None
    if stop is not None and stop.path:
        return f"As the target was to be taken out, {pressed(stop.path)}, and {facts.plain(record.failure or '')}."
    victim = record.fallen[0] if record.fallen else TARGET
    if victim == TARGET and "the target fell" not in (recording.episode.failure or ""):
        return ""
    fell = "fell over" if victim == TARGET and not record.target_fallen else "fell off the board"
    path = knocks(recording, i, victim)
    # That the hand touches a target that it grasps says nothing.
    known = len(path) > 1 + facts.takes_target(step)
    return f"{_pushed(path, step)}, which {fell} (action {i + 1})." if known else ""


def _unknown(recording: Recording, i: int) -> list[str]:
    """That an object was not recognised which the arm met as it was held up, as a sentence; none if all were."""
    stop, scene = run_stop(recording, i), recording.steps[i].scene
    path = () if stop is None else stop.path
    met = sorted(k for k in path if isinstance(k, int) and k < scene.capacity and not scene.valid[k])
    if not met:
        return []
    return [f"{objects_in_words(met).capitalize()} {'was' if len(met) == 1 else 'were'} not recognised at that step."]


def _pushed(path: Sequence[Party], step: RecordedStep) -> str:
    """How the robot moved a body, by a chain of `contacts.knocked`, as the begin of a sentence."""
    first, *bodies = (named(party, not step.found) for party in path)
    own = facts.moves_body(step, path[1])
    held = own and step.action is not None and kind_of(int(step.action.kind)).holds_object
    if len(bodies) == 1:
        words = f"{first} {'moved' if held else 'pushed' if own else 'ran into'} {bodies[0]}"
    elif held:
        words = f"{bodies[0]}, in the hand, ran into {bodies[1]}"
    else:
        words = f"{first} pushed {bodies[0]} into {bodies[1]}"
    words += "".join(f", and that into {body}" for body in bodies[2:])
    return words[0].upper() + words[1:]


def _no_grasp(recording: Recording) -> Cause:
    """Where a target stands of which the arm can reach no grasp, and how it came there."""
    last, shelf = recording.steps[-1], recording.shelf
    at = places.where(shelf, last.world, TARGET)
    never = recording.episode is not None and recording.episode.config.get("move_target") is False
    stuck = ["A target that is found is not pushed in this search."] if never else []
    had = [i for i, step in enumerate(recording.steps) if step.evidence is not None and len(step.evidence.hits)]
    i = had[-1] if had else -1
    far = float(facts.shifts(recording, i)[TARGET]) if had else 0.0
    path = knocks(recording, i, TARGET) if far > facts.DISPLACED else ()
    if not path:
        return Cause(f"The target stands {at}, and there the arm can reach no grasp of it.", stuck)
    pushed = f"{_pushed(path, recording.steps[i])}, which moved {100 * far:.0f} cm (action {i + 1})"
    return Cause(f"{pushed}; since then the arm can reach no grasp of it: it stands {at}.", stuck)


def _blocked(recording: Recording, obstacles: Sequence[int]) -> Cause:
    """What is in the way of each grasp of a target, what the hand met there, and why it was not moved."""
    last, one = recording.steps[-1], len(obstacles) == 1
    at = places.beside_wall(recording.shelf, last.world, obstacles[0]) if one else ""
    at = f" {at}{_came_there(recording, obstacles[0])}," if at else ""
    things = objects_in_words(obstacles).capitalize()
    words = f"{things} {'stands' if one else 'stand'}{at} in the way of {_grasps(last)}"
    stops = trial_stops(recording, [len(recording.steps) - 1], None)
    path, count = _met_by_grasps(stops, obstacles)
    stayed = _not_moved(recording, obstacles, path)
    if not path:
        return Cause(f"{words}{stayed.words}.", stayed.evidence)
    met = f"reaching for it, {pressed(path, now=True)}, and the arm is held up"
    so = f"So it was in {_among(count, stops)} of taking the target out at the last look."
    return Cause(f"{words}: {met}.", [so, *stayed.evidence])


def _grasps(step: RecordedStep) -> str:
    """Which grasps of the target meet the objects that the best ones meet, in words."""
    assert step.evidence is not None
    count = len(step.evidence.hits)
    if len(least_sets(step.evidence.hits)) > 1:
        return f"the best of the {count} grasps of the target that the arm can reach"
    which = f"each of the {count} grasps" if count > 1 else "the only grasp"
    return f"{which} of the target that the arm can reach"


def _came_there(recording: Recording, k: int) -> str:
    """Which action moved an object to where it stands without being to move it since the target was found, in words."""
    moved = [i for i in range(last_action(recording) + 1) if facts.shifts(recording, i)[k] > facts.DISPLACED]
    since = facts.since_found(recording)
    if not moved or any(facts.moves_body(recording.steps[i], k) for i in since):
        return ""
    return f", where action {moved[-1] + 1} moved it"


def _met_by_grasps(stops: Sequence[Stop], obstacles: Sequence[int]) -> tuple[tuple[Party, ...], int]:
    """What the hand met in most of some failed trials of taking the target out, and in how many; empty if unclear."""
    paths = Counter(stop.path for stop in stops if len(stop.path) > 1 and stop.path[1] in obstacles)
    path, count = paths.most_common(1)[0] if paths else ((), 0)
    return (path, count) if path and count >= MOST * len(stops) else ((), 0)


def _among(count: int, stops: Sequence[Stop]) -> str:
    """So many of some failed trials, in words."""
    if len(stops) == 1:
        return "the only failed trial"
    return f"{'each' if count == len(stops) else count} of the {len(stops)} failed trials"


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
        tried = nothing_tried() if evidence is None else evidence.tried
        for row in range(len(tried.result)):
            kind, moved = kind_of(int(tried.action.kind[row])), int(tried.action.object[row])
            if kind.takes_target if k is None else kind.moves_object and moved == k:
                stops.append(trial_stop(recording, i, row))
    return [stop for stop in stops if stop is not None]


def _hidden(recording: Recording, obstacles: Sequence[int]) -> Cause:
    """What hides a target that was never seen, and why that was not moved."""
    at = places.where(recording.shelf, recording.steps[-1].world, TARGET)
    stayed = _not_moved(recording, obstacles, ())
    words = f"The target stands {at}, hidden from the camera by {objects_in_words(obstacles)}{stayed.words}."
    return Cause(words, stayed.evidence)


def _not_moved(recording: Recording, obstacles: Sequence[int], met: Sequence[Party]) -> Cause:
    """Why the first of some objects of which that is known stayed in the way: a clause, and what shows it.

    Args:
      recording: of the episode.
      obstacles: the objects.
      met: what the hand met in trials of taking the target out, of which it was said.
    """
    every = (_stayed(recording, k, met) for k in obstacles)
    return next((each for each in every if each.words or each.evidence), Cause())


def _stayed(recording: Recording, k: int, met: Sequence[Party]) -> Cause:
    """What became of moving an object, or why nothing could move it; empty if that is not known."""
    since = facts.since_found(recording)
    own = [i for i in since if facts.moves_body(recording.steps[i], k)]
    none = impossible(recording, k)
    moved = [f"{_moved(recording, own, k)}."] if own else []
    stops = trial_stops(recording, since, k)
    if stops and not (own and len(stops) == 1):
        (words, path), count = Counter((stop.words, stop.path) for stop in stops).most_common(1)[0]
        tried = f"{_among(count, stops)} of moving object {k}"
        return Cause("", [*moved, f"So it was in {tried}, too." if path and path == met else f"In {tried} {words}."])
    if own and not (none and none[0] < own[0]):
        return Cause("", moved)
    at, words = _could_not(recording, none, k)
    if not words:
        return Cause("", moved)
    clause = f", and {_when(recording, at)} nothing could move object {k}: {words}{_put_there(recording, at[0], k)}"
    until = [i for i in since if i not in none and recording.steps[i].action is not None and not (own and i >= own[0])]
    passing = [i for i in until if (each := choices.ways(recording, i, k)) and choices.only_entering(each)]
    if passing:
        when = _when(recording, passing).capitalize()
        costs = f"{when} each motion that could move it passed where the target may be, which counts against that."
        moved = [costs, *moved]
    return Cause(clause, moved)


def _moved(recording: Recording, own: Sequence[int], k: int) -> str:
    """How far the actions moved an object that were to, and which wall it met; without an end."""
    far = sum(float(facts.shifts(recording, i)[k]) for i in own)
    met = Counter(wall for i in own for wall in WALLS if any({k, wall} in row for row in touched(recording, i)))
    acts = facts.actions_in_words(own).capitalize()
    if far < facts.DISPLACED:
        return f"{acts} {'was' if len(own) == 1 else 'were'} to move object {k}, and moved it by less than 1 cm"
    late = ", the last one," if own[0] == last_action(recording) else ""
    wall = f", until it met {met.most_common(1)[0][0]}" if met else ""
    return f"{acts}{late} moved object {k} by {100 * far:.0f} cm{' in all' if len(own) > 1 else ''}{wall}"


def _could_not(recording: Recording, none: Sequence[int], k: int) -> tuple[list[int], str]:
    """At which of some steps nothing could move an object, and why at most of them; empty if that is not known."""
    why = {i: words for i in none if (words := why_none(recording, i, k))}
    words, count = Counter(why.values()).most_common(1)[0] if why else ("", 0)
    return ([i for i in why if why[i] == words], words) if words and count >= MOST * len(none) else ([], "")


def why_none(recording: Recording, i: int, k: int) -> str:
    """Why none of an object's motions was possible at a step, in words; empty if that is not known."""
    every = choices.ways(recording, i, k)
    return "" if every is None else choices.none_in_words(every, recording.steps[i].scene.capacity)


def _when(recording: Recording, steps: Sequence[int]) -> str:
    """Some steps in words."""
    every = [i for i in facts.since_found(recording) if recording.steps[i].action is not None]
    within = [i for i in every if steps[0] <= i <= steps[-1]]
    if list(steps) == every and not every[0]:
        return "at every step"
    if list(steps) == within and steps[-1] == every[-1]:
        return f"from action {steps[0] + 1} on"
    if list(steps) == within and not steps[0]:
        return f"before action {steps[-1] + 2}"
    return f"at step{'s' if len(steps) > 1 else ''} {numbers_in_words([i + 1 for i in steps])}"


def _put_there(recording: Recording, i: int, k: int) -> str:
    """That the action before a step moved what has been in the way of moving an object since; empty if none did."""
    before, now = choices.ways(recording, i - 1, k) if i else None, choices.ways(recording, i, k)
    if before is None or now is None or not choices.begun(before):
        return ""
    shifts = facts.shifts(recording, i - 1)
    moved = {b for each in now for b in each.blockers if b < TARGET and shifts[b] > facts.DISPLACED}
    return f"; action {i} had put {objects_in_words(sorted(moved))} there" if moved else ""


def impossible(recording: Recording, k: int) -> list[int]:
    """The steps with candidates, none of which was to move an object."""
    every = {i: facts.candidates_of(recording.steps[i]) for i in facts.since_found(recording)}
    return [i for i, moved in every.items() if moved and all(other != k for other, _ in moved)]


def last_action(recording: Recording) -> int:
    """The last step with an action; -1 without one."""
    return max((i for i, step in enumerate(recording.steps) if step.action is not None), default=-1)
