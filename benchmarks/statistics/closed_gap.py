"""What share of the gap between a worse and a better variant another one closes.

The measure by which algorithm selectors are compared, from the best single algorithm to one that always knows the best
(Lindauer, van Rijn and Kotthoff, Artificial Intelligence 272:86, 2019); here from random actions to a planner that
knows where the target is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Sequence

import numpy as np

from mechsearch_jax.benchmarks.statistics.intervals import Interval, ratio_interval
from mechsearch_jax.benchmarks.statistics.rates import scene_of
from mechsearch_jax.benchmarks.store.rows import Row


@dataclasses.dataclass(frozen=True)
class ClosedGap:
    """A share of a gap.

    Attributes:
      share: 0 as the worse variant, 1 as the better one; None where these do not differ, or no scenes are shared.
      interval: its 95% interval, from drawing scenes; None below two scenes, or where the gap may be none.
      pairs: on how many scenes and seeds all three have an episode.
    """

    share: float | None
    interval: Interval | None
    pairs: int


def closed_gap(
    rows: Sequence[Row], worse: Sequence[Row], better: Sequence[Row], measure: Callable[[Row], int | float | None]
) -> ClosedGap:
    """The share (worse - rows) / (worse - better) of a measure's means.

    Only scenes and seeds count of which all three have an episode with the measure. The episodes of a scene are
    averaged first.

    Args:
      rows, worse, better: of three variants.
      measure: less is better.
    """
    values = [{(scene_of(row), row.seed): measure(row) for row in each} for each in (rows, worse, better)]
    scenes: dict[Hashable, list[tuple[float, float]]] = {}
    for key in values[0]:
        ours, most, least = (each.get(key) for each in values)
        if ours is not None and most is not None and least is not None:
            scenes.setdefault(key[0], []).append((most - ours, most - least))
    if not scenes:
        return ClosedGap(None, None, 0)
    saved, gaps = np.array([np.mean(pairs, axis=0) for pairs in scenes.values()]).T
    gap = float(np.sum(gaps))
    share = float(np.sum(saved)) / gap if gap else None
    return ClosedGap(share, ratio_interval(saved.tolist(), gaps.tolist()), sum(map(len, scenes.values())))
