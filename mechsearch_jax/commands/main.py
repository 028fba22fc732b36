"""The command line: parse, call, print. `mechsearch --help` tells what there is.

Bad input ends a command with one line on standard error and status 2, and leaves existing output as it is. What a
command needs is imported when it runs, so that help and mistakes are answered at once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import gc
import io
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from mechsearch_jax.errors import InputError

if TYPE_CHECKING:
    from mechsearch_jax.benchmarks.bench import Timing
    from mechsearch_jax.planner import PlannerConfig

Method = Literal["search-for-grasp", "search-and-grasp"]
Actions = Literal["both", "push", "pick-and-place"]
Recognition = Literal["oracle", "masks", "full"]
PushModel = Literal["quasi-static", "learned", "physics"]
TargetShape = Literal["cylinder", "box"]


@dataclasses.dataclass(frozen=True)
class PlannerOptions:
    """How the planner decides. What is not given is the preset's.

    Attributes:
      preset: where settings come from that are not given; "best" stands for the best known ones, which so far are
        the same as "paper".
      gamma: discount of later actions, above 0 and at most 1; the paper's is 0.9.
      horizon: actions in a sequence; the paper's is 3.
      sequences: sequences that are sampled for a decision; 30 by default.
      actions: which actions are used; both by default.
      criterion: what makes a target visible; "detector", the default, counts pixels as the detector does.
      focus: share of the sampled actions that go to objects by how much they hide or are in the way, 0.7 by default;
        0 is the paper's even draw.
      push_model: what predicts pushes: "learned", the default, by a network, "quasi-static" by geometry, "physics" by
        simulating them, on a CPU only those that come first.
      topple_charge: what a push costs, as a share of the cost J, times how many objects are expected to fall over; 0 by
        default. One after which an object falls with more than 0.5 is never made.
      max_steps: actions in an episode; 10 by default.
      recognition: what the planner sees the objects through: "oracle" knows their true shapes and poses; the others see
        a noisy depth image, "masks" with the true segmentation, "full" without.
      simulator: what executes the actions: MuJoCo in C ("native") or on the GPU ("mjx"); "auto" takes the latter for
        batches where there is a GPU.
    """

    preset: Literal["paper", "best"] = "paper"
    gamma: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    horizon: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    sequences: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    actions: Annotated[Actions | None, tyro.conf.arg(metavar="{both,push,pick-and-place}")] = None
    criterion: Annotated[
        Literal["detector", "depth-mse", "depth-norm"] | None,
        tyro.conf.arg(metavar="{detector,depth-mse,depth-norm}"),
    ] = None
    focus: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    push_model: Annotated[PushModel | None, tyro.conf.arg(metavar="{quasi-static,learned,physics}")] = None
    topple_charge: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    max_steps: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    recognition: Recognition = "oracle"
    simulator: Literal["auto", "native", "mjx"] = "auto"

    def config(self, method: Method) -> PlannerConfig:
        """The planner's configuration: the preset's, with what is given in its place.

        Raises:
          InputError: an option is impossible, or the push model cannot be used.
        """
        from mechsearch_jax.envs.push_models import push_models
        from mechsearch_jax.planner import PlannerConfig

        presets = {"paper": PlannerConfig.paper, "best": PlannerConfig.paper}
        names = (
            "gamma",
            "horizon",
            "sequences",
            "actions",
            "criterion",
            "focus",
            "push_model",
            "topple_charge",
            "max_steps",
        )
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        config = presets[self.preset](method=method, **given)
        # Missing weights are to be told of now, not by every episode.
        push_models(config.push_model)
        return config

    def engine(self) -> str:
        """The class of the simulator that runs many episodes.

        Raises:
          InputError: it is not installed.
        """
        from mechsearch_jax.envs.mjx_simulator import import_mjx

        if self.simulator == "native" or (self.simulator == "auto" and not has_gpu()):
            return "NativeSimulator"
        if self.simulator == "mjx":
            import_mjx()
            return "MjxSimulator"
        try:
            import_mjx()
        except InputError as error:
            print(f"mechsearch: {error}; using the native simulator", file=sys.stderr)
            return "NativeSimulator"
        return "MjxSimulator"

    def only_native(self, command: str) -> None:
        """Refuse the batch simulator where one episode is run.

        Raises:
          InputError: it was asked for.
        """
        if self.simulator == "mjx":
            raise InputError(
                f"{command}: --simulator mjx is for batches (mechsearch evaluate); leave it out for one episode"
            )


def has_gpu() -> bool:
    """Whether JAX computes on something else than the CPU."""
    import jax

    return jax.default_backend() != "cpu"


Options = Annotated[PlannerOptions, tyro.conf.arg(name="")]
Scenarios = Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SCENARIO|FOLDER ...")]

JsonFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
WeightsFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE.npz")]


def at_least_one(command: str, **options: int | None) -> None:
    """Refuse counts below 1; None stands for what is not given.

    Raises:
      InputError: one is.
    """
    for name, value in options.items():
        if value is not None and value < 1:
            raise InputError(f"{command}: --{name.replace('_', '-')} {value} must be at least 1")


def find_scenario(name: str) -> Path:
    """The file that a scenario's path, or the name of one that ships with the package, stands for.

    Raises:
      InputError: there is neither.
    """
    from mechsearch_jax.workspace.scenario import example_scenarios

    shipped = example_scenarios()
    if Path(name).is_file():
        return Path(name)
    if name in shipped:
        return shipped[name]
    raise InputError(f"{name}: there is no such file, nor a shipped scenario of that name ({', '.join(shipped)})")


def find_scenarios(names: Sequence[str]) -> list[Path]:
    """The files that paths, folders and names stand for.

    In a folder, JSON files that are plainly something else, as the episode.json that `search` writes beside its
    scenario, are left out; each is named on standard error.

    Raises:
      InputError: there is nothing for one of them.
    """
    from mechsearch_jax.workspace.scenario import is_another_format

    files: list[Path] = []
    for name in names:
        if Path(name).is_dir():
            inside = sorted(Path(name).glob("*.json"))
            others = [file for file in inside if is_another_format(file)]
            for file in others:
                print(f"{file}: is not a scenario file and is left out", file=sys.stderr)
            inside = [file for file in inside if file not in others]
            if not inside:
                raise InputError(f"{name}: there are no scenario files (*.json) in this folder")
            files += inside
        else:
            files.append(find_scenario(name))
    if not files:
        raise InputError("no scenario is given; name a file, a folder or a shipped scenario")
    return files


def search(
    scenario: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENARIO")] = None,
    /,
    *,
    objects: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    target: Annotated[TargetShape | None, tyro.conf.arg(metavar="{cylinder,box}")] = None,
    method: Method = "search-for-grasp",
    seed: int = 0,
    out: Path,
    options: Options = PlannerOptions(),
) -> None:
    """Run one episode: look, decide, act, until the target is found, graspable and taken out.

    Args:
      scenario: a scenario file, or the name of one that ships with the package.
      objects: instead of a scenario, generate one with so many objects.
      target: shape of a generated target; a cylinder if not given.
      method: "search-for-grasp" minds the grasp while it searches, "search-and-grasp" only afterwards.
      seed: of the planner, of the environment, and of a generated scenario.
      out: folder for episode.json, filmstrip.png and the scenario.
      options: how the planner decides.
    """
    from rich.console import Console

    from mechsearch_jax.cache import keep_compilations, kept_problem
    from mechsearch_jax.envs.episode import run_episode, target_of
    from mechsearch_jax.envs.generator import generate_scenario
    from mechsearch_jax.envs.narration import Narrator, verdict
    from mechsearch_jax.envs.recognisers import recogniser
    from mechsearch_jax.envs.records import save_episode
    from mechsearch_jax.envs.simulator import NativeSimulator
    from mechsearch_jax.files import check_writable
    from mechsearch_jax.viz.drawing import save_figure
    from mechsearch_jax.viz.filmstrip import filmstrip
    from mechsearch_jax.workspace.scenario import load_scenario, save_scenario

    if (scenario is None) == (objects is None):
        raise InputError("search: give either a scenario or --objects N, not both")
    if scenario is not None and target is not None:
        raise InputError("search: --target is for a generated scenario; a scenario file says itself what its target is")
    options.only_native("search")
    config = options.config(method)
    known = load_scenario(find_scenario(scenario)) if scenario is not None else None
    check_writable(out)
    keep_compilations()
    console = Console(highlight=False)
    with console.status("preparing") as status:
        scene = known or generate_scenario(seed, objects or 0, target or "cylinder")
        console.print(f"[bold]{scene.name}[/bold]: {len(scene.objects)} objects hide a {scene.target.shape}; {method}")
        problem = kept_problem(target_of(scene))
        narrator = Narrator(console, status, problem, config)
        eyes = recogniser(options.recognition, target_of(scene))
        episode = run_episode(
            seed, scene, problem, config, NativeSimulator(), eyes, options.recognition, watcher=narrator
        )
        status.update("writing")
        strip = filmstrip(narrator.frames, problem.camera, problem.shelf, problem.target, verdict(episode))
        save_figure(strip, out / "filmstrip.png")
        save_scenario(scene, out / "scenario.json")
        save_episode(episode, out / "episode.json")
    narrator.ended(episode)
    console.print(f"{out / 'episode.json'}\n{out / 'filmstrip.png'}", soft_wrap=True)


def inspect(
    scenarios: Scenarios,
    /,
    *,
    out: Path,
    seed: int = 0,
    options: Options = PlannerOptions(),
) -> None:
    """Write maps of f and g at the start of scenarios, as NAME.npz and NAME.png.

    Args:
      scenarios: scenario files, folders of them, or names of shipped ones.
      out: folder for the maps.
      seed: of the recogniser.
      options: how the planner decides.
    """
    from rich.progress import track

    from mechsearch_jax.cache import keep_compilations, kept_problem
    from mechsearch_jax.envs.episode import target_of
    from mechsearch_jax.envs.pictures import inspect_scenario
    from mechsearch_jax.envs.recognisers import recogniser
    from mechsearch_jax.files import check_writable
    from mechsearch_jax.viz.drawing import save_figure
    from mechsearch_jax.viz.maps import save_maps
    from mechsearch_jax.workspace.scenario import load_scenario

    options.only_native("inspect")
    config = options.config("search-for-grasp")
    scenes = [load_scenario(file) for file in find_scenarios(scenarios)]
    check_writable(out)
    keep_compilations()
    problems = {target: kept_problem(target) for target in {target_of(scene) for scene in scenes}}
    for scene in track(scenes, "inspecting"):
        eyes = recogniser(options.recognition, target_of(scene))
        maps, figure = inspect_scenario(scene, problems[target_of(scene)], config, eyes, seed)
        save_maps(maps, out / f"{scene.name}.npz")
        save_figure(figure, out / f"{scene.name}.png")
    print(f"{len(scenes)} scenario{'s' if len(scenes) > 1 else ''} inspected: {out}")


def evaluate(
    scenarios: Scenarios,
    /,
    *,
    out: Path,
    method: tuple[Method, ...] = ("search-for-grasp",),
    seed: tuple[int, ...] = (0,),
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    batch: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    options: Options = PlannerOptions(),
) -> None:
    """Run many episodes; killed and started again, it goes on where it stopped.

    On a GPU they run in batches in this process, on a CPU one after the other in worker processes.

    Args:
      scenarios: scenario files, folders of them, or names of shipped ones.
      out: Parquet file with one row for each episode; rows that it already holds are not run again.
      method: one or more.
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
    from mechsearch_jax.cache import keep_compilations

    at_least_one("evaluate", workers=workers, batch=batch)
    if workers is not None and batch is not None:
        raise InputError("evaluate: give either --workers or --batch, not both")
    if workers is not None and options.simulator == "mjx":
        raise InputError("evaluate: --workers run the native simulator; leave --workers out, or --simulator mjx")
    in_processes = workers is not None or (batch is None and options.simulator != "mjx" and not has_gpu())
    engine = "NativeSimulator" if in_processes else options.engine()
    configs = [options.config(one) for one in method]
    jobs = make_jobs(find_scenarios(scenarios), configs, seed, engine, options.recognition)
    console = Console(highlight=False)
    with EpisodeProgress(console, len(jobs)) as progress:
        if in_processes:
            cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
            runner = Processes(workers or cores)
        else:
            keep_compilations()
            runner = Batches(batch, progress.busy)
        rows = evaluate(jobs, out, runner, progress.ended)
    console.print(rates_table(rows))
    console.print(str(out), soft_wrap=True)


