"""Convert a robot's images to fixed types, since every other type would be compiled for anew."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

_LEAST, _MOST = np.iinfo(np.int32).min, np.iinfo(np.int32).max


class Images(NamedTuple):
    """The image arguments of a `Recogniser`."""

    depth: Any
    colour: Any
    mask: Any
    target_id: Any


def converted(depth: Any, colour: Any, mask: Any, target_id: Any) -> Images:
    """The images with depth as float32, colour as uint8, mask as int32, and the target's number as an int.

    Arrays of other kinds stay as they are; the recogniser raises an error about them.
    """
    depth = np.asarray(depth)
    if depth.dtype.kind == "f":
        depth = depth.astype(np.float32)
    if colour is not None:
        colour = np.asarray(colour)
        if colour.dtype.kind == "f" and np.all((colour >= 0.0) & (colour <= 1.0)):
            colour = np.round(255.0 * colour).astype(np.uint8)
    if mask is not None:
        mask = np.asarray(mask)
        if mask.dtype.kind in "iu":
            mask = np.clip(mask, _LEAST if mask.dtype.kind == "i" else 0, _MOST).astype(np.int32)
    if target_id is not None and np.ndim(target_id) == 0 and np.asarray(target_id).dtype.kind in "iu":
        target_id = int(target_id)
    return Images(depth, colour, mask, target_id)
