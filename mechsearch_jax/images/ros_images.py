"""Images and cameras in messages of ROS 1 and ROS 2, whatever made the messages: `rclpy`, or `rosbags`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from mechsearch_jax.images.lens import Lens, distortion_of
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera

# The type of a channel and the number of channels of each encoding.
DEPTH = {"16UC1": (np.uint16, 1), "mono16": (np.uint16, 1), "32FC1": (np.float32, 1)}
MASK = {
    **dict.fromkeys(("8UC1", "mono8"), (np.uint8, 1)),
    **dict.fromkeys(("16UC1", "mono16"), (np.uint16, 1)),
    "32SC1": (np.int32, 1),
}
COLOUR = {name: (np.uint8, len(name) - 1) for name in ("rgb8", "bgr8", "rgba8", "bgra8")}


def depth_of(image: Any) -> Float[np.ndarray, "h w"]:
    """The depth in metres of a `sensor_msgs/Image`, float32; 0 or NaN where nothing was measured.

    Raises:
      InputError: it has another encoding, or not the size that it says.
    """
    array = _pixels(image, DEPTH)[..., 0]
    if array.dtype == np.float32:
        return array
    # Cameras and simulators write the largest number of the type, too, where they measure nothing.
    return np.where(array == np.iinfo(array.dtype).max, 0, array).astype(np.float32) * np.float32(0.001)


def colour_of(image: Any) -> UInt8[np.ndarray, "h w 3"]:
    """Red, green and blue of a `sensor_msgs/Image`.

    Raises:
      InputError: as `depth_of`.
    """
    array = _pixels(image, COLOUR)[..., :3]
    return array[..., ::-1].copy() if image.encoding.startswith("bgr") else array


def mask_of(image: Any) -> Int[np.ndarray, "h w"]:
    """The numbers of a `sensor_msgs/Image` that names objects; `image_files.numbered` makes a mask of them.

    Raises:
      InputError: as `depth_of`.
    """
    return _pixels(image, MASK)[..., 0].astype(np.int32)


def lens_of(info: Any, camera: Camera, rectified: bool = False) -> Lens:
    """The lens of a `sensor_msgs/CameraInfo`.

    Args:
      info: the message.
      camera: has the pose, which the message does not.
      rectified: the images are rectified, as image_proc publishes them: their intrinsics are in P, whatever D is.

    Raises:
      InputError: it is not calibrated, or its lens is not understood.
    """
    # Capitals in ROS 1.
    K, P, D = (getattr(info, name if hasattr(info, name) else name.upper()) for name in "kpd")
    if rectified:
        fx, _, cx, _, _, fy, cy = (float(value) for value in P[:7])
    else:
        fx, _, cx, _, fy, cy = (float(value) for value in K[:6])
    if fx <= 0.0 or fy <= 0.0:
        raise InputError(f"camera_info: {'p' if rectified else 'k'} holds no focal lengths; calibrate the camera")
    distortion = () if rectified else distortion_of(info.distortion_model, D, "camera_info")
    # In ROS the centre of the first pixel is at 0.
    size = {"width": int(info.width), "height": int(info.height)}
    return Lens(dataclasses.replace(camera, **size, fx=fx, fy=fy, cx=cx + 0.5, cy=cy + 0.5), distortion)


def _pixels(image: Any, kinds: Mapping[str, tuple[type, int]]) -> np.ndarray:
    """The array of a `sensor_msgs/Image`, whose encoding must be one of `kinds`."""
    if image.encoding not in kinds:
        raise InputError(f"images of encoding {image.encoding} cannot be used, only {', '.join(kinds)}")
    kind, channels = kinds[image.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
    data, length = np.frombuffer(bytes(image.data), np.uint8), image.width * channels * dtype.itemsize
    if not 0 < length <= image.step or data.size != image.height * image.step:
        raise InputError(f"an image of {image.width} x {image.height} pixels holds {data.size} bytes; it is damaged")
    row = np.ascontiguousarray(data.reshape(image.height, image.step)[:, :length])
    return row.view(dtype).reshape(image.height, image.width, channels).astype(kind)
