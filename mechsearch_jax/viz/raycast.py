"""Ray casting of solids without OpenGL, in closed form, for the pixels in each solid's bounding box.

A solid is any surface with a closed-form intersection with rays, such as the shapes of bodies. Static solids are cast
once into a `Picture`, over which moving ones are drawn. NumPy suffices: 30 ms for about 50 solids that fill a quarter
of the image.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, UInt8

from mechsearch_jax.shapes.primitives import Surface
from mechsearch_jax.workspace.camera import Camera

# A solid nearer to the camera's plane than this is cast in the whole image [m].
NEAREST = 0.02
# Rays along each side of a pixel.
RAYS = 2

Colour = tuple[float, float, float]


@dataclasses.dataclass(frozen=True, eq=False)
class VisibleSolid:
    """A visible solid.

    Attributes:
      surface: its shape.
      half_size: half-extents [m], shape (3,).
      rotation: `R_world_solid`, shape (3, 3).
      position: `t_world_solid` [m], shape (3,).
      colour: red, green and blue, 0 to 1.
    """

    surface: Surface
    half_size: Float[np.ndarray, " 3"]
    rotation: Float[np.ndarray, "3 3"]
    position: Float[np.ndarray, " 3"]
    colour: Colour


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """An image with `RAYS` x `RAYS` rays for each pixel.

    Attributes:
      depth: along the camera's axis [m], infinite where nothing is, shape (rows, columns).
      colour: 0 to 1, shape (rows, columns, 3).
    """

    depth: Float[np.ndarray, "rows columns"]
    colour: Float[np.ndarray, "rows columns 3"]

    @property
    def pixels(self) -> UInt8[np.ndarray, "h w 3"]:
        """The image, 8 bits per channel; each pixel is the mean of its rays."""
        # Added up ray by ray, which takes a third of the time of a mean over two axes.
        rays = [self.colour[i::RAYS, j::RAYS] for i in range(RAYS) for j in range(RAYS)]
        total = functools.reduce(np.add, rays)
        return np.round(255 * (total / RAYS**2)).astype(np.uint8)


class Eye:
    """A camera that casts rays, which are computed once."""

    def __init__(self, camera: Camera, light: Colour, ambient: float, background: Colour):
        """Args:
        camera: of the pixels; each has `RAYS` x `RAYS` rays.
        light: direction from which it comes.
        ambient: share of the light that reaches every side.
        background: colour beside the solids.
        """
        self._rotation = np.array(camera.rotation, np.float32)
        self._position = np.array(camera.position, np.float32)
        self._focal = np.array([camera.fx, camera.fy]) * RAYS
        self._centre = np.array([camera.cx, camera.cy]) * RAYS
        rows, columns = camera.height * RAYS, camera.width * RAYS
        x = ((np.arange(columns) + 0.5 - self._centre[0]) / self._focal[0]).astype(np.float32)
        y = ((np.arange(rows) + 0.5 - self._centre[1]) / self._focal[1]).astype(np.float32)
        right, down, forward = self._rotation.T
        # Directions by component, of unit depth.
        self._rays = [x[None, :] * right[i] + y[:, None] * down[i] + forward[i] for i in range(3)]
        self._background = np.array(background, np.float32)
        self._light = np.array(light, np.float32) / np.float32(np.linalg.norm(light))
        self._ambient = ambient

    def empty(self) -> Picture:
        """A picture of the background."""
        shape = self._rays[0].shape
        colour = np.broadcast_to(self._background, (*shape, 3)).copy()
        return Picture(np.full(shape, np.inf, np.float32), colour)

    def picture(self, solids: Iterable[VisibleSolid], behind: Picture | None = None) -> Picture:
        """A picture of solids, merged by depth with the picture `behind`."""
        start = behind or self.empty()
        picture = Picture(start.depth.copy(), start.colour.copy())
        # From front to back, so that few hidden points are shaded.
        for solid in sorted(solids, key=lambda solid: float(np.linalg.norm(solid.position - self._position))):
            self._draw(solid, picture)
        return picture

    def _draw(self, solid: VisibleSolid, picture: Picture) -> None:
        window = self._window(solid)
        if window is None:
            return
        rotation, half = np.asarray(solid.rotation, np.float32), np.asarray(solid.half_size, np.float32)
        rays = [component[window] for component in self._rays]
        origin = (self._position - np.asarray(solid.position, np.float32)) @ rotation
        x, y, z = rays
        local = [rotation[0, k] * x + rotation[1, k] * y + rotation[2, k] * z for k in range(3)]
        with np.errstate(all="ignore"):
            depth = solid.surface.cut([np.float32(o) for o in origin], local, half, np)
        nearer = depth < picture.depth[window]
        if not nearer.any():
            return
        depth = depth[nearer]
        points = origin + depth[:, None] * np.stack([component[nearer] for component in local], axis=-1)
        normal = solid.surface.normal(points, np.broadcast_to(half, points.shape), np)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
        shade = self._ambient + (1.0 - self._ambient) * np.maximum(normal @ (rotation.T @ self._light), 0.0)
        picture.depth[window][nearer] = depth
        picture.colour[window][nearer] = shade[:, None] * np.array(solid.colour, np.float32)

    def _window(self, solid: VisibleSolid) -> tuple[slice, slice] | None:
        """The part of the image that contains a solid's bounding box; None if that is outside."""
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(8, 3)
        corners = (signs * solid.half_size) @ np.asarray(solid.rotation).T + solid.position
        seen = (corners - self._position) @ self._rotation
        rows, columns = self._rays[0].shape
        if (seen[:, 2] < NEAREST).all():
            return None
        if (seen[:, 2] < NEAREST).any():
            return slice(0, rows), slice(0, columns)
        image = seen[:, :2] / seen[:, 2:] * self._focal + self._centre
        low = np.maximum(np.floor(image.min(axis=0)), 0).astype(int)
        high = np.minimum(np.ceil(image.max(axis=0)), (columns, rows)).astype(int)
        if (low >= high).any():
            return None
        return slice(low[1], high[1]), slice(low[0], high[0])
