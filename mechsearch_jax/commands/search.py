"""`mechsearch search`: one episode."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mechsearch_jax.commands.options import (
    DEFAULTS,
    EpisodeOptions,
    GivenShape,
    OneMethod,
    OnePolicy,
    chosen_policies,
    find_scenario,
)
from mechsearch_jax.commands.video import make_film
from mechsearch_jax.runtime.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console
    from rich.status import Status

    from mechsearch_jax.envs.episode.method import Method
    from mechsearch_jax.envs.episode.records import Episode
    from mechsearch_jax.envs.recording.narration import Narrator
    from mechsearch_jax.envs.recording.recording import Recorder
    from mechsearch_jax.planner import Problem
    from mechsearch_jax.workspace.scenario import Scenario


def _check_scene(scenario: str | None, objects: int | None, target: str | None) -> None:
    """Refuse what does not say one scene."""
    if (scenario is None) == (objects is None):
        raise InputError("search: give either a scenario or --objects N, not both")
    if scenario is not None and target is not None:
        raise InputError("search: --target is for a generated scenario; a scenario file says itself what its target is")


def _save(out: Path, scene: Scenario, episode: Episode, strip: Figure) -> None:
    """Write what there is of every episode."""
    from mechsearch_jax.envs.episode.records import save_episode
    from mechsearch_jax.viz.drawing import save_figure
    from mechsearch_jax.workspace.scenario import save_scenario

    save_figure(strip, out / "filmstrip.png")
    save_scenario(scene, out / "scenario.json")
    save_episode(episode, out / "episode.json")


def _run(
    console: Console, status: Status, chosen: Method, scene: Scenario, problem: Problem, seed: int
) -> tuple[Episode, Narrator, Recorder]:
    """Run the episode; what was told of it, and what was recorded."""
    from mechsearch_jax.envs.episode.episodes import run_episode
    from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
    from mechsearch_jax.session.preparing import first_decision, prepared

    policy, workcell = chosen.policy(), chosen.workcell
    first = first_decision(problem, policy, SimulatorConfig().motion)
    with prepared(first, lambda text: console.print(text, style="dim")):
        # These take long to import, and meanwhile what the first decision needs is read or compiled.
        from mechsearch_jax.envs.camera.recognisers import recogniser
        from mechsearch_jax.envs.recording.narration import Narrator
        from mechsearch_jax.envs.recording.recording import TRACE_EVERY, Recorder
        from mechsearch_jax.envs.simulators.native import NativeSimulator

        simulator = NativeSimulator(
            config=SimulatorConfig(trace_every=TRACE_EVERY), shelf=workcell.shelf, camera=workcell.camera
        )
        recorder = Recorder(simulator)
        narrator = Narrator(console, status, problem, recorder.note)
        episode = run_episode(
            seed,
            scene,
            problem,
            policy,
            simulator,
            recogniser(chosen.recognition, problem.target),
            chosen.config.max_steps,
            chosen.options(),
            narrator,
            chosen.terms,
            chosen.trials(),
        )
    return episode, narrator, recorder


def search(
    scenario: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENARIO")] = None,
    /,
    *,
    objects: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    target: GivenShape = None,
    method: OneMethod = None,
    policy: OnePolicy = None,
    seed: int = 0,
    out: Path,
    record: bool = False,
    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE.mp4|FILE.webp")] = None,
    options: EpisodeOptions = DEFAULTS,
) -> None:
    """Run one episode: look, decide, act, until the target is found, graspable and taken out.

    Args:
      scenario: a scenario file, or the name of one that ships with the package or is in a scene set, as c2-4-017.
      objects: instead of a scenario, generate one with so many objects.
      target: shape of a generated target; a cylinder, or what the configuration file says, if not given.
      method: "search-for-grasp", the default, minds the grasp while it searches, "search-and-grasp" only afterwards.
      policy: instead of a method, the name of a policy (also random, greedy, mctx), or the import path of another.
      seed: of the planner, of the environment, and of a generated scenario.
      out: folder for episode.json, filmstrip.png and the scenario.
      record: also write recording.npz, what moved and what was believed, of which `mechsearch video` makes a film.
      video: make the film at once, too; it is recorded then.
      options: how the planner decides.
    """
    from rich.console import Console

    from mechsearch_jax.envs.episode.episodes import target_of
    from mechsearch_jax.envs.scenes.generator import ScenarioGenerator
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.runtime.files import check_writable
    from mechsearch_jax.viz.movie import check_movie_path
    from mechsearch_jax.workspace.scenario import load_scenario

    _check_scene(scenario, objects, target)
    options.only_native("search")
    (chosen,) = options.methods(chosen_policies("search", method and (method,), policy and (policy,)))
    settings, workcell = options.settings(), chosen.workcell
    known = load_scenario(find_scenario(scenario), workcell.shelf) if scenario is not None else None
    if video is not None:
        check_movie_path(video)
        check_writable(video.parent)
    check_writable(out)
    keep_compilations()
    console = Console(highlight=False)
    with console.status("preparing") as status:
        scene = known or ScenarioGenerator.of(settings, target).generate(seed, objects or 0)
        console.print(
            f"[bold]{scene.name}[/bold]: {len(scene.objects)} objects hide a {scene.target.shape}; {chosen.name}"
        )
        problem = workcell.problem(target_of(scene, workcell.target), chosen.problem_config)
        episode, narrator, recorder = _run(console, status, chosen, scene, problem, seed)
        # Not before: these take long to import.
        from mechsearch_jax.envs.recording.narration import verdict
        from mechsearch_jax.envs.recording.recording import NAME, save_recording
        from mechsearch_jax.viz.filmstrip import filmstrip

        status.update("writing")
        strip = filmstrip(narrator.frames, problem.camera, problem.shelf, problem.target, verdict(episode))
        _save(out, scene, episode, strip)
        recording = recorder.recording(problem, verdict(episode))
        if record or video is not None:
            save_recording(recording, out / NAME)
    narrator.ended(episode)
    console.print(f"{out / 'episode.json'}\n{out / 'filmstrip.png'}", soft_wrap=True)
    if video is not None:
        make_film(recording, video, console)
