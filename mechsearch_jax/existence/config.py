"""Settings of f."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import numpy as np

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.options import option
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.detector import FOUND_PIXELS, found_pixels, longer


@dataclasses.dataclass(frozen=True)
class ExistenceConfig:
    """Settings of f.

    Attributes:
      criterion: what makes the target visible: "detector" counts the pixels it would show at full resolution;
        "depth-mse" is the paper's mean squared difference of the two depth images.
      found_pixels: the detector finds the target if it shows more pixels than this in an image of 1280 x 720; in other
        images the same share, see `workspace.detector`.
      depth_threshold: threshold of "depth-mse" [m^2].
      downscale: factor by which f is rendered coarser than an image of 1280 x 720; with other images scaled to keep the
        size of a coarse pixel, rounded to a whole number.
      cell_reach: the target is tested at the middle of its grid cell and at these shares of the distance to each of the
        cell's corners in x and y; at the corners themselves (1) it is also turned by half a step in yaw, to alternating
        sides, and the corners of the outermost cells lie at the walls.
      closer_look: factor by which the image of a closer look is coarser than 1280 x 720, scaled likewise; 0 for none.
      erosion: by how much the target is shrunk for the collision test [m]: a pushed target touches objects, often on
        several sides, so that hardly any place of its cell would be free. That is too rare to gain anything.
      reopen: whether f is opened again around what an action may have moved unseen; see `belief.unseen_motion`.
      window: rows and columns of the window an object is rendered in, at the coarse resolution.
      points: points on the target's surface for the collision test.
    """

    criterion: Literal["detector", "depth-mse"] = option(
        "detector",
        "what makes a target visible: its pixels, as the detector counts them, or the depth image, as in the paper",
        ("detector", "depth-mse"),
    )
    found_pixels: int = FOUND_PIXELS
    depth_threshold: float = 0.001
    downscale: int = 7
    cell_reach: tuple[float, ...] = option(
        (1.0,), "how far from the middle of its grid cell to the corners a target is tried; none for the middle alone"
    )
    closer_look: int = option(
        3, "where few of the target's pixels show, they are counted again in an image this much coarser; 0 for never"
    )
    erosion: float = option(
        0.0, "how deep a target that may be somewhere may reach into an object, on all sides [m]; the paper's is 0"
    )
    reopen: bool = option(
        True, "whether f is opened again around what an action may have moved unseen; not in the paper"
    )
    window: tuple[int, int] = (48, 48)
    points: int = 512

    def __post_init__(self):
        if self.criterion not in ("detector", "depth-mse"):
            raise InputError(f'criterion "{self.criterion}" is unknown; use "detector" or "depth-mse"')
        if not all(0.0 < share <= 1.0 for share in self.cell_reach):
            raise InputError(f"cell_reach {self.cell_reach} must be shares above 0 and at most 1")
        if not 0.0 <= self.erosion < math.inf:
            raise InputError(f"erosion {self.erosion} m must be a number that is not negative")
        if self.downscale < 1:
            raise InputError(f"ExistenceConfig: downscale {self.downscale} must be at least 1")
        if not 0 <= self.closer_look < max(self.downscale, 2):
            raise InputError(f"closer_look {self.closer_look} must be 0 or more and below downscale {self.downscale}")

    @property
    def places(self) -> np.ndarray:
        """Places in a cell where the target is tested: x, y and yaw as shares of half the cell, shape (S, 3)."""
        corners = [(a, b, a * b * (share == 1.0)) for share in self.cell_reach for a, b in _corners(share)]
        return np.array([(0.0, 0.0, 0.0), *corners], np.float32)

    def step(self, camera: Camera) -> int:
        """Side of a coarse pixel in pixels of a camera's image."""
        return max(round(self.downscale * longer(camera)), 1)

    def closer_step(self, camera: Camera) -> int:
        """Side of a pixel of the closer look in pixels of a camera's image; `step` if there is no closer look."""
        if self.criterion != "detector" or not self.closer_look:
            return self.step(camera)
        return max(round(self.closer_look * longer(camera)), 1)

    def allowed(self, camera: Camera) -> int:
        """How many coarse pixels a target may show that the detector does not find."""
        return int(found_pixels(camera, self.found_pixels) // self.step(camera) ** 2)


def _corners(share: float) -> list[tuple[float, float]]:
    return [(x, y) for x in (-share, share) for y in (-share, share)]
