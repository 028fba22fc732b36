"""Every mistake of the table in mistakes.md is made here, and gets the message that the table states."""

import dataclasses
import functools
import json
import re
import types
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import grey_dilation, minimum_filter

from mechsearch_jax.images.examples import example_images
from mechsearch_jax.images.image_files import (
    load_camera,
    load_colour,
    load_depth,
    load_mask,
    save_camera,
    save_depth,
)
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.problem.settings import load_settings
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.robot.arm_config import check_joints
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.faults import check_image
from mechsearch_jax.session.images import converted
from mechsearch_jax.workspace.sight import camera_faults, check_camera

GUIDE = Path(__file__).with_name("mistakes.md")
HEADER = "| mistake | what is said |"
IMAGES = example_images()
CELL = Workcell(camera=IMAGES.camera)
CAMERA, SHELF = CELL.camera, CELL.shelf
DEPTH, COLOUR, MASK = IMAGES.depth, IMAGES.colour, IMAGES.mask.astype(np.int32)
T = np.eye(4)
T[:3, :3], T[:3, 3] = CAMERA.rotation, CAMERA.position


def look(depth=DEPTH, colour=COLOUR, mask=None, target_id=None, camera=CAMERA, shelf=SHELF):
    """What a searcher warns of in images before it decides.

    Raises:
      InputError: it refuses them.
    """
    check_camera(camera, shelf)
    images = converted(depth, colour, mask, target_id)
    setting = types.SimpleNamespace(camera=camera, shelf=shelf, target=CELL.target)
    return [*camera_faults(camera, shelf), *check_image(setting, CELL.calibration, images, recogniser())[1]]


@functools.cache
def recogniser():
    return Recogniser(types.SimpleNamespace(camera=CAMERA, shelf=SHELF, target=CELL.target))


def posed(pose, **changes):
    rotation, position = tuple(map(tuple, pose[:3, :3].tolist())), tuple(pose[:3, 3].tolist())
    return dataclasses.replace(CAMERA, rotation=rotation, position=position, **changes)


def picture(tmp_path, array, load, name="image.png"):
    path = tmp_path / name
    np.save(path, array) if name.endswith("npy") else Image.fromarray(array).save(path)
    return load(path)


def camera_file(tmp_path, **changes):
    path = tmp_path / "camera.json"
    save_camera(CAMERA, path)
    value = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: part for key, part in value.items() if part is not None}))
    return load_camera(path)


def settings(tmp_path, text):
    (tmp_path / "mine.toml").write_text(text)
    return load_settings(tmp_path / "mine.toml")


