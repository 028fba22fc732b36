"""Worlds of which some bodies are compounds of several pieces.

A world without compounds stays a plain `World`, so that its programs stay what they are.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial import HalfspaceIntersection
from scipy.spatial.transform import Rotation

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.shapes import PRIMITIVES
from mechsearch_jax.shapes.compound import (
    COMPOUND,
    CONVEX,
    CONVEX_CODE,
    MOST_SOLIDS,
    MOST_VERTICES,
    Compound,
    Piece,
    faces,
    half_extents,
    inertial,
    solids,
)
from mechsearch_jax.shapes.parts import part_rows
from mechsearch_jax.workspace.scenario import Body, pieces_of

# Most faces of a convex polyhedron: triangles between its vertices.
FACES = 2 * MOST_VERTICES - 4
# What fills unused rows of arrays [m].
_NOTHING = 1e-3


class Solids(PyTreeNode):
    """The solids of bodies, in the bodies' frames; leading axes (..., 9, 16).

    Attributes:
      kind: code of a primitive, or `CONVEX_CODE`, int32.
      half_size: half-extents along a primitive's axes [m], shape (..., 9, 16, 3).
      position: of the centre [m], shape (..., 9, 16, 3).
      rotation: `R_body_solid`, shape (..., 9, 16, 3, 3).
      faces: half-spaces of a convex polyhedron, rows (n, d) with n . x <= d in its frame; none in a world without
        such, shape (..., 9, 16, F, 4).
      valid: whether the row holds a solid.
    """

    kind: jax.Array
    half_size: jax.Array
    position: jax.Array
    rotation: jax.Array
    faces: jax.Array
    valid: jax.Array


class Matter(PyTreeNode):
    """What bodies are made of; leading axes (..., 9).

    Attributes:
      mass: [kg].
      moments: principal moments of inertia [kg m2], shape (..., 9, 3).
      axes: rotation of the principal axes in the body's frame, shape (..., 9, 3, 3).
      friction: coefficient of sliding friction.
      density: [kg/m3].
      colour: red, green and blue, 0 to 1; NaN where the colour is the slot's, shape (..., 9, 3).
    """

    mass: jax.Array
    moments: jax.Array
    axes: jax.Array
    friction: jax.Array
    density: jax.Array
    colour: jax.Array


class Compounds(PyTreeNode):
    """What a `World` of compounds knows beside a plain one.

    Attributes:
      compound: which bodies are compounds, shape (..., 9); the others have a single solid.
      solids: of all bodies.
      matter: of all bodies.
      parts: the superquadrics that describe each body to the planner, in its frame, leading axes (..., 9, 4).
    """

    compound: jax.Array
    solids: Solids
    matter: Matter
    parts: Superquadrics


def compounds_of(bodies: Sequence[Body | None]) -> Compounds:
    """What the bodies in a world's slots are made of.

    Args:
      bodies: in their slots; None for an empty one.

    Raises:
      InputError: a plain body is of a shape that is no primitive.
    """
    made = [None if body is None else pieces_of(body) for body in bodies]
    wide = any(piece.shape == CONVEX for one in made if one for piece in one.pieces)
    rows = [_body_solids(one, FACES if wide else 0) for one in made]
    return Compounds(
        compound=jax.device_put(np.array([body is not None and body.compound is not None for body in bodies])),
        solids=_stacked(rows),
        matter=_stacked([_matter(one) for one in made]),
        parts=_stacked([_parts(one) for one in made]),
    )


def _stacked(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jax.device_put(np.stack(leaves)), *trees)


@functools.lru_cache(maxsize=1024)
def _body_solids(compound: Compound | None, sides: int) -> Any:
    """The rows of a body's solids, as a `Solids` of NumPy arrays, which must not be changed."""
    rows = [] if compound is None else solids(compound.pieces)
    half = np.full((MOST_SOLIDS, 3), _NOTHING, np.float32)
    kind, position = np.zeros(MOST_SOLIDS, np.int32), np.zeros((MOST_SOLIDS, 3), np.float32)
    rotation = np.tile(np.eye(3, dtype=np.float32), (MOST_SOLIDS, 1, 1))
    planes = np.zeros((MOST_SOLIDS, sides, 4), np.float32)
    for i, solid in enumerate(rows):
        position[i], rotation[i] = solid.position, solid.rotation
        if solid.shape == CONVEX:
            own = faces(solid)
            kind[i], half[i] = CONVEX_CODE, np.abs(np.array(solid.vertices)).max(axis=0)
            planes[i] = own[np.minimum(np.arange(sides), len(own) - 1)]
        else:
            kind[i], half[i] = PRIMITIVES[solid.shape].code, solid.half_size
    return Solids(kind, half, position, rotation, planes, np.arange(MOST_SOLIDS) < len(rows))  # pyright: ignore


