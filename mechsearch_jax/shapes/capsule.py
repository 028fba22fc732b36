"""Capsules about their third axis."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import trimesh

CODE = 3
# MuJoCo has no capsules without a length [m].
SHORTEST = 1e-6


@dataclasses.dataclass(frozen=True)
class Capsule:
    """A `primitive.Primitive`: a cylinder with round ends; half-extents (r, r, half its length with the ends)."""

    code: int = CODE
    name: str = "capsule"
    geometry: str = "capsule"

    def fault(self, half_size: Sequence[float]) -> str | None:
        if half_size[0] != half_size[1]:
            return "a capsule's first two are its radius and must be equal"
        return None if half_size[2] >= half_size[0] else "a capsule's third is half its length, at least its radius"

    def volume(self, half_size, library):
        radius, half = half_size[..., 0], half_size[..., 2] - half_size[..., 0]
        return np.pi * radius**2 * (2 * half + 4 / 3 * radius)

    def moments(self, half_size, library):
        """Those of the cylinder and of the two half-balls, whose centres of mass are 3/8 r beyond its ends."""
        radius, half = half_size[..., 0], half_size[..., 2] - half_size[..., 0]
        square = radius**2
        middle = 2 * half / (2 * half + 4 / 3 * radius)
        ends = 1.0 - middle
        beyond = half**2 + 0.75 * half * radius
        across = middle * (square / 4 + half**2 / 3) + ends * (0.4 * square + beyond)
        along = middle * square / 2 + ends * 0.4 * square
        return library.stack([across, across, along], axis=-1)

    def geometry_size(self, half_size, library):
        radius, half = half_size[..., 0], half_size[..., 2] - half_size[..., 0]
        return library.stack([radius, library.maximum(half, SHORTEST), library.zeros_like(radius)], axis=-1)

    def bounding_radius(self, half_size, library):
        return half_size[..., 2]

    def inside(self, point, half_size, library):
        half = half_size[2] - half_size[0]
        beyond = library.maximum(library.abs(point[..., 2]) - half, 0.0)
        return point[..., 0] ** 2 + point[..., 1] ** 2 + beyond**2 <= half_size[0] ** 2

    def cut(self, origin, direction, half_size, library):
        """The nearest crossing of the side, between the centres of the ends, or of the spheres at the ends."""
        (x, y, z), (u, v, w) = origin, direction
        radius, half = half_size[0], half_size[2] - half_size[0]
        square = library.maximum(u * u + v * v, 1e-12)
        along = u * x + v * y
        chord = along * along - square * (x * x + y * y - radius * radius)
        side = (-along - library.sqrt(library.maximum(chord, 0.0))) / square
        on_side = (chord >= 0.0) & (library.abs(z + side * w) <= half) & (side > 0.0)
        nearest = library.where(on_side, side, library.inf)
        length = square + w * w
        for end in (-half, half):
            along = u * x + v * y + w * (z - end)
            chord = along * along - length * (x * x + y * y + (z - end) ** 2 - radius * radius)
            first = (-along - library.sqrt(library.maximum(chord, 0.0))) / length
            hit = (chord >= 0.0) & (first > 0.0)
            nearest = library.where(hit & (first < nearest), first, nearest)
        return nearest

    def reach(self, direction, half_size, library):
        radius, half = half_size[..., 0], half_size[..., 2] - half_size[..., 0]
        return radius + half * library.abs(direction[..., 2])

    def distance(self, level, height, half_size, library):
        half = half_size[2] - half_size[0]
        beyond = library.maximum(library.abs(height) - half, 0.0)
        square = level[..., 0] ** 2 + level[..., 1] ** 2 + beyond**2
        off_axis = square > 0
        return library.where(off_axis, library.sqrt(library.where(off_axis, square, 1.0)), 0.0) - half_size[0]

    def normal(self, point, half_size, library):
        half = half_size[..., 2:] - half_size[..., :1]
        height = point[..., 2:] - library.clip(point[..., 2:], -half, half)
        return library.concatenate([point[..., :2], height], axis=-1)

    def mesh(self, half_size: Sequence[float]) -> trimesh.Trimesh:
        """Its surface as a triangle mesh [m]."""
        import trimesh

        radius, _, half = half_size
        mesh = trimesh.creation.capsule(height=2 * (half - radius), radius=radius, count=(16, 12))
        return mesh.apply_translation(-mesh.bounds.mean(axis=0))