def report(
    tables: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE ...")],
    /,
    *,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None,
) -> None:
    """Print rates by method and number of objects from results of `evaluate`, and write them with plots.

    Args:
      tables: Parquet files.
      out: folder for report.md, rates.csv, rates.json, failures.csv and success.png; only prints if not given.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.report import read_tables, write_report
    from mechsearch_jax.benchmarks.tables import rates_table

    rows = read_tables(tables)
    if out is not None:
        write_report(rows, out)
    console = Console(highlight=False)
    console.print(rates_table(rows))
    if out is not None:
        console.print(str(out / "report.md"), soft_wrap=True)


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

    from mechsearch_jax.cache import keep_compilations
    from mechsearch_jax.envs.generator import ScenarioGenerator
    from mechsearch_jax.files import check_writable
    from mechsearch_jax.workspace.scenario import save_scenario
    from mechsearch_jax.workspace.target import Target

    at_least_one("scenarios generate", count=count)
    check_writable(out)
    keep_compilations()
    generator = ScenarioGenerator(Target.box() if target == "box" else Target.cylinder())
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


def _print_timing(subject: str, out: Path | None, measure: Callable[[], Timing]) -> None:
    """Measure, print and write a timing.

    Raises:
      InputError: the file cannot be written, or what `measure` raises.
    """
    import jax
    from rich.console import Console

    from mechsearch_jax.benchmarks.bench import save_timing
    from mechsearch_jax.benchmarks.tables import timing_table
    from mechsearch_jax.files import check_writable

    if out is not None:
        check_writable(out.parent)
    # A compilation that was read from disk would not tell how long compiling takes.
    jax.config.update("jax_enable_compilation_cache", False)
    console = Console(highlight=False)
    with console.status(f"timing {subject}"):
        timing = measure()
    console.print(timing_table(timing))
    if out is not None:
        save_timing(timing, out)


def _timing_of(subject: Literal["existence", "graspability", "plan"], what: str) -> Callable[..., None]:
    """The command that times one part of the planner."""

    def command(
        *,
        objects: int = 8,
        batch: int = 1,
        repeats: int = 10,
        out: JsonFile = None,
        options: Options = PlannerOptions(),
    ) -> None:
        from mechsearch_jax.benchmarks.bench import bench

        at_least_one(f"bench {subject}", repeats=repeats, batch=batch)
        config = options.config("search-for-grasp")
        _print_timing(subject, out, lambda: bench(subject, objects, config, batch=batch, repeats=repeats))

    command.__name__ = subject
    command.__doc__ = f"""Time {what}: compilation, median and spread.

    Args:
      objects: number of objects in a scene.
      batch: how many scenes at once.
      repeats: number of timed calls.
      out: JSON file for the result.
      options: how the planner decides.
    """
    return command


def bench_perceive(
    *,
    objects: int = 8,
    batch: int = 1,
    repeats: int = 10,
    recognition: Literal["masks", "full"] = "full",
    out: JsonFile = None,
) -> None:
    """Time recognising all objects of a scene from its noisy depth image: compilation, median and spread.

    Args:
      objects: number of objects in a scene.
      batch: how many scenes at once.
      repeats: number of timed calls.
      recognition: "masks" is told which pixels are whose, "full" finds out.
      out: JSON file for the result.
    """
    from mechsearch_jax.benchmarks import bench as benches

    at_least_one("bench perceive", repeats=repeats, batch=batch)
    _print_timing("perceive", out, lambda: benches.bench_perceive(recognition, objects, batch, repeats=repeats))


def bench_predict(
    *,
    push_model: PushModel = "learned",
    weights: WeightsFile = None,
    objects: int = 8,
    batch: int = 30,
    repeats: int = 20,
    out: JsonFile = None,
) -> None:
    """Time predicting random pushes, all at once, each in a scene of its own: compilation, median and spread.

    Args:
      push_model: what predicts them; "physics" simulates every one.
      weights: of the learned model; those that ship if not given.
      objects: number of objects in a scene.
      batch: pushes predicted at once; each step of a decision predicts 30.
      repeats: number of timed calls.
      out: JSON file for the result.
    """
    from mechsearch_jax.benchmarks import bench as benches

    at_least_one("bench predict", repeats=repeats, batch=batch)
    if weights is not None and push_model != "learned":
        raise InputError(f"bench predict: --weights is for --push-model learned, not for {push_model}")
    _print_timing("predict", out, lambda: benches.bench_predict(push_model, objects, batch, repeats, weights))


def bench_simulate(*, worlds: int = 1024, steps: int = 500, repeats: int = 5, out: JsonFile = None) -> None:
    """Time the batch simulator with 8 objects, the arm sweeping through them: steps per second of all worlds together.

    Args:
      worlds: simulated at once.
      steps: time steps in a timed call.
      repeats: number of timed calls.
      out: JSON file for the result.
    """
    from mechsearch_jax.benchmarks import bench as benches

    _print_timing("simulate", out, lambda: benches.bench_simulate(worlds, steps, repeats))


def bench_inside(
    *, placed: int = 1024, objects: int = 8, points: int = 2560, repeats: int = 10, out: JsonFile = None
) -> None:
    """Time every point of clouds against every superquadric, and what the device can do at most, apart from compiling.

    Args:
      placed: clouds in one call; a GPU needs some 100000 to be busy for milliseconds.
      objects: that each is tested against.
      points: of a cloud.
      repeats: number of timed calls.
      out: JSON file for the result.
    """
    import jax
    from rich.console import Console

    from mechsearch_jax.benchmarks import roofline
    from mechsearch_jax.benchmarks.bench import save_timings
    from mechsearch_jax.benchmarks.tables import timings_table
    from mechsearch_jax.files import check_writable

    if out is not None:
        check_writable(out.parent)
    jax.config.update("jax_enable_compilation_cache", False)
    console = Console(highlight=False)
    with console.status("timing inside"):
        timings = roofline.bench_inside(placed, objects, points, repeats)
    console.print(timings_table(timings))
    if out is not None:
        save_timings(timings, out)


def bench_roofline(
    results: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")], /, *, out: Path
) -> None:
    """Write the page that compares measured rates with what devices allow, from results of `inside` and `simulate`.

    Args:
      results: folder with their JSON files; others are left out.
      out: Markdown file.
    """
    from mechsearch_jax.benchmarks.roofline import write_page

    write_page(results, out)
    print(out)


def bench_agreement(
    scenarios: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[SCENARIO|FOLDER ...]")] = (),
    /,
    *,
    actions: int = 200,
    scenes: int = 40,
    seed: int = 0,
    out: JsonFile = None,
) -> None:
    """Compare the batch simulator with the native one: random pushes and pick-and-places, executed by both.

    Args:
      scenarios: scenario files, folders of them, or names of shipped ones; scenes are generated if there are none.
      actions: how many; they are as many worlds of one batch.
      scenes: how many are generated, with 1 to 8 objects in turn.
      seed: of the scenes and of the actions.
      out: JSON file for the result.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.agreement import agreement, draw_actions, generated_scenes, save_agreement
    from mechsearch_jax.benchmarks.tables import agreement_table
    from mechsearch_jax.cache import keep_compilations
    from mechsearch_jax.envs.mjx_simulator import import_mjx
    from mechsearch_jax.files import check_writable
    from mechsearch_jax.workspace.scenario import load_scenario

    at_least_one("bench agreement", actions=actions, scenes=scenes)
    files = find_scenarios(scenarios) if scenarios else []
    if out is not None:
        check_writable(out.parent)
    import_mjx()
    keep_compilations()
    console = Console(highlight=False)
    with console.status("making scenes") as status:
        where = [load_scenario(file) for file in files] or generated_scenes(scenes, seed)
        status.update("drawing actions")
        cases = draw_actions(where, actions, seed)
        status.update("executing actions")
        found = agreement(cases)
    console.print(agreement_table(found))
    if out is not None:
        save_agreement(found, out)


