"""Scenarios: the objects on the shelf at the start of an episode, and their files."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.resources
import json
import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.bodies import bodies_of
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.runtime.errors import InputError, shown
from mechsearch_jax.runtime.files import read_json, replacing
from mechsearch_jax.shapes import PRIMITIVES, shape_of
from mechsearch_jax.shapes.compound import (
    COMPOUND,
    CONVEX,
    FRUSTUM,
    IDENTITY,
    LEAST_VOLUME,
    MOST_DISCS,
    MOST_SOLIDS,
    MOST_VERTICES,
    Compound,
    Piece,
    centred,
    half_extents,
    hull_volume,
    solids,
)
from mechsearch_jax.shapes.meshes import convex_pieces
from mechsearch_jax.shapes.parts import part_rows
from mechsearch_jax.workspace.shelf import Shelf

# How far the length of a unit quaternion may be from 1.
UNIT = 1e-3
# Bounds of a piece's half-extents [m], of densities [kg/m3], of friction, and of the scale of meshes [m].
LEAST, LARGEST = 1e-3, 0.5
DENSITIES = (1.0, 25_000.0)
FRICTIONS = (0.0, 5.0)
SCALES = (1e-6, 1e3)
_SHAPES = (*PRIMITIVES, FRUSTUM, CONVEX)
_SHARED = ("density", "friction")
FORMAT = "mechsearch-scenario"
# Version 2 has bodies of several pieces; what needs none is written as version 1.
VERSION, COMPOUND_VERSION = 1, 2
MAX_OBJECTS = 8
# Enough for thousands of scenes: 48 bits.
HASH_DIGITS = 12
# Names are also file names.
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}")
# Smallest half-extent; smaller ones lead to numerical problems [m].
LEAST_HALF_SIZE = 5e-4

_POSE_KEYS = ("position", "quaternion")
_BODY_KEYS = ("shape", "half_size", *_POSE_KEYS)


def numbers(value: Any, count: int, where: str) -> tuple[float, ...]:
    """A list of finite numbers.

    Raises:
      InputError: it is none, or has another length.
    """
    number = isinstance(value, list) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    if not number or len(value) != count:
        raise InputError(f"{where}: must be a list of {count} numbers")
    try:
        floats = tuple(float(v) for v in value)
    except OverflowError:
        raise InputError(f"{where}: holds a number that is too large; every number must be finite") from None
    if not all(math.isfinite(v) for v in floats):
        raise InputError(f"{where}: holds NaN or an infinite number; every number must be finite")
    return floats


def number(value: Any, low: float, high: float, unit: str, where: str) -> float:
    """A number in a range.

    Raises:
      InputError: it is none, or out of the range.
    """
    if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
        raise InputError(f"{where}: {shown(value)} must be a number from {low:g} to {high:g}{unit and ' '}{unit}")
    return float(value)


def check_norm(quaternion: Sequence[float], where: str) -> None:
    """Check that a quaternion (w, x, y, z) has length 1.

    Raises:
      InputError: it has not.
    """
    if abs(math.hypot(*quaternion) - 1.0) > UNIT:
        raise InputError(f"{where}: its norm is {math.hypot(*quaternion):.4g}; it must be 1 (w, x, y, z)")


def check_keys(value: Any, keys: Sequence[str], where: str, optional: Sequence[str] = ()) -> None:
    """Check that a value is a JSON object with these keys.

    Raises:
      InputError: it is none, or a key is unknown or missing.
    """
    known = (*keys, *optional)
    if not isinstance(value, dict):
        raise InputError(f"{where}: must be a JSON object with the keys {', '.join(known)}")
    for unknown in [k for k in value if k not in known]:
        raise InputError(f"{where}: unknown key {shown(unknown)}; known are {', '.join(known)}")
    for missing in [k for k in keys if k not in value]:
        raise InputError(f'{where}: key "{missing}" is missing')


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
            f" {MOST_DISCS}"
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


@dataclasses.dataclass(frozen=True)
class Body:
    """A rigid body on the shelf.

    Attributes:
      shape: name of its shape, such as "box" or "cylinder"; "compound" of a body of several pieces.
      half_size: half-extents along its axes [m]; for a cylinder (radius, radius, half its height), for a compound those
        of the smallest box about its centre of mass.
      position: of its centre in the world [m]; of a compound its centre of mass.
      quaternion: (w, x, y, z) of its rotation in the world, a unit quaternion.
      compound: what a compound is made of; None for any other body.
    """

    shape: str
    half_size: tuple[float, float, float]
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    compound: Compound | None = None


@dataclasses.dataclass(frozen=True)
class Scenario:
    """The start of an episode.

    Attributes:
      name: in results.
      objects: the surrounding objects, which the robot may move.
      target: the body that the robot searches.
    """

    name: str
    objects: tuple[Body, ...]
    target: Body

    @property
    def content_hash(self) -> str:
        """Twelve hexadecimal digits of a hash of every shape, size and pose, in the objects' order.

        The name and the format of numbers in the file do not count. The order of the objects does, since random numbers
        depend on it.
        """
        bodies = [_content(body) for body in (*self.objects, self.target)]
        return hashlib.sha256(json.dumps(bodies, allow_nan=False).encode()).hexdigest()[:HASH_DIGITS]


def _content(body: Body) -> list[Any]:
    """Shape, size and pose of a body; of a compound all that it is made of."""
    if body.compound is None:
        return [body.shape, *(_plain(part) for part in (body.half_size, body.position, body.quaternion))]
    return [body.shape, *(_plain(part) for part in (format_compound(body.compound), body.position, body.quaternion))]


def _plain(value: Any) -> Any:
    """A value of JSON with floating-point numbers alone; adding 0 makes -0 the 0 that it equals."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value if isinstance(value, str) else float(value) + 0.0


