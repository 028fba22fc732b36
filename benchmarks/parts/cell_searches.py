"""Whole searches from images in a simulated cell, through `Searcher` alone: `mechsearch bench cell`.

One configuration file says what the cell is like. Of each generated scene with a hidden target the searcher sees what a
camera with noise delivers, and an arm in simulation follows the trajectories that it hands out. Nothing else passes
between the two; what is true of the scene is only compared with what was recognised.
"""

from __future__ import annotations

import dataclasses
import json
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.table import Table

from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.benchmarks.statistics.intervals import wilson
from mechsearch_jax.envs.cell.loading import load_searcher
from mechsearch_jax.envs.cell.simulated_cell import SensorNoise, SimulatedCell
from mechsearch_jax.envs.scenes.generator import ScenarioGenerator
from mechsearch_jax.observation import Observation
from mechsearch_jax.problem.settings import Settings, load_settings
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, read_json, save_json
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.session.searcher import Searcher
from mechsearch_jax.session.step import SearchStep
from mechsearch_jax.workspace.detector import found_pixels
from mechsearch_jax.workspace.scenario import Scenario, rotation_matrix

# A search is given up after so many looks in a row without a motion.
PATIENCE = 3
# A recognised object that reaches this far into the target's middle is in or on it [m].
INSIDE = 0.005
# A recognised object whose centre is farther than this from the centre of everything that stands there is none [m].
ASTRAY = 0.06


@dataclasses.dataclass(frozen=True)
class Row:
    """What came of one search.

    Attributes:
      seed, objects: which scene it was.
      retrieved: whether the target was taken out and nothing fell off the board.
      found_step: number of motions before the target was first seen; None where it never was.
      motions: number of motions that were handed out.
      failed: number of motions that the arm could not follow, or that missed the target.
      ended: how it ended, in a few words.
      phantoms: looks at which an object was recognised in or on a target in sight.
      undetected: looks at which a target in sight was not detected.
      astray: looks at which an object was recognised where nothing stands.
      idle: reasons of the looks without a motion.
      warnings: of all looks, and how often each was given.
      actions: kinds of the motions.
      seconds: that each look and decision took [s].
      error: the traceback of what was raised; None where nothing was.
    """

    seed: int
    objects: int
    retrieved: bool
    found_step: int | None
    motions: int
    failed: int
    ended: str
    phantoms: int
    undetected: int
    astray: int
    idle: tuple[str, ...]
    warnings: dict[str, int]
    actions: tuple[str, ...]
    seconds: tuple[float, ...]
    error: str | None = None


def run_search(
    searcher: Searcher,
    cell: SimulatedCell,
    seed: int,
    objects: int,
    max_motions: int,
    shown: Callable[[SearchStep], None] = lambda step: None,
) -> Row:
    """One search, from the first look to its end.

    Args:
      searcher: new.
      cell: set up with a scene.
      seed, objects: which scene it is.
      max_motions: after so many, a search whose target is not out has failed.
      shown: called with every step.
    """
    found_step, failed, in_a_row = None, 0, 0
    phantoms = undetected = astray = 0
    idle: list[str] = []
    actions: list[str] = []
    seconds: list[float] = []
    warnings: Counter[str] = Counter()
    ended, error, retrieved = "too many motions", None, False
    try:
        while len(actions) < max_motions and in_a_row < PATIENCE:
            look, pixels = cell.look(), cell.target_pixels()
            begin = time.perf_counter()
            step = searcher.next(*look, joints=cell.joints)
            seconds.append(round(time.perf_counter() - begin, 3))
            shown(step)
            warnings.update(step.warnings)
            if bool(step.observation.target_visible):
                found_step = len(actions) if found_step is None else found_step
            # As the scene is, not as it is recognised: an undetected target may be an object to the searcher.
            if pixels > found_pixels(cell.workcell.camera):
                phantoms += any(_in_target(cell, step.observation))
                undetected += not bool(step.observation.target_visible)
            astray += any(_astray(cell, step.observation))
            if step.trajectory is None:
                idle.append(step.reason)
                in_a_row += 1
                ended = "no motion"
                continue
            in_a_row = 0
            done = cell.follow(step.trajectory)
            actions.append(step.kind)
            failed += not done.ok
            searcher.acted(ok=done.ok)
            retrieved = done.retrieved
            if searcher.finished or cell.fallen.any():
                ended = "retrieved" if retrieved else "something fell" if cell.fallen.any() else "lost in the hand"
                break
            ended = "too many motions"
    except Exception:
        # An error belongs to its search.
        ended, error = "error", traceback.format_exc()
    return Row(
        seed=seed,
        objects=objects,
        retrieved=retrieved,
        found_step=found_step,
        motions=len(actions),
        failed=failed,
        ended=ended,
        phantoms=phantoms,
        undetected=undetected,
        astray=astray,
        idle=tuple(idle),
        warnings=dict(warnings),
        actions=tuple(actions),
        seconds=tuple(seconds),
        error=error,
    )


