"""Shared by commands that run many episodes: how and where episodes are run."""

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
from mechsearch_jax.runtime.files import is_file, is_folder

if TYPE_CHECKING:
    from rich.console import Console

    from mechsearch_jax.benchmarks.report.console_tables import EpisodeProgress
    from mechsearch_jax.benchmarks.running.evaluate import Job, PlannedJob, Runner, SceneOutline
    from mechsearch_jax.benchmarks.store.rows import EpisodeRow
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
        """Check the options before any work, with a simulator of `EpisodeOptions`.

        Raises:
          InputError: an option is impossible or contradicts another.
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
        """Whether worker processes run the episodes, with a simulator of `EpisodeOptions`.

        Raises:
          InputError: as `check`, or a time limit is given for batches.
        """
        self.check(command, simulator)
        site = self.site(command)
        in_processes = self.workers is not None or (self.batch is None and simulator != "mjx" and not site.has_gpu())
        if self.time_limit is not None and not in_processes:
            raise InputError(
                f"{command}: --time-limit is for worker processes, not for batches; leave it out, or --workers N"
            )
        return in_processes

    def engine(self, command: str, options: EpisodeOptions) -> EngineName:
        """The simulator that the episodes run in.

        Raises:
          InputError: as `in_processes`, the site cannot be reached, or the simulator is not installed.
        """
        self.check(command, options.simulator)
        site = self.site(command)
        site.enter()
        return "NativeSimulator" if self.in_processes(command, options.simulator) else options.engine(site.has_gpu)

    def site(self, command: str) -> Site:
        """Where the episodes are run.

        Raises:
          InputError: there is no such site, or a dry run is given for a cluster.
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
        """Connect to the site, before any computation.

        Raises:
          InputError: it cannot be reached.
        """
        ...

    def has_gpu(self) -> bool:
        """Whether there is a GPU."""
        ...

    def runner(self, run: RunOptions, in_processes: bool, progress: EpisodeProgress) -> Runner:
        """The runner of the episodes.

        Args:
          run: how they are run.
          in_processes: the result of `RunOptions.in_processes`.
          progress: the progress display.
        """
        ...


@dataclasses.dataclass(frozen=True)
class Here:
    """This machine."""

    def enter(self) -> None:
        """Nothing to do."""

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
        return Batches(run.batch, progress.busy, progress.compiling, progress.again)


@dataclasses.dataclass(frozen=True)
class OnRay:
    """A Ray cluster.

    Attributes:
      address: argument of `benchmarks.running.cluster.join`.
    """

    address: str

    def enter(self) -> None:
        """Join the cluster, and leave its GPUs to its workers."""
        import jax

        from mechsearch_jax.benchmarks.running.cluster import join

        join(self.address)
        # On a GPU of this machine, this process would take most of its memory.
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


# The default.
USUAL_RUN = RunOptions()


def parsed_shard(command: str, text: str | None) -> tuple[int, int]:
    """The numbers K and N of "K/N"; 1 and 1 for None.

    Raises:
      InputError: the text has another form.
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
      command: name of the command, for error messages.
      scenarios: scenario arguments of the command line.
      points: options of episodes; all have the same simulator and configuration file.
      policies: names or import paths of policies.
      seeds: seeds of the episodes.
      out: folder of the results.
      run: how the episodes are run.

    Raises:
      InputError: an argument cannot be used.
    """
    from mechsearch_jax.benchmarks.report.episode_tables import print_rates
    from mechsearch_jax.benchmarks.running.evaluate import make_jobs
    from mechsearch_jax.envs.scenes.standing import check_standing

    engine = run.engine(command, points[0])
    # Several points may give the same settings.
    methods = list(dict.fromkeys(method for point in points for method in point.methods(policies, engine)))
    seeds = list(dict.fromkeys(seeds))
    if run.dry_run:
        from mechsearch_jax.benchmarks.running.evaluate import planned_jobs

        planned = planned_jobs(outlines_of(scenarios), methods, seeds)
        print_estimate(command, planned, out, run, points[0].simulator)
        return
    jobs = make_jobs(find_scenarios(scenarios), methods, seeds)
    check_standing({job.path: job.scenario for job in jobs}, methods[0].workcell.shelf)
    run_jobs(command, jobs, out, run, points[0].simulator, print_rates)


def outlines_of(names: Sequence[str]) -> list[SceneOutline]:
    """What is known of the scenes that scenario arguments stand for; those of scene sets are not made.

    Raises:
      InputError: there is no scenario for a name.
    """
    from mechsearch_jax.benchmarks.running.evaluate import SceneOutline
    from mechsearch_jax.envs.scenes.scene_sets import SETS, find_scene, set_scenes
    from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

    outlines = []
    for name in names:
        scene, is_path = find_scene(name), is_file(name) or is_folder(name)
        if name in SETS and not is_path:
            outlines += [SceneOutline.of_block(*each) for each in set_scenes(SETS[name])]
        elif scene and not is_path and name not in example_scenarios():
            outlines.append(SceneOutline.of_block(*scene))
        else:
            outlines += [SceneOutline.of_scenario(load_scenario(file)) for file in find_scenarios([name])]
    return outlines or [SceneOutline.of_scenario(load_scenario(file)) for file in find_scenarios(names)]


def print_estimate(command: str, jobs: Sequence[PlannedJob], out: Path, run: RunOptions, simulator: str) -> None:
    """Print what this machine's part of the jobs would take.

    Args:
      command: name of the command, for error messages.
      jobs: the episodes of all machines, with the engine of `run.engine`.
      out: folder of the results, which need not be there.
      run: how the episodes would be run.
      simulator: the simulator of `EpisodeOptions`.

    Raises:
      InputError: an argument cannot be used.
    """
    from mechsearch_jax.benchmarks.running.estimate import estimate
    from mechsearch_jax.benchmarks.running.evaluate import shard_of

    jobs = shard_of(jobs, *parsed_shard(command, run.shard))
    workers = run.workers or cores()
    print(estimate(jobs, out, workers if run.in_processes(command, simulator) else None, run.retry_errors))


def run_jobs(
    command: str,
    jobs: Sequence[Job],
    out: Path,
    run: RunOptions,
    simulator: str,
    print_results: Callable[[Console, Sequence[EpisodeRow]], None],
) -> None:
    """Run this machine's part of the jobs.

    Args:
      command: name of the command, for error messages.
      jobs: the episodes of all machines, with the engine of `run.engine`.
      out: folder of the results.
      run: how the episodes are run.
      simulator: the simulator of `EpisodeOptions`.
      print_results: prints the rows of the episodes, if there are any.

    Raises:
      InputError: an argument cannot be used.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.report.console_tables import EpisodeProgress
    from mechsearch_jax.benchmarks.running.evaluate import evaluate, shard_of

    jobs = shard_of(jobs, *parsed_shard(command, run.shard))
    in_processes = run.in_processes(command, simulator)
    console = Console(highlight=False)
    with EpisodeProgress(console, len(jobs)) as progress:
        runner = run.site(command).runner(run, in_processes, progress)
        rows = evaluate(jobs, out, runner, progress.ended, progress.waiting, run.retry_errors)
    if rows:
        print_results(console, rows)
    if errors := sum(row.is_error for row in rows):
        print(
            f"{command}: {errors} of {len(rows)} episodes ended in an error; --retry-errors runs them again",
            file=sys.stderr,
        )
    console.print(str(out), soft_wrap=True, markup=False)
