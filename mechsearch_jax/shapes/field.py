"""The signed distance of a compound on a grid: fast where it is looked up at very many points; without JAX."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Float

from mechsearch_jax.shapes import union
from mechsearch_jax.shapes.compound import Compound, surface_points

# Spacing of the grid, larger for bodies of more cells than the second number, and the rim around the body [m].
STEP, CELLS, RIM = 0.002, 150_000, 0.006
# Points whose distances are computed at once.
BLOCK = 4096


@dataclasses.dataclass(frozen=True, eq=False)
class Field:
    """Signed distances to a surface [m], negative inside, at points of a grid.

    Attributes:
      low: the first point [m].
      step: spacing of the points [m].
      values: shape (nx, ny, nz).
    """

    low: Float[np.ndarray, " 3"]
    step: float
    values: Float[np.ndarray, "nx ny nz"]

    @property
    def high(self) -> Float[np.ndarray, " 3"]:
        """The last point [m]."""
        return self.low + self.step * (np.array(self.values.shape) - 1)

    def at(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Interpolated distances of points; beyond the grid that of its rim, which is outside of the body."""
        from scipy.ndimage import map_coordinates

        index = np.moveaxis((points - self.low) / self.step, -1, 0)
        return map_coordinates(self.values, index, order=1, mode="nearest")

    def slope(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """The outward unit normals of the surfaces of equal distance."""
        steps = np.eye(3) * self.step
        slope = np.stack([self.at(points + step) - self.at(points - step) for step in steps], axis=-1)
        return slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-9)


@functools.lru_cache(maxsize=16)
def field_of(compound: Compound) -> Field:
    """The field of a compound; its arrays must not be changed."""
    corners = surface_points(compound)
    low, high = corners.min(axis=0) - RIM, corners.max(axis=0) + RIM
    step = max(STEP, float(np.prod(high - low) / CELLS) ** (1 / 3))
    axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    flat = points.reshape(-1, 3).astype(np.float32)
    values = [union.distance(compound, list(flat[i : i + BLOCK].T), np) for i in range(0, len(flat), BLOCK)]
    return Field(low, step, np.concatenate(values).reshape(points.shape[:-1]))
