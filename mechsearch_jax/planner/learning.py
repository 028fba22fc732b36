"""Learning while searching what trials assume: the friction and the mass of what stands on the shelf.

An executed action is simulated once for each of a few hypotheses. How well they predict where the objects are seen
next is their likelihood (Bayes' rule), and the trials after it assume the most probable one.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.types import Action
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner.step import SearchState
from mechsearch_jax.planner.trials import Trials, TrialScenes, scenes_of
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.runtime.errors import InputError

# Exponent of the likelihood (1 + r^2)^-TAIL of a distance of r spreads, whose tails are heavy.
TAIL = 1.5
# Distance, in spreads, beyond which an object counts as not seen: one that is hidden, not recognised, or pushed by
# something that the simulation lacks must not decide alone, wherever hypotheses predict it.
FARTHEST = 5.0
# Probability that an object on the board is not seen, relative to that of one off the board.
MISSED = 0.2
# Before normalisation no hypothesis is less probable than this, so that a wrong conclusion can be corrected.
LEAST = 1e-3


@runtime_checkable
class LearnsFriction(Protocol):
    """`Trials` that learn friction and mass; H is the number of their hypotheses."""

    @property
    def prior(self) -> Float[np.ndarray, " h"]:
        """How probable each hypothesis is before the first action."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Distinct names of the hypotheses, by which what is learned is saved."""
        ...

    def learned(
        self,
        problem: Problem,
        probabilities: Float[np.ndarray, "r h"],
        scenes: TrialScenes,
        actions: Action,
        seen: Superquadrics,
    ) -> Float[np.ndarray, "r h"]:
        """The probabilities after executed actions and the looks that followed them.

        Args:
          problem: constants of the search.
          probabilities: before.
          scenes: before the actions, as they were recognised.
          actions: one for each scene, executed or attempted; of kind NONE where nothing was done.
          seen: the objects recognised afterwards, fields (R, N, ...).
        """
        ...

    def assumed(self, probabilities: Float[np.ndarray, "r h"], scenes: TrialScenes) -> TrialScenes:
        """The scenes with the friction and the mass that trials are to assume."""
        ...

    def __call__(
        self, problem: Problem, scenes: TrialScenes, actions: Action, wanted: Bool[Array | np.ndarray, "r k"]
    ) -> Int[np.ndarray, "r k"]:
        """See `trials.Trials`."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class AssumingTrials:
    """The `Trials` of scenes in which hypotheses were learned.

    Attributes:
      trials: that learn.
      probabilities: of their hypotheses in each scene.
    """

    trials: LearnsFriction
    probabilities: Float[np.ndarray, "r h"]

    def __call__(
        self, problem: Problem, scenes: TrialScenes, actions: Action, wanted: Bool[Array | np.ndarray, "r k"]
    ) -> Int[np.ndarray, "r k"]:
        """See `trials.Trials`."""
        return self.trials(problem, self.trials.assumed(self.probabilities, scenes), actions, wanted)


class LearnedFriction:
    """What trials have learned in several searches.

    Attributes:
      probabilities: of the hypotheses in each search, shape (S, H).
    """

    def __init__(self, trials: LearnsFriction, searches: int) -> None:
        """Nothing is learned yet in so many searches."""
        self._trials = trials
        self.probabilities = np.tile(trials.prior, (searches, 1))

    def forget(self, fresh: Bool[np.ndarray, " s"]) -> None:
        """Begin anew in the fresh searches."""
        self.probabilities[np.asarray(fresh)] = self._trials.prior

    def learn(
        self, problem: Problem, rows: Sequence[int], scenes: TrialScenes, actions: Action, seen: Superquadrics
    ) -> None:
        """Learn in the searches `rows`; the other arguments as of `LearnsFriction.learned`."""
        before = self.probabilities[list(rows)]
        self.probabilities[list(rows)] = self._trials.learned(problem, before, scenes, actions, seen)

    def learn_first(self, problem: Problem, before: SearchState, after: Observation) -> None:
        """Learn in the first search from a state, what was done in it, and the observation after it."""
        search = scenes_of(before.belief, before.observation), before.action, after.objects
        self.learn(problem, [0], *jax.tree.map(lambda a: np.asarray(a)[None], search))

    @property
    def first(self) -> dict[str, float]:
        """The probabilities in the first search by the hypotheses' names."""
        return dict(zip(self._trials.names, self.probabilities[0].tolist(), strict=True))

    def trials(self, rows: Sequence[int]) -> AssumingTrials:
        """The trials of scenes of the searches `rows`."""
        return AssumingTrials(self._trials, self.probabilities[list(rows)])


