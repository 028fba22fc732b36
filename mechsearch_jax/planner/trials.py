"""Trials: actions are tried in physics before one is made, a stage between a policy's proposal and the action.

The planner's predictions are quick and rough. A decision therefore holds ranked alternatives; trials return their
results, and `choose` takes the first that succeeds. `step` says when; `envs.trials` simulates.
"""

from __future__ import annotations

import enum
import functools
import math
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import SAMPLED_KINDS, ActionKind
from mechsearch_jax.actions.types import Action
from mechsearch_jax.belief.belief import Belief
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner.state import Alternatives, Decision, Sequences
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.pytree import PyTreeNode

# Largest number of first actions of sequences that are tried; for grasps see `retrieval.TRIES`.
TRIES = 24
# Two actions of the same kind and object are alike if the gripper begins within this of the other's place, also ends
# within it [m], and approaches within this angle of it [rad].
ALIKE, ALIKE_APPROACH = 0.02, math.radians(10)
# Kinds of action that a plan may begin with.
PLANNED = tuple(ActionKind(kind.code) for kind in SAMPLED_KINDS)


class TrialResult(enum.IntEnum):
    """Result of an action's trial.

    `UNKNOWN`: it was not tried, or its simulation diverged or had too little room. `HARMFUL`: something leaves the
    board, or the found target falls over. `FAILED`: it is not executed as intended. `SUCCEEDED`: it is; a retrieval
    takes the target out. `UNSURE`: it is in the scene as it is recognised; in one near it a retrieval fails
    without harm, or another action does harm.
    """

    UNKNOWN = 0
    HARMFUL = 1
    FAILED = 2
    SUCCEEDED = 3
    UNSURE = 4


# How good each `TrialResult` is, by its number.
RANK = (0, 1, 2, 4, 3)


class TrialScenes(PyTreeNode):
    """Scenes in which actions are tried; every field has a leading axis R.

    Attributes:
      objects: the recognised objects without the target, fields (R, N, ...).
      pose: pose of the target as x, y [m], yaw [rad], shape (R, 3).
      found: whether the target is found, shape (R,).
      friction: multiple of the assumed frictions, shape (R,).
    """

    objects: Superquadrics
    pose: jax.Array
    found: jax.Array
    friction: jax.Array


class Trials(Protocol):
    """Tries actions, each in the present state of its scene. Called on the host, outside of transformations."""

    def __call__(
        self, problem: Problem, scenes: TrialScenes, actions: Action, wanted: Bool[Array | np.ndarray, "r k"]
    ) -> Int[np.ndarray, "r k"]:
        """The `TrialResult` of each action.

        Actions after the first success of a row need not be tried; their results, and those of actions that are not
        wanted, are ignored. For a retrieval it counts whether it succeeds, and
        whether any has a result at all; see `choose`.

        Args:
          problem: constants of the search.
          scenes: a scene for each row.
          actions: actions of any kinds, best first in each row, fields (R, K, ...).
          wanted: which actions to try.
        """
        ...


