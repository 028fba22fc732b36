"""What a run leaves behind: the record of an episode, maps of f and g, and tables with one row per episode.

Every file is written beside its place and then moved there, so that a file is either whole or not there at all.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import math
import platform
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow
import pyarrow.parquet
from jaxtyping import Bool, Float, Int

from mechsearch_jax.actions import Action, ActionKind
from mechsearch_jax.errors import InputError
from mechsearch_jax.files import PathLike, replacing
from mechsearch_jax.superquadric import Superquadrics

ACTION_NAMES = {ActionKind.NONE: "none", ActionKind.PUSH: "push", ActionKind.PICK_AND_PLACE: "pick-and-place"}


def check_writable(folder: PathLike) -> None:
    """Fail before the work begins rather than after it, if files cannot be written into a folder.

    Raises:
      InputError: the folder does not exist and cannot be made, or nothing can be written into it.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: cannot be written to ({error.strerror or error})") from error


def versions() -> dict[str, str]:
    """The versions of what a result depends on, and the device that it was computed on."""
    packages = ("mechsearch-jax", "jax", "mujoco", "numpy")
    device = jax.devices()[0]
    return {
        **{name: importlib.metadata.version(name) for name in packages},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "device": f"{device.platform}: {device.device_kind}",
    }


@dataclasses.dataclass(frozen=True)
class ActionRecord:
    """An action as a file keeps it; fields as in `mechsearch_jax.actions.Action`.

    Attributes:
      kind: "push", "pick-and-place", "retrieve" or "none".
      object: index of the object in the scenario; None for a retrieval, which takes the target, and for "none".
      T_world_gripper, T_world_place: rows of the 4 x 4 poses [m].
      displacement: [m].
      q7: [rad].
      opening: [m].
    """

    kind: str
    object: int | None
    T_world_gripper: list[list[float]]
    displacement: list[float]
    T_world_place: list[list[float]]
    q7: float
    opening: float


def record_action(action: Action) -> ActionRecord:
    """A single action, as a file keeps it."""
    kind = ActionKind(int(action.kind))
    return ActionRecord(
        kind=ACTION_NAMES[kind],
        object=None if kind is ActionKind.NONE else int(action.object),
        T_world_gripper=np.asarray(action.T_world_gripper).tolist(),
        displacement=np.asarray(action.displacement).tolist(),
        T_world_place=np.asarray(action.T_world_place).tolist(),
        q7=float(action.q7),
        opening=float(action.opening),
    )


@dataclasses.dataclass(frozen=True)
class Step:
    """What was known at one step of an episode, what was done, and what came of it.

    Attributes:
      belief_size: number of candidate poses where the target can still be.
      found: whether the target has been found.
      graspable: whether it has been found and a collision-free grasp of it exists in the true state.
      cost: J of the observed state; None where nothing was planned.
      action: what the robot did; None if the episode ended here.
      predicted_cost: J that the plan expects right after the action; None where nothing was planned.
      observed_cost: J at the next observation; None if there was none.
      sequences: number of valid action sequences that the plan was chosen from.
      failure: why the action could not be carried out as planned; None if it was.
      timings: wall time of each stage [s].
    """

    belief_size: int
    found: bool
    graspable: bool
    cost: float | None
    action: ActionRecord | None
    predicted_cost: float | None
    observed_cost: float | None
    sequences: int
    failure: str | None
    timings: dict[str, float]


@dataclasses.dataclass(frozen=True)
class Episode:
    """A whole episode, from the first look to the retrieval or to giving up.

    Attributes:
      scenario: name of the scenario.
      objects: number of surrounding objects.
      config: the planner's and the episode's options.
      versions: as `versions` returns them.
      steps: one for each observation.
      found_step: number of actions before the target was found; None where it never was.
      graspable_step: number of actions before it could also be grasped; None where it never could.
      retrieved: whether the hand took the target out of the shelf and no object fell.
      failure: why the episode ended without a retrieval; None after one.
    """

    scenario: str
    objects: int
    config: dict[str, Any]
    versions: dict[str, str]
    steps: tuple[Step, ...]
    found_step: int | None
    graspable_step: int | None
    retrieved: bool
    failure: str | None


