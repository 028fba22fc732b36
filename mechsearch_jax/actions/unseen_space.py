"""The space that an unseen target may take, and what enters it."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class PossibleSpace(flax.struct.PyTreeNode):
    """Where a target that has not been ruled out would stand, as a raster at the spacing of the candidate poses.

    Attributes:
      occupied: whether any of it lies in a cell, shape (rows along x, columns along y).
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
    """A raster with the neighbours of its cells. A cell is 15 mm wide and a target's radius 20 mm: one is enough."""
    return jax.lax.reduce_window(cells, False, jax.lax.bitwise_or, (3, 3), (1, 1), "SAME")


def _cells(space: PossibleSpace, points):
    """Row and column of the cells of world points (N, 3), and whether they are on the raster and not above a target."""
    index = jnp.round((points[:, :2] - space.origin[None]) / space.cell[None]).astype(jnp.int32)
    shape = jnp.array(space.occupied.shape)[None]
    inside = jnp.all((index >= 0) & (index < shape), axis=-1) & (points[:, 2] < space.top)
    return jnp.clip(index, 0, shape - 1), inside


def enters(space: PossibleSpace, points: Float[Array, "... 3"]) -> Bool[Array, "..."]:
    """Whether world points lie in possible space."""
    index, inside = _cells(space, points.reshape(-1, 3))
    return (space.occupied[index[:, 0], index[:, 1]] & inside).reshape(points.shape[:-1])


def risk(space: PossibleSpace, points: Float[Array, "... 3"]) -> Float[Array, ""]:
    """Share of the possible poses at which the target would be touched by world points."""
    index, inside = _cells(space, points.reshape(-1, 3))
    touched = jnp.zeros(space.occupied.shape, bool).at[index[:, 0], index[:, 1]].max(inside)
    return jnp.sum(jnp.where(widen(touched), space.chance, 0.0))
