"""Paired differences: how much more one of two episodes on the same scene reaches than the other.

The episodes of a scene are not independent. So a scene's differences are averaged first, and scenes are counted.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Hashable, Mapping, Sequence

import numpy as np
import scipy.stats

from mechsearch_jax.benchmarks.statistics.actions_until import budget_of, restricted_steps
from mechsearch_jax.benchmarks.statistics.intervals import Interval, by_scene, mean_interval
from mechsearch_jax.benchmarks.statistics.rates import GOALS, scene_of, step_of
from mechsearch_jax.benchmarks.statistics.variants import canonical, column, label_variants, natural
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.runtime.errors import InputError

# What two episodes of a pair have in common by default.
PAIRED = ("scenario", "seed")
# How names of means end, of actions until a goal.
STEPS, RESTRICTED = "_steps", "_restricted_steps"


@dataclasses.dataclass(frozen=True)
class PairedDifference:
    """Differences of a measure over pairs of episodes.

    Attributes:
      scene_means: the mean difference of each scene's pairs, ascending.
      pairs: how many pairs.
      gains, losses: in how many of them the difference is above, and below 0.
    """

    scene_means: tuple[float, ...]
    pairs: int
    gains: int
    losses: int

    @classmethod
    def of(cls, differences: Sequence[int | float], scenes: Sequence[Hashable]) -> PairedDifference:
        """The paired difference of pairs, each on one of these scenes."""
        sums, counts = by_scene(differences, scenes)
        gains, losses = sum(value > 0 for value in differences), sum(value < 0 for value in differences)
        return cls(tuple(sorted((sums / counts).tolist())), len(differences), gains, losses)

    @property
    def scenes(self) -> int:
        """How many scenes the pairs are on."""
        return len(self.scene_means)

    @property
    def mean(self) -> float | None:
        """The mean over scenes; None where there are no pairs."""
        return float(np.mean(self.scene_means)) if self.scene_means else None

    @property
    def standard_error(self) -> float | None:
        """Of the mean, from how scenes differ, by SciPy; None below two scenes."""
        return float(scipy.stats.sem(self.scene_means)) if self.scenes > 1 else None

    @functools.cached_property
    def interval(self) -> Interval | None:
        """The 95% interval of the mean, from drawing scenes; None below two scenes."""
        return mean_interval(self.scene_means, range(self.scenes))


def same_episodes(
    rows: Sequence[EpisodeRow], base: Sequence[EpisodeRow], objects: int | None = None
) -> list[tuple[EpisodeRow, EpisodeRow]]:
    """The rows of which the base has one on the same scene with the same seed, each with that one.

    Args:
      rows, base: of two variants.
      objects: only scenes with so many; all if None.
    """
    partners = {(scene_of(row), row.seed): row for row in base}
    return [
        (row, partner)
        for row in rows
        if objects in (None, row.objects) and (partner := partners.get((scene_of(row), row.seed)))
    ]


def change_of(
    pairs: Sequence[tuple[EpisodeRow, EpisodeRow]], measure: Callable[[EpisodeRow], int | float | None]
) -> PairedDifference:
    """How much larger a measure is in the first row of each pair; a pair where one of them has none is left out."""
    return _change([(measure(row), measure(other)) for row, other in pairs], [scene_of(row) for row, _ in pairs])


def reached_change(pairs: Sequence[tuple[EpisodeRow, EpisodeRow]], goal: str) -> PairedDifference:
    """How much larger the share of episodes is that reached a goal."""
    return change_of(pairs, lambda row: step_of(row, goal) is not None)


def steps_change(pairs: Sequence[tuple[EpisodeRow, EpisodeRow]], goal: str) -> PairedDifference:
    """How many more actions it took to reach a goal, over the pairs of which both episodes did."""
    return change_of(pairs, lambda row: step_of(row, goal))


# By variant, and by goal; by goal and `STEPS`, the actions until then, over the pairs in which both got there; and by
# goal and `RESTRICTED`, the same over all pairs: see `actions_until`.
VariantDifferences = Mapping[str, Mapping[str, PairedDifference]]


def paired(rows: Sequence[EpisodeRow], baseline: str, columns: Sequence[str] = PAIRED) -> VariantDifferences:
    """How every other variant differs from the baseline, by label and goal.

    Several episodes of a variant that the columns do not tell apart count as one, with their mean. Scenarios of the
    same name that hold something else are no pair.

    Args:
      rows: of all variants.
      baseline: a label of `label_variants`.
      columns: what two episodes of a pair have in common.

    Raises:
      InputError: there is no such column, or no episode of another variant makes a pair with one of the baseline.
    """
    names = [canonical(name) for name in columns]
    # The content of a scenario belongs to its name.
    values = [column(rows, name) for name in (*names, *(("content_hash",) if "scenario" in names else ()))]
    variants: dict[str, dict[tuple[Hashable, ...], list[EpisodeRow]]] = {}
    for label, pair, row in zip(label_variants(rows), zip(*values, strict=True), rows, strict=True):
        variants.setdefault(label, {}).setdefault(pair, []).append(row)
    base = variants.pop(baseline)
    common = {label: [pair for pair in own if pair in base] for label, own in variants.items()}
    if not any(common.values()):
        raise InputError(f"report: no other variant shares {', '.join(names)} with the baseline {baseline}")
    # The places of the scenario's name and content in a pair; without them each pair is a scene.
    places = [names.index("scenario"), -1] if "scenario" in names else range(len(names))
    budget = budget_of(rows)
    names_of_means = [f"{goal}{ending}" for ending in ("", STEPS, RESTRICTED) for goal in GOALS]
    base_means = {
        name: {pair: _mean(episodes, name, budget) for pair, episodes in base.items()} for name in names_of_means
    }
    differences: dict[str, dict[str, PairedDifference]] = {}
    for label in sorted(variants, key=natural):
        scenes = [tuple(pair[i] for i in places) for pair in common[label]]
        differences[label] = {
            name: _change(
                [(_mean(variants[label][pair], name, budget), base_means[name][pair]) for pair in common[label]], scenes
            )
            for name in names_of_means
        }
    return differences


def _change(
    means: Sequence[tuple[int | float | None, int | float | None]], scenes: Sequence[Hashable]
) -> PairedDifference:
    """The difference over pairs of means, each on a scene; a pair of which one mean is None is left out."""
    differences = [
        (mean - base, scene)
        for (mean, base), scene in zip(means, scenes, strict=True)
        if mean is not None and base is not None
    ]
    return PairedDifference.of([value for value, _ in differences], [scene for _, scene in differences])


def _mean(rows: Sequence[EpisodeRow], name: str, budget: int) -> float | None:
    """A mean over rows by its name, as `VariantDifferences` has it; None where there is nothing to average."""
    goal = name.removesuffix(RESTRICTED).removesuffix(STEPS)
    if name.endswith(RESTRICTED):
        steps = [step for row in rows if (step := restricted_steps(row, goal, budget)) is not None]
    else:
        steps = [step for row in rows if (step := step_of(row, goal)) is not None]
    if name == goal:
        return len(steps) / len(rows)
    return sum(steps) / len(steps) if steps else None