def bench_recognition(
    scenarios: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[SCENARIO|FOLDER ...]")] = (),
    /,
    *,
    scenes: int = 40,
    seed: int = 0,
    noise: tuple[Literal["clean", "gaussian", "time-of-flight"], ...] = ("clean", "gaussian"),
    method: tuple[Literal["network", "network-refined", "ems", "ems-refined"], ...] = (
        "network",
        "network-refined",
        "ems",
        "ems-refined",
    ),
    ems_scenes: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    out: JsonFile = None,
    picture: JsonFile = None,
    worst: int = 12,
    worst_of: Literal["network", "network-refined", "ems", "ems-refined"] = "network-refined",
) -> None:
    """Compare recognisers, given true masks, with the truth: the network, refinement and the classical EMS.

    Args:
      scenarios: scenario files, folders of them, or names of shipped ones, beside the generated scenes.
      scenes: how many are generated, with a seed that training cannot have; may be 0 if there are scenarios.
      seed: of the generated scenes, of the noise and of the methods.
      noise: of the depth image, one or more; "gaussian" is the paper's, 1 mm.
      method: one or more; one that begins with another's answers brings it along.
      ems_scenes: number of scenes, spread evenly over all, for EMS, which is slow; all if not given.
      out: JSON file for the figures and for every object's row.
      picture: PNG file for the worst answers of a method, beside the truth.
      worst: how many of them.
      worst_of: which method's.
    """
    import jax
    from rich.console import Console

    from mechsearch_jax.benchmarks import images, recognition
    from mechsearch_jax.benchmarks.tables import recognition_tables, recognition_times_table
    from mechsearch_jax.files import check_writable
    from mechsearch_jax.perception.cloud import shelf_view
    from mechsearch_jax.viz.drawing import save_figure
    from mechsearch_jax.workspace.scenario import load_scenario
    from mechsearch_jax.workspace.shelf import Shelf

    at_least_one("bench recognition", worst=worst)
    for file in (out, picture):
        if file is not None:
            check_writable(file.parent)
    given = images.scenes_of([load_scenario(file) for file in find_scenarios(scenarios)] if scenarios else [])
    console = Console(highlight=False)
    with console.status("making scenes") as status:
        methods = recognition.shipped_methods(shelf_view().camera, Shelf())
        bench = recognition.Bench(
            [*images.held_out_scenes(scenes, seed), *given],
            recognition.chosen_methods(methods, method),
            tuple(dict.fromkeys(noise)),
            seed,
            ems_scenes,
        )
        if picture is not None and worst_of not in bench.methods:
            raise InputError(f"bench recognition: --worst-of {worst_of} is not among the methods; add it to --method")
        # A compilation that was read from disk would not tell how long compiling takes.
        jax.config.update("jax_enable_compilation_cache", False)
        total = len(bench.scenes) * len(bench.noises)
        status.update("compiling")
        measured = bench.run(lambda done: status.update(f"recognising {done}/{total}"))
        if out is not None:
            recognition.save_recognition(measured, out)
        if picture is not None:
            status.update("drawing")
            rows = recognition.worst(measured.rows, worst_of, worst)
            save_figure(recognition.worst_figure(bench, rows), picture)
    console.print(recognition_tables(measured))
    console.print(recognition_times_table(measured))


