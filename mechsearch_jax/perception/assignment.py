"""The assignment problem, exactly and without a data-dependent loop.

The Hungarian method (H. W. Kuhn, 1955) needs fewest operations, but its nested loops end when the data say so: over a
batch on a GPU they are thousands of launches that wait for each other. For a few rows there are few enough subsets of
columns to go through them all, as R. Bellman and M. Held and R. Karp did for the travelling salesman (both 1962): the
cheapest way to give the first k rows the k columns of a subset follows from those of k - 1 rows. That takes n steps,
each the same for every problem of a batch.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mechsearch_jax.runtime.errors import InputError

# The work grows as n^2 2^n.
_MOST = 10


def assign(cost: Float[Array, "n n"]) -> Int[Array, " n"]:
    """Which column each row gets, each column once, so that the sum of the costs is smallest.

    Among equal sums it is the same one each time, but which is not specified. Sums are those of float32.

    Args:
      cost: of each row (first axis) with each column; finite.

    Raises:
      InputError: there is no row, or more than ten.
    """
    size = cost.shape[0]
    if not 1 <= size <= _MOST:
        raise InputError(f"assign: {size} rows; up to {_MOST} it can, optax.assignment.hungarian_algorithm more")
    # A subset is a number whose bits are its columns.
    subsets, columns = np.arange(2**size)[:, None], np.arange(size)[None]
    within = (subsets >> columns & 1).astype(bool)
    without = subsets ^ (1 << columns)
    # What a row costs whatever it gets is left out: the digits of the sums are kept for what differs.
    cost = cost - jnp.min(cost, axis=1, keepdims=True)

    def give(total, row):
        through = jnp.where(within, total[without] + row[None], jnp.inf)
        return jnp.min(through, axis=1), jnp.argmin(through, axis=1).astype(jnp.int32)

    def take(subset, last):
        return subset ^ (1 << last[subset]), last[subset]

    # Only subsets of as many columns as there are rows so far mean anything, and only they are reached from the whole.
    _, last = jax.lax.scan(give, jnp.zeros(2**size, cost.dtype), cost)
    return jax.lax.scan(take, jnp.int32(2**size - 1), last, reverse=True)[1]
