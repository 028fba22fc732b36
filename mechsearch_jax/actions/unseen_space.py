"""The space that an unseen target, or anything that was not measured, may fill, and tests of what enters it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.transforms import transform_rows
from mechsearch_jax.runtime.pytree import PyTreeNode

# Cells of the raster beyond the candidate poses on each side, so that it covers the board: they stay 50 mm from its
# edges, and are 15 mm apart.
BORDER = 4


class PossibleSpace(PyTreeNode):
    """The part of the shelf that may be filled by what was not seen, as a raster spaced as the candidate poses are.

    Attributes:
      target: height up to which a target at a possible pose fills a cell [m], -inf where none does, shape (rows along
        x, columns along y); the outer `BORDER` rows and columns on each side have no candidate poses.
      unmeasured: height up to which a cell may be filled by a thing that has no depth [m], -inf where it cannot, same
        shape; see `belief.unmeasured`.
      chance: share of the possible poses whose centre is in a cell, without the border; the sum is 1, or 0 if there are
        none.
      origin: centre of the first cell [m], shape (2,).
      cell: spacing [m], shape (2,).
    """

    target: jax.Array
    unmeasured: jax.Array
    chance: jax.Array
    origin: jax.Array
    cell: jax.Array


def bordered(cells: Bool[Array, "r c"]) -> Bool[Array, "rows columns"]:
    """A raster with a border of cells that are False."""
    return jnp.pad(cells, BORDER)


def widen(cells: Bool[Array, "r c"]) -> Bool[Array, "r c"]:
    """Grow a raster by one cell on every side: enough, as a cell is 15 mm wide and a target's radius 20 mm."""
    return jax.lax.reduce_window(cells, False, jax.lax.bitwise_or, (3, 3), (1, 1), "SAME")


def _cells(space: PossibleSpace, x: Float[Array, "*batch"], y: Float[Array, "*batch"]):
    """Row and column of the cells of world points, and whether they are on the raster."""
    rows, columns = space.target.shape
    row, column = (
        jnp.round((at - space.origin[axis]) / space.cell[axis]).astype(jnp.int32) for axis, at in enumerate((x, y))
    )
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    return jnp.clip(row, 0, rows - 1), jnp.clip(column, 0, columns - 1), inside


def _enters(space: PossibleSpace, x, y, z):
    row, column, inside = _cells(space, x, y)
    return (z < jnp.maximum(space.target, space.unmeasured)[row, column]) & inside


def enters(space: PossibleSpace, points: Float[Array, "*batch 3"]) -> Bool[Array, "*batch"]:
    """Whether world points lie in possible space."""
    return _enters(space, points[..., 0], points[..., 1], points[..., 2])


def enters_unmeasured(space: PossibleSpace, points: Float[Array, "*batch 3"]) -> Bool[Array, "*batch"]:
    """Whether world points lie where something that has no depth may be."""
    row, column, inside = _cells(space, points[..., 0], points[..., 1])
    return (points[..., 2] < space.unmeasured[row, column]) & inside


def cloud_enters(
    space: PossibleSpace, T_world_cloud: Float[Array, "*batch 4 4"], cloud: Float[Array, "*#batch 3 p"]
) -> Bool[Array, "*batch"]:
    """Whether any point of a cloud (rows of coordinates in its own frame) at a pose lies in possible space."""
    return jnp.any(_enters(space, *transform_rows(T_world_cloud, cloud)), axis=-1)


def touch_probability(space: PossibleSpace, points: Float[Array, "... 3"]) -> Float[Array, "2"]:
    """Share of the possible poses at which points would touch the target; and 1 if they enter what was not measured,
    else 0."""
    points = points.reshape(-1, 3)
    row, column, inside = _cells(space, points[:, 0], points[:, 1])
    low = points[:, 2] < jnp.max(space.target)
    touched = jnp.zeros(space.target.shape, bool).at[row, column].max(inside & low)
    touched = touched[BORDER:-BORDER, BORDER:-BORDER]
    probability = jnp.sum(jnp.where(widen(touched), space.chance, 0.0))
    return jnp.stack([probability, jnp.any(enters_unmeasured(space, points)).astype(probability.dtype)])
