"""Tables with one row per episode, as Parquet files."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import operator
import os
import types
from collections.abc import Mapping, Sequence, Sized
from typing import Any, Protocol, get_args, get_origin, get_type_hints

import pyarrow
import pyarrow.parquet

from mechsearch_jax.config.fixed import AS_IN_PAPER, renamed
from mechsearch_jax.envs.episode.records import Episode, Step
from mechsearch_jax.planner import OPTIONS as PLANNER_OPTIONS
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing
from mechsearch_jax.runtime.versions import DECISION_VERSION, DECISIONS

# The stages of a step that the robot spends thinking; simulation is another.
PLANNING = ("recognise", "believe", "grasp", "plan", "judge")
# Where a step's timings say how long it waited for compilations.
COMPILING = "compile"
# Options that are fields of a row; the others are in its `configuration`.
OPTIONS = ("target", "policy", "recognition", "gamma", "horizon", "sequences", "actions")
# Of an `episode_key`.
KEY_DIGITS = 32
# What happened on the way.
EVENTS = (
    *("looks", "truth_lost", "truth_lost_step", "restarts"),
    *("objects_fallen", "fallen_step", "held_up", "unsettled"),
    *("truth_ruled_out", "truth_ruled_out_step", "blind_actions"),
)
# Columns that tables of before do not have; they say nothing of it.
_LATER = frozenset(("truth_ruled_out", "truth_ruled_out_step", "blind_actions", "decision_version"))
# How the reason begins where the program failed, not the robot.
ERROR = "error: "
# Between kinds of action in their column.
ACTIONS_BETWEEN = "+"


class Scene(Protocol):
    """What a row says of the scenario of an episode that could not be run to its end."""

    @property
    def name(self) -> str:
        """Its name."""
        ...

    @property
    def content_hash(self) -> str:
        """Of what it holds."""
        ...

    @property
    def objects(self) -> Sized:
        """The surrounding objects."""
        ...


@dataclasses.dataclass(frozen=True)
class EpisodeRow:
    """One episode in a table of results; its fields are columns of the table, to which `write_rows` adds more.

    Attributes:
      scenario: its name.
      objects: number of surrounding objects.
      target: name of its shape.
      policy, recognition, gamma, horizon, sequences, actions, seed: the options it ran with; the kinds of action are
        joined by "+".
      found_step, graspable_step, retrieved, failure: as in `Episode`.
      steps: number of actions, attempts to take the target out among them.
      planning_seconds, simulation_seconds: wall time in total, without compilations [s].
      configuration: everything that decides about the episode beside its scenario and its seed, as `configuration`
        writes it.
      content_hash: of the scenario, as in `Episode`.
      looks: number of steps at which the target was not found and stood on the board.
      truth_lost: at how many of them f ruled out the candidate pose nearest to the target's true pose.
      truth_lost_step: number of actions before the first of these; None where there was none.
      restarts: how often f was started anew.
      objects_fallen: number of objects that left the board.
      fallen_step: number of actions after which the first of them was off it; None where none fell.
      held_up: number of actions in which the arm was held up.
      unsettled: number of actions after which something never came to rest.
      paper_graspable: whether the target could be grasped with the paper's grasps alone at some step; None where that
        is not known.
      paper_graspable_step: as in `Episode`.
      compile_seconds: wall time that its steps waited for compilations [s]; in a batch, its share of it.
      code: what ran it, as `evaluate.present_code` says it.
      device: that computed it, as `versions` says it.
      versions: of Python and the libraries, and the machine, as JSON.
      truth_ruled_out: at how many of the `looks` f ruled out every candidate pose of the true pose's cell and of the
        eight cells around it; None where that is not known.
      truth_ruled_out_step: number of actions before the first of these; None where there was none.
      blind_actions: number of actions that swept space of which nothing was measured.
      decision_version: the `DECISION_VERSION` of `runtime.versions` that it ran with; None in rows that are older.

    From `looks` to `unsettled`, `compile_seconds`, `device`, `versions` and the last two are None for an episode that
    could not be run to its end.
    """

    scenario: str
    objects: int
    target: str
    policy: str
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
    configuration: str = "{}"
    content_hash: str = ""
    looks: int | None = None
    truth_lost: int | None = None
    truth_lost_step: int | None = None
    restarts: int | None = None
    objects_fallen: int | None = None
    fallen_step: int | None = None
    held_up: int | None = None
    unsettled: int | None = None
    paper_graspable: bool | None = None
    paper_graspable_step: int | None = None
    compile_seconds: float | None = None
    code: str = ""
    device: str | None = None
    versions: str | None = None
    truth_ruled_out: int | None = None
    truth_ruled_out_step: int | None = None
    blind_actions: int | None = None
    decision_version: int | None = None

    @classmethod
    def of_episode(cls, episode: Episode, code: str = "") -> EpisodeRow:
        """The row of an episode that ran to its end, by the code that ran it."""
        spent = [{"simulate": 0.0, **step.timings} for step in episode.steps]
        libraries = {name: version for name, version in episode.versions.items() if name not in ("device", DECISIONS)}
        decisions = episode.versions.get(DECISIONS)
        return cls(
            scenario=episode.scenario,
            objects=episode.objects,
            **_option_columns(episode.config),
            found_step=episode.found_step,
            graspable_step=episode.graspable_step,
            retrieved=episode.retrieved,
            steps=sum(step.action is not None for step in episode.steps),
            failure=episode.failure,
            planning_seconds=sum(sum(timings.get(stage, 0.0) for timings in spent) for stage in PLANNING),
            simulation_seconds=sum(timings["simulate"] for timings in spent),
            content_hash=episode.content_hash,
            **_event_columns(episode.steps),
            paper_graspable=any(step.paper_graspable for step in episode.steps),
            paper_graspable_step=episode.paper_graspable_step,
            compile_seconds=sum(timings.get(COMPILING, 0.0) for timings in spent),
            code=code,
            device=episode.versions.get("device"),
            versions=json.dumps(libraries, sort_keys=True),
            decision_version=None if decisions is None else int(decisions),
        )

    @classmethod
    def failed(cls, scenario: Scene, options: Mapping[str, Any], reason: str, code: str = "") -> EpisodeRow:
        """The row of an episode that could not be run to its end; `options` are as in `Episode.config`."""
        return cls(
            scenario=scenario.name,
            objects=len(scenario.objects),
            **_option_columns(options),
            found_step=None,
            graspable_step=None,
            retrieved=False,
            steps=0,
            failure=f"{ERROR}{reason}",
            planning_seconds=0.0,
            simulation_seconds=0.0,
            content_hash=scenario.content_hash,
            paper_graspable=False,
            code=code,
            decision_version=DECISION_VERSION,
        )

    @property
    def is_error(self) -> bool:
        """Whether it ended because the program failed, not the robot."""
        return self.failure is not None and self.failure.startswith(ERROR)


def _event_columns(steps: Sequence[Step]) -> dict[str, Any]:
    """The columns `EVENTS`; all None where there are no steps."""
    if not steps:
        return dict.fromkeys(EVENTS)
    lost = [i for i, step in enumerate(steps) if step.truth_possible is False]
    ruled_out = [i for i, step in enumerate(steps) if step.around_possible is False]
    fell = [i + 1 for i, step in enumerate(steps) if step.fallen]
    return {
        "looks": sum(step.truth_possible is not None for step in steps),
        "truth_lost": len(lost),
        "truth_lost_step": min(lost, default=None),
        "restarts": max(step.restarts for step in steps),
        "objects_fallen": sum(len(step.fallen or ()) for step in steps),
        "fallen_step": min(fell, default=None),
        "held_up": sum(bool(step.held_up) for step in steps),
        "unsettled": sum(step.at_rest is False for step in steps),
        "truth_ruled_out": len(ruled_out),
        "truth_ruled_out_step": min(ruled_out, default=None),
        "blind_actions": sum(bool(step.blind) for step in steps),
    }


def _option_columns(options: Mapping[str, Any]) -> dict[str, Any]:
    """The columns that say how an episode ran, from its options as `Episode.config` holds them."""
    return {
        **{name: options[name] for name in OPTIONS},
        "actions": ACTIONS_BETWEEN.join(options["actions"]),
        "seed": options["seed"],
        "configuration": configuration(options),
    }


_ARROW = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64(), bool: pyarrow.bool_()}


def _column(kind: Any) -> pyarrow.DataType:
    """The type of a column, from that of a field or an option, which may also be None or a tuple."""
    if get_origin(kind) is tuple:
        return pyarrow.list_(_ARROW[get_args(kind)[0]])
    plain = [part for part in get_args(kind) if part is not types.NoneType]
    return _ARROW[plain[0] if plain else kind]


_FIELDS = {name: _column(kind) for name, kind in get_type_hints(EpisodeRow).items()}
# The same in rows of the same episode, whichever table they are in.
EPISODE = "episode"
# Columns for who reads the table with something else; a row has all of it in its other fields.
_MORE = {
    **{option.name: _column(option.type) for option in PLANNER_OPTIONS if option.name not in _FIELDS},
    AS_IN_PAPER: pyarrow.bool_(),
    "simulator": pyarrow.string(),
    EPISODE: pyarrow.string(),
}
SCHEMA = pyarrow.schema([*_FIELDS.items(), *_MORE.items()])


def configuration(options: Mapping[str, Any]) -> str:
    """An episode's options, as `Episode.config` holds them, in one text that is the same for the same options.

    The target and the seed have columns of their own and are left out.
    """
    kept = {name: value for name, value in options.items() if name not in ("target", "seed")}
    return json.dumps(kept, sort_keys=True, allow_nan=False)


@functools.lru_cache(maxsize=4096)
def _options(text: str) -> Mapping[str, Any]:
    """The options that a `EpisodeRow.configuration` holds, by the names that this version has.

    Raises:
      ValueError: it is not a JSON object.
    """
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError("not an object")
    return renamed(value)


@functools.lru_cache(maxsize=4096)
def _canonical(text: str) -> str:
    """A `EpisodeRow.configuration` as `configuration` writes it; the same object for the same options.

    Raises:
      ValueError: it is not a JSON object.
    """
    return configuration(_options(text))


_named = operator.attrgetter("scenario", "content_hash", *OPTIONS, "seed")


def identity(row: EpisodeRow) -> tuple[Any, ...]:
    """What tells the rows of a table apart: the scenario, by its name and content, every option and the seed."""
    return *_named(row), _canonical(row.configuration)


def episode_key(row: EpisodeRow) -> str:
    """`KEY_DIGITS` hexadecimal digits that are the same for rows of the same `identity`."""
    text = repr((*_named(row), _digest(_canonical(row.configuration))))
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_DIGITS]


@functools.lru_cache(maxsize=4096)
def _digest(text: str) -> str:
    """Of a `EpisodeRow.configuration`, which many rows share."""
    return hashlib.sha256(text.encode()).hexdigest()


def options_of(row: EpisodeRow) -> dict[str, Any]:
    """Every option of a row."""
    columns = {name: getattr(row, name) for name in OPTIONS}
    return {**_options(row.configuration), **columns, "actions": row.actions.split(ACTIONS_BETWEEN)}


def read_rows(path: PathLike) -> list[EpisodeRow]:
    """Rows of a Parquet file that `write_rows` wrote.

    Raises:
      InputError: the file cannot be read or is a table of something else.
    """
    try:
        # As a file of its own: the names of the folders that it is in say nothing of it.
        with open(path, "rb") as file, pyarrow.parquet.ParquetFile(file) as parquet:
            table = parquet.read()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or ' '.join(str(error).split())})") from error
    except pyarrow.ArrowException as error:
        raise InputError(f"{path}: is not a Parquet file ({' '.join(str(error).split())})") from error
    missing = _FIELDS.keys() - _LATER - set(table.schema.names)
    if missing:
        raise InputError(
            f"{path}: lacks the column {min(missing)}: it is no table of episodes of this version; use another file"
        )
    try:
        columns = table.select([name for name in _FIELDS if name in table.schema.names]).to_pydict()
        return [_row(dict(zip(columns, values, strict=True))) for values in zip(*columns.values(), strict=True)]
    except ValueError as error:
        raise InputError(f"{path}: {error}; use another file") from error


def parse_row(text: str | bytes) -> EpisodeRow:
    """A row from the JSON object of its fields.

    Raises:
      ValueError: it is none.
    """
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError("it is not a JSON object")
    missing = _FIELDS.keys() - _LATER - value.keys()
    if missing:
        raise ValueError(f"it lacks {min(missing)}")
    return _row({name: value[name] for name in _FIELDS if name in value})


def _row(fields: dict[str, Any]) -> EpisodeRow:
    """The row of these fields.

    Raises:
      ValueError: its configuration is not a JSON object.
    """
    try:
        fields["configuration"] = _canonical(fields["configuration"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"the configuration of {fields['scenario']!r} is not a JSON object") from error
    return EpisodeRow(**fields)


def write_rows(rows: Sequence[EpisodeRow], path: PathLike) -> None:
    """Write a table of episodes as Parquet, in place of the one that is there.

    Beside the fields of a row it has a column for every other option and for the simulator, and `episode`, which is
    `episode_key`: for who reads it with something else.

    Raises:
      InputError: the file cannot be written.
    """
    values = []
    for row in rows:
        options = _options(row.configuration)
        values.append({**vars(row), **{name: options.get(name) for name in _MORE}, EPISODE: episode_key(row)})
    table = pyarrow.Table.from_pylist(values, schema=SCHEMA)
    with replacing(path) as file:
        pyarrow.parquet.write_table(table, file)
        # What a row was kept in until now goes when this file is there.
        file.flush()
        os.fsync(file.fileno())
