"""What the arm reaches in a cell, and how well its camera can be placed."""

from __future__ import annotations

from typing import Literal

from mechsearch_jax.commands.options import (
    DEFAULTS,
    EpisodeOptions,
    JsonFile,
    Scenarios,
    at_least_one,
    check_files,
    find_scenarios,
)


def bench_reach(
    *,
    grasps: Literal["candidates", "found"] = "candidates",
    out: JsonFile = None,
    options: EpisodeOptions = DEFAULTS,
) -> None:
    """Tell where a target that stands alone on the shelf can be grasped, and what rules its grasps out elsewhere.

    Args:
      grasps: those of g at candidate poses, or the denser ones of a found target.
      out: JSON file for the means across the shelf and for every candidate pose's row.
      options: of shelf, gripper, target and grasps; the others do not matter here.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.lab.reach.reach import reach, save_reach
    from mechsearch_jax.benchmarks.lab.tables import reach_table
    from mechsearch_jax.problem.cache import keep_compilations

    settings = options.settings()
    check_files(out)
    keep_compilations()
    problem = settings.config.problem
    chosen = problem.grasps if grasps == "candidates" else problem.retrieval
    console = Console(highlight=False)
    with console.status("reaching"):
        rows = reach(settings.workcell, chosen)
    if out is not None:
        save_reach(rows, chosen, out)
    console.print(reach_table(rows))


def bench_calibration(
    scenarios: Scenarios,
    /,
    *,
    offsets: int = 5,
    seed: int = 0,
    out: JsonFile = None,
) -> None:
    """Measure how well the shelf in a depth image tells how far the camera's pose is off: up to 20 mm and 3 degrees.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets.
      offsets: random ones for each scene and sensor, and as many looks without one.
      seed: of offsets and noise.
      out: JSON file for the figures and for every fit's row.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.lab.calibration.offsets import CalibrationBench
    from mechsearch_jax.benchmarks.lab.tables import calibration_table
    from mechsearch_jax.benchmarks.store.json_rows import save_rows
    from mechsearch_jax.workspace.scenario import load_scenario

    at_least_one("lab calibration", offsets=offsets)
    check_files(out)
    scenes = [load_scenario(file) for file in find_scenarios(scenarios)]
    console = Console(highlight=False)
    with console.status("looking") as status:
        bench = CalibrationBench(scenes, offsets, seed=seed)
        measured = bench.run(lambda done: status.update(f"looking {done}/{len(scenes)}"))
    if out is not None:
        save_rows(measured.value(), measured.rows, out)
    console.print(calibration_table(measured))


COMMANDS = {"reach": bench_reach, "calibration": bench_calibration}
