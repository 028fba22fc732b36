"""The yardstick for search: how many actions the variants of a study take until found, graspable and retrieved.

All variants are measured on the scenes and seeds of the study's first variant, up to the same budget of actions.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence

from mechsearch_jax.benchmarks.statistics.actions_until import budget_of, horizon_of, reached, restricted_steps
from mechsearch_jax.benchmarks.statistics.closed_gap import ClosedGap, closed_gap
from mechsearch_jax.benchmarks.statistics.intervals import Interval, mean_interval, share_interval
from mechsearch_jax.benchmarks.statistics.paired import PairedDifference, change_of, same_episodes
from mechsearch_jax.benchmarks.statistics.rates import GOALS, scene_of, step_of
from mechsearch_jax.benchmarks.store.rows import Row
from mechsearch_jax.benchmarks.studies.shown import ShownStudy


@dataclasses.dataclass(frozen=True)
class Yardstick:
    """What is measured against what.

    Attributes:
      study: its name; the first variant is what changes are from.
      worse, better: labels of the variants between which the others are placed.
      drawn: labels of the variants that have a curve, each always in the same colour.
    """

    study: str
    worse: str
    better: str
    drawn: tuple[str, ...]


YARDSTICK = Yardstick(
    "baselines",
    worse="random",
    better="informed",
    drawn=(
        "search-for-grasp",
        "search-and-grasp",
        "greedy",
        "most-occluding",
        "mctx",
        "preset paper",
        "preset published-code",
        "random",
        "informed",
    ),
)


@dataclasses.dataclass(frozen=True)
class ActionsUntil:
    """How many actions a variant takes until a goal, with so many objects.

    Attributes:
      episodes: how many.
      share, share_interval: that reached the goal within its horizon.
      mean, interval: restricted mean number of actions, and what it may be.
      change: how many more than the first variant's; None for that one.
      gap: the share that it closes of the gap between the worse and the better variant; None for these two, and where
        one of them has no rows.
    """

    episodes: int
    share: float
    share_interval: Interval
    mean: float
    interval: Interval | None
    change: PairedDifference | None
    gap: ClosedGap | None


@dataclasses.dataclass(frozen=True)
class Measured:
    """A study by the yardstick.

    Attributes:
      shown: the study.
      budget: of actions.
      objects: numbers of objects, ascending.
      rows: of each variant, on the scenes and seeds of the first one, by its label.
      actions: by goal, label and number of objects, None for all; a variant without rows is left out.
    """

    shown: ShownStudy
    budget: int
    objects: Sequence[int]
    rows: Mapping[str, Sequence[Row]]
    actions: Mapping[tuple[str, str, int | None], ActionsUntil]

    def curve(self, goal: str, label: str) -> list[float]:
        """The share of a variant's episodes that reached a goal within 0, 1, ... actions, up to its horizon."""
        rows = self.rows[label]
        return [count / len(rows) for count in reached(rows, goal, horizon_of(goal, self.budget))]


def measure(shown: ShownStudy, yardstick: Yardstick = YARDSTICK) -> Measured:
    """The variants of a study by the yardstick.

    Args:
      shown: the study; its first variant has rows.
      yardstick: what is measured against what.
    """
    base = shown.study.baseline.label
    groups = shown.study.rows_of(shown.rows)
    common = {label: [row for row, _ in same_episodes(rows, groups[base])] for label, rows in groups.items()}
    rows = {label: members for label, members in common.items() if members}
    budget, objects = budget_of(shown.rows), sorted({row.objects for row in rows[base]})
    actions: dict[tuple[str, str, int | None], ActionsUntil] = {}
    for count, goal in itertools.product((None, *objects), GOALS):
        part = {
            label: [
                row
                for row in members
                if count in (None, row.objects) and restricted_steps(row, goal, budget) is not None
            ]
            for label, members in rows.items()
        }
        for label in filter(part.get, part):
            actions[goal, label, count] = _actions_until(part, base, label, goal, budget, yardstick)
    return Measured(shown, budget, objects, rows, actions)


def _actions_until(
    rows: Mapping[str, Sequence[Row]], base: str, label: str, goal: str, budget: int, yardstick: Yardstick
) -> ActionsUntil:
    """The actions of a variant until a goal, of at least one row, all of which have the goal."""
    steps_of, horizon = functools.partial(restricted_steps, goal=goal, budget=budget), horizon_of(goal, budget)
    members, scenes = rows[label], list(map(scene_of, rows[label]))
    steps = [steps for row in members if (steps := steps_of(row)) is not None]
    within = [(step := step_of(row, goal)) is not None and step <= horizon for row in members]
    worse, better = (rows.get(end, ()) for end in (yardstick.worse, yardstick.better))
    between = label not in (yardstick.worse, yardstick.better) and bool(worse and better)
    return ActionsUntil(
        episodes=len(members),
        share=sum(within) / len(within),
        share_interval=share_interval(within, scenes),
        mean=sum(steps) / len(steps),
        interval=mean_interval(steps, scenes),
        change=change_of(same_episodes(members, rows.get(base, ())), steps_of) if label != base else None,
        gap=closed_gap(members, worse, better, steps_of) if between else None,
    )
