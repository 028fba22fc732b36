"""Monte-Carlo tree search over predicted states: another way to plan with the engine's slots, to compare with.

The search is DeepMind's `mctx` (https://github.com/google-deepmind/mctx), with its Gumbel MuZero policy and the model
that the planner has. A node is a predicted state; its discrete actions are so many that are sampled there, each drawn
and predicted when it is first tried. What an action takes off J is its reward, and no more is expected of a leaf.
"""

from __future__ import annotations

import functools
import math
from types import ModuleType
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array

from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.actions.types import Action
from mechsearch_jax.config.config import PlannerConfig
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner.rollout import Rollout, no_sequences
from mechsearch_jax.planner.state import Decision, State
from mechsearch_jax.runtime.errors import InputError


class Node(flax.struct.PyTreeNode):
    """A node of the tree.

    Attributes:
      state: as it is predicted, up to date.
      key: data of the PRNG key that its actions are drawn with.
      depth: number of actions before it, int32.
      cost: its J.
      action: that led to it; of kind NONE where that is impossible, and at the root.
      penalty: of that action, in units of J.
    """

    state: State
    key: jax.Array
    depth: jax.Array
    cost: jax.Array
    action: Action
    penalty: jax.Array


def import_mctx() -> ModuleType:
    """The library, which is not always installed.

    Raises:
      InputError: it is not.
    """
    try:
        import mctx
    except ImportError as error:
        raise InputError(
            f"policy mctx needs the library mctx ({error}); install it with: pip install 'mechsearch-jax[mctx]'"
        ) from error
    return mctx


def _up_to_date(rollout: Rollout, state: State) -> State:
    """A state with its f, g and actions, after `state.moved` moved."""
    state = rollout.update(state, state.moved)
    return state.replace(candidates=rollout.candidates(state, state.moved))


def _step(rollout: Rollout, key: Array, index: Array, node: Node) -> Node:
    """What the action of an index leads to; the same index means the same action whenever it is tried."""
    draw = jax.random.fold_in(jax.random.wrap_key_data(node.key), index)
    changes, action, penalty = rollout.act(node.depth == 0, node.state, draw)
    state = _up_to_date(rollout, node.state.replace(**changes))
    return Node(
        state=state,
        key=jax.random.key_data(key),
        depth=node.depth + 1,
        cost=rollout.cost(state),
        action=action,
        penalty=penalty * node.cost,
    )


def width(config: PlannerConfig) -> int:
    """How many actions a node has: the root of how many are predicted in all, so that each may be tried some times.

    With as many as there are sequences each would be tried once, and the search would look one action ahead.
    """
    return min(config.sequences, max(math.isqrt(config.sequences * config.horizon), 2))


def tree_plan(rollout: Rollout, key: Array, objects: Superquadrics) -> Decision:
    """Decide on the next action by tree search; a `policies.Plan`.

    As many actions are predicted in all as sampling has to predict, sequences times horizon; see `width`.

    Args:
      rollout: what is known, and how states lead to states.
      key: PRNG key of the planner.
      objects: as recognised, fields (N, ...).

    Returns:
      The decision. Its sequences are the actions that were tried first, best first, each with what its subtree came to.

    Raises:
      InputError: `mctx` is not installed.
    """
    mctx, config = import_mctx(), rollout.config
    key_root, key_search = jax.random.split(key)
    state = _up_to_date(rollout, rollout.root(objects))
    cost = rollout.cost(state)
    begin = Node(state, jax.random.key_data(key_root), jnp.int32(0), cost, no_action(), jnp.float32(0.0))
    # What `mctx` sees has an axis for a batch, here of one.
    logits = jnp.zeros((1, width(config)))

    def expand(_: Any, key: Array, index: Array, batch: Node):
        node = jax.tree.map(lambda a: a[0], batch)
        after = _step(rollout, key, index[0], node)
        acted = after.action.kind != ActionKind.NONE
        output = mctx.RecurrentFnOutput(
            reward=jnp.where(acted, node.cost - after.cost - after.penalty, 0.0)[None],
            discount=jnp.where(acted, config.gamma, 0.0).astype(jnp.float32)[None],
            prior_logits=logits,
            value=jnp.zeros(1),
        )
        return output, jax.tree.map(lambda a: a[None], after)

    result = mctx.gumbel_muzero_policy(
        params=(),
        rng_key=key_search,
        root=mctx.RootFnOutput(
            prior_logits=logits, value=jnp.zeros(1), embedding=jax.tree.map(lambda a: a[None], begin)
        ),
        recurrent_fn=expand,
        num_simulations=config.sequences * config.horizon,
        max_depth=config.horizon,
        max_num_considered_actions=width(config),
        gumbel_scale=0.0,
    )
    return _decision(rollout, begin, result, objects.capacity)


def _decision(rollout: Rollout, begin: Node, result: Any, slots: int) -> Decision:
    """What a search came to; an action that turned out impossible is never chosen."""
    tree, config = result.search_tree, rollout.config
    child = tree.children_index[0, tree.ROOT_INDEX]
    tried = functools.partial(jax.tree.map, lambda a: a[0, jnp.maximum(child, 0)])
    node = tree.embeddings
    actions, cost, scenes = tried(node.action), tried(node.cost), tried(node.state.scene)
    acted = (child >= 0) & (actions.kind != ActionKind.NONE)
    value = jnp.where(acted, -tree.qvalues(jnp.full(1, tree.ROOT_INDEX))[0], jnp.inf)
    actions = actions.replace(kind=jnp.where(acted, actions.kind, ActionKind.NONE).astype(jnp.int32))
    # The one that the search trusts comes first, wherever its value stands.
    trusted = (jnp.arange(width(config)) == result.action[0]) & acted
    order = jnp.argsort(jnp.where(trusted, -jnp.inf, value), stable=True)
    actions, cost, value, scenes = jax.tree.map(lambda a: a[order], (actions, cost, value, scenes))

    # In the shapes of sampled sequences: of one action each, and fewer than there could be.
    nothing, count = no_sequences(config, jax.tree.map(lambda a: a[:slots], begin.state.scene)), width(config)
    sequences = nothing.replace(
        actions=jax.tree.map(lambda a, b: b.at[:count, 0].set(a), actions, nothing.actions),
        cost=nothing.cost.at[:count, 0].set(cost),
        value=nothing.value.at[:count].set(value),
        # Without the target's slot, which comes after those of the objects.
        after=jax.tree.map(lambda a, b: b.at[:count].set(a[:, :slots]), scenes, nothing.after),
    )
    able = jnp.isfinite(value[0])
    return Decision(
        action=jax.tree.map(lambda a: a[0], actions),
        value=value[0],
        cost=begin.cost,
        predicted_cost=jnp.where(able, cost[0], begin.cost),
        predicted=jax.tree.map(lambda a, b: jnp.where(able, a[0, :slots], b[:slots]), scenes, begin.state.scene),
        sequences=sequences,
        refused=jnp.int32(0),
    )
