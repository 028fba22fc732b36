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

# A GPU needs that many times as large blocks to be busy; beyond that its memory is the limit.
GPU_BLOCKS = 64


class Row:
    """An array's part that belongs to one element of a batch. What is taken from it is all that is ever read.

    It stands for the array without its batch axes: `row[k, 2]` and `row[...]` do what they would do there.
    """

    __slots__ = ("_array", "_index")

    def __init__(self, array: Array, index: tuple[Array, ...]):
        # An array that does not vary along an axis of the batch has a length of 1 there.
        self._array = array
        self._index = tuple(jnp.zeros_like(i) if n == 1 else i for i, n in zip(index, array.shape, strict=False))

    def __getitem__(self, key: Any) -> Array:
        return self._array[(*self._index, *(key if isinstance(key, tuple) else (key,)))]


def masked_vmap(
    function: Callable[[Any, Any, Array], Any], mask: Bool[Array, " n"], shared: Any, row: Any, block: int = 256
) -> Any:
    """`function(shared, row, i)` for every `i` whose mask is true, zeros (or False) for the others.

    Args:
      function: maps two pytrees and an index to a pytree of arrays. It must not close over traced values. The leaves
        of its second argument are `Row`s: index them to get arrays.
      mask: which of the `n` indices to evaluate.
      shared: pytree that stays the same under `vmap`. (It may be batched too, but then the batch runs one by one.)
      row: pytree that differs along a batch.
      block: how many indices are evaluated at once on a CPU; changes the speed, never a result.

    Returns:
      The function's results with a leading axis `n`.
    """
    size = block if jax.default_backend() == "cpu" else block * GPU_BLOCKS

    def evaluate(shared, rows, batch, entries):
        """Results for entries, each with the index of its row along every axis of the batch."""

        def one(batch, entry):
            return function(shared, jax.tree.map(lambda a: Row(a, batch), rows), entry)

        return jax.vmap(one)(batch, entries)

    # Jitted, it is traced once for all the places below that use it; most of the time of tracing a plan went there.
    return _masked(jax.jit(evaluate), size, 0)(mask, shared, row)


def _masked(evaluate, block, levels):
    """`masked_vmap` with so many axes of a batch in front of the mask and of the rows."""

    @custom_vmap
    def apply(mask, shared, rows):
        batch, n = mask.shape[:levels], mask.shape[levels]
        total, size = mask.size, min(block, mask.size)
        slots = math.ceil(total / size) * size
        order = jnp.nonzero(mask.reshape(-1), size=slots, fill_value=total)[0].astype(jnp.int32)

        def block_of(index):
            inside = jnp.minimum(index, total - 1)
            where = jnp.unravel_index(inside // n, batch) if levels else ()
            return evaluate(shared, rows, where, inside % n)

        result = jax.eval_shape(block_of, jax.ShapeDtypeStruct((size,), jnp.int32))
        result = jax.tree.map(lambda s: jnp.zeros((total, *s.shape[1:]), s.dtype), result)

        def body(i, result):
            index = jax.lax.dynamic_slice(order, (i * size,), (size,))
            return jax.tree.map(lambda r, v: r.at[index].set(v, mode="drop"), result, block_of(index))

        blocks = (jnp.sum(mask, dtype=jnp.int32) + (size - 1)) // size
        result = jax.lax.fori_loop(0, blocks, body, result)
        return jax.tree.map(lambda r: r.reshape(*mask.shape, *r.shape[1:]), result)

    @apply.def_vmap
    def merge(axis_size, in_batched, mask, shared, rows):
        mask_batched, shared_batched, rows_batched = in_batched
        mask = mask if mask_batched else jnp.broadcast_to(mask, (axis_size, *mask.shape))
        if any(jax.tree.leaves(shared_batched)):

            def spread(a, batched):
                return a if batched else jnp.broadcast_to(a, (axis_size, *a.shape))

            shared, rows = (
                jax.tree.map(spread, tree, batched)
                for tree, batched in ((shared, shared_batched), (rows, rows_batched))
            )
            result = jax.lax.map(lambda one: apply(*one), (mask, shared, rows))
        else:
            rows = jax.tree.map(lambda a, batched: a if batched else a[None], rows, rows_batched)
            result = _masked(evaluate, block, levels + 1)(mask, shared, rows)
        return result, jax.tree.map(lambda _: True, result)

    return apply
