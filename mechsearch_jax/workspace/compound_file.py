"""Bodies of several pieces in scenario files (version 2): read, checked and written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mechsearch_jax.runtime.errors import InputError, shown
from mechsearch_jax.shapes import PRIMITIVES, frustum
from mechsearch_jax.shapes.compound import (
    CONVEX,
    IDENTITY,
    LEAST_VOLUME,
    MOST_SOLIDS,
    MOST_VERTICES,
    Compound,
    Piece,
    hull_volume,
    solids,
)
from mechsearch_jax.shapes.meshes import convex_pieces
from mechsearch_jax.workspace.json_checks import check_keys, check_norm, number, numbers

# Bounds of a piece's half-extents [m], of densities [kg/m3], of friction, and of the scale of meshes [m].
LEAST, LARGEST = 1e-3, 0.5
DENSITIES = (1.0, 25_000.0)
FRICTIONS = (0.0, 5.0)
SCALES = (1e-6, 1e3)
_SHAPES = (*PRIMITIVES, frustum.NAME, CONVEX)
_SHARED = ("density", "friction")


def is_compound(value: Any) -> bool:
    """Whether a body of a file says what pieces it is made of, or in which mesh they are."""
    return isinstance(value, dict) and bool({"pieces", "mesh"} & set(value))


def parse_compound(value: dict[str, Any], pose: Sequence[str], where: str, folder: Path) -> Compound:
    """What a body of a scenario file is made of, in the file's frame of the body.

    Args:
      value: the body, parsed.
      pose: the body's other keys, which are not read.
      where: how messages name the body.
      folder: from which paths of meshes count.

    Raises:
      InputError: a key is unknown or missing, a number is out of range, or a mesh cannot be used.
    """
    source, more = ("mesh", ("color", "scale")) if "mesh" in value else ("pieces", ("color",))
    check_keys(value, (source, *_SHARED, *pose), where, more)
    pieces = _mesh_pieces(value, where, folder) if source == "mesh" else _pieces(value["pieces"], f"{where}.pieces")
    colour = None
    if "color" in value:
        colour = numbers(value["color"], 3, f"{where}.color")
        if not all(0.0 <= c <= 1.0 for c in colour):
            raise InputError(f"{where}.color: {list(colour)} must be red, green and blue from 0 to 1")
    density = number(value["density"], *DENSITIES, "kg/m3", f"{where}.density")
    friction = number(value["friction"], *FRICTIONS, "", f"{where}.friction")
    return Compound(pieces, density, friction, colour)  # pyright: ignore[reportArgumentType]


def _mesh_pieces(value: dict[str, Any], where: str, folder: Path) -> tuple[Piece, ...]:
    if not isinstance(value["mesh"], str) or not value["mesh"]:
        raise InputError(f"{where}.mesh: {shown(value['mesh'])} must be the path of a mesh file")
    scale = number(value.get("scale", 1.0), *SCALES, "metres per unit of the mesh", f"{where}.scale")
    pieces = convex_pieces(folder / value["mesh"], scale, f"{where}.mesh")
    volumes = [hull_volume(np.array(piece.vertices)) for piece in pieces]
    small = sum(volume < LEAST_VOLUME for volume in volumes)
    if 0 < small < len(pieces):
        raise InputError(
            f"{where}.mesh: {small} of its {len(pieces)} loose parts have less than {LEAST_VOLUME * 1e9:g} mm3, the"
            f" largest {max(volumes) * 1e6:.3g} cm3; delete the small ones from the mesh"
        )
    for piece in pieces:
        _check_polyhedron(np.array(piece.vertices), f"{where}.mesh", "give its unit as scale, such as 0.001")
    return pieces


def _pieces(value: Any, where: str) -> tuple[Piece, ...]:
    if not isinstance(value, list) or not value:
        raise InputError(f"{where}: must be a list of at least one piece")
    pieces = tuple(_piece(piece, f"{where}[{i}]") for i, piece in enumerate(value))
    if (count := len(solids(pieces))) > MOST_SOLIDS:
        raise InputError(
            f"{where}: {count} solids are too many, at most {MOST_SOLIDS} can be simulated; a frustum counts as up to"
            f" {frustum.MOST}"
        )
    return pieces


def _piece(value: Any, where: str) -> Piece:
    shape = value.get("shape") if isinstance(value, dict) else None
    if shape == CONVEX:
        return _polyhedron(value, where)
    check_keys(value, ("shape", "half_size", "position", "quaternion"), where)
    if shape not in _SHAPES:
        raise InputError(f"{where}.shape: {shown(shape)} is unknown; use {', '.join(_SHAPES)}")
    half_size = numbers(value["half_size"], 3, f"{where}.half_size")
    if not all(LEAST <= half <= LARGEST for half in half_size):
        raise InputError(f"{where}.half_size: {list(half_size)} must be lengths from {LEAST} to {LARGEST} m")
    primitive = PRIMITIVES.get(shape)
    if primitive is not None and (fault := primitive.fault(half_size)):
        raise InputError(f"{where}.half_size: {fault}")
    quaternion = numbers(value["quaternion"], 4, f"{where}.quaternion")
    check_norm(quaternion, f"{where}.quaternion")
    position = _place(value["position"], f"{where}.position")
    return Piece(shape, half_size, position, quaternion)  # pyright: ignore[reportArgumentType]


def _place(value: Any, where: str) -> tuple[float, ...]:
    position = numbers(value, 3, where)
    if max(map(abs, position)) > 2 * LARGEST:
        raise InputError(f"{where}: {list(position)} is farther than {2 * LARGEST} m from the body's origin")
    return position


def _polyhedron(value: dict[str, Any], where: str) -> Piece:
    check_keys(value, ("shape", "vertices", "position"), where)
    rows = value["vertices"]
    if not isinstance(rows, list) or not 4 <= len(rows) <= MOST_VERTICES:
        raise InputError(f"{where}.vertices: must be a list of 4 to {MOST_VERTICES} points")
    vertices = tuple(_place(row, f"{where}.vertices[{i}]") for i, row in enumerate(rows))
    _check_polyhedron(np.array(vertices), f"{where}.vertices", "give other points")
    position = _place(value["position"], f"{where}.position")
    return Piece(CONVEX, (0.0, 0.0, 0.0), position, IDENTITY, vertices)  # pyright: ignore[reportArgumentType]


def _check_polyhedron(vertices: np.ndarray, where: str, remedy: str) -> None:
    """Raise InputError unless points span a solid of a sensible size."""
    extent = float(np.ptp(vertices, axis=0).max())
    if extent > 2 * LARGEST:
        raise InputError(f"{where}: a piece is {extent:.3g} m long, more than {2 * LARGEST}; {remedy}")
    if hull_volume(vertices) < LEAST_VOLUME:
        raise InputError(f"{where}: a piece is flat, or has less than {LEAST_VOLUME * 1e9:g} mm3; {remedy}")


def format_compound(compound: Compound) -> dict[str, Any]:
    """The keys of a compound in a scenario file; a mesh is written as its convex pieces."""
    value: dict[str, Any] = {
        "pieces": [_format_piece(piece) for piece in compound.pieces],
        "density": compound.density,
        "friction": compound.friction,
    }
    return value if compound.colour is None else {**value, "color": list(compound.colour)}


def _format_piece(piece: Piece) -> dict[str, Any]:
    if piece.shape == CONVEX:
        return {"shape": CONVEX, "vertices": [list(v) for v in piece.vertices], "position": list(piece.position)}
    names = ("shape", "half_size", "position", "quaternion")
    return {name: getattr(piece, name) for name in names}
