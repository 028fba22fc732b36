"""The geometry of a compound as the union of its convex solids, for NumPy or JAX, and on a grid; without JAX.

Distances and cuts are the least of the solids', support functions the largest. Outside of a solid with edges a distance
may be less than the true one, but not on its surface or inside: that of a convex polyhedron is to the farthest of the
planes of its faces, that of an ellipsoid is right to first order.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mechsearch_jax.shapes.compound import CONVEX, Compound, Piece, faces, solids, surface_points
from mechsearch_jax.shapes.primitives import PRIMITIVES

# A solid is shrunk to no less than this share of its half-extents.
LEAST_SHARE = 0.5
# Beyond every plane of a body [m]: the planes that fill up the rows of polyhedra with fewer faces.
FAR = 1e3
# Spacing of the grid, larger for bodies of more cells than the second number, and the rim around the body [m].
STEP, CELLS, RIM = 0.002, 150_000, 0.006
# Points whose distances are computed at once.
BLOCK = 4096


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
    normal, offset, depth = np.zeros((*shape, 3)), np.full(shape, FAR), np.full(shape, FAR)
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


def _fold(step: Callable[[Any, Any], Any], start: Any, rows: tuple[Any, ...], library: Any) -> Any:
    """A step over rows, one after the other, such as over the faces of a polyhedron.

    Everything in a step has the axes of the points or rays: on a CPU that is thirty times as fast as a reduction over
    the faces for each of them.

    Args:
      step: of a state and a row of each array.
      start: the first state.
      rows: arrays (n, ...).
      library: of the arrays.
    """
    if library is np:
        state = start
        for row in zip(*rows, strict=True):
            state = step(state, row)
        return state
    # Only for arrays of JAX, which is loaded then.
    import jax

    cast = tuple(library.asarray(row, library.float32) for row in rows)
    return jax.lax.scan(lambda state, row: (step(state, row), None), start, cast)[0]


def _product(normal: Any, vector: Sequence[Any]) -> Any:
    return vector[0] * normal[0] + vector[1] * normal[1] + vector[2] * normal[2]


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
        values.append(_beyond(rows, point, library))
    return _least(values, library)


def cut(
    compound: Compound,
    origin: Sequence[Float[Any, "*#rays"]],
    direction: Sequence[Float[Any, "*#rays"]],
    grown: float,
    library: Any,
) -> Float[Any, "*rays"]:
    """Where rays from outside enter the body, as `Primitive.cut`; all solids are larger by `grown` [m]."""
    values = []
    for piece in _primitives(compound):
        start, along = _local(origin, piece, True), _local(direction, piece, False)
        values.append(PRIMITIVES[piece.shape].cut(start, along, _half(piece, grown), library))
    if (rows := polyhedra(compound)) is not None:
        values.append(_entered(rows, _offset(rows, grown), origin, direction, library))
    return _least(values, library)


def _beyond(rows: Polyhedra, point: Sequence[Any], library: Any) -> Any:
    """How far points are beyond the farthest plane of a polyhedron [m], at least of all polyhedra."""

    def of_face(most, face):
        normal, offset = face
        return library.maximum(most, _product(normal, point) - offset)

    def of_polyhedron(least, faces):
        most = library.full(point[0].shape, -library.inf, point[0].dtype)
        return library.minimum(least, _fold(of_face, most, faces, library))

    start = library.full(point[0].shape, library.inf, point[0].dtype)
    return _fold(of_polyhedron, start, (rows.normal, rows.offset), library)


def _entered(rows: Polyhedra, offset: np.ndarray, origin: Sequence[Any], direction: Sequence[Any], library: Any) -> Any:
    """Where rays from outside enter the first polyhedron; infinite for misses."""
    shape = np.broadcast_shapes(origin[0].shape, direction[0].shape)

    def full(value: float) -> Any:
        return library.full(shape, value, direction[0].dtype)

    def of_face(state, face):
        normal, offset = face
        return crossed(normal, offset, origin, direction, state, library)

    def of_polyhedron(first, faces):
        near, far = _fold(of_face, (full(library.inf), full(0.0)), faces, library)
        return library.minimum(first, entry(near, far, library))

    return _fold(of_polyhedron, full(library.inf), (rows.normal, offset), library)


def crossed(normal: Any, offset: Any, origin: Sequence[Any], direction: Sequence[Any], state: Any, library: Any) -> Any:
    """The state of rays that meet the faces of a polyhedron one after the other, after one more face n . x <= d.

    Faces are compared by the inverse of the ray parameter, which is finite for rays along them: a ray is inside after
    it has crossed all planes that its origin is beyond, and before it crosses any other. The state begins as (infinity,
    0): the least inverse of the former, and the largest of the latter.
    """
    near, far = state
    gap = offset - _product(normal, origin)
    inverse = _product(normal, direction) / library.where(library.abs(gap) < 1e-9, 1e-9, gap)
    before = gap < 0.0
    near = library.where(before, library.minimum(near, inverse), near)
    return near, library.where(before, far, library.maximum(far, inverse))


def entry(near: Any, far: Any, library: Any) -> Any:
    """Where rays enter a polyhedron, from their state after its last face, see `crossed`; infinite for misses."""
    hit = (near > 0.0) & (near >= far) & library.isfinite(near)
    return library.where(hit, 1.0 / library.where(hit, near, 1.0), library.inf)


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
    values = [distance(compound, list(flat[i : i + BLOCK].T), np) for i in range(0, len(flat), BLOCK)]
    return Field(low, step, np.concatenate(values).reshape(points.shape[:-1]))
