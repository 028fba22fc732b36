"""Scenarios: the objects on the shelf at the start of an episode, and their files."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.resources
import json
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
from mechsearch_jax.shapes.compound import COMPOUND, Compound, Piece, centred, half_extents
from mechsearch_jax.shapes.parts import part_rows
from mechsearch_jax.workspace.compound_file import format_compound, is_compound, parse_compound
from mechsearch_jax.workspace.json_checks import check_keys, check_norm, numbers
from mechsearch_jax.workspace.shelf import Shelf

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
