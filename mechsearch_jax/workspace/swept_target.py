"""The space that the target sweeps on a straight way out."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float

from mechsearch_jax.workspace.target import Target

# Multiple of the points on a swept target of several pieces that are drawn, since most are in other pieces' ways.
SPARE = 4


def swept_target(target: Target, direction: np.ndarray, distance: float, count: int, erosion: float) -> np.ndarray:
    """Surface of the volume that the target sweeps along a direction, in its own frame, shape (count, 3) [m]."""
    hulls = [_swept_hull(mesh, distance * np.asarray(direction)) for mesh in target.solid.hulls(erosion)]
    if len(hulls) == 1:
        return np.asarray(trimesh.sample.sample_surface(hulls[0], count, seed=0)[0], np.float32)
    # Points in other hulls are not on the surface; those that are left are spread evenly.
    shares = np.ceil(SPARE * count * np.array([hull.area for hull in hulls]) / sum(hull.area for hull in hulls))
    outside = [
        _outside(np.asarray(trimesh.sample.sample_surface(hull, int(share), seed=i)[0]), hulls[:i] + hulls[i + 1 :])
        for i, (hull, share) in enumerate(zip(hulls, shares, strict=True))
    ]
    points = np.concatenate(outside)
    if len(points) < count:
        points = np.concatenate([points, *[trimesh.sample.sample_surface(hull, count, seed=0)[0] for hull in hulls]])
    return np.asarray(points[np.random.default_rng(0).permutation(len(points))[:count]], np.float32)


def _swept_hull(mesh: trimesh.Trimesh, way: np.ndarray) -> trimesh.Trimesh:
    """What a convex solid sweeps on a straight way [m]."""
    return trimesh.convex.convex_hull(np.concatenate([mesh.vertices, mesh.vertices + way]))


def _outside(points: Float[np.ndarray, "n 3"], hulls: list[trimesh.Trimesh]) -> Float[np.ndarray, "m 3"]:
    """The points that are in none of several convex solids [m]."""
    inside = np.zeros(len(points), bool)
    for hull in hulls:
        normals = np.asarray(hull.face_normals)
        offsets = np.einsum("fi,fi->f", normals, np.asarray(hull.triangles_center))
        inside |= np.all(points @ normals.T < offsets - 1e-4, axis=1)
    return points[~inside]