def bench_segmentation(
    scenarios: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[SCENARIO|FOLDER ...]")] = (),
    /,
    *,
    scenes: int = 100,
    seed: int = 0,
    noise: tuple[Literal["clean", "gaussian", "time-of-flight"], ...] = ("clean", "gaussian"),
    out: JsonFile = None,
    picture: JsonFile = None,
    worst: int = 6,
) -> None:
    """Measure how well the objects of depth images are told apart, against their true masks.

    Args:
      scenarios: scenario files, folders of them, or names of shipped ones, beside the generated scenes.
      scenes: how many are generated, with a seed that training cannot have; may be 0 if there are scenarios.
      seed: of the generated scenes and of the noise.
      noise: of the depth image, one or more; "gaussian" is the paper's, 1 mm.
      out: JSON file for the figures and for every object's row.
      picture: PNG file for the worst images, the true masks above those found.
      worst: how many of them.
    """
    import jax
    from rich.console import Console

    from mechsearch_jax.benchmarks import images, segmentation
    from mechsearch_jax.benchmarks.tables import segmentation_tables
    from mechsearch_jax.files import check_writable
    from mechsearch_jax.viz.drawing import save_figure
    from mechsearch_jax.workspace.scenario import load_scenario

    at_least_one("bench segmentation", worst=worst)
    for file in (out, picture):
        if file is not None:
            check_writable(file.parent)
    given = images.scenes_of([load_scenario(file) for file in find_scenarios(scenarios)] if scenarios else [])
    console = Console(highlight=False)
    with console.status("making scenes") as status:
        everything = [*images.held_out_scenes(scenes, seed), *given]
        bench = segmentation.Bench(everything, tuple(dict.fromkeys(noise)), seed)
        # A compilation that was read from disk would not tell how long compiling takes.
        jax.config.update("jax_enable_compilation_cache", False)
        total = len(bench.scenes) * len(bench.noises)
        status.update("compiling")
        measured = bench.run(lambda done: status.update(f"segmenting {done}/{total}"))
        if out is not None:
            segmentation.save_segmentation(measured, out)
        if picture is not None:
            status.update("drawing")
            save_figure(segmentation.worst_figure(bench, measured.rows, worst), picture)
    console.print(segmentation_tables(measured))


