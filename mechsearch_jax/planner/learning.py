"""Learning while searching what trials assume: the friction and the mass of what stands on the shelf.

An executed action is simulated once for each of a few hypotheses. How well they predict where the objects are seen
next is their likelihood (Bayes' rule), and the trials after it assume the most probable one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.types import Action
from mechsearch_jax.belief.belief import Belief
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner.trials import Trials, TrialScenes, scenes_of
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.runtime.compiled import kept
from mechsearch_jax.runtime.errors import InputError

# Exponent of the likelihood's tails, which are those of Student's t distribution with two degrees of freedom: what is
# hidden, or was pushed by something that the simulation lacks, must not decide alone.
TAIL = 1.5
# No hypothesis becomes less probable than this, so that a wrong conclusion can be corrected.
LEAST = 1e-3


@runtime_checkable
class LearnsPhysics(Protocol):
    """`Trials` that learn friction and mass; H is the number of their hypotheses."""

    @property
    def prior(self) -> Float[np.ndarray, " h"]:
        """How probable each hypothesis is before the first action."""
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
    """The `Trials` of scenes whose physics were learned.

    Attributes:
      trials: that learn.
      probabilities: of their hypotheses in each scene.
    """

    trials: LearnsPhysics
    probabilities: Float[np.ndarray, "r h"]

    def __call__(
        self, problem: Problem, scenes: TrialScenes, actions: Action, wanted: Bool[Array | np.ndarray, "r k"]
    ) -> Int[np.ndarray, "r k"]:
        """See `trials.Trials`."""
        return self.trials(problem, self.trials.assumed(self.probabilities, scenes), actions, wanted)


class LearnedPhysics:
    """What trials have learned in several searches.

    Attributes:
      probabilities: of the hypotheses in each search, shape (S, H).
    """

    def __init__(self, trials: LearnsPhysics, searches: int) -> None:
        """Nothing is learned yet in so many searches."""
        self._trials = trials
        self.probabilities = np.tile(trials.prior, (searches, 1))

    def forget(self, fresh: Bool[np.ndarray, " s"]) -> None:
        """Begin anew in the fresh searches."""
        self.probabilities[np.asarray(fresh)] = self._trials.prior

    def learn(
        self, problem: Problem, rows: Sequence[int], scenes: TrialScenes, actions: Action, seen: Superquadrics
    ) -> None:
        """Learn in the searches `rows`; the other arguments as of `LearnsPhysics.learned`."""
        here = self.probabilities[list(rows)]
        self.probabilities[list(rows)] = self._trials.learned(problem, here, scenes, actions, seen)

    def learn_first(
        self, problem: Problem, belief: Belief, before: Observation, action: Action, after: Observation
    ) -> None:
        """Learn in the first search from an action, and from the belief and the observations before and after it."""
        acted = scenes_of(belief, before), action, after.objects
        self.learn(problem, [0], *jax.tree.map(lambda a: np.asarray(a)[None], acted))

    def trials(self, rows: Sequence[int]) -> AssumingTrials:
        """The trials of scenes of the searches `rows`."""
        return AssumingTrials(self._trials, self.probabilities[list(rows)])


def restored(trials: Trials | None, probabilities: Sequence[float]) -> LearnedPhysics | None:
    """What trials have learned in a single search; None if they do not learn.

    Args:
      trials: of the search.
      probabilities: of the hypotheses; none if nothing was learned yet.

    Raises:
      InputError: there are not as many as hypotheses.
    """
    if not isinstance(trials, LearnsPhysics):
        return None
    physics = LearnedPhysics(trials, 1)
    if len(probabilities) not in (0, len(trials.prior)):
        raise InputError(
            f"physics: {len(probabilities)} probabilities for {len(trials.prior)} hypotheses; begin a new search"
        )
    if probabilities:
        physics.probabilities[0] = probabilities
    return physics


@kept(on_host=True)
def posterior(
    probabilities: Float[Array, " h"],
    ends: Float[Array, "h w n 3"],
    there: Bool[Array, " n"],
    seen: Float[Array, "m 3"],
    visible: Bool[Array, " m"],
    spread: Float[Array, ""],
) -> Float[Array, " h"]:
    """The probabilities of hypotheses after a look at a scene.

    Objects are matched with the nearest that is seen. Nothing changes where nothing is seen, or where a prediction is
    not finite.

    Args:
      probabilities: before.
      ends: where each hypothesis has the objects' centres come to rest [m], in W ways of which the likelier counts.
      there: which objects there were.
      seen: centres of the objects that are seen [m].
      visible: which of them there are.
      spread: scale of the distance between a prediction and what is seen [m].
    """
    misfit = jnp.sum(jnp.log1p((_nearest(ends, seen, visible) / spread) ** 2), axis=-1, where=there[None, None])
    likelihood = -TAIL * jnp.min(misfit, axis=-1)
    usable = jnp.all(jnp.isfinite(likelihood))
    after = jax.nn.softmax(jnp.log(probabilities) + jnp.where(usable, likelihood, 0.0))
    after = jnp.maximum(after, LEAST)
    return jnp.where(usable, after / jnp.sum(after), probabilities)


@kept(on_host=True)
def fits(
    ends: Float[Array, "w n 3"],
    there: Bool[Array, " n"],
    seen: Float[Array, "m 3"],
    visible: Bool[Array, " m"],
    spread: Float[Array, ""],
) -> Bool[Array, ""]:
    """Whether one of the ways of a hypothesis has every object come to rest near one that is seen; as `posterior`."""
    near = _nearest(ends[None], seen, visible)[0] < spread
    return jnp.any(jnp.all(near | ~there[None], axis=1))


def _nearest(
    ends: Float[Array, "h w n 3"], seen: Float[Array, "m 3"], visible: Bool[Array, " m"]
) -> Float[Array, "h w n"]:
    """Distance of each predicted object from the nearest that is seen [m]."""
    apart = jnp.linalg.norm(ends[:, :, :, None] - seen[None, None, None], axis=-1)
    return jnp.min(jnp.where(visible[None, None, None], apart, jnp.inf), axis=-1)
