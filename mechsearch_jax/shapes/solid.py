"""The solid that a target is: a box, a cylinder, or the union of a compound's pieces; without JAX.

Points and directions are in the body's frame, whose origin is the centre of a shape and the centre of mass of a
compound. Methods with a `library`, NumPy or `jax.numpy`, take and return its arrays.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mechsearch_jax.shapes import union
from mechsearch_jax.shapes.compound import CONVEX, Compound, Piece, mesh, solids
from mechsearch_jax.shapes.primitives import PRIMITIVES, Shape

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


@dataclasses.dataclass(frozen=True)
class Solid:
    """What is computed with a target's geometry; `solid_of` makes it.

    Attributes:
      body: a shape, or a compound, which is centred.
      half_size: half-extents [m]; of a compound those of the smallest box about its centre of mass.
      round: whether it is a solid of revolution about its third axis.
      turn: the yaw after which it looks the same [rad]: half a turn or a full one; half a turn if it is round.
      ends_alike: whether it looks the same upside down.
      yaws: usual number of candidate yaw angles over a `turn`.
      bottom, top: how far below the origin its lowest point is, and how far above its highest [m].
      radius: largest distance of a point from the vertical axis [m].
      breadth: half of its least width seen from above [m].
    """

    body: Shape | Compound
    half_size: tuple[float, float, float]
    round: bool
    turn: float
    ends_alike: bool
    yaws: int
    bottom: float
    top: float
    radius: float
    breadth: float

    def distance(
        self, level: Float[Any, "*batch 2"], height: Float[Any, "*batch"], library: Any
    ) -> Float[Any, "*batch"]:
        """Signed distance of points to its surface [m], negative inside; its derivatives are finite everywhere."""
        if isinstance(self.body, Shape):
            return self.body.distance(level, height, self.half_size, library)
        return union.distance(self.body, [level[..., 0], level[..., 1], height], library)

    def cut(
        self,
        origin: Sequence[Float[Any, "*#rays"]],
        direction: Sequence[Float[Any, "*#rays"]],
        grown: float,
        library: Any,
    ) -> Float[Any, "*rays"]:
        """Where rays from outside enter it, see `Primitive.cut`, if it is larger by `grown` on all sides [m]."""
        if not isinstance(self.body, Shape):
            return union.cut(self.body, origin, direction, grown, library)
        half = np.array(self.half_size)
        half = half + grown if grown >= 0.0 else np.maximum(half + grown, -grown)
        return self.body.cut(origin, direction, half, library)

    def extent(self, direction: Float[Any, "*batch 3"], library: Any) -> tuple[Float[Any, "..."], Float[Any, "..."]]:
        """How far it reaches from its origin against and along unit vectors [m]."""
        if not isinstance(self.body, Shape):
            return _extent(self.body, direction, library)
        reach = self.body.reach(direction, library.array(self.half_size)[None], library)
        return reach, reach

    def rim(self) -> Float[np.ndarray, "corners 2"]:
        """A convex polygon around it seen from above, counter-clockwise [m]."""
        return self.body.rim(self.half_size) if isinstance(self.body, Shape) else _rim(self.body)

    def hulls(self, erosion: float) -> list[trimesh.Trimesh]:
        """Convex solids that together are the solid shrunk by `erosion` on all sides [m]."""
        if isinstance(self.body, Shape):
            return [self.body.mesh([half - erosion for half in self.half_size])]
        return [_shrunk(solid, erosion) for solid in solids(self.body.pieces)]


@functools.lru_cache(maxsize=256)
def solid_of(body: Shape | Compound, half_size: tuple[float, float, float]) -> Solid:
    """The geometry of a shape of these half-extents [m], or of a centred compound that they are a box around."""
    if isinstance(body, Shape):
        radius = half_size[0] if body.round else math.hypot(*half_size[:2])
        low = high = half_size[2]
        return Solid(
            body, half_size, body.round, math.pi, True, body.yaws, low, high, radius, breadth=min(half_size[:2])
        )
    symmetry = _symmetry(body)
    turn = symmetry or math.pi
    bottom, top = (float(reach) for reach in _extent(body, np.array([0.0, 0.0, 1.0]), np))
    angle = np.arange(180) * (math.pi / 180)
    against, along = _extent(body, np.stack([np.cos(angle), np.sin(angle), np.zeros(180)], axis=1), np)
    return Solid(
        body,
        half_size,
        round=symmetry == 0.0,
        turn=turn,
        ends_alike=False,
        yaws=1 if symmetry == 0.0 else round(YAWS * turn / (2 * math.pi)),
        bottom=bottom,
        top=top,
        radius=float(np.linalg.norm(_rim(body), axis=1).max()),
        breadth=float((against + along).min()) / 2,
    )


def _extent(compound: Compound, direction: Float[Any, "*batch 3"], library: Any) -> tuple[Any, Any]:
    return union.reach(compound, -direction, library), union.reach(compound, direction, library)


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

    whole: Any = trimesh.util.concatenate([_shrunk(solid, erosion) for solid in solids(compound.pieces)])
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
