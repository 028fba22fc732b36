"""What the commands share that run many episodes: how and where they are run, whatever they come to."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import tyro

from mechsearch_jax.commands.options import EpisodeOptions, at_least_one, find_scenarios, has_gpu
from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.runtime.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from mechsearch_jax.benchmarks.report.console_tables import EpisodeProgress
    from mechsearch_jax.benchmarks.running.evaluate import Job, Runner
    from mechsearch_jax.benchmarks.store.rows import Row
    from mechsearch_jax.envs.simulators.named import EngineName


def _count(metavar: str) -> Any:
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """How episodes are run; nothing of it decides what they come to.

    Attributes:
      workers: number of processes, which use the CPU; by default one for each core, where there is no GPU.
      batch: number of episodes that run at the same time in this process, or on each GPU of a cluster; by default, on a
        GPU, what its memory holds.
      cluster: run the episodes in the workers of a Ray cluster, one a GPU, or one a CPU where it has no GPU: of one
        that is started on this machine (ray), of the one that runs here (ray:auto), or of another (ray:HOST:PORT).
      shard: run only the K-th of N parts of the episodes, as on machines that share no folder.
      retry_errors: run the episodes again whose row is an error.
      time_limit: of an episode in a worker process; one that takes longer is killed, and its row is an error. 3600 by
        default.
      dry_run: only say how many episodes and compilations it would be, and about how many hours.
    """

    workers: Annotated[int | None, _count("N")] = None
    batch: Annotated[int | None, _count("N")] = None
    cluster: Annotated[str | None, _count("ray|ray:HOST:PORT")] = None
    shard: Annotated[str | None, _count("K/N")] = None
    retry_errors: bool = False
    time_limit: Annotated[float | None, _count("SECONDS")] = None
    dry_run: bool = False

    def check(self, command: str, simulator: str) -> None:
        """Fail before anything is begun, with a simulator as `EpisodeOptions` has it.

        Raises:
          InputError: an option is impossible, or does not go with another, wherever the episodes run.
        """
        parsed_shard(command, self.shard)
        self.site(command)
        at_least_one(command, workers=self.workers, batch=self.batch)
        if self.workers is not None and self.batch is not None:
            raise InputError(f"{command}: give either --workers or --batch, not both")
        if self.workers is not None and simulator == "mjx":
            raise InputError(f"{command}: --workers run the native simulator; leave --workers out, or --simulator mjx")
        if self.time_limit is not None and not 0 < self.time_limit < math.inf:
            raise InputError(f"{command}: --time-limit {self.time_limit:g} must be a number of seconds above 0")

    def in_processes(self, command: str, simulator: str) -> bool:
        """Whether worker processes run the episodes, with a simulator as `EpisodeOptions` has it.

        Raises:
          InputError: as `check`, or there is a limit of time for batches.
        """
        self.check(command, simulator)
        site = self.site(command)
        workers = self.workers is not None or (self.batch is None and simulator != "mjx" and not site.has_gpu())
        if self.time_limit is not None and not workers:
            raise InputError(
                f"{command}: --time-limit is for worker processes, not for batches; leave it out, or --workers N"
            )
        return workers

    def engine(self, command: str, options: EpisodeOptions) -> EngineName:
        """The simulator that the episodes run in.

        Raises:
          InputError: as `in_processes`, the place where they run cannot be reached, or the simulator is not installed.
        """
        self.check(command, options.simulator)
        site = self.site(command)
        site.enter()
        return "NativeSimulator" if self.in_processes(command, options.simulator) else options.engine(site.has_gpu)

    def site(self, command: str) -> Site:
        """Where the episodes are run.

        Raises:
          InputError: there is no such place, or it cannot be told what they would take there.
        """
        if self.cluster is None:
            return Here()
        name, _, address = self.cluster.partition(":")
        if name != "ray" or self.cluster == "ray:" or address.startswith("//"):
            raise InputError(
                f"{command}: --cluster {self.cluster} is unknown; give ray, ray:auto or ray:HOST:PORT, on a machine of "
                "the cluster"
            )
        if self.dry_run:
            raise InputError(f"{command}: --dry-run tells of runs on this machine; leave --cluster out")
        return OnRay(address or "local")


class Site(Protocol):
    """Where episodes are run."""

    def enter(self) -> None:
        """Go there; before anything is computed.

        Raises:
          InputError: it cannot be reached.
        """
        ...

    def has_gpu(self) -> bool:
        """Whether there is a GPU."""
        ...

    def runner(self, run: RunOptions, in_processes: bool, progress: EpisodeProgress) -> Runner:
        """What runs them.

        Args:
          run: how they are run.
          in_processes: as `RunOptions.in_processes` says it.
          progress: shown meanwhile.
        """
        ...


@dataclasses.dataclass(frozen=True)
class Here:
    """This machine."""

    def enter(self) -> None:
        """Nothing: this is there."""

    def has_gpu(self) -> bool:
        """See `Site`."""
        return has_gpu()

    def runner(self, run: RunOptions, in_processes: bool, progress: EpisodeProgress) -> Runner:
        """See `Site`."""
        from mechsearch_jax.benchmarks.running.batches import Batches
        from mechsearch_jax.benchmarks.running.processes import TIME_LIMIT, Processes
        from mechsearch_jax.problem.cache import keep_compilations

        if in_processes:
            return Processes(run.workers or cores(), run.time_limit or TIME_LIMIT)
        keep_compilations()
        return Batches(run.batch, progress.busy, progress.compiling)


@dataclasses.dataclass(frozen=True)
class OnRay:
    """A Ray cluster.

    Attributes:
      address: as `benchmarks.running.cluster.join` has it.
    """

    address: str

    def enter(self) -> None:
        """Join it, and leave its GPUs to its workers."""
        import jax

        from mechsearch_jax.benchmarks.running.cluster import join

        join(self.address)
        # Were it to use a GPU of this machine, this process would take most of its memory.
        jax.config.update("jax_platforms", "cpu")

    def has_gpu(self) -> bool:
        """See `Site`."""
        from mechsearch_jax.benchmarks.running.cluster import join

        return any(machine.get("GPU", 0) >= 1 for machine in join(self.address))

    def runner(self, run: RunOptions, in_processes: bool, progress: EpisodeProgress) -> Runner:
        """See `Site`."""
        from mechsearch_jax.benchmarks.running.cluster import RayCluster
        from mechsearch_jax.benchmarks.running.cluster_workers import OnCpus, OnGpus
        from mechsearch_jax.benchmarks.running.processes import TIME_LIMIT

        kind = OnCpus(run.workers, run.time_limit or TIME_LIMIT) if in_processes else OnGpus(run.batch)
        return RayCluster(kind, self.address)


# As the commands run them where nothing is given.
USUAL_RUN = RunOptions()


def parsed_shard(command: str, text: str | None) -> tuple[int, int]:
    """The numbers K and N of "K/N"; 1 and 1 where nothing is given.

    Raises:
      InputError: it is something else.
    """
    parts = (text or "1/1").split("/")
    if len(parts) != 2 or not all(part.isdecimal() for part in parts) or not 1 <= int(parts[0]) <= int(parts[1]):
        raise InputError(f"{command}: --shard {text} is not K/N with K from 1 to N, as 2/8")
    return int(parts[0]), int(parts[1])


def run_episodes_of(
    command: str,
    scenarios: Sequence[str],
    points: Sequence[EpisodeOptions],
    policies: Sequence[str],
    seeds: Sequence[int],
    out: Path,
    run: RunOptions,
) -> None:
    """Run every scenario with every policy at every point and with every seed, and print the rates.

    Args:
      command: its name, for complaints.
      scenarios: as commands take them.
      points: what episodes run with; one simulator and one configuration file for all.
      policies: their names or import paths.
      seeds: of the episodes.
      out: folder of the results.
      run: how they are run.

    Raises:
      InputError: something that is given cannot be used.
    """
    from mechsearch_jax.benchmarks.report.episode_tables import print_rates
    from mechsearch_jax.benchmarks.running.evaluate import make_jobs

    engine = run.engine(command, points[0])
    # The same settings may come from several points.
    methods = dict.fromkeys(method for point in points for method in point.methods(policies, engine))
    jobs = make_jobs(find_scenarios(scenarios), list(methods), list(dict.fromkeys(seeds)))
    run_jobs(command, jobs, out, run, points[0].simulator, print_rates)


def run_jobs(
    command: str,
    jobs: Sequence[Job],
    out: Path,
    run: RunOptions,
    simulator: str,
    show: Callable[[Console, Sequence[Row]], None],
) -> None:
    """Run this machine's part of jobs, or only say what that would take.

    Args:
      command: its name, for complaints.
      jobs: the episodes of all machines; their engine is `run.engine`'s.
      out: folder of the results.
      run: how they are run.
      simulator: as `EpisodeOptions` has it.
      show: prints what they came to, where there are any.

    Raises:
      InputError: something that is given cannot be used.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.report.console_tables import EpisodeProgress
    from mechsearch_jax.benchmarks.running.evaluate import evaluate, shard_of

    jobs = shard_of(jobs, *parsed_shard(command, run.shard))
    in_processes = run.in_processes(command, simulator)
    if run.dry_run:
        from mechsearch_jax.benchmarks.running.estimate import estimate

        workers = run.workers or cores()
        print(estimate(jobs, out, workers if in_processes else None, run.retry_errors))
        return
    console = Console(highlight=False)
    with EpisodeProgress(console, len(jobs)) as progress:
        runner = run.site(command).runner(run, in_processes, progress)
        rows = evaluate(jobs, out, runner, progress.ended, progress.waiting, run.retry_errors)
    if rows:
        show(console, rows)
    if errors := sum(row.is_error for row in rows):
        print(
            f"{command}: {errors} of {len(rows)} episodes ended in an error; --retry-errors runs them again",
            file=sys.stderr,
        )
    console.print(str(out), soft_wrap=True)
