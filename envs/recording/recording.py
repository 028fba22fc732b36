"""The recording of an episode, `recording.npz`: motion, belief and decision of every step.

It is enough to show the episode again without simulating, recognising or planning. Images are not stored: they are
ray-cast from the true poses.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any, Protocol

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mechsearch_jax.actions import Action, no_action
from mechsearch_jax.envs.episode.moments import Moment
from mechsearch_jax.envs.episode.records import Episode, episode_of
from mechsearch_jax.envs.recording.evidence import Evidence, evidence
from mechsearch_jax.envs.recording.evidence import packed as packed_evidence
from mechsearch_jax.envs.recording.evidence import unpacked as unpacked_evidence
from mechsearch_jax.envs.recording.sampled import Sampled, nothing_sampled, packed, sampled, unpacked
from mechsearch_jax.envs.simulators.simulator import ARM
from mechsearch_jax.envs.simulators.trace import Trace
from mechsearch_jax.envs.world.world import BODIES, World, with_target
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.bodies import PARTS
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner import Problem
from mechsearch_jax.runtime.arrays import read_arrays
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, read_bytes, replacing
from mechsearch_jax.shapes import in_order
from mechsearch_jax.shapes.compound import COMPOUND, Compound, Piece
from mechsearch_jax.viz.filmstrip import Frame
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import MAX_OBJECTS
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

NAME = "recording.npz"
FORMAT, VERSION = "mechsearch recording", 1
# Larger files are refused [bytes]; ten actions take about half a megabyte.
LIMIT = 64 * 2**20
# A simulator records every tenth time step: 25 rows a second.
TRACE_EVERY = 10

# Contents of a file: the problem's settings and each step's texts as JSON, each step's arrays, and its trees of arrays.
_SETTINGS: dict[str, type] = {"camera": Camera, "shelf": Shelf, "target": Target}
_TEXTS = ("title", "caption", "found")
_ARRAYS = ("existence", "graspability", "target_pose")
_NOT_ARRAYS = ("parts", "compounds", "target")
_TREES: dict[str, type] = {"world": World, "scene": Superquadrics, "after": Superquadrics, "action": Action}
# Those whose bodies may have parts.
_WITH_PARTS = ("scene", "after")


@dataclasses.dataclass(frozen=True, eq=False)
class RecordedStep:
    """One step; arrays are NumPy's, single steps' fields without leading axes.

    Attributes:
      title, caption, found: as in `Frame`.
      world: the true state when the robot looked.
      scene, after: the recognised objects, and the objects predicted after the action.
      existence, graspability: f and g at the candidate poses.
      target_pose: x, y [m] and yaw [rad] of the true target.
      action: the decision; None if there was none.
      trace: the motion; without rows if nothing moved.
      sampled: the actions that the decision chose from; empty if not recorded.
      evidence: what lies behind the decision; None if not recorded.
    """

    title: str
    caption: str
    found: bool
    world: World
    scene: Superquadrics
    after: Superquadrics
    existence: Bool[np.ndarray, " x"]
    graspability: Int[np.ndarray, " x"]
    target_pose: Float[np.ndarray, " 3"]
    action: Action | None
    trace: Trace
    sampled: Sampled = dataclasses.field(default_factory=nothing_sampled)
    evidence: Evidence | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """A whole episode.

    Attributes:
      heading: how it ended, in one sentence.
      camera, shelf, target: of the problem.
      steps: in their order, at least one.
      episode: its record, `episode.json`; None if not recorded.
    """

    heading: str
    camera: Camera
    shelf: Shelf
    target: Target
    steps: tuple[RecordedStep, ...]
    episode: Episode | None = None


class Traced(Protocol):
    """A simulator with traces of the last action in each world, such as `NativeSimulator`."""

    @property
    def traces(self) -> Sequence[Trace]: ...


class Recorder:
    """Collects the steps of an episode that runs alone."""

    def __init__(self, simulator: Traced, problem: Problem | None = None):
        """Args:
        simulator: of the episode.
        problem: of the episode, for the evidence of decisions; without it there is none.
        """
        self._simulator, self._problem = simulator, problem
        self._steps: list[RecordedStep] = []

    def note(self, moment: Moment, frame: Frame) -> None:
        """Record a finished step.

        Args:
          moment: of the step.
          frame: its picture.
        """
        acted = moment.outcome is not None
        chosen_from = nothing_sampled()
        if acted and moment.decision is not None:
            chosen_from = sampled(moment.decision.sequences)
        assert frame.target_pose is not None
        self._steps.append(
            RecordedStep(
                title=frame.title,
                caption=frame.caption,
                found=frame.found,
                world=jax.tree.map(np.asarray, moment.snapshot.world),
                scene=frame.scene,
                after=frame.after,
                existence=frame.existence,
                graspability=frame.graspability,
                target_pose=frame.target_pose,
                action=jax.tree.map(np.asarray, moment.decision.action) if acted and moment.decision else None,
                trace=self._simulator.traces[0] if acted else empty_trace(),
                sampled=chosen_from,
                evidence=None if self._problem is None else evidence(moment, self._problem),
            )
        )

    def recording(self, problem: Problem, heading: str, episode: Episode | None = None) -> Recording:
        """The recorded steps as a `Recording`, with the record of the episode if it is given."""
        return Recording(heading, problem.camera, problem.shelf, problem.target, tuple(self._steps), episode)


def empty_trace() -> Trace:
    """A trace without rows."""
    rows = (np.zeros((0, *shape)) for shape in ((), (ARM,), (2,), (BODIES, 3), (BODIES, 4)))
    return Trace(*rows)


def save_recording(recording: Recording, path: PathLike) -> None:
    """Write a recording as a compressed npz file (docs/method.md, "Files").

    Raises:
      InputError: the file cannot be written.
    """
    steps = recording.steps
    head = {
        "format": FORMAT,
        "version": VERSION,
        "heading": recording.heading,
        **{name: _written(getattr(recording, name)) for name in _SETTINGS},
        "steps": [{name: getattr(step, name) for name in _TEXTS} for step in steps],
    }
    if recording.episode is not None:
        head["episode"] = dataclasses.asdict(recording.episode)
    arrays: dict[str, np.ndarray] = {"rows": np.array([len(step.trace.time) for step in steps])}
    arrays["acts"] = np.array([step.action is not None for step in steps])
    for name in _fields(Trace):
        parts = [np.asarray(getattr(step.trace, name), np.float32) for step in steps]
        arrays[f"trace.{name}"] = np.concatenate(parts)
    for name, kind in _TREES.items():
        trees = [getattr(step, name) or jax.device_get(no_action()) for step in steps]
        for field in _fields(kind):
            arrays[f"{name}.{field}"] = np.stack([np.asarray(getattr(tree, field)) for tree in trees])
    for name in _WITH_PARTS:
        parts = [getattr(step, name).parts for step in steps]
        if parts[0] is not None:
            for field in _fields(Superquadrics):
                arrays[f"{name}.parts.{field}"] = np.stack([np.asarray(getattr(each, field)) for each in parts])
    arrays |= {name: np.stack([np.asarray(getattr(step, name)) for step in steps]) for name in _ARRAYS}
    arrays |= packed([step.sampled for step in steps])
    arrays |= packed_evidence([step.evidence for step in steps], arrays["existence"].shape[1])
    with replacing(path) as file:
        np.savez_compressed(file, allow_pickle=False, head=np.array(json.dumps(head)), **arrays)


def load_recording(path: PathLike) -> Recording:
    """Read what `save_recording` wrote.

    Raises:
      InputError: the file cannot be read or holds something else.
    """
    arrays = read_arrays(read_bytes(path, LIMIT), path)
    try:
        head = json.loads(str(arrays["head"]))
        if (head["format"], head["version"]) != (FORMAT, VERSION):
            raise ValueError("of another kind or version")
        texts, count = head["steps"], len(head["steps"])
        settings = {name: kind(**_read(head[name])) for name, kind in _SETTINGS.items()}
        poses = len(settings["target"].candidate_poses(settings["shelf"]))
        _check(arrays, count, poses)
        ends = np.cumsum(arrays["rows"])
        more = zip(unpacked(arrays, count), unpacked_evidence(arrays, count, poses), strict=True)
        steps = [
            dataclasses.replace(
                _step(arrays, texts[i], i, slice(ends[i] - arrays["rows"][i], ends[i]), settings["target"]),
                sampled=chosen_from,
                evidence=e,
            )
            for i, (chosen_from, e) in enumerate(more)
        ]
        episode = episode_of(head["episode"]) if head.get("episode") is not None else None
        if episode is not None and len(episode.steps) != count:
            raise ValueError("its record has another number of steps")
        return Recording(str(head["heading"]), **settings, steps=tuple(steps), episode=episode)
    except (KeyError, ValueError, TypeError, AttributeError, IndexError) as error:
        raise InputError(f"{path}: is no recording of an episode ({' '.join(str(error).split())})") from error


def _check(arrays: dict[str, np.ndarray], count: int, poses: int) -> None:
    """Raise ValueError unless the arrays are those of `count` steps and `poses` candidate poses."""
    nothing = superquadric.empty(MAX_OBJECTS)
    trees = {"world": _no_world(), "scene": nothing, "after": nothing, "action": no_action()}
    examples = {
        f"{name}.{f}": np.asarray(getattr(tree, f)) for name, tree in trees.items() for f in _fields(type(tree))
    }
    for name in _WITH_PARTS:
        if f"{name}.parts.size" in arrays:
            parts = superquadric.empty(MAX_OBJECTS, min(arrays[f"{name}.parts.size"].shape[2], PARTS)).parts
            examples |= {f"{name}.parts.{f}": np.asarray(getattr(parts, f)) for f in _fields(Superquadrics)}
    examples |= {"rows": np.array(0), "acts": np.array(True), "target_pose": np.zeros(3)}
    examples |= {"existence": np.zeros(poses, bool), "graspability": np.zeros(poses, int)}
    if not count or any(arrays[name].shape != (count, *example.shape) for name, example in examples.items()):
        raise ValueError("steps are missing, or their arrays are of other shapes")
    still = empty_trace()
    traces = {f"trace.{name}": getattr(still, name) for name in _fields(Trace)}
    examples |= traces
    if any(arrays[name].dtype.kind != example.dtype.kind for name, example in examples.items()):
        raise ValueError("an array is of another type")
    rows = int(arrays["rows"].sum())
    if arrays["rows"].min() < 0 or any(arrays[name].shape != (rows, *a.shape[1:]) for name, a in traces.items()):
        raise ValueError("rows are missing")
    if not all(np.isfinite(arrays[name]).all() for name in examples):
        raise ValueError("there are numbers that are not finite")
    kinds = arrays["world.kind"]
    if kinds.min() < 0 or kinds.max() >= len(in_order()) or not (arrays["world.half_size"] > 0).all():
        raise ValueError("a body is of no shape")


def _no_world() -> World:
    vectors = np.zeros((BODIES, 3), np.float32)
    rotations, present = np.zeros((BODIES, 3, 3), np.float32), np.zeros(BODIES, bool)
    return World(np.zeros(BODIES, np.int32), vectors, vectors, rotations, present)  # pyright: ignore[reportArgumentType]


def _step(arrays: dict[str, np.ndarray], texts: dict[str, Any], i: int, rows: slice, target: Target) -> RecordedStep:
    trees = {name: kind(*(arrays[f"{name}.{f}"][i] for f in _fields(kind))) for name, kind in _TREES.items()}
    trees["world"] = jax.tree.map(np.asarray, with_target(trees["world"], target))
    trees["action"] = trees["action"] if arrays["acts"][i] else None
    for name in _WITH_PARTS:
        if f"{name}.parts.size" in arrays:
            parts = (arrays[f"{name}.parts.{f}"][i] for f in _fields(Superquadrics))
            trees[name] = trees[name].replace(parts=Superquadrics(*parts))  # pyright: ignore[reportArgumentType]
    trace = Trace(*(arrays[f"trace.{name}"][rows] for name in _fields(Trace)))
    return RecordedStep(**{n: texts[n] for n in _TEXTS}, **{n: arrays[n][i] for n in _ARRAYS}, **trees, trace=trace)


def _fields(kind: type) -> tuple[str, ...]:
    """The names of the arrays of a pytree; parts of bodies are kept beside them, and what they are made of is not."""
    return tuple(field.name for field in dataclasses.fields(kind) if field.name not in _NOT_ARRAYS)


def _written(setting: Any) -> dict[str, Any]:
    """The fields of a setting; what a target is made of only where it is a compound."""
    value = dataclasses.asdict(setting)
    return {name: field for name, field in value.items() if name != COMPOUND or field is not None}


def _read(value: dict[str, Any]) -> dict[str, Any]:
    """The fields of a setting, from `_written`."""
    fields = _tuples(value)
    if COMPOUND in fields:
        made = dict(fields[COMPOUND])
        fields[COMPOUND] = Compound(tuple(Piece(**piece) for piece in made.pop("pieces")), **made)
    return fields


def _tuples(value: Any) -> Any:
    """JSON's lists as tuples, also within a dictionary."""
    if isinstance(value, dict):
        return {name: _tuples(item) for name, item in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
