"""`mechsearch doctor` and `mechsearch config`: what is usable here, and what can be set."""

from __future__ import annotations

from typing import Annotated

import tyro

from mechsearch_jax.commands.options import ConfigFile, find_scenario, settings_of


def doctor(
    scenario: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENARIO")] = "first-light",
    /,
    *,
    config: ConfigFile = None,
) -> None:
    """Tell what is usable on this machine, and what to do about what is not; status 1 if nothing can be searched.

    Args:
      scenario: whose problem is looked for in the cache; first-light if not given.
      config: a file of settings, that it would be built with.
    """
    from rich.console import Console

    from mechsearch_jax.envs.health import State, checks, examine
    from mechsearch_jax.workspace.scenario import load_scenario

    settings = settings_of(config)
    scene = load_scenario(find_scenario(scenario), settings.workcell.shelf)
    console = Console(highlight=False, markup=False)
    broken = False
    for subject, check in checks(scene, settings).items():
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
    from mechsearch_jax.planner.settings import example_config

    print(example_config(), end="")
