"""`mechsearch scenarios`: generate and check scenario files."""

from __future__ import annotations

import sys
from pathlib import Path

from mechsearch_jax.commands.options import Scenarios, TargetShape, at_least_one, find_scenarios
from mechsearch_jax.errors import InputError


def generate(*, objects: int, out: Path, count: int = 1, target: TargetShape = "cylinder", seed: int = 0) -> None:
    """Generate scenarios: objects dropped on the shelf, and a target that the camera cannot see.

    Args:
      objects: surrounding objects in each.
      out: folder for the files.
      count: number of scenarios.
      target: shape of the target.
      seed: of the first scenario; the next ones follow.
    """
    from rich.progress import track

    from mechsearch_jax.envs.generator import ScenarioGenerator
    from mechsearch_jax.files import check_writable
    from mechsearch_jax.planner.cache import keep_compilations
    from mechsearch_jax.workspace.scenario import save_scenario
    from mechsearch_jax.workspace.target import Target

    at_least_one("scenarios generate", count=count)
    check_writable(out)
    keep_compilations()
    generator = ScenarioGenerator(Target.of(target))
    for i in track(range(seed, seed + count), "generating"):
        scenario = generator.generate(i, objects)
        save_scenario(scenario, out / f"{scenario.name}.json")
    print(f"{count} scenario{'s' if count > 1 else ''} generated: {out}")


def check(scenarios: Scenarios, /) -> None:
    """Check scenario files; every one that is malformed is named with its reason.

    Args:
      scenarios: scenario files, folders of them, or names of shipped ones.
    """
    from mechsearch_jax.workspace.scenario import load_scenario

    bad = 0
    for file in find_scenarios(scenarios):
        try:
            scenario = load_scenario(file)
        except InputError as error:
            print(error, file=sys.stderr)
            bad += 1
        else:
            print(f"{file}: {len(scenario.objects)} objects, target {scenario.target.shape}")
    if bad:
        raise SystemExit(2)


COMMANDS = {"generate": generate, "check": check}
