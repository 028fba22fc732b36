"""Tables with one row per episode, as Parquet files."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow
import pyarrow.parquet

from mechsearch_jax.envs.records import EARLIER
from mechsearch_jax.errors import InputError
from mechsearch_jax.files import PathLike, replacing


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
