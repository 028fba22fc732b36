"""The superquadric parts by which compounds are described to the planner, at most four for a body."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from mechsearch_jax.shapes.compound import FRUSTUM, Compound, Piece, discs, inside, mesh, solids
from mechsearch_jax.shapes.primitives import SHAPES

# Most parts of a body.
PARTS = 4
_EDGED, _ROUND = SHAPES["box"].exponents, SHAPES["cylinder"].exponents
_SMOOTH = (1.0, 1.0)
# Points to fit parts with, and those to measure volumes with, as powers of 2.
_FIT, _MEASURE = 11, 16


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """A superquadric in the frame of a body.

    Attributes:
      size: half-extents [m], shape (3,).
      exponents: (e1, e2), shape (2,).
      position: of its centre [m], shape (3,).
      rotation: `R_body_part`, shape (3, 3).
    """

    size: Float[np.ndarray, " 3"]
    exponents: tuple[float, float]
    position: Float[np.ndarray, " 3"]
    rotation: Float[np.ndarray, "3 3"]

    def contains(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points in the body's frame are in the part [m]."""
        x, y, z = (np.abs((points - self.position) @ self.rotation) / self.size).T
        e1, e2 = self.exponents
        return (x ** (2 / e2) + y ** (2 / e2)) ** (e2 / e1) + z ** (2 / e1) <= 1.0


def _of_piece(piece: Piece, half: Sequence[float], exponents: tuple[float, float], along: float = 0.0) -> Part:
    """A part with a piece's pose, moved along its third axis [m]."""
    position = np.array(piece.position) + along * piece.rotation[:, 2]
    return Part(np.array(half, float), exponents, position, piece.rotation)


def _capsule_exponent(half: Sequence[float]) -> float:
    """The e1 of the superquadric of a capsule's half-extents that has most of its volume in common with it."""
    radius, length = half[0], half[2]
    r, z = np.meshgrid(np.linspace(0, 1, 64), np.linspace(0, 1, 128), indexing="ij")
    beyond = np.maximum(z * length - (length - radius), 0.0) / radius
    capsule = r**2 + beyond**2 <= 1.0

    def shared(e1: float) -> float:
        part = r ** (2 / e1) + z ** (2 / e1) <= 1.0
        return float((r * (capsule & part)).sum() / (r * (capsule | part)).sum())

    return max(np.linspace(_EDGED[0], 1.0, 17).tolist(), key=shared)


def _nearest(piece: Piece, count: int) -> list[Part]:
    """The parts of a piece; `count` of a frustum."""
    half = piece.half_size
    match piece.shape:
        case "box":
            return [_of_piece(piece, half, _EDGED)]
        case "cylinder":
            return [_of_piece(piece, half, _ROUND)]
        case "ellipsoid":
            return [_of_piece(piece, half, _SMOOTH)]
        case "capsule":
            return [_of_piece(piece, half, (_capsule_exponent(half), 1.0))]
        case "frustum":
            stack = discs(half, count)
            return [_of_piece(piece, (radius, radius, tall), _ROUND, along) for along, radius, tall in stack]
        case _:
            return [_fitted([piece])]


def _sample(pieces: Sequence[Piece], power: int) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"], float]:
    """Points spread evenly in the box around solids, which of them are in one, and the box's volume [m3]."""
    # Takes long to import.
    from scipy.stats import qmc

    corners = np.concatenate([np.asarray(mesh(piece).vertices) for piece in pieces])
    margin = 0.02 * np.ptp(corners, axis=0)
    low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    points = low + (high - low) * qmc.Sobol(3, scramble=False).random_base2(power)
    return points, np.any([inside(piece, points) for piece in pieces], axis=0), float(np.prod(high - low))


