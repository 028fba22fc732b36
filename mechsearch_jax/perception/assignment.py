"""The assignment problem, exactly and without a data-dependent loop.

The Hungarian method (H. W. Kuhn, 1955) needs fewest operations, but the number of its iterations depends on the data:
for a batch on a GPU it takes thousands of sequential kernel launches. For a few rows, dynamic programming over all
subsets of columns is feasible, as by R. Bellman and by M. Held and R. Karp for the travelling salesman (both 1962): the
cheapest assignment of the first k rows to a subset of k columns follows from those of k - 1 rows. It takes n steps, the
same for every problem of a batch.
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
    """The column of each row, each column once, with the least sum of costs in float32.

    Of equal sums it deterministically chooses an unspecified one.

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
    # Subtract each row's constant part, for precision.
    cost = cost - jnp.min(cost, axis=1, keepdims=True)

    def give(total, row):
        through = jnp.where(within, total[without] + row[None], jnp.inf)
        return jnp.min(through, axis=1), jnp.argmin(through, axis=1).astype(jnp.int32)

    def take(subset, last):
        return subset ^ (1 << last[subset]), last[subset]

    # After k rows, only subsets of k columns are meaningful, and only these are reached backwards from the full set.
    _, last = jax.lax.scan(give, jnp.zeros(2**size, cost.dtype), cost)
    return jax.lax.scan(take, jnp.int32(2**size - 1), last, reverse=True)[1]
