"""How far convex pieces are from the surface that they stand for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

if TYPE_CHECKING:
    from trimesh import Trimesh

# Points at which a surface is looked at; the nearest so many of them tell which triangles are near.
SAMPLES, NEAR = 10_000, 12
# Pairs of points and triangles at a time, and points that are looked at more closely at a time.
AT_ONCE, BLOCK = 1 << 20, 64
# Triangles whose distances differ by less are equally near [m].
TIED = 1e-9


def turns_around(mesh: Trimesh, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """How often a surface goes around points: 0 outside a closed one, 1 inside, in between for an open one.

    Jacobson, Kavan and Sorkine-Hornung, Robust Inside-Outside Segmentation Using Generalized Winding Numbers (2013);
    the solid angle of a triangle is that of van Oosterom and Strackee (1983).
    """
    triangles = np.asarray(mesh.triangles)
    turns = np.empty(len(points))
    step = max(1, AT_ONCE // len(triangles))
    for i in range(0, len(points), step):
        a, b, c = np.moveaxis(triangles[None] - points[i : i + step, None, None], 2, 0)
        la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
        dot_ab, dot_bc, dot_ca = (np.sum(v * w, axis=-1) for v, w in ((a, b), (b, c), (c, a)))
        below = la * lb * lc + dot_ab * lc + dot_bc * la + dot_ca * lb
        turns[i : i + step] = np.arctan2(np.sum(a * np.cross(b, c), axis=-1), below).sum(axis=1) / (2 * np.pi)
    return turns


def nearest(mesh: Trimesh, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """The point of a surface that is nearest to each point, and whether the surface faces the point there.

    Only the triangles around the nearest of its samples are looked at: where triangles are long and thin, another may
    be nearer.
    """
    import trimesh
    from scipy.spatial import KDTree

    samples, face = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[:2]
    # Small triangles may have no sample.
    around = np.concatenate([samples, mesh.triangles_center])
    of = np.concatenate([face, np.arange(len(mesh.faces))])
    near = of[KDTree(around).query(points, k=NEAR)[1]]
    on = _closest(mesh, near.ravel(), np.repeat(points, NEAR, axis=0)).reshape(-1, NEAR, 3)
    apart = points[:, None] - on
    away = np.linalg.norm(apart, axis=-1)
    # At an edge, the triangle that is seen least aslant tells the side.
    along = np.sum(apart * mesh.face_normals[near], axis=-1)
    tied = away <= away.min(axis=1, keepdims=True) + TIED
    best = np.argmax(np.where(tied, np.abs(along), -1.0), axis=1)
    rows = np.arange(len(points))
    return on[rows, best], along[rows, best] > 0


def _closest(mesh: Trimesh, faces: np.ndarray, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    import trimesh

    return np.asarray(trimesh.triangles.closest_point(np.asarray(mesh.triangles)[faces], points))


def farthest_outside(mesh: Trimesh, points: Float[np.ndarray, "n 3"], least: float) -> float:
    """How far the farthest of some points is outside of a surface [m]; less than `least` is not told from 0."""
    on, faced = nearest(mesh, points)
    # No point is farther away than that.
    most = np.where(faced, np.linalg.norm(points - on, axis=1), 0.0)
    order, farthest, faces = np.argsort(-most), least, np.arange(len(mesh.faces))
    for i in range(0, len(order), BLOCK):
        block = order[i : i + BLOCK]
        block = points[block[most[block] > farthest]]
        if not len(block):
            break
        block = block[turns_around(mesh, block) < 0.5]
        for point in block:
            closest = _closest(mesh, faces, np.broadcast_to(point, (len(faces), 3)))
            farthest = max(farthest, float(np.linalg.norm(closest - point, axis=1).min()))
    return farthest if farthest > least else 0.0


def beyond(hulls: Sequence[Float[np.ndarray, "_ 3"]], points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, " m"]:
    """How far points are outside of all of several convex polyhedra, given by vertices [m].

    That is the distance to the plane of a face: before an edge or a corner it is less than the true one.
    """
    from scipy.spatial import ConvexHull

    planes = [ConvexHull(vertices).equations for vertices in hulls]
    return np.clip(np.min([np.max(points @ p[:, :3].T + p[:, 3], axis=1) for p in planes], axis=0), 0.0, None)


def deviation(mesh: Trimesh, hulls: Sequence[Float[np.ndarray, "_ 3"]], least: float) -> tuple[float, float]:
    """How far convex polyhedra, given by their vertices, reach out of a surface, and how far inside of it they stay, at
    sampled points [m]; the first is 0 up to `least`."""
    import trimesh

    pieces = trimesh.util.concatenate([trimesh.convex.convex_hull(vertices) for vertices in hulls])
    reached = np.concatenate([*hulls, trimesh.sample.sample_surface(pieces, SAMPLES, seed=0)[0]])
    points = np.concatenate([mesh.vertices, trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[0]])
    return farthest_outside(mesh, reached, least), float(beyond(hulls, points).max())
