"""What a run would take: how many episodes and compilations, and about how long."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax

from mechsearch_jax.benchmarks.running.episode_seconds import (
    Kind,
    MeasuredSeconds,
    kind_of,
    measured,
    nearest,
    stored_seconds,
)
from mechsearch_jax.benchmarks.running.evaluate import PlannedJob, check_code
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.benchmarks.store.shards import Results
from mechsearch_jax.envs.episode.method import MISMATCH_PREFIX, Method
from mechsearch_jax.envs.world.mismatch import Mismatch
from mechsearch_jax.planner import PlannerConfig
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.runtime.versions import versions

# Of an episode and of a compilation where nothing was measured on such a device: on one CPU core [s].
ASSUMED = MeasuredSeconds(8.0, 60.0, 0)
# The options that are data in what is compiled.
CONTINUOUS = frozenset(path[0].name for path, _ in jax.tree_util.tree_flatten_with_path(PlannerConfig())[0])


class Part(NamedTuple):
    """The episodes of a run that take about as long as each other.

    Attributes:
      kind: what they have in common.
      left: how many are still to be run.
      compilations: in how many ways they differ in more than continuous settings and max_steps, without those of
        earlier parts.
      seconds: what an episode and a compilation take, by the folder's rows, by stored runs or assumed.
      grounds: where the seconds are from.
    """

    kind: Kind
    left: int
    compilations: int
    seconds: MeasuredSeconds
    grounds: str


@dataclasses.dataclass(frozen=True)
class Estimate:
    """What a run would take.

    Attributes:
      variants: how many methods with all their settings there are.
      episodes: how many are wanted.
      there: of how many of them the folder holds the row.
      workers: how many processes share the episodes; None for batches.
      parts: those that are left.
    """

    variants: int
    episodes: int
    there: int
    workers: int | None
    parts: Sequence[Part]

    @property
    def compilations(self) -> int:
        """How many compilations of the planner those that are left need."""
        return sum(part.compilations for part in self.parts)

    @property
    def hours(self) -> float:
        """How long it would take, if nothing was compiled before."""
        return sum(map(self._seconds, self.parts)) / 3600.0

    def _seconds(self, part: Part) -> float:
        running = part.left * part.seconds.episode_seconds / (self.workers or 1)
        return running + part.compilations * part.seconds.compile_seconds

    def __str__(self) -> str:
        left = self.episodes - self.there
        where = "in batches" if self.workers is None else f"in {_counted(self.workers, 'process')}"
        lines = [
            f"{_counted(self.variants, 'variant')}, {_counted(self.episodes, 'episode')}, "
            f"{self.there} of them there already, {left} left",
            f"{_counted(self.compilations, 'compilation')} of the planner: "
            "what differs in continuous settings alone shares one",
            f"about {self.hours:.2g} hours {where}, if nothing was compiled before",
        ]
        for part in self.parts:
            lines.append(
                f"  {', '.join(part.kind.words)}: {part.left} x "
                f"{part.seconds.episode_seconds:.3g} s, {part.compilations} x {part.seconds.compile_seconds:.3g} s of "
                f"compiling ({part.grounds})"
            )
        return "\n".join(lines)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 'es' if what.endswith('s') else 's'}"


def estimate(jobs: Sequence[PlannedJob], out: PathLike, workers: int | None, retry_errors: bool = False) -> Estimate:
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
    device = versions()["device"]
    rows = [row for row in results.rows.values() if row.device == device and not row.is_error]
    by_kind: dict[Kind, list[PlannedJob]] = {}
    kinds = functools.cache(Kind.of)
    for job in left:
        by_kind.setdefault(kinds(job.method), []).append(job)
    clocks = _Clocks(rows, device, workers or 1)
    compile_key = functools.cache(Method.compile_key)
    seen: set[object] = set()
    parts = []
    for kind, members in by_kind.items():
        keys = {(job.target, compile_key(job.method)) for job in members} - seen
        seen |= keys
        parts.append(Part(kind, len(members), len(keys), *clocks.of(kind)))
    return Estimate(len({job.method for job in jobs}), len(wanted), len(wanted) - len(left), workers, parts)


class _Clocks:
    """What episodes take: by a folder's rows, else by stored runs, else by what is assumed."""

    def __init__(self, rows: Sequence[EpisodeRow], device: str, at_once: int) -> None:
        """Args:
        rows: of the folder, of the device.
        device: as `versions` says it.
        at_once: how many processes wait for each compilation.
        """
        self._device, self._at_once = device, at_once
        self._folder: dict[Kind, list[EpisodeRow]] = {}
        for row in rows:
            self._folder.setdefault(kind_of(row.configuration), []).append(row)
        self._stored = stored_seconds()

    def of(self, kind: Kind) -> tuple[MeasuredSeconds, str]:
        """What an episode of a kind and its compilation take, and how that is known."""
        if self._folder:
            of_rows = min(self._folder, key=kind.distance)
            rows = self._folder[of_rows]
            seconds = measured(rows, _compilations(rows), self._at_once)
            return seconds, f"from {_counted(len(rows), 'row')} of the folder{_of(of_rows, kind)}"
        best = nearest(self._device, kind, self._stored)
        if best is None:
            return ASSUMED, "assumed: nothing was measured on such a device"
        where = f" on {best.device.partition(': ')[2]}" if best.device != self._device else ""
        return best.seconds, f"from {best.source}{where}{_of(best.kind, kind)}"


def _of(measured_kind: Kind, kind: Kind) -> str:
    """What was measured instead of a kind; empty where it is the kind itself."""
    differing = [text for text, wanted in zip(measured_kind.words, kind.words, strict=True) if text != wanted]
    return f", of {', '.join(differing)}" if differing else ""


def _compilations(rows: Iterable[EpisodeRow]) -> int:
    """How many compilations rows needed, as far as their options tell."""
    return len({_discrete(row.configuration, row.target) for row in rows})


@functools.lru_cache(maxsize=4096)
def _discrete(configuration: str, target: str) -> str:
    """What is compiled, as far as the options tell."""
    options = json.loads(configuration)
    differs = {name: value for name, value in options.items() if name.startswith(MISMATCH_PREFIX)}
    mismatch = Mismatch(**{name.removeprefix(MISMATCH_PREFIX): value for name, value in differs.items()})
    data = CONTINUOUS | differs.keys() | {"max_steps"}
    kept = {name: value for name, value in options.items() if name not in data}
    return json.dumps([kept, mismatch.compile_key(), target], sort_keys=True)
