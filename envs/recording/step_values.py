"""What a recorded episode and its steps hold, as values: for its page, and for the viewer's panel."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jinja2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mechsearch_jax.actions import Action, kind_of
from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board
from mechsearch_jax.envs.episode.endings import events, in_words, verdict
from mechsearch_jax.envs.episode.episode_log import target_trouble
from mechsearch_jax.envs.episode.records import Step
from mechsearch_jax.envs.recording.in_the_way import blocking, least_sets, objects_in_words
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.world.world import TARGET, World
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.doubt import recognition_doubt
from mechsearch_jax.planner.trials import TrialResult

# What came of a trial, and how that is coloured.
RESULTS = {
    TrialResult.SUCCEEDED: ("good", "went as intended"),
    TrialResult.FAILED: ("poor", "failed"),
    TrialResult.HARMFUL: ("bad", "did harm: something fell"),
    TrialResult.UNSURE: ("poor", "succeeded here, but not in every scene nearby"),
    TrialResult.UNKNOWN: ("poor", "no result"),
}
# Recognitions whose shapes may be wrong: the others are given the true ones.
SEEING = ("masks", "masks-parts", "full", "full-parts")
# An object that shows no more pixels than this counts as hidden.
FEWEST_PIXELS = 100
# What moved less at an action counts as where it was [m], and what tilted less as upright [rad].
DISPLACED, TILTED = 0.01, np.deg2rad(20.0)


class Ending(NamedTuple):
    """How an episode ended, or where it is.

    Attributes:
      good: whether it reached what its protocol asks for; None if nothing says so.
      title: in a sentence.
      text: what more is to be said.
    """

    good: bool | None
    title: str
    text: str = ""


class Candidate(NamedTuple):
    """A compared action.

    Attributes:
      role: "chosen", "next best" or "best of another object".
      words: the action.
      value: equation 2 of its sequence; None if the policy compares no costs.
      cost: predicted J after it; likewise.
      poses, graspable: predicted number of poses in f, and of these, where a grasp meets nothing; None if not recorded.
    """

    role: str
    words: str
    value: float | None
    cost: float | None
    poses: int | None
    graspable: int | None


class Trial(NamedTuple):
    """Actions that read alike and were tried out: words, number, result, its colour, and whether one was chosen."""

    words: str
    count: int
    result: str
    colour: str
    chosen: bool


class Shape(NamedTuple):
    """A recognised object.

    Attributes:
      number: index of the object.
      words: what it is taken for; "hidden" or "not recognised" if it is not.
      confidence: 0 to 1; None if nothing says so.
      off: distance from the true body's middle [m]; None without one.
    """

    number: int
    words: str
    confidence: float | None
    off: float | None


@dataclasses.dataclass(frozen=True)
class StepValues:
    """The values of a step; None and empty ones are not recorded, or do not apply.

    Attributes:
      number: of the step, from 1.
      heading: the decided action in words.
      found: whether the target is found.
      poses: number of poses in f; 1 once something is taken for the target.
      every: number of candidate poses.
      graspable: number of poses in f at which a grasp meets nothing.
      ruled_out, opened: number of poses that left f since the step before, and that came back.
      cost, predicted, measured: J before the action, as predicted after it, and as measured at the next look.
      grasps, free: of a found target, number of grasps that the arm reaches inside the shelf, and of these, that meet
        nothing.
      hits: where none is free, the sets of objects that grasps meet, the smallest first, in words.
      blocked: the recognised objects in the way of the best grasps of a found target.
      candidates: the chosen action and the best others.
      compared: number of candidate actions.
      trials: what was simulated before acting.
      shapes: what was recognised; empty where the true shapes were given.
      unexplained: share of what stands on the board that lies on no recognised shape.
      moved: what the action moved, in words.
      outcome: what came of the action.
      warnings: what is wrong with belief or action, a line each.
    """

    number: int
    heading: str
    found: bool
    poses: int
    every: int
    graspable: int
    ruled_out: int | None
    opened: int | None
    cost: float | None
    predicted: float | None
    measured: float | None
    grasps: int | None
    free: int | None
    hits: tuple[str, ...]
    blocked: tuple[int, ...]
    candidates: tuple[Candidate, ...]
    compared: int
    trials: tuple[Trial, ...]
    shapes: tuple[Shape, ...]
    unexplained: float | None
    moved: tuple[str, ...]
    outcome: str
    warnings: tuple[str, ...]


def environment(*folders: Path) -> jinja2.Environment:
    """Templates of some folders, and those of values, which lie beside this file."""
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader([*folders, Path(__file__).parent]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )


def ending(recording: Recording) -> Ending:
    """How a recording's episode ended."""
    episode = recording.episode
    if episode is None:
        return Ending(None, recording.heading.partition(": ")[2] or recording.heading)
    return Ending(episode.retrieved, verdict(episode).removeprefix(f"{episode.scenario}: "))


