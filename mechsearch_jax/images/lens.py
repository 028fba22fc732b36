"""Lenses that distort: their images become those of a pinhole camera before anything else looks at them.

The model is that of OpenCV and of ROS: radial terms, rational ones too, and tangential ones (Brown, "Close-range camera
calibration", 1971). Undistorting asks of each pixel where the lens shows its ray, which needs no iteration.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int, Num

from mechsearch_jax.images.labels import MISSING
from mechsearch_jax.runtime.errors import InputError, shown
from mechsearch_jax.workspace.camera import Camera

# The models of a ROS `CameraInfo` that are understood, and how many numbers `D` has in each.
MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8,)}
NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# Models in which zeros are no pinhole camera either.
FISHEYE = ("equidistant", "fisheye")
# Radii at which is looked for where a lens maps two rays to one place.
STEPS = 4096


@dataclasses.dataclass(frozen=True)
class Lens:
    """A pinhole camera, and how its lens distorts the images that it takes.

    Where the lens did not see what a pixel of the pinhole camera shows, nothing is measured.

    Attributes:
      camera: of the undistorted images; the lens's own intrinsics and pose.
      distortion: k1, k2, p1, p2, k3, k4, k5, k6, or the first of them; without any there is no distortion.

    Raises:
      InputError: there are more.
    """

    camera: Camera
    distortion: tuple[float, ...] = ()

    def __post_init__(self):
        if len(self.distortion) > len(NAMES):
            raise InputError(f"Lens: distortion has {len(self.distortion)} numbers; it may have {', '.join(NAMES)}")

    @property
    def distorts(self) -> bool:
        """Whether its images differ from the pinhole camera's."""
        return any(self.distortion)

    @functools.cached_property
    def sources(self) -> Float[np.ndarray, "2 h w"]:
        """Row and column of the lens's image that show what each pixel of the pinhole camera does; NaN where none."""
        camera = self.camera
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, *(0.0,) * 8)[:8]

        def radial(s):
            return (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))

        x = (np.arange(camera.width)[None] + 0.5 - camera.cx) / camera.fx
        y = (np.arange(camera.height)[:, None] + 0.5 - camera.cy) / camera.fy
        s, xy = x * x + y * y, x * y
        with np.errstate(all="ignore"):
            column = x * radial(s) + 2 * p1 * xy + p2 * (s + 2 * x * x)
            row = y * radial(s) + 2 * p2 * xy + p1 * (s + 2 * y * y)
            # Beyond the radius where the polynomial turns back, it describes no lens.
            radius = np.linspace(0.0, float(np.sqrt(s.max())), STEPS)
            turns = ~(np.diff(radius * radial(radius**2)) > 0)
        limit = radius[np.argmax(turns)] if turns.any() else np.inf
        row, column = row * camera.fy + camera.cy - 0.5, column * camera.fx + camera.cx - 0.5
        seen = (np.abs(row - (camera.height - 1) / 2) <= camera.height / 2) & (s <= limit**2)
        seen &= np.abs(column - (camera.width - 1) / 2) <= camera.width / 2
        return np.where(seen, np.stack([row, column]), np.nan)

    def depth(self, image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """A depth image of the lens as the pinhole camera's: the nearest pixel's depth, 0 where the lens did not see.

        Raises:
          InputError: it is not of the camera's size; so do the others.
        """
        return self._undistorted("depth", image, 0, 0)

    def colour(self, image: Num[np.ndarray, "h w 3"]) -> Num[np.ndarray, "h w 3"]:
        """A colour image of the lens as the pinhole camera's: between pixels, black where the lens did not see."""
        channels = np.moveaxis(image, -1, 0) if self.distorts else ()
        return np.stack([self._undistorted("colour", c, 1, 0) for c in channels], -1) if self.distorts else image

    def mask(self, image: Int[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
        """A mask of the lens as the pinhole camera's: the nearest pixel's number, not measured beyond what it saw."""
        return self._undistorted("mask", image.astype(np.int32), 0, MISSING)

    def _undistorted(self, name: str, image: np.ndarray, order: int, beyond: int) -> np.ndarray:
        from scipy import ndimage

        size = (self.camera.height, self.camera.width)
        if not self.distorts:
            return image
        if image.shape != size:
            raise InputError(f"{name} image: its shape is {image.shape}, the camera's images are {size}")
        seen = ~np.isnan(self.sources[0])
        # Half a pixel at the edges takes the edge's value.
        places = np.where(seen, self.sources, 0.0)
        found = ndimage.map_coordinates(image, places, image.dtype, order=order, mode="nearest")
        return np.where(seen, found, np.asarray(beyond, image.dtype))


def distortion_of(model: str, D: Iterable[float], where: str) -> tuple[float, ...]:
    """The distortion of a ROS `CameraInfo`, empty where there is none.

    Args:
      model: its `distortion_model`; "" if it is not known, which `D` then tells.
      D: its numbers.
      where: the message's place, for errors.

    Raises:
      InputError: the model is not understood, or has another number of parameters.
    """
    values = tuple(float(value) for value in D)
    if model in FISHEYE:
        raise InputError(f"{where}: distortion_model {model} is not understood; give images that are rectified")
    if not any(values):
        return ()
    counts = MODELS.get(model) if model else tuple(count for each in MODELS.values() for count in each)
    if counts is None:
        raise InputError(
            f"{where}: distortion_model {shown(model)} is not understood, {' and '.join(MODELS)} are; give images "
            "that are rectified"
        )
    if len(values) not in counts:
        raise InputError(f"{where}: D must have {' or '.join(map(str, counts))} numbers, not {len(values)}")
    return values
