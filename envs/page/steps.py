"""What the page of an episode says of each step: belief, decision, trials, recognition, and what came of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mechsearch_jax.actions import kind_of
from mechsearch_jax.envs.camera.snapshot import Snapshot
from mechsearch_jax.envs.episode.records import Step
from mechsearch_jax.envs.known_target.in_the_way import blocking, grasps_in_words, objects_in_words
from mechsearch_jax.envs.page.facts import (
    action_words,
    believed_elsewhere,
    counted,
    free,
    number,
    plain,
    same_action,
    takes_target,
    tipped,
    trial_of,
    trouble,
)
from mechsearch_jax.envs.page.pictures import objects_of
from mechsearch_jax.envs.page.reasons import moved_in_words
from mechsearch_jax.envs.page.replays import Stop, run_stop
from mechsearch_jax.envs.page.story import WRONG
from mechsearch_jax.envs.recording.narration import events
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.graspability import INFEASIBLE
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.doubt import recognition_doubt
from mechsearch_jax.planner.trials import TrialResult

RESULTS = {
    TrialResult.SUCCEEDED: ("good", "went as intended"),
    TrialResult.FAILED: ("poor", "failed; why is not known"),
    TrialResult.HARMFUL: ("bad", "harm: something fell off the board, or the found target fell over"),
    TrialResult.UNSURE: ("poor", "the target was taken out here, but not in every scene nearby"),
    TrialResult.UNKNOWN: ("poor", "no result: it could not be simulated"),
}
# What stands for what nobody knows.
UNKNOWN = "–"
# Recognisers that see images, and may be wrong.
SEEING = ("masks", "masks-parts", "full", "full-parts")
# An object that shows no more pixels than this counts as hidden.
FEWEST_PIXELS = 100


class Candidate(NamedTuple):
    """One of the best candidates of a decision.

    Attributes:
      role: "chosen", "runner-up", or "best of another object"; of one that its trial ruled out, with that.
      words: the action.
      value, cost: equation 2 of its sequence, and predicted J after it; empty if the policy minds no cost.
      belief: predicted f and g in words; empty if not recorded.
      row: its index among the sampled actions.
    """

    role: str
    words: str
    value: str
    cost: str
    belief: str
    row: int


class Trial(NamedTuple):
    """Actions alike that were tried out: in words, what came of them, how that is coloured, and what followed."""

    words: str
    result: str
    colour: str
    verdict: str


class Shape(NamedTuple):
    """A recognised object: its number, what it is taken for, how sure that is, how far it is from the true body."""

    number: str
    words: str
    confidence: str
    off: str
    wrong: bool


def over(recording: Recording, step: RecordedStep) -> str:
    """That the target could no longer be taken out when the robot looked; empty if it could."""
    taken = recording.episode is not None and recording.episode.retrieved
    why = None if taken else trouble(recording, step)
    return "" if why is None else f"The episode had ended: {why}."


def poses_in_words(step: RecordedStep, before: RecordedStep | None) -> str:
    """f and g of a step, and how f changed since the step before."""
    if step.found:
        return "The target is found, so f is this one pose."
    if believed_elsewhere(step):
        return "Something else is taken for the target, so f is that one pose."
    size, poses = int(step.existence.sum()), len(step.existence)
    good = graspable(step.existence, step.graspability)
    words = f"f: the target can be at {size} of {poses} poses; g: at {good} of these a grasp would meet nothing."
    if before is None or before.found:
        return words
    gone = int((before.existence & ~step.existence).sum())
    new = int((step.existence & ~before.existence).sum())
    change = [f"{counted(gone, 'pose')} {_were(gone)} ruled out"] if gone else []
    change += [f"{counted(new, 'pose')} {_were(new)} opened again"] if new else []
    return f"{words} Since the step before, {' and '.join(change) or 'nothing changed'}."


def graspable(existence: np.ndarray, graspability: np.ndarray) -> int:
    """Number of possible poses at which a grasp meets nothing."""
    return int((existence & (graspability == 1)).sum())


def grasps_words(step: RecordedStep) -> str:
    """What the grasps of a target that is found would meet; empty if that is not recorded."""
    if step.evidence is None or not step.found:
        return ""
    hits = step.evidence.hits
    if free(hits):
        clear = int((~hits.any(axis=1)).sum())
        reached = f"{clear} of {len(hits)} grasps that the arm can reach inside the shelf"
        return f"{reached} hit{'s' if clear == 1 else ''} nothing."
    words = grasps_in_words(hits)
    return f"{words[0].upper()}{words[1:]}."


def candidates(step: RecordedStep, obstacles: Sequence[int] = ()) -> list[Candidate]:
    """The chosen action, the runner-up, and the best actions that move another object, or one in the way.

    A runner-up that reads as the chosen action does is passed over. The best that moves another object is left out of
    recordings that do not foresee it. None where nothing was chosen, or no sequences were compared.

    Args:
      step: with the decision.
      obstacles: the objects in the way at the end; the best action of the first is shown, too.
    """
    if step.action is None or not kind_of(int(step.action.kind)).moves_object:
        return []
    every = range(len(step.sampled))
    chosen = [k for k in every if same_action(step, step.sampled.action, k)][:1]
    others = [k for k in every if k not in chosen][:1]
    moved = step.sampled.action.object
    elsewhere = [k for k in every if moved[k] != step.action.object][:1]
    further = [k for k in elsewhere if k not in others and _forecast(step, k)]
    roles = {"chosen": chosen, "runner-up": others, "best of another object": further}
    shown = [_candidate(step, role + _ruled_out(step, k), k) for role, rows in roles.items() for k in rows]
    if len(shown) > 1 and chosen and others and _alike(shown[0], shown[1]):
        del shown[1]
    for i in obstacles[:1]:
        best = [k for k in every if moved[k] == i][:1]
        if best and i not in [int(moved[candidate.row]) for candidate in shown]:
            role = f"best of object {i}, in the way at the end{_ruled_out(step, best[0])}"
            shown.append(_candidate(step, role, best[0]))
    return shown


def unmoved(step: RecordedStep, obstacles: Sequence[int], why: str = "") -> str:
    """That no candidate was to move the object that is in the way at the end; empty if one was.

    Args:
      step: with the decision.
      obstacles: the objects in the way at the end.
      why: in words; empty if that is not known.
    """
    if not obstacles or not len(step.sampled) or (step.sampled.action.object == obstacles[0]).any():
        return ""
    none = f"No candidate of this step was to move object {obstacles[0]}, which is in the way at the end"
    return f"{none}: {why}." if why else f"{none}; why is not known."


def _alike(one: Candidate, other: Candidate) -> bool:
    """Whether two candidates read the same."""
    return one._replace(role="", row=0) == other._replace(role="", row=0)


def _ruled_out(step: RecordedStep, k: int) -> str:
    """That a trial ruled a candidate out; empty if none did, or if it was chosen nevertheless."""
    result = trial_of(step, step.sampled.single(k))
    if result in (None, TrialResult.SUCCEEDED) or same_action(step, step.sampled.action, k):
        return ""
    return f", {'passed over' if result is TrialResult.FAILED else 'refused'} after its trial"


def _candidate(step: RecordedStep, role: str, k: int) -> Candidate:
    action = step.sampled.single(k)
    words = kind_of(int(action.kind)).describe(action, step.scene.capacity)
    value, cost = (float(numbers[k]) for numbers in (step.sampled.value, step.sampled.cost))
    if not (step.sampled.value.any() or step.sampled.cost.any()):
        return Candidate(role, words, "", "", _forecast(step, k), k)
    return Candidate(role, words, f"{value + 0.0:+.1f}".replace("-0.0", "0.0"), number(cost), _forecast(step, k), k)


def _forecast(step: RecordedStep, k: int) -> str:
    forecasts = None if step.evidence is None else step.evidence.forecasts
    row = None if forecasts is None else forecasts.of(k)
    if forecasts is None or row is None:
        return ""
    least = int(forecasts.in_the_way[row])
    if least == INFEASIBLE:
        return "no grasp would be possible"
    if least >= 0:
        return "a grasp would be free" if least == 0 else f"the best grasp would hit {counted(least, 'object')}"
    exists, g = forecasts.existence[row], forecasts.graspability[row]
    return f"f at {counted(int(exists.sum()), 'pose')}, graspable at {graspable(exists, g)}"


def _were(count: int) -> str:
    return "was" if count == 1 else "were"


def trials(step: RecordedStep, stops: Sequence[Stop | None] = ()) -> list[Trial]:
    """What was tried out at a step, in order; trials that read the same stand where the first of them does.

    Args:
      step: of the trials.
      stops: why each of them failed, as far as that is known; may be left out.
    """
    if step.evidence is None:
        return []
    tried = step.evidence.tried
    rows = []
    for k, code in enumerate(tried.result.tolist()):
        result = TrialResult(code)
        kind = kind_of(int(tried.action.kind[k]))
        single = type(tried.action)(*(getattr(tried.action, name)[k] for name in tried.action.__dataclass_fields__))
        made = same_action(step, tried.action, k)
        passed = "passed over" if result is TrialResult.FAILED else "refused"
        verdict = "chosen" if made else "not better" if result is TrialResult.SUCCEEDED else passed
        colour, words = RESULTS[result]
        if kind.takes_target and result is not TrialResult.SUCCEEDED:
            failed = "the target was not taken out, here or in a scene nearby"
            words = {TrialResult.UNSURE: words, TrialResult.UNKNOWN: "no result"}.get(result, failed)
            colour, verdict = "poor", "chosen" if made else "passed over"
        stop = stops[k] if stops else None
        rows.append(Trial(kind.describe(single, step.scene.capacity), stop.words if stop else words, colour, verdict))
    counts = [(row, rows.count(row)) for row in dict.fromkeys(rows)]
    return [row._replace(words=f"{row.words}, {count} ways") if count > 1 else row for row, count in counts]


def truth(step: RecordedStep, record: Step | None) -> str:
    """Whether the belief holds the truth; empty if that is not recorded."""
    if believed_elsewhere(step):
        return "It is not the target."
    if record is None or record.truth_possible is None:
        return ""
    if record.truth_possible:
        return "The true pose is among the possible ones."
    return "The true pose is not among the possible ones: the belief is wrong."


def blocked(step: RecordedStep) -> tuple[int, ...]:
    """The recognised objects that the best grasps of a found target hit."""
    if step.evidence is None or not step.found or not len(step.evidence.hits):
        return ()
    return tuple(i for i in blocking(step.evidence.hits) if step.scene.valid[i])


def troubles(recording: Recording, i: int) -> list[str]:
    """What went wrong at a step; empty where that is not recorded."""
    if recording.episode is None:
        return []
    record, after = recording.episode.steps[i], [] if recording.episode.retrieved else recording.steps[i + 1 : i + 2]
    fell = [why for step in after if (why := trouble(recording, step)) and not record.target_fallen]
    stop = run_stop(recording, i)
    failed = [plain(record.failure)] if record.failure else []
    return [*(failed if stop is None else [stop.words]), *events(record), *fell]


def came_of_it(recording: Recording, i: int) -> str:
    """What a step's action moved and tipped in the run, beside its trial; empty if nothing, or without a record."""
    step = recording.steps[i]
    if recording.episode is None or step.action is None:
        return ""
    moved, tips = moved_in_words(recording, i, target=not takes_target(step)), tipped(recording, i)
    if not moved:
        return "In the run it moved nothing by more than 1 cm."
    over = f", and tipped {objects_in_words(tips)}" if tips else ""
    trial = trial_of(step, step.action)
    fine = tips and trial is TrialResult.SUCCEEDED and not takes_target(step)
    remark = " Its trial went as intended; it does not matter there whether an object is tipped." if fine else ""
    return f"In the run it moved {moved}{over}.{remark}"


