"""Compounds: rigid bodies of several convex pieces, each a primitive, a cone frustum or a convex polyhedron.

A body's frame has its origin at the centre of mass (`centred`). All volumes and masses are sums over the pieces: where
pieces overlap, matter counts twice, as in MuJoCo.

MuJoCo has no cone frustums, and a mesh would have to be compiled for every size. So physics, camera and volumes all
take one, about its third axis, for the same stack of cylinders.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mechsearch_jax.shapes.primitives import PRIMITIVES

if TYPE_CHECKING:
    import trimesh

# Name of the shape of bodies that are compounds, and of pieces that are cone frustums and convex polyhedra.
COMPOUND, FRUSTUM, CONVEX = "compound", "frustum", "convex"
# The radius of a frustum's disc differs by about the first from its neighbours' [m]; it has at most so many.
DISC_STEP, MOST_DISCS = 2e-3, 6
# Code of convex polyhedra among the kinds of pieces.
CONVEX_CODE = len(PRIMITIVES)
# Most solids of a body once frustums are stacks of discs; most vertices of a convex polyhedron.
MOST_SOLIDS, MOST_VERTICES = 16, 48
# Least volume of a convex polyhedron [m3].
LEAST_VOLUME = 1e-9
# A centre of mass that is as near as this to the origin is taken for it [m].
CENTRED = 1e-6
# Digits to which poses and vertices are rounded when a body is centred [m].
DIGITS = 8
IDENTITY = (1.0, 0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class Piece:
    """A convex solid of a compound.

    Attributes:
      shape: name of a primitive, "frustum", or "convex".
      half_size: half-extents along its axes [m]; of a frustum its radii at the lower and the upper end and half its
        height; of a convex polyhedron zeros.
      position: of its centre in the body's frame [m].
      quaternion: (w, x, y, z) of its rotation in the body's frame, a unit quaternion.
      vertices: of a convex polyhedron, in the piece's frame [m].
    """

    shape: str
    half_size: tuple[float, float, float]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = IDENTITY
    vertices: tuple[tuple[float, float, float], ...] = ()

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """`R_body_piece`."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(self.quaternion, scalar_first=True).as_matrix()

    def in_body(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points in the body's frame, from the piece's [m]."""
        return points @ self.rotation.T + np.array(self.position)


@dataclasses.dataclass(frozen=True)
class Compound:
    """What a body of several pieces is made of.

    Attributes:
      pieces: at least one.
      density: [kg/m3].
      friction: coefficient of sliding friction against anything that is not rougher.
      colour: red, green and blue, 0 to 1; None for the colour of the body's slot.
    """

    pieces: tuple[Piece, ...]
    density: float
    friction: float
    colour: tuple[float, float, float] | None = None


class Inertial(NamedTuple):
    """Mass properties.

    Attributes:
      mass: [kg].
      centre: of mass, in the body's frame [m], shape (3,).
      moments: principal moments of inertia [kg m2], shape (3,).
      rotation: of the principal axes in the body's frame, shape (3, 3).
    """

    mass: float
    centre: Float[np.ndarray, " 3"]
    moments: Float[np.ndarray, " 3"]
    rotation: Float[np.ndarray, "3 3"]


def solids(pieces: Sequence[Piece]) -> list[Piece]:
    """The pieces with every frustum as its stack of discs: primitives and convex polyhedra alone."""
    return [solid for piece in pieces for solid in _solids(piece)]


def _solids(piece: Piece) -> list[Piece]:
    if piece.shape != FRUSTUM:
        return [piece]
    axis, centre = piece.rotation[:, 2], np.array(piece.position)
    return [
        Piece("cylinder", (radius, radius, half), _three(centre + height * axis), piece.quaternion)
        for height, radius, half in discs(piece.half_size)
    ]


def discs(half_size: Sequence[float], count: int | None = None) -> list[tuple[float, float, float]]:
    """The stack of a frustum: height of the centre, radius and half the height of each disc, from below [m].

    Every disc has the volume of its part of the frustum.

    Args:
      half_size: radii at the lower and the upper end, and half the height [m].
      count: number of discs; from `DISC_STEP` and `MOST_DISCS` if None.
    """
    low, high, half = half_size
    count = count or min(max(math.ceil(abs(high - low) / DISC_STEP), 1), MOST_DISCS)
    ends = [low + (high - low) * i / count for i in range(count + 1)]
    return [
        (half * ((2 * i + 1) / count - 1), math.sqrt((a * a + a * b + b * b) / 3), half / count)
        for i, (a, b) in enumerate(itertools.pairwise(ends))
    ]


def _three(values: Sequence[float] | np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def hull(piece: Piece) -> trimesh.Trimesh:
    """The surface of a convex polyhedron in the piece's frame [m]."""
    import trimesh

    return trimesh.convex.convex_hull(np.array(piece.vertices))


def hull_volume(points: Float[np.ndarray, "n 3"]) -> float:
    """Volume of the convex hull of points [m3]; 0 where they are in a plane."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(points).volume)
    except (QhullError, ValueError):
        return 0.0


def mesh(piece: Piece) -> trimesh.Trimesh:
    """The surface of a solid in the body's frame [m]; round ones have flat faces."""
    surface = hull(piece) if piece.shape == CONVEX else PRIMITIVES[piece.shape].mesh(piece.half_size)
    turned = surface.copy()
    turned.vertices = piece.in_body(np.asarray(surface.vertices))
    return turned


def faces(piece: Piece) -> Float[np.ndarray, "n 4"]:
    """The half-spaces n . x <= d of a convex polyhedron in its own frame, as rows (n, d)."""
    from scipy.spatial import ConvexHull

    rows = np.unique(np.round(ConvexHull(np.array(piece.vertices)).equations, 9), axis=0)
    return np.column_stack([rows[:, :3], -rows[:, 3]])


def inside(piece: Piece, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Which points in the body's frame are in a solid [m]."""
    local = (points - np.array(piece.position)) @ piece.rotation
    if piece.shape == CONVEX:
        rows = faces(piece)
        return np.all(local @ rows[:, :3].T <= rows[:, 3], axis=1)
    return PRIMITIVES[piece.shape].inside(local, np.array(piece.half_size), np)


def _weight(piece: Piece) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume of a solid, its centre of mass in the body's frame, and its inertia about that at density 1."""
    if piece.shape == CONVEX:
        surface = hull(piece)
        volume, centre, inertia = float(surface.volume), np.asarray(surface.center_mass), surface.moment_inertia
        return volume, piece.in_body(centre), piece.rotation @ np.asarray(inertia) @ piece.rotation.T
    primitive, half = PRIMITIVES[piece.shape], np.array(piece.half_size)
    volume = float(primitive.volume(half, np))
    moments = np.diag(volume * np.asarray(primitive.moments(half, np)))
    return volume, np.array(piece.position), piece.rotation @ moments @ piece.rotation.T


@functools.lru_cache(maxsize=4096)
def inertial(compound: Compound) -> Inertial:
    """Mass properties of a compound; its arrays must not be changed."""
    weights = [_weight(solid) for solid in solids(compound.pieces)]
    volume = sum(v for v, _, _ in weights)
    centre = sum(v * c for v, c, _ in weights) / volume
    whole = np.zeros((3, 3))
    for v, c, inertia in weights:
        apart = c - centre
        whole += inertia + v * (apart @ apart * np.eye(3) - np.outer(apart, apart))
    moments, axes = np.linalg.eigh(compound.density * whole)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return Inertial(compound.density * volume, np.asarray(centre), moments, axes)


def centred(compound: Compound) -> tuple[Compound, Float[np.ndarray, " 3"]]:
    """The compound in a frame whose origin is the centre of mass, and where that is in the old frame [m].

    A compound that is centred already stays exactly as it is.
    """
    centre = inertial(compound).centre
    if np.abs(centre).max() <= CENTRED:
        return compound, np.zeros(3)
    moved = tuple(
        dataclasses.replace(piece, position=_rounded(np.array(piece.position) - centre)) for piece in compound.pieces
    )
    return dataclasses.replace(compound, pieces=moved), centre


def _rounded(values: np.ndarray) -> tuple[float, float, float]:
    return _three([round(float(v), DIGITS) + 0.0 for v in values])


def scaled(compound: Compound, factor: float) -> Compound:
    """The compound with all lengths times a factor."""

    def times(values: tuple[float, float, float]) -> tuple[float, float, float]:
        return _rounded(factor * np.array(values))

    pieces = tuple(
        dataclasses.replace(
            piece,
            half_size=times(piece.half_size),
            position=times(piece.position),
            vertices=tuple(times(vertex) for vertex in piece.vertices),
        )
        for piece in compound.pieces
    )
    return dataclasses.replace(compound, pieces=pieces)


@functools.lru_cache(maxsize=4096)
def surface_points(compound: Compound) -> Float[np.ndarray, "n 3"]:
    """Points whose convex hull contains the compound, in the body's frame [m]; must not be changed."""
    points = []
    for solid in solids(compound.pieces):
        corners = np.array(solid.vertices) if solid.shape == CONVEX else _around(solid)
        points.append(solid.in_body(corners))
    return np.concatenate(points)


def _around(solid: Piece) -> Float[np.ndarray, "n 3"]:
    """Points around a primitive, in its frame: those of its mesh, moved outwards until their hull contains it."""
    primitive = PRIMITIVES[solid.shape]
    vertices = np.asarray(primitive.mesh(solid.half_size).vertices)
    if solid.shape == "box":
        return vertices
    if solid.shape == "cylinder":
        return vertices * [1.0 / math.cos(math.pi / 32), 1.0 / math.cos(math.pi / 32), 1.0]
    return vertices * 1.02


def half_extents(compound: Compound) -> tuple[float, float, float]:
    """Half-extents of the smallest box about the body's origin, along its axes, that contains the compound [m]."""
    return _three([round(float(v), DIGITS) for v in np.abs(surface_points(compound)).max(axis=0)])
