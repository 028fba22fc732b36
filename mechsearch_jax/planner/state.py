"""Predicted states in a sequence of actions, and decisions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions.candidates import AllCandidates
from mechsearch_jax.actions.registry import SAMPLED_KINDS
from mechsearch_jax.actions.types import Action
from mechsearch_jax.existence import ObjectViews
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.runtime.pytree import PyTreeNode


class State(PyTreeNode):
    """A predicted state, with quantities computed for the state before it.

    Attributes:
      scene: the objects and the target, fields (N, ...).
      is_target: which slot is the target's, shape (N,).
      exists: f, shape (X,). Once the target is found: the pose where it was pushed, if it could be hidden there.
      target_at: mask of the candidate pose that represents where a found target was pushed, shape (X,); empty before.
        See `belief.moved_target`.
      views: the objects as the camera sees them.
      hits: H, shape (K, N).
      candidates: candidate actions, of each of `SAMPLED_KINDS`.
      moved: which objects differ from the state before, shape (N,).
      available: which objects may be moved, shape (N,); `able` restricts the target to kinds that may move it.
      alive: whether every action of the sequence so far was possible.
    """

    scene: Superquadrics
    is_target: jax.Array
    exists: jax.Array
    target_at: jax.Array
    views: ObjectViews
    hits: jax.Array
    candidates: AllCandidates
    moved: jax.Array
    available: jax.Array
    alive: jax.Array

    @property
    def able(self) -> Bool[Array, "kinds n"]:
        """Which objects may be moved by each of `SAMPLED_KINDS`."""
        kinds = jnp.array([kind.moves_target for kind in SAMPLED_KINDS])
        return (self.available & self.alive)[None] & (kinds[:, None] | ~self.is_target[None])


class Sequences(PyTreeNode):
    """Sampled sequences of actions, best first; leading axis S, and M within.

    Attributes:
      actions: shape (S, M), of kind NONE after the last possible action; all NONE if the first was refused because it,
        or one like it, did harm in a trial.
      cost: J after each action, shape (S, M).
      value: equation 2 of the best prefix, shape (S,); infinite if there was no first action, or it was refused.
      length: number of actions in that prefix, shape (S,).
      after: the predicted objects after the first action of each, without the target, fields (S, N, ...); the present
        ones if there is no first action.
    """

    actions: Action
    cost: jax.Array
    value: jax.Array
    length: jax.Array
    after: Superquadrics


class Alternatives(PyTreeNode):
    """Alternative actions of a decision, for trials to choose from, best first; K of them.

    Attributes:
      actions: shape (K,).
      worth: which actions are possible and worth a trial, shape (K,).
      sequence: index of the decision's sequence that each begins, shape (K,); -1 for a grasp that may take the target
        out.
      now: the present objects, fields (N, ...).
      reached: J if the target can be taken out.
    """

    actions: Action
    worth: jax.Array
    sequence: jax.Array
    now: Superquadrics
    reached: jax.Array


class Decision(PyTreeNode):
    """The next action, and everything that was considered.

    Attributes:
      action: the next action; of kind NONE if none is possible or all that were tried were refused, of kind RETRIEVE if
        the target can be taken out.
      value: equation 2 of the sequence that it begins: the change of the cost, negative is good; 0 for a retrieval,
        infinite without an action.
      cost: J now.
      predicted_cost: predicted J after the action; NaN after a retrieval.
      predicted: the predicted objects after the action, without the target, fields (N, ...).
      sequences: all sampled sequences, the chosen one first, then best first; without first actions if none was
        sampled.
      refused: number of actions that were tried and refused.
      alternatives: actions to try instead; None if the policy gives none.
    """

    action: Action
    value: jax.Array
    cost: jax.Array
    predicted_cost: jax.Array
    predicted: Superquadrics
    sequences: Sequences
    refused: jax.Array | int = 0
    alternatives: Alternatives | None = None

    @property
    def least_cost(self) -> Float[Array, ""]:
        """The least J that is predicted after the action, or after later ones of its sequence."""
        return jnp.minimum(self.predicted_cost, jnp.min(self.sequences.cost[0]))
