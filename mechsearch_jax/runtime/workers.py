"""Processes beside this one that compute on the host, with the compiled programs that this one keeps on disk."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import loky

from mechsearch_jax.runtime.compiled import keep_in, kept_in
from mechsearch_jax.runtime.cores import share_of_cores

# JAX's settings of its cache on disk.
CACHE = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


def workers(processes: int) -> loky.ProcessPoolExecutor:
    """A pool of processes, each with its share of this process's cores; they start with the first task.

    Args:
      processes: their number.
    """
    alone = {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": "", "OPENBLAS_NUM_THREADS": "1"}
    return loky.ProcessPoolExecutor(
        processes,
        initializer=_keep,
        initargs=(kept_in(), {name: getattr(jax.config, name) for name in CACHE}),
        env=alone | share_of_cores(processes),
    )


def _keep(executables: Path | None, cache: Mapping[str, Any]) -> None:
    """Keep compiled programs of a new process on disk, where the first process keeps its own."""
    if executables is not None:
        keep_in(executables)
    for name, value in cache.items():
        jax.config.update(name, value)
