"""Stored runs: all rows of a run as one small Parquet file, and beside it what comes of them as JSON lines.

`NAME.parquet` holds the fields of `EpisodeRow` alone, in few bytes: what can be computed from them is left out, and
times are rounded. `NAME.jsonl` has a line for each variant, scene set and number of objects; `lab.site.store_run` makes
it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow
import pyarrow.parquet

from mechsearch_jax.benchmarks.store.rows import SCHEMA, EpisodeRow, episode_key, options_of, read_rows
from mechsearch_jax.benchmarks.store.shards import PREFIX, result_tables
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing

# Where a checkout keeps them.
RUNS = Path("benchmarks/results/runs")
# Wall times, which two runs of the same episode never share, and to how many digits they are kept [s].
SECONDS = ("planning_seconds", "simulation_seconds", "compile_seconds")
DIGITS = 2
# What may differ in two rows of an episode that agree.
_INCIDENTAL = (*SECONDS, "device", "versions")
_FIELDS = pyarrow.schema([SCHEMA.field(field.name) for field in dataclasses.fields(EpisodeRow)])
_NAME = re.compile(r"[a-z0-9]+(?:[-.][a-z0-9]+)*")


@dataclasses.dataclass(frozen=True)
class StoredRun:
    """A run that is stored.

    Attributes:
      name: of its files.
      rows: all of them.
      lines: what comes of them, by variant, scene set and number of objects; see `lab.site.store_run`.
    """

    name: str
    rows: tuple[EpisodeRow, ...]
    lines: tuple[Mapping[str, Any], ...]


def variant_of(row: EpisodeRow) -> str:
    """Twelve hexadecimal digits that rows share which ran with the same options, whatever the target and the seed."""
    options = {name: value for name, value in options_of(row).items() if name != "target"}
    return hashlib.sha256(json.dumps(options, sort_keys=True).encode()).hexdigest()[:12]


def started(folders: Iterable[PathLike]) -> str | None:
    """The day on which the first shard of results folders was begun, as 2026-11-25; None where no shard names it."""
    pattern = re.compile(rf"{PREFIX}(\d{{4}})(\d\d)(\d\d)T\d{{6}}-")
    names = [path.name for folder in folders for path in sorted(Path(folder).rglob(f"{PREFIX}*"))]
    return min(("-".join(match.groups()) for name in names if (match := pattern.match(name))), default=None)


def merged(folders: Sequence[PathLike]) -> list[EpisodeRow]:
    """The rows of results folders that are parts of one run, one for each episode.

    An episode without an error goes before the same one with an error, as in a folder.

    Raises:
      InputError: a folder holds no results, they were run by different code, or two folders disagree about an episode.
    """
    rows: dict[str, tuple[EpisodeRow, Path]] = {}
    first: tuple[EpisodeRow, Path] | None = None
    for folder in folders:
        for place, table in result_tables(folder):
            for row in table:
                first = first or (row, place)
                if row.code != first[0].code:
                    raise InputError(
                        f"{place}: its episodes were run by {row.code or 'unknown code'}, those of {first[1]} by "
                        f"{first[0].code or 'unknown code'}; store them as two runs"
                    )
                key = episode_key(row)
                rows[key] = _agreed(rows[key], (row, place)) if key in rows else (row, place)
    return sorted((row for row, _ in rows.values()), key=lambda row: (row.configuration, row.scenario, row.seed))


def _agreed(before: tuple[EpisodeRow, Path], now: tuple[EpisodeRow, Path]) -> tuple[EpisodeRow, Path]:
    """Which of two rows of an episode counts.

    Raises:
      InputError: both ran to their end, and ended differently.
    """
    if before[0].is_error or now[0].is_error:
        return now if before[0].is_error else before
    ends = [{**vars(row), **dict.fromkeys(_INCIDENTAL)} for row, _ in (before, now)]
    differing = [name for name, value in ends[0].items() if ends[1][name] != value]
    if differing:
        raise InputError(
            f"{now[1]}: scenario {now[0].scenario!r}, seed {now[0].seed}, has another {differing[0]} than the same "
            f"episode in {before[1]}; store only one of them"
        )
    return before


def write_run(run: StoredRun, folder: PathLike) -> list[Path]:
    """Write `NAME.parquet` and `NAME.jsonl`, in place of what is there.

    Returns:
      The two files.

    Raises:
      InputError: the name is none for a file, or a file cannot be written.
    """
    if not _NAME.fullmatch(run.name):
        raise InputError(f"--name {run.name}: use small letters and digits, with - or . between, as table1-h100")
    table, lines = _files(folder, run.name)
    with replacing(table) as file:
        pyarrow.parquet.write_table(
            pyarrow.Table.from_pylist([vars(_rounded(row)) for row in run.rows], schema=_FIELDS),
            file,
            compression="zstd",
            compression_level=19,
            row_group_size=1 << 20,
        )
    with replacing(lines) as file:
        file.write("".join(json.dumps(line, allow_nan=False) + "\n" for line in run.lines).encode())
    return [table, lines]


def _rounded(row: EpisodeRow) -> EpisodeRow:
    times = {name: value for name in SECONDS if (value := getattr(row, name)) is not None}
    return dataclasses.replace(row, **{name: round(value, DIGITS) for name, value in times.items()})


def load_run(folder: PathLike, name: str) -> StoredRun:
    """A stored run.

    Raises:
      InputError: one of its files cannot be read, or the lines are of other rows.
    """
    table, file = _files(folder, name)
    rows = read_rows(table)
    try:
        lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
        counted = sum(line["episodes"] for line in lines)
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror or error})") from error
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{file}: holds a line that tells of no run ({error}); store the run again") from error
    if counted != len(rows):
        raise InputError(f"{file}: tells of {counted} episodes, {table} has {len(rows)}; store the run again")
    return StoredRun(name, tuple(rows), tuple(lines))


def stored_runs(folder: PathLike = RUNS) -> list[StoredRun]:
    """All stored runs of a folder by name; none if there is no such folder.

    Raises:
      InputError: a file cannot be read.
    """
    return [load_run(folder, path.stem) for path in sorted(Path(folder).glob("*.jsonl"))]


def _files(folder: PathLike, name: str) -> tuple[Path, Path]:
    return Path(folder) / f"{name}.parquet", Path(folder) / f"{name}.jsonl"
