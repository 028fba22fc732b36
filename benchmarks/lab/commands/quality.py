"""How good the parts are."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import tyro

from mechsearch_jax.commands.options import (
    JsonFile,
    Scenarios,
    SomeScenarios,
    WeightsFile,
    at_least_one,
    check_files,
    find_scenarios,
    forget_kept_compilations,
    settings_of,
)
from mechsearch_jax.runtime.errors import InputError, check_once

if TYPE_CHECKING:
    from rich.status import Status

    from mechsearch_jax.benchmarks.lab.parts.recognition import MeasuredRecognition, RecognitionBench
    from mechsearch_jax.problem.workcell import Workcell
    from mechsearch_jax.workspace.scenario import Scenario


Noise = Literal["clean", "gaussian", "time-of-flight"]
Recogniser = Literal["network", "network-refined", "ems", "ems-refined"]
ComparedModel = Literal["no motion", "quasi-static", "learned", "physics", "nudged"]


def _loaded(names: Sequence[str]) -> list[Scenario]:
    """What files, folders and names of scenarios stand for; none if there are none."""
    from mechsearch_jax.workspace.scenario import load_scenario

    return [load_scenario(file) for file in find_scenarios(names)] if names else []


def bench_agreement(
    scenarios: SomeScenarios = (),
    /,
    *,
    actions: int = 200,
    scenes: int = 40,
    seed: int = 0,
    out: JsonFile = None,
) -> None:
    """Compare the batch simulator with the native one: random pushes and pick-and-places, executed by both.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets; scenes are generated if there
        are none.
      actions: how many; they are as many worlds of one batch.
      scenes: how many are generated, with 1 to 8 objects in turn.
      seed: of the scenes and of the actions.
      out: JSON file for the result.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.lab.parts.agreement import agreement, draw_actions, generated_scenes
    from mechsearch_jax.benchmarks.lab.screen import as_text
    from mechsearch_jax.envs.simulators.mjx_model import import_mjx
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.runtime.files import save_json

    at_least_one("lab agreement", actions=actions, scenes=scenes)
    given = _loaded(scenarios)
    check_files(out)
    import_mjx()
    keep_compilations()
    console = Console(highlight=False)
    with console.status("making scenes") as status:
        where = given or generated_scenes(scenes, seed)
        status.update("drawing actions")
        cases = draw_actions(where, actions, seed)
        status.update("executing actions")
        result = agreement(cases)
    print(as_text({"kind": name, **line} for name, line in result.summary().items()))
    if out is not None:
        save_json(result.value(), out)


@dataclasses.dataclass(frozen=True)
class GeneratedScenes:
    """Scenes that are made.

    Attributes:
      config: files of settings, one or more; the scenes are generated on the shelf, and looked at by the camera, of
        each in turn. The defaults if not given.
      scenes: how many are generated, with a seed that training cannot have; may be 0 if there are scenarios.
      seed: of the generated scenes, of the noise and of the methods.
    """

    config: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE.toml ...", help_behavior_hint="")] = ()
    scenes: int = 40
    seed: int = 0


def bench_recognition(
    scenarios: SomeScenarios = (),
    /,
    *,
    generated: Annotated[GeneratedScenes, tyro.conf.arg(name="")] = GeneratedScenes(),
    noise: tuple[Noise, ...] = ("clean", "gaussian"),
    method: tuple[Recogniser, ...] = get_args(Recogniser),
    ems_scenes: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    out: JsonFile = None,
) -> None:
    """Compare recognisers, given true masks, with the truth: the network, refinement and the classical EMS.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets, beside the generated scenes.
      generated: what is generated.
      noise: of the depth image, one or more; "gaussian" is the paper's, 1 mm.
      method: one or more; one that begins with another's answers brings it along.
      ems_scenes: number of scenes, spread evenly over all, for EMS, which is slow; all if not given.
      out: JSON file for the figures and for every object's row.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.lab.parts import images, recognition
    from mechsearch_jax.benchmarks.lab.screen import as_text

    check_files(out)
    places = _places("lab recognition", generated.config, scenarios)
    given = images.scenes_of(_loaded(scenarios))
    console = Console(highlight=False)
    with console.status("making scenes") as status:
        forget_kept_compilations()
        benches = {
            name: recognition.shipped_bench(
                [*images.held_out_scenes(generated.scenes, generated.seed, place.shelf, name), *given],
                method,
                tuple(dict.fromkeys(noise)),
                generated.seed,
                ems_scenes,
                place,
            )
            for name, place in places.items()
        }
        measured = _measured(benches, places, status, out)
    print(as_text(measured.summary()))
    print(as_text({"method": name, **time.value()} for name, time in measured.times.items()))


def _measured(
    benches: Mapping[str, RecognitionBench], places: Mapping[str, Workcell], status: Status, out: Path | None
) -> MeasuredRecognition:
    """Measure in each place, and write what is measured after each: one takes minutes."""
    from mechsearch_jax.benchmarks.lab.parts.recognition import joined
    from mechsearch_jax.benchmarks.store.json_rows import save_rows

    parts: dict[str, MeasuredRecognition] = {}
    for name, bench in benches.items():
        total = len(bench.scenes) * len(bench.noises)
        status.update(f"{name}: compiling")
        parts[name] = bench.run(lambda done, name=name, total=total: status.update(f"{name}: {done}/{total}"))
        if out is not None:
            measured = joined(parts, places)
            save_rows(measured.value(), measured.rows, out)
    return joined(parts, places)


def _places(command: str, files: Sequence[Path], scenarios: Sequence[str]) -> dict[str, Workcell]:
    """The cameras and shelves of configuration files by the files' names; the default without any.

    Raises:
      InputError: a file cannot be used, two have the same name, or scenario files, which stand on the default shelf,
        are given too.
    """
    from mechsearch_jax.problem.workcell import Workcell

    if files and scenarios:
        raise InputError(f"{command}: --config is for generated scenes; leave the scenario files out")
    check_once(f"{command}: two configuration files", (file.stem for file in files))
    return {file.stem: settings_of(file).workcell for file in files} or {"held-out": Workcell()}


def bench_segmentation(
    scenarios: SomeScenarios = (),
    /,
    *,
    scenes: int = 100,
    seed: int = 0,
    noise: tuple[Noise, ...] = ("clean", "gaussian"),
    out: JsonFile = None,
    picture: JsonFile = None,
    worst: int = 6,
) -> None:
    """Measure how well the objects of depth images are told apart, against their true masks.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets, beside the generated scenes.
      scenes: how many are generated, with a seed that training cannot have; may be 0 if there are scenarios.
      seed: of the generated scenes and of the noise.
      noise: of the depth image, one or more; "gaussian" is the paper's, 1 mm.
      out: JSON file for the figures and for every object's row.
      picture: PNG file for the worst images, the true masks above those found.
      worst: how many of them.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.lab.parts import images, segmentation
    from mechsearch_jax.benchmarks.lab.screen import as_text
    from mechsearch_jax.benchmarks.store.json_rows import save_rows
    from mechsearch_jax.viz.drawing import save_figure

    at_least_one("lab segmentation", worst=worst)
    check_files(out, picture)
    given = images.scenes_of(_loaded(scenarios))
    console = Console(highlight=False)
    with console.status("making scenes") as status:
        everything = [*images.held_out_scenes(scenes, seed), *given]
        bench = segmentation.SegmentationBench(everything, tuple(dict.fromkeys(noise)), seed)
        forget_kept_compilations()
        total = len(bench.scenes) * len(bench.noises)
        status.update("compiling")
        measured = bench.run(lambda done: status.update(f"segmenting {done}/{total}"))
        if out is not None:
            save_rows(measured.value(), measured.rows, out)
        if picture is not None:
            status.update("drawing")
            save_figure(segmentation.worst_figure(bench, measured.rows, worst), picture)
    print(as_text(measured.summary()))


