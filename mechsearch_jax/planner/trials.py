"""Trying actions out before one is made: a stage between what a policy proposes and what is done.

What the planner predicts is quick and rough. A decision therefore holds its alternatives, ranked; trials tell what
becomes of them, and `choose` takes the first that succeeds. `decide` is the stage for a single scene,
`envs.episode.many_slots` has it for many at once, and `envs.trials` simulates.
"""

from __future__ import annotations

import enum
from typing import Protocol, runtime_checkable

import flax.struct
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
from mechsearch_jax.runtime.compiled import kept

# So many first actions of sequences are tried out at most; of grasps `retrieval.TRIES`.
TRIES = 8
# What a plan may begin with.
PLANNED = tuple(ActionKind(kind.code) for kind in SAMPLED_KINDS)


class TrialResult(enum.IntEnum):
    """What becomes of an action that is tried out, from bad to good.

    `UNKNOWN`: it was not tried, or its simulation diverged or had too little room. `HARMFUL`: something leaves the
    board, or the found target falls over. `FAILED`: it is not carried out as it was meant to. `SUCCEEDED`: it is; a
    retrieval takes the target out.
    """

    UNKNOWN = 0
    HARMFUL = 1
    FAILED = 2
    SUCCEEDED = 3


class TrialScenes(flax.struct.PyTreeNode):
    """Scenes in which actions are tried out; every field has a leading axis R.

    Attributes:
      objects: as recognised, without the target, fields (R, N, ...).
      pose: of the target as x, y [m], yaw [rad], shape (R, 3).
      found: whether the target is there, shape (R,).
      friction, mass: multiples of what friction and masses are taken to be, shape (R,).
    """

    objects: Superquadrics
    pose: jax.Array
    found: jax.Array
    friction: jax.Array
    mass: jax.Array


class Trials(Protocol):
    """Tries actions out, each in the present state of its scene. Called on the host, outside of any transformation."""

    def __call__(
        self, problem: Problem, scenes: TrialScenes, actions: Action, wanted: Bool[Array | np.ndarray, "r k"]
    ) -> Int[np.ndarray, "r k"]:
        """What becomes of each, as `TrialResult`.

        Those after the first of a row that succeeds need not be tried; what is said of them, and of those that are not
        wanted, counts for nothing. Of a retrieval it only counts whether it succeeds.

        Args:
          problem: what does not change.
          scenes: a scene for each row.
          actions: of any kinds, the best of a row first, fields (R, K, ...).
          wanted: which of them to try.
        """
        ...


