"""Trying actions out before one is made: a slot that `envs.physics_rehearsal` fills with a simulation.

What the planner predicts is quick and rough. Of the few actions that it likes best, a rehearsal tells what becomes of
them, and the first that succeeds is made.
"""

from __future__ import annotations

import enum
from typing import Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.nothing import no_action
from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.actions.types import Action
from mechsearch_jax.compiled import kept
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner.problem import Problem
from mechsearch_jax.planner.state import Decision

# So many actions are tried out at most.
TRIES = 8


class Rehearsed(enum.IntEnum):
    """What becomes of an action that is tried out, from bad to good.

    `HARMFUL`: something leaves the board, or the found target falls over; also what was not tried out. `FAILED`: it is
    not carried out as it was meant to. `SUCCEEDED`: it is; a retrieval takes the target out.
    """

    HARMFUL = 0
    FAILED = 1
    SUCCEEDED = 2


class Rehearsal(Protocol):
    """Tries actions out, each in the present scene."""

    def __call__(
        self,
        problem: Problem,
        scene: Superquadrics,
        pose: Float[Array, "3"],
        found: Bool[Array, ""] | bool,
        actions: Action,
        asked: Bool[Array, " k"],
    ) -> Int[Array, " k"]:
        """What becomes of each, as `Rehearsed`; those after the first that succeeds need not be tried.

        Args:
          problem: what does not change.
          scene: the objects, without the target, fields (N, ...).
          pose: of the target as x, y [m], yaw [rad].
          found: whether the target is there.
          actions: of any kinds, the best first, fields (K, ...).
          asked: which of them to try.
        """
        ...


def rehearsed(
    rehearsal: Rehearsal,
    problem: Problem,
    scene: Superquadrics,
    pose: Float[Array, "3"],
    found: Bool[Array, ""] | bool,
    decision: Decision,
) -> Decision:
    """A decision whose action is the first of the best sequences' that succeeds as it is tried out.

    Where none succeeds, the first is made that does no harm; where all do harm, nothing is done.

    Args:
      rehearsal: tries out.
      problem, scene, pose, found: as it is told.
      decision: of the planner, not to take the target out.
    """
    actions, asked = _to_try(decision)
    return _made(decision, rehearsal(problem, scene, pose, found, actions, asked))


@kept()
def _to_try(decision: Decision) -> tuple[Action, Bool[Array, " k"]]:
    """The first actions of the best sequences, and which of them are any."""
    first = jax.tree.map(lambda a: a[:TRIES, 0], decision.sequences.actions)
    return first, (first.kind != ActionKind.NONE) & (decision.action.kind != ActionKind.NONE)


@kept()
def _made(decision: Decision, told: Int[Array, " k"]) -> Decision:
    """The decision as what was told makes it."""
    best, every = jnp.argmax(told), decision.sequences
    first: Action = jax.tree.map(lambda a: a[best, 0], every.actions)
    chosen = decision.replace(
        action=first,
        value=every.value[best],
        predicted_cost=every.cost[best, 0],
        predicted=jax.tree.map(lambda a: a[best], every.after),
    )
    none = told[best] == Rehearsed.HARMFUL
    nothing = decision.replace(action=no_action(), value=jnp.zeros_like(decision.value), predicted_cost=decision.cost)
    # Where the planner found nothing to do, nothing was tried.
    keeps = decision.action.kind == ActionKind.NONE
    tried = jax.tree.map(lambda a, b: jnp.where(none, a, b), nothing, chosen)
    return jax.tree.map(lambda a, b: jnp.where(keeps, a, b), decision, tried)
