"""The solid that a target is: a box, a cylinder, or the union of a compound's pieces, behind one protocol; without JAX.

Points and directions are in the body's frame, whose origin is the centre of a shape and the centre of mass of a
compound. Methods with a `library`, NumPy or `jax.numpy`, take and return its arrays.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from jaxtyping import Float

from mechsearch_jax.shapes import union
from mechsearch_jax.shapes.compound import CONVEX, Compound, Piece, mesh, solids
from mechsearch_jax.shapes.registry import PRIMITIVES
from mechsearch_jax.shapes.shape import Shape

if TYPE_CHECKING:
    import trimesh

# Candidate yaw angles of a compound over a full turn; half of them over half a turn.
YAWS = 12
# A compound is symmetric under a turn if no point of its turned surface is farther than this outside of it [m], and a
# solid of revolution if it is symmetric under all of `TURNS` turns.
ALIKE, TURNS = 0.002, 16
# Points on its surface by which this is tested.
SURFACE_POINTS = 2000
# [m]
JUST_OUTSIDE = 2e-4


class Solid(Protocol):
    """What is computed with a target's geometry."""

    @property
    def round(self) -> bool:
        """Whether it is a solid of revolution about its third axis."""
        ...

    @property
    def turn(self) -> float:
        """The yaw after which it looks the same [rad]: half a turn or a full one; half a turn if it is round."""
        ...

    @property
    def ends_alike(self) -> bool:
        """Whether it looks the same upside down."""
        ...

    @property
    def yaws(self) -> int:
        """Usual number of candidate yaw angles over a `turn`."""
        ...

    @property
    def bottom(self) -> float:
        """How far below the origin its lowest point is [m]."""
        ...

    @property
    def top(self) -> float:
        """How far above the origin its highest point is [m]."""
        ...

    @property
    def radius(self) -> float:
        """Largest distance of a point from the vertical axis [m]."""
        ...

    @property
    def breadth(self) -> float:
        """Half of its least width seen from above [m]."""
        ...

    def distance(
        self, level: Float[Any, "*batch 2"], height: Float[Any, "*batch"], library: Any
    ) -> Float[Any, "*batch"]:
        """Signed distance of points to its surface [m], negative inside; its derivatives are finite everywhere."""
        ...

    def cut(
        self,
        origin: Sequence[Float[Any, "*#rays"]],
        direction: Sequence[Float[Any, "*#rays"]],
        grown: float,
        library: Any,
    ) -> Float[Any, "*rays"]:
        """Where rays from outside enter it, see `shape.Shape.cut`, if it is larger by `grown` on all sides [m]."""
        ...

    def extent(self, direction: Float[Any, "*batch 3"], library: Any) -> tuple[Float[Any, "..."], Float[Any, "..."]]:
        """How far it reaches from its origin against and along unit vectors [m]."""
        ...

    def rim(self) -> Float[np.ndarray, "corners 2"]:
        """A convex polygon around it seen from above, counter-clockwise [m]."""
        ...

    def hulls(self, erosion: float) -> list[trimesh.Trimesh]:
        """Convex solids that together are the solid shrunk by `erosion` on all sides [m]."""
        ...


@dataclasses.dataclass(frozen=True)
class SingleShape:
    """The `Solid` of a shape, with half-extents [m]."""

    shape: Shape
    half_size: tuple[float, float, float]

    @property
    def round(self) -> bool:
        return self.shape.round

    @property
    def turn(self) -> float:
        return math.pi

    @property
    def ends_alike(self) -> bool:
        return True

    @property
    def yaws(self) -> int:
        return self.shape.yaws

    @property
    def bottom(self) -> float:
        return self.half_size[2]

    @property
    def top(self) -> float:
        return self.half_size[2]

    @property
    def radius(self) -> float:
        return self.half_size[0] if self.round else math.hypot(*self.half_size[:2])

    @property
    def breadth(self) -> float:
        return min(self.half_size[:2])

    def distance(self, level, height, library):
        return self.shape.distance(level, height, self.half_size, library)

    def cut(self, origin, direction, grown, library):
        half = np.array(self.half_size)
        half = half + grown if grown >= 0.0 else np.maximum(half + grown, -grown)
        return self.shape.cut(origin, direction, half, library)

    def extent(self, direction, library):
        reach = self.shape.reach(direction, library.array(self.half_size)[None], library)
        return reach, reach

    def rim(self) -> Float[np.ndarray, "corners 2"]:
        return self.shape.rim(self.half_size)

    def hulls(self, erosion: float) -> list[trimesh.Trimesh]:
        return [self.shape.mesh([half - erosion for half in self.half_size])]


