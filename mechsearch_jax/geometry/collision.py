"""Points against superquadrics.

A cloud collides with an object if one of its points is inside it (paper equations 14 to 17). Powers are by far the most
expensive part of that test, and almost never needed: the p-norms of the gauge lie between norms without powers, which
decide every cloud except those that graze the surface.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.masked import block_size, for_each, merged, rows_of


def _transform_cloud(T, cloud):
    """Coordinates of a cloud stored as three rows, after a rigid transform: three arrays of its length."""
    return [sum(T[i, k] * cloud[k] for k in range(3)) + T[i, 3] for i in range(3)]


@jax.jit
def _bounds(cloud, T_object_cloud, size, exponents):
    """Bounds on the least gauge of a cloud's points, with no power evaluated per point."""
    p, r = 2.0 / exponents[1], 2.0 / exponents[0]
    x, y, z = (jnp.abs(q) / size[k] for k, q in enumerate(_transform_cloud(T_object_cloud, cloud)))
    most, two = jnp.maximum(x, y), jnp.sqrt(x * x + y * y)
    below = jnp.where(p > 2.0, most, two)
    above = jnp.where(p >= 2.0, jnp.minimum(two, 2.0 ** (1.0 / p) * most), x + y)
    # The axis and the plane are joined by an r-norm with r >= 1: at least the larger of the two, at most 2^(1/r)
    # times it.
    return jnp.min(jnp.maximum(below, z)), jnp.min(jnp.maximum(above, z)) * 2.0 ** (1.0 / r)


@jax.jit
def _least_gauge(cloud, T_object_cloud, size, exponents):
    points = jnp.stack(_transform_cloud(T_object_cloud, cloud), axis=-1)
    return jnp.min(superquadric.gauge(size[None], exponents[None], points))


class Pair(NamedTuple):
    """A cloud and a superquadric that may collide.

    Attributes:
      cloud: the cloud's coordinates in its own frame, three rows [m].
      T_object_cloud: pose of the cloud in the object's frame.
      size: half-extents of the superquadric [m].
      exponents: its exponents.
    """

    cloud: Array
    T_object_cloud: Array
    size: Array
    exponents: Array


def mark_hits(
    hits: Bool[Array, " m"],
    mask: Bool[Array, " n"],
    pair: Callable[[Array], Pair],
    where: Callable[[Array], Array],
    block: int,
    coarse: int = 0,
    gap: Array | float = 0.0,
) -> Bool[Array, " m"]:
    """Set `hits[where(i)]` for the masked `i` whose pair collides.

    Three tests, each only for what the one before left open: a first part of the cloud, the whole cloud with bounds
    that need no powers, and the exact gauge.

    Args:
      hits: what was hit before.
      mask: which of the `n` pairs are worth a look.
      pair: makes pair `i`.
      where: place of pair `i` in `hits`; beyond its end where `i` is `n`.
      block: how many pairs are tested at once.
      coarse: how many points the first part has; 0 leaves that test out.
      gap: how far a point of the cloud may be from the nearest one of its first part [m].
    """
    n = mask.shape[0]

    def bounded(cut):
        def bounds(i):
            cloud, T, size, exponents = pair(i)
            lower, upper = _bounds(cloud[:, :cut] if cut else cloud, T, size, exponents)
            # The gauge is a norm, at most the length over the least half-extent, or twice that below 2-norms.
            slack = jnp.where(jnp.max(exponents) > 1.0, 2.0, 1.0) * gap / jnp.min(size) if cut else 0.0
            return lower < 1.0 + slack, upper < 1.0

        return jax.vmap(bounds)

    def test(hits, index, mask, cut):
        """Test the masked ones of pairs `index`, or of all pairs, and those that stay open further."""

        def body(hits, inner, active):
            chosen = inner if index is None else jnp.where(active, index[jnp.minimum(inner, mask.size - 1)], n)
            near, sure = bounded(cut)(jnp.minimum(chosen, n - 1))
            sure &= active
            hits = hits.at[where(jnp.where(sure, chosen, n))].set(True, mode="drop")
            still_open = active & near & ~sure
            return test(hits, chosen, still_open, 0) if cut else exact(hits, chosen, still_open)

        return for_each(mask, body, hits, block)

    def exact(hits, index, mask):
        def body(hits, inner, active):
            chosen = jnp.where(active, index[jnp.minimum(inner, index.shape[0] - 1)], n)
            least = jax.vmap(lambda i: _least_gauge(*pair(i)))(jnp.minimum(chosen, n - 1))
            return hits.at[where(jnp.where(active & (least < 1.0), chosen, n))].set(True, mode="drop")

        return for_each(mask, body, hits, max(block // 8, 1))

    return test(hits, None, mask, coarse)


def any_inside(
    mask: Bool[Array, " n"], pair: Callable[[Any, Any, Array], Pair], shared: Any, row: Any, block: int = 256
) -> Bool[Array, " n"]:
    """Whether any point of a cloud lies inside a superquadric, for the masked ones of `n` pairs.

    Args:
      mask: pairs that are worth a look; the others are reported as free of collision.
      pair: makes pair `i` from `shared`, `row` and `i`; see `masked.masked_vmap`.
      shared, row: what pairs are made from.
      block: how many pairs are evaluated at once on a CPU.

    Returns:
      True where a masked pair collides.
    """

    def run(mask, shared, rows):
        batch, n = mask.shape[:-1], mask.shape[-1]
        make = lambda i: pair(shared, rows_of(rows, i // n, batch), i % n)  # noqa: E731
        hits = jnp.zeros(mask.size, bool)
        return mark_hits(hits, mask.reshape(-1), make, lambda i: i, block_size(block)).reshape(mask.shape)

    return merged(run)(mask, shared, row)
