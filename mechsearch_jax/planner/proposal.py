"""Sampling of an action in a state: the engine's slots `weigh` and `propose`."""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions.candidates import sample_action
from mechsearch_jax.actions.types import Sample
from mechsearch_jax.actions.unseen_space import PossibleSpace
from mechsearch_jax.belief.belief import Belief
from mechsearch_jax.existence import occluders
from mechsearch_jax.grasping.graspability import pairs
from mechsearch_jax.planner.objective import Objective
from mechsearch_jax.planner.state import State
from mechsearch_jax.problem.problem import Problem

# Weight of an object that alone blocks something relative to one of two blockers, of one of two to one of three, ...
ALONE = 4.0
# How many times shares pass on to the objects that block the motion of an object.
DEPTH = 2
# Number of objects that share the even part of the draws, a scene's eight and the target, for any number of slots.
EVEN = 9


class ObjectWeights(Protocol):
    """Weighs the objects of a state for the draws of actions: the engine's slot `weigh`; static under jit."""

    def __call__(
        self, problem: Problem, belief: Belief, objective: Objective, guided_fraction: Array | float, state: State
    ) -> Float[Array, " n"]:
        """Sampling weight of each object, at least 0.

        Args:
          problem: constants of the search.
          belief: the belief at the start of the plan.
          objective: the cost that the search minimises.
          guided_fraction: see `PlannerConfig`.
          state: the state in which to sample.
        """
        ...


class Propose(Protocol):
    """Samples an action in a state; static under jit."""

    def __call__(
        self,
        key: Array,
        problem: Problem,
        state: State,
        possible: PossibleSpace,
        weights: Float[Array, " n"],
        wanted: Bool[Array, ""],
    ) -> Sample:
        """One action, of kind NONE if none is possible.

        Args:
          key: PRNG key.
          problem, state: constants of the search, and the state in which to sample; see `rollout.without_poses`.
          possible: where the target may be.
          weights: sampling weight of each object.
          wanted: whether the action is used; if not, it is of kind NONE, and little is computed.
        """
        ...


def weighted_draw(
    key: Array,
    problem: Problem,
    state: State,
    possible: PossibleSpace,
    weights: Float[Array, " n"],
    wanted: Bool[Array, ""],
) -> Sample:
    """The default `Propose`: draws go to objects by their weights."""
    return sample_action(key, problem.space, state.scene, possible, state.candidates, state.able, weights, wanted)


def blame(in_the_way: Bool[Array, "k n"], counts: Bool[Array, " k"]) -> Float[Array, " n"]:
    """Each object's share in blocking the rows that count; a row weighs more the fewer objects block it."""
    other_blockers = jnp.sum(in_the_way, axis=1, keepdims=True) - 1.0
    weight = jnp.where(in_the_way & counts[:, None], ALONE**-other_blockers, 0.0)
    total = jnp.sum(weight, axis=0)
    return total / jnp.maximum(jnp.sum(total), 1e-12)


def propagate_blame(state: State, share: Float[Array, " n"], partly: bool = False) -> Float[Array, " n"]:
    """Pass the share of each object that cannot be moved yet on to the objects that its candidate actions hit.

    Repeated `DEPTH` times. The share of an object without any reachable candidate is lost.

    Args:
      state: a state with its candidate actions.
      share: share of each object, shape (N,).
      partly: whether an object that can be moved passes on as much of its share as of its candidates hit something.
    """
    reached = [
        jnp.any(c.reached, axis=-1) & able[:, None] for c, able in zip(state.candidates, state.able, strict=True)
    ]
    reachable, hits = jnp.concatenate(reached, axis=1), jnp.concatenate([c.hits for c in state.candidates], axis=1)
    free = reachable & ~jnp.any(hits, axis=-1)
    passed = ~jnp.any(free, axis=1)
    if partly:
        passed = 1.0 - jnp.sum(free, axis=1) / jnp.maximum(jnp.sum(reachable, axis=1), 1)
    passed = jnp.where(jnp.any(state.able, axis=0), passed, 0.0)
    in_the_way = jax.vmap(blame)(hits, reachable)
    for _ in range(DEPTH):
        given = passed * share
        share = share - given + jnp.sum(given[:, None] * in_the_way, axis=0)
    return share


def sampling_weights(
    problem: Problem,
    belief: Belief,
    objective: Objective,
    guided_fraction: Array | float,
    state: State,
    partly: bool = False,
) -> Float[Array, " n"]:
    """Sampling weight of each object: partly even, partly by what it hides, which grasps it blocks, and which objects
    that do so it keeps from being moved.

    A found target that may be pushed counts as one more blocker of each of its blocked grasps; if no grasp is feasible,
    it is the only blocker. `partly` is that of `propagate_blame`.
    """
    rows = pairs(problem.grasps, belief.grasps.feasible)
    counts = rows.allowed & objective.needs_graspability(belief, state)[rows.pose]
    target = state.available & state.is_target
    blocked = jnp.any(state.hits, axis=1)
    blocks = blame(state.hits | (blocked[:, None] & target[None]), counts)
    blocks = jnp.where(jnp.any(counts), blocks, target)
    hides = blame(occluders(problem.existence, state.views), state.exists & ~belief.found)
    share = propagate_blame(state, blocks + hides, partly)
    share = share / jnp.maximum(jnp.sum(share), 1e-12)
    return (1.0 - guided_fraction) / EVEN + guided_fraction * share


def farther_weights(
    problem: Problem, belief: Belief, objective: Objective, guided_fraction: Array | float, state: State
) -> Float[Array, " n"]:
    """`sampling_weights` for where no single action gains anything: not even of what can be moved already."""
    return sampling_weights(problem, belief, objective, guided_fraction, state, partly=True)