def rotation_matrix(quaternion: Sequence[float] | Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z), which are normalised first; at most one leading axis."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.roll(np.asarray(quaternion, float), -1, axis=-1)).as_matrix()


def check_name(value: Any, where: str) -> None:
    """Check a scenario's name, which is also a file name.

    Raises:
      InputError: it is not a valid name.
    """
    if not isinstance(value, str) or not NAME.fullmatch(value):
        raise InputError(
            f'{where}: must be a text of 1 to 100 letters, digits, ".", "_" and "-", the first no "." or "-",'
            f" not {shown(value)}"
        )


def _body(value: Any, where: str, key: str, shelf: Shelf) -> Body:
    check_keys(value, _BODY_KEYS, f"{where}: {key}")
    where = f"{where}: {key}"
    shape = shape_of(value["shape"], f"{where}.shape")
    half_size = numbers(value["half_size"], 3, f"{where}.half_size")
    position, quaternion = _pose(value, where)
    if min(half_size) <= 0:
        raise InputError(f"{where}.half_size: {list(half_size)} must be positive lengths in metres")
    if fault := shape.fault(half_size):
        raise InputError(f"{where}.half_size: {fault}")
    _check_size(half_size, f"{where}.half_size", shelf)
    check_norm(quaternion, f"{where}.quaternion")
    _check_place(position, where, shelf)
    return Body(shape.name, half_size, position, quaternion)  # pyright: ignore[reportArgumentType]


def _compound_body(value: Any, where: str, key: str, shelf: Shelf, folder: Path) -> Body:
    """A body of several pieces, in the frame of its centre of mass."""
    where = f"{where}: {key}"
    compound, centre = centred(parse_compound(value, _POSE_KEYS, where, folder))
    position, quaternion = _pose(value, where)
    check_norm(quaternion, f"{where}.quaternion")
    half_size = half_extents(compound)
    _check_size(half_size, where, shelf)
    if centre.any():
        moved = rotation_matrix(quaternion) @ centre + position
        position = tuple(round(float(p), 9) for p in moved)
    _check_place(position, where, shelf)
    return Body(COMPOUND, half_size, position, quaternion, compound)  # pyright: ignore[reportArgumentType]


