"""Evaluate a function only where a mask is true, at fixed shapes.

Most (pose, grasp, object) triples of a scene are far apart, and most objects do not move in an action. `masked_vmap`
compacts the entries that matter and runs over them in blocks, so the work follows their number while every shape stays
static: there is no capacity to overflow. Under `vmap` the batch is merged into the entries before they are compacted, so
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
    function: Callable[[Any, Any], Any], mask: Bool[Array, " n"], constants: Any, arguments: Any, block: int = 256
) -> Any:
    """`function(constants, entry)` for every entry whose mask is true, zeros (or False) for the others.

    Args:
      function: maps `constants` and one entry to a pytree of arrays. It must not close over traced values.
      mask: which of the `n` entries to evaluate.
      constants: pytree shared by all entries.
      arguments: pytree of arrays with leading axis `n`.
      block: how many entries are evaluated at once; changes the speed, never a result.

    Returns:
      The function's results with a leading axis `n`.
    """
    return _masked(function, block)(mask, constants, arguments)


def _masked(function, block):
    @custom_vmap
    def apply(mask, constants, arguments):
        n = mask.shape[0]
        size = min(block, n)
        slots = math.ceil(n / size) * size
        order = jnp.nonzero(mask, size=slots, fill_value=n)[0]
        entry = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), arguments)
        shape = jax.eval_shape(function, constants, entry)
        result = jax.tree.map(lambda s: jnp.zeros((n, *s.shape), s.dtype), shape)

        def body(i, result):
            index = jax.lax.dynamic_slice(order, (i * size,), (size,))
            entries = jax.tree.map(lambda a: a.at[index].get(mode="clip"), arguments)
            values = jax.vmap(function, in_axes=(None, 0))(constants, entries)
            return jax.tree.map(lambda r, v: r.at[index].set(v, mode="drop"), result, values)

        blocks = (jnp.sum(mask, dtype=jnp.int32) + (size - 1)) // size
        return jax.lax.fori_loop(0, blocks, body, result)

    @apply.def_vmap
    def merge(axis_size, in_batched, mask, constants, arguments):
        mask_batched, constants_batched, arguments_batched = in_batched
        if any(jax.tree.leaves(constants_batched)):
            spread = lambda batched, a: a if batched else jnp.broadcast_to(a, (axis_size, *a.shape))  # noqa: E731
            everything = jax.tree.map(spread, tuple(in_batched), (mask, constants, arguments))
            result = jax.lax.map(lambda row: apply(*row), everything)
        else:
            spread = lambda batched, a: (  # noqa: E731
                a if batched else jnp.broadcast_to(a, (axis_size, *a.shape))
            ).reshape(-1, *a.shape[1 + batched :])
            flat = jax.tree.map(spread, arguments_batched, arguments)
            result = apply(spread(mask_batched, mask), constants, flat)
            result = jax.tree.map(lambda a: a.reshape(axis_size, -1, *a.shape[1:]), result)
        return result, jax.tree.map(lambda _: True, result)

    return apply
