"""`mechsearch bench`: whether whole episodes come to less than before, and how many are run in a second."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mechsearch_jax.commands.options import JsonFile, at_least_one, check_files, files_of
from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.runtime.errors import InputError


def _command() -> str:
    """What was typed."""
    return shlex.join(["mechsearch", *sys.argv[1:]])


def bench_guard(
    *,
    out: Path,
    scenes: Literal[40, 80, 160] = 160,
    reference: JsonFile = None,
    write: bool = False,
    workers: int | None = None,
) -> None:
    """Run a fixed suite of episodes and compare them with stored ones; status 1 after a significant loss.

    Args:
      out: folder for the rows; one that is there is gone on with, if the same code wrote it.
      scenes: size of the suite: the first scenes of each number of objects in the scene set `development`.
      reference: what it is compared with; benchmarks/results/guard-cpu.json of the checkout if not given.
      write: store what it came to in that place, instead of comparing.
      workers: number of processes; one for each core if not given.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.guard import guard
    from mechsearch_jax.benchmarks.report.console_tables import EpisodeProgress
    from mechsearch_jax.benchmarks.report.episode_tables import guard_table
    from mechsearch_jax.benchmarks.running.evaluate import evaluate, make_jobs
    from mechsearch_jax.benchmarks.running.processes import Processes
    from mechsearch_jax.envs.episode.method import Method

    at_least_one("bench guard", workers=workers)
    stored = reference or guard.REFERENCE
    before = None if write else guard.read_reference(stored)
    if write:
        check_files(stored)
    jobs = make_jobs(files_of(guard.suite(scenes)), [Method()], (guard.SEED,))
    console = Console(highlight=False)
    with EpisodeProgress(console, len(jobs)) as progress:
        rows = evaluate(jobs, out, Processes(workers or cores()), progress.ended, progress.waiting)
    if before is None:
        guard.save_reference(rows, _command(), stored)
        console.print(str(stored), soft_wrap=True, markup=False)
        return
    comparisons = guard.compare(before.outcomes, [guard.Outcome.of_row(row) for row in rows])
    console.print(guard_table(comparisons, before.code))
    if any(one.lost for one in comparisons):
        raise SystemExit(1)


Counts = Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")]
# Of each worker, where nothing is said: on a CPU, and on a GPU.
USUAL_EPISODES, USUAL_BATCHES = 8, 600


def bench_scaling(
    *,
    workers: Counts = (),
    shards: Counts = (),
    ray: Counts = (),
    episodes_per_worker: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    cores_each: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    out: JsonFile = None,
) -> None:
    """Measure episodes per second of one worker and of several, each with as many cores and episodes, once all is
    compiled.

    Args:
      workers: numbers of worker processes on the CPU, as "1 16".
      shards: numbers of GPUs, a process with --shard for each.
      ray: numbers of GPUs, all in one process with --cluster ray.
      episodes_per_worker: 8 by default, and 600 of a GPU, where they are rounded up to all 200 scenes with some seeds.
      cores_each: of each worker or GPU; by default what each has where there are most of them.
      out: file for a line of JSON for each number, added to those that are there.
    """
    import jax
    from rich.console import Console

    from mechsearch_jax.benchmarks.parts import scaling
    from mechsearch_jax.workspace.scenario import load_scenario

    counts = {"workers": workers, "shards": shards, "ray": ray}
    if not any(counts.values()):
        raise InputError(
            "bench scaling: nothing is to be measured; give --workers, --shards or --ray, as --workers 1 16"
        )
    at_least_one("bench scaling", episodes_per_worker=episodes_per_worker, cores_each=cores_each)
    for name, numbers in counts.items():
        at_least_one("bench scaling", **{name: min(numbers, default=None)})
    check_files(out)
    # The GPUs are the workers'.
    jax.config.update("jax_platforms", "cpu")
    episodes = {"workers": episodes_per_worker or USUAL_EPISODES}
    scenarios = list(map(load_scenario, files_of(scaling.scenes(episodes["workers"])))) if workers else []
    measured = [] if out is None else scaling.read_measured(out)
    console = Console(highlight=False)
    with console.status("starting") as status:
        if workers:
            scaling.keep_what_is_compiled(scenarios, status.update)
        for case in scaling.CASES:
            for count in counts[case]:
                share = cores_each or max(cores() // max(counts[case]), 1)
                if case == "workers":
                    result = scaling.measure_workers(scenarios, count, share, _command(), status.update)
                else:
                    of_gpu = episodes_per_worker or USUAL_BATCHES
                    result = scaling.measure_gpus(case, count, of_gpu, share, _command(), status.update)
                measured.append(result)
                if out is not None:
                    scaling.add_measured(result, out)
    console.print(scaling.scaling_table(measured))


COMMANDS = {"guard": bench_guard, "scaling": bench_scaling}