def bench_push(
    *,
    pushes: Annotated[int, tyro.conf.arg(metavar="N")] = 2000,
    seed: int = 0,
    models: tuple[Literal["no motion", "quasi-static", "learned", "physics", "nudged"], ...] = (
        "no motion",
        "quasi-static",
        "learned",
        "physics",
        "nudged",
    ),
    weights: WeightsFile = None,
    worlds: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    data: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None,
    out: JsonFile = None,
) -> None:
    """Simulate random pushes in scenes that no training has seen, and compare push models with what became of them.

    Args:
      pushes: at least so many.
      seed: of the scenes and the pushes, of those that training cannot have.
      models: what is compared, one or more; "no motion" predicts nothing, and "nudged" is the same simulation again
        from a hundredth of a millimetre elsewhere: how far it differs from itself.
      weights: of the learned model; those that ship if not given.
      worlds: simulated at once; 512 on a GPU and 64 on a CPU if left out.
      data: folder for the pushes, so that a killed run goes on and another need not simulate them again; they are not
        kept if left out.
      out: JSON file for the scores, in groups by distance and number of objects.
    """
    import tempfile

    import jax
    from rich.console import Console

    from mechsearch_jax.benchmarks import push
    from mechsearch_jax.benchmarks.tables import push_scores_tables
    from mechsearch_jax.cache import keep_compilations
    from mechsearch_jax.files import check_writable
    from mechsearch_jax.train.run import counting

    worlds = (64 if jax.default_backend() == "cpu" else 512) if worlds is None else worlds
    bench = push.Bench(push.held_out_generation(pushes, worlds, seed), models, weights)
    for folder in (data, None if out is None else out.parent):
        if folder is not None:
            check_writable(folder)
    keep_compilations()
    with contextlib.ExitStack() as stack:
        folder = data or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        with counting("pushes", pushes) as told:
            made = bench.pushes(folder, told)
    console = Console(highlight=False)
    with console.status("predicting") as status:
        total = len(made.object)
        measured = bench.run(made, lambda name, done: status.update(f"{name}: {done}/{total}"))
        if out is not None:
            push.save_push_scores(measured, out)
    console.print(push_scores_tables(measured))


