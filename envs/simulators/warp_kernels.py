"""Warp's kernels, compiled beforehand in another process, many at the same time.

Warp compiles a module of kernels where the first of them is launched, one after the other, which takes minutes on a new
machine, and each needs Python's lock for a while. What it has compiled it keeps on disk (`WARP_CACHE_PATH`), for every
process. So a step of the same model is taken in a process of its own in which nothing is launched, but each module is
noted, and then all are compiled, on all cores. The process of who asks goes on meanwhile.
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
    """Begin to compile what a step of many worlds launches, unless a note beside the kernels says that it was done.

    Args:
      model: of C MuJoCo.
      batched: names of the model's fields that every world has its own of.
      worlds: how many; some kernels are of a number of worlds.
      contacts, rows: capacities, `naconmax` and `njmax`.
      device: Warp's name of the device.

    Returns:
      What waits until all are compiled. Where that fails, it warns, and they are compiled when they are needed. None
      where all were compiled before.
    """
    import warp

    folder = tempfile.TemporaryDirectory()
    file = Path(folder.name) / "model.mjb"
    mujoco.mj_saveModel(model, str(file))
    sizes: dict[str, Any] = {"batched": list(batched), "worlds": worlds, "contacts": contacts, "rows": rows}
    what = repr((sizes, device, warp.get_device(device).name, warp.__version__, mujoco.__version__))
    digest = hashlib.sha256(what.encode() + file.read_bytes()).hexdigest()[:32]
    note = Path(str(warp.config.kernel_cache_dir)) / f"step-{digest}"
    if note.exists():
        folder.cleanup()
        return None
    # Importing JAX must not take the GPU's memory there.
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
            note.touch()

    return wait


def modules_of_a_step(
    model: mujoco.MjModel, batched: Sequence[str], worlds: int, contacts: int, rows: int, device: str
) -> list[tuple[Any, int | None]]:
    """The modules that a step launches kernels of, with their block sizes; see `compile_kernels` for the arguments.

    For a process of its own: afterwards Warp launches nothing any more.
    """
    import warp
    from mujoco.mjx.third_party import mujoco_warp
    from warp._src.context import Module

    found: dict[tuple[Any, int | None], None] = {}

    def noted(module: Any, device: Any, block_dim: int | None = None, **options: Any) -> None:
        # Without an executable a launch returns.
        found[module, block_dim] = None

    def once(condition: Any, while_body: Callable[..., None], **arguments: Any) -> None:
        while_body(**arguments)

    def both(condition: Any, on_true: Any = None, on_false: Any = None, **arguments: Any) -> None:
        for branch in filter(None, (on_true, on_false)):
            branch(**arguments)

    # What would wait for a result of what was not launched.
    warp.capture_while, warp.capture_if = once, both
    warp.get_suggested_block_size = lambda kernel, device=None: (256, 1)
    Module.load = noted
    with warp.ScopedDevice(device):
        here = mujoco_warp.put_model(model, batch_sizes=dict.fromkeys(batched, worlds))
        # As `MjxModel` has it; some kernels are of it.
        here.opt.warn_overflow = 0
        data = mujoco_warp.make_data(model, nworld=worlds, naconmax=contacts, njmax=rows)
        mujoco_warp.step(here, data)
    return list(found)


def main(settings: str) -> None:
    """Compile what a step launches; `settings` is what `compile_kernels` writes."""
    import warp
    from mujoco.mjx.warp import forward
    from warp._src.context import Module

    sizes = json.loads(settings)
    threads, device = sizes.pop("threads"), sizes["device"]
    load, model = Module.load, mujoco.MjModel.from_binary_path(sizes.pop("model"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = modules_of_a_step(model, **sizes)
    # What calls a step from JAX is a module, too, even where it has no kernels.
    found.append((warp.get_module(forward.ffi.__name__), None if device != "cpu" else 1))
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda each: load(each[0], warp.get_device(device), each[1]), found))


if __name__ == "__main__":
    main(sys.argv[1])
