"""Images and cameras in files, in the formats of camera drivers.

| what | files |
|---|---|
| depth | PNG or TIFF of 16 bits in millimetres; TIFF or `.npy` of floats in metres; 0 or NaN for not measured |
| colour | PNG or JPEG, 8 bits a channel |
| mask | PNG or `.npy` of whole numbers, one for each object, and one for the background |
| camera | JSON with the fields of a ROS `sensor_msgs/CameraInfo` and `T_world_camera`; a lens that distorts, too |
"""

from __future__ import annotations

import io
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8
from PIL import Image

from mechsearch_jax.images.labels import CAPACITY, OTHER, more_room
from mechsearch_jax.images.lens import Lens, distortion_of
from mechsearch_jax.runtime.errors import InputError, nearest, shown
from mechsearch_jax.runtime.files import PathLike, read_bytes, read_json, replacing, save_json
from mechsearch_jax.workspace.camera import Camera

# Largest size of an image [bytes, pixels].
IMAGE_LIMIT = 256 * 2**20
PIXEL_LIMIT = 64 * 10**6
MILLIMETRE = 0.001
# Bound of the numbers in intrinsics and poses.
LARGEST_NUMBER = 1e7
# A number that covers a larger share of a mask must be the background.
LARGEST = 0.5
# Keys of a camera's file that do not matter.
_UNUSED = ("header", "R", "r", "P", "p", "binning_x", "binning_y", "roi", "frame_id")
_CAMERA_KEYS = ("width", "height", "K", "D", "distortion_model", "T_world_camera")


def load_depth(path: PathLike) -> Float[np.ndarray, "h w"]:
    """Read a depth image in metres along the camera's z, 0 or NaN where nothing was measured.

    Raises:
      InputError: the file cannot be read, or is not a depth image.
    """
    image = load_pixels(path)
    if image.ndim != 2:
        raise InputError(f"{path}: has {image.shape[-1]} channels; a depth image has one")
    if image.dtype.kind == "f":
        return image.astype(np.float32)
    if image.dtype.kind in "iu" and image.dtype.itemsize > 1:
        # Cameras and simulators write the largest number of the type, too, where they measure nothing.
        image = np.where(image == np.iinfo(image.dtype).max, 0, image)
        return image.astype(np.float32) * np.float32(MILLIMETRE)
    raise InputError(
        f"{path}: holds {image.dtype}; a depth image has 16 bits in millimetres, or floats in metres (.npy, .tiff)"
    )


def load_colour(path: PathLike) -> UInt8[np.ndarray, "h w 3"]:
    """Read a colour image: red, green and blue.

    Raises:
      InputError: the file cannot be read, or is not a colour image.
    """
    image = load_pixels(path)
    if image.ndim != 3 or image.shape[-1] not in (3, 4) or image.dtype != np.uint8:
        raise InputError(
            f"{path}: holds {image.dtype} of shape {image.shape}; give red, green and blue with 8 bits each"
        )
    return np.ascontiguousarray(image[..., :3])


def load_mask(
    path: PathLike, background: int, capacity: int = CAPACITY
) -> tuple[Int[np.ndarray, "h w"], dict[int, int]]:
    """Read a mask and renumber its objects for a `Recogniser`.

    Args:
      path: of the file; its objects may have any numbers.
      background: the number of the background, as are negative ones.
      capacity: how many objects the recogniser can hold, beside the target.

    Returns:
      The mask, and the new number for each number in the file.

    Raises:
      InputError: the file cannot be read, is not a mask, or has too many objects.
    """
    return numbered(load_pixels(path), background, str(path), capacity)