def _training_of(name: Literal["segmentation", "recognition"], batch: int, rate: float) -> Callable[..., None]:
    """The command that trains one network of perception."""
    default_batch, default_rate = batch, rate

    def command(
        *,
        out: Path,
        seed: int = 0,
        steps: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
        minutes: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None,
        batch: int = default_batch,
        rate: float = default_rate,
        chunk: int = 20,
        held_out: int = 512,
    ) -> None:
        from mechsearch_jax.files import check_writable
        from mechsearch_jax.train.loop import TrainConfig
        from mechsearch_jax.train.run import TASKS, run

        if steps is None and minutes is None:
            minutes = 10.0
        config = TrainConfig(
            seed=seed,
            steps=steps,
            minutes=minutes,
            batch=batch,
            rate=rate,
            chunk=chunk,
            held_out=held_out,
        )
        check_writable(out)
        run(TASKS[name](), config, out)

    command.__name__ = name
    command.__doc__ = f"""Train the network of {name} on scenes made as they are needed; goes on where it was stopped.

    Args:
      out: folder for the checkpoint, the curves (scalars.jsonl), and in the end {name}.npz and its card {name}.json.
      seed: of the weights and the scenes.
      steps: length in steps; with the same steps, seed and machine the weights are the same.
      minutes: length in minutes instead, without the scoring at the end; 10 if neither is given.
      batch: scenes in a step.
      rate: highest learning rate.
      chunk: steps that the device makes before it reports.
      held_out: scenes for each of the scores at the end.
    """
    return command


