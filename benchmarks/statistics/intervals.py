"""95% confidence intervals over episodes, of which those of the same scene are alike.

SciPy computes Wilson's interval (`scipy.stats.binomtest`) and the percentile bootstrap (`scipy.stats.bootstrap`). Ours
is what accounts for scenes: the design effect, by which the number of episodes is divided, and the bootstrap's samples,
which are a sum and a number of values for each scene. An interval does not depend on the order of the episodes.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Hashable, Iterable, Sequence

import numpy as np
import scipy.stats
from jaxtyping import Float

# How often the bootstrap draws scenes, how many draws it holds in memory at once, and its seed.
RESAMPLES, BATCH, SEED = 2000, 250, 0
# Scenes of all samples that are drawn together: BATCH draws of them take 32 MB.
STACKED = 16_000
# Quantile of the normal distribution for a 95% interval.
_Z = float(scipy.stats.norm.ppf(0.975))
Interval = tuple[float, float]


@functools.lru_cache(maxsize=65_536)
def wilson(successes: int, count: int) -> Interval:
    """Wilson's interval of a share of independent trials, by SciPy: low and high; (0, 1) of no trials."""
    if count == 0:
        return 0.0, 1.0
    interval = scipy.stats.binomtest(successes, count).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def with_interval(value: int | float | None, interval: Sequence[float | None] | None, form: str = "{:.3f}") -> str:
    """A value and its interval as a text, "0.500 (0.400 to 0.600)": without an interval the value, without both "-"."""
    if value is None:
        return "-"
    bounds = [] if interval is None else [form.format(bound) for bound in interval if bound is not None]
    return f"{form.format(value)} ({' to '.join(bounds)})" if bounds else form.format(value)


def by_scene(
    values: Sequence[int | float], scenes: Sequence[Hashable]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The sum and the number of the values of each scene, in ascending order.

    Args:
      values: of each episode.
      scenes: on which each episode was run.
    """
    groups: dict[Hashable, list[int | float]] = {}
    for value, scene in zip(values, scenes, strict=True):
        groups.setdefault(scene, []).append(value)
    pairs = sorted((math.fsum(group), len(group)) for group in groups.values())
    sums, counts = np.array(pairs, float).reshape(-1, 2).T
    return sums, counts


def share_interval(reached: Sequence[bool], scenes: Sequence[Hashable]) -> Interval:
    """The interval of a share of episodes, of which those of the same scene are alike.

    Wilson's, for the effective number of episodes: their number over the design effect, which is the variance of the
    share between scenes over that of independent episodes (Korn and Graubard, Survey Methodology 24, 1998, with
    Wilson's interval instead of Clopper's and Pearson's). Where few episodes end otherwise, that variance is hardly
    known. So the design effect is averaged with the largest possible one, of scenes whose episodes all end alike: the
    estimate weighs as much as the rarer ending has episodes, the largest as much as one episode. Where all episodes
    end alike, each scene therefore counts once, and where each scene has one episode, the interval is Wilson's.

    Args:
      reached: for each episode whether it counts.
      scenes: on which each episode was run.

    Returns:
      Low and high; (0, 1) if there are no episodes.
    """
    count = len(reached)
    if count == 0:
        return 0.0, 1.0
    sums, sizes = by_scene(reached, scenes)
    successes = int(sums.sum())
    rarer, share = min(successes, count - successes), successes / count
    largest = float(np.sum(sizes**2)) / count
    effect = largest
    if rarer and len(sums) > 1:
        between = len(sums) / (len(sums) - 1) * float(np.sum((sums - sizes * share) ** 2)) / count**2
        measured = float(np.clip(between / (share * (1 - share) / count), 1.0, largest))
        effect = (rarer * measured + largest) / (rarer + 1)
    return wilson(successes, count) if effect == 1.0 else _effective_wilson(share, count / effect)


def _effective_wilson(share: float, count: float) -> Interval:
    """Wilson's interval of an effective number of trials, for which SciPy takes whole numbers only."""
    total = 1 + _Z**2 / count
    middle = (share + _Z**2 / (2 * count)) / total
    half = _Z / total * math.sqrt(share * (1 - share) / count + _Z**2 / (4 * count**2))
    # But for rounding, the bounds are 0 and 1 where the share is.
    return 0.0 if share == 0.0 else middle - half, 1.0 if share == 1.0 else middle + half


def mean_interval(values: Sequence[int | float], scenes: Sequence[Hashable]) -> Interval | None:
    """The interval of a mean over episodes: percentile bootstrap, by SciPy, that draws whole scenes.

    Args:
      values: of each episode.
      scenes: on which each episode was run.

    Returns:
      Low and high; None below two scenes, from which it is not known how scenes differ.
    """
    return mean_intervals([(values, scenes)])[0]


def mean_intervals(
    samples: Iterable[tuple[Sequence[int | float], Sequence[Hashable]]],
) -> list[Interval | None]:
    """The `mean_interval` of each of many samples, which takes less time than one after the other.

    Every sample is drawn with the same seed, so that samples of the same number of scenes have their draws in common.

    Args:
      samples: values and scenes, as `mean_interval` has them.
    """
    pairs = [by_scene(values, scenes) for values, scenes in samples]
    intervals: list[Interval | None] = [None] * len(pairs)
    places: dict[int, list[int]] = {}
    for place, (sums, _) in enumerate(pairs):
        places.setdefault(len(sums), []).append(place)
    for scenes, members in places.items():
        most = max(STACKED // max(scenes, 1), 1)
        for first in range(0, len(members) if scenes > 1 else 0, most):
            stack = members[first : first + most]
            for place, interval in zip(stack, _drawn_intervals([pairs[place] for place in stack]), strict=True):
                intervals[place] = interval
    return intervals


def _drawn_intervals(
    pairs: Sequence[tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]],
) -> list[Interval]:
    """The intervals of samples of the same number of scenes, from the sums and numbers of the scenes' values.

    Each is of the sum of the first over the sum of the second.
    """
    interval = scipy.stats.bootstrap(
        tuple(np.stack(parts) for parts in zip(*pairs, strict=True)),
        lambda sums, counts, axis: np.sum(sums, axis) / np.sum(counts, axis),
        paired=True,
        vectorized=True,
        axis=-1,
        n_resamples=RESAMPLES,
        batch=BATCH,
        method="percentile",
        rng=SEED,
    ).confidence_interval
    return list(zip(interval.low.tolist(), interval.high.tolist(), strict=True))
