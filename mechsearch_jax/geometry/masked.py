"""Evaluate a function only where a mask is true, at fixed shapes.

Most (pose, grasp, object) triples of a scene are far apart, and most objects do not move in an action. What is here
compacts the entries that matter and runs over them in blocks, so the work follows their number while every shape stays
static: there is no capacity to overflow. Under `vmap` the rows of the batch are merged before they are compacted, so
that one full scene among a thousand empty ones costs no more than its own entries.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Integer

# A GPU needs that many times as large blocks to be busy. With eight times as many, so that a single decision has no
# block but the first, it takes a third longer: what is masked then costs more than looking for what is not.
GPU_BLOCKS = 64
# Where there are so many entries, as in a batch, up to so many times as many again: what is masked costs little then,
# beside the hundreds of rounds that smaller blocks take.
MANY, LARGER = 2**22, 4
# Indices are 32 bits wide.
LARGEST_INDEX = 2**31 - 1
# How many entries of a mask are counted together before those that are true are looked for among them.
WIDTH = 64

Carry = TypeVar("Carry")


class Entry(NamedTuple):
    """Places in what has the axes of a batch in front, each given by one number.

    Attributes:
      batch: sizes of the axes.
      axes: where along each of them.
    """

    batch: tuple[int, ...]
    axes: tuple[Array, ...]

    def of(self, array: Array, *within: tuple[Array, int]) -> Array:
        """The parts of an array that belong to the entries; one that does not vary along an axis has a length of 1.

        Args:
          array: with the axes of the batch in front, and after them those of `within`.
          within: where along further axes, and their sizes.
        """
        lead = len(self.batch)
        axes = [*((i, n) for i, n in zip(self.axes, array.shape[:lead], strict=True) if n > 1), *within]
        flat = array.reshape(-1, *array.shape[lead + len(within) :])
        if not axes:
            return flat[0]
        index, _ = axes[0]
        for more, size in axes[1:]:
            index = index * jnp.uint32(size) + more
        return taken(flat, index)


def taken(array: Array, index: Integer[Array, " k"]) -> Array:
    """Rows of an array; `array[index]` for indices that are known to be in range, which needs many operations less."""
    numbers = jax.lax.GatherDimensionNumbers(tuple(range(1, array.ndim)), (0,), (0,))
    sizes = (1, *array.shape[1:])
    return jax.lax.gather(array, index[:, None], numbers, sizes, mode=jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def put(array: Array, index: Integer[Array, " k"], values: Array) -> Array:
    """The array with other rows; those beyond its end are left out."""
    numbers = jax.lax.ScatterDimensionNumbers(tuple(range(1, array.ndim)), (0,), (0,))
    mode = jax.lax.GatherScatterMode.FILL_OR_DROP
    return jax.lax.scatter(array, index[:, None], values, numbers, mode=mode)


def entry_of(index: Integer[Array, " k"], batch: tuple[int, ...], inner: int) -> Entry:
    """The batch's part of indices into all entries, of which each element of the batch has `inner`."""
    axes: list[Array] = []
    rest = jax.lax.div(index, jnp.uint32(inner)) if batch else index
    for place, size in reversed(list(enumerate(batch))):
        axes.insert(0, jax.lax.rem(rest, jnp.uint32(size)) if place else rest)
        rest = jax.lax.div(rest, jnp.uint32(size)) if place else rest
    return Entry(batch, tuple(axes))


def on_cpu() -> bool:
    """Whether what is being traced is meant for a CPU, going by the default device, which a program may set."""
    device = jax.default_device.value
    return (device if isinstance(device, str) else device.platform if device else jax.default_backend()) == "cpu"


