"""`mechsearch scenarios`: list scene sets, generate, check and import scenario files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mechsearch_jax.commands.given_target import USUAL_TARGET, GivenTarget
from mechsearch_jax.commands.options import (
    ConfigFile,
    Scenarios,
    at_least_one,
    find_scenarios,
    settings_of,
    tell_strange,
)
from mechsearch_jax.runtime.errors import InputError

if TYPE_CHECKING:
    from mechsearch_jax.problem.settings import Settings
    from mechsearch_jax.workspace.target import Target


def list_sets() -> None:
    """List the named sets of scenes: how many scenes, with how many objects, and what they hold."""
    from rich.console import Console

    from mechsearch_jax.benchmarks.report.console_tables import scene_sets_table

    Console(highlight=False).print(scene_sets_table())


def generate(
    *,
    objects: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    scene_set: Annotated[str | None, tyro.conf.arg(name="set", metavar="NAME")] = None,
    out: Path,
    count: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    hides: Annotated[GivenTarget, tyro.conf.arg(name="")] = USUAL_TARGET,
    seed: Annotated[int | None, tyro.conf.arg(metavar="SEED")] = None,
    config: ConfigFile = None,
) -> None:
    """Generate scenarios: objects dropped on the shelf, and a target that the camera cannot see.

    Args:
      objects: surrounding objects in each.
      scene_set: instead, the name of a set of scenes (mechsearch scenarios list).
      out: folder for the files.
      count: number of scenarios; 1 if not given.
      hides: the target.
      seed: of the first scenario, 0 if not given; the next ones follow.
      config: a file of settings, of which camera, shelf, gripper, target and objects count.
    """
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.runtime.files import check_writable

    if (objects is None) == (scene_set is None):
        raise InputError("scenarios generate: give either --objects N or --set NAME, not both")
    if scene_set is not None and (hides.given or (count, seed, config) != (None,) * 3):
        raise InputError(
            "scenarios generate: --count, --target and --seed are not for a set, which has its own, nor is --config"
        )
    at_least_one("scenarios generate", count=count)
    if scene_set is not None:
        made = _generate_set(scene_set, out)
    else:
        settings = settings_of(config)
        check_writable(out)
        keep_compilations()
        made = count or 1
        _generate_more(range(seed or 0, (seed or 0) + made), objects or 0, settings, hides.load(), out)
    print(f"{made} scenario{'s' if made > 1 else ''} generated: {out}")


def _generate_more(seeds: range, objects: int, settings: Settings, target: str | Target | None, out: Path) -> None:
    from rich.progress import track

    from mechsearch_jax.envs.scenes.generator import ScenarioGenerator
    from mechsearch_jax.workspace.scenario import save_scenario

    generator = ScenarioGenerator.of(settings, target)
    for seed in track(seeds, "generating"):
        scenario = generator.generate(seed, objects)
        save_scenario(scenario, out / f"{scenario.name}.json")


def _generate_set(name: str, out: Path) -> int:
    """Write a set's scenes into a folder; how many they are."""
    from rich.progress import track

    from mechsearch_jax.envs.scenes.scene_sets import find_set, holds, scene_files, set_scenes
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.runtime.files import check_writable

    scenes = set_scenes(find_set(name))
    for block, index in scenes:
        file = out / f"{block.scene_name(index)}.json"
        if file.exists() and not holds(file, block, index):
            raise InputError(f"{file}: is there already and holds something else; give another folder")
    check_writable(out)
    keep_compilations()
    tell_strange(scene_files(scenes, out, lambda missing: track(missing, "generating")).strange)
    return len(scenes)


def check(scenarios: Scenarios, /, *, config: ConfigFile = None) -> None:
    """Check scenario files: what is malformed, and bodies that cannot stand where they are, are named with the reason.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets.
      config: a file of settings, of which the shelf counts.
    """
    from mechsearch_jax.envs.scenes.standing import faults
    from mechsearch_jax.envs.simulators.native import NativeWorld
    from mechsearch_jax.workspace.scenario import load_scenario
    from mechsearch_jax.workspace.shelf import Shelf

    shelf = Shelf() if config is None else settings_of(config).workcell.shelf
    world, bad = NativeWorld(shelf), 0
    for file in find_scenarios(scenarios):
        try:
            scenario = load_scenario(file, shelf)
            wrong = [f"{file}: {fault}" for fault in faults(scenario, world)]
        except InputError as error:
            wrong = [str(error)]
        for line in wrong:
            print(line, file=sys.stderr)
        bad += bool(wrong)
        if not wrong:
            print(f"{file}: {len(scenario.objects)} objects, target {scenario.target.shape}")
    if bad:
        raise SystemExit(2)


def import_published(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")], /, *, out: Path
) -> None:
    """Make scenario files of the scenes that the paper's authors published, from a copy of their repository.

    Args:
      folder: exp_configs of their repository, which holds objects_N/initial_scenario_K.pkl.
      out: folder for the files.
    """
    from mechsearch_jax.envs.scenes.published import published_files, read_published
    from mechsearch_jax.runtime.files import check_writable
    from mechsearch_jax.workspace.scenario import save_scenario

    scenarios = [read_published(file) for file in published_files(folder)]
    check_writable(out)
    for scenario in scenarios:
        save_scenario(scenario, out / f"{scenario.name}.json")
    print(f"{len(scenarios)} scenarios: {out}")


COMMANDS = {"list": list_sets, "generate": generate, "check": check, "import": import_published}
