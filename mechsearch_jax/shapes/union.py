"""The geometry of a compound as the union of its convex solids, for NumPy or JAX; without JAX.

Distances and cuts are the least of the solids', support functions the largest. Outside of a solid with edges a distance
may be less than the true one, but not on its surface or inside: that of a convex polyhedron is to the farthest of the
planes of its faces, that of an ellipsoid is right to first order.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mechsearch_jax.shapes.compound import CONVEX, Compound, Piece, faces, solids
from mechsearch_jax.shapes.registry import PRIMITIVES

# A solid is shrunk to no less than this share of its half-extents.
LEAST_SHARE = 0.5
# Beyond every plane of a body [m]: the planes that fill up the rows of polyhedra with fewer faces.
_FAR = 1e3


class Polyhedra(NamedTuple):
    """The convex polyhedra of a compound as half-spaces n . x <= d in its frame.

    Attributes:
      normal: shape (P, F, 3).
      offset: d, shape (P, F) [m]; rows of polyhedra with fewer faces are filled up with planes far away.
      depth: distance of the planes from the middle of the polyhedron's vertices, shape (P, F) [m].
    """

    normal: Float[np.ndarray, "p f 3"]
    offset: Float[np.ndarray, "p f"]
    depth: Float[np.ndarray, "p f"]


@functools.lru_cache(maxsize=256)
def _solids(compound: Compound) -> tuple[Piece, ...]:
    return tuple(solids(compound.pieces))


@functools.lru_cache(maxsize=256)
def _primitives(compound: Compound) -> tuple[Piece, ...]:
    return tuple(solid for solid in _solids(compound) if solid.shape != CONVEX)


@functools.lru_cache(maxsize=256)
def polyhedra(compound: Compound) -> Polyhedra | None:
    """Its convex polyhedra, None without any; the arrays must not be changed."""
    pieces = [solid for solid in _solids(compound) if solid.shape == CONVEX]
    if not pieces:
        return None
    rows = [faces(piece) for piece in pieces]
    shape = (len(rows), max(len(row) for row in rows))
    normal, offset, depth = np.zeros((*shape, 3)), np.full(shape, _FAR), np.full(shape, _FAR)
    for i, (piece, row) in enumerate(zip(pieces, rows, strict=True)):
        turned = row[:, :3] @ piece.rotation.T
        middle = piece.in_body(np.array(piece.vertices)).mean(axis=0)
        normal[i, : len(row)] = turned
        offset[i, : len(row)] = row[:, 3] + turned @ np.array(piece.position)
        depth[i, : len(row)] = offset[i, : len(row)] - turned @ middle
    return Polyhedra(normal, offset, depth)


def _local(vector: Sequence[Any], piece: Piece, place: bool) -> list[Any]:
    """Components in a piece's frame of a point, if `place`, or a direction in the body's."""
    R, t = piece.rotation, piece.position
    moved = [component - t[i] if place else component for i, component in enumerate(vector)]
    return [sum(moved[j] * float(R[j, i]) for j in range(3)) for i in range(3)]


def _half(piece: Piece, grown: float) -> np.ndarray:
    half = np.array(piece.half_size)
    return half + grown if grown >= 0.0 else np.maximum(half + grown, LEAST_SHARE * half)


def _offset(rows: Polyhedra, grown: float) -> np.ndarray:
    return rows.offset + (grown if grown >= 0.0 else np.maximum(grown, -LEAST_SHARE * rows.depth))


def _least(values: list[Any], library: Any) -> Any:
    least, *rest = values
    for value in rest:
        least = library.minimum(least, value)
    return least


def _dot(normal: np.ndarray, vector: Sequence[Any], library: Any) -> Any:
    """Products of every normal (P, F, 3) with every vector, shape (*batch, P, F)."""
    return sum(
        component[..., None, None] * library.asarray(normal[..., i], component.dtype)
        for i, component in enumerate(vector)
    )


def distance(compound: Compound, point: Sequence[Float[Any, "*batch"]], library: Any) -> Float[Any, "*batch"]:
    """Signed distance of points to the surface [m], negative inside; its derivatives are finite everywhere.

    Args:
      compound: whose solids together are the body.
      point: by component, in the body's frame [m].
      library: of the arrays.
    """
    values = []
    for piece in _primitives(compound):
        x, y, z = _local(point, piece, True)
        level = library.stack([x, y], axis=-1)
        values.append(PRIMITIVES[piece.shape].distance(level, z, piece.half_size, library))
    if (rows := polyhedra(compound)) is not None:
        beyond = _dot(rows.normal, point, library) - library.asarray(rows.offset, point[0].dtype)
        values.append(library.min(library.max(beyond, axis=-1), axis=-1))
    return _least(values, library)


def cut(
    compound: Compound,
    origin: Sequence[Float[Any, "*#rays"]],
    direction: Sequence[Float[Any, "*#rays"]],
    grown: float,
    library: Any,
) -> Float[Any, "*rays"]:
    """Where rays from outside enter the body, as `shape.Shape.cut`; all solids are larger by `grown` [m]."""
    values = []
    for piece in _primitives(compound):
        start, along = _local(origin, piece, True), _local(direction, piece, False)
        values.append(PRIMITIVES[piece.shape].cut(start, along, _half(piece, grown), library))
    if (rows := polyhedra(compound)) is not None:
        gap = library.asarray(_offset(rows, grown), origin[0].dtype) - _dot(rows.normal, origin, library)
        speed = _dot(rows.normal, direction, library)
        safe = library.where(library.abs(speed) < 1e-12, 1e-12, speed)
        meets = gap / safe
        near = library.max(library.where(speed < -1e-12, meets, -library.inf), axis=-1)
        far = library.min(library.where(speed > 1e-12, meets, library.inf), axis=-1)
        # A ray along a face and outside of it misses.
        beside = library.any((library.abs(speed) <= 1e-12) & (gap < 0.0), axis=-1)
        hit = (near <= far) & (near > 0.0) & ~beside
        values.append(library.min(library.where(hit, near, library.inf), axis=-1))
    return _least(values, library)


def reach(compound: Compound, direction: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch"]:
    """The support function, from the body's origin along unit vectors [m]."""
    vector = [direction[..., i] for i in range(3)]
    values = []
    for piece in _solids(compound):
        along = _local(vector, piece, False)
        centre = sum(component * piece.position[i] for i, component in enumerate(vector))
        if piece.shape == CONVEX:
            corners = np.array(piece.vertices).T
            out = library.max(sum(a[..., None] * library.asarray(corners[i], a.dtype) for i, a in enumerate(along)), -1)
        else:
            half = library.asarray(piece.half_size, direction.dtype)
            out = PRIMITIVES[piece.shape].reach(library.stack(along, axis=-1), half, library)
        values.append(-(centre + out))
    return -_least(values, library)


def inside(
    compound: Compound, points: Float[np.ndarray, "*batch 3"], margin: float = 0.0
) -> Bool[np.ndarray, "*batch"]:
    """Which points in the body's frame are in the body, deeper than a margin [m]."""
    return distance(compound, [points[..., i] for i in range(3)], np) < -margin
