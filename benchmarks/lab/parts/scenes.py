"""Statistics of scenes at their start: where the target can be, and how much of target and objects is visible.

They compare sets of scenes, such as generated with published ones, using the true shapes and poses.
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

from mechsearch_jax.benchmarks.lab.parts.exact_existence import SIDE, exact_existence
from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.benchmarks.store.json_rows import save_rows
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
from mechsearch_jax.train.scenes import PIXELS, cast_world, object_pixels
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.detector import FOUND_PIXELS
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target


@dataclasses.dataclass(frozen=True)
class SceneRow:
    """Statistics of one scene.

    Attributes:
      source: its folder or set.
      scenario, content_hash: of the scenario.
      objects: number of objects around the target.
      target: its shape.
      possible: number of candidate poses where the target can be, the size of f.
      candidates: number of candidate poses.
      truth_possible: whether the target can be at the candidate pose nearest to its true one.
      target_pixels: number of pixels of the full image that show the target.
      target_share: that number divided by the one without any objects.
      visible: number of objects that show at least 100 pixels.
      objects_share: mean over the objects of the visible share of their pixels.
      exact_cells: number of poses whose cell contains a place where a target is hidden, by brute force; None if not
        computed.
      exact_missed: number of these cells that f lacks.
      exact_poses: number of poses where a target is hidden, by brute force.
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
    """f of the first look, as if the target were hidden even if it is not."""
    unseen = Observation(true_superquadrics(world), jnp.array(False), jnp.zeros(3))
    return update_belief(problem, initial_belief(problem), unseen).exists


@functools.partial(jax.jit, static_argnames=("shelf",))
def _seen(shelf: Shelf, world: World) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """Number of pixels of the full image that show each object, and without other objects, from a thinned image."""
    view = shelf_view(shelf=shelf)
    _, owner, alone = cast_world(view.camera, shelf, world)
    return object_pixels(owner) * view.stride**2, alone[:TARGET] * view.stride**2


def nearest_pose(target: Target, shelf: Shelf, pose: Float[np.ndarray, " 3"]) -> int:
    """Index of the candidate pose that is nearest to a pose (x, y [m], yaw [rad]): first in place, then in yaw."""
    candidates = target.candidate_poses(shelf).astype(float)
    place = np.hypot(*(candidates[:, :2] - pose[:2]).T)
    turn = (candidates[:, 2] - pose[2] + np.pi / 2) % np.pi - np.pi / 2
    at_place = place <= place.min() + 1e-6
    return int(np.flatnonzero(at_place)[np.argmin(np.abs(turn[at_place]))])


def look_at(
    source: str, scenario: Scenario, problem: Problem, camera: Camera, shelf: Shelf, exact: bool = False
) -> SceneRow:
    """The statistics of a scene.

    Args:
      source: name of its folder or set.
      scenario: the scene.
      problem: built for its target.
      camera, shelf: static.
      exact: whether to compute f by brute force, too.
    """
    world = from_scenario(scenario)
    only_target = world.replace(valid=jnp.arange(TARGET + 1) == TARGET)
    exists = np.asarray(_possible(problem, world))
    pixels, alone = (np.asarray(a)[: len(scenario.objects)] for a in _seen(shelf, world))
    shown, whole = (int(target_pixels(camera, bodies)) for bodies in (world, only_target))
    body = scenario.target
    yaw = 2 * np.arctan2(body.quaternion[3], body.quaternion[0])
    truth = nearest_pose(problem.target, shelf, np.array([*body.position[:2], yaw]))
    by_brute_force = {}
    if exact:
        cells, poses = (np.asarray(exact_existence(problem, true_superquadrics(world), side)) for side in (SIDE, 1))
        by_brute_force = {
            "exact_cells": int(cells.sum()),
            "exact_missed": int((cells & ~exists).sum()),
            "exact_poses": int(poses.sum()),
        }
    return SceneRow(
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
        **by_brute_force,
    )


def look_at_all(
    sources: Mapping[str, Sequence[Scenario]],
    on_progress: Callable[[int], None] = lambda done: None,
    exact: bool = False,
) -> list[SceneRow]:
    """The statistics of the scenes of several sources.

    Args:
      sources: scenes by the name of their folder or set.
      on_progress: called with the number of scenes so far.
      exact: whether to compute f by brute force, too, which takes seconds per scene.

    Raises:
      InputError: a target cannot be grasped.
    """
    camera, shelf = Camera(), Shelf()
    problems = functools.cache(cached_problem)
    rows: list[SceneRow] = []
    for source, scenarios in sources.items():
        for scenario in scenarios:
            rows.append(look_at(source, scenario, problems(target_of(scenario)), camera, shelf, exact))
            on_progress(len(rows))
    return rows


def summary(rows: Sequence[SceneRow]) -> list[dict[str, Any]]:
    """Figures for each source, in the rows' order, and number of objects."""
    groups: dict[tuple[str, int], list[SceneRow]] = {}
    for row in rows:
        groups.setdefault((row.source, row.objects), []).append(row)
    places = {source: i for i, source in enumerate(dict.fromkeys(row.source for row in rows))}
    return [
        {"source": source, "objects": objects, **_figures(groups[source, objects])}
        for source, objects in sorted(groups, key=lambda key: (places[key[0]], key[1]))
    ]


def _figures(rows: Sequence[SceneRow]) -> dict[str, Any]:
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


def _by_brute_force(rows: Sequence[SceneRow]) -> dict[str, Any]:
    """Figures of scenes with f by brute force, too; empty if there are none."""
    if not rows:
        return {}
    cells, missed, poses = (sum(getattr(row, f"exact_{name}") for row in rows) for name in ("cells", "missed", "poses"))
    return {
        "exact_scenes": len(rows),
        "possible_over_exact_cells": sum(row.possible for row in rows) / max(cells, 1),
        "exact_cells_over_exact_poses": cells / max(poses, 1),
        "exact_missed_share": missed / max(cells, 1),
    }


def save_scenes(rows: Sequence[SceneRow], path: PathLike) -> None:
    """Write figures and rows as JSON.

    Raises:
      InputError: there are no rows, or the file cannot be written.
    """
    if not rows:
        raise InputError("lab scenes: there are no scenes; name a file, a folder or a scene set")
    save_rows({"code": present_code(), "versions": versions(), "summary": summary(rows)}, rows, path)
