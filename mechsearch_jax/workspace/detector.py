"""The detection threshold: how many pixels of the target an image must show for the detector to find it.

Recognition, the simulated camera and f use it; f must not rule out a target that the detector could not see.
"""

from __future__ import annotations

import math

from mechsearch_jax.workspace.camera import Camera

# The target is visible with more pixels than this in an image of this size, as in the paper.
FOUND_PIXELS = 100
IMAGE_SIZE = (1280, 720)
# A thinned image may overestimate an object's number of pixels by this factor.
SAMPLED = 1.5


def found_pixels(camera: Camera, pixels: int | float = FOUND_PIXELS) -> float:
    """The largest number of the target's pixels in a camera's image with which the detector does not find it.

    It is the same share of images of all sizes.

    Args:
      camera: only its image's size matters.
      pixels: the number in an image of 1280 x 720.
    """
    return pixels * camera.width * camera.height / math.prod(IMAGE_SIZE)


def longer(camera: Camera) -> float:
    """Factor of lengths in pixels from an image of 1280 x 720 to a camera's image of the same view."""
    return math.sqrt(found_pixels(camera) / FOUND_PIXELS)