@functools.lru_cache(maxsize=1024)
def _matter(compound: Compound | None) -> Any:
    if compound is None:
        numbers = (_NOTHING, [_NOTHING] * 3, np.eye(3), 0.0, 1.0, [np.nan] * 3)
    else:
        weight, colour = inertial(compound), compound.colour or [np.nan] * 3
        numbers = (weight.mass, weight.moments, weight.rotation, compound.friction, compound.density, colour)
    return Matter(*(np.asarray(value, np.float32) for value in numbers))  # pyright: ignore[reportArgumentType]


@functools.lru_cache(maxsize=1024)
def _parts(compound: Compound | None) -> Any:
    return Superquadrics(*part_rows(compound))  # pyright: ignore[reportArgumentType]


def body_of(host: Compounds, slot: int, pose: tuple[Sequence[float], Sequence[float]]) -> Body:
    """A compound in a slot, made again of what a world knows of it.

    Frustums come back as their discs.

    Args:
      host: as NumPy arrays, without further leading axes.
      slot: of a compound.
      pose: position [m] and quaternion (w, x, y, z).
    """
    rows: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[slot], host.solids)
    pieces = tuple(_piece(jax.tree.map(lambda leaf, i=i: leaf[i], rows)) for i in np.flatnonzero(rows.valid))
    matter: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[slot], host.matter)
    colour = None if np.isnan(matter.colour).any() else tuple(float(c) for c in matter.colour)
    compound = Compound(pieces, float(matter.density), float(matter.friction), colour)  # pyright: ignore
    return body_at(compound, pose)


def body_at(compound: Compound, pose: tuple[Sequence[float], Sequence[float]]) -> Body:
    """The body of a compound at a pose: position [m] and quaternion (w, x, y, z)."""
    position, quaternion = (tuple(float(v) for v in values) for values in pose)
    return Body(COMPOUND, half_extents(compound), position, quaternion, compound)  # pyright: ignore


def _piece(row: Any) -> Piece:
    """The piece of a single row of `Solids`."""
    quaternion = tuple(Rotation.from_matrix(row.rotation).as_quat(scalar_first=True).tolist())
    position = tuple(row.position.tolist())
    if row.kind != CONVEX_CODE:
        name = list(PRIMITIVES)[row.kind]
        return Piece(name, tuple(row.half_size.tolist()), position, quaternion)
    halves = np.column_stack([row.faces[:, :3], -row.faces[:, 3]]).astype(float)
    corners: Float[np.ndarray, "n 3"] = np.unique(
        np.round(HalfspaceIntersection(halves, np.zeros(3)).intersections, 7), axis=0
    )
    vertices = tuple((x, y, z) for x, y, z in corners.tolist())
    return Piece(CONVEX, (0.0, 0.0, 0.0), position, quaternion, vertices)


def with_polyhedra(compounds: Compounds) -> Compounds:
    """The same with room for convex polyhedra, so that worlds with and without such can be stacked."""
    shape = compounds.solids.faces.shape
    if shape[-2]:
        return compounds
    room = jax.device_put(np.zeros((*shape[:-2], FACES, 4), np.float32))
    return dataclasses.replace(compounds, solids=dataclasses.replace(compounds.solids, faces=room))
