"""What scenes are like at their start: where the target can be, and how much the camera sees of it and of the objects.

Made to compare sets of scenes with each other, as generated ones with published ones. Nothing is recognised: shapes and
poses are the true ones.
"""

from __future__ import annotations

import dataclasses
import functools
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mechsearch_jax.benchmarks.parts.exact_existence import SIDE, exact_existence
from mechsearch_jax.benchmarks.parts.images import save_rows
from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.envs.camera.simulated_camera import target_pixels
from mechsearch_jax.envs.episode.episodes import target_of
from mechsearch_jax.envs.world.world import TARGET, World, from_scenario, true_superquadrics
from mechsearch_jax.images.cloud import shelf_view
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Problem, initial_belief, update_belief
from mechsearch_jax.problem.cache import cached_problem
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.train.scenes import PIXELS, cast_world
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.detector import FOUND_PIXELS
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target


@dataclasses.dataclass(frozen=True)
class Row:
    """What one scene is like.

    Attributes:
      source: the folder or set that it is of.
      scenario, content_hash: its name, and what it holds.
      objects: how many surround the target.
      target: its shape.
      possible: number of candidate poses where the target can be, the size of f.
      candidates: how many there are.
      truth_possible: whether the target can be at the candidate pose that is nearest to its own.
      target_pixels: of the full image that show the target.
      target_share: that number over the one that there would be if it stood alone.
      visible: how many objects show at least 100 pixels of themselves.
      objects_share: mean over the objects of what each shows of the pixels that it would show if it stood alone.
      exact_cells: number of poses whose cell holds a place where a target is hidden, by brute force; None if not asked.
      exact_missed: how many of these f lacks.
      exact_poses: number of poses that are such places themselves.
    """

    source: str
    scenario: str
    content_hash: str
    objects: int
    target: str
    possible: int
    candidates: int
    truth_possible: bool
    target_pixels: int
    target_share: float
    visible: int
    objects_share: float
    exact_cells: int | None = None
    exact_missed: int | None = None
    exact_poses: int | None = None


@jax.jit
def _possible(problem: Problem, world: World) -> Array:
    """f of the first look, as if the target were hidden also where it is not."""
    unseen = Observation(true_superquadrics(world), jnp.array(False), jnp.zeros(3))
    return update_belief(problem, initial_belief(problem), unseen).exists


@functools.partial(jax.jit, static_argnames=("shelf",))
def _seen(shelf: Shelf, world: World) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """Pixels of the full image that show each object, and those that it would show alone; every second row and column
    counted for all."""
    view = shelf_view(shelf=shelf)
    _, owner, alone = cast_world(view.camera, shelf, world)
    pixels = jnp.sum(owner[..., None] == jnp.arange(TARGET).reshape(1, 1, -1), axis=(0, 1))
    return pixels * view.stride**2, alone[:TARGET] * view.stride**2


def nearest_pose(target: Target, shelf: Shelf, pose: Float[np.ndarray, " 3"]) -> int:
    """Index of the candidate pose that is nearest to a pose (x, y [m], yaw [rad]): first in place, then in yaw."""
    candidates = target.candidate_poses(shelf).astype(float)
    place = np.hypot(*(candidates[:, :2] - pose[:2]).T)
    turn = (candidates[:, 2] - pose[2] + np.pi / 2) % np.pi - np.pi / 2
    at_place = place <= place.min() + 1e-6
    return int(np.flatnonzero(at_place)[np.argmin(np.abs(turn[at_place]))])


