"""Settings of JAX that this library is written for, whatever the program that calls it has set for its own functions.

It computes in 32 bits; NaN marks what was not measured or is not known, and infinity what is nowhere.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numpy as np

from mechsearch_jax.runtime.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

# JAX's defaults; the names in capitals are those of environment variables.
OWN = {
    "jax_enable_x64": False,
    "jax_debug_nans": False,
    "jax_debug_infs": False,
    "jax_numpy_dtype_promotion": "standard",
}
# With it XLA makes derivatives wrong on a CPU, and so depth images: findings/xla-cpu-level-0-wrong-derivative.sh.
UNOPTIMISED = "--xla_backend_optimization_level=0"


def own_settings() -> contextlib.AbstractContextManager[object]:
    """A block in which the settings of `OWN` hold in this thread.

    Raises:
      InputError: `XLA_FLAGS` holds `UNOPTIMISED`.
    """
    if UNOPTIMISED in os.environ.get("XLA_FLAGS", "").split():
        raise InputError(f"XLA_FLAGS: {UNOPTIMISED} makes derivatives wrong on a CPU; use 1, or leave it out")
    # Imported here so that `--help` does not wait for it.
    import jax

    blocks = contextlib.ExitStack()
    for name, value in OWN.items():
        if getattr(jax.config, name) != value:
            blocks.enter_context(getattr(jax, name.removeprefix("jax_"))(value))
    return blocks


def _narrowed(tree: T) -> T:
    """A pytree with its arrays of 64 bits in 32; the same where the program's setting makes none."""
    import jax

    if not getattr(jax.config, "jax_enable_x64"):  # noqa: B009
        return tree
    wide = {np.dtype(f"{kind}64"): np.dtype(f"{kind}32") for kind in ("float", "int", "uint")}

    def narrow(leaf: object) -> object:
        return leaf.astype(wide[leaf.dtype]) if isinstance(leaf, jax.Array) and leaf.dtype in wide else leaf

    return jax.tree.map(narrow, tree)


def in_own_settings(function: Callable[P, R]) -> Callable[P, R]:
    """A decorator: the function runs in `own_settings`, and is given arrays of 64 bits in 32."""

    @functools.wraps(function)
    def inner(*args: P.args, **kwargs: P.kwargs) -> R:
        given, named = _narrowed((args, kwargs))
        with own_settings():
            return function(*given, **named)

    return inner
