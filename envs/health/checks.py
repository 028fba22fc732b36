"""Checks of what is usable on this machine, with remedies."""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import contextlib
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

from mechsearch_jax.envs.health.finding import Finding, State
from mechsearch_jax.runtime.errors import InputError

if TYPE_CHECKING:
    from mechsearch_jax.problem.settings import Settings
    from mechsearch_jax.workspace.scenario import Scenario

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
