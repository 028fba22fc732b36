"""Recognised bodies of several parts as compounds, in which actions are tried."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.pushing.physics_push import THINNEST
from mechsearch_jax.envs.world.world import TARGET, body_at
from mechsearch_jax.geometry.superquadric import ROUND_EXPONENT, Superquadrics
from mechsearch_jax.shapes import PRIMITIVES, shape_of
from mechsearch_jax.shapes.compound import COMPOUND, Compound, Piece, centred, half_extents
from mechsearch_jax.workspace.scenario import Body
from mechsearch_jax.workspace.target import Target

# A round superquadric whose exponent e1 is above this is nearer to an ellipsoid than to a cylinder.
SMOOTH_EXPONENT = 0.6
# Bodies of several parts are none of the environment's boxes and cylinders. What they are made of is not known: here
# they are as dense as full vessels [kg/m3] and of the roughest material, since what is heavier or rougher than in its
# trial holds the arm up.
DENSITY, FRICTION = 1000.0, 0.6
# What stands on an ellipsoid would roll, and stood still as it was seen: it has a base, as the fruit and pots of
# `household.toml` have. It is this share of the ellipsoid's width, and so flat [m].
BASE_SHARE, BASE_THICKNESS = 0.5, 0.008


def _piece(size: np.ndarray, exponents: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> Piece:
    """The solid nearest to a part, in the frame of its body."""
    half = np.maximum(size.astype(float), THINNEST)
    shape = "box"
    if exponents[1] > ROUND_EXPONENT:
        shape = "ellipsoid" if exponents[0] > SMOOTH_EXPONENT else "cylinder"
    if shape == "cylinder":
        half = shape_of(shape).nearest(half, np)
    quaternion = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    return Piece(shape, *(tuple(float(v) for v in values) for values in (half, position, quaternion)))  # pyright: ignore


def compound_of(parts: Any, up: Float[np.ndarray, " 3"]) -> Compound:
    """The compound of a body's parts, in the body's frame, of `DENSITY` and `FRICTION`; an ellipsoid stands on a base.

    An approximation: a cylinder that lies has none, and may roll.

    Args:
      parts: a `Superquadrics` of a single body, as NumPy arrays; absent ones are left out.
      up: the vertical, a unit vector in the body's frame.
    """
    there = np.flatnonzero(parts.valid)
    rows = [(parts.size[i], parts.exponents[i], parts.position[i], parts.rotation[i]) for i in there]
    pieces = tuple(_piece(*row) for row in rows)
    return Compound((*pieces, *_base(pieces, up)), DENSITY, FRICTION)


def _base(pieces: Sequence[Piece], up: Float[np.ndarray, " 3"]) -> list[Piece]:
    """The base of a body whose lowest piece is an ellipsoid; empty for others."""

    def bottom(piece: Piece) -> float:
        reach = PRIMITIVES[piece.shape].reach(piece.rotation.T @ up, np.array(piece.half_size), np)
        return float(up @ piece.position - reach)

    lowest = min(pieces, key=bottom)
    if lowest.shape != "ellipsoid":
        return []
    half, own_up = np.array(lowest.half_size), lowest.rotation.T @ up
    # An ellipsoid's point that is farthest down, from its middle; and its semi-axes as seen from above.
    down = -lowest.rotation @ (half**2 * own_up) / np.linalg.norm(half * own_up)
    level = np.linalg.svd(up[None])[2][1:]
    radius = BASE_SHARE * float(np.linalg.svd(level @ lowest.rotation * half, compute_uv=False).min())
    x, y, z = (np.array(lowest.position) + down + BASE_THICKNESS / 2 * up).tolist()
    turn = Rotation.align_vectors(up[None], np.array([[0.0, 0.0, 1.0]]))[0]
    quaternion = tuple(float(v) for v in turn.as_quat(scalar_first=True))
    return [Piece("cylinder", (radius, radius, BASE_THICKNESS / 2), (x, y, z), quaternion)]  # pyright: ignore


def with_parts(bodies: Sequence[Body | None], objects: Superquadrics) -> list[Body | None]:
    """The bodies of recognised objects, with those of several parts as compounds.

    Args:
      bodies: in their slots, each the body nearest to an object's bounding superquadric.
      objects: recognised, as NumPy arrays.
    """
    made = list(bodies)
    parts: Any = objects.parts
    if parts is None:
        return made
    for i in np.flatnonzero(objects.valid & (parts.valid.sum(axis=-1) > 1)):
        own: Any = Superquadrics(*(getattr(parts, name)[i] for name in _FIELDS))
        compound, centre = centred(compound_of(own, np.asarray(objects.rotation[i], float)[2]))
        body = made[i]
        assert body is not None
        position = np.asarray(objects.position[i], float) + np.asarray(objects.rotation[i], float) @ centre
        x, y, z = position.tolist()
        made[i] = dataclasses.replace(
            body, shape=COMPOUND, half_size=half_extents(compound), position=(x, y, z), compound=compound
        )
    return made


def with_target(bodies: Sequence[Body | None], target: Target) -> list[Body | None]:
    """The bodies with the target, if it is there, as what it is made of.

    Args:
      bodies: in their slots; that of a compound target the box around it.
      target: of the search.
    """
    made, body = list(bodies), bodies[TARGET]
    if target.compound is not None and body is not None:
        made[TARGET] = body_at(target.compound, (body.position, body.quaternion))
    return made


_FIELDS = ("size", "exponents", "position", "rotation", "valid")
