"""The bodies of a world as solids that pictures and the viewer can show: of a compound each of its solids."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mechsearch_jax.envs.camera.simulated_camera import PALETTE
from mechsearch_jax.envs.world.world import BODIES, TARGET, World, bodies_of
from mechsearch_jax.shapes import PRIMITIVES, in_order, union
from mechsearch_jax.shapes.compound import CONVEX, Compound, Piece, faces, hull, solids, surface_points
from mechsearch_jax.shapes.primitives import Surface
from mechsearch_jax.viz.raycast import Colour, VisibleSolid

if TYPE_CHECKING:
    import trimesh


@dataclasses.dataclass(frozen=True, eq=False)
class Polyhedron(Surface):
    """A convex polyhedron as a surface of pictures, whatever half-extents are said.

    Attributes:
      piece: of a compound.
      planes: its half-spaces n . x <= d in its own frame, as rows (n, d).
    """

    piece: Piece
    planes: Float[np.ndarray, "n 4"]

    def cut(
        self, origin: Sequence[Any], direction: Sequence[Any], half_size: Float[Any, "3 *#rays"], library: Any
    ) -> Float[Any, "*rays"]:
        near, far = library.full_like(direction[0], np.inf), library.full_like(direction[0], 0.0)
        for *normal, offset in self.planes.tolist():
            near, far = union.crossed(normal, offset, origin, direction, (near, far), library)
        return union.entry(near, far, library)

    def normal(
        self, point: Float[Any, "*batch 3"], half_size: Float[Any, "*batch 3"], library: Any
    ) -> Float[Any, "*batch 3"]:
        above = point @ self.planes[:, :3].T - self.planes[:, 3]
        return self.planes[:, :3][library.argmax(above, axis=-1)]

    def mesh(self, half_size: Sequence[float]) -> trimesh.Trimesh:
        return hull(self.piece).copy()


def slot_colour(index: int) -> Colour:
    """The colour of a body's slot, or of the shelf."""
    red, green, blue = (float(c) for c in PALETTE[index])
    return red, green, blue


def body_solids(world: World) -> dict[int, list[VisibleSolid]]:
    """The solids of the bodies that are there, by slot, each in the frame of its body.

    Args:
      world: NumPy arrays without leading axes.
    """
    bodies = [None] * BODIES if world.compounds is None else bodies_of(world)
    shown = {}
    for i in np.flatnonzero(world.valid).tolist():
        body = bodies[i]
        if body is not None and body.compound is not None:
            shown[i] = _of_compound(body.compound, i)
        else:
            shape, half = in_order()[int(world.kind[i])], np.asarray(world.half_size[i])
            shown[i] = [VisibleSolid(shape, half, np.eye(3), np.zeros(3), slot_colour(i))]
    return shown


def _of_compound(compound: Compound, slot: int) -> list[VisibleSolid]:
    colour = slot_colour(slot) if slot == TARGET else compound.colour or slot_colour(slot)
    return [
        VisibleSolid(_surface(solid), _half(solid), solid.rotation, np.array(solid.position), colour)
        for solid in solids(compound.pieces)
    ]


def _surface(solid: Piece) -> Any:
    return Polyhedron(solid, faces(solid)) if solid.shape == CONVEX else PRIMITIVES[solid.shape]


def _half(solid: Piece) -> Float[np.ndarray, " 3"]:
    """Half-extents of a solid about its centre [m]."""
    return np.abs(np.array(solid.vertices)).max(axis=0) if solid.shape == CONVEX else np.array(solid.half_size)


def moved(solid: VisibleSolid, rotation: Float[np.ndarray, "3 3"], position: Float[np.ndarray, " 3"]) -> VisibleSolid:
    """A solid in the world, from that in the frame of its body, which has a pose."""
    return dataclasses.replace(solid, rotation=rotation @ solid.rotation, position=rotation @ solid.position + position)


def body_points(world: World) -> dict[int, Float[np.ndarray, "points 3"]]:
    """Points whose hull contains each body that is there, by slot, in its own frame [m]; see `body_solids`."""
    bodies = [None] * BODIES if world.compounds is None else bodies_of(world)
    points = {}
    for i in np.flatnonzero(world.valid).tolist():
        body = bodies[i]
        if body is not None and body.compound is not None:
            points[i] = surface_points(body.compound)
        else:
            half = [float(h) for h in world.half_size[i]]
            level = in_order()[int(world.kind[i])].rim(half)
            points[i] = np.concatenate([np.column_stack([level, np.full(len(level), z)]) for z in (-half[2], half[2])])
    return points