def truncated(tmp_path):
    save_depth(DEPTH, tmp_path / "image.png")
    data = (tmp_path / "image.png").read_bytes()
    (tmp_path / "image.png").write_bytes(data[: len(data) // 2])
    return load_depth(tmp_path / "image.png")


def turned(axis, degrees):
    angle = np.radians(degrees)
    rotation = np.eye(4)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation[i, i] = rotation[j, j] = np.cos(angle)
    rotation[i, j], rotation[j, i] = -np.sin(angle), np.sin(angle)
    return rotation


def shifted(x=0.0, y=0.0, z=0.0):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def ray_lengths():
    v, u = np.meshgrid(np.arange(CAMERA.height), np.arange(CAMERA.width), indexing="ij")
    x, y = (u + 0.5 - CAMERA.cx) / CAMERA.fx, (v + 0.5 - CAMERA.cy) / CAMERA.fy
    return np.sqrt(1 + x**2 + y**2).astype(np.float32)


OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
BODY = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
MANY = np.repeat(np.arange(12, dtype=np.uint8), 12).reshape(12, 12)
# Each mistake makes an error, or returns what is said.
MISTAKES = {
    "depth: millimetres as floats": lambda tmp: look(1000 * DEPTH),
    "depth: whole millimetres, given to Python": lambda tmp: look((1000 * DEPTH).astype(np.uint16)),
    "depth: tenths of millimetres in a file of 16 bits": lambda tmp: look(10 * DEPTH),
    "depth: distances along the rays instead of along the camera's axis": lambda tmp: look(DEPTH * ray_lengths()),
    "depth: its scale 1% off": lambda tmp: look(1.01 * DEPTH),
    "depth: of another camera or resolution": lambda tmp: look(DEPTH[::2, ::2]),
    "depth: transposed": lambda tmp: look(DEPTH.T.copy()),
    "depth: upside down": lambda tmp: look(DEPTH[::-1].copy()),
    "depth: turned by 180 degrees": lambda tmp: look(DEPTH[::-1, ::-1].copy()),
    "depth: left and right exchanged": lambda tmp: look(DEPTH[:, ::-1].copy()),
    "depth: NaN, 0 or infinite everywhere": lambda tmp: look(np.full_like(DEPTH, np.nan)),
    "depth: 65.535 everywhere": lambda tmp: look(np.full_like(DEPTH, 65.535)),
    "depth: a thing without depth": lambda tmp: look(np.where(MASK == 0, 0, DEPTH)),
    "depth: the same everywhere": lambda tmp: look(np.full_like(DEPTH, 0.8)),
    "depth: most pixels not measured": lambda tmp: look(
        np.where(np.arange(DEPTH.size).reshape(DEPTH.shape) % 3, 0, DEPTH)
    ),
    "depth: nearer things reach beyond their edges, as where a stereo camera matches blocks": lambda tmp: look(
        minimum_filter(np.where(DEPTH > 0, DEPTH, np.inf), 5)
    ),
    "depth: complex, boolean or other numbers": lambda tmp: look(DEPTH > 0.5),
    "depth: no array": lambda tmp: look("depth.png"),
    "depth file: 8 bits": lambda tmp: picture(tmp, np.zeros((9, 16), np.uint8), load_depth),
    "depth file: a colour image": lambda tmp: picture(tmp, np.zeros((9, 16, 3), np.uint8), load_depth),
    "image file: cut off, or of another kind": truncated,
    "image file: missing": lambda tmp: load_depth(tmp / "image.png"),
    "image file: an array of another shape": lambda tmp: picture(tmp, np.zeros(9), load_depth, "image.npy"),
    "colour: blue, green, red": lambda tmp: look(*bgr()),
    "colour: 0 to 255 as floats": lambda tmp: look(colour=COLOUR.astype(np.float32)),
    "colour: 16 bits": lambda tmp: look(colour=COLOUR.astype(np.uint16)),
    "colour: of another camera or resolution": lambda tmp: look(colour=COLOUR[::2, ::2]),
    "colour file: grey": lambda tmp: picture(tmp, np.zeros((9, 16), np.uint8), load_colour),
    "mask: of another size": lambda tmp: look(mask=MASK[::2, ::2]),
    "mask: floats": lambda tmp: look(mask=MASK.astype(np.float32)),
    "mask: names nothing": lambda tmp: look(mask=np.full_like(MASK, -1), target_id=-1),
    "mask: shifted by 8 pixels": lambda tmp: look(mask=np.roll(MASK, 8, 1), target_id=-1),
    "mask: 6 pixels too large": lambda tmp: look(mask=grey_dilation(MASK, size=(13, 13)), target_id=-1),
    "mask file: the background's number is not given": lambda tmp: picture(
        tmp, np.zeros((12, 12), np.uint8), lambda path: load_mask(path, 255)
    ),
    "mask file: more objects than can be told apart": lambda tmp: picture(tmp, MANY, lambda path: load_mask(path, 255)),
    "mask file: colours": lambda tmp: picture(tmp, np.zeros((9, 16, 3), np.uint8), lambda path: load_mask(path, 255)),
    "target: its number is not in the mask": lambda tmp: look(mask=MASK, target_id=77),
    "target: a number without a mask": lambda tmp: look(target_id=3),
    "target: neither colour nor a number": lambda tmp: look(colour=None),
    "pose: inverted": lambda tmp: check_camera(posed(np.linalg.inv(T)), SHELF),
    "pose: rotation transposed": lambda tmp: check_camera(posed(np.block([[T[:3, :3].T, T[:3, 3:]], [T[3:]]])), SHELF),
    "pose: OpenGL's axes": lambda tmp: check_camera(posed(T @ OPENGL), SHELF),
    "pose: the axes of a robot's body": lambda tmp: check_camera(posed(T @ BODY), SHELF),
    "pose: the image is upside down": lambda tmp: look(camera=posed(T @ np.diag([-1.0, -1.0, 1.0, 1.0]))),
    "pose: looks away": lambda tmp: check_camera(posed(turned(2, 180) @ T), SHELF),
    "pose: mirrored": lambda tmp: posed(T @ np.diag([-1.0, 1.0, 1.0, 1.0])),
    "pose: millimetres": lambda tmp: posed(shifted() @ np.block([[T[:3, :3], 1000 * T[:3, 3:]], [T[3:]]])),
    "pose: in another frame, as the table's": lambda tmp: look(camera=posed(shifted(z=-0.15) @ T)),
    "pose: camera or shelf moved by 5 mm": lambda tmp: look(camera=posed(shifted(x=0.005) @ T)),
    "pose: camera or shelf moved by 2 cm": lambda tmp: look(camera=posed(shifted(x=0.02) @ T)),
    "pose: camera turned by 2 degrees": lambda tmp: look(camera=posed(turned(2, 2.0) @ T)),
    "shelf: the upper board measured 12 mm too low": lambda tmp: look(
        shelf=dataclasses.replace(SHELF, ceiling=SHELF.ceiling - 0.012)
    ),
    "intrinsics: of another resolution": lambda tmp: look(
        camera=posed(T, fx=CAMERA.fx / 2, fy=CAMERA.fy / 2, cx=CAMERA.cx / 2, cy=CAMERA.cy / 2)
    ),
    "intrinsics: 5% off": lambda tmp: look(camera=posed(T, fx=1.05 * CAMERA.fx, fy=1.05 * CAMERA.fy)),
    "camera file: cut off, or no JSON": lambda tmp: (
        (tmp / "camera.json").write_text('{"width": 12') and load_camera(tmp / "camera.json")
    ),
    "camera file: a field is missing": lambda tmp: camera_file(tmp, K=None),
    "camera file: a field is unknown": lambda tmp: camera_file(tmp, widht=3),
    "camera file: the lens distorts, in `load_camera`": lambda tmp: camera_file(tmp, D=[0.1, 0.0, 0.0, 0.0, 0.0]),
    "camera file: a fisheye": lambda tmp: camera_file(tmp, distortion_model="equidistant"),
    "camera file: K with too few numbers": lambda tmp: camera_file(tmp, K=[600.0, 600.0, 640.0, 360.0]),
    "camera file: pose transposed": lambda tmp: camera_file(tmp, T_world_camera=T.T.tolist()),
    "camera file: a pose that is no rotation": lambda tmp: camera_file(
        tmp, T_world_camera=(T * [[2, 1, 1, 1]]).tolist()
    ),
    "configuration: unknown table": lambda tmp: settings(tmp, "[camra]\nfx = 3\n"),
    "configuration: unknown key": lambda tmp: settings(tmp, "[camera]\nfocal = 3\n"),
    "configuration: a value of another type": lambda tmp: settings(tmp, '[camera]\nwidth = "1280"\n'),
    "configuration: millimetres": lambda tmp: settings(tmp, "[shelf]\nfront = 414\n"),
    "configuration: degrees": lambda tmp: settings(tmp, "[arm]\nhome = [0, -84, 0, -140, 8, 132, 40]\n"),
    "configuration: back before front": lambda tmp: settings(tmp, "[shelf]\nback = 0.3\n"),
    "configuration: a target without a hue": lambda tmp: settings(tmp, "[target]\ncolour = [0.5, 0.5, 0.5]\n"),
    "configuration: no TOML": lambda tmp: settings(tmp, "[camera\n"),
    "joints: degrees": lambda tmp: check_joints("joints", np.array([0.0, -84, 0, -140, 8, 132, 40])),
    "joints: six, or NaN": lambda tmp: check_joints("joints", np.zeros(6)),
}


def bgr():
    """Depth, and colours with red and blue exchanged, of a target in the open."""
    from test_perception_plausibility import IN_SIGHT, sensed

    depth, colour = sensed(IN_SIGHT, CAMERA)
    return depth, colour[..., ::-1].copy()


def response(mistake, tmp_path):
    """What a mistake gets: how it is taken, and the error's message or the warnings."""
    try:
        taken, result = "warned of", MISTAKES[mistake](tmp_path)
    except InputError as error:
        taken, result = "refused", [str(error)]
    return taken, [line.replace(f"{tmp_path}/", "") for line in result or ()]


def table():
    rows = re.search(rf"^{re.escape(HEADER)}\n\|[-|]+\|\n((?:\|.*\|\n)+)", GUIDE.read_text(encoding="utf-8"), re.M)
    assert rows
    return dict(row.strip("| ").split(" | ", 1) for row in rows[1].splitlines())


def test_the_table_has_all_of_them():
    assert list(table()) == list(MISTAKES)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_gets_what_the_table_says(mistake, tmp_path):
    taken, lines = response(mistake, tmp_path)
    assert all(len(line.splitlines()) == 1 for line in lines)
    how, stated = re.fullmatch(r"([\w ]+): `(.+)`", table()[mistake]).groups()
    assert how == taken
    pattern = ".*".join(map(re.escape, stated.split("…")))
    assert any(re.match(pattern, line) for line in lines), (stated, lines)
