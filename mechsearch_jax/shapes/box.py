"""Boxes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mechsearch_jax.shapes.prism import face, first, gap, slab

if TYPE_CHECKING:
    import trimesh

CODE = 0


@dataclasses.dataclass(frozen=True)
class Box:
    """A `shape.Shape`."""

    code: int = CODE
    name: str = "box"
    exponents: tuple[float, float] = (0.2, 0.2)
    density: float = 737.0
    friction: float = 0.4
    geometry: str = "box"
    round: bool = False
    yaws: int = 6
    target_half_size: tuple[float, float, float] = (0.015, 0.02, 0.05)

    def fault(self, half_size: Sequence[float]) -> str | None:
        return None

    def nearest(self, size, library):
        return size

    def volume(self, half_size, library):
        return 8 * library.prod(half_size, axis=-1)

    def moments(self, half_size, library):
        square = half_size**2
        return (square.sum(axis=-1, keepdims=True) - square) / 3

    def geometry_size(self, half_size, library):
        return half_size

    def bounding_radius(self, half_size, library):
        x, y, z = (half_size[..., i] for i in range(3))
        return library.sqrt(x**2 + y**2 + z**2)

    def inside(self, point, half_size, library):
        return library.all(library.abs(point) <= half_size, axis=-1)

    def reach(self, direction, half_size, library):
        return library.sum(library.abs(direction) * half_size, axis=-1)

    def cut(self, origin, direction, half_size, library):
        cuts = [slab(o, d, half_size[i], library) for i, (o, d) in enumerate(zip(origin, direction, strict=True))]
        (near, far), *rest = cuts
        for a, b in rest:
            near, far = library.maximum(near, a), library.minimum(far, b)
        return first(near, far, library)

    def normal(self, point, half_size, library):
        return face(point, half_size, library)

    def distance(self, level, height, half_size, library):
        half = library.asarray(half_size[:2], level.dtype).reshape((1,) * (level.ndim - 1) + (2,))
        side = gap(library.abs(level) - half, library)
        return gap(library.stack([side, library.abs(height) - half_size[2]], axis=-1), library)

    def fall(self, before, after, library):
        return library.sum(before * after, axis=-1)

    def areas(self, half_size, library):
        """Areas of the faces across each axis."""
        a, b, c = half_size
        return library.stack([b * c, a * c, a * b])

    def spread(self, part, even, sign, library):
        return library.where(part[:, None] == library.arange(3)[None], sign[:, None], even)

    def rim(self, half_size: Sequence[float]) -> Float[np.ndarray, "4 2"]:
        a, b, _ = half_size
        return np.array([(a, b), (-a, b), (-a, -b), (a, -b)])

    def mesh(self, half_size: Sequence[float]) -> trimesh.Trimesh:
        import trimesh

        a, b, c = half_size
        return trimesh.creation.box(extents=(2 * a, 2 * b, 2 * c))

    def grasps(self, half_size, count, max_yaw):
        """Perpendicular to each side."""
        return np.arange(4) * np.pi / 2, 2 * np.array(half_size)[[1, 0, 1, 0]]
