"""How many actions episodes take to reach a goal, where episodes that never reach it count too.

An episode ends in one of three ways: it reaches the goal, it fails before (something falls, the target tips, the arm is
held up as it takes the target out, the program stops), or its budget of actions is spent. A failure is a competing
event and not censoring. Censoring would mean that the episode would have reached the goal later, as often as others do,
so that a policy gained by failing wherever it is hard (which is what a Kaplan-Meier curve would say). An episode that
fails never reaches the goal. The budget alone censors, every episode at the same number of actions, so up to there
nothing is censored: the Aalen-Johansen estimate of the cumulative incidence is the share of episodes that reached the
goal within k actions. The area above that curve up to a horizon is the restricted mean: the mean number of actions, in
which an episode that never reaches the goal counts as the horizon. In the literature: restricted mean survival time
(Royston and Parmar, BMC Medical Research Methodology 13:152, 2013), with competing risks the horizon less the
restricted mean time lost (Andersen, Statistics in Medicine 32:5278, 2013), and PAR1 where algorithms are compared.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

from mechsearch_jax.benchmarks.statistics.intervals import Interval, mean_intervals
from mechsearch_jax.benchmarks.statistics.rates import GOALS, scene_of, step_of, with_totals
from mechsearch_jax.benchmarks.statistics.variants import VARIANT
from mechsearch_jax.benchmarks.store.rows import EpisodeRow, options_of
from mechsearch_jax.planner import PRESETS


def budget_of(rows: Sequence[EpisodeRow]) -> int:
    """The number of actions that every episode may take: the least of their budgets.

    Args:
      rows: at least one; one of an early version that does not say it had what preset `standard` has.
    """
    usual = PRESETS["standard"]().options()["max_steps"]
    # Thousands of rows have the same few options.
    each = {row.configuration: row for row in rows}.values()
    return min(int(options_of(row).get("max_steps", usual)) for row in each)


def horizon_of(goal: str, budget: int) -> int:
    """The actions within which a goal can be reached: taking the target out is one more after those of the budget."""
    return budget + (goal == "retrieved")


def restricted_steps(row: EpisodeRow, goal: str, budget: int) -> int:
    """Actions until a goal, at most as many as its horizon, which also stands for never.

    Args:
      row: of the episode; one that ended in an error never reaches a goal.
      goal: one of `GOALS`.
      budget: of actions, not above the episode's own.
    """
    horizon, step = horizon_of(goal, budget), step_of(row, goal)
    return horizon if step is None else min(step, horizon)


def reached(rows: Sequence[EpisodeRow], goal: str, actions: int) -> list[int]:
    """How many episodes had reached a goal after 0, 1, ..., `actions` actions: the cumulative incidence, as counts."""
    after = collections.Counter(step_of(row, goal) for row in rows)
    return list(itertools.accumulate(after[k] for k in range(actions + 1)))


@dataclasses.dataclass(frozen=True)
class RestrictedMeans:
    """Restricted mean numbers of actions of a group of episodes.

    Attributes:
      group: as in `Rates`.
      episodes: how many episodes.
      budget: of actions; the horizon of `retrieved` is one more.
      found, graspable, retrieved: the means.
      found_interval, graspable_interval, retrieved_interval: what the true means may be: see `mean_interval`.
    """

    group: Mapping[str, Hashable]
    episodes: int
    budget: int
    found: float
    found_interval: Interval | None
    graspable: float
    graspable_interval: Interval | None
    retrieved: float
    retrieved_interval: Interval | None

    @property
    def objects(self) -> Hashable:
        """The number of surrounding objects; None for all."""
        return self.group.get("objects")


def restricted_means(
    rows: Sequence[EpisodeRow], columns: Sequence[str] = (VARIANT, "objects"), budget: int | None = None
) -> list[RestrictedMeans]:
    """Restricted means, grouped as `rates.summarise` does, all of them up to the same horizon.

    Args:
      rows: at least one.
      columns: to group by.
      budget: of actions; that of all rows if None.

    Raises:
      InputError: there is no such column.
    """
    budget = budget_of(rows) if budget is None else budget
    groups = list(with_totals(rows, columns))
    samples = [_steps_and_scenes(members, goal, budget) for _, members in groups for goal in GOALS]
    intervals = mean_intervals(samples)
    means = []
    for place, (group, members) in zip(range(0, len(samples), len(GOALS)), groups, strict=True):
        fields: dict[str, Any] = {}
        for goal, (steps, _), interval in zip(GOALS, samples[place:], intervals[place:], strict=False):
            fields |= {goal: sum(steps) / len(steps), f"{goal}_interval": interval}
        means.append(RestrictedMeans(group, len(members), budget, **fields))
    return means


def _steps_and_scenes(rows: Sequence[EpisodeRow], goal: str, budget: int) -> tuple[list[int], list[Hashable]]:
    """The restricted actions until a goal and the scene of each episode."""
    return [restricted_steps(row, goal, budget) for row in rows], [scene_of(row) for row in rows]