def _in_target(cell: SimulatedCell, observation: Observation) -> list[bool]:
    """Which recognised objects are in or on the target: one's middle is in the other."""
    truth = cell.scenario("now").target
    half, centre = np.array(truth.half_size), np.array(truth.position)
    objects = observation.objects
    here = np.asarray(objects.position, float)
    in_target = _inside(here, centre, rotation_matrix(truth.quaternion), half - INSIDE)
    holds = [
        bool(_inside(centre[None], here[i], np.asarray(objects.rotation[i]), np.asarray(objects.size[i]) - INSIDE)[0])
        for i in range(len(here))
    ]
    return (np.asarray(objects.valid) & (in_target | np.array(holds))).tolist()


def _astray(cell: SimulatedCell, observation: Observation) -> list[bool]:
    """Which recognised objects are where nothing stands."""
    scene = cell.scenario("now")
    centres = np.array([body.position for body in (*scene.objects, scene.target)])
    here = np.asarray(observation.objects.position, float)
    apart = np.linalg.norm(here[:, None, :2] - centres[None, :, :2], axis=-1).min(axis=1)
    return (np.asarray(observation.objects.valid) & (apart > ASTRAY)).tolist()


def _inside(
    points: Float[np.ndarray, "n 3"],
    centre: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    half: Float[np.ndarray, "3"],
) -> np.ndarray:
    return np.all(np.abs((points - centre) @ rotation) <= np.maximum(half, 0.0), axis=1)


def scenes(settings: Settings, objects: Sequence[int], searches: int, seed: int) -> list[tuple[int, Scenario]]:
    """Scenes with a hidden target in a cell: their seeds, and what stands in them.

    A seed has the same number of objects in every run, so that parts of a run may be run apart.

    Raises:
      InputError: nothing can be hidden there.
    """
    generator = ScenarioGenerator.of(settings)
    return [(s, generator.generate(s, objects[s % len(objects)])) for s in range(seed, seed + searches)]