@runtime_checkable
class AsksTwice(Protocol):
    """A policy that can be asked in two steps for what it decides, so that a plan is made only where one is needed."""

    def retrieval(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """Whether to take out a target that is found: an action of kind RETRIEVE, or of kind NONE."""
        ...

    def planned(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """What to do otherwise."""
        ...


def decide(
    policy, trials: Trials | None, key: Array, problem: Problem, belief: Belief, observation: Observation
) -> Decision:
    """What a policy proposes, after trials, for a single scene: propose, try, choose. On the host.

    What becomes of a plan is only tried where the target is not taken out.

    Args:
      policy: see `policies.Policy`; one that `AsksTwice` plans only where no grasp will do.
      trials: what tries its alternatives; None where nothing does.
      key, problem, belief, observation: as for the policy.
    """
    arguments = (key, problem, belief, observation)
    if trials is None or not isinstance(policy, AsksTwice):
        return tried(trials, problem, belief, observation, policy(*arguments))
    if belief.found:
        decision = tried(trials, problem, belief, observation, policy.retrieval(*arguments))
        if int(decision.action.kind) == ActionKind.RETRIEVE:
            return decision
    return tried(trials, problem, belief, observation, policy.planned(*arguments))


def tried(
    trials: Trials | None, problem: Problem, belief: Belief, observation: Observation, decision: Decision
) -> Decision:
    """A decision after trials of its alternatives; as it is where it has none, or nothing tries."""
    alternatives = decision.alternatives
    if trials is None or alternatives is None:
        return decision
    scene = scenes_of(belief, observation)
    scenes, rows = jax.tree.map(lambda a: np.asarray(a)[None], jax.device_get((scene, alternatives)))
    results = trials(problem, scenes, rows.actions, rows.worth)
    return choose(decision, jnp.asarray(results[0], jnp.int32))


def scenes_of(belief: Belief, observation: Observation) -> TrialScenes:
    """Where a policy's actions are to be tried; with any leading axes, or none."""
    found = belief.found
    usual = jnp.ones(jnp.shape(found), jnp.float32)
    return TrialScenes(observation.objects, belief.found_pose, found, usual, usual)


def grasps_to_try(actions: Action, worth: Bool[Array, " k"], now: Superquadrics, reached: float) -> Alternatives:
    """Grasps that may take the target out, best first; see `Alternatives`."""
    sequence = jnp.full(worth.shape, -1, jnp.int32)
    return Alternatives(actions, worth, sequence, now, jnp.float32(reached))


@kept()
def sequences_to_try(sequences: Sequences, now: Superquadrics, reached: Float[Array, ""]) -> Alternatives:
    """The first actions of the best sequences; see `Alternatives`."""
    first: Action = jax.tree.map(lambda a: a[:TRIES, 0], sequences.actions)
    worth = (first.kind != ActionKind.NONE) & jnp.isfinite(sequences.value[:TRIES])
    return Alternatives(first, worth, jnp.arange(len(worth), dtype=jnp.int32), now, reached)


def in_turn(first: Alternatives, then: Alternatives) -> Alternatives:
    """Alternatives, and others after them, in one decision."""
    actions, worth, sequence = jax.tree.map(
        lambda a, b: jnp.concatenate([a, b]),
        (first.actions, first.worth, first.sequence),
        (then.actions, then.worth, then.sequence),
    )
    return then.replace(actions=actions, worth=worth, sequence=sequence)


@kept()
def choose(decision: Decision, results: Int[Array, " k"]) -> Decision:
    """The decision as results of trials make it.

    The first alternative that succeeds is made. Where none does, a target that the decision takes out is taken out all
    the same; else the first is made that begins a sequence and does no harm; else nothing. Sequences that begin with
    what did harm, or of which it is not known what it does, are refused. A decision without alternatives stays as it
    is.

    Args:
      decision: of a policy.
      results: of them, as `TrialResult`.
    """
    sequences, alternatives = decision.sequences, decision.alternatives
    if alternatives is None:
        return decision
    results = jnp.where(alternatives.worth, results, TrialResult.UNKNOWN)
    grasps = alternatives.sequence < 0
    takes = decision.action.kind == ActionKind.RETRIEVE
    # Of what would take the target out it only counts whether it does.
    best = jnp.argmax(jnp.where(grasps & (results < TrialResult.SUCCEEDED), -1, results))
    succeeds = results[best] == TrialResult.SUCCEEDED
    does = results[best] > TrialResult.HARMFUL
    # What comes after the first that succeeds was not tried.
    order = jnp.arange(results.shape[0])
    rejected = alternatives.worth & ~grasps & ((order < best) | ~succeeds) & (results <= TrialResult.HARMFUL)
    place = jnp.where(grasps, sequences.value.shape[0], alternatives.sequence)
    refused = jnp.zeros(sequences.value.shape, bool).at[place].set(rejected, mode="drop")
    planned = _planned(decision, alternatives.now, refused, alternatives.sequence[best], does & ~grasps[best])
    taken = _taken(decision, alternatives, jax.tree.map(lambda a: a[best], alternatives.actions))
    grasped = succeeds & grasps[best]

    def either(grasp, as_it_is, other):
        return jnp.where(grasped, grasp, jnp.where(takes & ~succeeds, as_it_is, other))

    return jax.tree.map(either, taken, decision.replace(refused=jnp.int32(0)), planned)


def _planned(
    decision: Decision, now: Superquadrics, refused: Bool[Array, " s"], index: Int[Array, ""], does: Bool[Array, ""]
) -> Decision:
    """The decision to begin with the first action of a sequence, or to do nothing, without those that are refused."""
    sequences = decision.sequences
    ruled_out = sequences.replace(
        actions=sequences.actions.replace(kind=jnp.where(refused[:, None], ActionKind.NONE, sequences.actions.kind)),
        value=jnp.where(refused, jnp.inf, sequences.value),
        after=jax.tree.map(lambda a, b: jnp.where(refused.reshape(-1, *[1] * b.ndim), b, a), sequences.after, now),
    )
    chosen = (jnp.arange(len(refused)) == index) & does
    order = jnp.argsort(jnp.where(chosen, -jnp.inf, ruled_out.value), stable=True)
    sequences = jax.tree.map(lambda a: a[order], ruled_out)
    first: Action = jax.tree.map(lambda a: a[0, 0], sequences.actions)
    return decision.replace(
        action=jax.tree.map(lambda a, b: jnp.where(does, a, b), first, no_action()),
        value=jnp.where(does, sequences.value[0], jnp.inf),
        predicted_cost=jnp.where(does, sequences.cost[0, 0], decision.cost),
        predicted=jax.tree.map(lambda a, b: jnp.where(does, a[0], b), sequences.after, now),
        sequences=sequences,
        refused=jnp.sum(refused),
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