@runtime_checkable
class TwoStagePolicy(Protocol):
    """A policy that decides in two steps, so that it plans only if the target is not taken out."""

    def retrieval(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """Whether to take out a found target: an action of kind RETRIEVE, or of kind NONE."""
        ...

    def planned(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """The planned decision otherwise."""
        ...


class TriedActions(NamedTuple):
    """The actions that were tried out before one was made, in order, up to the first that succeeded; NumPy arrays. What
    succeeded, but cannot be executed by the arm, counts as failed.

    Attributes:
      action: fields with a leading axis K.
      result: the `TrialResult` of each, shape (K,).
    """

    action: Action
    result: Int[np.ndarray, " k"]


def nothing_tried() -> TriedActions:
    """No actions."""
    # By shapes alone: arrays would be made on the device, and read back, for each decision.
    blank = jax.tree.map(lambda a: np.zeros((0, *a.shape), a.dtype), jax.eval_shape(no_action))
    return TriedActions(blank, np.zeros(0, np.int32))


def tried(alternatives: Alternatives, results: Int[np.ndarray, "1 k"]) -> TriedActions:
    """What the trials of a single scene came to, whose alternatives have a leading axis of 1.

    Those after the first success are left out: nothing depends on them.
    """
    rows = np.flatnonzero(alternatives.worth[0])
    won = np.flatnonzero(results[0][rows] == TrialResult.SUCCEEDED)
    rows = rows[: won[0] + 1] if len(won) else rows
    return TriedActions(
        jax.tree.map(lambda a: a[0][rows], alternatives.actions), np.asarray(results[0], np.int32)[rows]
    )


def scenes_of(belief: Belief, observation: Observation) -> TrialScenes:
    """Scenes for trials, with friction as assumed; any leading axes, or none."""
    friction = jnp.ones(jnp.shape(belief.found), jnp.float32)
    return TrialScenes(observation.objects, belief.found_pose, belief.found, friction)


def grasps_to_try(actions: Action, worth: Bool[Array, " k"], now: Superquadrics, reached: float) -> Alternatives:
    """The alternatives of grasps that may take the target out, best first."""
    sequence = jnp.full(worth.shape, -1, jnp.int32)
    return Alternatives(actions, worth, sequence, now, jnp.float32(reached))


@cached_jit()
def sequences_to_try(sequences: Sequences, now: Superquadrics, reached: Float[Array, ""]) -> Alternatives:
    """The alternatives of the first actions of the best sequences, up to `TRIES` of them, no two alike.

    A trial of an action that is like another would only repeat its result. If fewer differ, the rest are not worth a
    trial.

    Args:
      sequences: of a decision, best first.
      now: the present objects.
      reached: J if the target can be taken out.
    """
    first: Action = jax.tree.map(lambda a: a[:, 0], sequences.actions)
    possible = (first.kind != ActionKind.NONE) & jnp.isfinite(sequences.value)
    count = len(possible)

    def pick(rank: Int[Array, " s"], _):
        i = jnp.argmin(rank)
        behind = _alike(first, jax.tree.map(lambda a: a[i], first)) & (rank < count)
        return jnp.where(behind, rank + count, rank).at[i].set(2 * count), (i, rank[i] < count)

    # From `count` on, what is not worth a trial, and then what was picked.
    rank = jnp.arange(count) + jnp.where(possible, 0, count)
    _, (best, worth) = jax.lax.scan(pick, rank, length=min(TRIES, count))
    return Alternatives(jax.tree.map(lambda a: a[best], first), worth, best.astype(jnp.int32), now, reached)


def _alike(actions: Action, action: Action) -> Bool[Array, " s"]:
    """Which of S actions are like another; see `ALIKE`."""
    near = [
        jnp.sum((ends - end[None]) ** 2, axis=-1) < ALIKE**2
        for ends, end in (
            (actions.T_world_gripper[:, :3, 3], action.T_world_gripper[:3, 3]),
            (actions.T_world_place[:, :3, 3], action.T_world_place[:3, 3]),
        )
    ]
    cosine = jnp.sum(actions.T_world_gripper[:, :3, 2] * action.T_world_gripper[None, :3, 2], axis=-1)
    same = (actions.kind == action.kind) & (actions.object == action.object)
    return same & near[0] & near[1] & (cosine > math.cos(ALIKE_APPROACH))


def concatenate(first: Alternatives, then: Alternatives) -> Alternatives:
    """Alternatives in order: `first`, and `then` after them."""
    actions, worth, sequence = jax.tree.map(
        lambda a, b: jnp.concatenate([a, b]),
        (first.actions, first.worth, first.sequence),
        (then.actions, then.worth, then.sequence),
    )
    return then.replace(actions=actions, worth=worth, sequence=sequence)


@cached_jit()
def choose(decision: Decision, results: Int[Array, " k"], last: Bool[Array, ""]) -> Decision:
    """Choose an action by the results of trials.

    A grasp that succeeds is chosen first, or, where no further action is allowed and none does, an unsure one. Else a
    retrieval that the decision already makes is kept if the results of all grasps are unknown. Else the first other
    alternative that succeeds is chosen, else the first that is unsure, else the first that begins a sequence and did no
    harm, else nothing. Sequences whose first action did harm, or has an unknown result, or is like one of these, are
    refused. A decision without alternatives stays unchanged.

    Args:
      decision: decision of a policy.
      results: the `TrialResult` of each alternative.
      last: whether no further action is allowed.
    """
    sequences, alternatives = decision.sequences, decision.alternatives
    if alternatives is None:
        return decision
    results = jnp.where(alternatives.worth, results, TrialResult.UNKNOWN)
    grasps = alternatives.sequence < 0
    certain = jnp.any(grasps & (results == TrialResult.SUCCEEDED))
    unsure = jnp.where(last & ~certain, TrialResult.SUCCEEDED, TrialResult.FAILED)
    results = jnp.where(grasps & (results == TrialResult.UNSURE), unsure, results)
    takes = decision.action.kind == ActionKind.RETRIEVE
    # A grasp counts only if it succeeds.
    rank = jnp.array(RANK)[results]
    best = jnp.argmax(jnp.where(grasps & (results != TrialResult.SUCCEEDED), -1, rank))
    succeeds = results[best] == TrialResult.SUCCEEDED
    harmless = results[best] > TrialResult.HARMFUL
    # Alternatives after the first success were not tried.
    order = jnp.arange(results.shape[0])
    rejected = alternatives.worth & ~grasps & ((order < best) | ~succeeds) & (results <= TrialResult.HARMFUL)
    first = jax.tree.map(lambda a: a[:, 0], sequences.actions)
    alike = jax.vmap(functools.partial(_alike, first))(alternatives.actions) & rejected[:, None]
    refused = jnp.any(alike, axis=0)
    planned = _planned(decision, alternatives.now, refused, alternatives.sequence[best], harmless & ~grasps[best])
    planned = planned.replace(refused=jnp.sum(rejected))
    taken = _taken(decision, alternatives, jax.tree.map(lambda a: a[best], alternatives.actions))
    grasped = succeeds & grasps[best]
    untried = takes & ~jnp.any(grasps & (results > TrialResult.UNKNOWN))
    kept_grasp = _taken(decision, alternatives, decision.action)

    def select(grasp, untried_grasp, plan):
        return jnp.where(grasped, grasp, jnp.where(untried, untried_grasp, plan))

    return jax.tree.map(select, taken, kept_grasp, planned)


def _planned(
    decision: Decision, now: Superquadrics, refused: Bool[Array, " s"], index: Int[Array, ""], acts: Bool[Array, ""]
) -> Decision:
    """The decision to begin the sequence `index` if `acts`, else to do nothing; without the refused sequences."""
    sequences = decision.sequences
    chosen = (jnp.arange(len(refused)) == index) & acts
    refused = refused & ~chosen
    ruled_out = sequences.replace(
        actions=sequences.actions.replace(kind=jnp.where(refused[:, None], ActionKind.NONE, sequences.actions.kind)),
        value=jnp.where(refused, jnp.inf, sequences.value),
        after=jax.tree.map(lambda a, b: jnp.where(refused.reshape(-1, *[1] * b.ndim), b, a), sequences.after, now),
    )
    order = jnp.argsort(jnp.where(chosen, -jnp.inf, ruled_out.value), stable=True)
    sequences = jax.tree.map(lambda a: a[order], ruled_out)
    first: Action = jax.tree.map(lambda a: a[0, 0], sequences.actions)
    return decision.replace(
        action=jax.tree.map(lambda a, b: jnp.where(acts, a, b), first, no_action()),
        value=jnp.where(acts, sequences.value[0], jnp.inf),
        predicted_cost=jnp.where(acts, sequences.cost[0, 0], decision.cost),
        predicted=jax.tree.map(lambda a, b: jnp.where(acts, a[0], b), sequences.after, now),
        sequences=sequences,
    )


def _taken(decision: Decision, alternatives: Alternatives, action: Action) -> Decision:
    """The decision to take the target out with an action."""
    sequences = decision.sequences
    nothing = jax.tree.map(lambda a, b: jnp.broadcast_to(b, a.shape), sequences.actions, no_action())
    after = jax.tree.map(lambda a, b: jnp.broadcast_to(b, a.shape), sequences.after, alternatives.now)
    return decision.replace(
        action=action,
        value=jnp.float32(0.0),
        cost=alternatives.reached,
        predicted_cost=jnp.float32(jnp.nan),
        predicted=alternatives.now,
        sequences=Sequences(
            actions=nothing,
            cost=jnp.full_like(sequences.cost, jnp.nan),
            value=jnp.full_like(sequences.value, jnp.inf),
            length=jnp.ones_like(sequences.length),
            after=after,
        ),
        refused=jnp.int32(0),
    )