def step_values(recording: Recording, i: int) -> StepValues:
    """The values of the i-th step of a recording."""
    step, before = recording.steps[i], recording.steps[i - 1] if i else None
    record = None if recording.episode is None else recording.episode.steps[i]
    costs = record if record is not None and step.action is not None and record.compares_costs else None
    known = not (step.found or mistaken(step))
    size = int(step.existence.sum()) if known else 1
    changes = before is not None and known and not (before.found or mistaken(before))
    hits = step.evidence.hits if step.evidence is not None and step.found else None
    free = None if hits is None else int((~hits.any(axis=1)).sum())
    return StepValues(
        number=i + 1,
        heading="no action" if step.action is None else _in_words(step.action, step),
        found=step.found,
        poses=size,
        every=len(step.existence),
        graspable=int((step.existence & (step.graspability == 1)).sum()),
        ruled_out=int((before.existence & ~step.existence).sum()) if changes and before else None,
        opened=int((step.existence & ~before.existence).sum()) if changes and before else None,
        cost=costs and costs.cost,
        predicted=costs and costs.predicted_cost,
        measured=costs and costs.observed_cost,
        grasps=None if hits is None else len(hits),
        free=free,
        hits=() if hits is None or free else tuple(map(objects_in_words, least_sets(hits))),
        blocked=tuple(k for k in blocking(hits) if step.scene.valid[k]) if hits is not None and len(hits) else (),
        candidates=_candidates(step),
        compared=len(step.sampled),
        trials=_trials(step),
        shapes=_shapes(recording, step),
        unexplained=_unexplained(recording, step) if _sees(recording) else None,
        moved=_moved(recording, i),
        outcome=_outcome(recording, i, record),
        warnings=_warnings(recording, i, record),
    )


def mistaken(step: RecordedStep) -> bool:
    """Whether the robot takes something else for the target."""
    return not step.found and step.evidence is not None and bool(np.isfinite(step.evidence.believed_pose).all())


def trouble(recording: Recording, step: RecordedStep) -> str | None:
    """Why the target could no longer be retrieved when the robot looked: it lay, or had left the board; else None.

    None, too, where nobody knows where it is, as in a search on a robot that has not found it.
    """
    if not step.world.valid[TARGET]:
        return None
    place, rotation = (np.asarray(a)[TARGET] for a in (step.world.position, step.world.rotation))
    return target_trouble(recording.shelf, place, rotation, recording.target.solid.ends_alike)


def last_world(step: RecordedStep) -> World:
    """The true state after the step's action, or at the step if there was none."""
    if not len(step.trace.time):
        return step.world
    rotation = Rotation.from_quat(np.asarray(step.trace.quaternion[-1]), scalar_first=True).as_matrix()
    return step.world.replace(
        position=np.asarray(step.trace.position[-1], np.float32), rotation=rotation.astype(np.float32)
    )


def confidence(step: RecordedStep) -> Float[np.ndarray, " n"]:
    """How sure each recognised object is; NaN where nothing says so."""
    return np.full(step.scene.capacity, np.nan) if step.evidence is None else step.evidence.confidence


def recognised_shapes(step: RecordedStep) -> tuple[Shape, ...]:
    """The recognised objects of a step whose true ones nobody knows."""
    return tuple(_shape(step, i, None) for i in range(step.scene.capacity) if step.scene.valid[i])


def _in_words(action: Action, step: RecordedStep) -> str:
    return kind_of(int(action.kind)).describe(action, step.scene.capacity)


def _same(action: Action, other: Action) -> bool:
    """Whether two actions are the same motion."""
    names = ("T_world_gripper", "T_world_place", "displacement", "q7")
    return int(action.kind) == int(other.kind) and all(
        np.allclose(getattr(action, name), getattr(other, name), atol=1e-6) for name in names
    )


def _candidates(step: RecordedStep) -> tuple[Candidate, ...]:
    """The chosen action, the next best, and the best that moves another object; none where none were compared.

    Of a policy that compares no costs the chosen one alone.
    """
    if step.action is None or not kind_of(int(step.action.kind)).moves_object:
        return ()
    every = range(len(step.sampled))
    chosen = [k for k in every if _same(step.action, step.sampled.single(k))][:1]
    compared = every if _compares(step) else ()
    others = [k for k in compared if k not in chosen][:1]
    elsewhere = [k for k in compared if step.sampled.action.object[k] != step.action.object][:1]
    roles = {"chosen": chosen, "next best": others, "best of another object": [k for k in elsewhere if k not in others]}
    return tuple(_candidate(step, role, k) for role, rows in roles.items() for k in rows)


def _compares(step: RecordedStep) -> bool:
    """Whether the policy compares costs: those of one that does not are all 0."""
    return bool(step.sampled.value.any() or step.sampled.cost.any())


def _candidate(step: RecordedStep, role: str, k: int) -> Candidate:
    forecasts = None if step.evidence is None or step.found else step.evidence.forecasts
    row = None if forecasts is None else forecasts.of(k)
    poses = good = None
    if forecasts is not None and row is not None:
        exists, g = forecasts.existence[row], forecasts.graspability[row]
        poses, good = int(exists.sum()), int((exists & (g == 1)).sum())
    value, cost = (float(a[k]) if _compares(step) else None for a in (step.sampled.value, step.sampled.cost))
    return Candidate(role, _in_words(step.sampled.single(k), step), value, cost, poses, good)


