"""The detector, which finds the target in an image that shows enough of it: how few pixels are too few.

Whoever has to know asks `found_pixels`: recognition, the simulated camera, and f, which must not rule out a target
where the detector cannot see it.
"""

from __future__ import annotations

import math

from mechsearch_jax.workspace.camera import Camera

# More pixels of an image of this size make the target visible, as in the paper.
FOUND_PIXELS = 100
IMAGE_SIZE = (1280, 720)


def found_pixels(camera: Camera, pixels: int | float = FOUND_PIXELS) -> float:
    """The most pixels of the target that a camera's image may show without the detector finding it.

    The same share of every image: of one that is half as wide and half as high a quarter as many.

    Args:
      camera: whose images are looked at; only their size matters.
      pixels: as many in an image of 1280 x 720.
    """
    return pixels * camera.width * camera.height / math.prod(IMAGE_SIZE)


def longer(camera: Camera) -> float:
    """How many times as long, in pixels, what an image of 1280 x 720 shows is in a camera's image of the same view."""
    return math.sqrt(found_pixels(camera) / FOUND_PIXELS)