def block_size(entries: int, total: int = 0) -> int:
    """How many of `total` entries to evaluate at once where a CPU would be given `entries`."""
    return entries if on_cpu() else entries * GPU_BLOCKS * min(max(total // MANY, 1), LARGER)


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
    if n == 0:
        return carry
    if n <= block and not on_cpu():
        # A GPU evaluates the idle entries of a single block faster than it finds out whether there is anything to do.
        return body(carry, jnp.where(mask, jnp.arange(n, dtype=jnp.uint32), jnp.uint32(n)), mask)
    size, rows = min(block, n), math.ceil(n / WIDTH)
    bits = jax.lax.pad(mask.astype(jnp.uint8), jnp.uint8(0), ((0, rows * WIDTH - n, 0),)).reshape(rows, WIDTH)
    ends = jax.lax.cumsum(jnp.sum(bits, axis=1, dtype=jnp.uint32))
    starts = jax.lax.pad(ends, jnp.uint32(0), ((1, -1, 0),))
    total = ends[-1]
    # How often a range of rows is halved until one is left.
    halvings = max(rows - 1, 1).bit_length()

    def step(i, carry):
        rank = i * jnp.uint32(size) + jnp.arange(size, dtype=jnp.uint32)
        active = rank < total
        rank = jax.lax.min(rank, total - 1)

        def halve(_, bounds):
            """The last row that begins at or before each rank."""
            low, high = bounds
            middle = jax.lax.shift_right_logical(low + high, jnp.uint32(1))
            later = taken(ends, middle) <= rank
            return jnp.where(later, middle + 1, low), jnp.where(later, high, middle)

        first = jnp.zeros_like(rank)
        row, _ = jax.lax.fori_loop(0, halvings, halve, (first, first + jnp.uint32(rows - 1)), unroll=not on_cpu())
        before = jax.lax.cumsum(taken(bits, row), axis=1)
        column = jax.lax.argmax(before > (rank - taken(starts, row)).astype(jnp.uint8)[:, None], 1, jnp.uint32)
        return body(carry, jnp.where(active, row * jnp.uint32(WIDTH) + column, jnp.uint32(n)), active)

    blocks = jax.lax.div(total + jnp.uint32(size - 1), jnp.uint32(size))
    return jax.lax.fori_loop(jnp.uint32(0), blocks, step, carry)


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
    function: Callable[[Any, Any, Any], Any],
    mask: Bool[Array, " n"],
    shared: Any,
    own: Any,
    rows: Any,
    block: int = 256,
) -> Any:
    """`function(shared, own, row)` for every row whose mask is true, zeros (or False) for the others.

    Args:
      function: maps three pytrees to a pytree of arrays. It must not close over traced values.
      mask: which of the `n` rows to evaluate.
      shared: pytree that stays the same under `vmap`. (It may be batched too, but then the batch runs one by one.)
      own: pytree of what all rows share, but the elements of a batch do not.
      rows: pytree whose leaves have a leading axis `n`.
      block: how many rows are evaluated at once on a CPU; changes the speed, never a result.

    Returns:
      The function's results with a leading axis `n`.
    """

    def run(mask, shared, both):
        batch, n, total = mask.shape[:-1], mask.shape[-1], mask.size
        own, rows = both
        size = block_size(block, total)
        if total <= size and not on_cpu():
            return _everywhere(function, mask, shared, own, rows)
        width = jnp.uint32(n)

        def evaluate(shared, own, rows, index):
            entry = entry_of(index, batch, n)
            row = jax.tree.map(lambda a: entry.of(a, (jax.lax.rem(index, width), n)), rows)
            apart = jax.tree.map(entry.of, own)
            varies = jax.tree.map(lambda a: 0 if any(k > 1 for k in a.shape[: len(batch)]) else None, own)
            return jax.vmap(function, (None, varies, 0), axis_size=len(index))(shared, apart, row)

        def body(result, index, active):
            values = evaluate(shared, own, rows, jax.lax.min(index, jnp.uint32(total - 1)))
            return jax.tree.map(lambda r, v: put(r, index, v), result, values)

        shape = jax.eval_shape(evaluate, shared, own, rows, jax.ShapeDtypeStruct((1,), jnp.uint32))
        result = jax.tree.map(lambda s: jnp.zeros((total, *s.shape[1:]), s.dtype), shape)
        result = for_each(mask.reshape(-1), body, result, size)
        return jax.tree.map(lambda r: r.reshape(*mask.shape, *r.shape[1:]), result)

    return merged(run)(mask, shared, (own, rows))


def _everywhere(function, mask, shared, own, rows):
    """`masked_vmap` without looking for what is masked."""
    batch = mask.shape[:-1]
    evaluate = jax.vmap(function, (None, None, 0), axis_size=mask.shape[-1])
    for k in reversed(range(len(batch))):
        own_axes, row_axes = (jax.tree.map(lambda a, k=k: 0 if a.shape[k] > 1 else None, tree) for tree in (own, rows))
        evaluate = jax.vmap(evaluate, (None, own_axes, row_axes), axis_size=batch[k])
    squeezed = (
        jax.tree.map(lambda a: a.reshape([k for k in a.shape[: len(batch)] if k > 1] + [*a.shape[len(batch) :]]), tree)
        for tree in (own, rows)
    )
    values = evaluate(shared, *squeezed)

    def masked(v):
        return jnp.where(mask.reshape(*mask.shape, *[1] * (v.ndim - mask.ndim)), v, jnp.zeros_like(v))

    return jax.tree.map(masked, values)
