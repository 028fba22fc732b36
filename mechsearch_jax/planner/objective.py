"""The cost J of equation 2 that a search minimises: the engine's slot `objective`."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.belief.belief import Belief, possible_poses
from mechsearch_jax.config.config import Weights
from mechsearch_jax.grasping.graspability import INFEASIBLE, crowding, graspability, pairs
from mechsearch_jax.planner.state import State
from mechsearch_jax.problem.problem import Problem


class Objective(Protocol):
    """The cost of a state; static under jit.

    Attributes:
      reached: cost of a state in which the target is found and a grasp hits nothing.
    """

    @property
    def reached(self) -> float: ...

    def cost(self, problem: Problem, belief: Belief, state: State, weights: Weights) -> Float[Array, ""]:
        """J of a state; it may include a terminal value.

        Args:
          problem: constants of the search.
          belief: the belief at the start of the plan.
          state: a state with up-to-date f and H.
          weights: weights of J's terms.
        """
        ...

    def needs_graspability(self, belief: Belief, state: State) -> Bool[Array, " y"]:
        """At which poses J depends on g: candidate poses, then the found pose; f of the state is up to date."""
        ...


def _where_and_how_graspable(problem, belief, state):
    """f, 1 - g with g extended below zero (B.4), and crowding, at all poses.

    g counts only the best grasp of a pose; crowding also rewards clearing the others.
    A found target that is pushed to where it could be hidden counts as if no grasp were feasible: unseen, its true pose
    would be unknown.
    """
    f = possible_poses(belief, state.exists, state.target_at).astype(jnp.float32)
    rows = pairs(problem.grasps, belief.grasps.feasible)
    hidden = jnp.append(state.exists & belief.found, False)
    g = jnp.minimum(graspability(rows, state.hits), jnp.where(hidden, 1 - INFEASIBLE, 1)).astype(jnp.float32)
    return f, 1.0 - g, crowding(rows, state.hits)


@dataclasses.dataclass(frozen=True)
class SearchForGrasp:
    """Where the target can be and how far it is from graspable there, together (the sum of f * (2 - g)).

    Attributes:
      reached: see `Objective`.
    """

    reached: float = 1.0

    def cost(self, problem, belief, state, weights) -> Float[Array, ""]:
        f, hindered, crowded = _where_and_how_graspable(problem, belief, state)
        return jnp.sum(f * (1.0 + hindered + weights.crowding * crowded))

    def needs_graspability(self, belief, state) -> Bool[Array, " y"]:
        return possible_poses(belief, state.exists, state.target_at)


@dataclasses.dataclass(frozen=True)
class SearchAndGrasp:
    """First where the target can be; once it is found, how far it is from graspable.

    Attributes:
      reached: see `Objective`.
    """

    reached: float = 0.0

    def cost(self, problem, belief, state, weights) -> Float[Array, ""]:
        f, hindered, crowded = _where_and_how_graspable(problem, belief, state)
        grasp_cost = hindered + weights.crowding * crowded
        return jnp.where(belief.found, jnp.sum(f * grasp_cost), jnp.sum(f))

    def needs_graspability(self, belief, state) -> Bool[Array, " y"]:
        return possible_poses(belief, state.exists, state.target_at) & belief.found


@dataclasses.dataclass(frozen=True)
class Indifferent:
    """A constant cost: the first possible sequence is the best."""

    reached: float = 0.0

    def cost(self, problem, belief, state, weights) -> Float[Array, ""]:
        return jnp.float32(0.0)

    def needs_graspability(self, belief, state) -> Bool[Array, " y"]:
        return jnp.zeros_like(possible_poses(belief, state.exists, state.target_at))
