"""Rates of success of episodes with confidence intervals, and how many actions it took."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Any

from mechsearch_jax.benchmarks.statistics.intervals import Interval, mean_intervals, share_interval
from mechsearch_jax.benchmarks.statistics.variants import VARIANT, canonical, grouped
from mechsearch_jax.benchmarks.store.rows import EpisodeRow

# The shares in `Events`, in the words of tables.
EVENTS = {
    "truth_lost": "truth ruled out",
    "looks_truth_lost": "of all looks",
    "truth_ruled_out": "around it, too",
    "restarted": "f started anew",
    "fallen": "objects fallen",
    "held_up": "arm held up",
    "unsettled": "never at rest",
}
# What an episode may reach, in the words of pictures.
GOALS = {"found": "found", "graspable": "found and graspable", "retrieved": "retrieved"}


@dataclasses.dataclass(frozen=True)
class Rates:
    """Shares of episodes, among those of a group.

    Attributes:
      group: what the group has in common, by column; None stands for all values of it. Usually `VARIANT`, the policy
        with the options that tell it from the others (see `label_variants`), and "objects", their number.
      episodes: how many episodes.
      errors: how many of them could not be run to their end; they count as failures.
      found, graspable, retrieved: shares of them.
      found_interval, graspable_interval, retrieved_interval: what the true shares may be: see `share_interval`.
      paper_episodes: how many of the episodes say whether the target could be grasped with the paper's grasps alone.
      paper_graspable, paper_graspable_interval: share of those in which it could, None where there are none, and what
        the true share may be.
      found_steps, graspable_steps, retrieved_steps: mean number of actions until then, of the episodes that got there;
        None where none did.
      found_steps_interval, graspable_steps_interval, retrieved_steps_interval: what the true means may be: see
        `mean_interval`.
      steps: see `mean_actions`.
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
    steps: float | None
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
      truth_ruled_out: share of the episodes in which it ruled out the true pose's cell and all cells around it at some
        step; None where an episode does not say.
      restarted: share of the episodes in which f became empty and was started anew.
      fallen: in which an object left the board.
      held_up: in which the arm was held up.
      unsettled: in which something never came to rest after an action.
    """

    group: Mapping[str, Hashable]
    episodes: int
    truth_lost: float
    looks_truth_lost: float
    truth_ruled_out: float | None
    restarted: float
    fallen: float
    held_up: float
    unsettled: float

    @property
    def objects(self) -> Hashable:
        """The number of surrounding objects; None for all."""
        return self.group.get("objects")

    def texts(self) -> list[str]:
        """The shares `EVENTS`, in the words of tables; empty where one is not known."""
        shares = [getattr(self, name) for name in EVENTS]
        return ["" if share is None else f"{share:.3f}" for share in shares]


def step_of(row: EpisodeRow, goal: str) -> int | None:
    """Number of actions after which an episode reached one of `GOALS`; None if it never did."""
    if goal == "retrieved":
        return row.steps if row.retrieved else None
    return row.found_step if goal == "found" else row.graspable_step


def actions_of(row: EpisodeRow) -> int | None:
    """Number of actions of an episode, attempts to take the target out among them; None of one that did not end."""
    return None if row.is_error else row.steps


def mean_actions(rows: Sequence[EpisodeRow]) -> float | None:
    """Mean number of actions of the episodes that did not end in an error; None where all did."""
    counts = [count for row in rows if (count := actions_of(row)) is not None]
    return sum(counts) / len(counts) if counts else None


def scene_of(row: EpisodeRow) -> tuple[str, str | None]:
    """What an episode was run on: the scenario, by its name and content."""
    return row.scenario, row.content_hash


def summarise(rows: Sequence[EpisodeRow], columns: Sequence[str] = (VARIANT, "objects")) -> list[Rates]:
    """Rates for every combination of what columns say, and for each of all but the last column over all values of it.

    Usually by variant and number of objects, and for each variant over all of them.

    Raises:
      InputError: there is no such column.
    """
    groups = list(with_totals(rows, columns))
    intervals = mean_intervals(_steps_and_scenes(members, goal) for _, members in groups for goal in GOALS)
    return [
        _rates(group, members, intervals[place : place + len(GOALS)])
        for place, (group, members) in zip(range(0, len(intervals), len(GOALS)), groups, strict=True)
    ]


def _steps_and_scenes(rows: Sequence[EpisodeRow], goal: str) -> tuple[list[int], list[Hashable]]:
    """The actions until a goal and the scene of each episode that reached it."""
    reached = [(step, scene_of(row)) for row in rows if (step := step_of(row, goal)) is not None]
    return [step for step, _ in reached], [scene for _, scene in reached]


def _rates(
    group: Mapping[str, Hashable], rows: Sequence[EpisodeRow], steps_intervals: Sequence[Interval | None]
) -> Rates:
    """The rates of a group, with the intervals of the mean number of actions until each of `GOALS`."""
    count, actions = len(rows), max(sum(row.steps for row in rows), 1)
    by_paper = [row for row in rows if row.paper_graspable is not None]
    paper_graspable = [bool(row.paper_graspable) for row in by_paper]
    scenes = list(map(scene_of, rows))
    goals: dict[str, Any] = {}
    for goal, interval in zip(GOALS, steps_intervals, strict=True):
        goals |= {**_goal(rows, scenes, goal), f"{goal}_steps_interval": interval}
    return Rates(
        group=group,
        episodes=count,
        errors=sum(row.is_error for row in rows),
        **goals,
        paper_episodes=len(by_paper),
        paper_graspable=sum(paper_graspable) / len(by_paper) if by_paper else None,
        paper_graspable_interval=share_interval(paper_graspable, list(map(scene_of, by_paper))),
        steps=mean_actions(rows),
        planning_seconds=math.fsum(row.planning_seconds for row in rows) / actions,
        simulation_seconds=math.fsum(row.simulation_seconds for row in rows) / actions,
    )


def _goal(rows: Sequence[EpisodeRow], scenes: Sequence[Hashable], goal: str) -> dict[str, Any]:
    """The fields of `Rates` that belong to a goal, without the interval of its steps."""
    steps = [step_of(row, goal) for row in rows]
    known_steps = [step for step in steps if step is not None]
    return {
        goal: len(known_steps) / len(rows),
        f"{goal}_interval": share_interval([step is not None for step in steps], scenes),
        f"{goal}_steps": sum(known_steps) / len(known_steps) if known_steps else None,
    }


def summarise_events(rows: Sequence[EpisodeRow], columns: Sequence[str] = (VARIANT, "objects")) -> list[Events]:
    """What happened on the way, grouped as `summarise` does; groups of which nothing is known are left out."""
    summary = []
    for group, members in with_totals(rows, columns):
        recorded = [row for row in members if row.looks is not None]
        if not recorded:
            continue

        def share(name: str, rows: Sequence[EpisodeRow] = recorded) -> float:
            return sum(getattr(row, name) > 0 for row in rows) / len(rows)

        looks, lost = (sum(getattr(row, name) for row in recorded) for name in ("looks", "truth_lost"))
        summary.append(
            Events(
                group=group,
                episodes=len(recorded),
                truth_lost=share("truth_lost"),
                looks_truth_lost=lost / max(looks, 1),
                truth_ruled_out=None if any(r.truth_ruled_out is None for r in recorded) else share("truth_ruled_out"),
                restarted=share("restarts"),
                fallen=share("objects_fallen"),
                held_up=share("held_up"),
                unsettled=share("unsettled"),
            )
        )
    return summary


def with_totals(
    rows: Sequence[EpisodeRow], columns: Sequence[str]
) -> Iterator[tuple[Mapping[str, Hashable], list[EpisodeRow]]]:
    """The rows by columns, and after those that differ in the last one alone, with None for it, all of them."""
    names = [canonical(name) for name in columns]
    groups = grouped(rows, names)
    for outer, inner in itertools.groupby(groups, key=lambda values: values[:-1]):
        members = list(inner)
        for values in members:
            yield dict(zip(names, values, strict=True)), groups[values]
        yield dict(zip(names, (*outer, None), strict=True)), [row for values in members for row in groups[values]]
