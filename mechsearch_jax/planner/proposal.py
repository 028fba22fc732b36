"""Which action is sampled in a state: the engine's slot `propose`."""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions.sampler import sample_action
from mechsearch_jax.actions.types import Sample
from mechsearch_jax.belief.belief import Belief, possible_space
from mechsearch_jax.existence import occluders
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.graspability import pairs
from mechsearch_jax.planner.objective import Objective
from mechsearch_jax.planner.state import State
from mechsearch_jax.problem.problem import Problem

# How much more an object matters that is in the way alone than one of two that are, one of two than one of three, ...
ALONE = 4.0
# How many objects deep what is in the way of moving an object is looked for.
DEPTH = 2
# What is drawn evenly is shared as if by so many, a scene's eight objects and the target, however many slots there are.
EVEN = 9


class Propose(Protocol):
    """Samples an action in a state; static under jit."""

    def __call__(
        self,
        key: Array,
        problem: Problem,
        belief: Belief,
        objective: Objective,
        guided_fraction: Array | float,
        state: State,
    ) -> Sample:
        """One action, of kind NONE where none is possible.

        Args:
          key: PRNG key.
          problem: what does not change.
          belief: what was known at the start.
          objective: what the search makes small.
          guided_fraction: see `PlannerConfig`.
          state: where it is sampled.
        """
        ...


class DrawnIn(Protocol):
    """As what a state is taken for where an action is drawn; static under jit."""

    def __call__(self, present: Superquadrics | None, state: State) -> State:
        """The state in which an action is drawn that is carried out in `state`.

        Args:
          present: the scene in which all sequences begin, fields (N, ...); None outside of sequences.
          state: as it is predicted.
        """
        ...


def as_predicted(present: Superquadrics | None, state: State) -> State:
    """The default `DrawnIn`: an action is drawn in the state that is predicted before it, as the paper says."""
    return state


def blame(in_the_way: Bool[Array, "k n"], counts: Bool[Array, " k"]) -> Float[Array, " n"]:
    """Each object's share of what is in the way in those rows that count; the fewer share a row, the more it weighs."""
    others = jnp.sum(in_the_way, axis=1, keepdims=True) - 1.0
    weight = jnp.where(in_the_way & counts[:, None], ALONE**-others, 0.0)
    total = jnp.sum(weight, axis=0)
    return total / jnp.maximum(jnp.sum(total), 1e-12)


def passed_on(state: State, share: Float[Array, " n"]) -> Float[Array, " n"]:
    """Shares of the objects, where those that cannot be moved yet give theirs to what is in the way of moving them.

    What is in the way of that in turn counts, too, `DEPTH` objects deep. The share of an object that arm and shelf do
    not allow to be moved at all is lost.

    Args:
      state: with its candidate actions.
      share: of each object, shape (N,).
    """
    reached = [
        jnp.any(c.reached, axis=-1) & able[:, None] for c, able in zip(state.candidates, state.able, strict=True)
    ]
    reachable, hits = jnp.concatenate(reached, axis=1), jnp.concatenate([c.hits for c in state.candidates], axis=1)
    stuck = ~jnp.any(reachable & ~jnp.any(hits, axis=-1), axis=1) & jnp.any(state.able, axis=0)
    in_the_way = jax.vmap(blame)(hits, reachable)
    for _ in range(DEPTH):
        given = jnp.where(stuck, share, 0.0)
        share = share - given + jnp.sum(given[:, None] * in_the_way, axis=0)
    return share


def sampling_weights(
    problem: Problem, belief: Belief, objective: Objective, guided_fraction: Array | float, state: State
) -> Float[Array, " n"]:
    """Sampling weight of each object: in part even, in part by what it hides and which grasps it blocks, or by what of
    that it keeps from being moved.

    A found target that may be pushed is one more object in the way of each of its grasps that is blocked; where none is
    feasible, it alone is in the way.
    """
    rows = pairs(problem.grasps, belief.grasps.feasible)
    counts = rows.allowed & objective.needs_graspability(belief, state)[rows.pose]
    target = state.available & state.is_target
    blocked = jnp.any(state.hits, axis=1)
    blocks = blame(state.hits | (blocked[:, None] & target[None]), counts)
    blocks = jnp.where(jnp.any(counts), blocks, target)
    hides = blame(occluders(problem.existence, state.views), state.exists & ~belief.found)
    share = passed_on(state, blocks + hides)
    share = share / jnp.maximum(jnp.sum(share), 1e-12)
    return (1.0 - guided_fraction) / EVEN + guided_fraction * share


def guided_draw(
    key: Array,
    problem: Problem,
    belief: Belief,
    objective: Objective,
    guided_fraction: Array | float,
    state: State,
) -> Sample:
    """The default `Propose`: draws go to objects by `sampling_weights`."""
    return sample_action(
        key,
        problem.space,
        state.scene,
        possible_space(problem, belief, state.exists),
        state.candidates,
        state.able,
        sampling_weights(problem, belief, objective, guided_fraction, state),
    )
