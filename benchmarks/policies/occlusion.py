"""A policy without look-ahead, `mechsearch_jax.benchmarks.policies.occlusion:most_occluding`: it moves the object that
occludes most.

See docs/method.md, "Policies to compare with".

An object occludes as many possible poses of the target as it hides; once the target is found, as many of its feasible
grasps as would hit the object.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.belief.belief import Belief
from mechsearch_jax.existence import occluders
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner import PlannerConfig, PlanningPolicy, search_and_grasp
from mechsearch_jax.planner.objective import Objective
from mechsearch_jax.planner.rollout import Rollout, no_sequences
from mechsearch_jax.planner.state import Decision, State
from mechsearch_jax.problem.problem import Problem

# Sampling weight of an object relative to the next one that occludes more. An object that cannot be moved has none.
NEXT = 0.5
# Largest number of actions of an object that a decision holds, so that trials come to the next object, too.
EACH = 4


class Occlusion(NamedTuple):
    """What the objects of a scene occlude: possible poses of a hidden target, or grasps of a found one.

    Attributes:
      by_object: number that each object occludes; several objects may occlude the same.
      total: number of possible poses, or of grasps that hit any object.
    """

    by_object: Float[Array, " n"]
    total: Float[Array, ""]


def occlusion(problem: Problem, belief: Belief, state: State) -> Occlusion:
    """What each object of a state occludes; its f and H are up to date."""
    possible = state.exists & ~belief.found
    hides = occluders(problem.existence, state.views) & possible[:, None]
    blocks = state.hits[problem.grasps.pair_pose.shape[0] :] & belief.grasps.feasible[:, None] & belief.found
    by_object = jnp.sum(hides, axis=0) + jnp.sum(blocks, axis=0)
    total = jnp.sum(possible) + jnp.sum(jnp.any(blocks, axis=1))
    return Occlusion(by_object.astype(jnp.float32), total.astype(jnp.float32))


def weights_in_order(by_object: Float[Array, " n"]) -> Float[Array, " n"]:
    """Sampling weights of objects that fall by `NEXT` from each to the one that occludes next most; ties are equal."""
    rank = jnp.sum(by_object[None] > by_object[:, None], axis=1)
    return NEXT ** rank.astype(jnp.float32)


def occlusion_weights(
    problem: Problem, belief: Belief, objective: Objective, guided_fraction: Array | float, state: State
) -> Float[Array, " n"]:
    """The `ObjectWeights` of this baseline: most draws go to the object that occludes most and can be moved."""
    return weights_in_order(occlusion(problem, belief, state).by_object)


def most_occluding_first(
    kind: Int[Array, " s"], index: Int[Array, " s"], by_object: Float[Array, " n"]
) -> Float[Array, " s"]:
    """Value of each drawn action, the least best: minus what its object occludes; infinite for those left out.

    Actions of kind NONE are left out, and those of an object beyond its first `EACH`.

    Args:
      kind: of the actions.
      index: of their objects.
      by_object: see `Occlusion`.
    """
    acts = kind != ActionKind.NONE
    before = jnp.tril((index[:, None] == index[None]) & acts[None], -1)
    return jnp.where(acts & (jnp.sum(before, axis=1) < EACH), -by_object[index], jnp.inf)


def plan_by_occlusion(rollout: Rollout, key: Array, objects: Superquadrics) -> Decision:
    """Decide to move the object that occludes most; a `policies.Plan`.

    Of the objects for which a possible action was drawn it is the one that occludes most, and of its actions the one
    that was drawn first: no cost of a predicted state is computed. J is the number of what is occluded, and is said to
    decrease by what the object occludes.

    Args:
      rollout: problem, belief and slots; its `weigh` has the same order.
      key: PRNG key of the planner.
      objects: the recognised objects, fields (N, ...).

    Returns:
      The decision. Its sequences are single actions, in the order of what their objects occlude.
    """
    count = rollout.config.sequences
    state = rollout.up_to_date(rollout.root(objects))
    occludes = occlusion(rollout.problem, rollout.belief, state)
    changes, actions, _ = jax.vmap(lambda k: rollout.act(True, state, k))(jax.random.split(key, count))
    value = most_occluding_first(actions.kind, actions.object, occludes.by_object)
    usable = jnp.isfinite(value)
    actions = actions.replace(kind=jnp.where(usable, actions.kind, ActionKind.NONE).astype(jnp.int32))
    nothing = no_sequences(rollout.config, objects)
    # Without the target's slot, the last.
    after = jax.tree.map(lambda a: a[:, : objects.capacity], changes["scene"])
    sequences = nothing.replace(
        actions=jax.tree.map(lambda a, b: b.at[:, 0].set(a), actions, nothing.actions),
        cost=nothing.cost.at[:, 0].set(occludes.total + jnp.where(usable, value, 0.0)),
        value=value,
        after=jax.tree.map(lambda a, b: jnp.where(_rows(usable, a), a, b), after, nothing.after),
    )
    order = jnp.argsort(value, stable=True)
    sequences = jax.tree.map(lambda a: a[order], sequences)
    return Decision(
        action=jax.tree.map(lambda a: a[0, 0], sequences.actions),
        value=sequences.value[0],
        cost=occludes.total,
        predicted_cost=sequences.cost[0, 0],
        predicted=jax.tree.map(lambda a: a[0], sequences.after),
        sequences=sequences,
        refused=jnp.int32(0),
    )


def _rows(which: Bool[Array, " s"], like: Array) -> Bool[Array, "s *ones"]:
    """A mask of rows that broadcasts against an array."""
    return which.reshape(-1, *[1] * (like.ndim - 1))


def most_occluding(config: PlannerConfig | None = None, **slots: Any) -> PlanningPolicy:
    """Moves the object that hides the most possible poses, by any action; see `planner.policies.PolicyFactory`.

    Once the target is found: the object that the most of its grasps hit.

    If no action of the object is possible, the next one in that order is moved. It does not plan ahead and does not
    move a found target: of `config`, the horizon, `move_target` and what is as in J or in the guided draws is ignored.
    """
    plain = dataclasses.replace(
        config or PlannerConfig(),
        horizon=1,
        move_target=False,
        guided_fraction=0.0,
        crowding_weight=0.0,
        unseen_contact_penalty=0.0,
    )
    return search_and_grasp(plain, weigh=occlusion_weights, **slots).replace(plan=plan_by_occlusion)
