"""Checks whether a search is possible in the cell of a configuration file: one line for each part of the cell."""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import contextlib
import dataclasses
import enum
import functools
import importlib.metadata
import importlib.util
import io
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mechsearch_jax.envs.health.reach import lost_poses
from mechsearch_jax.images.trained_view import view_faults
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.problem.settings import Settings
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.searcher import LEAST_REACH
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.sight import blindness, camera_faults, share_seen

if TYPE_CHECKING:
    from mechsearch_jax.problem.settings import Settings
    from mechsearch_jax.workspace.scenario import Scenario


class State(enum.Enum):
    """How usable something is."""

    FINE = "fine"
    MISSING = "missing"  # The main job, one search on a CPU, does without.
    DOUBTFUL = "doubtful"  # It works, but less well than it should.
    BROKEN = "BROKEN"


@dataclasses.dataclass(frozen=True)
class Finding:
    """Result of a check.

    Attributes:
      subject: what was checked.
      state: how usable it is.
      says: one line of text.
      remedy: how to mend it; empty if nothing is wrong.
    """

    subject: str
    state: State
    says: str
    remedy: str = ""


PACKAGES = ("mechsearch-jax", "jax", "jaxlib", "flax", "numpy", "mujoco", "mujoco-mjx")
EXTRAS = ("warp-lang", "example-robot-data")
# Draws an empty picture through OpenGL.
_RENDER = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco/>")
with mujoco.Renderer(model, 8, 8) as renderer:
    renderer.update_scene(mujoco.MjData(model))
    renderer.render()
