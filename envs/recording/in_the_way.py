"""The objects in the way of a target: which ones its grasps hit, as sets and in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool


def least_sets(hits: Bool[np.ndarray, "grasps n"]) -> list[tuple[int, ...]]:
    """The minimal sets of objects that grasps hit, the smallest first; empty without grasps.

    Args:
      hits: which objects each grasp hits, of grasps that arm and shelf allow.
    """
    sets = {frozenset(np.flatnonzero(row).tolist()) for row in hits}
    minimal = [objects for objects in sets if not any(other < objects for other in sets)]
    return sorted((tuple(sorted(objects)) for objects in minimal), key=lambda objects: (len(objects), objects))


def blocking(hits: Bool[np.ndarray, "grasps n"]) -> tuple[int, ...]:
    """The objects that the best grasps hit, those that hit the fewest objects."""
    sets = least_sets(hits)
    return tuple(sorted({index for objects in sets if len(objects) == len(sets[0]) for index in objects}))


def objects_in_words(indices: Sequence[int]) -> str:
    """Objects by their numbers, as in a sentence."""
    *others, last = map(str, indices)
    return f"objects {', '.join(others)} and {last}" if others else f"object {last}"