def train_push(
    *,
    out: Path,
    data: Path | None = None,
    pushes: Annotated[int, tyro.conf.arg(metavar="N")] = 900_000,
    worlds: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    rounds: int = 8,
    frame: Literal["push", "world"] = "push",
    width: int = 64,
    layers: int = 3,
    seed: int = 0,
    steps: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    minutes: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None,
    batch: int = 1024,
    rate: float = 2e-3,
    decay: float = 0.1,
    chunk: int = 50,
    held_out: int = 20_000,
) -> None:
    """Simulate random pushes and train the push model on them; goes on where it was stopped.

    Args:
      out: folder for the checkpoint, the curves (scalars.jsonl), and in the end push.npz and its card push.json.
      data: folder for the pushes, a kilobyte each; OUT/pushes if left out. What lies there is not simulated again.
      pushes: at least so many are simulated; one in 32 of the scenes is held out.
      worlds: simulated at once; 16,384 on a GPU and 64 on a CPU if left out.
      rounds: pushes that follow each other in a world before all are begun anew.
      frame: "push" sees objects along the push; "world" is the baseline without symmetry.
      width: of what the network knows of an object.
      layers: of messages between objects.
      seed: of the weights, the scenes and the pushes.
      steps: length in steps.
      minutes: length in minutes instead, without simulation and scoring; 5 if neither is given.
      batch: pushes in a step.
      rate: highest learning rate.
      decay: of the weights, times the learning rate, in every step.
      chunk: steps that the device makes before it reports.
      held_out: pushes, at most, for the scores at the end.
    """
    import jax

    from mechsearch_jax.envs.pushes import Generation
    from mechsearch_jax.files import check_writable
    from mechsearch_jax.networks.push import PushConfig
    from mechsearch_jax.train.loop import TrainConfig
    from mechsearch_jax.train.push import push_task
    from mechsearch_jax.train.run import counting, run

    if steps is None and minutes is None:
        minutes = 5.0
    config = TrainConfig(
        seed=seed,
        steps=steps,
        minutes=minutes,
        batch=batch,
        rate=rate,
        decay=decay,
        chunk=chunk,
        held_out=held_out,
    )
    network = PushConfig(width=width, layers=layers, frame=frame)
    worlds = (64 if jax.default_backend() == "cpu" else 16_384) if worlds is None else worlds
    generation = Generation(seed, pushes, worlds, rounds)
    check_writable(out)
    folder = data or out / "pushes"
    check_writable(folder)
    with counting("pushes", pushes) as told:
        task = push_task(generation, folder, network, told)
    run(task, config, out)


