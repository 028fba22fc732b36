"""What programs of this package keep on disk between runs: compiled functions and built problems."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import operator
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mechsearch_jax.actions.config import ActionTables
from mechsearch_jax.config.config import ProblemConfig
from mechsearch_jax.existence import ExistenceTables
from mechsearch_jax.geometry.collision import Clouds, Dense
from mechsearch_jax.grasping.graspability import CandidateGrasps, GraspTables
from mechsearch_jax.problem import problem as problems
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.compiled import keep_in
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.kept_arrays import cache_folder, forget_old, load_arrays, save_arrays
from mechsearch_jax.runtime.own_settings import in_own_settings
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.runtime.versions import source_digest
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.sight import check_camera
from mechsearch_jax.workspace.target import Target

# So many built problems are kept, for users who switch between versions of the package.
CACHED_PROBLEMS = 6

# The tables of a problem, and those within them.
_PARTS = {"existence": ExistenceTables, "grasps": CandidateGrasps, "actions": ActionTables, "retrieval": GraspTables}
_TABLES: Mapping[str, Any] = {**_PARTS, "swept": Clouds, "dense": Dense}
_ARRAYS = ("poses", "cell")


def keep_compilations() -> None:
    """Make this process keep what JAX compiles, so that the next one starts in seconds.

    For programs; the library does not call it by itself. JAX's own cache stays as it is if the user has set
    `JAX_COMPILATION_CACHE_DIR`.
    """
    folder = cache_folder()
    if folder is None:
        return
    keep_in(folder / "executables")
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # Also short compilations: a start needs many, which add up to most of a second.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


@in_own_settings
def cached_problem(
    target: Target | None = None,
    config: ProblemConfig | None = None,
    *,
    camera: Camera | None = None,
    shelf: Shelf | None = None,
    gripper: Gripper | None = None,
) -> Problem:
    """`build_problem`, read from disk if the same problem was built before.

    The key of a file is made of the package's source, the versions of its dependencies, the device and the arguments. A
    problem whose file is damaged is built again; if the folder cannot be written to, nothing is kept.

    Raises:
      InputError: as `build_problem`.
    """
    parts = _parts(target, config, camera, shelf, gripper)
    check_camera(parts["camera"], parts["shelf"])
    folder = cache_folder()
    if folder is None:
        return problems.build_problem(**parts)
    key = _key(parts)
    file = _file(folder, key)
    problem = _load(file, key, parts)
    if problem is None:
        problem = problems.build_problem(**parts)
        with contextlib.suppress(InputError):
            _save(problem, file, key)
            forget_old(folder, "problem", CACHED_PROBLEMS)
    return problem


def is_cached(
    target: Target | None = None,
    config: ProblemConfig | None = None,
    *,
    camera: Camera | None = None,
    shelf: Shelf | None = None,
    gripper: Gripper | None = None,
) -> bool:
    """Whether `cached_problem` would find a file."""
    folder = cache_folder()
    return folder is not None and _file(folder, _key(_parts(target, config, camera, shelf, gripper))).is_file()


def _parts(
    target: Target | None,
    config: ProblemConfig | None,
    camera: Camera | None,
    shelf: Shelf | None,
    gripper: Gripper | None,
) -> dict[str, Any]:
    """The arguments of `build_problem`."""
    return {
        "camera": camera or Camera(),
        "shelf": shelf or Shelf(),
        "gripper": gripper or Gripper(),
        "target": target or Target(),
        "config": config or ProblemConfig(),
    }


def _file(folder: Path, key: str) -> Path:
    return folder / f"problem-{key[:32]}.npz"


@functools.cache
def _source() -> str:
    """SHA-256 of the source that builds problems."""
    return source_digest((".py",))


def _key(parts: dict[str, Any]) -> str:
    device = jax.devices()[0]
    versions = [importlib.metadata.version(name) for name in ("jax", "jaxlib", "numpy", "scipy", "trimesh")]
    key = (_source(), versions, device.platform, device.device_kind, parts)
    return hashlib.sha256(repr(key).encode()).hexdigest()


def _save(problem: Problem, file: Path, key: str) -> None:
    arrays = {name: np.asarray(getattr(problem, name)) for name in _ARRAYS}
    for table in _PARTS:
        arrays |= _named(getattr(problem, table), table)
    save_arrays(arrays, file, key)


def _named(value: Any, name: str) -> dict[str, np.ndarray]:
    """The arrays of a table and of the tables in it, by names such as "grasps.swept.points"."""
    if not isinstance(value, PyTreeNode):
        return {name: np.asarray(value)}
    return functools.reduce(operator.or_, (_named(part, f"{name}.{field}") for field, part in vars(value).items()))


def _table(name: str, arrays: Mapping[str, np.ndarray]) -> Any:
    """The inverse of `_named`."""
    if name in arrays:
        return jax.device_put(arrays[name])
    kind = _TABLES[name.rpartition(".")[2]]
    return kind(**{field.name: _table(f"{name}.{field.name}", arrays) for field in dataclasses.fields(kind)})


def _load(file: Path, key: str, parts: dict[str, Any]) -> Problem | None:
    """The problem in a file; None if it is missing, damaged or has another key."""
    arrays = load_arrays(file, key)
    if arrays is None:
        return None
    try:
        places = {name: jax.device_put(arrays.pop(name)) for name in _ARRAYS}
        return Problem(**places, **{name: _table(name, arrays) for name in _PARTS}, **parts)
    except (ValueError, KeyError, TypeError):
        return None
