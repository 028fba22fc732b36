"""The shelf of planner and simulator: a box of free space, open at the front (-x)."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.transforms import transform_rows
from mechsearch_jax.runtime.errors import InputError, check_range
from mechsearch_jax.workspace.leaves import are_given

# Largest coordinate, and largest thickness of a board [m].
FARTHEST, THICKEST = 10.0, 0.5
# The fields that are numbers, and those that are ranges; all are dynamic under `jit`.
_NUMBERS = ("front", "back", "right", "left", "board", "ceiling", "thickness", "side_margin", "ceiling_margin")
_RANGES = ("spawn_x", "spawn_y")


@functools.partial(jax.tree_util.register_dataclass, data_fields=(*_NUMBERS, *_RANGES), meta_fields=())
@dataclasses.dataclass(frozen=True)
class Shelf:
    """Inner faces of the shelf in the robot's base frame [m]; +x points into the shelf, z up (docs/method.md,
    "Facts of the scene").

    A pytree, so that a shelf with other measures recompiles nothing where a jitted function takes it as a dynamic
    argument. Outside of tracing it holds plain numbers and is hashable.

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

    def __post_init__(self):
        # In a pytree rebuilt by JAX, fields may hold tracers or other stand-ins, which are not checked.
        if not are_given(*(getattr(self, name) for name in (*_NUMBERS, *_RANGES))):
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
    inside = (
        (x <= shelf.back)
        & (y >= shelf.right + shelf.side_margin)
        & (y <= shelf.left - shelf.side_margin)
        & (z >= shelf.board)
        & (z <= shelf.ceiling - shelf.ceiling_margin)
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
    to_wall = jnp.minimum(y - shelf.right, shelf.left - y) - shelf.side_margin
    to_board = jnp.minimum(z - shelf.board, shelf.ceiling - z - shelf.ceiling_margin)
    beside = jnp.maximum(jnp.minimum(to_wall, to_board), 0.0)
    before = jnp.maximum(shelf.front - x, 0.0)
    radii = radii.reshape((1,) * (x.ndim - 1) + radii.shape)
    return (beside**2 + before**2 < radii**2) | (x + radii > shelf.back)
