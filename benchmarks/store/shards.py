"""Results as a folder: shards of rows, each written by one process alone, so that any number of them add side by side.

A shard grows as a file of JSON lines in the folder `OPEN`, and becomes a Parquet file when it is full or its writer
ends: the Parquet file appears whole, then the other goes. Every row is on disk before `append` returns; of a line that
a kill cut short nothing is taken. A shard that a process left open, because it was killed or could not write the
Parquet file, is closed by the next one that adds to the folder (see `claims`).

Two processes may have run the same episode all the same, since nothing that machines share but a folder can rule that
out. Readers take one row of each: one without an error goes before one with an error, then the one that comes first by
the shard's name and in it. That depends on nothing but what is in the folder.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

from mechsearch_jax.benchmarks.store.rows import EpisodeRow, episode_key, parse_row, read_rows, write_rows
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, check_writable

# Readers of Parquet pass over names that begin so.
OPEN = "_open"
CLOSED_ENDING, OPEN_ENDING = ".parquet", ".jsonl"
PREFIX = "shard-"
# A reader wants few files; what is open is read as text.
ROWS_PER_SHARD = 5000


def _names(folder: Path, ending: str) -> set[str]:
    """The names of the shards in a folder, without their ending."""
    try:
        names = os.listdir(folder)
    except FileNotFoundError:
        return set()
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror or error})") from error
    return {name.removesuffix(ending) for name in names if name.startswith(PREFIX) and name.endswith(ending)}


def _parse(line: bytes, path: Path) -> EpisodeRow:
    try:
        return parse_row(line)
    except ValueError as error:
        raise InputError(
            f"{path}: holds a line that is no row ({error}); delete the line, and its episode is run again"
        ) from error


def _read_open(path: Path, offset: int = 0) -> tuple[list[EpisodeRow], int]:
    """The rows of an open shard from a place in its file on, and the place where the next one begins.

    Raises:
      FileNotFoundError: it has been closed.
      InputError: it cannot be read.
    """
    try:
        with open(path, "rb") as file:
            file.seek(offset)
            text = file.read()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    # A line that has no end is still being written, or never will be.
    whole = text[: text.rfind(b"\n") + 1]
    return [_parse(line, path) for line in whole.splitlines()], offset + len(whole)


@dataclasses.dataclass
class _Shard:
    """How far an open shard has been read."""

    rows: int = 0
    offset: int = 0


class Results:
    """The rows of a folder's shards, one for each episode, as far as they have been read.

    Attributes:
      folder: in which the shards are.
      rows: by `episode_key`.
      attempts: how many rows of each there are in all.
    """

    def __init__(self, folder: PathLike) -> None:
        self.folder = Path(folder)
        self.rows: dict[str, EpisodeRow] = {}
        self.attempts: dict[str, int] = {}
        self._ranks: dict[str, tuple[bool, str, int]] = {}
        self._shards: dict[str, _Shard] = {}
        # The closed ones, which have been read to their end.
        self._done: set[str] = set()

    def refresh(self) -> list[str]:
        """Read what was added since the last time, by whomever; the `episode_key` of every row of that.

        Raises:
          InputError: a file cannot be read or holds something else.
        """
        # In this order, one that is closed meanwhile is in the second list at least.
        still_open, closed = _names(self.folder / OPEN, OPEN_ENDING), _names(self.folder, CLOSED_ENDING)
        fresh: list[str] = []
        for name in sorted((still_open | closed) - self._done):
            shard = self._shards.setdefault(name, _Shard())
            fresh += [self._add(row, name, shard) for row in self._read(name, shard, name in closed)]
        return fresh

    def _read(self, name: str, shard: _Shard, closed: bool) -> list[EpisodeRow]:
        """The rows of a shard that have not been read."""
        path = self.folder / OPEN / (name + OPEN_ENDING)
        if not closed:
            with contextlib.suppress(FileNotFoundError):
                if path.stat().st_size <= shard.offset:
                    return []
                rows, shard.offset = _read_open(path, shard.offset)
                return rows
        rows = read_rows(self.folder / (name + CLOSED_ENDING))[shard.rows :]
        self._done.add(name)
        return rows

    def _add(self, row: EpisodeRow, name: str, shard: _Shard) -> str:
        key, rank = episode_key(row), (row.is_error, name, shard.rows)
        shard.rows += 1
        self.attempts[key] = self.attempts.get(key, 0) + 1
        if key in self.rows and self.rows[key].code != row.code:
            raise InputError(
                f"{self.folder}: holds scenario {row.scenario!r}, seed {row.seed}, run with the same options by "
                f"{self.rows[key].code} and by {row.code}; move the shards of one of them to a folder of their own"
            )
        if key not in self._ranks or rank < self._ranks[key]:
            self.rows[key], self._ranks[key] = row, rank
        return key


class ShardWriter:
    """Adds rows to a folder, in shards that nobody else writes to.

    The folder is made if it is not there. `close` closes the last shard; as a context it does so at the end.
    """

    def __init__(self, folder: PathLike, writer: str, rows_per_shard: int = ROWS_PER_SHARD) -> None:
        """Args:
          folder: for the shards.
          writer: a name that nothing else that ever adds to the folder has.
          rows_per_shard: how many a shard holds before it is closed.

        Raises:
          InputError: the folder cannot be written to.
        """
        self._folder, self._writer, self._most = Path(folder), writer, rows_per_shard
        check_writable(self._folder / OPEN)
        self._number = 0
        self._rows: list[EpisodeRow] = []
        self._file: IO[bytes] | None = None

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(self, *details: object) -> None:
        self.close()

    def append(self, rows: Sequence[EpisodeRow]) -> None:
        """Add rows; they are on disk when this returns.

        Raises:
          InputError: they cannot be written.
        """
        if not rows:
            return
        path = self._folder / OPEN / f"{self._name}{OPEN_ENDING}"
        try:
            if self._file is not None and not _is_at(self._file, path):
                # Somebody took this process for dead, and has closed its shard: it goes on in another.
                lost = [] if (self._folder / f"{self._name}{CLOSED_ENDING}").exists() else self._rows
                self._file.close()
                self._file, self._number = None, self._number + 1
                self.append([*lost, *rows])
                return
            if self._file is None:
                self._file, self._rows = path.open("xb", buffering=0), []
            text = "".join(json.dumps(vars(row), allow_nan=False) + "\n" for row in rows)
            _write(self._file, text.encode())
        except OSError as error:
            # What is whole in it stays; after half a line no other must follow.
            self._file, self._number = None, self._number + 1
            raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
        self._rows += rows
        if len(self._rows) >= self._most:
            self.close()

    def close(self) -> None:
        """Close the shard that is open, if any; the next row opens another.

        Raises:
          InputError: it cannot be written; its rows stay where they are, for the next process to close.
        """
        if self._file is None:
            return
        self._file.close()
        name, rows = self._name, self._rows
        self._file, self._rows, self._number = None, [], self._number + 1
        try:
            close_shard(self._folder, name, rows)
        except InputError as error:
            raise InputError(
                f"{error}; the rows are kept in {self._folder / OPEN} until the same command is run again"
            ) from error

    @property
    def _name(self) -> str:
        return f"{PREFIX}{self._writer}-{self._number:05d}"


def _is_at(file: IO[bytes], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _write(file: IO[bytes], text: bytes) -> None:
    """All of it, and on to the disk."""
    rest = memoryview(text)
    while rest:
        rest = rest[file.write(rest) :]
    os.fsync(file.fileno())


def close_shard(folder: PathLike, name: str, rows: Sequence[EpisodeRow]) -> None:
    """Make a Parquet file of an open shard's rows, and remove what they were in.

    Raises:
      InputError: it cannot be written.
    """
    write_rows(rows, Path(folder) / f"{name}{CLOSED_ENDING}")
    (Path(folder) / OPEN / f"{name}{OPEN_ENDING}").unlink(missing_ok=True)


def writers_of_open_shards(folder: PathLike) -> set[str]:
    """Who has shards open in a folder.

    Raises:
      InputError: the folder cannot be read.
    """
    return {name.removeprefix(PREFIX).rpartition("-")[0] for name in _names(Path(folder) / OPEN, OPEN_ENDING)}


def close_shards_of(folder: PathLike, writer: str) -> None:
    """Close what a writer left open that is gone for good.

    Raises:
      InputError: a shard cannot be read, or not be written.
    """
    folder = Path(folder)
    for name in sorted(_names(folder / OPEN, OPEN_ENDING)):
        if name.startswith(f"{PREFIX}{writer}-"):
            with contextlib.suppress(FileNotFoundError):
                rows, _ = _read_open(folder / OPEN / f"{name}{OPEN_ENDING}")
                if (folder / f"{name}{CLOSED_ENDING}").exists() or not rows:
                    (folder / OPEN / f"{name}{OPEN_ENDING}").unlink()
                else:
                    close_shard(folder, name, rows)


def result_tables(path: PathLike) -> Iterator[tuple[Path, list[EpisodeRow]]]:
    """The rows of a Parquet file or of a folder, table by table: a folder's shards are one, every other Parquet file in
    it is one, and the folders in it are as many as they hold.

    Raises:
      InputError: there is nothing of that name or in it, or a file cannot be read.
    """
    path = Path(path)
    if not path.is_dir():
        yield path, read_rows(path)
        return
    tables = list(_tables_in(path))
    if not tables:
        raise InputError(f"{path}: there are no results in this folder or those in it")
    yield from tables


def _tables_in(folder: Path) -> Iterator[tuple[Path, list[EpisodeRow]]]:
    results = Results(folder)
    results.refresh()
    if results.rows:
        yield folder, list(results.rows.values())
    try:
        inside = sorted(folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror or error})") from error
    for path in inside:
        if path.name.startswith((".", "_")):
            continue
        if path.is_dir():
            yield from _tables_in(path)
        elif path.suffix == CLOSED_ENDING and not path.name.startswith(PREFIX):
            yield path, read_rows(path)