def train() -> None:
    """Train the networks: mechsearch train segmentation|recognition|push."""


def scenarios() -> None:
    """Generate and check scenario files: mechsearch scenarios generate|check."""


def bench() -> None:
    """Measure the parts, one command each."""


Commands = dict[str, Callable[..., None]]

COMMANDS: Commands = {
    "search": search,
    "inspect": inspect,
    "evaluate": evaluate,
    "report": report,
    "scenarios": scenarios,
    "train": train,
    "bench": bench,
}
GROUPS: dict[str, Commands] = {
    "scenarios": {"generate": generate, "check": check},
    "train": {
        "segmentation": _training_of("segmentation", batch=32, rate=1e-3),
        "recognition": _training_of("recognition", batch=64, rate=1e-3),
        "push": train_push,
    },
    "bench": {
        "existence": _timing_of("existence", "f"),
        "graspability": _timing_of("graspability", "g where f = 1"),
        "plan": _timing_of("plan", "a whole decision"),
        "predict": bench_predict,
        "perceive": bench_perceive,
        "simulate": bench_simulate,
        "inside": bench_inside,
        "roofline": bench_roofline,
        "agreement": bench_agreement,
        "recognition": bench_recognition,
        "segmentation": bench_segmentation,
        "push": bench_push,
    },
}


def _deferred(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """A function with the same signature that only returns what is to be run."""

    @functools.wraps(command)
    def parsed(*args, **kwargs):
        return functools.partial(command, *args, **kwargs)

    return parsed


def one_line(complaint: str) -> str:
    """The message in the box that the parser draws around it, on one line."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", complaint)
    rows = [row.strip("│╭╰╮╯ \t") for row in plain.splitlines()]
    title, *rows = [row for row in rows if row] or ["the arguments are wrong"]
    body: list[str] = []
    for row in rows:
        if not row.strip("─"):
            break
        body.append(row)
    text = " ".join(body) if body else title.strip("─ ")
    return re.sub(r"\s+", " ", text)


def parse(arguments: Sequence[str]) -> Callable[[], None]:
    """The command that arguments ask for, ready to be called.

    Raises:
      InputError: the arguments are wrong.
      SystemExit: after help was printed.
    """
    group = arguments[0] if arguments and arguments[0] in GROUPS else None
    program = f"mechsearch {group}" if group else "mechsearch"
    commands = GROUPS[group] if group else COMMANDS
    description = COMMANDS[group].__doc__ if group else "Find a hidden object on a cluttered shelf and take it out."
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.extras.subcommand_cli_from_dict(
                {name: _deferred(command) for name, command in commands.items()},
                prog=program,
                description=description,
                args=list(arguments[1:] if group else arguments),
            )
    except SystemExit as end:
        if not end.code:
            raise
        raise InputError(f"{one_line(complaint.getvalue())} ({program} --help tells more)") from None


def main() -> None:
    """The console command `mechsearch`."""
    # Tracing makes millions of small objects that are not garbage: looking for it takes a fifth of a start.
    gc.set_threshold(200_000, 20, 20)
    try:
        parse(sys.argv[1:])()
    except InputError as error:
        print(f"mechsearch: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("mechsearch: stopped", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