def run_cell(
    config: Path,
    out: Path,
    objects: Sequence[int],
    searches: int,
    seed: int,
    noise: SensorNoise,
    progress: Callable[[int, str], None] = lambda done, what: None,
) -> list[Row]:
    """Searches in the cell of a configuration file; those that have a row in the folder already are not run again.

    Args:
      config: the file.
      out: folder for a row and the last picture of every search.
      objects: numbers of objects, taken in turn.
      searches: how many.
      seed: of the first scene; the others follow.
      noise: of the camera.
      progress: told how many are done, and what comes next.

    Raises:
      InputError: the file is wrong, its cell cannot work, or the folder holds rows of something else.
    """
    settings = load_settings(config)
    usual = {"config": config.read_text(encoding="utf-8"), "noise": dataclasses.asdict(noise), "code": present_code()}
    rows = []
    progress(0, "preparing")
    for number, (scene_seed, scenario) in enumerate(scenes(settings, objects, searches, seed)):
        file = out / f"search-{scene_seed}-{len(scenario.objects)}.json"
        if file.is_file():
            rows.append(_read_row(file, usual))
            continue
        progress(number, f"{len(scenario.objects)} objects, seed {scene_seed}")
        steps: list[SearchStep] = []
        cell = SimulatedCell(
            settings.workcell, scenario, noise=noise, target_colour=settings.workcell.colour, seed=scene_seed
        )
        searcher = load_searcher(config, seed=scene_seed)
        row = run_search(searcher, cell, scene_seed, len(scenario.objects), settings.config.max_steps + 1, steps.append)
        if steps and not row.retrieved:
            for step in steps:
                step.picture.savefig(out / f"search-{scene_seed}-{step.index}.png")
        save_json({**usual, "row": dataclasses.asdict(row)}, file)
        rows.append(row)
    progress(searches, "done")
    return rows


def _read_row(file: Path, usual: dict[str, Any]) -> Row:
    value = read_json(file)
    if any(value.get(name) != said for name, said in usual.items()):
        raise InputError(f"{file}: is of another configuration, noise or code; give an empty folder with --out")
    row = value["row"]
    tuples = {name: tuple(row[name]) for name in ("idle", "actions", "seconds")}
    return Row(**{**row, **tuples})


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Counts over all searches; the interval is `rates.wilson`'s, every search being of a scene of its own."""
    retrieved = sum(row.retrieved for row in rows)
    steady = [second for row in rows for second in row.seconds[1:]]
    return {
        "searches": len(rows),
        "retrieved": retrieved,
        "retrieved_interval": wilson(retrieved, len(rows)),
        "found": sum(row.found_step is not None for row in rows),
        "ended": dict(Counter(row.ended for row in rows)),
        "motions": sum(row.motions for row in rows),
        "failed_motions": sum(row.failed for row in rows),
        "looks_with_phantom_in_target": sum(row.phantoms for row in rows),
        "looks_with_undetected_target": sum(row.undetected for row in rows),
        "looks_with_object_astray": sum(row.astray for row in rows),
        "errors": sum(row.error is not None for row in rows),
        "seconds_per_step_median": round(float(np.median(steady)), 2) if steady else None,
    }


def cell_table(rows: Sequence[Row]) -> Table:
    """One line for every search, and the counts of all."""
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    for name in ("seed", "objects", "found after", "motions", "failed", "phantoms", "ended"):
        table.add_column(name, justify="left" if name == "ended" else "right", no_wrap=True)
    for row in rows:
        found = "-" if row.found_step is None else str(row.found_step)
        numbers = (row.seed, row.objects, found, row.motions, row.failed, row.phantoms)
        table.add_row(*map(str, numbers), row.ended)
    counts = summary(rows)
    low, high = counts["retrieved_interval"]
    table.add_row(
        "all", "", str(counts["found"]), str(counts["motions"]), str(counts["failed_motions"]),
        str(counts["looks_with_phantom_in_target"]),
        f"{counts['retrieved']} of {counts['searches']} retrieved ({low:.2f} to {high:.2f})",
        style="bold",
    )  # fmt: skip
    return table


def save_rows(rows: Sequence[Row], config: Path, noise: SensorNoise, command: str, path: PathLike) -> None:
    """Write all rows with their summary.

    Raises:
      InputError: the file cannot be written.
    """
    save_json(
        {
            "command": command,
            "code": present_code(),
            "versions": versions(),
            "config": config.read_text(encoding="utf-8"),
            "noise": dataclasses.asdict(noise),
            "summary": summary(rows),
            "rows": [json.loads(json.dumps(dataclasses.asdict(row))) for row in rows],
        },
        path,
    )
