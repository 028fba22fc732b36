"""How variants differ from one of them over the same episodes: paired differences with their standard errors.

The seeds of a scene are not independent, so that its differences are averaged first, and scenes are what is counted.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Hashable, Mapping, Sequence

from mechsearch_jax.benchmarks.statistics.rates import GOALS, says, step_of
from mechsearch_jax.benchmarks.statistics.variants import canonical, column, label_variants, natural
from mechsearch_jax.benchmarks.store.rows import Row
from mechsearch_jax.runtime.errors import InputError

# What makes a pair where nothing else is asked for.
PAIRED = ("scenario", "seed")


@dataclasses.dataclass(frozen=True)
class Difference:
    """A variant less the baseline in one goal, over the pairs that both have.

    Attributes:
      method: the variant's label; see `label_variants`.
      goal: one of `GOALS`, or that and "_steps" for the number of actions until then, over the pairs in which both
        got there.
      pairs: how many; none for `graspable` where an episode does not say it (see `Row.graspable_known`).
      scenes: of how many scenes they are; of as many as there are pairs where these are not told apart by scenes.
      difference: mean over scenes of the mean difference of a scene's pairs; None where there are no pairs.
      standard_error: of that mean, from how scenes differ; None below two scenes.
      gains, losses: in how many pairs the variant has more, and less.
    """

    method: str
    goal: str
    pairs: int
    scenes: int
    difference: float | None
    standard_error: float | None
    gains: int
    losses: int


def paired(rows: Sequence[Row], baseline: str, columns: Sequence[str] = PAIRED) -> list[Difference]:
    """How every other variant differs from the baseline.

    Several episodes of a variant that the columns do not tell apart count as one, with their mean. Scenarios of the
    same name that hold something else are no pair.

    Args:
      rows: of all variants.
      baseline: a label of `label_variants`.
      columns: what two episodes of a pair have in common.

    Raises:
      InputError: there is no such column, or no episode of another variant makes a pair with one of the baseline.
    """
    named = [canonical(name) for name in columns]
    # What a scenario holds belongs to its name.
    said = [column(rows, name) for name in (*named, *(("content_hash",) if "scenario" in named else ()))]
    variants: dict[str, dict[tuple[Hashable, ...], list[Row]]] = {}
    for label, values, row in zip(label_variants(rows), zip(*said, strict=True), rows, strict=True):
        variants.setdefault(label, {}).setdefault(values, []).append(row)
    base = variants.pop(baseline)
    common = {label: [pair for pair in found if pair in base] for label, found in variants.items()}
    if not any(common.values()):
        raise InputError(f"report: no other variant shares {', '.join(named)} with the baseline {baseline}")
    # Where the scenario is among them, its place in what makes a pair; what it holds comes last.
    scene = [named.index("scenario"), -1] if "scenario" in named else None

    def unit(pair: tuple[Hashable, ...]) -> Hashable:
        return pair if scene is None else tuple(pair[i] for i in scene)

    return [
        _difference(label, goal, [(unit(pair), variants[label][pair], base[pair]) for pair in common[label]])
        for label in sorted(variants, key=natural)
        for goal in (*GOALS, *(f"{goal}_steps" for goal in GOALS))
    ]


def _difference(label: str, goal: str, pairs: Sequence[tuple[Hashable, Sequence[Row], Sequence[Row]]]) -> Difference:
    """The difference in a goal over pairs, each with its scene."""
    known = all(says(row, goal.removesuffix("_steps")) for _, rows, base in pairs for row in (*rows, *base))
    values = [(scene, _mean(rows, goal), _mean(base, goal)) for scene, rows, base in pairs] if known else []
    found = [(scene, a - b) for scene, a, b in values if a is not None and b is not None]
    scenes: dict[Hashable, list[float]] = {}
    for scene, value in found:
        scenes.setdefault(scene, []).append(value)
    own = [sum(each) / len(each) for each in scenes.values()]
    count = len(own)
    mean = sum(own) / count if count else None
    error = None
    if mean is not None and count > 1:
        error = math.sqrt(sum((value - mean) ** 2 for value in own) / (count - 1) / count)
    gains, losses = sum(value > 0 for _, value in found), sum(value < 0 for _, value in found)
    return Difference(label, goal, len(found), count, mean, error, gains, losses)


def _mean(rows: Sequence[Row], goal: str) -> float | None:
    """The share of rows that reached a goal, or how many actions those took that did; None where none did."""
    if goal in GOALS:
        return sum(step_of(row, goal) is not None for row in rows) / len(rows)
    steps = [step for row in rows if (step := step_of(row, goal.removesuffix("_steps"))) is not None]
    return sum(steps) / len(steps) if steps else None


def by_variant(differences: Sequence[Difference]) -> Mapping[str, Mapping[str, Difference]]:
    """Differences by variant and goal."""
    found: dict[str, dict[str, Difference]] = {}
    for one in differences:
        found.setdefault(one.method, {})[one.goal] = one
    return found
