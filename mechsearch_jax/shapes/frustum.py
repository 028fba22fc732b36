"""Cone frustums about their third axis, as stacks of discs.

MuJoCo has no such geometry, and a mesh would have to be compiled for every size. So physics, camera and volumes all
take a frustum for the same stack of cylinders.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

NAME = "frustum"
# The radius of a disc differs by about STEP from its neighbours' [m]; a frustum has at most MOST discs.
STEP, MOST = 2e-3, 6


def discs(half_size: Sequence[float], count: int | None = None) -> list[tuple[float, float, float]]:
    """The stack: height of the centre, radius and half the height of each disc, from below [m].

    Every disc has the volume of its part of the frustum.

    Args:
      half_size: radii at the lower and the upper end, and half the height [m].
      count: number of discs; from `STEP` and `MOST` if None.
    """
    low, high, half = half_size
    count = count or min(max(math.ceil(abs(high - low) / STEP), 1), MOST)
    ends = [low + (high - low) * i / count for i in range(count + 1)]
    return [
        (half * ((2 * i + 1) / count - 1), math.sqrt((a * a + a * b + b * b) / 3), half / count)
        for i, (a, b) in enumerate(itertools.pairwise(ends))
    ]