@dataclasses.dataclass(frozen=True)
class Union:
    """The `Solid` of a compound, which is centred."""

    compound: Compound

    @property
    def round(self) -> bool:
        return _symmetry(self.compound) == 0.0

    @property
    def turn(self) -> float:
        return _symmetry(self.compound) or math.pi

    @property
    def ends_alike(self) -> bool:
        return False

    @property
    def yaws(self) -> int:
        return 1 if self.round else round(YAWS * self.turn / (2 * math.pi))

    @property
    def bottom(self) -> float:
        return float(union.reach(self.compound, np.array([0.0, 0.0, -1.0]), np))

    @property
    def top(self) -> float:
        return float(union.reach(self.compound, np.array([0.0, 0.0, 1.0]), np))

    @property
    def radius(self) -> float:
        return float(np.linalg.norm(self.rim(), axis=1).max())

    @property
    def breadth(self) -> float:
        angle = np.arange(180) * (math.pi / 180)
        level = np.stack([np.cos(angle), np.sin(angle), np.zeros(180)], axis=1)
        against, along = self.extent(level, np)
        return float((against + along).min()) / 2

    def distance(self, level, height, library):
        return union.distance(self.compound, [level[..., 0], level[..., 1], height], library)

    def cut(self, origin, direction, grown, library):
        return union.cut(self.compound, origin, direction, grown, library)

    def extent(self, direction, library):
        return union.reach(self.compound, -direction, library), union.reach(self.compound, direction, library)

    def rim(self) -> Float[np.ndarray, "corners 2"]:
        return _rim(self.compound)

    def hulls(self, erosion: float) -> list[trimesh.Trimesh]:
        return [_shrunk(solid, erosion) for solid in solids(self.compound.pieces)]


def _shrunk(solid: Piece, erosion: float) -> trimesh.Trimesh:
    """A convex solid in the body's frame, shrunk on all sides, to no less than half of its size."""
    import trimesh

    if solid.shape == CONVEX:
        whole = mesh(solid)
        middle = np.asarray(whole.vertices).mean(axis=0)
        gap = np.einsum("fi,fi->f", np.asarray(whole.face_normals), np.asarray(whole.triangles_center) - middle)
        share = max(1.0 - erosion / max(float(gap.min()), 1e-9), union.LEAST_SHARE)
        whole.vertices = middle + share * (np.asarray(whole.vertices) - middle)
        return whole
    half = np.array(solid.half_size)
    surface = PRIMITIVES[solid.shape].mesh(np.maximum(half - erosion, union.LEAST_SHARE * half).tolist())
    vertices = solid.in_body(np.asarray(surface.vertices))
    return trimesh.Trimesh(vertices, surface.faces, process=False)


@functools.lru_cache(maxsize=256)
def _rim(compound: Compound) -> Float[np.ndarray, "corners 2"]:
    """The polygon whose sides touch the solid in evenly spread directions."""
    from scipy.spatial import ConvexHull

    count = 72
    angle = np.arange(count) * (2 * math.pi / count)
    normal = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    reach = union.reach(compound, normal, np)
    # The corner between two neighbouring sides.
    following = np.roll(reach, -1)
    step = math.sin(2 * math.pi / count)
    c, s = normal[:, 0], normal[:, 1]
    c2, s2 = np.roll(c, -1), np.roll(s, -1)
    corners = np.stack([(reach * s2 - following * s) / step, (following * c - reach * c2) / step], axis=1)
    return corners[ConvexHull(corners).vertices]


@functools.lru_cache(maxsize=256)
def surface(compound: Compound, count: int, erosion: float = 0.0) -> Float[np.ndarray, "n 3"]:
    """At most `count` points spread evenly over the surface of the union of a compound's solids [m]; must not be
    changed.

    Args:
      compound: centred.
      count: number of points.
      erosion: by how much every solid is shrunk on all sides [m].
    """
    import trimesh

    whole: Any = trimesh.util.concatenate(Union(compound).hulls(erosion))
    points, face = trimesh.sample.sample_surface(whole, 4 * count, seed=0)[:2]
    # Where solids touch or overlap, there is another one just outside of a surface.
    outside = np.asarray(points) + JUST_OUTSIDE * np.asarray(whole.face_normals)[face]
    free = np.asarray(points)[~union.inside(compound, outside, erosion)]
    # In random order: any leading ones are spread evenly, too.
    return free[np.random.default_rng(0).permutation(len(free))[:count]]


@functools.lru_cache(maxsize=256)
def _symmetry(compound: Compound) -> float:
    """The yaw after which a compound looks the same [rad]; 0 if that is any."""
    points = surface(compound, SURFACE_POINTS)

    def same(angle: float) -> bool:
        c, s = math.cos(angle), math.sin(angle)
        turned = points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return float(union.distance(compound, list(turned.T), np).max()) < ALIKE

    if all(same(2 * math.pi * i / TURNS) for i in range(1, TURNS)):
        return 0.0
    return math.pi if same(math.pi) else 2 * math.pi
