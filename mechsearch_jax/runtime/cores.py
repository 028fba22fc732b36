"""The host's processors: how many cores this process may use, and how to compute on them if there is a GPU."""

from __future__ import annotations

import contextlib
import os
from typing import Any

# Environment variable that limits the cores of a process.
VARIABLE = "MECHSEARCH_CORES"


def cores() -> int:
    """`MECHSEARCH_CORES`, or the cores that this process may run on."""
    given = os.environ.get(VARIABLE, "")
    if given.isdecimal() and int(given) > 0:
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share_of_cores(processes: int) -> dict[str, str]:
    """Environment variables for each of several processes that share this process's cores."""
    return {VARIABLE: str(max(cores() // processes, 1))}


def on_host() -> contextlib.AbstractContextManager[Any]:
    """A block in which JAX computes on the host, for work that takes longer on a GPU, compiling included.

    If `JAX_PLATFORMS` excludes the host, JAX computes on the GPU.
    """
    # Imported here so that `--help` does not wait for it.
    import jax

    if jax.default_backend() != "cpu":
        with contextlib.suppress(RuntimeError):
            return jax.default_device(jax.local_devices(backend="cpu")[0])
    return contextlib.nullcontext()
