"""The shelf as the planner and the simulator know it: a box of free space, open at the front (-x)."""

from __future__ import annotations

import dataclasses

from mechsearch_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class Shelf:
    """Inner faces of the shelf in the robot's base frame [m]; +x points into the shelf, z up (DESIGN.md section 4).

    Attributes:
      front: x of the board's front edge.
      back: x of the back wall's face.
      right: y of the side wall with the smaller y.
      left: y of the side wall with the larger y.
      board: z of the board's top, on which objects stand.
      ceiling: z of the upper board's underside.
      thickness: thickness of the boards.
      side_margin: how much closer than they are the planner takes the side walls to be.
      ceiling_margin: the same for the upper board.
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
        for low, high in (("front", "back"), ("right", "left"), ("board", "ceiling")):
            if not getattr(self, low) < getattr(self, high):
                raise InputError(f"Shelf: {low} ({getattr(self, low)}) must be below {high} ({getattr(self, high)})")
