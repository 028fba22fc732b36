"""Example images that ship with the package: what a robot's camera would deliver."""

from __future__ import annotations

import dataclasses
import importlib.resources
import io
import json

import numpy as np
from jaxtyping import Float, Int, UInt8

from mechsearch_jax.files import PathLike, replacing
from mechsearch_jax.workspace.camera import Camera

# The shipped file, in the folder `data` of the package.
FILE = "example-images.npz"
# Depths are kept as whole multiples of this [m], as depth cameras deliver them.
STEP = 0.001


@dataclasses.dataclass(frozen=True)
class Images:
    """Images of one moment, registered to each other: pixel (row, column) shows the same point in each.

    Attributes:
      depth: float32 (H, W), metres along the camera's z; 0 where nothing was measured.
      colour: uint8 (H, W, 3), red, green and blue.
      mask: int8 (H, W), the number of the object that a pixel shows, or what `perception.labels` has.
      target_id: the number in the mask that is the target's; None where it is not visible.
      camera: intrinsics and pose in the world, the robot's base.
    """

    depth: Float[np.ndarray, "h w"]
    colour: UInt8[np.ndarray, "h w 3"]
    mask: Int[np.ndarray, "h w"]
    target_id: int | None
    camera: Camera


def example_images() -> Images:
    """Images of the shipped scenario `first-light`, whose target is hidden, by the simulated camera.

    1280 x 720 pixels; depths in whole millimetres with Gaussian noise of 1 mm, one in two hundred missing. They are
    made by `python -m mechsearch_jax.envs.example_images`.
    """
    file = importlib.resources.files("mechsearch_jax") / "data" / FILE
    with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as kept:
        rest = json.loads(str(kept["rest"]))
        depth = kept["depth"].astype(np.float32) * np.float32(STEP)
        return Images(depth, kept["colour"], kept["mask"], rest["target_id"], _camera(rest["camera"]))


def save_images(images: Images, path: PathLike) -> None:
    """Write images as the shipped ones are kept; depths are rounded to millimetres.

    Raises:
      InputError: the file cannot be written.
    """
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


def _camera(value: dict) -> Camera:
    rotation = tuple(tuple(row) for row in value["rotation"])
    return Camera(**{**value, "rotation": rotation, "position": tuple(value["position"])})
