"""The pinhole camera that looks into the shelf: rays and projection."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax.geometry.transforms import rotate
from mechsearch_jax.runtime.errors import InputError, check_range
from mechsearch_jax.workspace.leaves import are_given

# Largest number of pixels along a side, and largest coordinate of the position [m].
LARGEST = 16384
FARTHEST = 10.0
# No depth camera of a robot measures so far [m]: in whole millimetres, 65535 stands for no measurement.
BEYOND = 65.0
# The fields that are dynamic under `jit`.
_DATA = ("fx", "fy", "cx", "cy", "rotation", "position")


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=_DATA,
    meta_fields=("width", "height"),
)
@dataclasses.dataclass(frozen=True)
class Camera:
    """A fixed pinhole camera; its frame has x right, y down, z forward. Defaults: docs/method.md,
    "Facts of the scene".

    A pytree, so that a recalibrated camera recompiles nothing where a jitted function takes it as a dynamic argument.
    Outside of tracing it holds plain numbers and is hashable.

    Attributes:
      width, height: image size in pixels; static.
      fx, fy: focal lengths in pixels.
      cx, cy: principal point in pixels; pixel (row, column) has its centre at (column + 0.5, row + 0.5).
      rotation: rows of `R_world_camera`.
      position: `t_world_camera` [m].
    """

    width: int = 1280
    height: int = 720
    fx: float = 609.635
    fy: float = 609.635
    cx: float = 640.0
    cy: float = 360.0
    rotation: tuple[tuple[float, float, float], ...] = (
        (-0.43471579, -0.10620786, 0.894283),
        (-0.9005385, 0.05926315, -0.43071834),
        (-0.00725236, -0.99257633, -0.12140689),
    )
    position: tuple[float, float, float] = (-0.04457319, 0.44833383, 0.65361773)

    def __post_init__(self):
        for name in ("width", "height"):
            check_range(f"Camera: {name}", getattr(self, name), 1, LARGEST, "pixels")
        # In a pytree rebuilt by JAX, dynamic fields may hold tracers or other stand-ins, which are not checked.
        if not are_given(*(getattr(self, name) for name in _DATA), arrays=True):
            return
        for name in ("fx", "fy"):
            check_range(f"Camera: {name}", getattr(self, name), 1e-3, 100 * LARGEST, "pixels")
        for name in ("cx", "cy"):
            check_range(f"Camera: {name}", getattr(self, name), -10 * LARGEST, 10 * LARGEST, "pixels")
        check_rotation("Camera", self.rotation)
        for axis, value in zip("xyz", self.position, strict=True):
            check_range(f"Camera: position {axis}", value, -FARTHEST, FARTHEST, "m")
        # Convert to one type, for other types would be compiled for anew.
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, float(getattr(self, name)))
        object.__setattr__(self, "rotation", tuple(tuple(map(float, row)) for row in self.rotation))
        object.__setattr__(self, "position", tuple(map(float, self.position)))

    def moved(self, shift: tuple[float, float, float]) -> Camera:
        """The same camera elsewhere, by a translation in the world [m]."""
        x, y, z = (a + b for a, b in zip(self.position, shift, strict=True))
        return dataclasses.replace(self, position=(x, y, z))

    def scaled(self, factor: int) -> Camera:
        """The same view at `1/factor` of the resolution, its size rounded down."""
        return dataclasses.replace(
            self,
            width=self.width // factor,
            height=self.height // factor,
            fx=self.fx / factor,
            fy=self.fy / factor,
            cx=self.cx / factor,
            cy=self.cy / factor,
        )


def check_rotation(name: str, rotation: Any) -> None:
    """Check that rows are a rotation matrix.

    Raises:
      InputError: they are not; the message begins with the name.
    """
    R = np.array(rotation, float)
    # Products of numbers far above 1 may overflow.
    small = R.shape == (3, 3) and bool((np.abs(R) < 2.0).all())
    if not small or not np.allclose(R @ R.T, np.eye(3), atol=1e-4):
        raise InputError(f"{name}: rotation must be a rotation matrix, three orthonormal rows")
    if np.linalg.det(R) < 0:
        raise InputError(
            f"{name}: rotation mirrors; its columns are the {name.lower()}'s x, y and z, a right-handed frame"
        )


def measured(depth: Any) -> Any:
    """Which pixels of a depth image [m], an array of NumPy or JAX, hold a measurement.

    As in ROS (REP 118), infinity says that nothing is within the sensor's range, and counts; NaN, minus infinity, 0,
    negative numbers, and finite ones of `BEYOND` and more do not.
    """
    return (depth > 0) & ((depth < BEYOND) | (depth == math.inf))


def pixel_rays(
    camera: Camera, rows: Float[Array, "*batch"], columns: Float[Array, "*batch"]
) -> Float[Array, "*batch 3"]:
    """Directions in the world of the rays through pixel centres, scaled to unit depth along the optical axis.

    Args:
      camera: the camera.
      rows, columns: pixel indices, also fractional or outside the image.

    Returns:
      `d` such that `camera.position + depth * d` lies at that depth [m per m of depth].
    """
    x = (columns + 0.5 - camera.cx) / camera.fx
    y = (rows + 0.5 - camera.cy) / camera.fy
    right, down, forward = (jnp.array([row[i] for row in camera.rotation]) for i in range(3))
    shape = [1] * x.ndim + [3]
    return x[..., None] * right.reshape(shape) + y[..., None] * down.reshape(shape) + forward.reshape(shape)


def rays(camera: Camera) -> Float[Array, "h w 3"]:
    """`pixel_rays` of every pixel, shape (height, width, 3)."""
    rows, columns = jnp.meshgrid(jnp.arange(camera.height) * 1.0, jnp.arange(camera.width) * 1.0, indexing="ij")
    return pixel_rays(camera, rows, columns)


def project(
    camera: Camera, points: Float[Array, "*batch 3"]
) -> tuple[Float[Array, "*batch 2"], Float[Array, "*batch"]]:
    """World points as (row, column) pixel coordinates and depth [m]; the inverse of `pixel_rays`.

    Points at or behind the camera's plane have no image; they are projected as at a depth of 1 micrometre.
    """
    inverse = jnp.array(camera.rotation).T
    origin = jnp.array(camera.position).reshape([1] * (points.ndim - 1) + [3])
    x, y, z = jnp.moveaxis(rotate(inverse, points - origin), -1, 0)
    safe = jnp.maximum(z, 1e-6)
    row = camera.fy * y / safe + camera.cy - 0.5
    column = camera.fx * x / safe + camera.cx - 0.5
    return jnp.stack([row, column], axis=-1), z


def back_project(camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """The world point of every pixel of a depth image [m]; NaN where the depth is not finite."""
    seen = jnp.isfinite(depth)
    points = jnp.array(camera.position).reshape(1, 1, 3) + jnp.where(seen, depth, 0.0)[..., None] * rays(camera)
    return jnp.where(seen[..., None], points, jnp.nan)