def _trials(step: RecordedStep) -> tuple[Trial, ...]:
    """What was tried out, in order; trials that read the same stand where the first of them does."""
    if step.evidence is None:
        return ()
    tried, rows = step.evidence.tried, []
    for k, code in enumerate(tried.result.tolist()):
        action = jax.tree.map(lambda a, k=k: a[k], tried.action)
        colour, result = RESULTS[TrialResult(code)]
        chosen = step.action is not None and _same(step.action, action)
        rows.append(Trial(_in_words(action, step), 1, result, colour, chosen))
    return tuple(row._replace(count=rows.count(row)) for row in dict.fromkeys(rows))


def _sees(recording: Recording) -> bool:
    return recording.episode is not None and recording.episode.config.get("recognition") in SEEING


def _shapes(recording: Recording, step: RecordedStep) -> tuple[Shape, ...]:
    """The recognised objects beside the true ones; empty where the true shapes were given."""
    if not _sees(recording):
        return ()
    snapshot = Snapshot(recording.camera, recording.shelf, jax.tree.map(jnp.asarray, step.world))
    truth = jax.tree.map(np.asarray, objects_on_the_board(snapshot))
    rows = []
    for i in range(step.scene.capacity):
        if step.scene.valid[i]:
            off = float(np.linalg.norm(np.asarray(step.scene.position[i]) - truth.position[i]))
            rows.append(_shape(step, i, off if truth.valid[i] else None))
        elif truth.valid[i]:
            shows = np.count_nonzero(np.asarray(snapshot.image.segmentation) == i) > FEWEST_PIXELS
            rows.append(Shape(i, "not recognised" if shows else "hidden", None, None))
    return tuple(rows)


def _shape(step: RecordedStep, i: int, off: float | None) -> Shape:
    x, y, z = (200 * float(half) for half in step.scene.size[i])
    round_ = float(step.scene.exponents[i, 1]) > 0.5
    words = f"cylinder, {x:.0f} cm wide, {z:.0f} cm long" if round_ else f"box, {x:.0f} × {y:.0f} × {z:.0f} cm"
    sure = float(confidence(step)[i])
    return Shape(i, words, sure if np.isfinite(sure) else None, off)


def _unexplained(recording: Recording, step: RecordedStep) -> float:
    """The share of what stands on the board, in an image without noise, that lies on no recognised shape."""
    depth = Snapshot(recording.camera, recording.shelf, jax.tree.map(jnp.asarray, step.world)).image.depth
    seen = Observation(step.scene, jnp.array(step.found), jnp.asarray(step.target_pose))
    return recognition_doubt(recording, seen, np.asarray(depth)).unexplained


def _moved(recording: Recording, i: int) -> tuple[str, ...]:
    """The bodies that a step moved or tilted, the target too unless it was taken out."""
    step = recording.steps[i]
    if step.action is None:
        return ()
    before, after = step.world, recording.steps[i + 1].world if i + 1 < len(recording.steps) else last_world(step)
    shift = np.linalg.norm(np.asarray(after.position) - np.asarray(before.position), axis=-1)
    upward = (np.asarray(before.rotation)[..., 2] * np.asarray(after.rotation)[..., 2]).sum(axis=-1)
    tilt = np.arccos(np.clip(upward, -1.0, 1.0))
    words = []
    for k in np.flatnonzero(np.asarray(before.valid) & ((shift > DISPLACED) | (tilt > TILTED))).tolist():
        if k == TARGET and kind_of(int(step.action.kind)).takes_target:
            continue
        tilted = f", tilted by {np.rad2deg(tilt[k]):.0f}°" if tilt[k] > TILTED else ""
        words.append(f"{'the target' if k == TARGET else f'object {k}'} by {100 * shift[k]:.1f} cm{tilted}")
    return tuple(words)


def _outcome(recording: Recording, i: int, record: Step | None) -> str:
    """What came of a step's action; empty where there was none, or that is not recorded."""
    step, last = recording.steps[i], i + 1 == len(recording.steps)
    if record is None or step.action is None:
        return ""
    if record.failure:
        return in_words(record.failure)
    took = last and recording.episode is not None and recording.episode.retrieved
    came = not last and recording.steps[i + 1].found and not step.found
    return "the target was taken out" if took else "carried out" + (", and the target came into view" if came else "")


def _warnings(recording: Recording, i: int, record: Step | None) -> tuple[str, ...]:
    """What is wrong with the belief of a step, or went wrong beside what its action came to."""
    step = recording.steps[i]
    lines = [trouble(recording, step) or "", "something else is taken for the target" if mistaken(step) else ""]
    if record is not None:
        restarts = recording.episode.steps[i - 1].restarts if i and recording.episode is not None else 0
        lines += [
            "f had become empty, and was started anew" if record.restarts > restarts else "",
            "the true pose is not in f" if record.truth_possible is False else "",
            "the action sweeps space of which nothing was measured" if record.blind else "",
            "the arm was held up" if record.held_up else "",
            *events(record),
        ]
    return tuple(line for line in lines if line)
