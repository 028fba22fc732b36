"""f by brute force: the visible pixels of a target are counted at the camera's full resolution, without any margin.

The reference for `existence`, which uses a coarse image and five places of a cell.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from mechsearch_jax.existence import (
    ExistenceConfig,
    ExistenceTables,
    allowances,
    closer_image,
    existence,
    existence_tables,
    object_views,
)
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner import Problem
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.target import Target

# Places along each side of a cell, its edges included.
SIDE = 5

# Cached, since they take seconds and are the same for every scene.
_tables = functools.cache(existence_tables)


@dataclasses.dataclass(frozen=True)
class FullResolution(ExistenceConfig):
    """Every pixel of the camera counts, and every overlap.

    Attributes:
      side: number of places along each side of a cell at which a target is tried, in a square grid; 1 is the middle
        alone.
    """

    downscale: int = 1
    window: tuple[int, int] = (336, 336)
    side: int = 1

    @property
    def looks_closer(self) -> bool:
        """Never."""
        return False

    def step(self, camera: Camera) -> int:
        """As of `ExistenceConfig`."""
        return 1

    @property
    def places(self) -> np.ndarray:
        """As of `ExistenceConfig`; the yaw is the pose's own."""
        along = np.linspace(-1.0, 1.0, self.side) if self.side > 1 else np.zeros(1)
        x, y = np.meshgrid(along, along, indexing="ij")
        # The middle comes first.
        grid = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        return grid[np.argsort(np.abs(grid).sum(axis=1), kind="stable")].astype(np.float32)


@functools.partial(jax.jit, static_argnames=("target", "config"))
def _possible(
    tables: ExistenceTables, camera: Camera, target: Target, scene: Superquadrics, config: FullResolution
) -> Bool[Array, " x"]:
    everywhere = jnp.ones(tables.corner.shape[0], bool)
    views = object_views(tables, camera, scene, everywhere, config)
    closer = closer_image(camera, scene, views, config)
    allowed = allowances(tables, camera, target, views, closer, config)
    return existence(tables, camera, views, everywhere, allowed, config)


def exact_existence(problem: Problem, scene: Superquadrics, side: int = SIDE) -> Bool[Array, " x"]:
    """The candidate poses whose cell contains a place where the target would be hidden and overlap nothing.

    Args:
      problem: of the camera, the shelf and the target.
      scene: the objects, fields (N, ...).
      side: number of places along each side of a cell; 1 is the candidate pose alone.
    """
    config = FullResolution(side=side)
    tables = _tables(problem.camera, problem.shelf, problem.target, config)
    return _possible(tables, problem.camera, problem.target, scene, config)
