"""The space that the target sweeps on a straight way out."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mechsearch_jax.workspace.target import Target

if TYPE_CHECKING:
    from scipy.spatial import ConvexHull

# Multiple of the points on a swept target of several pieces that are drawn, since most are in other pieces' ways.
SPARE = 4
# Of so many faces of a hull one is looked at first.
FACES = 16


def swept_target(target: Target, direction: np.ndarray, distance: float, count: int, erosion: float) -> np.ndarray:
    """Surface of the volume that the target sweeps along a direction, in its own frame, shape (count, 3) [m]."""
    import trimesh
    from scipy.spatial import ConvexHull

    way = distance * np.asarray(direction)
    if target.compound is None:
        (mesh,) = target.solid.hulls(erosion)
        hull = trimesh.convex.convex_hull(np.concatenate([mesh.vertices, mesh.vertices + way]))
        return np.asarray(trimesh.sample.sample_surface(hull, count, seed=0)[0], np.float32)
    hulls = [ConvexHull(np.concatenate([corners, corners + way])) for corners in _corners(target, erosion)]
    # Points in other hulls are not on the surface; those that are left are spread evenly.
    shares = np.ceil(SPARE * count * np.array([hull.area for hull in hulls]) / sum(hull.area for hull in hulls))
    drawn = [_drawn(hull, int(share), i) for i, (hull, share) in enumerate(zip(hulls, shares, strict=True))]
    outside = [_outside(points, hulls[:i] + hulls[i + 1 :]) for i, points in enumerate(drawn)]
    points = np.concatenate(outside)
    if len(points) < count:
        points = np.concatenate([points, *drawn])
    return np.asarray(points[np.random.default_rng(0).permutation(len(points))[:count]], np.float32)


@functools.lru_cache(maxsize=16)
def _corners(target: Target, erosion: float) -> tuple[Float[np.ndarray, "n 3"], ...]:
    """The corners of the shrunk solids [m]; must not be changed."""
    return tuple(np.asarray(mesh.vertices) for mesh in target.solid.hulls(erosion))


def _drawn(hull: ConvexHull, count: int, seed: int) -> Float[np.ndarray, "{count} 3"]:
    """Points on the surface of a convex hull [m]."""
    import trimesh

    # Much faster than `trimesh.convex.convex_hull`, whose faces all turn the same way, which does not count here.
    surface = trimesh.Trimesh(hull.points, hull.simplices, process=False)
    return np.asarray(trimesh.sample.sample_surface(surface, count, seed=seed)[0])


def _outside(points: Float[np.ndarray, "n 3"], hulls: list[ConvexHull]) -> Float[np.ndarray, "m 3"]:
    """The points that are in none of several convex hulls [m]."""
    inside = np.zeros(len(points), bool)
    for hull in hulls:
        left = np.flatnonzero(~inside)
        # A few faces tell most points that are outside.
        for faces in (hull.equations[::FACES], hull.equations):
            left = left[np.all(points[left] @ faces[:, :3].T + faces[:, 3] < -1e-4, axis=1)]
        inside[left] = True
    return points[~inside]