def shapes(recording: Recording, step: RecordedStep, owner: Int[np.ndarray, "h w"]) -> list[Shape]:
    """The recognised objects beside the true ones; empty where the true shapes were given.

    Args:
      recording: of the episode.
      step: one of its steps.
      owner: the true object at each pixel of the image.
    """
    episode = recording.episode
    if episode is None or episode.config.get("recognition") not in SEEING:
        return []
    truth = objects_of(step.world, recording.camera, recording.shelf)
    rows = []
    for i in range(step.scene.capacity):
        seen, there = bool(step.scene.valid[i]), bool(truth.valid[i])
        if not (seen or there):
            continue
        if not seen:
            visible = bool(np.count_nonzero(owner == i) > FEWEST_PIXELS)
            rows.append(Shape(str(i), "not recognised" if visible else "hidden", UNKNOWN, UNKNOWN, visible))
            continue
        off = float(np.linalg.norm(np.asarray(step.scene.position[i]) - np.asarray(truth.position[i])))
        apart = f"{100 * off:.1f} cm" if there else "nothing is there"
        rows.append(_recognised(step, i)._replace(off=apart, wrong=not there or off > WRONG))
    return rows


def recognised(step: RecordedStep) -> list[Shape]:
    """The recognised objects of a step whose true ones nobody knows."""
    return [_recognised(step, i) for i in range(step.scene.capacity) if step.scene.valid[i]]


