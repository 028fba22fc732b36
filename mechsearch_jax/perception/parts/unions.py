"""Choose the superquadrics whose union explains a segment: points on no part, rays through one, a price for each."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.perception import solids
from mechsearch_jax.perception.scores import EDGE
from mechsearch_jax.perception.selection import check_numbers
from mechsearch_jax.runtime.pytree import PyTreeNode

# Objects that are shrunk keep at least this share of their sizes.
_LEAST = 0.3
# A change must gain more than rounding does [pixels].
LEAST_GAIN = 1e-3


@dataclasses.dataclass(frozen=True)
class UnionCosts:
    """What an explanation of a segment by parts costs; lengths in metres, costs in view pixels.

    Attributes:
      exact: a point this near to a part's surface is explained, or one that is so many times as near as ...
      deviations: ... the standard deviation of the depth's noise.
      wrong: a point that is farther by this is not; between the two its cost grows evenly.
      shrink: rays may pass this deep below a part's faces.
      part: price of each part after the first, and ...
      part_share: ... this share of the segment's pixels.
    """

    exact: float = 0.002
    deviations: float = 2.5
    wrong: float = 0.004
    shrink: float = 0.002
    part: float = 6.0
    part_share: float = 0.005

    def __post_init__(self):
        check_numbers(self, positive=("wrong",))


class Evidence(PyTreeNode):
    """What a segment is judged by.

    Attributes:
      points: of the segment in the world [m], shape (M, 3).
      point_weight: pixels for each point, 0 where there is none, shape (M,).
      origin: of the rays [m], shape (3,).
      directions: of rays in and around the segment's image, shape (R, 3).
      free: length up to which each ray is free, in lengths of its direction; 0 if nothing was measured, shape (R,).
      ray_weight: pixels for each ray, shape ().
      pixels: of the segment, shape ().
      exact: a point this near to a surface is explained [m], shape ().
    """

    points: jax.Array
    point_weight: jax.Array
    origin: jax.Array
    directions: jax.Array
    free: jax.Array
    ray_weight: jax.Array
    pixels: jax.Array
    exact: jax.Array


class Table(PyTreeNode):
    """What each of C candidates explains.

    Attributes:
      misfit: cost of each point by each candidate, 0 for a point on its surface to 1, shape (C, M).
      through: which rays pass through each candidate, shape (C, R).
    """

    misfit: jax.Array
    through: jax.Array


def distance(parts: Superquadrics, points: Float[Array, "p 3"]) -> Float[Array, "n p"]:
    """`solids.surface_distance` of boxes and cylinders, and likewise of ellipsoids [m]."""
    flat = solids.surface_distance(parts, points)
    x, y, z = solids.relative(parts, points)
    a, b, c = (parts.size[:, i, None] for i in range(3))
    first = jnp.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2)
    second = jnp.sqrt((x / a**2) ** 2 + (y / b**2) ** 2 + (z / c**2) ** 2)
    smooth = jnp.where(
        second > 1e-6, first * (first - 1.0) / jnp.maximum(second, 1e-6), -jnp.minimum(a, jnp.minimum(b, c))
    )
    return jnp.where((parts.exponents[:, 0] > EDGE)[:, None], smooth, flat)


def entries(
    parts: Superquadrics, origin: Float[Array, " 3"], directions: Float[Array, "p 3"], shrink: float
) -> Float[Array, "n p"]:
    """`solids.entries` of boxes and cylinders, and likewise of ellipsoids."""
    flat = solids.entries(parts, origin, directions, shrink)
    size = jnp.maximum(parts.size - shrink, _LEAST * parts.size)
    start = [part / size[:, i, None] for i, part in enumerate(solids.relative(parts, origin[None]))]
    way = [part / size[:, i, None] for i, part in enumerate(solids.local(parts, directions))]
    square = jnp.maximum(sum(w**2 for w in way), 1e-12)
    half = sum(s * w for s, w in zip(start, way, strict=True))
    root = half**2 - square * (sum(s**2 for s in start) - 1.0)
    spread = jnp.sqrt(jnp.maximum(root, 0.0))
    hit = (root > 0.0) & (spread > half) & parts.valid[:, None]
    smooth = jnp.where(hit, (-half - spread) / square, jnp.inf)
    return jnp.where((parts.exponents[:, 0] > EDGE)[:, None], smooth, flat)


def table_of(parts: Superquadrics, evidence: Evidence, costs: UnionCosts) -> Table:
    """What candidates explain; those that are not valid explain nothing."""
    off = jnp.clip((jnp.abs(distance(parts, evidence.points)) - evidence.exact) / costs.wrong, 0.0, 1.0)
    enter = entries(parts, evidence.origin, evidence.directions, costs.shrink)
    # Rays end where they are measured, with the noise of points.
    until = evidence.free[None] - costs.shrink - (evidence.exact - costs.exact)
    return Table(
        misfit=jnp.where(parts.valid[:, None], off, 1.0),
        through=(enter < until) & parts.valid[:, None],
    )


def union_cost(table: Table, chosen: Bool[Array, " c"], evidence: Evidence, costs: UnionCosts) -> Float[Array, ""]:
    """What the union of the chosen candidates costs, which must be at least one [pixels]."""
    price = (jnp.sum(chosen) - 1) * (costs.part + costs.part_share * evidence.pixels)
    return union_misfit(table, chosen, evidence) + price


def union_misfit(table: Table, chosen: Bool[Array, " c"], evidence: Evidence) -> Float[Array, ""]:
    """How many pixels the union of the chosen candidates explains badly, or are of rays that pass through it."""
    left = jnp.min(jnp.where(chosen[:, None], table.misfit, 1.0), axis=0)
    through = jnp.any(table.through & chosen[:, None], axis=0)
    return jnp.sum(left * evidence.point_weight) + jnp.sum(through) * evidence.ray_weight


def select_union(
    table: Table, start: Int[Array, " k"], evidence: Evidence, costs: UnionCosts
) -> tuple[Int[Array, " k"], Float[Array, ""]]:
    """The candidates of the cheapest union that was found, and its cost.

    From the given union and from the best pair, one candidate at a time is added, dropped or replaced, the best of all
    such changes first, until none pays.

    Args:
      table: of C candidates.
      start: the given union, as indices of candidates; C for none.
      evidence, costs: of the segment.

    Returns:
      Indices as `start`; and the cost [pixels].
    """
    count = table.misfit.shape[0]
    # The last candidate is none.
    misfit = jnp.concatenate([table.misfit, jnp.ones_like(table.misfit[:1])])
    through = jnp.concatenate([table.through, jnp.zeros_like(table.through[:1])])
    price = (costs.part + costs.part_share * evidence.pixels) * (jnp.arange(count + 1) < count)

    def total(misfit, through, price):
        return misfit @ evidence.point_weight + jnp.sum(through, axis=-1) * evidence.ray_weight + price - price_of_one

    price_of_one = price[0]

    def not_empty(after, others):
        """The costs of adding each candidate, or none, to others; a union of none is no choice."""
        return jnp.where((jnp.arange(count + 1) == count) & jnp.all(others == count), jnp.inf, after)

    def changed(slots):
        """The cost of putting each candidate, or none, into each slot, shape (k, C + 1)."""

        def without(slot):
            others = jnp.where(jnp.arange(len(slots)) == slot, count, slots)
            left, passed = jnp.min(misfit[others], axis=0), jnp.any(through[others], axis=0)
            after = total(jnp.minimum(misfit, left[None]), through | passed[None], price + jnp.sum(price[others]))
            return not_empty(after, others)

        return jax.vmap(without)(jnp.arange(len(slots)))

    def better(state):
        slots, cost, _ = state
        after = changed(slots)
        slot, candidate = jnp.unravel_index(jnp.argmin(after), after.shape)
        gained = after[slot, candidate] < cost - LEAST_GAIN
        return (
            jnp.where(gained, slots.at[slot].set(candidate), slots),
            jnp.minimum(after[slot, candidate], cost),
            gained,
        )

    def descend(slots):
        cost = jnp.min(jnp.diagonal(changed(slots)[:, slots]))
        return jax.lax.while_loop(lambda state: state[2], better, (slots, cost, jnp.array(True)))[:2]

    def with_first(first):
        left, passed = jnp.minimum(misfit, misfit[first][None]), through | through[first][None]
        return not_empty(total(left, passed, price + price[first]), first[None])

    pairs = jax.lax.map(with_first, jnp.arange(count + 1))
    pair = jnp.stack(jnp.unravel_index(jnp.argmin(pairs), pairs.shape))
    second = jnp.full(len(start), count).at[:2].set(pair)
    slots, cost = jax.vmap(descend)(jnp.stack([start, second]))
    best = jnp.argmin(cost)
    return slots[best], cost[best]
