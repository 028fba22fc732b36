"""The host's processors: how many cores this process may keep busy, and computing on them beside a GPU."""

from __future__ import annotations

import contextlib
import os
from typing import Any

# Set for processes that share the cores with others.
VARIABLE = "MECHSEARCH_CORES"


def cores() -> int:
    """`MECHSEARCH_CORES`, or the cores that this process may run on."""
    given = os.environ.get(VARIABLE, "")
    if given.isdecimal() and int(given) > 0:
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share_of_cores(processes: int) -> dict[str, str]:
    """What the environment of each of several processes must hold, so that together they keep no more cores busy than
    this one may."""
    return {VARIABLE: str(max(cores() // processes, 1))}


def on_host() -> contextlib.AbstractContextManager[Any]:
    """In this block JAX computes on the host, for what a GPU takes longer to compile or to get through.

    Where JAX may use nothing but the GPU (`JAX_PLATFORMS`), it computes there all the same.
    """
    # Who asks for help alone does not wait for it.
    import jax

    if jax.default_backend() != "cpu":
        with contextlib.suppress(RuntimeError):
            return jax.default_device(jax.local_devices(backend="cpu")[0])
    return contextlib.nullcontext()
