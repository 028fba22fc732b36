"""Labelled depth images of real scenes in files: BOP scenes, as `images.bop` reads them, and `NAME.npz` files.

These hold `depth`, uint16 in 0.1 mm, 0 where not measured; `mask`, uint8, the number of each pixel's thing, 255 for
none; `camera`, JSON as of `image_files.load_camera`; perhaps `notes`, JSON with a `category`. `NAME.jpg` is the colour.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from mechsearch_jax.images.bop import SCENE, bop_image, entries, visible_masks
from mechsearch_jax.images.image_files import camera_of, load_colour, number_array
from mechsearch_jax.runtime.errors import InputError, Note
from mechsearch_jax.runtime.files import is_file, is_folder
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

# z of the table: of our world, and of a BOP scene's, whose origin is on it [m].
BOARD, BOP_BOARD = Shelf().board, 0.0
# The table in front of the camera: from where to where before it, to either side, and up [m].
NEAR, FAR, WIDE, HIGH = 0.35, 0.95, 0.5, 0.45
# A world in which the camera looks farther to the side is turned until it looks along x [degrees].
SIDEWAYS = 30.0


@dataclasses.dataclass(frozen=True, eq=False)
class LabelledScene:
    """An image of a scene.

    Attributes:
      category: what kind of scene it is.
      camera: of the images, in a world whose z is up.
      board: z of what things stand on [m].
      depth: [m], 0 where nothing was measured.
      colour: registered to it; None without one.
      mask: the number of the thing that a pixel shows, -1 for none.
    """

    category: str
    camera: Camera
    board: float
    depth: Float[np.ndarray, "h w"]
    colour: UInt8[np.ndarray, "h w 3"] | None
    mask: Int[np.ndarray, "h w"]

    def workspace(self, shelf: Shelf | None) -> tuple[Camera, Shelf]:
        """The camera and the given shelf, or the table before the camera as one whose walls are far from things."""
        if shelf is not None:
            return self.camera, shelf
        camera = ahead(self.camera)
        x, y, _ = camera.position
        sides = (y - WIDE, y + WIDE, self.board, self.board + HIGH)
        return camera, Shelf(x + NEAR, x + FAR, *sides)


def ahead(camera: Camera) -> Camera:
    """The camera in a world that is turned about z until it looks along x, if it looks far to the side."""
    rotation = np.array(camera.rotation)
    heading = math.atan2(rotation[1, 2], rotation[0, 2])
    if abs(heading) < math.radians(SIDEWAYS):
        return camera
    c, s = math.cos(heading), math.sin(heading)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    rows = tuple(map(tuple, (turn @ rotation).tolist()))
    return dataclasses.replace(camera, rotation=rows, position=tuple((turn @ camera.position).tolist()))


def find_scenes(folder: Path) -> dict[str, Callable[[], LabelledScene | None]]:
    """What reads each image in and beneath a folder, by the image's name; it returns None for one without labels.

    Raises:
      InputError: there is no image, or a BOP scene's list of them is wrong. What reads one raises it about its files.
    """
    found: dict[str, Callable[[], LabelledScene | None]] = {}
    for file in sorted(folder.rglob("*.npz")) if is_folder(folder) else ():
        found[file.relative_to(folder).with_suffix("").as_posix()] = functools.partial(_arrays, file)
    for scene in sorted(file.parent for file in folder.rglob(SCENE)) if is_folder(folder) else ():
        for number in entries(scene):
            name = (scene.relative_to(folder) / f"{number:06d}").as_posix()
            found[name] = functools.partial(_bop, scene, number)
    if not found:
        raise InputError(f"{folder}: holds no scenes; name a folder of BOP scenes ({SCENE}) or of .npz files")
    return found


def _arrays(file: Path) -> LabelledScene | None:
    try:
        with np.load(file) as stored:
            parts = dict(stored)
        camera, notes = (json.loads(str(parts.get(name, "{}"))) for name in ("camera", "notes"))
        depth, width, height = parts["depth"].astype(np.float32) / 1e4, camera["width"], camera["height"]
        K, T = (number_array(camera[key], (n, n), key, file) for key, n in (("K", 3), ("T_world_camera", 4)))
        category = str(notes.get("category", file.parent.name))
    except (OSError, ValueError, KeyError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(f"{file}: is no labelled depth image ({' '.join(str(error).split())})") from error
    if "mask" not in parts:
        return None
    if np.any(camera.get("D", 0.0)):
        raise InputError(f"{file}: D says that the lens distorts; give images that are rectified")
    colour = load_colour(picture) if is_file(picture := file.with_suffix(".jpg")) else None
    mask = np.where(parts["mask"] == 255, -1, parts["mask"].astype(int))
    return _fitting(file, LabelledScene(category, camera_of(width, height, K, T, file), BOARD, depth, colour, mask))


def _bop(scene: Path, number: int) -> LabelledScene | None:
    # All labels count here, not only those that a recogniser can be told of.
    with warnings.catch_warnings(category=Note, action="ignore"):
        images = bop_image(scene, number)
    mask = np.full(images.depth.shape, -1)
    masks = visible_masks(scene, number, mask.shape)
    for thing, shown in masks.items():
        mask[shown] = thing
    read = LabelledScene(scene.name, images.camera, BOP_BOARD, images.depth, images.colour, mask)
    return _fitting(scene, read) if masks else None


def _fitting(place: Path, scene: LabelledScene) -> LabelledScene:
    """The scene, whose images have to be of the camera's size."""
    size = (scene.camera.height, scene.camera.width)
    for name in ("depth", "mask", "colour"):
        image = getattr(scene, name)
        if image is not None and image.shape[:2] != size:
            raise InputError(f"{place}: its {name} image is {image.shape[:2]}, its camera's are {size}")
    return scene
