"""The space that an unseen target may fill, and tests of what enters it."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.transforms import transform_rows


class PossibleSpace(flax.struct.PyTreeNode):
    """The part of the shelf that a target at a possible pose would fill, as a raster spaced as the candidate poses are.

    Attributes:
      occupied: whether a target at a possible pose covers part of a cell, shape (rows along x, columns along y).
      chance: share of the possible poses whose centre is in a cell, same shape; the sum is 1, or 0 if there are none.
      origin: centre of the first cell [m], shape (2,).
      cell: spacing [m], shape (2,).
      top: height up to which a target reaches [m].
    """

    occupied: jax.Array
    chance: jax.Array
    origin: jax.Array
    cell: jax.Array
    top: jax.Array


def widen(cells: Bool[Array, "r c"]) -> Bool[Array, "r c"]:
    """Grow a raster by one cell on every side: enough, as a cell is 15 mm wide and a target's radius 20 mm."""
    return jax.lax.reduce_window(cells, False, jax.lax.bitwise_or, (3, 3), (1, 1), "SAME")


def _cells(space: PossibleSpace, x: Float[Array, "*batch"], y: Float[Array, "*batch"], z: Float[Array, "*batch"]):
    """Row and column of the cells of world points, and whether they are on the raster and not above a target."""
    rows, columns = space.occupied.shape
    row, column = (
        jnp.round((at - space.origin[axis]) / space.cell[axis]).astype(jnp.int32) for axis, at in enumerate((x, y))
    )
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns) & (z < space.top)
    return jnp.clip(row, 0, rows - 1), jnp.clip(column, 0, columns - 1), inside


def _enters(space: PossibleSpace, x, y, z):
    row, column, inside = _cells(space, x, y, z)
    return space.occupied[row, column] & inside


def enters(space: PossibleSpace, points: Float[Array, "*batch 3"]) -> Bool[Array, "*batch"]:
    """Whether world points lie in possible space."""
    return _enters(space, points[..., 0], points[..., 1], points[..., 2])


def cloud_enters(
    space: PossibleSpace, T_world_cloud: Float[Array, "*batch 4 4"], cloud: Float[Array, "*#batch 3 p"]
) -> Bool[Array, "*batch"]:
    """Whether any point of a cloud (rows of coordinates in its own frame) at a pose lies in possible space."""
    return jnp.any(_enters(space, *transform_rows(T_world_cloud, cloud)), axis=-1)


def touch_probability(space: PossibleSpace, points: Float[Array, "... 3"]) -> Float[Array, ""]:
    """Share of the possible poses at which world points would touch the target."""
    x, y, z = points.reshape(-1, 3).T
    row, column, inside = _cells(space, x, y, z)
    touched = jnp.zeros(space.occupied.shape, bool).at[row, column].max(inside)
    return jnp.sum(jnp.where(widen(touched), space.chance, 0.0))
