"""`mechsearch search`: one episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mechsearch_jax.commands.given_target import USUAL_TARGET, GivenTarget
from mechsearch_jax.commands.options import (
    DEFAULTS,
    USUAL_POLICY,
    DecidedBy,
    EpisodeOptions,
    find_scenario,
)
from mechsearch_jax.commands.recordings import make_film, make_page
from mechsearch_jax.runtime.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.status import Status

    from mechsearch_jax.envs.episode.method import Method
    from mechsearch_jax.envs.episode.records import Episode
    from mechsearch_jax.envs.recording.narration import Narrator
    from mechsearch_jax.envs.recording.recording import Recorder, Recording
    from mechsearch_jax.observation import Observation
    from mechsearch_jax.planner import Problem
    from mechsearch_jax.problem.settings import Settings
    from mechsearch_jax.session.preparing import Preparing
    from mechsearch_jax.workspace.scenario import Scenario
    from mechsearch_jax.workspace.shelf import Shelf


@dataclasses.dataclass(frozen=True)
class Generated:
    """A scene that is made.

    Attributes:
      objects: instead of a scenario, generate one with so many objects.
      hides: the target.
    """

    objects: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    hides: Annotated[GivenTarget, tyro.conf.arg(name="")] = USUAL_TARGET


@dataclasses.dataclass(frozen=True)
class OutputFiles:
    """What is written beside what is always.

    Attributes:
      record: also write recording.npz, what moved and what was believed, of which `mechsearch video` makes a film.
      video: make the film at once, too; it is recorded then.
      page: write the page of every step's pictures and values, see `mechsearch view --save`; it is recorded then.
    """

    record: bool = False
    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE.mp4|FILE.webp", help_behavior_hint="")] = None
    page: Annotated[Path | None, tyro.conf.arg(metavar="FILE.html", help_behavior_hint="")] = None

    @property
    def records(self) -> bool:
        """Whether the episode is recorded."""
        return self.record or self.video is not None or self.page is not None

    def check(self) -> None:
        """Fail before the work begins, if a film or a page cannot be written.

        Raises:
          InputError: it cannot.
        """
        from mechsearch_jax.runtime.files import check_writable
        from mechsearch_jax.viz.movie import check_movie_path

        if self.video is not None:
            check_movie_path(self.video)
            check_writable(self.video.parent)
        if self.page is not None:
            from mechsearch_jax.envs.page.page import check_page_path

            check_page_path(self.page)
            check_writable(self.page.parent)

    def make(self, recording: Recording, console: Console) -> None:
        """Make the film and the page that are wanted of a recording.

        Raises:
          InputError: one cannot be written.
        """
        if self.video is not None:
            make_film(recording, self.video, console)
        if self.page is not None:
            make_page(recording, self.page, console, self.video)


def _save(out: Path, scene: Scenario, episode: Episode, problem: Problem, narrator: Narrator) -> None:
    """Write the filmstrip, the scenario and the episode."""
    from mechsearch_jax.envs.episode.endings import verdict
    from mechsearch_jax.envs.episode.records import save_episode
    from mechsearch_jax.viz.drawing import save_figure
    from mechsearch_jax.viz.filmstrip import filmstrip
    from mechsearch_jax.workspace.scenario import save_scenario

    strip = filmstrip(narrator.frames, problem.camera, problem.shelf, problem.target, verdict(episode))
    save_figure(strip, out / "filmstrip.png")
    save_scenario(scene, out / "scenario.json")
    save_episode(episode, out / "episode.json")


def _run(
    status: Status, preparing: Preparing, chosen: Method, scene: Scenario, problem: Problem, seed: int, records: bool
) -> tuple[Episode, Narrator, Recorder]:
    """Run the episode; return it with its narrator and its recorder, which keeps evidence if `records`."""
    from mechsearch_jax.envs.episode.closed_loop import RunSettings, Start
    from mechsearch_jax.envs.episode.episodes import run_episode
    from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
    from mechsearch_jax.session.preparing import decision, retrieval

    policy, workcell = chosen.policy(), chosen.workcell
    there, seen = _expected(scene, chosen.recognition)
    preparing.add(decision(problem, policy, seen))
    # These take long to import; meanwhile the first decision's program is read or compiled.
    from mechsearch_jax.envs.episode import verdicts
    from mechsearch_jax.envs.recording import evidence
    from mechsearch_jax.envs.recording.narration import Narrator
    from mechsearch_jax.envs.recording.recording import TRACE_EVERY, Recorder
    from mechsearch_jax.envs.simulators.native import NativeSimulator

    # Later steps need these, or most searches do.
    later = [*retrieval(problem, policy, seen), *verdicts.programs(problem, there.objects)]
    if records:
        later += evidence.programs(problem, seen.objects, there.objects)
    preparing.add(later, optional=True)
    simulator = NativeSimulator(
        config=SimulatorConfig(trace_every=TRACE_EVERY), shelf=workcell.shelf, camera=workcell.camera
    )
    recorder = Recorder(simulator, problem if records else None)
    narrator = Narrator(status.console, status, problem, recorder.note)
    settings = RunSettings(
        recogniser=chosen.recogniser(problem.target),
        max_steps=chosen.config.max_steps,
        options=chosen.options(),
        trials=chosen.trials(),
    )
    start = Start(scene, seed, mismatch=chosen.mismatch)
    episode = run_episode(start, problem, policy, simulator, settings, narrator)
    return episode, narrator, recorder


def _expected(scene: Scenario, recognition: str) -> tuple[Observation, Observation]:
    """Observations of nothing with the shapes of what is there and of what is recognised: programs depend on whether
    bodies have parts."""
    from mechsearch_jax.geometry.bodies import PARTS
    from mechsearch_jax.session.preparing import nothing_seen

    there = nothing_seen(PARTS if any(body.compound for body in scene.objects) else None)
    if recognition in ("oracle", "informed"):
        return there, there
    return there, nothing_seen(PARTS if recognition.endswith("-parts") else None)


def search(
    scenario: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENARIO")] = None,
    /,
    *,
    generated: Annotated[Generated, tyro.conf.arg(name="")] = Generated(),
    decides: DecidedBy = USUAL_POLICY,
    seed: int = 0,
    out: Path,
    keeps: Annotated[OutputFiles, tyro.conf.arg(name="")] = OutputFiles(),
    options: EpisodeOptions = DEFAULTS,
) -> None:
    """Run one episode: look, decide, act, until the target is found, graspable and taken out.

    Args:
      scenario: a scenario file, or the name of one that ships with the package or is in a scene set, as c2-4-017.
      generated: what is generated instead.
      decides: the policy.
      seed: of the planner, of the environment, and of a generated scenario.
      out: folder for episode.json, filmstrip.png and the scenario.
      keeps: what else is written.
      options: how the planner decides.
    """
    from rich.console import Console
    from rich.markup import escape

    from mechsearch_jax.envs.episode.episodes import target_of
    from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.runtime.files import check_writable
    from mechsearch_jax.session.preparing import Preparing, motions

    if (scenario is None) == (generated.objects is None):
        raise InputError("search: give either a scenario or --objects N, not both")
    if scenario is not None and generated.hides.given:
        raise InputError("search: --target is for a generated scenario; a scenario file says itself what its target is")
    options.only_native("search")
    (chosen,) = options.methods(decides.chosen("search"))
    make_scene = _scene(scenario, generated, seed, options.settings(), chosen.workcell.shelf)
    keeps.check()
    check_writable(out)
    keep_compilations()
    console = Console(highlight=False)
    with console.status("preparing") as status:
        with Preparing(lambda text: console.print(text, style="dim")) as preparing:
            # They depend on nothing else, and are compiled while a mesh is cut, the scene made and the problem built.
            preparing.add(motions(SimulatorConfig().motion))
            scene = make_scene()
            console.print(
                f"[bold]{escape(scene.name)}[/bold]: {len(scene.objects)} objects hide a {scene.target.shape}; "
                f"{escape(chosen.name)}"
            )
            problem = chosen.workcell.problem(target_of(scene, chosen.workcell.target), chosen.config.problem)
            episode, narrator, recorder = _run(status, preparing, chosen, scene, problem, seed, keeps.records)
        # Imported late: they take long.
        from mechsearch_jax.envs.episode.endings import verdict
        from mechsearch_jax.envs.recording.recording import NAME, save_recording

        status.update("writing")
        _save(out, scene, episode, problem, narrator)
        recording = recorder.recording(problem, verdict(episode), episode)
        if keeps.records:
            save_recording(recording, out / NAME)
    narrator.ended(episode)
    console.print(f"{out / 'episode.json'}\n{out / 'filmstrip.png'}", soft_wrap=True, markup=False)
    keeps.make(recording, console)


def _scene(
    scenario: str | None, generated: Generated, seed: int, settings: Settings, shelf: Shelf
) -> Callable[[], Scenario]:
    """A function that makes the scene, which takes seconds where a mesh is cut; a scenario file is read immediately.

    Raises:
      InputError: a file cannot be used; that of a target raises it in the function.
    """
    from mechsearch_jax.envs.scenes.generator import ScenarioGenerator, check_numbers
    from mechsearch_jax.envs.scenes.standing import check_standing
    from mechsearch_jax.workspace.scenario import load_scenario

    if scenario is not None:
        file = find_scenario(scenario)
        loaded = load_scenario(file, shelf)
        check_standing({str(file): loaded}, shelf)
        return lambda: loaded
    objects = generated.objects or 0
    check_numbers(seed, objects)
    return lambda: ScenarioGenerator.of(settings, generated.hides.load()).generate(seed, objects)
