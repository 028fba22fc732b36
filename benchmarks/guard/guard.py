"""A regression guard: a fixed suite of episodes, compared in pairs with stored outcomes.

The suite is run natively with preset `standard`. Each pair of a stored and a new episode is equal, a gain or a loss.
The test is the exact one-sided McNemar (sign) test of the hypothesis that gains and losses are equally likely.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.stats

from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.benchmarks.statistics.paired import PairedDifference
from mechsearch_jax.benchmarks.store.json_rows import save_rows
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.envs.scenes.scene_sets import SETS, Block
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, read_json
from mechsearch_jax.runtime.versions import versions

REFERENCE = Path(__file__).parents[1] / "results" / "guard-cpu.json"
# Number of scenes with each number of objects, from the set `development`, by the size of the suite.
SUITES: Mapping[int, int] = {40: 10, 80: 20, 160: 40}
SEED = 0


class Measure(NamedTuple):
    """How a measure is tested: at what significance level, and whether more (1) or less (-1) of it is better."""

    alpha: float
    sign: int


# Attributes of `Outcome`. The levels add up to the probability of a false alarm in all.
MEASURES: Mapping[str, Measure] = {
    "graspable": Measure(0.02, 1),
    "retrieved": Measure(0.02, 1),
    "actions": Measure(0.01, -1),
}
ALPHA = 0.05
# Actions of an episode without a retrieval: one more than any with it has, ten and the retrieval.
NOT_RETRIEVED = 12
# Share of episodes that end otherwise with another seed: published scenes, `standard`, retrieved, 0.10 to 0.13. A
# change of random numbers alone does the same.
FLIPS = 0.12
POWER = 0.8


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The outcome of an episode of the suite.

    Attributes:
      scenario, content_hash, objects, seed: which episode it is.
      found, graspable, retrieved, steps, failure: as in `EpisodeRow`, the first two whether there was such a step; None
        for `graspable` where that is not known, as in references of which a retrieval counted as graspable.
    """

    scenario: str
    content_hash: str
    objects: int
    seed: int
    found: bool
    graspable: bool | None
    retrieved: bool
    steps: int
    failure: str | None

    @classmethod
    def of_row(cls, row: EpisodeRow) -> Outcome:
        """The outcome in an episode's row."""
        return cls(
            scenario=row.scenario,
            content_hash=row.content_hash,
            objects=row.objects,
            seed=row.seed,
            found=row.found_step is not None,
            graspable=row.graspable_step is not None,
            retrieved=row.retrieved,
            steps=row.steps,
            failure=row.failure,
        )

    @property
    def actions(self) -> int:
        """Number of actions up to the retrieval, or `NOT_RETRIEVED`."""
        return self.steps if self.retrieved else NOT_RETRIEVED

    @property
    def episode(self) -> tuple[str, int]:
        """The key by which stored and new episodes are paired."""
        return self.content_hash, self.seed


@dataclasses.dataclass(frozen=True)
class Comparison:
    """How a measure of the suite changed.

    Attributes:
      measure: one of `MEASURES`.
      pairs: number of episodes.
      before, now: sums over the episodes: in how many it holds, or the number of actions.
      gains, losses: number of episodes in which it is better now, and was better before.
      p_value: probability of at least so many losses if gains and losses are equally likely.
      alpha: significance level.
    """

    measure: str
    pairs: int
    before: int
    now: int
    gains: int
    losses: int
    p_value: float
    alpha: float

    @property
    def lost(self) -> bool:
        """Whether the loss is significant."""
        return self.p_value <= self.alpha


def suite(scenes: int) -> list[tuple[Block, int]]:
    """The scenes of a suite, for `scene_sets.scene_files`: the first of each number of objects in `development`.

    Raises:
      InputError: there is no suite of that size.
    """
    if scenes not in SUITES:
        raise InputError(f"bench guard: there is no suite of {scenes} scenes; there are {', '.join(map(str, SUITES))}")
    return [(block, index) for block in SETS["development"].blocks for index in range(SUITES[scenes])]


def sign_test(gains: int, losses: int) -> float:
    """Probability of at least so many losses if each change is a gain or a loss with equal probability."""
    changes = gains + losses
    return 1.0 if changes == 0 else float(scipy.stats.binomtest(losses, changes, 0.5, alternative="greater").pvalue)