def restored(trials: Trials | None, probabilities: Mapping[str, float]) -> LearnedFriction | None:
    """What trials have learned in a single search; None if they do not learn.

    Args:
      trials: of the search.
      probabilities: of the hypotheses by their names; none if nothing was learned yet.

    Raises:
      InputError: the probabilities are impossible, or of other hypotheses than those of the trials.
    """
    if not isinstance(trials, LearnsFriction):
        if probabilities:
            raise InputError(
                "hypotheses were learned, but the trials learn nothing; give the trials that it had, "
                "such as LearningTrials(), or begin a new search"
            )
        return None
    learned = LearnedFriction(trials, 1)
    if not probabilities:
        return learned
    if set(probabilities) != set(trials.names):
        raise InputError(
            f"hypotheses {'; '.join(probabilities)} were learned, but the trials have {'; '.join(trials.names)}; give "
            "the trials that it had, or begin a new search"
        )
    values = np.array([probabilities[name] for name in trials.names])
    if not (np.isfinite(values).all() and (values >= 0.0).all() and values.sum() > 0.0):
        raise InputError(f"probabilities {values.tolist()} of the hypotheses are impossible; begin a new search")
    learned.probabilities[0] = values / values.sum()
    return learned


def posterior(
    probabilities: Float[np.ndarray, " h"],
    ends: Float[np.ndarray, "h w n 3"],
    there: Bool[np.ndarray, " n"],
    seen: Float[np.ndarray, "m 3"],
    visible: Bool[np.ndarray, " m"],
    spread: float,
) -> Float[np.ndarray, " h"]:
    """The probabilities of hypotheses after a look at a scene.

    A way that is not finite does not count, and a hypothesis without a finite way keeps its probability.

    Args:
      probabilities: before.
      ends: where each hypothesis has the objects' centres come to rest [m], in W ways of which the likelier counts;
        infinite for an object off the board, NaN for a way that could not be simulated.
      there: which objects there were.
      seen: centres of the objects that are seen [m].
      visible: which of them there are.
      spread: scale of the distance between a prediction and what is seen [m].
    """
    ways = [[_misfit(places[there], seen[visible], spread) for places in hypothesis] for hypothesis in ends]
    misfit = np.fmin.reduce(np.array(ways), axis=1)
    simulated = np.isfinite(misfit)
    if not simulated.any():
        return probabilities
    before = np.maximum(probabilities, LEAST)
    weights = before[simulated] * np.exp(-TAIL * (misfit[simulated] - misfit[simulated].min()))
    after = before.copy()
    after[simulated] = before[simulated].sum() * weights / weights.sum()
    after = np.maximum(after, LEAST)
    return after / after.sum()


def _misfit(predicted: Float[np.ndarray, "k 3"], seen: Float[np.ndarray, "m 3"], spread: float) -> float:
    """How far predicted places are from what is seen, of the best assignment of each to at most one that is seen.

    What comes into sight costs nothing. NaN if a place is NaN.
    """
    from scipy.optimize import linear_sum_assignment

    if np.isnan(predicted).any():
        return math.nan
    there, visible = len(predicted), len(seen)
    off = ~np.isfinite(predicted).all(axis=1)
    cost = np.zeros((max(there, visible),) * 2)
    cost[:there] = _cost(FARTHEST)
    cost[np.flatnonzero(off), visible:] += math.log(MISSED) / TAIL
    apart = np.linalg.norm(predicted[~off, None] - seen[None], axis=-1)
    cost[np.flatnonzero(~off), :visible] = _cost(np.minimum(apart / spread, FARTHEST))
    return float(cost[linear_sum_assignment(cost)].sum())


def _cost(distance: Any) -> Any:
    """The misfit of a distance in spreads."""
    return np.log1p(np.square(distance))
