"""What a run would take: how many episodes and compilations, and about how long."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Sequence

import jax

from mechsearch_jax.benchmarks.running.evaluate import Job, check_code
from mechsearch_jax.benchmarks.store.rows import Row
from mechsearch_jax.benchmarks.store.shards import Results
from mechsearch_jax.envs.episode.episodes import target_of
from mechsearch_jax.envs.episode.method import MISMATCH_PREFIX, Method
from mechsearch_jax.envs.world.mismatch import Mismatch
from mechsearch_jax.planner import PlannerConfig
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.runtime.versions import versions

# Of an episode and of a compilation where nothing was measured [s]: on one CPU core, and in batches on one H200
# (docs/results.md, "Speed").
ASSUMED = {"cpu": (8.0, 60.0), "gpu": (0.14, 120.0)}
# The options that are data in what is compiled.
CONTINUOUS = frozenset(path[0].name for path, _ in jax.tree_util.tree_flatten_with_path(PlannerConfig())[0])


@dataclasses.dataclass(frozen=True)
class Estimate:
    """What a run would take.

    Attributes:
      variants: how many methods with all their settings there are.
      episodes: how many are wanted.
      there: of how many of them the folder holds the row.
      compilations: in how many ways those that are left differ in more than continuous settings and max_steps.
      episode_seconds, compile_seconds: what one takes [s].
      workers: how many processes share the episodes; None for batches.
      measured: how many rows of the folder say so; where none do, the seconds are assumed.
    """

    variants: int
    episodes: int
    there: int
    compilations: int
    episode_seconds: float
    compile_seconds: float
    workers: int | None
    measured: int

    @property
    def hours(self) -> float:
        """How long it would take, if nothing was compiled before."""
        running = (self.episodes - self.there) * self.episode_seconds / (self.workers or 1)
        return (running + self.compilations * self.compile_seconds) / 3600.0

    def __str__(self) -> str:
        left = self.episodes - self.there
        grounds = (
            f"from {_counted(self.measured, 'row')} of this kind of device in the folder"
            if self.measured
            else "assumed: the folder holds no rows of this kind of device"
        )
        where = "in batches" if self.workers is None else f"in {_counted(self.workers, 'process')}"
        return (
            f"{_counted(self.variants, 'variant')}, {_counted(self.episodes, 'episode')}, "
            f"{self.there} of them there already, {left} left\n"
            f"{_counted(self.compilations, 'compilation')} of the planner: "
            "what differs in continuous settings alone shares one\n"
            f"about {self.hours:.2g} hours: {left} x {self.episode_seconds:.3g} s {where}, "
            f"{self.compilations} x {self.compile_seconds:.3g} s of compiling ({grounds})"
        )


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 'es' if what.endswith('s') else 's'}"


def estimate(jobs: Sequence[Job], out: PathLike, workers: int | None, retry_errors: bool = False) -> Estimate:
    """What `evaluate` would take for jobs.

    Args:
      jobs: what is wanted.
      out: the folder of the results, which need not be there.
      workers: number of worker processes; None for batches.
      retry_errors: as `evaluate` has it.

    Raises:
      InputError: the folder cannot be read, or holds rows of other code.
    """
    results = Results(out)
    check_code(results, results.refresh())
    over = {key for key, row in results.rows.items() if not (retry_errors and row.is_error)}
    wanted = {job.key: job for job in jobs}
    left = [job for key, job in wanted.items() if key not in over]
    mould = functools.cache(Method.mould)
    moulds = {(target_of(job.scenario, job.method.workcell.target), mould(job.method)) for job in left}
    device = versions()["device"]
    rows = [row for row in results.rows.values() if row.device == device and not row.is_error]
    episode, compiling = (
        _measured(rows, workers or 1) if rows else ASSUMED["cpu" if device.startswith("cpu") else "gpu"]
    )
    return Estimate(
        variants=len({job.method for job in jobs}),
        episodes=len(wanted),
        there=len(wanted) - len(left),
        compilations=len(moulds),
        episode_seconds=episode,
        compile_seconds=compiling,
        workers=workers,
        measured=len(rows),
    )


def _measured(rows: Sequence[Row], at_once: int) -> tuple[float, float]:
    """Mean seconds of an episode, and of a compilation if as many processes as now waited for each."""
    running = sum(row.planning_seconds + row.simulation_seconds for row in rows) / len(rows)
    compiled = {_discrete(row.configuration, row.target) for row in rows}
    return running, sum(row.compile_seconds or 0.0 for row in rows) / len(compiled) / at_once


@functools.lru_cache(maxsize=4096)
def _discrete(configuration: str, target: str) -> str:
    """What is compiled, as far as the options tell."""
    options = json.loads(configuration)
    differs = {name: value for name, value in options.items() if name.startswith(MISMATCH_PREFIX)}
    mismatch = Mismatch(**{name.removeprefix(MISMATCH_PREFIX): value for name, value in differs.items()})
    data = CONTINUOUS | differs.keys() | {"max_steps"}
    kept = {name: value for name, value in options.items() if name not in data}
    return json.dumps([kept, mismatch.mould(), target], sort_keys=True)
