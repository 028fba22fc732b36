"""A predicted state on the way through a sequence of actions, and what a decision consists of."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from mechsearch_jax.actions.candidates import AllCandidates
from mechsearch_jax.actions.registry import SAMPLED_KINDS
from mechsearch_jax.actions.types import Action
from mechsearch_jax.existence import ObjectViews
from mechsearch_jax.geometry.superquadric import Superquadrics


class State(flax.struct.PyTreeNode):
    """A predicted state, with what was computed of the one before it.

    Attributes:
      scene: the objects and the target, fields (N, ...).
      is_target: which slot is the target's, shape (N,).
      exists: f, shape (X,). Once the target is found: the pose that it was pushed to, if it could be hidden there.
      target_at: the candidate pose that stands for where a found target was pushed to, as a mask, shape (X,); nowhere
        as long as it was not. See `belief.moved_target`.
      views: the objects as the camera sees them.
      hits: H, shape (K, N).
      candidates: candidate actions, of each of `SAMPLED_KINDS`.
      moved: which objects differ from the state before, shape (N,).
      available: which objects may be moved, shape (N,); the target only by some kinds, see `able`.
      alive: whether the sequence has found something to do so far.
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


class Sequences(flax.struct.PyTreeNode):
    """Sampled sequences of actions, best first; leading axis S, and M within.

    Attributes:
      actions: shape (S, M), of kind NONE from where a sequence found nothing more to do; all of them where the first
        was refused because it did harm in a trial.
      cost: J after each action, shape (S, M).
      value: equation 2 of the best prefix, shape (S,); infinite if there was no first action, or it was refused.
      length: number of actions in that prefix, shape (S,).
      after: the objects as they are expected to be after the first action of each, without the target, fields (S, N,
        ...); as they are where there is none.
    """

    actions: Action
    cost: jax.Array
    value: jax.Array
    length: jax.Array
    after: Superquadrics


class Alternatives(flax.struct.PyTreeNode):
    """What a decision could be instead, for trials to choose from, the best first; K of them.

    Attributes:
      actions: shape (K,).
      worth: which of them are any, and worth a trial, shape (K,).
      sequence: which of the decision's sequences each begins, shape (K,); -1 for a grasp that may take the target out.
      now: the objects as they are, fields (N, ...).
      reached: J where the target can be taken out.
    """

    actions: Action
    worth: jax.Array
    sequence: jax.Array
    now: Superquadrics
    reached: jax.Array


class Decision(flax.struct.PyTreeNode):
    """What to do next, and everything that was considered.

    Attributes:
      action: what to do next; of kind NONE if nothing is possible or all that was tried out was refused, of kind
        RETRIEVE if the target can be taken out.
      value: equation 2 of the sequence it begins: the change of the cost, negative is good; 0 for a retrieval, infinite
        where nothing is done.
      cost: J now.
      predicted_cost: J that is expected after the action; NaN after a retrieval.
      predicted: the objects as they are expected to be after the action, without the target, fields (N, ...).
      sequences: all sampled sequences, the chosen one first, then the best; none has a first action where none was
        sampled.
      refused: how many of the best sequences began with what did harm in a trial.
      alternatives: what else could be done; None where the policy has not said.
    """

    action: Action
    value: jax.Array
    cost: jax.Array
    predicted_cost: jax.Array
    predicted: Superquadrics
    sequences: Sequences
    refused: jax.Array | int = 0
    alternatives: Alternatives | None = None
