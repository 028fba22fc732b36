"""Images that belong together, and those that ship with the package."""

from __future__ import annotations

import dataclasses
import importlib.resources
import io
import json
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from mechsearch_jax.images.labels import MOST
from mechsearch_jax.runtime.arrays import ARRAYS_LIMIT, read_arrays
from mechsearch_jax.runtime.errors import InputError, shown
from mechsearch_jax.runtime.files import PathLike, read_bytes, replacing
from mechsearch_jax.runtime.tables import Document, with_table
from mechsearch_jax.workspace.camera import Camera

# The shipped file, in the folder `data` of the package.
FILE = "example-images.npz"
# Depths are stored as multiples of this [m], as depth cameras deliver them.
STEP = 0.001
# The images in a file: their types, and the channels of a pixel.
IMAGES = {"depth": (np.uint16, ()), "colour": (np.uint8, (3,)), "mask": (np.int8, ())}
REST = "rest"


@dataclasses.dataclass(frozen=True)
class Images:
    """Images taken at the same time and registered to each other.

    Attributes:
      depth: float32 (H, W), metres along the camera's z; 0 where nothing was measured.
      colour: uint8 (H, W, 3), red, green and blue; None if there is none, as in a data set or bag without.
      mask: int8 (H, W), the number of the object that a pixel shows, or what `images.labels` has; None if none.
      target_id: the target's number in the mask; None if it is not visible.
      camera: intrinsics and pose in the world, the robot's base.
    """

    depth: Float[np.ndarray, "h w"]
    colour: UInt8[np.ndarray, "h w 3"] | None
    mask: Int[np.ndarray, "h w"] | None
    target_id: int | None
    camera: Camera


def example_images() -> Images:
    """Images of the shipped scenario `first-light`, whose target is hidden, by the simulated camera.

    1280 x 720 pixels; depths in whole millimetres with Gaussian noise of 1 mm, one in two hundred missing. They are
    made by `python -m mechsearch_jax.envs.camera.example_images`.
    """
    return load_images(Path(str(importlib.resources.files("mechsearch_jax") / "data" / FILE)))


def load_images(path: PathLike) -> Images:
    """Read a file of `save_images`.

    Raises:
      InputError: the file cannot be read or is damaged, an image has another size than the camera's or another type,
        or the camera is impossible.
    """
    arrays = read_arrays(read_bytes(path, ARRAYS_LIMIT), path)
    missing = {*IMAGES, REST} - arrays.keys()
    if missing:
        raise InputError(f"{path}: {sorted(missing)[0]} is missing; it must hold {', '.join((*IMAGES, REST))}")
    target_id, camera = _rest(arrays[REST], path)
    size = (camera.height, camera.width)
    for name, (kind, channels) in IMAGES.items():
        image = arrays[name]
        if image.shape != (*size, *channels) or image.dtype != kind:
            raise InputError(
                f"{path}: {name} is {image.dtype} of shape {image.shape}; it must be {np.dtype(kind)} of shape"
                f" {(*size, *channels)}, as the camera's images are"
            )
    depth = arrays["depth"].astype(np.float32) * np.float32(STEP)
    return Images(depth, arrays["colour"], arrays["mask"], target_id, camera)


def _rest(array: np.ndarray, path: PathLike) -> tuple[int | None, Camera]:
    """The target's number and the camera, from an archive's text."""
    try:
        value = json.loads(str(array)) if array.dtype.kind == "U" and array.ndim == 0 else None
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, dict) or set(value) != {"target_id", "camera"} or not isinstance(value["camera"], dict):
        raise InputError(f"{path}: {REST} must be JSON with the keys target_id and camera")
    target_id = value["target_id"]
    if target_id is not None and (type(target_id) is not int or not 0 <= target_id <= MOST):
        raise InputError(f"{path}: target_id {shown(target_id)} must be null or from 0 to {MOST}")
    document = Document(str(path), {"camera": value["camera"]}, {})
    return target_id, with_table(document, "camera", Camera())


def save_images(images: Images, path: PathLike) -> None:
    """Write images in the format of the shipped ones; depths are rounded to millimetres.

    Raises:
      InputError: the file cannot be written, or colour image or mask is missing.
    """
    if images.colour is None or images.mask is None:
        raise InputError(f"{path}: images without colour or mask cannot be written")
    rest = {"target_id": images.target_id, "camera": dataclasses.asdict(images.camera)}
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        depth=np.round(images.depth / STEP).astype(np.uint16),
        colour=images.colour,
        mask=images.mask,
        rest=np.array(json.dumps(rest)),
    )
    with replacing(path) as file:
        file.write(buffer.getvalue())