def _recognised(step: RecordedStep, i: int) -> Shape:
    sure = float(confidence(step)[i])
    return Shape(str(i), _shape(step, i), f"{100 * sure:.0f} %" if np.isfinite(sure) else UNKNOWN, UNKNOWN, False)


def confidence(step: RecordedStep) -> Float[np.ndarray, " n"]:
    """How sure each recognised object is; NaN where nothing says so."""
    return np.full(step.scene.capacity, np.nan) if step.evidence is None else step.evidence.confidence


def _shape(step: RecordedStep, i: int) -> str:
    """A recognised shape in words, with its size."""
    x, y, z = (200 * float(half) for half in step.scene.size[i])
    if float(step.scene.exponents[i, 1]) > 0.5:
        return f"cylinder, {x:.0f} cm wide, {z:.0f} cm long"
    return f"box, {x:.0f} × {y:.0f} × {z:.0f} cm"


def doubt(recording: Recording, step: RecordedStep, depth: np.ndarray) -> str:
    """How badly the recognised shapes explain an image without noise."""
    seen = Observation(step.scene, jnp.array(step.found), jnp.asarray(step.target_pose))
    measure = recognition_doubt(recording, seen, depth)
    share = f"{100 * measure.passed:.0f} %"
    behind = f"; at {share} of the pixels that {measure.worst} should fill, something behind it shows"
    passed = behind if measure.worst and share != "0 %" else ""
    return f"{100 * measure.unexplained:.0f} % of what stands on the board lies on no recognised shape{passed}."


