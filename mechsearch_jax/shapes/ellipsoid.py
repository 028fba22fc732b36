"""Ellipsoids."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import trimesh

CODE = 2


@dataclasses.dataclass(frozen=True)
class Ellipsoid:
    """A `primitive.Primitive`; its half-extents are its semi-axes."""

    code: int = CODE
    name: str = "ellipsoid"
    geometry: str = "ellipsoid"

    def fault(self, half_size: Sequence[float]) -> str | None:
        return None

    def volume(self, half_size, library):
        return library.prod(half_size, axis=-1) * (4 * np.pi / 3)

    def moments(self, half_size, library):
        square = half_size**2
        return (square.sum(axis=-1, keepdims=True) - square) / 5

    def geometry_size(self, half_size, library):
        return half_size

    def bounding_radius(self, half_size, library):
        return library.max(half_size, axis=-1)

    def inside(self, point, half_size, library):
        return library.sum((point / half_size) ** 2, axis=-1) <= 1.0

    def cut(self, origin, direction, half_size, library):
        """The first crossing of the unit sphere by the ray in semi-axes."""
        o = [component / half_size[i] for i, component in enumerate(origin)]
        d = [component / half_size[i] for i, component in enumerate(direction)]
        square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        middle = -(o[0] * d[0] + o[1] * d[1] + o[2] * d[2]) / square
        # From the point nearest to the centre: the difference of large squares would lose digits.
        miss = sum((o[i] + middle * d[i]) ** 2 for i in range(3))
        reach = library.sqrt(library.maximum(1.0 - miss, 0.0) / square)
        return library.where((miss <= 1.0) & (middle - reach > 0.0), middle - reach, library.inf)

    def reach(self, direction, half_size, library):
        return library.sqrt(library.sum((direction * half_size) ** 2, axis=-1))

    def distance(self, level, height, half_size, library):
        """Right to first order at the surface; in the middle minus the least semi-axis."""
        point = [level[..., 0], level[..., 1], height]
        share = sum((p / a) ** 2 for p, a in zip(point, half_size, strict=True))
        slope = sum((p / a**2) ** 2 for p, a in zip(point, half_size, strict=True))
        off = slope > 1e-12
        gauge, steep = (library.sqrt(library.where(off, value, 1.0)) for value in (share, slope))
        return library.where(off, gauge * (gauge - 1.0) / steep, -min(half_size))

    def normal(self, point, half_size, library):
        return point / half_size**2

    def mesh(self, half_size: Sequence[float]) -> trimesh.Trimesh:
        import trimesh

        return trimesh.creation.icosphere(subdivisions=3).apply_scale(np.asarray(half_size, float))
