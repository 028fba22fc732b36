"""The shelf's inner faces as planes, and which flat patches of an image may lie on them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mechsearch_jax.workspace.shelf import Shelf


class Face(NamedTuple):
    """An inner face of the shelf, across an axis of the world.

    Attributes:
      name: in messages.
      field: of `Shelf`, its place.
      axis: 0, 1, 2 for x, y, z.
      inward: 1 if the free space is where the coordinate is larger, else -1.
    """

    name: str
    field: str
    axis: int
    inward: float

    @property
    def normal(self) -> Float[np.ndarray, "3"]:
        """Unit vector into the free space."""
        return self.inward * np.eye(3)[self.axis]

    def height(self, shelf: Shelf, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """How far points are in front of the face, negative behind it [m]."""
        return self.inward * (points[:, self.axis] - getattr(shelf, self.field))

    def across(self, shelf: Shelf, points: Float[np.ndarray, "n 3"], spare: float) -> Bool[np.ndarray, " n"]:
        """Whether points are within the face's edges, or at most `spare` [m] beyond them."""
        ranges = ((shelf.front, shelf.back), (shelf.right, shelf.left), (shelf.board, shelf.ceiling))
        within = np.ones(len(points), bool)
        for axis, (low, high) in enumerate(ranges):
            if axis != self.axis:
                within &= (points[:, axis] > low - spare) & (points[:, axis] < high + spare)
        return within


FACES = (
    Face("board", "board", 2, 1.0),
    Face("back wall", "back", 0, -1.0),
    Face("right side wall", "right", 1, 1.0),
    Face("left side wall", "left", 1, -1.0),
    Face("upper board", "ceiling", 2, -1.0),
)
