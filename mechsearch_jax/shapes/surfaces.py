"""Surfaces of mesh files made ready to be cut: seams welded, holes closed, faces turned outwards, specks left out.

Also how far convex pieces are from the surface that they stand for.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from mechsearch_jax.shapes.compound import hull_volume

if TYPE_CHECKING:
    from trimesh import Trimesh

# Points at which a surface is looked at; the nearest so many of them tell which triangles are near.
SAMPLES, NEAR = 10_000, 12
# Pairs of points and triangles at a time, and points that are looked at more closely at a time.
AT_ONCE, BLOCK = 1 << 20, 64
# Triangles whose distances differ by less are equally near [m].
TIED = 1e-9
# Vertices of open edges that are as near to each other are one [m].
SEAM = 2e-5
# A connected part is a speck if its longest side is at most this share of that of the largest part.
SPECK = 0.03
# A closed surface encloses more than this share of the volume of the box around it.
FLAT = 1e-3
# So many vertices of a part are looked at to tell whether it lies inside another.
LOOKED_AT = 100


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


@dataclasses.dataclass(frozen=True)
class Mended:
    """A mesh's connected parts, none within another.

    Attributes:
      parts: each has consistent winding where it can be oriented, and faces outwards.
      holes: widths of those that were closed [m].
      open_edges: how many are left.
      specks: longest sides of the parts that were left out: flat, or tiny beside the largest [m].
      inner: volumes of the closed parts that were left out because they lie inside another [m3].
    """

    parts: tuple[Trimesh, ...]
    holes: tuple[float, ...]
    open_edges: int
    specks: tuple[float, ...]
    inner: tuple[float, ...]


def mended(mesh: Trimesh) -> Mended:
    """What a mesh in metres, whose vertices at the same place are one, is taken for."""
    mesh = _wound(_welded(mesh))
    parts = list(mesh.split(only_watertight=False, repair=False))
    longest = [float(np.max(part.extents)) for part in parts]
    least = SPECK * max(longest, default=0.0)
    kept, specks, holes = [], [], []
    for part, size in zip(parts, longest, strict=True):
        if size <= least or hull_volume(np.asarray(part.vertices)) == 0:
            specks.append(size)
        else:
            closed, widths = _closed(part)
            kept.append(_outwards(closed))
            holes += widths
    outer, inner = _outermost(kept)
    left = sum(len(open_edges(part)) for part in outer)
    return Mended(tuple(outer), tuple(holes), left, tuple(specks), tuple(inner))


def whole(parts: Sequence[Trimesh]) -> Trimesh:
    """Several surfaces as one."""
    import trimesh

    return trimesh.util.concatenate(list(parts))  # pyright: ignore[reportReturnType]


def open_edges(mesh: Trimesh) -> Int[np.ndarray, "n 2"]:
    """The edges that only one triangle has, in its direction."""
    edges = np.asarray(mesh.edges_sorted)
    _, first, uses = np.unique(edges, axis=0, return_index=True, return_counts=True)
    return np.asarray(mesh.edges)[first[uses == 1]]


def _welded(mesh: Trimesh) -> Trimesh:
    """The mesh without seams: other vertices than those of open edges stay, however near to each other."""
    from scipy.spatial import KDTree

    border = np.unique(open_edges(mesh))
    if len(border):
        pairs = border[KDTree(mesh.vertices[border]).query_pairs(SEAM, output_type="ndarray")]
        same = _components(pairs, len(mesh.vertices))
        # The first vertex of each group stands for it.
        first = np.unique(same, return_index=True)[1]
        mesh = type(mesh)(mesh.vertices, first[same][mesh.faces], process=False)
    # Those that welding has made lines; to leave out slivers would open holes.
    faces = np.asarray(mesh.faces)
    mesh.update_faces(np.all(faces != np.roll(faces, 1, axis=1), axis=1) & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    return mesh


def _components(pairs: Int[np.ndarray, "n 2"], count: int) -> Int[np.ndarray, " count"]:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def _wound(mesh: Trimesh) -> Trimesh:
    """The mesh with faces that share an edge running through it in opposite directions, wherever that is possible."""
    pairs, shared, count = np.asarray(mesh.face_adjacency), np.asarray(mesh.face_adjacency_edges), len(mesh.faces)
    if not len(pairs):
        return mesh
    along = [_runs_along(np.asarray(mesh.faces)[pairs[:, side]], shared) for side in (0, 1)]
    clash = along[0] == along[1]
    # Every face twice, as it is and turned: what fits together is connected. Where both are, there is no orientation.
    a, b = pairs.T
    fits = np.concatenate([np.stack([a, b + count * clash], 1), np.stack([a + count, b + count * ~clash], 1)])
    group = _components(fits, 2 * count)
    turned = group[:count] > group[count:]
    return type(mesh)(mesh.vertices, np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces), process=False)


def _runs_along(faces: Int[np.ndarray, "n 3"], edges: Int[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Whether faces have one of their edges in its direction."""
    after = np.roll(faces, -1, axis=1)
    return np.any((faces == edges[:, :1]) & (after == edges[:, 1:]), axis=1)


def _closed(part: Trimesh) -> tuple[Trimesh, list[float]]:
    """A connected part with a lid on every hole, and the holes' widths [m]; as it is where lids do not close it.

    A lid joins the edges around a hole to their centre. Of a flat hole it lies in the hole's plane, of whatever outline
    the hole is, and where it overlaps itself, it does so with opposite signs.
    """
    border = open_edges(part)
    if not len(border):
        return part, []
    begins, ends = (np.bincount(border[:, side], minlength=len(part.vertices)) for side in (0, 1))
    if not np.array_equal(begins, ends):
        return part, []
    hole = np.unique(_components(border, len(part.vertices))[border[:, 0]], return_inverse=True)[1]
    vertices, widths = np.asarray(part.vertices), []
    centres = np.empty((hole.max() + 1, 3))
    for i in range(len(centres)):
        around = vertices[border[hole == i]]
        centres[i] = around.mean(axis=(0, 1))
        widths.append(float(np.ptp(around.reshape(-1, 3), axis=0).max()))
    lids = np.column_stack([border[:, ::-1], len(vertices) + hole])
    closed = type(part)(np.concatenate([vertices, centres]), np.concatenate([part.faces, lids]), process=False)
    encloses = abs(closed.volume) > FLAT * np.prod(closed.extents)
    return (closed, widths) if encloses and closed.is_watertight else (part, [])


def _outwards(part: Trimesh) -> Trimesh:
    """The part with its faces turned away from its middle on the whole; of a closed one, outwards."""
    away = part.triangles_center - part.vertices.mean(axis=0)
    if np.sum(away * part.triangles_cross) < 0:
        part.invert()
    return part


def _outermost(parts: list[Trimesh]) -> tuple[list[Trimesh], list[float]]:
    """The parts that are not within another, and the volumes of the others [m3]."""
    outer, inner = [], []
    for part in sorted(parts, key=lambda part: -float(np.prod(part.extents))):
        corners = np.asarray(part.vertices)[:: -(-len(part.vertices) // LOOKED_AT)]
        if part.is_watertight and any(_within(part, corners, other) for other in outer):
            inner.append(abs(float(part.volume)))
        else:
            outer.append(part)
    return outer, inner


def _within(part: Trimesh, corners: np.ndarray, other: Trimesh) -> bool:
    low, high = other.bounds
    around = bool(np.all(part.bounds[0] > low) and np.all(part.bounds[1] < high))
    return around and other.is_watertight and bool(np.all(turns_around(other, corners) > 0.5))
