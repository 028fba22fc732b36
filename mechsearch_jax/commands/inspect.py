"""`mechsearch inspect`: maps of f and g."""

from __future__ import annotations

from pathlib import Path

from mechsearch_jax.commands.options import DEFAULTS, EpisodeOptions, Scenarios, find_scenarios
from mechsearch_jax.runtime.errors import check_once


def inspect(
    scenarios: Scenarios,
    /,
    *,
    out: Path,
    seed: int = 0,
    options: EpisodeOptions = DEFAULTS,
) -> None:
    """Write maps of f and g at the start of scenarios, as NAME.npz and NAME.png.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets.
      out: folder for the maps.
      seed: of the recogniser.
      options: how the planner decides.
    """
    from rich.progress import track

    from mechsearch_jax.envs.episode.episodes import target_of
    from mechsearch_jax.envs.recording.pictures import inspect_scenario
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.runtime.files import check_writable
    from mechsearch_jax.viz.drawing import save_figure
    from mechsearch_jax.viz.maps import save_maps
    from mechsearch_jax.workspace.scenario import load_scenario

    options.only_native("inspect")
    options.without_mismatch("inspect")
    (method,) = options.methods(("search-for-grasp",))
    workcell = method.workcell
    loaded = [load_scenario(file, workcell.shelf) for file in find_scenarios(scenarios)]
    check_once("inspect: two scenes, and their maps,", (scene.name for scene in loaded))
    scenes = {scene.name: scene for scene in loaded}
    check_writable(out)
    keep_compilations()
    targets = {name: target_of(scene, workcell.target) for name, scene in scenes.items()}
    problems = {target: workcell.problem(target, method.config.problem) for target in set(targets.values())}
    for scene in track(scenes.values(), "inspecting"):
        target = targets[scene.name]
        maps, figure = inspect_scenario(scene, problems[target], method.recogniser(target), seed)
        save_maps(maps, out / f"{scene.name}.npz")
        save_figure(figure, out / f"{scene.name}.png")
    print(f"{len(scenes)} scenario{'s' if len(scenes) > 1 else ''} inspected: {out}")
