"""Success rates of episodes with confidence intervals."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Sequence

import scipy.stats

from mechsearch_jax.benchmarks.rows import Row, label_variants

# The shares in `Events`, in the words of tables.
EVENTS = {
    "truth_lost": "truth ruled out",
    "looks_truth_lost": "of all looks",
    "restarted": "f started anew",
    "fallen": "objects fallen",
    "held_up": "arm held up",
    "unsettled": "never at rest",
}


@dataclasses.dataclass(frozen=True)
class Rates:
    """Shares of episodes, among those with a number of objects.

    Attributes:
      method: the planner's method, with the options that tell it from the others: see `label_variants`.
      objects: number of surrounding objects; None for all.
      episodes: how many episodes.
      errors: how many of them could not be run to their end; they count as failures.
      found, graspable, retrieved: shares of them.
      found_interval, graspable_interval, retrieved_interval: what the true shares may be: see `wilson`.
      paper_episodes: how many of the episodes say whether the target could be grasped with the paper's grasps alone.
      paper_graspable, paper_graspable_interval: share of those in which it could, None where there are none, and what
        the true share may be.
      steps: mean number of actions, attempts to take the target out among them.
      planning_seconds, simulation_seconds: mean wall time per action [s].
    """

    method: str
    objects: int | None
    episodes: int
    errors: int
    found: float
    graspable: float
    retrieved: float
    found_interval: tuple[float, float]
    graspable_interval: tuple[float, float]
    retrieved_interval: tuple[float, float]
    paper_episodes: int
    paper_graspable: float | None
    paper_graspable_interval: tuple[float, float]
    steps: float
    planning_seconds: float
    simulation_seconds: float


@dataclasses.dataclass(frozen=True)
class Events:
    """What happened on the way, in the episodes of a method that say so.

    Attributes:
      method: as in `Rates`.
      objects: number of surrounding objects; None for all.
      episodes: how many episodes say so.
      truth_lost: share of them in which f ruled out the target's true pose at some step.
      looks_truth_lost: share of all steps before the target was found at which it did.
      restarted: share of the episodes in which f became empty and was started anew.
      fallen: in which an object left the board.
      held_up: in which the arm was held up.
      unsettled: in which something never came to rest after an action.
    """

    method: str
    objects: int | None
    episodes: int
    truth_lost: float
    looks_truth_lost: float
    restarted: float
    fallen: float
    held_up: float
    unsettled: float


@functools.lru_cache(maxsize=65_536)
def wilson(successes: int, count: int) -> tuple[float, float]:
    """Wilson's 95% confidence interval of a share: low and high; (0, 1) if nothing was counted."""
    if count == 0:
        return 0.0, 1.0
    interval = scipy.stats.binomtest(successes, count).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def summarise(rows: Sequence[Row]) -> list[Rates]:
    """Rates by method (and what else differs) and number of objects, and for each method over all of them."""
    summary = []
    for method, objects, group in _groups(rows):
        actions = max(sum(row.steps for row in group), 1)
        found = sum(row.found_step is not None for row in group)
        graspable = sum(row.graspable_step is not None for row in group)
        retrieved = sum(row.retrieved for row in group)
        said = [row.paper_graspable for row in group if row.paper_graspable is not None]
        summary.append(
            Rates(
                method=method,
                objects=objects,
                episodes=len(group),
                errors=sum(row.is_error for row in group),
                found=found / len(group),
                graspable=graspable / len(group),
                retrieved=retrieved / len(group),
                found_interval=wilson(found, len(group)),
                graspable_interval=wilson(graspable, len(group)),
                retrieved_interval=wilson(retrieved, len(group)),
                paper_episodes=len(said),
                paper_graspable=sum(said) / len(said) if said else None,
                paper_graspable_interval=wilson(sum(said), len(said)),
                steps=sum(row.steps for row in group) / len(group),
                planning_seconds=sum(row.planning_seconds for row in group) / actions,
                simulation_seconds=sum(row.simulation_seconds for row in group) / actions,
            )
        )
    return summary


def summarise_events(rows: Sequence[Row]) -> list[Events]:
    """What happened on the way, grouped as `summarise` does; groups of which nothing is known are left out."""
    summary = []
    for method, objects, group in _groups(rows):
        known = [row for row in group if row.looks is not None]
        if not known:
            continue

        def share(column: str, known: Sequence[Row] = known) -> float:
            return sum(getattr(row, column) > 0 for row in known) / len(known)

        looks, lost = (sum(getattr(row, column) for row in known) for column in ("looks", "truth_lost"))
        summary.append(
            Events(
                method=method,
                objects=objects,
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


def _groups(rows: Sequence[Row]) -> Iterator[tuple[str, int | None, list[Row]]]:
    """The rows of every method, by their number of objects, and then, with None, all of them."""
    methods: dict[str, dict[int, list[Row]]] = {}
    for row, method in zip(rows, label_variants(rows), strict=True):
        methods.setdefault(method, {}).setdefault(row.objects, []).append(row)
    for method, by_objects in sorted(methods.items()):
        for objects, group in sorted(by_objects.items()):
            yield method, objects, group
        yield method, None, list(itertools.chain.from_iterable(by_objects.values()))
