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
from mechsearch_jax.actions.registry import SAMPLED_KINDS, ActionKind
from mechsearch_jax.actions.types import Action
from mechsearch_jax.compiled import kept
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner.problem import Problem
from mechsearch_jax.planner.state import Decision

# So many actions are tried out at most.
TRIES = 8
# What a plan may begin with.
PLANNED = tuple(ActionKind(kind.code) for kind in SAMPLED_KINDS)


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
        kinds: tuple[ActionKind, ...],
    ) -> Int[Array, " k"]:
        """What becomes of each, as `Rehearsed`.

        Those after the first that succeeds need not be tried; what is said of them, and of those that are not asked
        for, counts for nothing.

        Args:
          problem: what does not change.
          scene: the objects, without the target, fields (N, ...).
          pose: of the target as x, y [m], yaw [rad].
          found: whether the target is there.
          actions: of any kinds, the best first, fields (K, ...).
          asked: which of them to try.
          kinds: all that these are of; static.
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

    Where none succeeds, the first is made that does no harm; where all do harm, nothing is done. Sequences that begin
    with what did harm are refused.

    Args:
      rehearsal: tries out.
      problem, scene, pose, found: as it is told.
      decision: of the planner, not to take the target out.
    """
    actions, asked = _to_try(decision)
    return _made(decision, scene, asked, rehearsal(problem, scene, pose, found, actions, asked, PLANNED))


@kept()
def _to_try(decision: Decision) -> tuple[Action, Bool[Array, " k"]]:
    """The first actions of the best sequences, and which of them are any."""
    first: Action = jax.tree.map(lambda a: a[:TRIES, 0], decision.sequences.actions)
    return first, (first.kind != ActionKind.NONE) & jnp.isfinite(decision.sequences.value[:TRIES])


@kept()
def _made(decision: Decision, scene: Superquadrics, asked: Bool[Array, " k"], told: Int[Array, " k"]) -> Decision:
    """The decision as what was told of those that were asked for makes it."""
    every, k = decision.sequences, asked.shape[0]
    told = jnp.where(asked, told, Rehearsed.HARMFUL)
    best = jnp.argmax(told)
    # What comes after the first that succeeds was not tried.
    tried = asked & ((jnp.arange(k) < best) | (told[best] < Rehearsed.SUCCEEDED))
    refused = jnp.zeros(every.value.shape, bool).at[:k].set(tried & (told == Rehearsed.HARMFUL))
    ruled_out = every.replace(
        actions=every.actions.replace(kind=jnp.where(refused[:, None], ActionKind.NONE, every.actions.kind)),
        value=jnp.where(refused, jnp.inf, every.value),
        after=jax.tree.map(lambda a, now: jnp.where(refused.reshape(-1, *[1] * now.ndim), now, a), every.after, scene),
    )
    does = told[best] > Rehearsed.HARMFUL
    chosen = (jnp.arange(len(refused)) == best) & does
    order = jnp.argsort(jnp.where(chosen, -jnp.inf, ruled_out.value), stable=True)
    sequences = jax.tree.map(lambda a: a[order], ruled_out)
    first: Action = jax.tree.map(lambda a: a[0, 0], sequences.actions)
    return decision.replace(
        action=jax.tree.map(lambda a, b: jnp.where(does, a, b), first, no_action()),
        value=jnp.where(does, sequences.value[0], jnp.inf),
        predicted_cost=jnp.where(does, sequences.cost[0, 0], decision.cost),
        predicted=jax.tree.map(lambda a, now: jnp.where(does, a[0], now), sequences.after, scene),
        sequences=sequences,
        refused=jnp.sum(refused),
    )
