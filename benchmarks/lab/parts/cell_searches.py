"""Searches from images in a simulated cell, through `Searcher` alone: `python -m mechsearch_jax.benchmarks.lab cell`.

A configuration file describes the cell. In each generated scene with a hidden target the searcher gets the images of a
noisy camera, and a simulated arm follows its trajectories. Nothing else passes between the two; the true scene serves
only to score the recognised one.
"""

from __future__ import annotations

import dataclasses
import json
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.benchmarks.statistics.intervals import wilson
from mechsearch_jax.envs.cell.loading import searcher_of
from mechsearch_jax.envs.cell.simulated_cell import SensorNoise, SimulatedCell
from mechsearch_jax.envs.scenes.generator import ScenarioGenerator
from mechsearch_jax.images.colour import TargetColour
from mechsearch_jax.observation import Observation
from mechsearch_jax.problem.cache import keep_compilations
from mechsearch_jax.problem.settings import Settings, load_settings
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, read_json, save_json
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.session.searcher import Searcher
from mechsearch_jax.session.step import SearchStep
from mechsearch_jax.workspace.detector import found_pixels
from mechsearch_jax.workspace.scenario import Scenario, rotation_matrix

# A search ends after this number of consecutive looks without a motion.
PATIENCE = 3
# A recognised object whose centre is this deep inside the target, or vice versa, is a phantom [m].
INSIDE = 0.005
# A recognised target whose axis is farther than this from the true one is misplaced: a hand would grasp beside it [m].
MISPLACED = 0.02
# A recognised object whose centre is farther than this from the centres of all bodies is astray [m].
ASTRAY = 0.06