def compare(before: Sequence[Outcome], now: Sequence[Outcome]) -> list[Comparison]:
    """How each measure changed from a reference, episode by episode; the reference may hold more episodes.

    A measure that is None in any of the episodes is left out.

    Raises:
      InputError: there is nothing to compare, or the reference lacks an episode.
    """
    reference = {outcome.episode: outcome for outcome in before}
    missing = [outcome.scenario for outcome in now if outcome.episode not in reference]
    if missing or not now:
        lacking = f"{missing[0]} as it is here" if missing else "anything"
        raise InputError(f"bench guard: the reference does not hold {lacking}; write a new one with --write")
    changes = []
    for measure, (alpha, sign) in MEASURES.items():
        pairs = [(getattr(reference[outcome.episode], measure), getattr(outcome, measure)) for outcome in now]
        if any(None in pair for pair in pairs):
            continue
        change = PairedDifference.of([sign * (b - a) for a, b in pairs], [outcome.content_hash for outcome in now])
        changes.append(
            Comparison(
                measure=measure,
                pairs=change.pairs,
                before=sum(a for a, _ in pairs),
                now=sum(b for _, b in pairs),
                gains=change.gains,
                losses=change.losses,
                p_value=sign_test(change.gains, change.losses),
                alpha=alpha,
            )
        )
    return changes


def power(pairs: int, loss: float, flips: float = FLIPS, alpha: float = MEASURES["retrieved"].alpha) -> float:
    """The power of the test: the probability that a true loss is significant.

    Args:
      pairs: number of compared episodes.
      loss: decrease of the measure's share.
      flips: share of pairs that differ without a loss, half of them gains and half losses.
      alpha: significance level of the test.
    """
    gain, lose = flips / 2, flips / 2 + loss
    changes = np.arange(pairs + 1)
    chance = scipy.stats.binom.pmf(changes, pairs, gain + lose)
    # The least significant number of losses for each number of changes.
    needed = scipy.stats.binom.isf(alpha, changes, 0.5) + 1
    noticed = scipy.stats.binom.sf(needed - 1, changes, lose / (gain + lose))
    return float(np.sum(chance * np.where(changes > 0, noticed, 0.0)))


def detectable(pairs: int, flips: float = FLIPS) -> float:
    """The smallest loss, in steps of 0.005, that is significant with probability `POWER`."""
    losses = np.arange(1, int(200 * (1 - flips))) / 200
    return float(next(loss for loss in losses if power(pairs, loss, flips) >= POWER))


def save_reference(rows: Sequence[EpisodeRow], command: str, path: PathLike) -> None:
    """Store the outcomes of the suite for later comparisons.

    Args:
      rows: of all episodes.
      command: of the run.
      path: of the JSON file.

    Raises:
      InputError: an episode could not be run to its end, there are none, or the file cannot be written.
    """
    errors = [row for row in rows if row.is_error]
    if errors or not rows:
        reason = f"{errors[0].scenario} ended with {errors[0].failure!r}" if errors else "there are no episodes"
        raise InputError(f"bench guard: {reason}; nothing is stored")
    head = {
        "command": command,
        "code": present_code(),
        "versions": versions(),
        "configuration": json.loads(rows[0].configuration),
        "retrieved": {str(n): share for n, share in _shares(rows, "retrieved").items()},
        "graspable": {str(n): share for n, share in _shares(rows, "graspable").items()},
    }
    save_rows(head, [Outcome.of_row(row) for row in rows], path)


def _shares(rows: Sequence[EpisodeRow], measure: str) -> dict[int, float]:
    """A measure's share of the episodes with each number of objects."""
    groups: dict[int, list[Outcome]] = {}
    for row in sorted(rows, key=lambda row: row.objects):
        groups.setdefault(row.objects, []).append(Outcome.of_row(row))
    return {n: sum(getattr(outcome, measure) for outcome in group) / len(group) for n, group in groups.items()}


class Reference(NamedTuple):
    """A stored reference: the code that ran, and the outcomes of its episodes."""

    code: str
    outcomes: list[Outcome]


def read_reference(path: PathLike) -> Reference:
    """Read what `save_reference` stored.

    Raises:
      InputError: the file cannot be read, or is something else.
    """
    try:
        value = read_json(path)
    except InputError as error:
        raise InputError(f"{error}; write a reference with --write") from error
    try:
        outcomes = [Outcome(**dict(zip(value["columns"], row, strict=True))) for row in value["rows"]]
        return Reference(value["code"], outcomes)
    except (TypeError, KeyError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: is no reference of bench guard ({error})") from error
