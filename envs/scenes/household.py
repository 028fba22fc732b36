"""The catalogue of household things: compounds of primitives, with the pose in which each stands."""

from __future__ import annotations

import dataclasses
import functools
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mechsearch_jax.runtime.errors import InputError, nearest
from mechsearch_jax.shapes.compound import COMPOUND, Compound, Piece, centred, half_extents, scaled, surface_points
from mechsearch_jax.workspace.scenario import Body

FILE = Path(__file__).with_name("household.toml")
# Digits of drawn scales.
DIGITS = 3


@dataclasses.dataclass(frozen=True)
class Thing:
    """A household thing.

    Attributes:
      name: of the thing.
      compound: what it is made of at scale 1, standing, in the frame of its centre of mass.
      scale: least and largest factor on all its lengths.
    """

    name: str
    compound: Compound
    scale: tuple[float, float]

    def sized(self, factor: float) -> Compound:
        """What it is made of at another scale, centred."""
        return centred(scaled(self.compound, factor))[0]


def _piece(entry: dict[str, Any]) -> Piece:
    quaternion = Rotation.from_euler("xyz", entry.get("turn", (0.0, 0.0, 0.0)), degrees=True).as_quat(scalar_first=True)
    half_size, position = (tuple(float(v) for v in entry[name]) for name in ("half_size", "position"))
    turn = tuple(round(float(q), 9) + 0.0 for q in quaternion)
    return Piece(entry["shape"], half_size, position, turn)  # pyright: ignore[reportArgumentType]


def _thing(name: str, entry: dict[str, Any]) -> Thing:
    pieces = tuple(_piece(piece) for piece in entry["pieces"])
    red, green, blue = (float(c) for c in entry["colour"])
    compound, _ = centred(Compound(pieces, float(entry["density"]), float(entry["friction"]), (red, green, blue)))
    least, most = (float(factor) for factor in entry["scale"])
    return Thing(name, compound, (least, most))


@functools.cache
def household() -> Mapping[str, Thing]:
    """All things by name, in the order of the file, on which generated scenes depend."""
    entries = tomllib.loads(FILE.read_text(encoding="utf-8"))
    return {name: _thing(name, entry) for name, entry in entries.items()}


def thing_of(name: str) -> Thing:
    """The thing of a name.

    Raises:
      InputError: there is none.
    """
    things = household()
    if name not in things:
        raise InputError(f"household: there is no {name!r}; {nearest(name, things)}")
    return things[name]


def standing_height(compound: Compound) -> float:
    """Height of the centre of mass of a compound above the board on which it stands upright [m]."""
    return -float(surface_points(compound)[:, 2].min())


def body_at(compound: Compound, x: float, y: float, z: float, yaw: float = 0.0) -> Body:
    """A compound at a place [m], turned about the vertical [rad]."""
    turn = (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))
    return Body(COMPOUND, half_extents(compound), (x, y, z), turn, compound)


def draw_body(rng: np.random.Generator) -> Body:
    """A drawn thing, as a `generator.DrawBody`."""
    compound = draw_thing(rng)
    return body_at(compound, 0.0, 0.0, standing_height(compound))


def draw_thing(rng: np.random.Generator) -> Compound:
    """One of the things, all equally likely, at a scale drawn evenly from its own."""
    things = tuple(household().values())
    thing = things[int(rng.integers(len(things)))]
    return thing.sized(round(float(rng.uniform(*thing.scale)), DIGITS))
