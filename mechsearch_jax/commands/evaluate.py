"""`mechsearch evaluate`: many episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from mechsearch_jax.commands.options import DEFAULTS, EpisodeOptions, PaperMethod, Scenarios, chosen_policies
from mechsearch_jax.commands.runs import USUAL_RUN, RunOptions, run_episodes_of


def evaluate(
    scenarios: Scenarios,
    /,
    *,
    out: Path,
    method: tuple[PaperMethod, ...] = (),
    policy: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME|MODULE:ATTRIBUTE ...")] = (),
    seed: tuple[int, ...] = (0,),
    run: Annotated[RunOptions, tyro.conf.arg(name="")] = USUAL_RUN,
    options: EpisodeOptions = DEFAULTS,
) -> None:
    """Run many episodes; killed and started again, it goes on where it stopped.

    On a GPU they run in batches in this process, on a CPU one after the other in worker processes. The same command can
    be started several times, also on machines that share the folder: they divide the episodes among them.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets.
      out: folder for the results, one row for each episode; those of which it holds a row are not run again.
      method: one or more; search-for-grasp by default.
      policy: instead of methods, names of policies (also random, greedy), or import paths of others, one or more.
      seed: one or more.
      run: how the episodes are run.
      options: how the planner decides.
    """
    policies = chosen_policies("evaluate", method, policy)
    run_episodes_of("evaluate", scenarios, [options], policies, seed, out, run)
