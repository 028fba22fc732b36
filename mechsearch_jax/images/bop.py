"""Images of a BOP data set (https://bop.felk.cvut.cz), in its format with a folder for each scene.

Read are `scene_camera.json`, `depth/`, `rgb/` and `mask_visib/` of a scene. A data set in grey has no colours to tell
the target by: its `gray/` is left alone.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from mechsearch_jax.images.examples import Images
from mechsearch_jax.images.image_files import MILLIMETRE, camera_of, load_colour, load_depth, load_pixels, number_array
from mechsearch_jax.images.labels import CAPACITY, OTHER
from mechsearch_jax.runtime.errors import InputError, Note, shown
from mechsearch_jax.runtime.files import PathLike, read_json
from mechsearch_jax.workspace.camera import Camera

SCENE = "scene_camera.json"


def bop_images(
    folder: PathLike, *, camera: Camera | None = None, target: int | None = None, capacity: int = CAPACITY
) -> Iterator[Images]:
    """The images of a BOP scene one after the other, each read when it is asked for: `bop_image` of every number."""
    for number in entries(Path(folder)):
        yield bop_image(folder, number, camera=camera, target=target, capacity=capacity)


def bop_image(
    folder: PathLike,
    number: int | None = None,
    *,
    camera: Camera | None = None,
    target: int | None = None,
    capacity: int = CAPACITY,
) -> Images:
    """The images with one number of a BOP scene; `colour` or `mask` is None where the scene has none.

    The mask numbers objects in the order of their files, as `scene_gt.json` does. If there are more than can be told
    apart, the smallest are left out and the rest is numbered anew, with a `Note`.

    Args:
      folder: of the scene, in which `scene_camera.json` is.
      number: of the image; None where the scene has but one.
      camera: its pose is taken where the scene has none. Otherwise the frame of the scene is that of the robot's base.
      target: the target's number in the names of the mask's files, as in `scene_gt.json`; negative where it is known
        not to show. The images' `target_id` is its number in the mask, -1 where it does not show.
      capacity: how many objects the recogniser can hold, beside the target.

    Raises:
      InputError: a file is missing or cannot be used, or nothing says where the camera is.
    """
    scene = Path(folder)
    known = entries(scene)
    if number not in known:
        if number is not None or len(known) != 1:
            what = "several images; say which" if number is None else f"no image {number}"
            raise InputError(f"{scene / SCENE}: has {what} (it has {len(known)}, {min(known)} to {max(known)})")
        (number,) = known
    entry, where = known[number], f"{scene / SCENE}: image {number}"
    scale = float(number_array(entry.get("depth_scale", 1.0), (), "depth_scale", where))
    if scale <= 0.0:
        raise InputError(f"{where}: depth_scale {scale:g} must be more than 0")
    depth = load_depth(_file(scene, "depth", number)) * np.float32(scale)
    coloured = any(scene.glob("rgb/*"))
    colour = load_colour(_file(scene, "rgb", number)) if coloured else None
    mask, numbers = _mask(scene, number, depth.shape, capacity + (coloured or target is not None), target)
    return Images(
        depth,
        colour,
        mask if numbers else None,
        None if target is None else numbers.get(target, OTHER),
        _camera(entry, depth.shape, camera, where),
    )


def entries(scene: Path) -> dict[int, dict[str, Any]]:
    """The entry of each image in a scene's `scene_camera.json`, by the image's number.

    Raises:
      InputError: the file cannot be read, or is another one.
    """
    value = read_json(scene / SCENE)
    good = isinstance(value, dict) and value and all(isinstance(entry, dict) for entry in value.values())
    if not good or not all(name.isascii() and name.isdigit() and len(name) < 10 for name in value):
        raise InputError(f"{scene / SCENE}: must hold an object for each image, named by the image's number")
    return {int(name): value[name] for name in sorted(value, key=int)}


def _file(scene: Path, kind: str, number: int) -> Path:
    files = sorted((scene / kind).glob(f"{number:06d}.*"))
    return files[0] if files else scene / kind / f"{number:06d}.png"


def _camera(entry: dict[str, Any], shape: tuple[int, ...], camera: Camera | None, where: str) -> Camera:
    if "cam_K" not in entry:
        raise InputError(f"{where}: cam_K is missing")
    K, T = number_array(entry["cam_K"], (3, 3), "cam_K", where), np.eye(4)
    if "cam_R_w2c" in entry and "cam_t_w2c" in entry:
        R = number_array(entry["cam_R_w2c"], (3, 3), "cam_R_w2c", where)
        t = number_array(entry["cam_t_w2c"], (3,), "cam_t_w2c", where) * MILLIMETRE
        T[:3, :3], T[:3, 3] = R.T, -R.T @ t
    elif camera is not None:
        T[:3, :3], T[:3, 3] = camera.rotation, camera.position
    else:
        raise InputError(
            f"{where}: has no cam_R_w2c and cam_t_w2c, which say where the camera is; say so in [camera] of --config"
        )
    return camera_of(shape[1], shape[0], K, T, where)


def visible_masks(scene: Path, number: int, shape: tuple[int, ...]) -> dict[int, Bool[np.ndarray, "h w"]]:
    """Which pixels show each object of an image, by the number in the name of its mask's file.

    Raises:
      InputError: a file is no mask of the image's shape.
    """
    shapes = {}
    for path in sorted((scene / "mask_visib").glob(f"{number:06d}_*")):
        tail = path.stem.rpartition("_")[2]
        image = load_pixels(path)
        if not tail.isdigit() or image.shape[:2] != shape:
            raise InputError(f"{path}: is no mask of shape {shape}, called {number:06d}_NUMBER; it is {image.shape}")
        shapes[int(tail)] = (image if image.ndim == 2 else image[..., 0]) > 0
    return shapes


def _mask(
    scene: Path, number: int, shape: tuple[int, ...], most: int, target: int | None
) -> tuple[Int[np.ndarray, "h w"], dict[int, int]]:
    """The mask of the objects that show most, and the number in it for each number in a file's name."""
    shapes = visible_masks(scene, number, shape)
    if target is not None and target >= 0 and not shapes.get(target, np.zeros(1, bool)).any():
        warnings.warn(
            Note(f"{scene}: image {number} has no mask that shows the target's number {shown(target)}: not seen"),
            stacklevel=3,
        )
    by_size = sorted(shapes, key=lambda each: (each != target, -int(shapes[each].sum())))
    kept = sorted(by_size[:most])
    showing = [each for each in shapes if shapes[each].any()]
    if left := len(set(showing) - set(kept)):
        says = f"{scene}: image {number} shows {len(showing)} objects; the {left} smallest are left out"
        warnings.warn(Note(says), stacklevel=3)
    mask = np.full(shape, OTHER, np.int8)
    for new, old in enumerate(kept):
        mask[shapes[old]] = new
    return mask, {old: new for new, old in enumerate(kept) if old in showing}