def depth_of(recording: Recording, step: RecordedStep) -> np.ndarray:
    """The depth image of a step without noise [m]."""
    return np.asarray(Snapshot(recording.camera, recording.shelf, step.world).image.depth)


def costs(recording: Recording, i: int) -> tuple[str, bool] | None:
    """J before a step's action, as expected after it and as observed, and whether it came out as much worse.

    None where that is not recorded, or where the policy compares no costs.
    """
    if recording.episode is None or recording.steps[i].action is None:
        return None
    record = recording.episode.steps[i]
    if record.cost is None or record.predicted_cost is None:
        return None
    if not record.compares_costs:
        return None
    observed = "not observed" if record.observed_cost is None else f"{number(record.observed_cost)} observed"
    taken_next = i + 1 < len(recording.steps) and takes_target(recording.steps[i + 1])
    if record.observed_cost is not None and taken_next:
        observed += ", as a grasp that takes the target out is known then"
    worse = record.observed_cost is not None and record.observed_cost > record.predicted_cost + 0.1 * record.cost
    return f"J: {number(record.cost)} before, {number(record.predicted_cost)} expected, {observed}", worse


def label(step: RecordedStep) -> str:
    """What was done at a step, as short as can be."""
    if step.action is None:
        return "end"
    kind = kind_of(int(step.action.kind))
    if not kind.moves_object:
        return "take out" if kind.takes_target else kind.name
    what = "target" if int(step.action.object) == step.scene.capacity else str(int(step.action.object))
    return f"{kind.name.partition('-')[0]} {what}"


def heading(step: RecordedStep) -> str:
    """What was done at a step."""
    return "the search ends here" if step.action is None else action_words(step)