def save_episode(episode: Episode, path: PathLike) -> None:
    """Write `episode.json`.

    Raises:
      InputError: the file cannot be written.
    """
    text = json.dumps(dataclasses.asdict(episode), indent=1, allow_nan=False) + "\n"
    with replacing(path) as file:
        file.write(text.encode())


def load_episode(path: PathLike) -> Episode:
    """Read `episode.json`; options that it does not know yet have the values of `EARLIER`.

    Raises:
      InputError: the file cannot be read or is not the record of an episode.
    """
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON ({' '.join(str(error).split())})") from error
    try:
        steps = tuple(
            Step(**{**step, "action": None if step["action"] is None else ActionRecord(**step["action"])})
            for step in value["steps"]
        )
        return Episode(**{**value, "steps": steps, "config": {**EARLIER, **value["config"]}})
    except (TypeError, KeyError) as error:
        raise InputError(f"{path}: is not the record of an episode ({error})") from error


@dataclasses.dataclass(frozen=True)
class Maps:
    """f and g over all candidate poses, and the objects that they were computed from.

    Attributes:
      poses: x, y [m] and yaw [rad] of the candidate poses.
      existence: where the target can be.
      graspability: 1 where it could be grasped, else 1 minus the number of objects in the way.
      scene: the objects, as NumPy arrays.
    """

    poses: Float[np.ndarray, "x 3"]
    existence: Bool[np.ndarray, " x"]
    graspability: Int[np.ndarray, " x"]
    scene: Superquadrics


_SCENE_FIELDS = tuple(field.name for field in dataclasses.fields(Superquadrics))


def save_maps(maps: Maps, path: PathLike) -> None:
    """Write maps as a compressed npz file (DESIGN.md section 8).

    Raises:
      InputError: the file cannot be written.
    """
    arrays = {"poses": maps.poses, "existence": maps.existence, "graspability": maps.graspability}
    scene = {name: np.asarray(getattr(maps.scene, name)) for name in _SCENE_FIELDS}
    with replacing(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays, **scene)


