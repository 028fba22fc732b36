"""Tables with one row per episode, as Parquet files."""

from __future__ import annotations

import dataclasses
import json
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_args, get_type_hints

import pyarrow
import pyarrow.parquet

from mechsearch_jax.envs.earlier import RENAMED, present_options
from mechsearch_jax.envs.records import Episode, Step
from mechsearch_jax.errors import InputError
from mechsearch_jax.files import PathLike, replacing
from mechsearch_jax.workspace.scenario import Scenario

# The stages of a step that the robot spends thinking; simulation is another.
PLANNING = ("recognise", "believe", "grasp", "plan", "judge")
# Options that have a column of their own.
OPTIONS = ("target", "policy", "recognition", "gamma", "horizon", "sequences", "actions")
# What happened on the way.
EVENTS = (
    *("looks", "truth_lost", "truth_lost_step", "restarts"),
    *("objects_fallen", "fallen_step", "held_up", "unsettled"),
)
# Between kinds of action in their column.
ACTIONS_BETWEEN = "+"
# Where the table's metadata say what ran the episodes.
_CODE = b"mechsearch_code"


@dataclasses.dataclass(frozen=True)
class Row:
    """One episode in a table of results; its fields are the table's columns.

    Attributes:
      scenario: its name.
      objects: number of surrounding objects.
      target: name of its shape.
      policy, recognition, gamma, horizon, sequences, actions, seed: the options it ran with; the kinds of action are
        joined by "+".
      found_step, graspable_step, retrieved, failure: as in `Episode`.
      steps: number of actions, attempts to take the target out among them.
      planning_seconds, simulation_seconds: wall time in total [s].
      configuration: everything that decides about the episode beside its scenario and its seed, as `configuration`
        writes it; None in files of version 0.1.0, which do not say.
      content_hash: of the scenario, as in `Episode`; None in files of earlier versions, which do not say.
      looks: number of steps at which the target was not found and stood on the board.
      truth_lost: at how many of them f ruled out the candidate pose nearest to the target's true pose.
      truth_lost_step: number of actions before the first of these; None where there was none.
      restarts: how often f was started anew.
      objects_fallen: number of objects that left the board.
      fallen_step: number of actions after which the first of them was off it; None where none fell.
      held_up: number of actions in which the arm was held up.
      unsettled: number of actions after which something never came to rest.
      paper_graspable: whether the target could be grasped with the paper's grasps alone at some step; None in files of
        earlier versions, which do not say.
      paper_graspable_step: as in `Episode`.

    From `looks` to `unsettled` they are None where that is not known: in files of earlier versions, and of an episode
    that could not be run to its end.
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
    configuration: str | None = None
    content_hash: str | None = None
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

    @classmethod
    def of_episode(cls, episode: Episode) -> Row:
        """The row of an episode that ran to its end."""
        spent = [{"simulate": 0.0, **step.timings} for step in episode.steps]
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
            paper_graspable=_paper_graspable(episode.steps),
            paper_graspable_step=episode.paper_graspable_step,
        )

    @classmethod
    def failed(cls, scenario: Scenario, options: Mapping[str, Any], reason: str) -> Row:
        """The row of an episode that could not be run to its end; `options` are as in `Episode.config`."""
        return cls(
            scenario=scenario.name,
            objects=len(scenario.objects),
            **_option_columns(options),
            found_step=None,
            graspable_step=None,
            retrieved=False,
            steps=0,
            failure=f"error: {reason}",
            planning_seconds=0.0,
            simulation_seconds=0.0,
            content_hash=scenario.content_hash,
            paper_graspable=False,
        )


def _event_columns(steps: Sequence[Step]) -> dict[str, Any]:
    """The columns `EVENTS`; all None where there are no steps, or they do not say, as those of earlier versions."""
    if not steps or any(step.restarts is None for step in steps):
        return dict.fromkeys(EVENTS)
    lost = [i for i, step in enumerate(steps) if step.truth_possible is False]
    fell = [i + 1 for i, step in enumerate(steps) if step.fallen]
    return {
        "looks": sum(step.truth_possible is not None for step in steps),
        "truth_lost": len(lost),
        "truth_lost_step": min(lost, default=None),
        "restarts": max((step.restarts or 0 for step in steps), default=0),
        "objects_fallen": sum(len(step.fallen or ()) for step in steps),
        "fallen_step": min(fell, default=None),
        "held_up": sum(bool(step.held_up) for step in steps),
        "unsettled": sum(step.at_rest is False for step in steps),
    }


def _paper_graspable(steps: Sequence[Step]) -> bool | None:
    """Whether the paper's grasps would have done at some step; None where steps do not say, as in earlier versions."""
    said = [step.paper_graspable for step in steps]
    return None if None in said else any(said)


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
    """The type of a column, from that of a field, which may also be None."""
    plain = [part for part in get_args(kind) if part is not types.NoneType]
    return _ARROW[plain[0] if plain else kind]


