"""Settings of f."""

from __future__ import annotations

import dataclasses

import numpy as np

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.detector import FOUND_PIXELS, found_pixels, longer

# Factor by which the image of a closer look is coarser than 1280 x 720; scaled likewise for other images.
CLOSER_LOOK = 3


@dataclasses.dataclass(frozen=True)
class ExistenceConfig:
    """Settings of f.

    Attributes:
      found_pixels: the detector finds the target if it shows more pixels than this in an image of 1280 x 720; in other
        images the same share, see `workspace.detector`.
      depth_threshold: threshold of the mean squared difference, for preset `paper` alone [m^2].
      downscale: factor by which f is rendered coarser than an image of 1280 x 720; with other images scaled to keep the
        size of a coarse pixel, rounded to a whole number.
      as_in_paper: set by preset `paper` alone: what makes the target visible is then the mean squared difference of the
        two depth images instead of the pixels that it would show at full resolution, as the detector counts them; it is
        tested half-way to the corners of its grid cell; and f is never opened again.
      window: rows and columns of the window an object is rendered in, at the coarse resolution.
      points: points on the target's surface for the collision test.
    """

    found_pixels: int = FOUND_PIXELS
    depth_threshold: float = 0.001
    downscale: int = 7
    as_in_paper: bool = False
    window: tuple[int, int] = (48, 48)
    points: int = 512

    def __post_init__(self):
        if self.downscale < 1:
            raise InputError(f"ExistenceConfig: downscale {self.downscale} must be at least 1")
        if self.looks_closer and self.downscale <= CLOSER_LOOK:
            raise InputError(
                f"ExistenceConfig: downscale {self.downscale} must be above that of a closer look, {CLOSER_LOOK}"
            )

    @property
    def looks_closer(self) -> bool:
        """Whether pixels are counted again in a finer image where few of the target's show."""
        return not self.as_in_paper

    @property
    def places(self) -> np.ndarray:
        """Places in a cell where the target is tested: x, y and yaw as shares of half the cell, shape (S, 3).

        The middle and the corners, where it is also turned by half a step in yaw, to alternating sides; the corners of
        the outermost cells lie at the walls.
        """
        share = 0.5 if self.as_in_paper else 1.0
        corners = [(a, b, a * b * (share == 1.0)) for a in (-share, share) for b in (-share, share)]
        return np.array([(0.0, 0.0, 0.0), *corners], np.float32)

    def step(self, camera: Camera) -> int:
        """Side of a coarse pixel in pixels of a camera's image."""
        return max(round(self.downscale * longer(camera)), 1)

    def closer_step(self, camera: Camera) -> int:
        """Side of a pixel of the closer look in pixels of a camera's image; `step` if there is no closer look."""
        return max(round(CLOSER_LOOK * longer(camera)), 1) if self.looks_closer else self.step(camera)

    def allowed(self, camera: Camera) -> int:
        """How many coarse pixels a target may show that the detector does not find."""
        return int(found_pixels(camera, self.found_pixels) // self.step(camera) ** 2)