def load_maps(path: PathLike) -> Maps:
    """Read what `save_maps` wrote.

    Raises:
      InputError: the file cannot be read or holds something else.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            scene = Superquadrics(**{name: file[name] for name in _SCENE_FIELDS})
            return Maps(file["poses"], file["existence"], file["graspability"], scene)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (KeyError, ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: holds no maps ({error})") from error


@dataclasses.dataclass(frozen=True)
class Row:
    """One episode in a table of results.

    Attributes:
      scenario: its name.
      objects: number of surrounding objects.
      target: "cylinder" or "box".
      method, recognition, gamma, horizon, sequences, actions, seed: the options it ran with.
      found_step, graspable_step, retrieved, failure: as in `Episode`.
      steps: number of actions, attempts to take the target out among them.
      planning_seconds, simulation_seconds: wall time in total [s].
      configuration: everything that decides about the episode beside its scenario and its seed, as `configuration`
        writes it; None in files of version 0.1.0, which do not say.
    """

    scenario: str
    objects: int
    target: str
    method: str
    recognition: str
    gamma: float
    horizon: int
    sequences: int
    actions: str
    seed: int
    found_step: int | None
    graspable_step: int | None
    retrieved: bool
    steps: int
    failure: str | None
    planning_seconds: float
    simulation_seconds: float
    configuration: str | None = None


SCHEMA = pyarrow.schema(
    [
        ("scenario", pyarrow.string()),
        ("objects", pyarrow.int64()),
        ("target", pyarrow.string()),
        ("method", pyarrow.string()),
        ("recognition", pyarrow.string()),
        ("gamma", pyarrow.float64()),
        ("horizon", pyarrow.int64()),
        ("sequences", pyarrow.int64()),
        ("actions", pyarrow.string()),
        ("seed", pyarrow.int64()),
        ("found_step", pyarrow.int64()),
        ("graspable_step", pyarrow.int64()),
        ("retrieved", pyarrow.bool_()),
        ("steps", pyarrow.int64()),
        ("failure", pyarrow.string()),
        ("planning_seconds", pyarrow.float64()),
        ("simulation_seconds", pyarrow.float64()),
        ("configuration", pyarrow.string()),
    ]
)

OPTIONS = ("target", "method", "recognition", "gamma", "horizon", "sequences", "actions")
# Where the table's metadata say what ran the episodes.
_CODE = b"mechsearch_code"
# What version 0.1.0 wrote.
_FIRST_COLUMNS = SCHEMA.names[:-1]


# What options that files of earlier versions do not hold were then.
EARLIER: Mapping[str, Any] = {"push_model": "quasi-static", "topple_charge": 0.0}


def configuration(options: Mapping[str, Any]) -> str:
    """An episode's options, as `Episode.config` holds them, in one text that is the same for the same options.

    The target and the seed have columns of their own and are left out.
    """
    kept = {name: value for name, value in options.items() if name not in ("target", "seed")}
    return json.dumps(kept, sort_keys=True, allow_nan=False)


def identity(row: Row) -> tuple[Any, ...]:
    """What tells the rows of a table apart: the scenario, every option and the seed."""
    known = None if row.configuration is None else configuration({**EARLIER, **json.loads(row.configuration)})
    return row.scenario, *(getattr(row, name) for name in OPTIONS), row.seed, known


def _options(row: Row) -> dict[str, Any]:
    """Every option of a row that is known."""
    known = {name: getattr(row, name) for name in OPTIONS}
    return {**EARLIER, **json.loads(row.configuration or "{}"), **known}


def label_variants(rows: Sequence[Row]) -> list[str]:
    """For each row the method and those options that are not the same in all rows: "search-for-grasp, gamma 0.5".

    Rows that ran under different options never share a label.
    """
    each = [_options(row) for row in rows]
    names = sorted({name for options in each for name in options} - {"method"})
    differing = [name for name in names if len({json.dumps(options.get(name)) for options in each}) > 1]

    def said(options: dict[str, Any], name: str) -> str:
        value = options.get(name, "unknown")
        shown = "/".join(f"{v:g}" for v in value) if isinstance(value, list) else value
        return f"{name.replace('_', ' ')} {shown}"

    return [", ".join([str(o["method"]), *(said(o, name) for name in differing)]) for o in each]


def read_rows(path: PathLike) -> list[Row]:
    """Rows of a Parquet file that `write_rows` wrote.

    Raises:
      InputError: the file cannot be read or is a table of something else.
    """
    try:
        table = pyarrow.parquet.read_table(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or ' '.join(str(error).split())})") from error
    except pyarrow.ArrowException as error:
        raise InputError(f"{path}: is not a Parquet file ({' '.join(str(error).split())})") from error
    if table.schema.names not in (SCHEMA.names, _FIRST_COLUMNS):
        raise InputError(f"{path}: is a table of something else, not of episodes; use another file")
    rows = [Row(**row) for row in table.to_pylist()]
    for row in rows:
        _check_configuration(row, path)
    return rows


def _check_configuration(row: Row, path: PathLike) -> None:
    try:
        value = {} if row.configuration is None else json.loads(row.configuration)
    except ValueError:
        value = None
    if not isinstance(value, dict):
        raise InputError(f"{path}: the configuration of {row.scenario!r} is not a JSON object; use another file")


def read_code(path: PathLike) -> str | None:
    """What `write_rows` was told of the code that ran the episodes; None where it was told nothing.

    Raises:
      InputError: the file cannot be read.
    """
    try:
        metadata = pyarrow.parquet.read_schema(path).metadata or {}
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or ' '.join(str(error).split())})") from error
    except pyarrow.ArrowException as error:
        raise InputError(f"{path}: is not a Parquet file ({' '.join(str(error).split())})") from error
    code = metadata.get(_CODE)
    return None if code is None else code.decode(errors="replace")


def write_rows(rows: Sequence[Row], path: PathLike, code: str | None = None) -> None:
    """Write a table of episodes as Parquet, in place of the one that is there.

    Args:
      rows: the episodes.
      path: of the file.
      code: what ran them, which is kept beside them: see `read_code`.

    Raises:
      InputError: the file cannot be written.
    """
    schema = SCHEMA if code is None else SCHEMA.with_metadata({_CODE: code.encode()})
    table = pyarrow.Table.from_pylist([dataclasses.asdict(row) for row in rows], schema=schema)
    with replacing(path) as file:
        pyarrow.parquet.write_table(table, file)


@dataclasses.dataclass(frozen=True)
class Rates:
    """Shares of episodes, among those with a number of objects.

    Attributes:
      method: the planner's method, with the options that tell it from the others: see `label_variants`.
      objects: number of surrounding objects; None for all.
      episodes: how many episodes.
      errors: how many of them could not be run to their end; they count as failures.
      found, graspable, retrieved: shares of them.
      found_interval, graspable_interval, retrieved_interval: what the true shares may be: see `wilson`.
      steps: mean number of actions, attempts to take the target out among them.
      planning_seconds, simulation_seconds: mean wall time per action [s].
    """

    method: str
    objects: int | None
    episodes: int
    errors: int
    found: float
    graspable: float
    retrieved: float
    found_interval: tuple[float, float]
    graspable_interval: tuple[float, float]
    retrieved_interval: tuple[float, float]
    steps: float
    planning_seconds: float
    simulation_seconds: float


Z = 1.959964


def wilson(successes: int, count: int) -> tuple[float, float]:
    """Wilson's 95% confidence interval of a share: low and high; (0, 1) if nothing was counted."""
    if count == 0:
        return 0.0, 1.0
    share = successes / count
    middle = (share + Z**2 / (2 * count)) / (1 + Z**2 / count)
    half = Z / (1 + Z**2 / count) * math.sqrt(share * (1 - share) / count + Z**2 / (4 * count**2))
    low = 0.0 if successes == 0 else middle - half
    return low, 1.0 if successes == count else middle + half


