"""Where programs of this package keep compiled functions from one run to the next."""

from __future__ import annotations

import os
from pathlib import Path

import jax

VARIABLE = "MECHSEARCH_CACHE_DIR"


def cache_folder() -> Path | None:
    """`MECHSEARCH_CACHE_DIR`, or a folder in the user's cache; None if that variable is set to nothing."""
    chosen = os.environ.get(VARIABLE)
    if chosen is not None:
        return Path(chosen) if chosen else None
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "mechsearch-jax"


def keep_compilations() -> None:
    """Make this process keep what JAX compiles, so that the next one starts in seconds.

    Meant for programs, which own their process; a library's user decides alone. A cache that the user has set up with
    `JAX_COMPILATION_CACHE_DIR` is left as it is.
    """
    folder = cache_folder()
    if folder is None or os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
