"""Evaluate a function only where a mask is true, at fixed shapes.

Most (pose, grasp, object) triples of a scene are far apart, and most objects do not move in an action. `masked_vmap`
compacts the entries that matter and runs over them in blocks, so the work follows their number while every shape stays
static: there is no capacity to overflow. Under `vmap` the rows of the batch are merged before they are compacted, so
that one full scene among a thousand empty ones costs no more than its own entries.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool


def masked_vmap(
    function: Callable[[Any, Any, Array], Any], mask: Bool[Array, " n"], shared: Any, row: Any, block: int = 256
) -> Any:
    """`function(shared, row, i)` for every `i` whose mask is true, zeros (or False) for the others.

    Args:
      function: maps two pytrees and an index to a pytree of arrays. It must not close over traced values.
      mask: which of the `n` indices to evaluate.
      shared: pytree that stays the same under `vmap`. (It may be batched too, but then the batch runs one by one.)
      row: pytree that differs along a batch.
      block: how many indices are evaluated at once; changes the speed, never a result.

    Returns:
      The function's results with a leading axis `n`.
    """
    rows = jax.tree.map(lambda a: a[None], row)
    # Jitted, it is traced once for all the places below that use it; most of the time of tracing a plan went there.
    evaluate = jax.jit(jax.vmap(function, in_axes=(None, 0, 0)))
    return jax.tree.map(lambda a: a[0], _masked(evaluate, block)(mask[None], shared, rows))


def _masked(evaluate, block):
    @custom_vmap
    def apply(mask, shared, rows):
        shape, total = mask.shape, mask.size
        size = min(block, total)
        slots = math.ceil(total / size) * size
        order = jnp.nonzero(mask.reshape(-1), size=slots, fill_value=total)[0].astype(jnp.int32)

        def block_of(index):
            row = jax.tree.map(lambda a: a.at[index // shape[1]].get(mode="clip"), rows)
            return evaluate(shared, row, index % shape[1])

        result = jax.eval_shape(block_of, jax.ShapeDtypeStruct((size,), jnp.int32))
        result = jax.tree.map(lambda s: jnp.zeros((total, *s.shape[1:]), s.dtype), result)

        def body(i, result):
            index = jax.lax.dynamic_slice(order, (i * size,), (size,))
            return jax.tree.map(lambda r, v: r.at[index].set(v, mode="drop"), result, block_of(index))

        blocks = (jnp.sum(mask, dtype=jnp.int32) + (size - 1)) // size
        result = jax.lax.fori_loop(0, blocks, body, result)
        return jax.tree.map(lambda r: r.reshape(*shape, *r.shape[1:]), result)

    @apply.def_vmap
    def merge(axis_size, in_batched, mask, shared, rows):
        mask_batched, shared_batched, rows_batched = in_batched

        def spread(a, batched):
            return a if batched else jnp.broadcast_to(a, (axis_size, *a.shape))

        mask, rows = spread(mask, mask_batched), jax.tree.map(spread, rows, rows_batched)
        if any(jax.tree.leaves(shared_batched)):
            result = jax.lax.map(lambda one: apply(*one), (mask, jax.tree.map(spread, shared, shared_batched), rows))
        else:
            flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), (mask, rows))
            result = apply(flat[0], shared, flat[1])
            result = jax.tree.map(lambda r: r.reshape(axis_size, -1, *r.shape[1:]), result)
        return result, jax.tree.map(lambda _: True, result)

    return apply
