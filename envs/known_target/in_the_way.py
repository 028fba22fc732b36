"""The objects in the way of a target: which ones its grasps hit, as sets and in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

# Largest number of sets of objects that are listed.
MAX_LISTED = 3


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


def grasps_in_words(hits: Bool[np.ndarray, "grasps n"]) -> str:
    """What the grasps that arm and shelf allow meet."""
    if not len(hits):
        return "the arm can reach no grasp of the target inside the shelf"
    sets = least_sets(hits)
    listed = ", or ".join(map(objects_in_words, sets[:MAX_LISTED])) + (", or others" if len(sets) > MAX_LISTED else "")
    if len(hits) == 1:
        return f"the only grasp that the arm can reach inside the shelf hits {listed}"
    return f"each of the {len(hits)} grasps that the arm can reach inside the shelf hits {listed}"


def objects_in_words(indices: Sequence[int]) -> str:
    """Objects by their numbers."""
    return f"object{'s' if len(indices) > 1 else ''} {numbers_in_words(indices)}"


def numbers_in_words(indices: Sequence[int]) -> str:
    """Numbers as in a sentence."""
    *others, last = map(str, indices)
    return f"{', '.join(others)} and {last}" if others else last