def is_error(row: Row) -> bool:
    """Whether an episode ended because the program failed, not the robot."""
    return row.failure is not None and row.failure.startswith("error: ")


def summarise(rows: Sequence[Row]) -> list[Rates]:
    """Rates by method (and what else differs) and number of objects, and for each method over all of them."""
    summary = []
    labels = label_variants(rows)
    for method in sorted(set(labels)):
        of_method = [row for row, label in zip(rows, labels, strict=True) if label == method]
        for objects in [*sorted({row.objects for row in of_method}), None]:
            group = [row for row in of_method if objects is None or row.objects == objects]
            actions = max(sum(row.steps for row in group), 1)
            found = sum(row.found_step is not None for row in group)
            graspable = sum(row.graspable_step is not None for row in group)
            retrieved = sum(row.retrieved for row in group)
            summary.append(
                Rates(
                    method=method,
                    objects=objects,
                    episodes=len(group),
                    errors=sum(is_error(row) for row in group),
                    found=found / len(group),
                    graspable=graspable / len(group),
                    retrieved=retrieved / len(group),
                    found_interval=wilson(found, len(group)),
                    graspable_interval=wilson(graspable, len(group)),
                    retrieved_interval=wilson(retrieved, len(group)),
                    steps=sum(row.steps for row in group) / len(group),
                    planning_seconds=sum(row.planning_seconds for row in group) / actions,
                    simulation_seconds=sum(row.simulation_seconds for row in group) / actions,
                )
            )
    return summary
