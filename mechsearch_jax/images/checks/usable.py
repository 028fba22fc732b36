"""Whether the images of a camera can be used: their shapes, types, units and numbers; the same for every way in."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from mechsearch_jax.images.labels import INSTANCES, MISSING
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera


def check_images(camera: Camera, depth: Any, colour: Any = None, mask: Any = None, target_id: Any = None) -> None:
    """Check that images can be used: all that can be said of them without their shelf.

    Args:
      camera: of the images.
      depth, colour, mask, target_id: as of a `Recogniser`.

    Raises:
      InputError: one of them has the wrong shape, type or unit. Values are checked outside `jit` only.
    """
    size = (camera.height, camera.width)
    for name, image, shape in (("depth", depth, size), ("colour", colour, (*size, 3)), ("mask", mask, size)):
        if image is None and name != "depth":
            continue
        if image is None or not (hasattr(image, "shape") and hasattr(image, "dtype")):
            raise InputError(f"{name} image: is a {type(image).__name__}; give an array of the shape {shape}")
        if tuple(image.shape) != shape:
            turned = "; it looks transposed" if tuple(image.shape[:2]) == size[::-1] else ""
            raise InputError(
                f"{name} image: its shape is {tuple(image.shape)}, the camera's images are {shape}{turned}"
            )
    _check_depth(depth)
    if colour is not None:
        _check_colour(colour)
    if target_id is not None:
        if mask is None:
            raise InputError("target_id: names a number of a mask; give the mask too, or leave it out")
        if not jnp.issubdtype(jnp.result_type(target_id), jnp.integer) or jnp.ndim(target_id) != 0:
            raise InputError(f"target_id: {target_id} must be one whole number, that of the target in the mask")
    if mask is not None:
        _check_mask(mask, colour is None and target_id is None)


def _values(image: Any) -> np.ndarray | None:
    """Every eighth row and column, for checks of the values; None while JAX traces."""
    return None if isinstance(image, Tracer) else np.asarray(image[::8, ::8])


def _check_depth(depth: Any) -> None:
    if not jnp.issubdtype(depth.dtype, jnp.floating):
        raise InputError(f"depth image: holds {depth.dtype}; give floats in metres (millimetres divided by 1000)")
    values = _values(depth)
    if values is None:
        return
    known = values[np.isfinite(values) & (values > 0)]
    # The largest number may stand for what was not measured, or be a simulator's far plane.
    known = known[known < known.max(initial=0.0)]
    if known.size and np.median(known) > 20:
        raise InputError(f"depth image: its median is {np.median(known):.0f}; give metres, not millimetres")


def _check_colour(colour: Any) -> None:
    if colour.dtype == jnp.uint8:
        return
    if not jnp.issubdtype(colour.dtype, jnp.floating):
        raise InputError(f"colour image: holds {colour.dtype}; give floats from 0 to 1, or uint8")
    values = _values(colour)
    if values is not None and not np.all((values >= 0) & (values <= 1)):
        raise InputError("colour image: its floats must be from 0 to 1; divide 8-bit values by 255")


def _check_mask(mask: Any, blind: bool) -> None:
    if not jnp.issubdtype(mask.dtype, jnp.integer):
        raise InputError(f"mask image: holds {mask.dtype}; give whole numbers, 0 to 8 for objects, -1 for none")
    values = _values(mask)
    if values is None:
        return
    low, high = (int(v) for v in (np.asarray(mask).min(), np.asarray(mask).max()))
    if low < MISSING or high >= INSTANCES:
        raise InputError(
            f"mask image: holds numbers from {low} to {high}; objects are 0 to {INSTANCES - 1}, all else -1, -2 or -3"
        )
    if blind and high == INSTANCES - 1:
        raise InputError(f"mask image: nine things are too many; say with target_id which of 0 to {high} is the target")
