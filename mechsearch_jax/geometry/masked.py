"""Evaluate a function only where a mask is true, at fixed shapes.

Most (pose, grasp, object) triples of a scene are far apart, and most objects do not move in an action. What is here
compacts the entries that matter and runs over them in blocks, so the work follows their number while every shape stays
static: there is no capacity to overflow. Under `vmap` the rows of the batch are merged before they are compacted, so
that one full scene among a thousand empty ones costs no more than its own entries.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool

# A GPU needs that many times as large blocks to be busy; beyond that its memory is the limit.
GPU_BLOCKS = 64
# Indices are 32 bits wide.
LARGEST_INDEX = 2**31 - 1
# How many entries of a mask are counted together before those that are true are looked for among them.
WIDTH = 64

Carry = TypeVar("Carry")


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


def rows_of(rows: Any, index: Array, batch: tuple[int, ...]) -> Any:
    """The `Row`s of a pytree whose leaves have the axes of a batch in front, for an index into the flattened batch."""
    where = jnp.unravel_index(index, batch) if batch else ()
    return jax.tree.map(lambda a: Row(a, where), rows)


def on_cpu() -> bool:
    """Whether what is being traced is meant for a CPU, going by the default device, which a program may set."""
    device = jax.default_device.value
    return (device if isinstance(device, str) else device.platform if device else jax.default_backend()) == "cpu"


def block_size(entries: int) -> int:
    """How many entries to evaluate at once where a CPU would be given so many."""
    return entries if on_cpu() else entries * GPU_BLOCKS


def for_each(mask: Bool[Array, " n"], body: Callable[[Carry, Array, Array], Carry], carry: Carry, block: int) -> Carry:
    """Run over the indices where a mask is true, a block at a time; their order is kept.

    Args:
      mask: which of the `n` indices are meant.
      body: `body(carry, index, active) -> carry`, with `block` indices of which only the `active` are meant; the
        others are `n`. On a GPU it may be called with none that is active.
      carry: what the first block begins with.
      block: how many indices at once.
    """
    n = mask.shape[0]
    if n <= block and not on_cpu():
        # A GPU evaluates the idle entries of a single block faster than it finds out whether there is anything to do.
        return body(carry, jnp.where(mask, jnp.arange(n, dtype=jnp.int32), n), mask)
    size, rows = min(block, n), math.ceil(n / WIDTH)
    bits = jnp.pad(mask, (0, rows * WIDTH - n)).reshape(rows, WIDTH)
    counts = jnp.sum(bits, axis=1, dtype=jnp.int32)
    ends = jnp.cumsum(counts)
    total = ends[-1]

    def step(i, carry):
        rank = i * size + jnp.arange(size, dtype=jnp.int32)
        active = rank < total
        row = jnp.minimum(jnp.searchsorted(ends, rank, side="right", method="scan_unrolled"), rows - 1)
        rank_in_row = rank - (ends[row] - counts[row])
        column = jnp.argmax(jnp.cumsum(bits[row], axis=1, dtype=jnp.int32) > rank_in_row[:, None], axis=1)
        return body(carry, jnp.where(active, row * WIDTH + column, n).astype(jnp.int32), active)

    return jax.lax.fori_loop(0, (total + size - 1) // size, step, carry)


def merged(run: Callable[[Array, Any, Any], Any], indices: int = 1) -> Callable[[Array, Any, Any], Any]:
    """A function of a mask (n,), of what is shared and of rows, which sees a whole batch at once under `vmap`.

    Args:
      run: `run(mask, shared, rows)`, where the mask has the axes of the batch in front, if any, and so have the leaves
        of `rows`, with a length of 1 along those where they do not vary. Its results have the same axes in front. It
        must not close over traced values.
      indices: how many indices `run` needs for each entry of the mask.

    Returns:
      The function. Under `vmap`, what is shared may be batched too, but then the batch runs one by one. A batch with
      more indices than there can be runs in pieces.
    """

    @custom_vmap
    def apply(mask, shared, rows):
        return run(mask, shared, rows)

    @apply.def_vmap
    def merge(axis_size, in_batched, mask, shared, rows):
        mask_batched, shared_batched, rows_batched = in_batched
        mask = mask if mask_batched else jnp.broadcast_to(mask, (axis_size, *mask.shape))
        limit = LARGEST_INDEX // max(mask.size // axis_size * indices, 1)
        piece = max((k for k in range(1, axis_size + 1) if axis_size % k == 0 and k <= limit), default=1)

        def spread(a, batched):
            return a if batched else jnp.broadcast_to(a, (axis_size, *jnp.shape(a)))

        if any(jax.tree.leaves(shared_batched)):
            shared, rows = (
                jax.tree.map(spread, tree, batched)
                for tree, batched in ((shared, shared_batched), (rows, rows_batched))
            )
            result = jax.lax.map(lambda one: apply(*one), (mask, shared, rows))
        elif piece < axis_size:
            rows = jax.tree.map(spread, rows, rows_batched)
            result = jax.lax.map(lambda one: apply(one[0], shared, one[1]), (mask, rows), batch_size=piece)
        else:
            rows = jax.tree.map(lambda a, batched: a if batched else a[None], rows, rows_batched)
            result = merged(run, indices)(mask, shared, rows)
        return result, jax.tree.map(lambda _: True, result)

    return apply


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

    def run(mask, shared, rows):
        batch, n, total = mask.shape[:-1], mask.shape[-1], mask.size

        # Jitted, it is traced once for both of the places below; most of the time of tracing a plan went there.
        @jax.jit
        def evaluate(shared, rows, index):
            return jax.vmap(lambda i: function(shared, rows_of(rows, i // n, batch), i % n))(index)

        def body(result, index, active):
            values = evaluate(shared, rows, jnp.minimum(index, total - 1))
            return jax.tree.map(lambda r, v: r.at[index].set(v, mode="drop"), result, values)

        shape = jax.eval_shape(evaluate, shared, rows, jax.ShapeDtypeStruct((1,), jnp.int32))
        result = jax.tree.map(lambda s: jnp.zeros((total, *s.shape[1:]), s.dtype), shape)
        result = for_each(mask.reshape(-1), body, result, block_size(block))
        return jax.tree.map(lambda r: r.reshape(*mask.shape, *r.shape[1:]), result)

    return merged(run)(mask, shared, row)
