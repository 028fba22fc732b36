"""`mechsearch evaluate`: many episodes."""

from __future__ import annotations

import math
import sys
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


def parsed_shard(text: str | None) -> tuple[int, int]:
    """The numbers K and N of "K/N"; 1 and 1 where nothing is given.

    Raises:
      InputError: it is something else.
    """
    parts = (text or "1/1").split("/")
    if len(parts) != 2 or not all(part.isdecimal() for part in parts) or not 1 <= int(parts[0]) <= int(parts[1]):
        raise InputError(f"evaluate: --shard {text} is not K/N with K from 1 to N, as 2/8")
    return int(parts[0]), int(parts[1])


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
    shard: Annotated[str | None, tyro.conf.arg(metavar="K/N")] = None,
    retry_errors: bool = False,
    time_limit: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None,
    options: EpisodeOptions = DEFAULTS,
) -> None:
    """Run many episodes; killed and started again, it goes on where it stopped.

    On a GPU they run in batches in this process, on a CPU one after the other in worker processes. The same command can
    be started several times, also on machines that share the folder: they divide the episodes among them.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets.
      out: folder for the results, one row for each episode; those of which it holds a row are not run again.
      method: one or more; search-for-grasp by default.
      policy: instead of methods, names of policies ("random" is one more), or import paths of others, one or more.
      seed: one or more.
      workers: number of processes, which use the CPU; by default one for each core, where there is no GPU.
      batch: number of episodes that run at the same time in this process; by default, on a GPU, what its memory holds.
      shard: run only the K-th of N parts of the episodes, as on machines that share no folder.
      retry_errors: run the episodes again whose row is an error.
      time_limit: of an episode in a worker process; one that takes longer is killed, and its row is an error. 3600 by
        default.
      options: how the planner decides.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.batches import Batches
    from mechsearch_jax.benchmarks.evaluate import evaluate, make_jobs, shard_of
    from mechsearch_jax.benchmarks.processes import TIME_LIMIT, Processes
    from mechsearch_jax.benchmarks.tables import EpisodeProgress, rates_table
    from mechsearch_jax.planner.cache import keep_compilations

    policies = chosen_policies("evaluate", method, policy)
    at_least_one("evaluate", workers=workers, batch=batch)
    if workers is not None and batch is not None:
        raise InputError("evaluate: give either --workers or --batch, not both")
    if workers is not None and options.simulator == "mjx":
        raise InputError("evaluate: --workers run the native simulator; leave --workers out, or --simulator mjx")
    parts = parsed_shard(shard)
    in_processes = workers is not None or (batch is None and options.simulator != "mjx" and not has_gpu())
    if time_limit is not None and not in_processes:
        raise InputError(
            "evaluate: --time-limit is for worker processes, not for batches; leave it out, or --workers N"
        )
    if time_limit is not None and not 0 < time_limit < math.inf:
        raise InputError(f"evaluate: --time-limit {time_limit:g} must be a number of seconds above 0")
    engine = "NativeSimulator" if in_processes else options.engine()
    jobs = make_jobs(find_scenarios(scenarios), options.methods(policies, engine), seed)
    jobs = shard_of(jobs, *parts)
    console = Console(highlight=False)
    with EpisodeProgress(console, len(jobs)) as progress:
        if in_processes:
            runner = Processes(workers or cores(), time_limit or TIME_LIMIT)
        else:
            keep_compilations()
            runner = Batches(batch, progress.busy)
        rows = evaluate(jobs, out, runner, progress.ended, progress.waiting, retry_errors)
    if rows:
        console.print(rates_table(rows))
    if errors := sum(row.is_error for row in rows):
        print(
            f"evaluate: {errors} of {len(rows)} episodes ended in an error; --retry-errors runs them again",
            file=sys.stderr,
        )
    console.print(str(out), soft_wrap=True)
