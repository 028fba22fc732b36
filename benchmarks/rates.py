"""Rates of success of episodes with confidence intervals, and how many actions it took."""

from __future__ import annotations

import collections
import dataclasses
import functools
import itertools
from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import scipy.stats

from mechsearch_jax.benchmarks.rows import Row
from mechsearch_jax.benchmarks.variants import VARIANT, canonical, grouped

# The shares in `Events`, in the words of tables.
EVENTS = {
    "truth_lost": "truth ruled out",
    "looks_truth_lost": "of all looks",
    "restarted": "f started anew",
    "fallen": "objects fallen",
    "held_up": "arm held up",
    "unsettled": "never at rest",
}
# What an episode may reach, in the words of pictures.
GOALS = {"found": "found", "graspable": "found and graspable", "retrieved": "retrieved"}
# How often steps are drawn again for their interval, and the seed of that.
RESAMPLES, SEED = 2000, 0
Interval = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Rates:
    """Shares of episodes, among those of a group.

    Attributes:
      group: what the group has in common, by column; None stands for all values of it. Usually `VARIANT`, the policy
        with the options that tell it from the others (see `label_variants`), and "objects", their number.
      episodes: how many episodes.
      errors: how many of them could not be run to their end; they count as failures.
      found, graspable, retrieved: shares of them.
      found_interval, graspable_interval, retrieved_interval: what the true shares may be: see `wilson`.
      paper_episodes: how many of the episodes say whether the target could be grasped with the paper's grasps alone.
      paper_graspable, paper_graspable_interval: share of those in which it could, None where there are none, and what
        the true share may be.
      found_steps, graspable_steps, retrieved_steps: mean number of actions until then, of the episodes that got there;
        None where none did.
      found_steps_interval, graspable_steps_interval, retrieved_steps_interval: what the true means may be: see
        `bootstrap`.
      steps: mean number of actions, attempts to take the target out among them.
      planning_seconds, simulation_seconds: mean wall time per action [s].
    """

    group: Mapping[str, Hashable]
    episodes: int
    errors: int
    found: float
    graspable: float
    retrieved: float
    found_interval: Interval
    graspable_interval: Interval
    retrieved_interval: Interval
    paper_episodes: int
    paper_graspable: float | None
    paper_graspable_interval: Interval
    found_steps: float | None
    graspable_steps: float | None
    retrieved_steps: float | None
    found_steps_interval: Interval | None
    graspable_steps_interval: Interval | None
    retrieved_steps_interval: Interval | None
    steps: float
    planning_seconds: float
    simulation_seconds: float

    @property
    def method(self) -> Hashable:
        """The variant's label."""
        return self.group.get(VARIANT)

    @property
    def objects(self) -> Hashable:
        """The number of surrounding objects; None for all."""
        return self.group.get("objects")


@dataclasses.dataclass(frozen=True)
class Events:
    """What happened on the way, in the episodes of a group that say so.

    Attributes:
      group: as in `Rates`.
      episodes: how many episodes say so.
      truth_lost: share of them in which f ruled out the target's true pose at some step.
      looks_truth_lost: share of all steps before the target was found at which it did.
      restarted: share of the episodes in which f became empty and was started anew.
      fallen: in which an object left the board.
      held_up: in which the arm was held up.
      unsettled: in which something never came to rest after an action.
    """

    group: Mapping[str, Hashable]
    episodes: int
    truth_lost: float
    looks_truth_lost: float
    restarted: float
    fallen: float
    held_up: float
    unsettled: float

    @property
    def objects(self) -> Hashable:
        """The number of surrounding objects; None for all."""
        return self.group.get("objects")


def step_of(row: Row, goal: str) -> int | None:
    """Number of actions after which an episode reached one of `GOALS`; None if it never did."""
    if goal == "retrieved":
        return row.steps if row.retrieved else None
    return row.found_step if goal == "found" else row.graspable_step


