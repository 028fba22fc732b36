"""The target, whose shape is known, and the finite set of its candidate poses (paper section 3)."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax.runtime.errors import InputError, check_range
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.shelf import Shelf

# Largest half-extent and inset [m], and largest number of candidate poses.
LARGEST = 1.0
MOST_POSES = 100_000


@dataclasses.dataclass(frozen=True)
class Target:
    """An upright target of known shape.

    Attributes:
      shape: name of its shape.
      half_size: half-extents [m].
      grid: number of candidate positions in x and y.
      inset: distance between the outermost candidate positions and the board's edges [m].
      yaws: number of candidate yaw angles over half a turn; 1 for a round target.
    """

    shape: str = "cylinder"
    half_size: tuple[float, float, float] = (0.02, 0.02, 0.05)
    grid: tuple[int, int] = (18, 44)
    inset: float = 0.05
    yaws: int = 1

    def __post_init__(self):
        shape = shape_of(self.shape, "Target: shape")
        if len(self.half_size) != 3 or not all(0 < s <= LARGEST for s in self.half_size):
            raise InputError(
                f"Target: half_size {self.half_size} must be three positive lengths in metres, at most {LARGEST}"
            )
        if fault := shape.fault(self.half_size):
            raise InputError(f"Target: half_size {self.half_size}: {fault}")
        if min(self.grid) < 2 or self.yaws < 1:
            raise InputError(
                f"Target: grid {self.grid} needs at least 2 positions an axis and yaws {self.yaws} at least 1"
            )
        if self.grid[0] * self.grid[1] * self.yaws > MOST_POSES:
            raise InputError(f"Target: grid {self.grid} and yaws {self.yaws} make more than {MOST_POSES} poses")
        check_range("Target: inset", self.inset, 0.0, LARGEST, "m")

    @classmethod
    def of(cls, shape: str, half_size: tuple[float, float, float] | None = None) -> Target:
        """The target of a shape, with the shape's number of yaw angles.

        Args:
          shape: its name.
          half_size: half-extents [m]; the shape's usual ones if left out.

        Raises:
          InputError: there is no such shape, or it cannot have these half-extents.
        """
        kind = shape_of(shape)
        return cls(kind.name, half_size or kind.target_half_size, yaws=kind.yaws)

    def resized(self, shape: str, half_size: tuple[float, float, float]) -> Target:
        """A target of a shape and half-extents [m] with this one's grid and inset.

        It has this target's yaw angles if the shape is the same, else the other shape's usual ones.

        Raises:
          InputError: as `of`.
        """
        other = Target.of(shape, half_size)
        yaws = self.yaws if other.shape == self.shape else other.yaws
        return dataclasses.replace(other, grid=self.grid, inset=self.inset, yaws=yaws)

    @classmethod
    def cylinder(cls) -> Target:
        return cls.of("cylinder")

    @classmethod
    def box(cls) -> Target:
        return cls.of("box")

    @property
    def exponents(self) -> tuple[float, float]:
        return shape_of(self.shape).exponents

    def height(self, shelf: Shelf) -> float | Array:
        """z of the centre of a target that stands on the board [m]; the shelf may be traced."""
        return shelf.board + self.half_size[2]

    def candidate_poses(self, shelf: Shelf) -> Float[np.ndarray, "x 3"]:
        """The candidate poses X as rows of x, y [m] and yaw [rad], yaw varying fastest and x slowest.

        The outermost positions are `inset` from the board's edges; the default spacing is 15 to 16 mm.
        """
        x = np.linspace(shelf.front + self.inset, shelf.back - self.inset, self.grid[0])
        y = np.linspace(shelf.right + self.inset, shelf.left - self.inset, self.grid[1])
        yaw = np.arange(self.yaws) * np.pi / self.yaws
        return np.stack(np.meshgrid(x, y, yaw, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)

    def places(self, shelf: Shelf, shares: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "x s 3"]:
        """Places in the grid cell of each candidate pose: x, y [m] and yaw [rad].

        The outermost cells reach to where a target touches the back or a side wall, for pushes take it there, and no
        other pose represents it. They are not extended at the front, where little hides the target.

        Args:
          shelf: as in `candidate_poses`.
          shares: positions in a cell, relative to half of its size; 1 is at a corner.
        """
        poses = self.candidate_poses(shelf)
        offsets = np.tile(shares * np.array(self.cell(shelf), np.float32) / 2, (len(poses), 1, 1))
        outward = max(self.inset - min(self.half_size[:2]), 0.0)
        for axis, side in ((0, 1.0), (1, 1.0), (1, -1.0)):
            outermost = poses[:, axis] * side == np.max(poses[:, axis] * side)
            offsets[np.ix_(outermost, shares[:, axis] == side, [axis])] = side * outward
        return poses[:, None] + offsets

    def cell(self, shelf: Shelf) -> tuple[float, float, float]:
        """Spacing of the candidate poses in x, y [m] and yaw [rad]."""
        return (
            (shelf.back - shelf.front - 2 * self.inset) / (self.grid[0] - 1),
            (shelf.left - shelf.right - 2 * self.inset) / (self.grid[1] - 1),
            np.pi / self.yaws if self.yaws > 1 else 0.0,
        )
