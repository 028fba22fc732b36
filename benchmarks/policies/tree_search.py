"""Monte-Carlo tree search over predicted states, `mechsearch_jax.benchmarks.policies.tree_search:mctx`, which plans
with the engine's slots.

The search is DeepMind's `mctx` (https://github.com/google-deepmind/mctx), with its Gumbel MuZero policy and the
planner's model. A node is a predicted state; its discrete actions are samples, each drawn and predicted when it is
first tried. The reward of an action is the decrease of J; a leaf has value 0.
"""

from __future__ import annotations

import functools
import math
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.actions.types import Action
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner import PlannerConfig, PlanningPolicy, search_for_grasp
from mechsearch_jax.planner.rollout import Rollout, no_sequences
from mechsearch_jax.planner.state import Decision, State
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode


class Node(PyTreeNode):
    """A node of the tree.

    Attributes:
      state: the predicted state, up to date.
      key: data of the PRNG key with which its actions are drawn.
      depth: number of actions before the node, int32.
      cost: J of the state.
      action: the action that led to the node; of kind NONE if it is impossible, and at the root.
      penalty: penalty of that action, in units of J.
    """

    state: State
    key: jax.Array
    depth: jax.Array
    cost: jax.Array
    action: Action
    penalty: jax.Array


def import_mctx() -> ModuleType:
    """Import the library `mctx`.

    Raises:
      InputError: it is not installed.
    """
    try:
        import mctx
    except ImportError as error:
        raise InputError(
            f"policy mctx needs the library mctx ({error}); install it with: pip install 'mechsearch-jax[mctx]'"
        ) from error
    return mctx


def _step(rollout: Rollout, key: Array, index: Array, node: Node) -> Node:
    """The node that the action of an index leads to; an index always means the same action."""
    draw = jax.random.fold_in(jax.random.wrap_key_data(node.key), index)
    branches = (functools.partial(rollout.act, first) for first in (True, False))
    changes, action, penalty = jax.lax.cond(node.depth == 0, *branches, node.state, draw)
    state = rollout.up_to_date(node.state.replace(**changes))
    return Node(
        state=state,
        key=jax.random.key_data(key),
        depth=node.depth + 1,
        cost=rollout.cost(state),
        action=action,
        penalty=jnp.sum(penalty) * node.cost,
    )


def width(config: PlannerConfig) -> int:
    """Number of actions of a node: the square root of the number of predictions, so that each may be tried repeatedly.

    With as many as sequences, each would be tried once, and the search would look one action ahead.
    """
    return min(config.sequences, max(math.isqrt(config.sequences * config.horizon), 2))


def tree_plan(rollout: Rollout, key: Array, objects: Superquadrics) -> Decision:
    """Decide on the next action by tree search; a `policies.Plan`.

    It predicts as many actions as sampling does, sequences times horizon; see `width`.

    Args:
      rollout: problem, belief and slots.
      key: PRNG key of the planner.
      objects: the recognised objects, fields (N, ...).

    Returns:
      The decision. Its sequences are the root's actions, best first, with the values of their subtrees.

    Raises:
      InputError: `mctx` is not installed.
    """
    mctx, config = import_mctx(), rollout.config
    key_root, key_search = jax.random.split(key)
    state = rollout.up_to_date(rollout.root(objects))
    cost = rollout.cost(state)
    begin = Node(state, jax.random.key_data(key_root), jnp.int32(0), cost, no_action(), jnp.float32(0.0))
    # `mctx` expects a batch axis, here of length 1.
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
    return _decision(rollout, begin, result, objects)


def _decision(rollout: Rollout, begin: Node, result: Any, objects: Superquadrics) -> Decision:
    """The decision of a search; an impossible action is never chosen."""
    tree, config = result.search_tree, rollout.config
    child = tree.children_index[0, tree.ROOT_INDEX]
    children = functools.partial(jax.tree.map, lambda a: a[0, jnp.maximum(child, 0)])
    node = tree.embeddings
    actions, cost, slots = children(node.action), children(node.cost), objects.capacity
    scenes = children(node.state.scene)
    acted = (child >= 0) & (actions.kind != ActionKind.NONE)
    value = jnp.where(acted, -tree.qvalues(jnp.full(1, tree.ROOT_INDEX))[0], jnp.inf)
    actions = actions.replace(kind=jnp.where(acted, actions.kind, ActionKind.NONE).astype(jnp.int32))
    # The action that the search selects comes first, whatever its value.
    selected = (jnp.arange(width(config)) == result.action[0]) & acted
    order = jnp.argsort(jnp.where(selected, -jnp.inf, value), stable=True)
    actions, cost, value, scenes = jax.tree.map(lambda a: a[order], (actions, cost, value, scenes))

    # In the shapes of sampled sequences: one action each, and fewer of them.
    present = jax.tree.map(lambda a: a[:slots], begin.state.scene)
    nothing, count = no_sequences(config, present), width(config)
    sequences = nothing.replace(
        actions=jax.tree.map(lambda a, b: b.at[:count, 0].set(a), actions, nothing.actions),
        cost=nothing.cost.at[:count, 0].set(cost),
        value=nothing.value.at[:count].set(value),
        # Without the target's slot, the last.
        after=jax.tree.map(lambda a, b: b.at[:count].set(a[:, :slots]), scenes, nothing.after),
    )
    able = jnp.isfinite(value[0])
    return Decision(
        action=jax.tree.map(lambda a: a[0], actions),
        value=value[0],
        cost=begin.cost,
        predicted_cost=jnp.where(able, cost[0], begin.cost),
        predicted=jax.tree.map(lambda a, b: jnp.where(able, a[0, :slots], b), scenes, present),
        sequences=sequences,
        refused=jnp.int32(0),
    )


def mctx(config: PlannerConfig | None = None, **slots: Any) -> PlanningPolicy:
    """Tree search on the cost of `search_for_grasp`; see `planner.policies.PolicyFactory`.

    Raises:
      InputError: the library `mctx` is not installed.
    """
    import_mctx()
    return search_for_grasp(config, **slots).replace(plan=tree_plan)
