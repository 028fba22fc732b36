"""Numbers of a camera or a shelf that are data under `jit`: what somebody gave, or what JAX puts in its place."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np


def are_given(*fields: Any, arrays: bool = False) -> bool:
    """Whether all leaves of some fields are what somebody gave, right or wrong, and not what stands for them in JAX.

    A dataclass that is a pytree is rebuilt with tracers, shapes or axes in its fields: there is nothing to check then.

    Args:
      fields: of the dataclass.
      arrays: whether somebody may give arrays of the host. JAX rebuilds with such, too.
    """
    kinds = (int, float, np.number, str, *([np.ndarray] if arrays else []))
    leaves = jax.tree.leaves(fields, is_leaf=lambda part: part is None)
    return all(isinstance(leaf, kinds) and not isinstance(leaf, bool) for leaf in leaves)
