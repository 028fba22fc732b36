"""`mechsearch doctor` and `mechsearch config`: what is usable here, and what can be set."""

from __future__ import annotations

from typing import Annotated

import tyro

from mechsearch_jax.commands.options import ConfigFile, find_scenario, settings_of


def doctor(
    scenario: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENARIO")] = None,
    /,
    *,
    config: ConfigFile = None,
) -> None:
    """Tell what is usable on this machine, and what to do about what is not; status 1 if nothing can be searched.

    Args:
      scenario: whose problem is looked for in the cache; first-light if neither this nor a file is given.
      config: a file of settings, whose cell is looked at: camera, target, the arm's reach, the networks' view.
    """
    from rich.console import Console

    from mechsearch_jax.envs.health.cell_health import State, checks, examine
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.workspace.scenario import load_scenario

    settings = settings_of(config)
    name = scenario or (None if config else "first-light")
    scene = None if name is None else load_scenario(find_scenario(name), settings.workcell.shelf)
    if config is not None:
        keep_compilations()
    console = Console(highlight=False, markup=False)
    broken = False
    for subject, check in checks(scene, settings, cell=config is not None).items():
        for finding in examine(subject, check):
            broken |= finding.state is State.BROKEN
            console.print(f"{finding.subject:<10} {finding.state.value:<8} {finding.says}", soft_wrap=True)
            if finding.remedy:
                console.print(f"{'':<19} -> {finding.remedy}", soft_wrap=True)
    print("nothing can be searched here" if broken else "searching works here")
    if broken:
        raise SystemExit(1)


def print_config() -> None:
    """Print a configuration file with every key and its default, to be changed and given to others with --config."""
    from mechsearch_jax.problem.settings import example_config

    print(example_config(), end="")
