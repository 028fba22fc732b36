"""`mechsearch evaluate`: many episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from mechsearch_jax.commands.options import (
    DEFAULTS,
    EpisodeOptions,
    PaperMethod,
    Scenarios,
    at_least_one,
    chosen_policies,
    find_scenarios,
    has_gpu,
)
from mechsearch_jax.cores import cores
from mechsearch_jax.errors import InputError


def evaluate(
    scenarios: Scenarios,
    /,
    *,
    out: Path,
    method: tuple[PaperMethod, ...] = (),
    policy: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME|MODULE:ATTRIBUTE ...")] = (),
    seed: tuple[int, ...] = (0,),
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    batch: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    options: EpisodeOptions = DEFAULTS,
) -> None:
    """Run many episodes; killed and started again, it goes on where it stopped.

    On a GPU they run in batches in this process, on a CPU one after the other in worker processes.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets.
      out: Parquet file with one row for each episode; rows that it already holds are not run again.
      method: one or more; search-for-grasp by default.
      policy: instead of methods, names of policies ("random" is one more), or import paths of others, one or more.
      seed: one or more.
      workers: number of processes, which use the CPU; by default one for each core, where there is no GPU.
      batch: number of episodes that run at the same time in this process; by default, on a GPU, what its memory holds.
      options: how the planner decides.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.batches import Batches
    from mechsearch_jax.benchmarks.evaluate import evaluate, make_jobs
    from mechsearch_jax.benchmarks.processes import Processes
    from mechsearch_jax.benchmarks.tables import EpisodeProgress, rates_table
    from mechsearch_jax.planner.cache import keep_compilations

    policies = chosen_policies("evaluate", method, policy)
    at_least_one("evaluate", workers=workers, batch=batch)
    if workers is not None and batch is not None:
        raise InputError("evaluate: give either --workers or --batch, not both")
    if workers is not None and options.simulator == "mjx":
        raise InputError("evaluate: --workers run the native simulator; leave --workers out, or --simulator mjx")
    in_processes = workers is not None or (batch is None and options.simulator != "mjx" and not has_gpu())
    engine = "NativeSimulator" if in_processes else options.engine()
    jobs = make_jobs(find_scenarios(scenarios), options.methods(policies, engine), seed)
    console = Console(highlight=False)
    with EpisodeProgress(console, len(jobs)) as progress:
        if in_processes:
            runner = Processes(workers or cores())
        else:
            keep_compilations()
            runner = Batches(batch, progress.busy)
        rows = evaluate(jobs, out, runner, progress.ended)
    console.print(rates_table(rows))
    console.print(str(out), soft_wrap=True)
