"""Many scenarios, methods and seeds: what is wanted, what is there already, and what becomes of the rest.

How the episodes are run is a slot: `processes.Processes` runs one after the other in several worker processes,
`batches.Batches` many at a time in this one. The table is written anew whenever episodes have ended, so that a run that
was killed goes on where it stopped.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from mechsearch_jax.benchmarks.rows import Row, identity, read_code, read_rows, write_rows
from mechsearch_jax.envs.method import Method
from mechsearch_jax.errors import InputError
from mechsearch_jax.files import PathLike
from mechsearch_jax.versions import source_digest
from mechsearch_jax.workspace.scenario import Scenario, load_scenario


@dataclasses.dataclass(frozen=True)
class Job:
    """One episode to run.

    Attributes:
      path: file of the scenario.
      scenario: what is in it.
      method: everything else that decides about it, but for the seed.
      seed: of the episode.
    """

    path: str
    scenario: Scenario
    method: Method
    seed: int

    @property
    def options(self) -> dict[str, Any]:
        """As in `Episode.config`."""
        asked = {"target": self.scenario.target.shape, "simulator": self.method.engine, "seed": self.seed}
        return {**self.method.options(), **asked}

    def failed(self, reason: str) -> Row:
        """The row of an episode that could not be run to its end."""
        return Row.failed(self.scenario, self.options, reason)


def make_jobs(
    files: Sequence[PathLike],
    methods: Sequence[Method],
    seeds: Sequence[int],
) -> list[Job]:
    """All combinations of scenario files, methods and seeds.

    Raises:
      InputError: a file is not a scenario, two of them have the same name, or a method cannot be used.
    """
    for method in methods:
        method.check()
    jobs: list[Job] = []
    names: dict[str, str] = {}
    # All methods of a run are of the same shelf.
    shelf = methods[0].workcell.shelf if methods else None
    for file in files:
        path = str(Path(file).resolve())
        scenario = load_scenario(file, shelf)
        if scenario.name in names:
            raise InputError(
                f"{file}: has the name {scenario.name!r} as {names[scenario.name]} has; rename one of them"
            )
        names[scenario.name] = str(file)
        jobs += [Job(path, scenario, method, seed) for method in methods for seed in seeds]
    return jobs


@functools.cache
def present_code() -> str:
    """The code that decides about an episode: the package's version, and a digest of planner, perception (with its
    weights) and environment.

    The version alone would not tell a checkout from the next commit. The command line and pictures decide nothing.
    """
    digest = source_digest((".py", ".npz"), ("mechsearch_jax", "mechsearch_jax.envs"))
    return f"mechsearch-jax {importlib.metadata.version('mechsearch-jax')} ({digest[:12]})"


def _check_code(path: PathLike, rows: Sequence[Row]) -> None:
    """Refuse a table whose rows would be taken for those of the present code.

    Raises:
      InputError: some of them would, but other code ran them.
    """
    code = read_code(path)
    if code != present_code() and any(row.configuration is not None for row in rows):
        raise InputError(
            f"{path}: its episodes were run by {code or 'other code, it does not say which'}, this is "
            f"{present_code()}; give another file, or delete this one to run all of them again"
        )


class Runner(Protocol):
    """Runs episodes in whatever order it likes."""

    def __call__(self, jobs: Sequence[Job], ended: Callable[[Sequence[Row]], None]) -> None:
        """Run all jobs; `ended` is told of every one's row once, of several at a time if they ended together."""
        ...


def evaluate(
    jobs: Sequence[Job],
    out: PathLike,
    runner: Runner,
    ended: Callable[[Row, Sequence[Row]], None] = lambda row, rows: None,
) -> list[Row]:
    """Run the jobs that the table at `out` does not hold yet, and add each as its episode ends.

    Args:
      jobs: what is wanted.
      out: the Parquet file; rows that it holds already are kept, and stand for a job only if every option and what
        the scenario holds were the same. (Files of earlier versions do not say all of that: their rows are kept, but
        run again.) The file says which code ran the episodes, and only that code adds to it.
      runner: runs the episodes.
      ended: called after every episode with its row and with all rows.

    Returns:
      The rows of all jobs, in the order of the jobs.

    Raises:
      InputError: the table is there, but not one of episodes, or other code ran them, or it cannot be written.
    """
    rows: list[Row] = []
    if Path(out).exists():
        rows = read_rows(out)
        _check_code(out, rows)
    done = {identity(row) for row in rows}
    missing = [job for job in jobs if identity(job.failed("")) not in done]
    write_rows(rows, out, present_code())

    def take(new: Sequence[Row]) -> None:
        start = len(rows)
        rows.extend(new)
        write_rows(rows, out, present_code())
        for i, row in enumerate(new):
            ended(row, rows[: start + i + 1])

    if missing:
        runner(missing, take)
    by_identity = {identity(row): row for row in rows}
    return [by_identity[identity(job.failed(""))] for job in jobs]