@functools.lru_cache(maxsize=65_536)
def wilson(successes: int, count: int) -> Interval:
    """Wilson's 95% confidence interval of a share: low and high; (0, 1) if nothing was counted."""
    if count == 0:
        return 0.0, 1.0
    interval = scipy.stats.binomtest(successes, count).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def bootstrap(steps: Sequence[int]) -> Interval | None:
    """Percentile bootstrap's 95% confidence interval of the mean of whole numbers; None where there are none.

    The same for the same numbers. Drawing numbers again with replacement is drawing how often each of them comes.
    """
    if not steps:
        return None
    counts = collections.Counter(steps)
    values = np.array(sorted(counts))
    shares = np.array([counts[value] for value in values.tolist()]) / len(steps)
    drawn = np.random.default_rng(SEED).multinomial(len(steps), shares, size=RESAMPLES)
    low, high = np.percentile(drawn @ values / len(steps), (2.5, 97.5))
    return float(low), float(high)


def summarise(rows: Sequence[Row], columns: Sequence[str] = (VARIANT, "objects")) -> list[Rates]:
    """Rates for every combination of what columns say, and for each of all but the last column over all values of it.

    Usually by variant and number of objects, and for each variant over all of them.

    Raises:
      InputError: there is no such column.
    """
    return [_rates(group, members) for group, members in _groups(rows, columns)]


def _rates(group: Mapping[str, Hashable], rows: Sequence[Row]) -> Rates:
    count, actions = len(rows), max(sum(row.steps for row in rows), 1)
    said = [row.paper_graspable for row in rows if row.paper_graspable is not None]
    steps = {goal: [step for row in rows if (step := step_of(row, goal)) is not None] for goal in GOALS}
    reached = {goal: len(steps[goal]) for goal in GOALS}
    told: dict[str, Any] = {
        **{goal: reached[goal] / count for goal in GOALS},
        **{f"{goal}_interval": wilson(reached[goal], count) for goal in GOALS},
        **{f"{goal}_steps": sum(steps[goal]) / reached[goal] if reached[goal] else None for goal in GOALS},
        **{f"{goal}_steps_interval": bootstrap(steps[goal]) for goal in GOALS},
    }
    return Rates(
        group=group,
        episodes=count,
        errors=sum(row.is_error for row in rows),
        **told,
        paper_episodes=len(said),
        paper_graspable=sum(said) / len(said) if said else None,
        paper_graspable_interval=wilson(sum(said), len(said)),
        steps=sum(row.steps for row in rows) / count,
        planning_seconds=sum(row.planning_seconds for row in rows) / actions,
        simulation_seconds=sum(row.simulation_seconds for row in rows) / actions,
    )


def summarise_events(rows: Sequence[Row], columns: Sequence[str] = (VARIANT, "objects")) -> list[Events]:
    """What happened on the way, grouped as `summarise` does; groups of which nothing is known are left out."""
    summary = []
    for group, members in _groups(rows, columns):
        known = [row for row in members if row.looks is not None]
        if not known:
            continue

        def share(name: str, known: Sequence[Row] = known) -> float:
            return sum(getattr(row, name) > 0 for row in known) / len(known)

        looks, lost = (sum(getattr(row, name) for row in known) for name in ("looks", "truth_lost"))
        summary.append(
            Events(
                group=group,
                episodes=len(known),
                truth_lost=share("truth_lost"),
                looks_truth_lost=lost / max(looks, 1),
                restarted=share("restarts"),
                fallen=share("objects_fallen"),
                held_up=share("held_up"),
                unsettled=share("unsettled"),
            )
        )
    return summary


def _groups(rows: Sequence[Row], columns: Sequence[str]) -> Iterator[tuple[Mapping[str, Hashable], list[Row]]]:
    """The rows by columns, and after those that differ in the last one alone, with None for it, all of them."""
    names = [canonical(name) for name in columns]
    found = grouped(rows, names)
    for outer, inner in itertools.groupby(found, key=lambda values: values[:-1]):
        values = list(inner)
        for value in values:
            yield dict(zip(names, value, strict=True)), found[value]
        yield dict(zip(names, (*outer, None), strict=True)), [row for value in values for row in found[value]]