def look_at(
    source: str, scenario: Scenario, problem: Problem, camera: Camera, shelf: Shelf, exact: bool = False
) -> Row:
    """What a scene is like.

    Args:
      source: what to call where it comes from.
      scenario: the scene.
      problem: built for its target.
      camera, shelf: static.
      exact: whether to look at f by brute force, too.
    """
    world = from_scenario(scenario)
    only_target = world.replace(valid=jnp.arange(TARGET + 1) == TARGET)
    exists = np.asarray(_possible(problem, world))
    pixels, alone = (np.asarray(a)[: len(scenario.objects)] for a in _seen(shelf, world))
    shown, whole = (int(target_pixels(camera, one)) for one in (world, only_target))
    body = scenario.target
    yaw = 2 * np.arctan2(body.quaternion[3], body.quaternion[0])
    truth = nearest_pose(problem.target, shelf, np.array([*body.position[:2], yaw]))
    counted = {}
    if exact:
        cells, poses = (np.asarray(exact_existence(problem, true_superquadrics(world), side)) for side in (SIDE, 1))
        counted = {
            "exact_cells": int(cells.sum()),
            "exact_missed": int((cells & ~exists).sum()),
            "exact_poses": int(poses.sum()),
        }
    return Row(
        source=source,
        scenario=scenario.name,
        content_hash=scenario.content_hash,
        objects=len(scenario.objects),
        target=body.shape,
        possible=int(exists.sum()),
        candidates=len(exists),
        truth_possible=bool(exists[truth]),
        target_pixels=shown,
        target_share=round(shown / max(whole, 1), 4),
        visible=int((pixels >= PIXELS).sum()),
        objects_share=round(float(np.mean(pixels / np.maximum(alone, 1))), 4) if len(pixels) else 1.0,
        **counted,
    )


def look_at_all(
    sources: Mapping[str, Sequence[Scenario]], watcher: Callable[[int], None] = lambda done: None, exact: bool = False
) -> list[Row]:
    """What the scenes of several sources are like.

    Args:
      sources: scenes by the name of where they come from.
      watcher: is told how many are done.
      exact: whether to look at f by brute force, too, which takes seconds a scene.

    Raises:
      InputError: a target cannot be grasped.
    """
    camera, shelf = Camera(), Shelf()
    problems = functools.cache(cached_problem)
    rows: list[Row] = []
    for source, scenarios in sources.items():
        for scenario in scenarios:
            rows.append(look_at(source, scenario, problems(target_of(scenario)), camera, shelf, exact))
            watcher(len(rows))
    return rows


def summary(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Figures for each source and number of objects, in the rows' order of sources."""
    groups: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.source, row.objects), []).append(row)
    places = {source: i for i, source in enumerate(dict.fromkeys(row.source for row in rows))}
    return [
        {"source": source, "objects": objects, **_figures(groups[source, objects])}
        for source, objects in sorted(groups, key=lambda key: (places[key[0]], key[1]))
    ]


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    possible = [row.possible for row in rows]
    p10, p90 = np.percentile(possible, (10, 90))
    return {
        "scenes": len(rows),
        "possible_mean": statistics.mean(possible),
        "possible_standard_error": statistics.stdev(possible) / len(rows) ** 0.5 if rows[1:] else None,
        "possible_median": float(statistics.median(possible)),
        "possible_p10": float(p10),
        "possible_p90": float(p90),
        "possible_share": statistics.mean(row.possible / row.candidates for row in rows),
        "truth_ruled_out": sum(not row.truth_possible for row in rows),
        "target_hidden": sum(row.target_pixels == 0 for row in rows),
        "target_below_threshold": sum(0 < row.target_pixels <= FOUND_PIXELS for row in rows),
        "target_found": sum(row.target_pixels > FOUND_PIXELS for row in rows),
        "target_share_mean": statistics.mean(row.target_share for row in rows),
        "visible_mean": statistics.mean(row.visible for row in rows),
        "objects_share_mean": statistics.mean(row.objects_share for row in rows),
        **_by_brute_force([row for row in rows if row.exact_cells is not None]),
    }


def _by_brute_force(rows: Sequence[Row]) -> dict[str, Any]:
    """Figures of the scenes in which f was found by brute force, too; nothing if there are none."""
    if not rows:
        return {}
    cells, missed, poses = (sum(getattr(row, f"exact_{name}") for row in rows) for name in ("cells", "missed", "poses"))
    return {
        "exact_scenes": len(rows),
        "possible_over_exact_cells": sum(row.possible for row in rows) / max(cells, 1),
        "exact_cells_over_exact_poses": cells / max(poses, 1),
        "exact_missed_share": missed / max(cells, 1),
    }


def save_scenes(rows: Sequence[Row], path: PathLike) -> None:
    """Write the figures and all rows as JSON.

    Raises:
      InputError: there are no rows, or the file cannot be written.
    """
    if not rows:
        raise InputError("bench scenes: there are no scenes; name a file, a folder or a scene set")
    save_rows({"code": present_code(), "versions": versions(), "summary": summary(rows)}, rows, path)
