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
from scipy.spatial.transform import Rotation

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.runtime.errors import InputError, shown
from mechsearch_jax.runtime.files import read_json, replacing
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.shelf import Shelf

FORMAT = "mechsearch-scenario"
VERSION = 1
MAX_OBJECTS = 8
# Enough for thousands of scenes: 48 bits.
HASH_DIGITS = 12
# Names are also file names.
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}")
# Smallest half-extent; smaller ones lead to numerical problems [m].
LEAST_HALF_SIZE = 5e-4

_BODY_KEYS = {"shape": str, "half_size": 3, "position": 3, "quaternion": 4}


@dataclasses.dataclass(frozen=True)
class Body:
    """A rigid body on the shelf.

    Attributes:
      shape: name of its shape, such as "box" or "cylinder".
      half_size: half-extents along its axes [m]; for a cylinder (radius, radius, half its height).
      position: of its centre in the world [m].
      quaternion: (w, x, y, z) of its rotation in the world, a unit quaternion.
    """

    shape: str
    half_size: tuple[float, float, float]
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]


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
        # Adding 0 makes -0 the 0 that it equals.
        bodies = [
            [body.shape, *([float(v) + 0.0 for v in part] for part in (body.half_size, body.position, body.quaternion))]
            for body in (*self.objects, self.target)
        ]
        return hashlib.sha256(json.dumps(bodies, allow_nan=False).encode()).hexdigest()[:HASH_DIGITS]


def rotation_matrix(quaternion: Sequence[float] | Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z), which are normalised first; at most one leading axis."""
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


def _numbers(value: Any, count: int, where: str) -> tuple[float, ...]:
    number = isinstance(value, list) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    if not number or len(value) != count:
        raise InputError(f"{where}: must be a list of {count} numbers")
    try:
        numbers = tuple(float(v) for v in value)
    except OverflowError:
        raise InputError(f"{where}: holds a number that is too large; every number must be finite") from None
    if not all(math.isfinite(v) for v in numbers):
        raise InputError(f"{where}: holds NaN or an infinite number; every number must be finite")
    return numbers


def _check_keys(value: Any, keys: Sequence[str], where: str, key: str | None) -> None:
    place = where if key is None else f"{where}: {key}"
    if not isinstance(value, dict):
        raise InputError(f"{place}: must be a JSON object with the keys {', '.join(keys)}")
    for unknown in [k for k in value if k not in keys]:
        raise InputError(f"{place}: unknown key {shown(unknown)}; known are {', '.join(keys)}")
    for missing in [k for k in keys if k not in value]:
        raise InputError(f'{place}: key "{missing}" is missing')


def _body(value: Any, where: str, key: str, shelf: Shelf) -> Body:
    _check_keys(value, tuple(_BODY_KEYS), where, key)
    where = f"{where}: {key}"
    shape = shape_of(value["shape"], f"{where}.shape")
    half_size = _numbers(value["half_size"], 3, f"{where}.half_size")
    position = _numbers(value["position"], 3, f"{where}.position")
    quaternion = _numbers(value["quaternion"], 4, f"{where}.quaternion")
    if min(half_size) <= 0:
        raise InputError(f"{where}.half_size: {list(half_size)} must be positive lengths in metres")
    if fault := shape.fault(half_size):
        raise InputError(f"{where}.half_size: {fault}")
    ranges = ((shelf.front, shelf.back), (shelf.right, shelf.left), (shelf.board, shelf.ceiling))
    widest = max(high - low for low, high in ranges)
    if not all(LEAST_HALF_SIZE <= half <= widest for half in half_size):
        raise InputError(
            f"{where}.half_size: {list(half_size)} must be from {LEAST_HALF_SIZE} to {widest:g}, in metres, which no"
            " object on this shelf exceeds"
        )
    if abs(math.hypot(*quaternion) - 1.0) > 1e-3:
        raise InputError(f"{where}.quaternion: its norm is {math.hypot(*quaternion):.4g}; it must be 1 (w, x, y, z)")
    for axis, p, (low, high) in zip("xyz", position, ranges, strict=True):
        if not low <= p <= high:
            raise InputError(
                f"{where}.position: {axis} = {p:g} is off the board, which reaches from {low:g} to {high:g}"
            )
    return Body(shape.name, half_size, position, quaternion)  # pyright: ignore[reportArgumentType]


def parse_scenario(value: Any, where: str, shelf: Shelf | None = None) -> Scenario:
    """A scenario from parsed JSON.

    Args:
      value: the parsed file.
      where: how messages name the file.
      shelf: the shelf that the bodies must stand on; the default shelf if None.

    Raises:
      InputError: the format or version is another one; a key is unknown or missing; the name is invalid; a number is
        not finite; a size is out of range; a quaternion is not of unit length; a body is off the board.
    """
    shelf = shelf or Shelf()
    _check_keys(value, ("format", "version", "name", "objects", "target"), where, None)
    if value["format"] != FORMAT:
        raise InputError(f'{where}: format: {shown(value["format"])} is not "{FORMAT}"')
    if value["version"] != VERSION or isinstance(value["version"], bool):
        raise InputError(f"{where}: version: {shown(value['version'])} is not supported; this program reads {VERSION}")
    check_name(value["name"], f"{where}: name")
    if not isinstance(value["objects"], list):
        raise InputError(f"{where}: objects: must be a list")
    if len(value["objects"]) > MAX_OBJECTS:
        raise InputError(f"{where}: objects: {len(value['objects'])} are too many; at most {MAX_OBJECTS} fit")
    objects = tuple(_body(b, where, f"objects[{i}]", shelf) for i, b in enumerate(value["objects"]))
    return Scenario(value["name"], objects, _body(value["target"], where, "target", shelf))


def load_scenario(path: str | os.PathLike[str], shelf: Shelf | None = None) -> Scenario:
    """Read a scenario file (JSON; docs/method.md, "Files").

    Raises:
      InputError: the file cannot be read, is not JSON, or fails a check of `parse_scenario`.
    """
    return parse_scenario(read_json(path), str(path), shelf)


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
    """The text of a scenario's file."""
    value = {"format": FORMAT, "version": VERSION, **dataclasses.asdict(scenario)}
    return json.dumps(value, indent=1, allow_nan=False) + "\n"


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

    Raises:
      InputError: there are more bodies than slots.
    """
    exact = Superquadrics(
        size=jnp.array([b.half_size for b in bodies], jnp.float32).reshape(-1, 3),
        exponents=jnp.array([shape_of(b.shape).exponents for b in bodies], jnp.float32).reshape(-1, 2),
        position=jnp.array([b.position for b in bodies], jnp.float32).reshape(-1, 3),
        rotation=jnp.array([rotation_matrix(b.quaternion) for b in bodies], jnp.float32).reshape(-1, 3, 3),
        valid=jnp.ones(len(bodies), bool),
    )
    return superquadric.pad(exact, capacity)


def example_scenarios() -> dict[str, Path]:
    """The files of the scenarios that ship with the package, by name."""
    folder = importlib.resources.files("mechsearch_jax") / "data"
    files = [Path(str(file)) for file in folder.iterdir() if file.name.endswith(".json")]
    return {file.stem: file for file in sorted(files)}