def _fitted(pieces: Sequence[Piece]) -> Part:
    """The box, cylinder or ellipsoid that has most of its volume in common with solids.

    Its axes are those of the smallest box around them; its volume is theirs.
    """
    import trimesh

    solid = solids(pieces)
    corners = np.concatenate([np.asarray(mesh(piece).vertices) for piece in solid])
    to_box, extents = trimesh.bounds.oriented_bounds(corners)
    R, t = to_box[:3, :3].T, -to_box[:3, :3].T @ to_box[:3, 3]
    points, body, box = _sample(solid, _FIT)
    volume = box * body.mean()

    def candidates():
        for axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            for exponents in (_EDGED, _ROUND, _SMOOTH):
                part = Part(extents[list(axes)] / 2, exponents, t, R[:, list(axes)])
                share = box * part.contains(points).mean()
                yield dataclasses.replace(part, size=part.size * (volume / share) ** (1 / 3)) if share else part

    return max(candidates(), key=lambda part: _shared(body, part.contains(points)))


def _shared(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def _counts(pieces: Sequence[Piece]) -> list[int]:
    """How many parts each piece gets: one, and the frustums with the largest steps what is left."""
    counts = [1] * len(pieces)

    def wrong(i: int) -> float:
        low, high, half = pieces[i].half_size
        return abs(high - low) * max(low, high) * half / counts[i] if pieces[i].shape == FRUSTUM else 0.0

    while sum(counts) < PARTS and (worst := max(range(len(pieces)), key=wrong)) is not None and wrong(worst) > 0:
        counts[worst] += 1
    return counts


def _clusters(pieces: Sequence[Piece]) -> list[list[Piece]]:
    """The pieces in at most `PARTS` groups: those are joined first whose common hull has the least empty volume."""
    groups = [[piece] for piece in pieces]

    def corners(group: list[Piece]) -> np.ndarray:
        return np.concatenate([np.asarray(mesh(solid).vertices) for solid in solids(group)])

    def volume(group: list[Piece]) -> float:
        from scipy.spatial import ConvexHull

        return float(ConvexHull(corners(group)).volume)

    while len(groups) > PARTS:
        a, b = min(
            itertools.combinations(range(len(groups)), 2),
            key=lambda pair: volume(groups[pair[0]] + groups[pair[1]]) - sum(volume(groups[i]) for i in pair),
        )
        groups[a] += groups.pop(b)
    return groups


@functools.lru_cache(maxsize=4096)
def parts_of(compound: Compound) -> tuple[Part, ...]:
    """The superquadrics that describe a compound, at most `PARTS`; their arrays must not be changed.

    A box is one of exponents (0.2, 0.2), a cylinder of (0.2, 1), an ellipsoid of (1, 1), all of the same size; a
    capsule the nearest of exponents (e1, 1); a frustum a stack of cylinders, as many as are left. A convex polyhedron,
    and pieces that are too many and so joined, are the box, cylinder or ellipsoid that fits best.
    """
    groups = _clusters(compound.pieces)
    counts = _counts([group[0] for group in groups]) if all(len(group) == 1 for group in groups) else [1] * PARTS
    parts: list[Part] = []
    for group, count in zip(groups, counts, strict=False):
        parts += _nearest(group[0], count) if len(group) == 1 else [_fitted(group)]
    return tuple(parts)


def part_rows(compound: Compound | None) -> tuple[np.ndarray, ...]:
    """The parts as arrays of `PARTS` rows: size, exponents, position, rotation, and whether there is a part.

    None has no parts.
    """
    parts = () if compound is None else parts_of(compound)
    size, exponents = np.full((PARTS, 3), 1e-3, np.float32), np.ones((PARTS, 2), np.float32)
    position, rotation = np.zeros((PARTS, 3), np.float32), np.tile(np.eye(3, dtype=np.float32), (PARTS, 1, 1))
    for i, part in enumerate(parts):
        size[i], exponents[i], position[i], rotation[i] = part.size, part.exponents, part.position, part.rotation
    return size, exponents, position, rotation, np.arange(PARTS) < len(parts)


def volume_in_common(compound: Compound) -> float:
    """Intersection over union of a compound's volume and that of its parts, on `2**16` even points."""
    whole = solids(compound.pieces)
    points, body, _ = _sample(whole, _MEASURE)
    return _shared(body, np.any([part.contains(points) for part in parts_of(compound)], axis=0))
