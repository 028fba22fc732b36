"""The shelf of planner and simulator: a box of free space, open at the front (-x)."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.transforms import transform_rows
from mechsearch_jax.runtime.errors import InputError, check_range, shown
from mechsearch_jax.workspace.leaves import are_given

# Largest coordinate, and largest thickness of a board [m].
FARTHEST, THICKEST = 10.0, 0.5
# The fields that are numbers, and those that are ranges; all are dynamic under `jit`.
_NUMBERS = ("front", "back", "right", "left", "board", "ceiling", "thickness", "side_margin", "ceiling_margin")
_RANGES = ("spawn_x", "spawn_y")
# The faces that may be missing; a missing one is this far away for all that faces stop or hide [m].
FACES = ("back", "right", "left", "ceiling")
AWAY = 100.0


class Walls(NamedTuple):
    """Where the faces in `FACES` are [m]; those that a shelf does not have are `AWAY` from their places."""

    back: Any
    right: Any
    left: Any
    ceiling: Any


@dataclasses.dataclass(frozen=True)
class Shelf:
    """Inner faces of the shelf in the robot's base frame [m]; +x points into the shelf, z up (docs/method.md,
    "Facts of the scene").

    A pytree, so that a shelf with other measures or faces recompiles nothing where a jitted function takes it as a
    dynamic argument. Outside of tracing it holds plain numbers and is hashable. Where a face is missing, its place
    still bounds what is searched and where things are put: a board without faces is a part of a table top.

    Attributes:
      front: x of the board's front edge.
      back: x of the back wall's face.
      right: y of the side wall with the smaller y.
      left: y of the side wall with the larger y.
      board: z of the board's top, on which objects stand.
      ceiling: z of the upper board's underside.
      thickness: thickness of the boards.
      side_margin: the planner's distance from the side walls.
      ceiling_margin: the planner's distance from the upper board.
      spawn_x: range of x in which the generator drops object centres.
      spawn_y: the same for y.
      faces: which of `FACES` there are; the others stop no motion, hide nothing and are not looked for in images.
    """

    front: float = 0.414
    back: float = 0.788
    right: float = -0.2835
    left: float = 0.4835
    board: float = 0.4045
    ceiling: float = 0.773
    thickness: float = 0.022
    side_margin: float = 0.009
    ceiling_margin: float = 0.011
    spawn_x: tuple[float, float] = (0.45, 0.73)
    spawn_y: tuple[float, float] = (-0.18, 0.38)
    faces: tuple[str, ...] = FACES

    def __post_init__(self):
        # In a pytree rebuilt by JAX, fields may hold tracers or other stand-ins, which are not checked.
        if not are_given(*(getattr(self, name) for name in (*_NUMBERS, *_RANGES, "faces"))):
            return
        for name in ("front", "back", "right", "left", "board", "ceiling"):
            check_range(f"Shelf: {name}", getattr(self, name), -FARTHEST, FARTHEST, "m")
        for name, least in (("thickness", 1e-3), ("side_margin", 0.0), ("ceiling_margin", 0.0)):
            check_range(f"Shelf: {name}", getattr(self, name), least, THICKEST, "m")
        for low, high in (("front", "back"), ("right", "left"), ("board", "ceiling")):
            if not getattr(self, low) < getattr(self, high):
                raise InputError(f"Shelf: {low} ({getattr(self, low)}) must be below {high} ({getattr(self, high)})")
        for name in ("spawn_x", "spawn_y"):
            low, high = getattr(self, name)
            if not -FARTHEST <= low < high <= FARTHEST:
                raise InputError(f"Shelf: {name} ({low}, {high}) must be two places in metres, the smaller first")
        # Convert to one type, for other types would be compiled for anew.
        for name in _NUMBERS:
            object.__setattr__(self, name, float(getattr(self, name)))
        for name in _RANGES:
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))
        object.__setattr__(self, "faces", self._named_faces())

    def __repr__(self) -> str:
        # Faces only where some are missing, so that searches that were saved before that could be go on.
        are_all = all(isinstance(face, str) for face in self.faces) and self.faces == FACES
        names = (*_NUMBERS, *_RANGES, *(() if are_all else ("faces",)))
        return f"Shelf({', '.join(f'{name}={getattr(self, name)!r}' for name in names)})"

    def _named_faces(self) -> tuple[str, ...]:
        """The faces' names in the order of `FACES`, from names or from the pytree's numbers."""
        if not any(isinstance(face, str) for face in self.faces) and len(self.faces) == len(FACES):
            return tuple(name for name, is_there in zip(FACES, self.faces, strict=True) if is_there)
        if isinstance(self.faces, str) or not set(self.faces) <= set(FACES):
            known = ", ".join(FACES)
            raise InputError(f"Shelf: faces {shown(self.faces)} must be a list of those there are of {known}")
        return tuple(name for name in FACES if name in self.faces)

    @property
    def _are_there(self) -> tuple[Any, ...]:
        """1 for each of `FACES` that there is, else 0."""
        if all(isinstance(face, str) for face in self.faces):
            return tuple(float(name in self.faces) for name in FACES)
        return self.faces

    @property
    def walls(self) -> Walls:
        """What stops motions and hides things; all numbers, or arrays if the shelf is traced."""
        away = [AWAY * (1.0 - is_there) for is_there in self._are_there]
        return Walls(self.back + away[0], self.right - away[1], self.left + away[2], self.ceiling + away[3])

    def is_open(self, face: str) -> Any:
        """Whether one of `FACES` is missing; an array if the shelf is traced."""
        return self._are_there[FACES.index(face)] < 0.5

    def moved(self, shift: tuple[float, float, float]) -> Shelf:
        """The same shelf elsewhere, by a translation in the world [m]."""
        x, y, z = shift
        return dataclasses.replace(
            self,
            front=self.front + x,
            back=self.back + x,
            right=self.right + y,
            left=self.left + y,
            board=self.board + z,
            ceiling=self.ceiling + z,
            spawn_x=(self.spawn_x[0] + x, self.spawn_x[1] + x),
            spawn_y=(self.spawn_y[0] + y, self.spawn_y[1] + y),
        )


def _flatten(shelf: Shelf) -> tuple[tuple[Any, ...], None]:
    return (*(getattr(shelf, name) for name in (*_NUMBERS, *_RANGES)), shelf._are_there), None


def _flatten_with_keys(shelf: Shelf) -> tuple[tuple[Any, ...], None]:
    names = (jax.tree_util.GetAttrKey(name) for name in (*_NUMBERS, *_RANGES, "faces"))
    return tuple(zip(names, _flatten(shelf)[0], strict=True)), None


jax.tree_util.register_pytree_with_keys(Shelf, _flatten_with_keys, lambda _, fields: Shelf(*fields), _flatten)


def past_open_side(
    shelf: Shelf, x: Float[Array, "*batch"], y: Float[Array, "*batch"], margin: float
) -> Bool[Array, "*batch"]:
    """Whether places are beyond the board's edge at the back or a side without a wall, or at most `margin` [m] before
    it: what stands there may fall."""
    gaps = {"back": shelf.back - x, "right": y - shelf.right, "left": shelf.left - y}
    return jnp.any(jnp.stack([(gap < margin) & shelf.is_open(face) for face, gap in gaps.items()]), axis=0)


def on_host(shelf: Shelf, *row: int) -> Shelf:
    """The original shelf from one that a jitted function returned: with the shortest decimals that round to float32.

    Args:
      shelf: its leaves are NumPy arrays, float32.
      row: index along the leading axes of the leaves, if there are several shelves.
    """
    return jax.tree.map(lambda numbers: float(str(np.float32(numbers[row]))), shelf)


def hits_shelf(shelf: Shelf, points: Float[Array, "*batch 3"]) -> Bool[Array, "*batch"]:
    """Whether world points are in the shelf's solid parts, which include the margins at sides and ceiling.

    Everything beyond the front edge and outside the free box counts as solid.
    """
    return _in_shelf(shelf, points[..., 0], points[..., 1], points[..., 2])


def cloud_hits_shelf(
    shelf: Shelf, T_world_cloud: Float[Array, "*batch 4 4"], cloud: Float[Array, "*#batch 3 p"]
) -> Bool[Array, "*batch"]:
    """Whether a point of a placed cloud, given as rows of coordinates in its frame, is in the shelf's solid parts."""
    return jnp.any(_in_shelf(shelf, *transform_rows(T_world_cloud, cloud)), axis=-1)


