"""Cylinders about their third axis."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mechsearch_jax.shapes.prism import face, first, gap, slab

if TYPE_CHECKING:
    import trimesh

CODE = 1
# Corners of the circumscribed polygon of a cylinder, and of the inscribed polygon of its mesh.
RIM, SECTIONS = 24, 32


@dataclasses.dataclass(frozen=True)
class Cylinder:
    """A `shape.Shape` with half-extents (radius, radius, half its height)."""

    code: int = CODE
    name: str = "cylinder"
    exponents: tuple[float, float] = (0.2, 1.0)
    density: float = 585.0
    friction: float = 0.6
    geometry: str = "cylinder"
    round: bool = True
    yaws: int = 1
    target_half_size: tuple[float, float, float] = (0.02, 0.02, 0.05)

    def fault(self, half_size: Sequence[float]) -> str | None:
        return None if half_size[0] == half_size[1] else "a cylinder's first two are its radius and must be equal"

    def nearest(self, size, library):
        """The cylinder of the same cross-section and height."""
        radius = library.sqrt(size[..., :1] * size[..., 1:2])
        return library.concatenate([radius, radius, size[..., 2:]], axis=-1)

    def volume(self, half_size, library):
        return 8 * library.prod(half_size, axis=-1) * (np.pi / 4)

    def moments(self, half_size, library):
        square = half_size**2
        across = square[..., 0] / 4 + square[..., 2] / 3
        return library.stack([across, across, square[..., 0] / 2], axis=-1)

    def geometry_size(self, half_size, library):
        return library.stack([half_size[..., 0], half_size[..., 2], library.zeros_like(half_size[..., 0])], axis=-1)

    def bounding_radius(self, half_size, library):
        return library.sqrt(half_size[..., 0] ** 2 + half_size[..., 2] ** 2)

    def inside(self, point, half_size, library):
        across = point[..., 0] ** 2 + point[..., 1] ** 2 <= half_size[0] ** 2
        return across & (library.abs(point[..., 2]) <= half_size[2])

    def reach(self, direction, half_size, library):
        square = 1.0 - direction[..., 2] ** 2
        tilted = square > 1e-12
        across = library.where(tilted, library.sqrt(library.where(tilted, square, 1.0)), 0.0)
        return library.abs(direction[..., 2]) * half_size[..., 2] + across * half_size[..., 0]

    def cut(self, origin, direction, half_size, library):
        """The ray crosses the side half a chord before and after its point nearest to the axis."""
        (x, y, z), (u, v, w) = origin, direction
        square = library.maximum(u * u + v * v, 1e-20)
        middle = -(x * u + y * v) / square
        miss = x * v - y * u
        chord = half_size[0] * half_size[0] - miss * miss / square
        reach = library.sqrt(library.maximum(chord, 0.0) / square)
        bottom, top = slab(z, w, half_size[2], library)
        near, far = library.maximum(middle - reach, bottom), library.minimum(middle + reach, top)
        return library.where(chord >= 0.0, first(near, far, library), library.inf)

    def normal(self, point, half_size, library):
        share = library.abs(point) / half_size
        on_side = library.sqrt(point[..., 0] ** 2 + point[..., 1] ** 2) / half_size[..., 0] >= share[..., 2]
        level = library.asarray([1.0, 1.0, 0.0], point.dtype).reshape((1,) * (point.ndim - 1) + (3,))
        return library.where(on_side[..., None], point * level, face(point, half_size, library) * (1.0 - level))

    def distance(self, level, height, half_size, library):
        square = library.sum(level**2, axis=-1)
        off_axis = square > 0
        side = library.where(off_axis, library.sqrt(library.where(off_axis, square, 1.0)), 0.0) - half_size[0]
        return gap(library.stack([side, library.abs(height) - half_size[2]], axis=-1), library)

    def fall(self, before, after, library):
        """The cosine of the difference between the inclinations of its axis."""
        a, b = (library.clip(library.abs(up[..., 2]), 0.0, 1.0) for up in (before, after))
        return a * b + library.sqrt((1.0 - a**2) * (1.0 - b**2))

    def areas(self, half_size, library):
        """Areas of the side, of nothing, and of the ends."""
        a, _, c = half_size
        return library.stack([2.0 * a * c, 0.0 * a, a * a])

    def spread(self, part, even, sign, library):
        angle = np.pi * even[:, 0]
        radius = library.where(part == 2, library.sqrt(library.abs(even[:, 1])), 1.0)
        height = library.where(part == 2, sign, even[:, 2])
        return library.stack([radius * library.cos(angle), radius * library.sin(angle), height], axis=-1)

    def rim(self, half_size: Sequence[float]) -> Float[np.ndarray, "corners 2"]:
        angle = np.arange(RIM) * (2 * np.pi / RIM)
        return np.stack([np.cos(angle), np.sin(angle)], axis=1) * half_size[0] / np.cos(np.pi / RIM)

    def mesh(self, half_size: Sequence[float]) -> trimesh.Trimesh:
        import trimesh

        return trimesh.creation.cylinder(radius=half_size[0], height=2 * half_size[2], sections=SECTIONS)

    def grasps(self, half_size, count, max_yaw):
        """From all directions of approach."""
        yaws = np.linspace(-max_yaw, max_yaw, count) if count > 1 else np.zeros(1)
        return yaws, np.full(len(yaws), 2 * half_size[0])
