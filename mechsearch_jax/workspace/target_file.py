"""Files of targets: a mesh, or a body as in a scenario file, without its place."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, read_json
from mechsearch_jax.shapes.compound import CONVEX, Piece
from mechsearch_jax.workspace.compound_file import is_compound, parse_compound
from mechsearch_jax.workspace.json_checks import check_norm, numbers
from mechsearch_jax.workspace.target import Target

# The key that says how the body has to be turned to stand upright.
TURN = "quaternion"


def load_target(path: PathLike, scale: float = 1.0) -> Target:
    """The target that a file describes, with the usual candidate poses.

    A JSON file holds a body of a scenario file: `pieces` or `mesh` with `density` and `friction`, perhaps `color` and
    `scale`, and no place; `quaternion` turns it upright, z up, if it is not already. Any other file is a mesh, z up.

    Args:
      path: of the file. For meshes see `meshes.convex_pieces`.
      scale: metres per unit of a mesh; in a JSON file that is a key.

    Raises:
      InputError: the file cannot be read, holds something else, or no target can be made of it.
    """
    file = Path(path)
    if file.suffix.lower() != ".json":
        return Target.from_mesh(file, scale)
    value = read_json(file)
    if not is_compound(value):
        raise InputError(f"{file}: must be a JSON object with pieces or mesh, density and friction")
    if scale != 1.0:
        raise InputError(f"{file}: a scale is for a mesh file; write it into this file, beside mesh")
    turn = Rotation.identity()
    if TURN in value:
        quaternion = numbers(value[TURN], 4, f"{file}: {TURN}")
        check_norm(quaternion, f"{file}: {TURN}")
        turn = Rotation.from_quat(quaternion, scalar_first=True)
    body = {key: entry for key, entry in value.items() if key != TURN}
    compound = parse_compound(body, (), str(file), file.parent)
    pieces = [_turned(piece, turn) for piece in compound.pieces]
    return Target.from_parts(pieces, compound.density, compound.friction)


def _turned(piece: Piece, turn: Rotation) -> Piece:
    """A piece in a frame that is turned about the body's origin; a polyhedron has no rotation of its own."""
    if turn.magnitude() == 0.0:
        return piece
    moved = dataclasses.replace(piece, position=_rounded(turn.apply(piece.position)))
    if piece.shape == CONVEX:
        return dataclasses.replace(moved, vertices=tuple(map(_rounded, turn.apply(piece.vertices))))
    own = Rotation.from_quat(piece.quaternion, scalar_first=True)
    return dataclasses.replace(moved, quaternion=_rounded((turn * own).as_quat(scalar_first=True)))


def _rounded(values: np.ndarray) -> Any:
    return tuple(round(float(v), 9) + 0.0 for v in values)