def _pose(value: Any, where: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return numbers(value["position"], 3, f"{where}.position"), numbers(value["quaternion"], 4, f"{where}.quaternion")


def _ranges(shelf: Shelf) -> tuple[tuple[float, float], ...]:
    return (shelf.front, shelf.back), (shelf.right, shelf.left), (shelf.board, shelf.ceiling)


def _check_size(half_size: tuple[float, ...], where: str, shelf: Shelf) -> None:
    widest = max(high - low for low, high in _ranges(shelf))
    if not all(LEAST_HALF_SIZE <= half <= widest for half in half_size):
        raise InputError(
            f"{where}: {list(half_size)} must be from {LEAST_HALF_SIZE} to {widest:g}, in metres, which no"
            " object on this shelf exceeds"
        )


def _check_place(position: tuple[float, ...], where: str, shelf: Shelf) -> None:
    for axis, p, (low, high) in zip("xyz", position, _ranges(shelf), strict=True):
        if not low <= p <= high:
            raise InputError(
                f"{where}.position: {axis} = {p:g} is off the board, which reaches from {low:g} to {high:g}"
            )


def parse_scenario(value: Any, where: str, shelf: Shelf | None = None, folder: Path | None = None) -> Scenario:
    """A scenario from parsed JSON.

    Args:
      value: the parsed file.
      where: how messages name the file.
      shelf: the shelf that the bodies must stand on; the default shelf if None.
      folder: from which paths of meshes count; the working folder if None.

    Raises:
      InputError: the format or version is another one; a key is unknown or missing; the name is invalid; a number is
        not finite; a size is out of range; a quaternion is not of unit length; a body is off the board; a mesh cannot
        be used.
    """
    shelf = shelf or Shelf()
    check_keys(value, ("format", "version", "name", "objects", "target"), where)
    if value["format"] != FORMAT:
        raise InputError(f'{where}: format: {shown(value["format"])} is not "{FORMAT}"')
    if value["version"] not in (VERSION, COMPOUND_VERSION) or isinstance(value["version"], bool):
        raise InputError(
            f"{where}: version: {shown(value['version'])} is not supported; this program reads {VERSION} and"
            f" {COMPOUND_VERSION}"
        )
    check_name(value["name"], f"{where}: name")
    if not isinstance(value["objects"], list):
        raise InputError(f"{where}: objects: must be a list")
    if len(value["objects"]) > MAX_OBJECTS:
        raise InputError(f"{where}: objects: {len(value['objects'])} are too many; at most {MAX_OBJECTS} fit")

    def body(entry: Any, key: str) -> Body:
        if not is_compound(entry):
            return _body(entry, where, key, shelf)
        if value["version"] == VERSION:
            raise InputError(f'{where}: {key}: bodies of pieces or meshes need "version": {COMPOUND_VERSION}')
        return _compound_body(entry, where, key, shelf, folder or Path())

    objects = tuple(body(b, f"objects[{i}]") for i, b in enumerate(value["objects"]))
    return Scenario(value["name"], objects, body(value["target"], "target"))


def load_scenario(path: str | os.PathLike[str], shelf: Shelf | None = None) -> Scenario:
    """Read a scenario file (JSON; docs/method.md, "Files").

    Raises:
      InputError: the file cannot be read, is not JSON, or fails a check of `parse_scenario`.
    """
    return parse_scenario(read_json(path), str(path), shelf, Path(path).parent)


def is_another_format(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a JSON object with neither `format` nor `target`, and so not a scenario.

    False if it cannot be read or parsed, so that `load_scenario` raises an error about a damaged scenario.
    """
    try:
        value = read_json(path)
    except InputError:
        return False
    return isinstance(value, dict) and not {"format", "target"} & set(value)


def format_scenario(scenario: Scenario) -> str:
    """The text of a scenario's file: of version 1, unless a body is a compound."""
    compounds = any(body.compound for body in (*scenario.objects, scenario.target))
    value = {
        "format": FORMAT,
        "version": COMPOUND_VERSION if compounds else VERSION,
        "name": scenario.name,
        "objects": [_format_body(body) for body in scenario.objects],
        "target": _format_body(scenario.target),
    }
    return json.dumps(value, indent=1, allow_nan=False) + "\n"


def _format_body(body: Body) -> dict[str, Any]:
    pose = {name: getattr(body, name) for name in _POSE_KEYS}
    if body.compound is not None:
        return format_compound(body.compound) | pose
    return {"shape": body.shape, "half_size": body.half_size} | pose


def save_scenario(scenario: Scenario, path: str | os.PathLike[str]) -> None:
    """Write a scenario file; an existing file is replaced.

    Raises:
      InputError: the file cannot be written.
    """
    text = format_scenario(scenario)
    with replacing(path) as file:
        file.write(text.encode())


def superquadrics(bodies: Sequence[Body], capacity: int = MAX_OBJECTS) -> Superquadrics:
    """Bodies as superquadrics with the planner's exponents, at their exact poses, in `capacity` slots.

    If there are compounds, all are bodies of parts.

    Raises:
      InputError: there are more bodies than slots.
    """
    if any(body.compound for body in bodies):
        return superquadric.pad(_of_parts(bodies), capacity)
    exact = Superquadrics(
        size=jnp.array([b.half_size for b in bodies], jnp.float32).reshape(-1, 3),
        exponents=jnp.array([shape_of(b.shape).exponents for b in bodies], jnp.float32).reshape(-1, 2),
        position=jnp.array([b.position for b in bodies], jnp.float32).reshape(-1, 3),
        rotation=jnp.array([rotation_matrix(b.quaternion) for b in bodies], jnp.float32).reshape(-1, 3, 3),
        valid=jnp.ones(len(bodies), bool),
    )
    return superquadric.pad(exact, capacity)


def pieces_of(body: Body) -> Compound:
    """What a body is made of; a plain one of the single piece that it is.

    Raises:
      InputError: it is of a shape that is no primitive.
    """
    if body.compound is not None:
        return body.compound
    shape = shape_of(body.shape)
    if shape.name not in PRIMITIVES:
        raise InputError(f"a {shape.name} cannot stand beside compounds: pieces are {', '.join(PRIMITIVES)}")
    return Compound((Piece(shape.name, body.half_size),), shape.density, shape.friction)


def _of_parts(bodies: Sequence[Body]) -> Superquadrics:
    rows = [part_rows(pieces_of(body)) for body in bodies]
    size, exponents, place, turn, valid = (jnp.array(np.stack(leaves)) for leaves in zip(*rows, strict=True))
    parts = Superquadrics(size, exponents, place, turn, valid)
    position = jnp.array([body.position for body in bodies], jnp.float32)
    rotation = jnp.array([rotation_matrix(body.quaternion) for body in bodies], jnp.float32)
    return bodies_of(parts, position, rotation)


def example_scenarios() -> dict[str, Path]:
    """The files of the scenarios that ship with the package, by name."""
    folder = importlib.resources.files("mechsearch_jax") / "data"
    files = [Path(str(file)) for file in folder.iterdir() if file.name.endswith(".json")]
    return {file.stem: file for file in sorted(files)}