def numbered(
    image: Shaped[np.ndarray, "..."], background: int, where: str, capacity: int = CAPACITY
) -> tuple[Int[np.ndarray, "h w"], dict[int, int]]:
    """A mask for a `Recogniser` of one with any numbers; as `load_mask`, whose messages begin with `where`.

    Raises:
      InputError: as `load_mask`.
    """
    if image.ndim != 2 or image.dtype.kind not in "iu":
        raise InputError(f"{where}: holds {image.dtype} of shape {image.shape}; a mask has one whole number a pixel")
    numbers, count = np.unique(image, return_counts=True)
    named = [(int(n), int(c)) for n, c in zip(numbers, count, strict=True) if n != background and n >= 0]
    for number, pixels in named:
        if pixels > LARGEST * image.size:
            raise InputError(
                f"{where}: number {number} covers {100 * pixels / image.size:.0f}% of the image; if it stands for no "
                f"object, say so: --background {number}"
            )
    if len(named) > capacity + 1:
        raise InputError(
            f"{where}: names {len(named)} objects; at most {capacity + 1} can be told apart{more_room(capacity)}"
        )
    new = {number: i for i, (number, _) in enumerate(named)}
    mask = np.full(image.shape, OTHER, np.int32)
    for number, i in new.items():
        mask[image == number] = i
    return mask, new


def load_camera(path: PathLike) -> Camera:
    """Read a camera: the fields `width`, `height` and `K` of a ROS `CameraInfo`, and `T_world_camera`.

    In `K` the centre of the first pixel is at 0, as in ROS. `T_world_camera` is 4 x 4, the camera's pose in the frame
    of the robot's base; the camera's frame has x right, y down, z forward (ROS: the optical frame).

    Raises:
      InputError: as `load_lens`, or the lens distorts.
    """
    lens = load_lens(path)
    if lens.distorts:
        raise InputError(f"{path}: D says that the lens distorts; read it with load_lens, which undistorts its images")
    return lens.camera


def load_lens(path: PathLike) -> Lens:
    """Read a camera as `load_camera` does, with the distortion of its lens: `D`, and `distortion_model`.

    Raises:
      InputError: the file cannot be read, or a field is missing, unknown or impossible, or the lens is a fisheye.
    """
    value = read_json(path)
    if not isinstance(value, dict):
        raise InputError(f"{path}: must hold an object with {', '.join(_CAMERA_KEYS)}")
    value = {{"k": "K", "d": "D"}.get(str(key), str(key)): part for key, part in value.items() if key not in _UNUSED}
    for key in value:
        if key not in _CAMERA_KEYS:
            raise InputError(f"{path}: {shown(key)} is unknown; {nearest(key, _CAMERA_KEYS)}")
    for key in ("width", "height", "K", "T_world_camera"):
        if key not in value:
            raise InputError(f"{path}: {key} is missing")
    for key in ("width", "height"):
        if type(value[key]) is not int or not 0 < value[key] <= 2**15:
            raise InputError(f"{path}: {key} must be a whole number of pixels, not {shown(value[key])}")
    model = value.get("distortion_model", "")
    if not isinstance(model, str):
        raise InputError(f"{path}: distortion_model must be a name, not {shown(model)}")
    distortion = distortion_of(model, number_array(value.get("D", []), None, "D", path).ravel().tolist(), str(path))
    K, T = (number_array(value[key], shape, key, path) for key, shape in (("K", (3, 3)), ("T_world_camera", (4, 4))))
    if not np.allclose(T[3], (0, 0, 0, 1)):
        raise InputError(f"{path}: T_world_camera: its last row must be 0 0 0 1; is it transposed?")
    return Lens(camera_of(value["width"], value["height"], K, T, path), distortion)


