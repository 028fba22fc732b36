"""Confidence intervals of what episodes say, in which the seeds of a scene are not independent."""

from __future__ import annotations

import functools
import math
from collections.abc import Hashable, Sequence

import numpy as np
import scipy.stats

# How often scenes are drawn again for the interval of a mean, and the seed of that.
RESAMPLES, SEED = 2000, 0
# Of a 95% interval.
_Z = float(scipy.stats.norm.ppf(0.975))
Interval = tuple[float, float]


@functools.lru_cache(maxsize=65_536)
def wilson(successes: int, count: int) -> Interval:
    """Wilson's 95% confidence interval of a share of independent trials: low and high; (0, 1) of none."""
    if count == 0:
        return 0.0, 1.0
    interval = scipy.stats.binomtest(successes, count).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def share_interval(reached: Sequence[bool], scenes: Sequence[Hashable]) -> Interval:
    """The 95% confidence interval of a share of episodes, in which episodes of the same scene are alike.

    Wilson's, for as many independent episodes as these are worth: their number over the design effect, which is the
    variance of the share between scenes over what independent episodes would have (Korn and Graubard, Survey
    Methodology 24, 1998, with Wilson's interval instead of Clopper's and Pearson's). Few episodes that end otherwise
    say little of that variance. So the design effect is averaged with the largest one, of scenes whose episodes all
    end alike: the estimate weighs as much as the rarer of both endings has episodes, the largest as much as one. Where
    all episodes end alike, each scene therefore counts once, and where each scene has one episode, the interval is
    Wilson's.

    Args:
      reached: for each episode whether it counts.
      scenes: what it was run on.

    Returns:
      Low and high; (0, 1) if there are no episodes.
    """
    count = len(reached)
    if count == 0:
        return 0.0, 1.0
    index = {scene: i for i, scene in enumerate(dict.fromkeys(scenes))}
    places = np.array([index[scene] for scene in scenes])
    sums = np.bincount(places, np.asarray(reached, float), len(index))
    sizes = np.bincount(places, minlength=len(index))
    successes = int(sums.sum())
    rarer, share = min(successes, count - successes), successes / count
    largest = float(np.sum(sizes**2)) / count
    effect = largest
    if rarer and len(index) > 1:
        between = len(index) / (len(index) - 1) * float(np.sum((sums - sizes * share) ** 2)) / count**2
        measured = float(np.clip(between / (share * (1 - share) / count), 1.0, largest))
        effect = (rarer * measured + largest) / (rarer + 1)
    return wilson(successes, count) if effect == 1.0 else _wilson(share, count / effect)


def _wilson(share: float, count: float) -> Interval:
    """Wilson's interval, of a number of trials that need not be whole."""
    total = 1 + _Z**2 / count
    middle = (share + _Z**2 / (2 * count)) / total
    half = _Z / total * math.sqrt(share * (1 - share) / count + _Z**2 / (4 * count**2))
    # But for rounding, the bounds are 0 and 1 where the share is.
    return 0.0 if share == 0.0 else middle - half, 1.0 if share == 1.0 else middle + half


def mean_interval(values: Sequence[int | float], scenes: Sequence[Hashable]) -> Interval | None:
    """The 95% confidence interval of a mean over episodes, from drawing their scenes again (percentile bootstrap).

    The same for the same episodes, in whatever order.

    Args:
      values: of each episode.
      scenes: what it was run on.

    Returns:
      Low and high; None below two scenes, which say nothing of how scenes differ.
    """
    groups: dict[Hashable, list[float]] = {}
    for value, scene in zip(values, scenes, strict=True):
        groups.setdefault(scene, []).append(value)
    if len(groups) < 2:
        return None
    pairs = sorted((float(sum(own)), float(len(own))) for own in groups.values())
    totals, counts = (np.array(column) for column in zip(*pairs, strict=True))
    weights = np.full(len(pairs), 1.0 / len(pairs))
    drawn = np.random.default_rng(SEED).multinomial(len(pairs), weights, size=RESAMPLES)
    low, high = np.percentile((drawn @ totals) / (drawn @ counts), (2.5, 97.5))
    return float(low), float(high)
