"""What comes of images, end to end."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from mechsearch_jax.commands.options import (
    JsonFile,
    Scenarios,
    at_least_one,
    check_files,
    find_scenarios,
    forget_kept_compilations,
)
from mechsearch_jax.runtime.errors import check_once

# Objects of at least this confidence are counted apart.
SURE = 0.9
Noise = Literal["clean", "gaussian", "time-of-flight"]
Segments = Literal["network", "explained", "joined", "true"]
Description = Literal["one", "parts", "true parts"]


def bench_looks(
    scenarios: Scenarios,
    /,
    *,
    noise: tuple[Noise, ...] = ("gaussian",),
    segments: tuple[Segments, ...] = ("explained",),
    seed: int = 0,
    out: JsonFile = None,
) -> None:
    """Measure what comes of a depth and a colour image alone: which visible objects are missing, off or turned,
    phantoms, missed targets, and how often objects are wrong by their stated confidence.

    MuJoCo renders the images, not the package's own camera. The target is red, the objects have random colours.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets.
      noise: of the depth image, one or more; "gaussian" is 1 mm.
      segments: those that explain the image, the same without dividing one, the segmentation network's alone, or the
        true masks; several are looked at in turn.
      seed: of the noise and of the recogniser.
      out: JSON file for the figures, and for every object that is not right.

    Raises:
      InputError: two scenarios have the same name, or the file cannot be written.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.lab.looks import looks
    from mechsearch_jax.benchmarks.lab.looks.pictures import taken
    from mechsearch_jax.benchmarks.lab.tables import looks_tables
    from mechsearch_jax.problem.workcell import Workcell
    from mechsearch_jax.runtime.files import save_json
    from mechsearch_jax.workspace.scenario import load_scenario

    check_files(out)
    scenes = list(map(load_scenario, find_scenarios(scenarios)))
    check_once("lab looks: two scenes", (scene.name for scene in scenes))
    console = Console(highlight=False)
    with console.status("rendering") as status:
        pictures = {}
        for number, scene in enumerate(scenes):
            pictures[scene.name] = scene, taken(Workcell(), scene)
            status.update(f"rendering {number + 1}/{len(scenes)}")
        bench = looks.LooksBench(pictures, tuple(dict.fromkeys(noise)), tuple(dict.fromkeys(segments)), seed)
        forget_kept_compilations()
        status.update("compiling")
        measured = bench.run(lambda done: status.update(f"looking {done}/{bench.looks}"))
        if out is not None:
            save_json(measured.value(), out)
    console.print(looks_tables(measured))


def bench_bodies(
    scenarios: Scenarios,
    /,
    *,
    described_by: tuple[Description, ...] = ("one", "parts", "true parts"),
    seed: int = 0,
    out: JsonFile = None,
) -> None:
    """Measure how well recognised bodies describe the true ones: the volume in common, and whether the gripper at
    random poses near an object is rightly said to hit it. The images are those of `--recognition masks`.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets.
      described_by: each object by one superquadric, by up to four, or by those that its true shape is known by.
      seed: of noise, recognition and poses.
      out: JSON file for the figures, with every object.

    Raises:
      InputError: two scenarios have the same name, or the file cannot be written.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.lab.looks import bodies
    from mechsearch_jax.benchmarks.lab.tables import bodies_tables
    from mechsearch_jax.runtime.files import save_json
    from mechsearch_jax.workspace.scenario import load_scenario

    check_files(out)
    loaded = list(map(load_scenario, find_scenarios(scenarios)))
    check_once("lab bodies: two scenes", (scene.name for scene in loaded))
    scenes = {scene.name: scene for scene in loaded}
    console = Console(highlight=False)
    with console.status("compiling") as status:
        bench = bodies.BodiesBench(scenes, tuple(dict.fromkeys(described_by)), seed)
        forget_kept_compilations()
        measured = bench.run(lambda done: status.update(f"looking {done}/{len(scenes)}"))
        if out is not None:
            save_json(measured.value(), out)
    console.print(bodies_tables(measured))


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
    from mechsearch_jax.benchmarks.lab.tables import sensors_table
    from mechsearch_jax.runtime.files import save_json

    check_files(out)
    at_least_one("lab sensors", scenes=scenes)
    console = Console(highlight=False)
    with console.status("measuring"):
        columns = {} if real is None else sensors.real_columns(real)
        columns |= sensors.simulated_columns(scenes)
        if out is not None:
            save_json(columns, out)
    console.print(sensors_table(columns))


def bench_confidence(*, scenes: int = 250) -> None:
    """Measure how often recognised objects are right by their stated confidence, on simulated tables and shelves before
    all sensors, and fit the constants that it is computed with to every other scene.

    Args:
      scenes: how many are looked at; those of odd numbers are judged.

    Raises:
      InputError: there is none.
    """
    import numpy as np
    from rich.console import Console
    from scipy.special import expit

    from mechsearch_jax.benchmarks.lab.looks import confidences
    from mechsearch_jax.benchmarks.report.console_tables import plain_table

    at_least_one("lab confidence", scenes=scenes)
    console = Console(highlight=False)
    with console.status("compiling") as status:
        rows = confidences.looked_at(scenes, lambda done: status.update(f"looking {done}/{scenes}"))
    about, right = np.stack(rows.logarithms), rows.right.to_numpy()
    fitted_to = (rows.scene % 2 == 0).to_numpy()
    found = confidences.constants(about[fitted_to], right[fitted_to])
    rows["fitted"] = expit(-(found[0] + about @ found[1:]))
    table = plain_table(f"of the scenes that nothing is fitted to, {(~fitted_to).sum()} objects")
    for name in ("confidence", "from", "to", "objects", "right", "stated"):
        table.add_column(name, justify="left" if name == "confidence" else "right")
    judged = rows[~fitted_to]
    groups = {"all": judged, "usual shelf": judged[judged.usual], "others": judged[~judged.usual]}
    groups |= {sensor: judged[judged.sensor == sensor] for sensor in sorted(set(judged.sensor))}
    for kind in ("confidence", "fitted"):
        for line in confidences.reliability(np.asarray(judged[kind]), np.asarray(judged.right)):
            table.add_row(kind, *(f"{line[name]:.2f}" if name != "objects" else str(line[name]) for name in line))
        for name, group in groups.items():
            sure = group[group[kind] >= SURE]
            if len(sure):
                figures = (str(len(sure)), f"{sure.right.mean():.2f}", f"{sure[kind].mean():.2f}")
                table.add_row(f"{kind}, {name}", f"{SURE:.2f}", "1.00", *figures)
    console.print(table)
    console.print("fitted constants:", ", ".join(f"{number:.3f}" for number in found))


COMMANDS = {"looks": bench_looks, "bodies": bench_bodies, "sensors": bench_sensors, "confidence": bench_confidence}