SCHEMA = pyarrow.schema([(name, _column(kind)) for name, kind in get_type_hints(Row).items()])
# The last column before rows told of the paper's grasps, before that of what happened on the way, before that of what
# their scenario holds, and before that of the configuration.
_EARLIER_COLUMNS = tuple(
    SCHEMA.names[: SCHEMA.names.index(last) + 1]
    for last in ("unsettled", "content_hash", "configuration", "simulation_seconds")
)


def configuration(options: Mapping[str, Any]) -> str:
    """An episode's options, as `Episode.config` holds them, in one text that is the same for the same options.

    The target and the seed have columns of their own and are left out.
    """
    kept = {name: value for name, value in options.items() if name not in ("target", "seed")}
    return json.dumps(kept, sort_keys=True, allow_nan=False)


def identity(row: Row) -> tuple[Any, ...]:
    """What tells the rows of a table apart: the scenario, by its name and content, every option and the seed.

    A row that does not say what its scenario held is apart from all that do.
    """
    known = None if row.configuration is None else configuration(present_options(json.loads(row.configuration)))
    return row.scenario, row.content_hash, *(getattr(row, name) for name in OPTIONS), row.seed, known


def _options(row: Row) -> dict[str, Any]:
    """Every option of a row that is known."""
    known = {name: getattr(row, name) for name in OPTIONS}
    actions = row.actions.split(ACTIONS_BETWEEN)
    return {**present_options(json.loads(row.configuration or "{}")), **known, "actions": actions}


def label_variants(rows: Sequence[Row]) -> list[str]:
    """For each row the policy and those options that are not the same in all rows: "search-for-grasp, gamma 0.5".

    Rows that ran under different options never share a label.
    """
    each = [_options(row) for row in rows]
    names = sorted({name for options in each for name in options} - {"policy"})
    differing = [name for name in names if len({json.dumps(options.get(name)) for options in each}) > 1]

    def said(options: dict[str, Any], name: str) -> str:
        value = options.get(name, "unknown")
        values = value if isinstance(value, list) else [value]
        shown = "/".join(f"{v:g}" if isinstance(v, float) else str(v) for v in values)
        return f"{name.replace('_', ' ')} {shown}"

    return [", ".join([str(o["policy"]), *(said(o, name) for name in differing)]) for o in each]


def _parquet(path: PathLike, read: Callable[[PathLike], Any]) -> Any:
    """What `read` makes of a file.

    Raises:
      InputError: the file cannot be read or is none of Parquet.
    """
    try:
        return read(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or ' '.join(str(error).split())})") from error
    except pyarrow.ArrowException as error:
        raise InputError(f"{path}: is not a Parquet file ({' '.join(str(error).split())})") from error


def read_rows(path: PathLike) -> list[Row]:
    """Rows of a Parquet file that `write_rows` wrote, today's or an earlier one, by the present names of options.

    Raises:
      InputError: the file cannot be read or is a table of something else.
    """
    table = _parquet(path, pyarrow.parquet.read_table)
    table = table.rename_columns([RENAMED.get(name, name) for name in table.schema.names])
    if table.schema.names not in (SCHEMA.names, *_EARLIER_COLUMNS):
        raise InputError(f"{path}: is a table of something else, not of episodes; use another file")
    return [_with_present_options(Row(**row), path) for row in table.to_pylist()]


def _with_present_options(row: Row, path: PathLike) -> Row:
    """The row with its options as they are said today."""
    kinds = present_options({"actions": row.actions})["actions"]
    row = dataclasses.replace(row, actions=kinds if isinstance(kinds, str) else ACTIONS_BETWEEN.join(kinds))
    if row.configuration is None:
        return row
    try:
        value = json.loads(row.configuration)
    except ValueError:
        value = None
    if not isinstance(value, dict):
        raise InputError(f"{path}: the configuration of {row.scenario!r} is not a JSON object; use another file")
    return dataclasses.replace(row, configuration=configuration(present_options(value)))


def read_code(path: PathLike) -> str | None:
    """What `write_rows` was told of the code that ran the episodes; None where it was told nothing.

    Raises:
      InputError: the file cannot be read.
    """
    code = (_parquet(path, pyarrow.parquet.read_schema).metadata or {}).get(_CODE)
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
