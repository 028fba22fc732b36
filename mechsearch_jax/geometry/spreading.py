"""Farthest-point sampling: a few of many points, spread evenly over all."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int


def farthest_points(
    count: int, first: int, distance: Callable[[int], Float[np.ndarray, " n"]]
) -> Int[np.ndarray, " {count}"]:
    """Indices of points each of which is the farthest from all before; of several it is the one with the least index.

    Args:
      count: number of points, at least 1; beyond the number of all, points repeat.
      first: index of the first.
      distance: the distance of all points from the one with an index, or what grows with it; it may return the same
        array each time.
    """
    chosen = np.empty(count, int)
    chosen[0] = first
    gap: Float[np.ndarray, " n"] | None = None
    for i in range(1, count):
        away = distance(int(chosen[i - 1]))
        gap = away.copy() if gap is None else np.minimum(gap, away, out=gap)
        chosen[i] = np.argmax(gap)
    return chosen