def bench_push(
    *,
    pushes: Annotated[int, tyro.conf.arg(metavar="N")] = 2000,
    seed: int = 0,
    models: tuple[ComparedModel, ...] = get_args(ComparedModel),
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

    from mechsearch_jax.benchmarks.lab.parts import push
    from mechsearch_jax.benchmarks.lab.screen import as_text
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.runtime.files import check_writable, save_json
    from mechsearch_jax.train.run import counting

    worlds = (64 if jax.default_backend() == "cpu" else 512) if worlds is None else worlds
    bench = push.PushBench(push.held_out_generation(pushes, worlds, seed), models, weights)
    for folder in (data, None if out is None else out.parent):
        if folder is not None:
            check_writable(folder)
    keep_compilations()
    with contextlib.ExitStack() as stack:
        folder = data or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        with counting("pushes", pushes) as on_progress:
            made = bench.pushes(folder, on_progress)
    console = Console(highlight=False)
    with console.status("predicting") as status:
        total = len(made.object)
        measured = bench.run(made, lambda name, done: status.update(f"{name}: {done}/{total}"))
        if out is not None:
            save_json(measured.value(), out)
    groups = ((model, name, line) for model, lines in measured.scores.items() for name, line in lines.items())
    print(as_text({"model": model, "group": name, **line} for model, name, line in groups))


def bench_scenes(scenarios: Scenarios, /, *, exact: bool = False, out: JsonFile = None) -> None:
    """Tell what scenes are like at their start: size of f, and what is seen of the target and of the objects.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets; each is a source of its own.
      exact: also find f by brute force, at full resolution and 25 places of each cell; seconds a scene.
      out: JSON file for the figures and for every scene's row.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.lab.parts import scenes
    from mechsearch_jax.benchmarks.lab.screen import as_text
    from mechsearch_jax.problem.cache import keep_compilations

    names = [Path(name).resolve().name for name in scenarios]
    check_once("lab scenes: two sources", names)
    sources = {name: _loaded([given]) for name, given in zip(names, scenarios, strict=True)}
    if not sources:
        find_scenarios([])
    check_files(out)
    keep_compilations()
    console = Console(highlight=False)
    total = sum(map(len, sources.values()))
    with console.status("looking") as status:
        rows = scenes.look_at_all(sources, lambda done: status.update(f"looking {done}/{total}"), exact)
    if out is not None:
        scenes.save_scenes(rows, out)
    print(as_text(scenes.summary(rows)))


def bench_sensors(*, scenes: int = 8, real: Path | None = None, out: JsonFile = None) -> None:
    """Measure what the depth images of simulated sensors are like, and beside them real ones.

    Args:
      scenes: images of each sensor and view.
      real: folder of folders of labelled images; each is a column.
      out: JSON file for the figures.

    Raises:
      InputError: there are no images in the folder, or the file cannot be written.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.lab.parts import sensors
    from mechsearch_jax.benchmarks.lab.screen import as_text
    from mechsearch_jax.runtime.files import save_json

    check_files(out)
    at_least_one("lab sensors", scenes=scenes)
    console = Console(highlight=False)
    with console.status("measuring"):
        columns = {} if real is None else sensors.real_columns(real)
        columns |= sensors.simulated_columns(scenes)
        if out is not None:
            save_json(columns, out)
    print(as_text({"images": name, **figures} for name, figures in columns.items()))


COMMANDS = {
    "scenes": bench_scenes,
    "agreement": bench_agreement,
    "recognition": bench_recognition,
    "segmentation": bench_segmentation,
    "push": bench_push,
    "sensors": bench_sensors,
}
