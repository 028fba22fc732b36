"""The space that the target sweeps on a straight way out."""

from __future__ import annotations

import numpy as np
import trimesh

from mechsearch_jax.shapes.solid import surface
from mechsearch_jax.workspace.target import Target


def swept_target(target: Target, direction: np.ndarray, distance: float, count: int, erosion: float) -> np.ndarray:
    """Surface of the volume that the target sweeps along a direction, in its own frame, shape (count, 3) [m].

    Of a target of pieces they are points on its surface, each somewhere on its way: some of them are inside.
    """
    way = distance * np.asarray(direction)
    if target.compound is not None:
        points = surface(target.compound, count, erosion)
        points = points[np.arange(count) % len(points)]
        # Evenly spread shares of the way, in an order that has nothing to do with that of the points.
        share = np.arange(1, count + 1) * ((5**0.5 - 1) / 2) % 1.0
        return np.asarray(points + share[:, None] * way, np.float32)
    (mesh,) = target.solid.hulls(erosion)
    hull = trimesh.convex.convex_hull(np.concatenate([mesh.vertices, mesh.vertices + way]))
    return np.asarray(trimesh.sample.sample_surface(hull, count, seed=0)[0], np.float32)