@dataclasses.dataclass(frozen=True)
class Conditions:
    """What differs from search to search, in turn: the number of objects fastest, then the target's colour, then noise.

    All depends on a scene's seed alone, so that a run can be divided.

    Attributes:
      objects: numbers of objects.
      colours: of the target, red, green and blue in 0 to 1; the configuration file's if empty.
      colour_noise: standard deviations of every channel of the camera's images, in shares of full brightness.
      depth_noise: standard deviation of the depth [m].
    """

    objects: tuple[int, ...] = (2, 4, 6)
    colours: tuple[tuple[float, float, float], ...] = ()
    colour_noise: tuple[float, ...] = (4 / 255,)
    depth_noise: float = 0.001

    def __post_init__(self):
        for colour in self.colours:
            TargetColour.lit(colour)
        for noise in self.colour_noise:
            SensorNoise(depth=self.depth_noise, colour=noise)

    def count(self, seed: int) -> int:
        """The number of objects."""
        return self.objects[seed % len(self.objects)]

    def settings(self, settings: Settings, seed: int) -> Settings:
        """The settings with the target's colour."""
        if not self.colours:
            return settings
        colour = self.colours[seed // len(self.objects) % len(self.colours)]
        return dataclasses.replace(settings, workcell=dataclasses.replace(settings.workcell, colour=colour))

    def noise(self, seed: int) -> SensorNoise:
        """The camera's noise."""
        turn = seed // (len(self.objects) * max(len(self.colours), 1))
        return SensorNoise(depth=self.depth_noise, colour=self.colour_noise[turn % len(self.colour_noise)])


@dataclasses.dataclass(frozen=True)
class CellRow:
    """The result of one search.

    Attributes:
      seed, objects: of the search and its scene.
      colour, colour_noise: of the target, red, green and blue in 0 to 1, and of the camera.
      retrieved: whether the target was taken out and nothing fell off the board.
      found_step: number of motions before the target was first seen; None if it never was.
      motions: number of planned motions.
      failed: number of motions that the arm could not follow, or that missed the target.
      ended: how it ended, in a few words.
      phantoms: number of looks with an object recognised in or on a target in sight.
      undetected: number of looks with an undetected target in sight.
      misplaced: number of looks with the target recognised where it does not stand; None in rows of before it counted.
      astray: number of looks with an object recognised where nothing stands.
      idle: reasons of the looks without a motion.
      warnings: of all looks, with their numbers.
      actions: kinds of the motions.
      seconds: of each look and decision [s].
      error: the traceback of an exception; None without one.
      scene: its name.
    """

    seed: int
    objects: int
    colour: tuple[float, float, float]
    colour_noise: float
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
    misplaced: int | None = None
    scene: str = ""


def run_search(
    searcher: Searcher,
    cell: SimulatedCell,
    seed: int,
    max_motions: int,
    on_step: Callable[[SearchStep], None] = lambda step: None,
) -> CellRow:
    """Run one search to its end.

    Args:
      searcher: new.
      cell: set up with a scene.
      seed: of the scene.
      max_motions: largest number of motions.
      on_step: called with every step.
    """
    found_step, failed, in_a_row = None, 0, 0
    phantoms = undetected = astray = misplaced = 0
    idle: list[str] = []
    actions: list[str] = []
    seconds: list[float] = []
    warnings: Counter[str] = Counter()
    ended, error, retrieved = "too many motions", None, False
    try:
        while len(actions) < max_motions and in_a_row < PATIENCE:
            look, pixels = cell.look(), cell.target_pixels()
            begin = time.perf_counter()
            step = searcher.next(*look, joints=cell.joints, width=cell.width)
            seconds.append(round(time.perf_counter() - begin, 3))
            on_step(step)
            warnings.update(step.warnings)
            if bool(step.observation.target_visible):
                found_step = len(actions) if found_step is None else found_step
                misplaced += _misplaced(cell, step.observation)
            # By the true scene: the searcher may take an undetected target for an object.
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
        # An error ends only its search.
        ended, error = "error", traceback.format_exc()
    return CellRow(
        seed=seed,
        objects=len(cell.scenario("now").objects),
        colour=cell.workcell.colour,
        colour_noise=cell.noise.colour,
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
        misplaced=misplaced,
    )


def _misplaced(cell: SimulatedCell, observation: Observation) -> bool:
    """Whether a recognised target is not where the target stands."""
    apart = np.asarray(observation.target_pose)[:2] - cell.scenario("now").target.position[:2]
    return bool(np.linalg.norm(apart) > MISPLACED)


def _in_target(cell: SimulatedCell, observation: Observation) -> list[bool]:
    """Which recognised objects are in or on the target: the centre of one is inside the other."""
    truth = cell.scenario("now").target
    half, centre = np.array(truth.half_size), np.array(truth.position)
    objects = observation.objects
    positions = np.asarray(objects.position, float)
    in_target = _inside(positions, centre, rotation_matrix(truth.quaternion), half - INSIDE)
    contains = [
        bool(_inside(centre[None], position, np.asarray(rotation), np.asarray(size) - INSIDE)[0])
        for position, rotation, size in zip(positions, objects.rotation, objects.size, strict=True)
    ]
    return (np.asarray(objects.valid) & (in_target | np.array(contains))).tolist()


def _astray(cell: SimulatedCell, observation: Observation) -> list[bool]:
    """Which recognised objects are where nothing stands."""
    scene = cell.scenario("now")
    centres = np.array([body.position for body in (*scene.objects, scene.target)])
    positions = np.asarray(observation.objects.position, float)
    apart = np.linalg.norm(positions[:, None, :2] - centres[None, :, :2], axis=-1).min(axis=1)
    return (np.asarray(observation.objects.valid) & (apart > ASTRAY)).tolist()


def _inside(
    points: Float[np.ndarray, "n 3"],
    centre: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    half: Float[np.ndarray, "3"],
) -> np.ndarray:
    return np.all(np.abs((points - centre) @ rotation) <= np.maximum(half, 0.0), axis=1)


def random_scenes(config: Path, conditions: Conditions, seeds: Iterable[int]) -> list[tuple[str, int, Scenario]]:
    """Scenes with a hidden target in the cell of a configuration file, with their names and seeds.

    Raises:
      InputError: the file is wrong, or no target can be hidden in its cell.
    """
    generator = ScenarioGenerator.of(load_settings(config))
    scenes = [(seed, generator.generate(seed, conditions.count(seed))) for seed in seeds]
    return [(f"{seed}-{len(scene.objects)}", seed, scene) for seed, scene in scenes]


def run_cell(
    config: Path,
    out: Path,
    conditions: Conditions,
    starts: Sequence[tuple[str, int, Scenario]],
    on_progress: Callable[[int, str], None] = lambda done, next_search: None,
) -> list[CellRow]:
    """Run searches in the cell of a configuration file; those with a row in the folder are not run again.

    Args:
      config: the file.
      out: folder for a row of every search, and pictures of those that failed.
      conditions: what differs from search to search.
      starts: name, seed and scene of each search.
      on_progress: called with the number of searches so far, and a description of the next.

    Raises:
      InputError: the file is wrong, its cell cannot work, or the folder holds rows of another identity.
    """
    settings = load_settings(config)
    identity = {
        "config": config.read_text(encoding="utf-8"),
        "conditions": json.loads(json.dumps(dataclasses.asdict(conditions))),
        "code": present_code(),
    }
    keep_compilations()
    rows = []
    on_progress(0, "preparing")
    for number, (name, seed, scenario) in enumerate(starts):
        file = out / f"search-{name}.json"
        if file.is_file():
            rows.append(_read_row(file, identity))
            continue
        on_progress(number, f"{name}: {len(scenario.objects)} objects, seed {seed}")
        steps: list[SearchStep] = []
        own = conditions.settings(settings, seed)
        noise, colour = conditions.noise(seed), own.workcell.colour
        cell = SimulatedCell(own.workcell, scenario, noise=noise, target_colour=colour, seed=seed)
        row = run_search(searcher_of(own, seed=seed), cell, seed, own.config.max_steps + 1, steps.append)
        row = dataclasses.replace(row, scene=scenario.name)
        if steps and not row.retrieved:
            for step in steps:
                step.picture.savefig(out / f"search-{name}-{step.index}.png")
        save_json({**identity, "row": dataclasses.asdict(row)}, file)
        rows.append(row)
    on_progress(len(starts), "done")
    return rows


def _read_row(file: Path, identity: dict[str, Any]) -> CellRow:
    value = read_json(file)
    if any(value.get(name) != expected for name, expected in identity.items()):
        raise InputError(f"{file}: is of another configuration, noise or code; give an empty folder with --out")
    row = value["row"]
    tuples = {name: tuple(row[name]) for name in ("colour", "idle", "actions", "seconds")}
    return CellRow(**{**row, **tuples})


def summary(rows: Sequence[CellRow]) -> dict[str, Any]:
    """Counts over all searches; the interval is Wilson's, since every search has a different scene."""
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
        "looks_with_target_misplaced": sum(row.misplaced or 0 for row in rows),
        "looks_with_object_astray": sum(row.astray for row in rows),
        "errors": sum(row.error is not None for row in rows),
        "seconds_per_step_median": round(float(np.median(steady)), 2) if steady else None,
    }


def save_rows(rows: Sequence[CellRow], config: Path, conditions: Conditions, command: str, path: PathLike) -> None:
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
            "conditions": dataclasses.asdict(conditions),
            "summary": summary(rows),
            "rows": [json.loads(json.dumps(dataclasses.asdict(row))) for row in rows],
        },
        path,
    )
