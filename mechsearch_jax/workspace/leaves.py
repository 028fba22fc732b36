"""Fields of a camera or a shelf that are dynamic under `jit`: a user's values, or JAX's stand-ins for them."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np


def are_given(*fields: Any, arrays: bool = False) -> bool:
    """Whether all leaves of dataclass fields are a user's values, valid or not, and should be checked.

    JAX rebuilds a dataclass that is a pytree with tracers, shapes or axes in its fields, which cannot be checked.

    Args:
      fields: of the dataclass.
      arrays: whether NumPy arrays count as a user's values, although JAX rebuilds with them, too.
    """
    kinds = (int, float, np.number, str, *([np.ndarray] if arrays else []))
    leaves = jax.tree.leaves(fields, is_leaf=lambda part: part is None)
    return all(isinstance(leaf, kinds) and not isinstance(leaf, bool) for leaf in leaves)
