"""Compiles Warp's kernels beforehand in another process, on all cores.

Warp compiles a module of kernels when the first of them is launched, one module after the other. On a new machine this
takes minutes and holds Python's lock repeatedly. Warp keeps compiled modules on disk (`WARP_CACHE_PATH`) for every
process. So a separate process makes a step of the same model with launches replaced by notes of their modules, and then
compiles all of these in parallel, while the calling process continues.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mujoco

from mechsearch_jax.runtime.cores import cores


def compile_kernels(
    model: mujoco.MjModel, batched: Sequence[str], worlds: int, contacts: int, rows: int, device: str
) -> Callable[[], None] | None:
    """Begin to compile the kernels of a step of many worlds, unless a marker file beside the kernels says it was done.

    Args:
      model: of C MuJoCo.
      batched: names of the model's fields that differ between worlds.
      worlds: number of worlds, on which some kernels depend.
      contacts, rows: capacities, `naconmax` and `njmax`.
      device: Warp's name of the device.

    Returns:
      A function that waits until all are compiled; if that fails, it warns, and they are compiled when needed. None if
      all were compiled before.
    """
    import warp

    folder = tempfile.TemporaryDirectory()
    file = Path(folder.name) / "model.mjb"
    mujoco.mj_saveModel(model, str(file))
    sizes: dict[str, Any] = {"batched": list(batched), "worlds": worlds, "contacts": contacts, "rows": rows}
    settings = repr((sizes, device, warp.get_device(device).name, warp.__version__, mujoco.__version__))
    digest = hashlib.sha256(settings.encode() + file.read_bytes()).hexdigest()[:32]
    marker = Path(str(warp.config.kernel_cache_dir)) / f"step-{digest}"
    if marker.exists():
        folder.cleanup()
        return None
    # JAX must not take the GPU's memory in that process.
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            __spec__.name,
            json.dumps(sizes | {"model": str(file), "device": device, "threads": cores()}),
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )

    def wait() -> None:
        with folder:
            complaints = process.communicate()[1].strip()
        if process.returncode:
            last = complaints.rpartition("\n")[2]
            warnings.warn(f"Warp's kernels are compiled one by one when they are needed: {last}", stacklevel=2)
            return
        with contextlib.suppress(OSError):
            marker.touch()

    return wait


def modules_of_a_step(
    model: mujoco.MjModel, batched: Sequence[str], worlds: int, contacts: int, rows: int, device: str
) -> list[tuple[Any, int | None]]:
    """The modules whose kernels a step launches, with their block sizes; see `compile_kernels` for the arguments.

    Only for a separate process: afterwards Warp launches nothing any more.
    """
    import warp
    from mujoco.mjx.third_party import mujoco_warp
    from warp._src.context import Module

    modules: dict[tuple[Any, int | None], None] = {}

    def note(module: Any, device: Any, block_dim: int | None = None, **options: Any) -> None:
        # A launch without an executable returns at once.
        modules[module, block_dim] = None

    def once(condition: Any, while_body: Callable[..., None], **arguments: Any) -> None:
        while_body(**arguments)

    def both(condition: Any, on_true: Any = None, on_false: Any = None, **arguments: Any) -> None:
        for branch in filter(None, (on_true, on_false)):
            branch(**arguments)

    # These would wait for results of kernels that were not launched.
    warp.capture_while, warp.capture_if = once, both
    warp.get_suggested_block_size = lambda kernel, device=None: (256, 1)
    Module.load = note
    with warp.ScopedDevice(device):
        warp_model = mujoco_warp.put_model(model, batch_sizes=dict.fromkeys(batched, worlds))
        # As in `MjxModel`; some kernels depend on it.
        warp_model.opt.warn_overflow = 0
        data = mujoco_warp.make_data(model, nworld=worlds, naconmax=contacts, njmax=rows)
        mujoco_warp.step(warp_model, data)
    return list(modules)


def main(settings: str) -> None:
    """Compile the kernels of a step; `settings` is the JSON that `compile_kernels` passes."""
    import warp
    from mujoco.mjx.warp import forward
    from warp._src.context import Module

    sizes = json.loads(settings)
    threads, device = sizes.pop("threads"), sizes["device"]
    load, model = Module.load, mujoco.MjModel.from_binary_path(sizes.pop("model"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        modules = modules_of_a_step(model, **sizes)
    # The module that calls a step from JAX is loaded, too, even without kernels.
    modules.append((warp.get_module(forward.ffi.__name__), None if device != "cpu" else 1))
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda entry: load(entry[0], warp.get_device(device), entry[1]), modules))


if __name__ == "__main__":
    main(sys.argv[1])
