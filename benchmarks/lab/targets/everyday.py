"""Meshes of everyday things: household things at sizes of a seed, as files that a user might have.

What stands in the catalogue as a stack of discs about one axis becomes a turned solid, and cups, bowls, glasses and
jugs are hollow, which they are not in the catalogue. All else is a closed shell for each piece.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mechsearch_jax.benchmarks.lab.targets.antipodal import lines
from mechsearch_jax.envs.scenes.household import household
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import replacing
from mechsearch_jax.shapes.compound import Compound, Piece, mesh, solids

if TYPE_CHECKING:
    import trimesh

# Things that are hollow, and the thickness of wall and floor [m].
VESSELS, WALL, FLOOR = ("mug", "espresso-cup", "bowl", "glass", "jug"), 0.004, 0.006
# Corners of a turned solid seen from above; discs nearer than this are on each other [m]; digits of drawn scales.
SECTIONS, TOUCHES, DIGITS = 48, 1e-4, 3
# A thing fits the hand if lines across it are found, of so many, within the friction cone [rad].
LINES, CONE = 50, math.radians(30)


def surface_of(compound: Compound, hollow: bool) -> trimesh.Trimesh:
    """The surface of a thing [m].

    Args:
      compound: what it is made of.
      hollow: whether its lowest turned solid is open at the top.
    """
    import trimesh

    round_ones = [piece for piece in compound.pieces if _is_upright(piece)]
    upright = sorted((piece for piece in round_ones if _beside(piece, round_ones[0]) < TOUCHES), key=_bottom)
    stacks: list[list[Piece]] = []
    for piece in upright:
        if stacks and abs(_top(stacks[-1][-1]) - _bottom(piece)) < TOUCHES:
            stacks[-1].append(piece)
        else:
            stacks.append([piece])
    shells = [_turned(stack, hollow and i == 0) for i, stack in enumerate(stacks)]
    others = [piece for piece in compound.pieces if piece not in upright]
    shells += [mesh(solid) for solid in solids(others)]
    return trimesh.util.concatenate(shells)  # pyright: ignore[reportReturnType]


def _is_upright(piece: Piece) -> bool:
    """Whether a piece is round about a vertical axis."""
    return piece.shape in ("cylinder", "frustum") and abs(piece.quaternion[0]) > 1 - 1e-9


def _beside(a: Piece, b: Piece) -> float:
    return math.dist(a.position[:2], b.position[:2])


def _bottom(piece: Piece) -> float:
    return piece.position[2] - piece.half_size[2]


def _top(piece: Piece) -> float:
    return piece.position[2] + piece.half_size[2]


def _turned(stack: Sequence[Piece], hollow: bool) -> trimesh.Trimesh:
    """The solid of revolution of discs and frustums on each other."""
    import trimesh

    outline = [(0.0, _bottom(stack[0]))]
    for piece in stack:
        low, high, _ = piece.half_size
        ends = (low, high) if piece.shape == "frustum" else (low, low)
        outline += [(ends[0], _bottom(piece)), (ends[1], _top(piece))]
    if hollow:
        (low, bottom), (high, top) = outline[1], outline[-1]
        at_floor = low + (high - low) * FLOOR / (top - bottom)
        outline += [(high - WALL, top), (at_floor - WALL, bottom + FLOOR), (0.0, bottom + FLOOR)]
    else:
        outline.append((0.0, _top(stack[-1])))
    kept = [row for i, row in enumerate(outline) if i == 0 or math.dist(row, outline[i - 1]) > TOUCHES]
    solid = trimesh.creation.revolve(np.array(kept), sections=SECTIONS)
    solid.apply_translation((*stack[0].position[:2], 0.0))
    if solid.volume < 0:
        solid.invert()
    return solid


def write_things(count: int, seed: int, folder: Path) -> list[Path]:
    """Write OBJ files of household things of different kinds, at a size drawn from each one's own, z up, in metres.

    Only those are written that have two opposite places between which the fingers fit.

    Args:
      count: how many.
      seed: equal seeds give equal things.
      folder: for the files.

    Raises:
      InputError: there are not as many kinds, or the folder cannot be written.
    """
    things, rng = household(), np.random.default_rng([seed, len(household())])
    widest = Gripper().usable_opening
    files: list[Path] = []
    for name in rng.permutation(list(things)):
        if len(files) == count:
            break
        thing = things[str(name)]
        scale = round(float(rng.uniform(*thing.scale)), DIGITS)
        surface = surface_of(thing.sized(scale), thing.name in VESSELS)
        draw = functools.partial(lines, surface, LINES, widest, CONE)
        if not len(draw(np.random.default_rng(seed)).width):
            continue
        files.append(folder / f"{thing.name}.obj")
        with replacing(files[-1]) as file:
            file.write(surface.export(file_type="obj").encode())  # pyright: ignore[reportAttributeAccessIssue]
    if len(files) < count:
        raise InputError(f"lab targets: --things {count}: only {len(files)} kinds fit the hand; use fewer")
    return files