def camera_of(
    width: int, height: int, K: Float[np.ndarray, "3 3"], T: Float[np.ndarray, "4 4"], where: PathLike
) -> Camera:
    """A camera of matrices.

    Args:
      width, height: of its images.
      K: intrinsics; the centre of the first pixel is at 0.
      T: `T_world_camera` [m].
      where: the file, for errors.

    Raises:
      InputError: it is impossible.
    """
    if abs(K[0, 1]) > 1e-6 or abs(K[1, 0]) > 1e-6:
        raise InputError(f"{where}: K: pixels must not be skewed")
    try:
        return Camera(
            width=width,
            height=height,
            fx=float(K[0, 0]),
            fy=float(K[1, 1]),
            cx=float(K[0, 2]) + 0.5,
            cy=float(K[1, 2]) + 0.5,
            rotation=tuple((float(a), float(b), float(c)) for a, b, c, _ in T[:3].tolist()),
            position=(float(T[0, 3]), float(T[1, 3]), float(T[2, 3])),
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def save_depth(depth: Float[np.ndarray, "h w"], path: PathLike) -> None:
    """Write a depth image as a PNG of 16 bits in millimetres.

    Raises:
      InputError: the file cannot be written.
    """
    finite = np.where(np.isfinite(depth), depth, 0.0)
    _save_png(np.round(np.clip(finite / MILLIMETRE, 0, 65535)).astype(np.uint16), path)


def save_colour(colour: UInt8[np.ndarray, "h w 3"], path: PathLike) -> None:
    """Write a colour image as a PNG.

    Raises:
      InputError: the file cannot be written.
    """
    _save_png(colour, path)


def save_mask(mask: Int[np.ndarray, "h w"], path: PathLike, background: int = 255) -> None:
    """Write a mask as a PNG of 8 bits, `background` where no object is.

    Raises:
      InputError: the file cannot be written.
    """
    _save_png(np.where(mask < 0, background, mask).astype(np.uint8), path)


def save_camera(camera: Camera, path: PathLike, distortion: tuple[float, ...] = ()) -> None:
    """Write a camera's file for `load_camera`, or for `load_lens` with the `distortion` of a `Lens`.

    Raises:
      InputError: the file cannot be written.
    """
    rows = [[*row, place] for row, place in zip(camera.rotation, camera.position, strict=True)]
    value = {
        "width": camera.width,
        "height": camera.height,
        "K": [camera.fx, 0.0, camera.cx - 0.5, 0.0, camera.fy, camera.cy - 0.5, 0.0, 0.0, 1.0],
        "D": list(distortion or (0.0,) * 5),
        "T_world_camera": [*rows, [0.0, 0.0, 0.0, 1.0]],
    }
    save_json(value, path)


def _save_png(image: np.ndarray, path: PathLike) -> None:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    with replacing(path) as file:
        file.write(buffer.getvalue())


def load_pixels(path: PathLike) -> np.ndarray:
    """The pixels of an image file, in its type.

    Raises:
      InputError: the file cannot be read, or is no image.
    """
    data = read_bytes(path, IMAGE_LIMIT)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            image = _array(data) if Path(path).suffix.lower() == ".npy" else _picture(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    # The decoders raise a dozen kinds of exception on damaged files.
    except Exception as error:
        raise InputError(f"{path}: is no whole image ({type(error).__name__})") from error
    if image.ndim not in (2, 3) or image.size == 0:
        raise InputError(f"{path}: has the shape {image.shape}, which is no image's")
    return image


def _array(data: bytes) -> np.ndarray:
    return np.load(io.BytesIO(data), allow_pickle=False)


def _picture(data: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(data)) as image:
        if image.width * image.height > PIXEL_LIMIT:
            raise InputError(f"has {image.width} x {image.height} pixels; at most {PIXEL_LIMIT} are read")
        return np.asarray(image)


def number_array(value: Any, shape: tuple[int, ...] | None, key: str, path: PathLike) -> np.ndarray:
    """Numbers of a shape, given as nested lists or row by row.

    Raises:
      InputError: they are others, naming the key and the path.
    """
    try:
        array = np.array(value, float)
        array = array if shape is None else array.reshape(shape)
        if array.size and not float(np.abs(array).max()) < LARGEST_NUMBER:
            raise ValueError
    except (ValueError, TypeError, OverflowError):
        size = "numbers" if shape is None else f"{math.prod(shape)} numbers" if shape else "a number"
        raise InputError(f"{path}: {key} must be {size}, not {shown(value)}") from None
    return array
