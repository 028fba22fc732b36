"""Evaluate a function only where a mask is true, at fixed shapes.

Most (pose, grasp, object) triples of a scene are far apart, and most objects do not move in an action. These functions
compact the entries whose mask is true and run over them in blocks, so the work is proportional to their number while
every shape stays static, without a capacity that could overflow. Under `vmap` the rows of the batch are merged before
they are compacted, so that one full scene among a thousand empty ones costs no more than its own entries.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Integer

# Blocks on a GPU are larger by this factor, to keep it busy. With eight times as much, a single decision fits one block
# and takes a third longer: evaluating masked entries then costs more than skipping them.
GPU_BLOCKS = 64
# With more than `MANY` entries, as in a batch, blocks are up to `LARGER` times as large again: masked entries cost
# little then, compared with the hundreds of rounds of smaller blocks.
MANY, LARGER = 2**22, 4
# Indices are 32 bits wide.
LARGEST_INDEX = 2**31 - 1
# Entries of a mask that are counted together, as the bits of a word, before the true ones among them are located.
WIDTH = 32
# Blocks whose entries a CPU locates at once.
LOCATED = 16

Carry = TypeVar("Carry")


class Entry(NamedTuple):
    """Indices into arrays with leading batch axes.

    Attributes:
      batch: sizes of the axes.
      axes: the index along each of them.
    """

    batch: tuple[int, ...]
    axes: tuple[Array, ...]

    def of(self, array: Array, *within: tuple[Array, int]) -> Array:
        """The parts of an array at these indices; an array that does not vary along an axis has a length of 1 there.

        Args:
          array: its leading axes are those of the batch, then those of `within`.
          within: indices along further axes, and their sizes.
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
    """`array[index]` for indices that must be in range, which saves the operations that handle others."""
    numbers = jax.lax.GatherDimensionNumbers(tuple(range(1, array.ndim)), (0,), (0,))
    sizes = (1, *array.shape[1:])
    return jax.lax.gather(array, index[:, None], numbers, sizes, mode=jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def put(array: Array, index: Integer[Array, " k"], values: Array) -> Array:
    """The array with rows replaced; indices beyond its end are ignored."""
    numbers = jax.lax.ScatterDimensionNumbers(tuple(range(1, array.ndim)), (0,), (0,))
    mode = jax.lax.GatherScatterMode.FILL_OR_DROP
    return jax.lax.scatter(array, index[:, None], values, numbers, mode=mode)


def entry_of(index: Integer[Array, " k"], batch: tuple[int, ...], inner: int) -> Entry:
    """The batch indices of flat indices, where each element of the batch has `inner` entries."""
    axes: list[Array] = []
    rest = jax.lax.div(index, jnp.uint32(inner)) if batch else index
    for place, size in reversed(list(enumerate(batch))):
        axes.insert(0, jax.lax.rem(rest, jnp.uint32(size)) if place else rest)
        rest = jax.lax.div(rest, jnp.uint32(size)) if place else rest
    return Entry(batch, tuple(axes))


def on_cpu() -> bool:
    """Whether JAX is tracing for a CPU, by its default device, which a program may set."""
    device = jax.default_device.value
    return (device if isinstance(device, str) else device.platform if device else jax.default_backend()) == "cpu"


def block_size(entries: int, total: int = 0) -> int:
    """How many of `total` entries to evaluate at once: `entries` on a CPU, more on a GPU."""
    return entries if on_cpu() else entries * GPU_BLOCKS * min(max(total // MANY, 1), LARGER)


def for_each(mask: Bool[Array, " n"], body: Callable[[Carry, Array, Array], Carry], carry: Carry, block: int) -> Carry:
    """Loop over the indices where a mask is true, in order and a block at a time.

    Args:
      mask: which of the `n` indices to visit.
      body: `body(carry, index, active) -> carry`, with `block` indices; those that are not `active` are `n`. On a GPU
        it may be called with no active index.
      carry: the initial carry.
      block: number of indices at once.
    """
    n = mask.shape[0]
    if n == 0:
        return carry
    if n <= block and not on_cpu():
        # A GPU evaluates the idle entries of a single block faster than it skips them.
        return body(carry, jnp.where(mask, jnp.arange(n, dtype=jnp.uint32), jnp.uint32(n)), mask)
    size, words = min(block, n), math.ceil(n / WIDTH)
    bits = jax.lax.pad(mask, False, ((0, words * WIDTH - n, 0),)).reshape(words, WIDTH)
    word = jnp.sum(bits.astype(jnp.uint32) << jnp.arange(WIDTH, dtype=jnp.uint32)[None], axis=1, dtype=jnp.uint32)
    ends = jax.lax.cumsum(jax.lax.population_count(word))
    total = ends[-1]
    # A CPU, to which each operation is a call, locates the entries of many blocks at once.
    blocks = min(LOCATED, math.ceil(n / size)) if on_cpu() else 1
    # Steps of a bisection over the words.
    halvings = max(words - 1, 1).bit_length()

    def located(first):
        """The next indices, from the `first`-th on."""
        rank = jax.lax.min(first + jnp.arange(blocks * size, dtype=jnp.uint32), total - 1)

        def halve(_, bounds):
            """The last word that begins at or before each rank."""
            low, high = bounds
            middle = jax.lax.shift_right_logical(low + high, jnp.uint32(1))
            later = taken(ends, middle) <= rank
            return jnp.where(later, middle + 1, low), jnp.where(later, high, middle)

        least = jnp.zeros_like(rank)
        which, _ = jax.lax.fori_loop(0, halvings, halve, (least, least + jnp.uint32(words - 1)), unroll=not on_cpu())
        found = taken(word, which)
        before = taken(ends, which) - jax.lax.population_count(found)
        return which * jnp.uint32(WIDTH) + _place(found, rank - before)

    def step(first, index, i, carry):
        begin = i * jnp.uint32(size)
        active = first + begin + jnp.arange(size, dtype=jnp.uint32) < total
        index = jax.lax.dynamic_slice_in_dim(index, begin, size)
        return body(carry, jnp.where(active, index, jnp.uint32(n)), active)

    def steps(i, carry):
        first = i * jnp.uint32(blocks * size)
        index = located(first)
        if blocks == 1:
            return step(first, index, jnp.uint32(0), carry)
        left = jax.lax.min(jnp.uint32(blocks), _ceil_div(total - first, size))
        return jax.lax.fori_loop(jnp.uint32(0), left, functools.partial(step, first, index), carry)

    return jax.lax.fori_loop(jnp.uint32(0), _ceil_div(total, blocks * size), steps, carry)


def _ceil_div(a: Array, b: int) -> Array:
    """Unsigned a / b, rounded up."""
    return jax.lax.div(a + jnp.uint32(b - 1), jnp.uint32(b))


def _place(word: Array, rank: Array) -> Array:
    """The place of the bit of a word before which `rank` others are set."""
    place = jnp.zeros_like(word)
    for half in (16, 8, 4, 2, 1):
        lower = jax.lax.population_count(word & jnp.uint32((1 << half) - 1))
        above = rank >= lower
        word = jnp.where(above, word >> jnp.uint32(half), word)
        rank, place = jnp.where(above, rank - lower, rank), jnp.where(above, place + jnp.uint32(half), place)
    return place


def merged(run: Callable[[Array, Any, Any], Any], indices: float = 1.0) -> Callable[[Array, Any, Any], Any]:
    """A function of a mask (n,), a shared pytree and rows, which is called for a whole batch at once under `vmap`.

    Args:
      run: `run(mask, shared, rows)`, where the mask and the leaves of `rows` may have leading batch axes, with a length
        of 1 where the rows do not vary. Its results have the same leading axes. It must not close over traced values.
      indices: number of indices that `run` needs for each entry of the mask.

    Returns:
      The function. Under `vmap`, if the shared pytree is batched, the elements of the batch run one by one. A batch
      that needs more than 32-bit indices runs in pieces.
    """

    @custom_vmap
    def apply(mask, shared, rows):
        return run(mask, shared, rows)

    @apply.def_vmap
    def merge(axis_size, in_batched, mask, shared, rows):
        mask_batched, shared_batched, rows_batched = in_batched
        mask = mask if mask_batched else jnp.broadcast_to(mask, (axis_size, *mask.shape))
        limit = int(LARGEST_INDEX / max(mask.size // axis_size * indices, 1))
        piece = max((k for k in range(1, axis_size + 1) if axis_size % k == 0 and k <= limit), default=1)

        def spread(a, batched):
            return a if batched else jnp.broadcast_to(a, (axis_size, *jnp.shape(a)))

        if any(jax.tree.leaves(shared_batched)):
            shared, rows = (
                jax.tree.map(spread, tree, batched)
                for tree, batched in ((shared, shared_batched), (rows, rows_batched))
            )
            result = jax.lax.map(lambda element: apply(*element), (mask, shared, rows))
        elif piece < axis_size:
            rows = jax.tree.map(spread, rows, rows_batched)
            result = jax.lax.map(lambda pair: apply(pair[0], shared, pair[1]), (mask, rows), batch_size=piece)
        else:
            rows = jax.tree.map(lambda a, batched: a if batched else a[None], rows, rows_batched)
            result = merged(run, indices)(mask, shared, rows)
        return result, jax.tree.map(lambda _: True, result)

    return apply


def masked_vmap(
    function: Callable[[Any, Any, Any], Any],
    mask: Bool[Array, " n"],
    shared: Any,
    per_element: Any,
    rows: Any,
    block: int = 256,
) -> Any:
    """`function(shared, per_element, row)` for every row whose mask is true, zeros (or False) for the others.

    Args:
      function: maps three pytrees to a pytree of arrays. It must not close over traced values.
      mask: which of the `n` rows to evaluate.
      shared: pytree that is not batched under `vmap`; if it is, the elements of the batch run one by one.
      per_element: pytree that all rows share, but that may differ between the elements of a batch.
      rows: pytree whose leaves have a leading axis `n`.
      block: number of rows evaluated at once on a CPU; changes the speed, never a result.

    Returns:
      The function's results with a leading axis `n`.
    """

    def run(mask, shared, both):
        batch, n, total = mask.shape[:-1], mask.shape[-1], mask.size
        per_element, rows = both
        size = block_size(block, total)
        if total == 0 or (total <= size and not on_cpu()):
            return _everywhere(function, mask, shared, per_element, rows)
        width = jnp.uint32(n)

        # Traced once, for the shape of its results and in the loop.
        @jax.jit
        def evaluate(shared, per_element, rows, index):
            entry = entry_of(index, batch, n)
            row = jax.tree.map(lambda a: entry.of(a, (jax.lax.rem(index, width), n)), rows)
            element = jax.tree.map(entry.of, per_element)
            varies = jax.tree.map(lambda a: 0 if any(k > 1 for k in a.shape[: len(batch)]) else None, per_element)
            return jax.vmap(function, (None, varies, 0), axis_size=len(index))(shared, element, row)

        def body(result, index, active):
            values = evaluate(shared, per_element, rows, jax.lax.min(index, jnp.uint32(total - 1)))
            return jax.tree.map(lambda r, v: put(r, index, v), result, values)

        shape = jax.eval_shape(
            evaluate, shared, per_element, rows, jax.ShapeDtypeStruct((min(size, total),), jnp.uint32)
        )
        result = jax.tree.map(lambda s: jnp.zeros((total, *s.shape[1:]), s.dtype), shape)
        result = for_each(mask.reshape(-1), body, result, size)
        return jax.tree.map(lambda r: r.reshape(*mask.shape, *r.shape[1:]), result)

    return merged(run)(mask, shared, (per_element, rows))


def _everywhere(function, mask, shared, per_element, rows):
    """`masked_vmap` that evaluates every row."""
    batch = mask.shape[:-1]
    evaluate = jax.vmap(function, (None, None, 0), axis_size=mask.shape[-1])
    for k in reversed(range(len(batch))):
        element_axes, row_axes = (
            jax.tree.map(lambda a, k=k: 0 if a.shape[k] > 1 else None, tree) for tree in (per_element, rows)
        )
        evaluate = jax.vmap(evaluate, (None, element_axes, row_axes), axis_size=batch[k])
    squeezed = (
        jax.tree.map(lambda a: a.reshape([k for k in a.shape[: len(batch)] if k > 1] + [*a.shape[len(batch) :]]), tree)
        for tree in (per_element, rows)
    )
    values = evaluate(shared, *squeezed)

    def masked(v):
        return jnp.where(mask.reshape(*mask.shape, *[1] * (v.ndim - mask.ndim)), v, jnp.zeros_like(v))

    return jax.tree.map(masked, values)