def _in_shelf(
    shelf: Shelf, x: Float[Array, "*batch"], y: Float[Array, "*batch"], z: Float[Array, "*batch"]
) -> Bool[Array, "*batch"]:
    walls = shelf.walls
    inside = (
        (x <= walls.back)
        & (y >= walls.right + shelf.side_margin)
        & (y <= walls.left - shelf.side_margin)
        & (z >= shelf.board)
        & (z <= walls.ceiling - shelf.ceiling_margin)
    )
    return (x > shelf.front) & ~inside


def spheres_hit_shelf(
    shelf: Shelf, centres: Float[Array, "*batch n 3"], radii: Float[Array, " n"]
) -> Bool[Array, "*batch n"]:
    """Whether spheres touch the shelf's solid parts (`hits_shelf`); at the front, the edges count, not their plane.

    Args:
      shelf: the shelf.
      centres: in the world [m].
      radii: above 0 [m].
    """
    x, y, z = (centres[..., axis] for axis in range(3))
    return placed_spheres_hit_shelf(shelf, x, y, z, radii)


def placed_spheres_hit_shelf(
    shelf: Shelf,
    x: Float[Array, "*batch n"],
    y: Float[Array, "*batch n"],
    z: Float[Array, "*batch n"],
    radii: Float[Array, " n"],
) -> Bool[Array, "*batch n"]:
    """`spheres_hit_shelf` with one array for each coordinate of the centres."""
    walls = shelf.walls
    to_wall = jnp.minimum(y - walls.right, walls.left - y) - shelf.side_margin
    to_board = jnp.minimum(z - shelf.board, walls.ceiling - z - shelf.ceiling_margin)
    beside = jnp.maximum(jnp.minimum(to_wall, to_board), 0.0)
    before = jnp.maximum(shelf.front - x, 0.0)
    radii = radii.reshape((1,) * (x.ndim - 1) + radii.shape)
    return (beside**2 + before**2 < radii**2) | (x + radii > walls.back)