"""


Check = Callable[[], Iterator[Finding]]


def checks(scenario: Scenario | None, settings: Settings, cell: bool = False) -> Mapping[str, Check]:
    """All checks, by subject.

    Args:
      scenario: whose problem is looked up in the cache; None to skip that.
      settings: with which the problem would be built.
      cell: whether to check the cell of the settings, for which its problem is built.
    """
    by_subject = dict(CHECKS)
    if cell:
        # Takes long to import.
        from mechsearch_jax.envs.health import cell_health

        parts = {part: getattr(cell_health, part) for part in CELL}
        by_subject |= {part: functools.partial(check, settings) for part, check in parts.items()}
    if scenario is not None:
        by_subject["problem"] = lambda: _problem(scenario, settings)
    return by_subject


def examine(subject: str, check: Check) -> Iterator[Finding]:
    """The findings of a check; one that says so if the check itself fails."""
    try:
        yield from check()
    # The other checks stay useful whatever is broken.
    except Exception as error:
        state = State.BROKEN if subject in NEEDED else State.MISSING
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"[:300]
        yield Finding(subject, state, reason, "install again: pip install --force-reinstall mechsearch-jax")


def _versions() -> Iterator[Finding]:
    versions = {name: _version(name) for name in (*PACKAGES, *EXTRAS)}
    listed = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
    yield Finding("versions", State.FINE, f"Python {platform.python_version()}, {listed}")
    for name in PACKAGES:
        if not versions[name]:
            yield Finding("versions", State.BROKEN, f"{name} is not installed", f"pip install {name}")
    mujoco, mjx = _version("mujoco"), _version("mujoco-mjx")
    if mujoco and mjx and mujoco.split(".")[:2] != mjx.split(".")[:2]:
        says = f"mujoco {mujoco} and mujoco-mjx {mjx} are not of one release: batches may fail, or step otherwise"
        yield Finding("versions", State.DOUBTFUL, says, f"pip install mujoco=={mjx}")


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _devices() -> Iterator[Finding]:
    import jax

    from mechsearch_jax.runtime.cores import cores

    devices = jax.devices()
    names = ", ".join(f"{device.platform}: {device.device_kind}" for device in devices)
    yield Finding("devices", State.FINE, f"JAX computes on {names}; {cores()} cores")
    if jax.default_backend() == "cpu" and (shutil.which("nvidia-smi") or Path("/proc/driver/nvidia/version").exists()):
        yield Finding(
            "devices",
            State.MISSING,
            "there is an NVIDIA GPU that JAX does not see",
            "pip install 'mechsearch-jax[gpu]', and leave JAX_PLATFORMS unset",
        )


def _simulator() -> Iterator[Finding]:
    import mujoco

    from mechsearch_jax.envs.world import model
    from mechsearch_jax.workspace.camera import Camera
    from mechsearch_jax.workspace.shelf import Shelf

    compiled = model.compile_model(Shelf(), Camera())
    mujoco.mj_step(compiled, mujoco.MjData(compiled))
    yield Finding("simulator", State.FINE, "the native simulator, MuJoCo in C, steps the scene")


def _batches() -> Iterator[Finding]:
    from mechsearch_jax.envs.simulators.mjx_model import import_mjx

    try:
        import_mjx()
    except InputError as error:
        says, _, remedy = str(error).partition("; ")
        yield Finding("batches", State.MISSING, says, remedy)
        return
    import warp  # pyright: ignore[reportMissingImports]

    # Warp prints that there is no GPU; the finding says so instead.
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        gpus = [device.name for device in warp.get_cuda_devices()]
    devices = ", ".join(gpus) if gpus else "the CPU alone, slowly: no GPU is seen"
    yield Finding("batches", State.FINE, f"MJX and Warp {warp.config.version} work, on {devices}")


def _rendering() -> Iterator[Finding]:
    for backend in ("egl", "osmesa"):
        environment = {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
        try:
            done = subprocess.run([sys.executable, "-c", _RENDER], env=environment, capture_output=True, timeout=60)
            works = done.returncode == 0
        except subprocess.TimeoutExpired:
            works = False
        if works:
            yield Finding("rendering", State.FINE, f"OpenGL through {backend}, for MuJoCo's own pictures alone")
            return
    yield Finding(
        "rendering",
        State.MISSING,
        "neither EGL nor OSMesa works; nothing here needs them, pictures are ray-cast",
        "for MuJoCo's own pictures install libegl1 or libosmesa6",
    )


def _weights() -> Iterator[Finding]:
    import importlib.resources

    from mechsearch_jax.networks.weights import ARCHITECTURES, load_weights

    folder = Path(str(importlib.resources.files("mechsearch_jax") / "networks"))
    for name in ARCHITECTURES:
        try:
            card = load_weights(folder / f"{name}.npz", name).card
        except InputError as error:
            yield Finding("weights", State.BROKEN, str(error), "pip install --force-reinstall mechsearch-jax")
        else:
            says = f"{name}: {card['parameters']} parameters, SHA-256 {card['sha256'][:12]}"
            yield Finding("weights", State.FINE, says)


def _cache() -> Iterator[Finding]:
    from mechsearch_jax.runtime.files import check_writable
    from mechsearch_jax.runtime.kept_arrays import VARIABLE, cache_folder

    folders = {"problems, compilations": cache_folder()}
    if given := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        folders = {"problems": cache_folder(), "compilations": Path(given)}
    for content, folder in folders.items():
        if folder is None:
            says = f"{content} are not kept: {VARIABLE} is empty, so that every start takes minutes"
            yield Finding("cache", State.MISSING, says, f"unset {VARIABLE}, or set it to a folder")
            continue
        try:
            check_writable(folder)
        except InputError as error:
            says = f"{content} are not kept: {error}"
            yield Finding("cache", State.MISSING, says, f"set {VARIABLE} to a folder that can be written to")
            continue
        sizes = [file.stat().st_size for file in folder.rglob("*") if file.is_file()]
        says = f"{content}: {folder}, {len(sizes)} files, {sum(sizes) / 1e6:.0f} MB, writable"
        yield Finding("cache", State.FINE, says)


def robot_meshes() -> Path | None:
    """The folder of the Panda's collision meshes in an installed `example-robot-data`; None if there is none.

    It is looked for by path: since its version 4.4 the package holds data alone, no Python module.
    """
    # Wheels have a prefix of their own beside the modules (cmeel); conda and system packages use the environment's.
    for prefix in (*(Path(place, "cmeel.prefix") for place in sys.path), Path(sys.prefix)):
        folder = prefix / "share/example-robot-data/robots/panda_description/meshes/collision"
        if folder.is_dir():
            return folder
    return None


def _meshes() -> Iterator[Finding]:
    if folder := robot_meshes():
        yield Finding("meshes", State.FINE, f"the robot's meshes are installed: {folder}")
    else:
        says = "the robot's meshes are not installed; only the test of the collision primitives needs them"
        yield Finding("meshes", State.MISSING, says, "pip install 'mechsearch-jax[meshes]'")


def _problem(scenario: Scenario, settings: Settings) -> Iterator[Finding]:
    from mechsearch_jax.envs.episode.episodes import target_of

    cell = settings.workcell
    if cell.is_cached(target_of(scenario, cell.target), settings.config.problem):
        yield Finding("problem", State.FINE, f"that of {scenario.name} is in the cache")
    else:
        says = f"that of {scenario.name} is not in the cache; to build it takes some 15 s, once"
        yield Finding("problem", State.MISSING, says, "run a search or inspect")


CHECKS: Mapping[str, Check] = {
    "versions": _versions,
    "devices": _devices,
    "simulator": _simulator,
    "batches": _batches,
    "rendering": _rendering,
    "weights": _weights,
    "cache": _cache,
    "meshes": _meshes,
}
# The checks of a cell, and those without which no search is possible.
CELL = ("camera", "target", "shelf", "networks", "planner")
NEEDED = ("versions", "devices", "simulator", "weights", *CELL)


def camera(settings: Settings) -> Iterator[Finding]:
    """Whether the camera sees the shelf."""
    seen_by, shelf = settings.workcell.camera, settings.workcell.shelf
    remedy = "mend [camera] position and rotation, or the focal lengths"
    if (fault := blindness(seen_by, shelf)) is not None:
        yield Finding("camera", State.BROKEN, fault, remedy)
        return
    for fault in camera_faults(seen_by, shelf):
        yield Finding("camera", State.DOUBTFUL, fault, remedy)
    share = share_seen(seen_by, shelf)
    yield Finding("camera", State.FINE, f"{seen_by.width} x {seen_by.height}, sees {100 * share:.0f}% of the board")


def target(settings: Settings) -> Iterator[Finding]:
    """Whether the target fits the gripper and the shelf."""
    cell = settings.workcell
    body, shelf, opening = cell.target, cell.shelf, cell.gripper.usable_opening
    grasps = settings.config.problem.grasps
    _, widths = shape_of(body.shape).grasps(body.half_size, grasps.yaws, grasps.max_yaw)
    size = " x ".join(f"{200 * half:.1f}" for half in body.half_size)
    if min(widths) > opening:
        says = f"target: {min(widths):.3f} m wide, but the gripper takes {opening} m"
        yield Finding("target", State.BROKEN, says, "mend [target] half_size, or [gripper] usable_opening")
    elif 2 * body.half_size[2] >= shelf.walls.ceiling - shelf.ceiling_margin - shelf.board:
        says = f"target: {2 * body.half_size[2]:.3f} m high, more than the shelf's free space"
        yield Finding("target", State.BROKEN, says, "mend [target] half_size, or [shelf] board and ceiling")
    else:
        yield Finding("target", State.FINE, f"{body.shape}, {size} cm, fits gripper and shelf; {cell.told_by}")


def shelf(settings: Settings) -> Iterator[Finding]:
    """The share of the target's possible poses that the arm reaches."""
    cell = settings.workcell
    remedy = "mend [shelf] front to ceiling, or [base] position: x into the shelf, z up, in the robot's frame"
    if blindness(cell.camera, cell.shelf) is not None:
        yield Finding("shelf", State.MISSING, "the arm's reach is not looked at before the camera sees the shelf")
        return
    try:
        problem = cell.problem(config=settings.config.problem)
    except InputError as error:
        yield Finding("shelf", State.BROKEN, str(error), remedy)
        return
    share = len(np.unique(np.asarray(problem.grasps.pair_pose))) / len(problem.poses)
    says = f"the arm can grasp the target at {100 * share:.0f}% of its {len(problem.poses)} possible poses"
    few = share < LEAST_REACH
    yield Finding("shelf", State.DOUBTFUL if few else State.FINE, says, remedy if few else "")
    for line in lost_poses(problem):
        yield Finding("shelf", State.DOUBTFUL if few else State.FINE, line)


def networks(settings: Settings) -> Iterator[Finding]:
    """Whether the view is like those that the networks were trained on."""
    cell = settings.workcell
    if blindness(cell.camera, cell.shelf) is not None:
        yield Finding("networks", State.MISSING, "the view is not looked at before the camera sees the shelf")
        return
    try:
        trained = Recogniser(cell).trained
        faults = view_faults(cell.camera, cell.shelf, trained)
    except InputError as error:
        yield Finding("networks", State.BROKEN, str(error), "mend [camera]")
        return
    for fault in faults:
        yield Finding("networks", State.DOUBTFUL, fault, "see docs/method.md, Other cameras and shelves")
    if not faults:
        yield Finding("networks", State.FINE, f"the view is like that which {' and '.join(trained)} were trained on")


def planner(settings: Settings) -> Iterator[Finding]:
    """The planner's settings in this cell."""
    config = settings.config
    says = (
        f"preset {settings.preset}, trials {config.trials}, push model {config.push_model}, "
        f"at most {config.max_steps} actions"
    )
    yield Finding("planner", State.FINE, says)
