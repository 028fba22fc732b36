"""What depth images are like, in figures: of simulated sensors, and of a folder of real images."""

from __future__ import annotations

import dataclasses
import json
import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key
from scipy import ndimage
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.camera.colour_image import scene_key
from mechsearch_jax.envs.camera.sensors import SENSORS, Sensor, surfaces_of
from mechsearch_jax.envs.camera.simulated_camera import BACKGROUND, SHELF, cast_shelf, observe
from mechsearch_jax.images.camera_pose import with_pose
from mechsearch_jax.images.noise import depth_of
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.train.scenes import random_world
from mechsearch_jax.workspace.camera import Camera, back_project, rays
from mechsearch_jax.workspace.shelf import Shelf

# Depths at which noise is measured, and how far from them [m]; least number of pixels.
DEPTHS, BAND, LEAST = (0.75, 0.8, 1.0), 0.05, 1000
# Distances at which noise is compared, and side of the blocks of which means are taken, in pixels.
LAGS, BLOCK = (4, 16), 24
# Points so far above the board are no board to recognition [m]. Those so far below it are mirrored, if they are such a
# share of those of things.
MARGIN, BELOW, FEW = 0.004, 0.008, 0.005
# Least difference in depth at a gap, and largest width of one, in pixels.
JUMP, WIDEST = 0.04, 60
# Sine of the angle down from which a camera looks at the board, not at the back wall.
STEEP = 0.45
# Pixels about things that are left out, and how far from a face points may be [m].
AROUND, NEAR = 8, 0.02
# Views as those of the real images: a table from above, whose walls are far away, and a shelf from before it.
FAR = Shelf(front=0.1, back=1.6, right=-1.5, left=1.5, ceiling=2.5)


def _looking(x: float, y: float, z: float, down: float, focal: float) -> Camera:
    """A camera of 640 x 480 pixels that looks along x, and down by an angle [degrees]."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", down, degrees=True).as_matrix() @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = x, y, z
    return with_pose(Camera(640, 480, focal, focal, 320.0, 240.0), T)


VIEWS: Mapping[str, tuple[Camera, Shelf]] = {
    "table": (_looking(-0.05, 0.1, 1.017, 37.0, 525.0), FAR),
    "shelf": (_looking(0.1, 0.1, 0.645, 20.0, 477.0), Shelf()),
}


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """A depth image and what is known of it.

    Attributes:
      camera: of the image.
      shelf: whose faces it shows.
      depth: [m]; NaN where nothing was measured, shape (h, w).
      body: pixels of things.
      inside: pixels that show shelf or things, measured or not.
    """

    camera: Camera
    shelf: Shelf
    depth: Float[np.ndarray, "h w"]
    body: Bool[np.ndarray, "h w"]
    inside: Bool[np.ndarray, "h w"]


def real_pictures(folder: Path) -> Iterator[Picture]:
    """The labelled images of a folder: NAME.npz with `depth` [0.1 mm], `mask` and `camera`, and perhaps shelf.toml with
    the faces of a shelf; otherwise a table."""
    faces = folder / "shelf.toml"
    shelf = Shelf(**tomllib.loads(faces.read_text())["shelf"]) if faces.exists() else FAR
    for file in sorted(folder.glob("*.npz")):
        data = np.load(file)
        about = json.loads(str(data["camera"]))
        K, T = np.array(about["K"], float).reshape(3, 3), np.array(about["T_world_camera"], float)
        fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]) + 0.5, float(K[1, 2]) + 0.5
        camera = with_pose(Camera(about["width"], about["height"], fx, fy, cx, cy), T)
        depth = np.where(data["depth"] > 0, data["depth"] / 1e4, np.nan)
        body = data["mask"] != 255 if "mask" in data else np.zeros(depth.shape, bool)
        points = np.asarray(back_project(camera, cast_shelf(camera, shelf, rays(camera))))
        low, high = (shelf.front, shelf.right, shelf.board), (shelf.back, shelf.left, shelf.ceiling)
        inside = np.all((points > np.array(low) - 1e-3) & (points < np.array(high) + 1e-3), axis=-1)
        # How far a table reaches is not known.
        yield Picture(camera, shelf, depth, body, inside & faces.exists())


def simulated_pictures(sensor: Sensor, view: str, count: int, seed: int = 0) -> Iterator[Picture]:
    """Images of random scenes.

    Args:
      sensor: that takes them.
      view: one of `VIEWS`.
      count: of them.
      seed: of scenes and noise.
    """
    camera, shelf = VIEWS[view]
    for number in range(count):
        key = jax.random.fold_in(jax.random.key(seed), number)
        depth, body, inside = map(np.asarray, _take(key, sensor, camera, shelf))
        yield Picture(camera, shelf, depth.astype(float), body, inside)


@jax.jit
def _take(key: Key[Array, ""], sensor: Sensor, camera: Camera, shelf: Shelf):
    scene, noise = jax.random.split(key)
    world = random_world(scene)
    image = observe(camera, world, shelf)
    surfaces = surfaces_of(scene_key(world), camera, shelf, world, image.segmentation, image.depth)
    points = sensor(noise, camera, image.depth, surfaces)
    # Who labels an image takes what is mirrored for a part of the thing.
    mirrored = jnp.isfinite(surfaces.mirrored) & (points[..., 2] < shelf.board - BELOW)
    body = (image.segmentation >= 0) & (image.segmentation < SHELF) | mirrored
    return depth_of(camera, points), body, image.segmentation != BACKGROUND


def figures(picture: Picture) -> dict[str, float]:
    """What a depth image is like; NaN where it does not show it.

    Noise is along the camera's axis, against the plane that fits a face best: the board, or the back wall if the camera
    looks more at that. Keys say what, and in what unit.
    """
    camera, depth, d = picture.camera, picture.depth, np.asarray(rays(picture.camera), float)
    points = np.array(camera.position) + depth[..., None] * d
    away = np.isfinite(depth) & np.logical_not(ndimage.binary_dilation(picture.body, iterations=AROUND))
    board = abs(camera.rotation[2][2]) > STEEP
    error, face = _off_plane(points, d, away, picture.shelf, board)
    found: dict[str, float] = {
        f"noise at {at} m [mm]": 1e3 * _deviation(error[face & (np.abs(depth - at) < BAND)]) for at in DEPTHS
    }
    near = face & (depth < 1.1)
    noise = np.where(near, error, np.nan)
    for lag in LAGS:
        pairs = ((noise[:, :-lag], noise[:, lag:]), (noise[:-lag], noise[lag:]))
        found[f"alike at {lag} px"] = float(np.mean([_correlation(a, b) for a, b in pairs]))
    found[f"mean of {BLOCK} px [mm]"] = 1e3 * _deviation(_block_means(noise))
    # Beyond a face of its own noise, whichever it is.
    towards = error * d[..., 2] if board else -error
    found["of it above the margin [%]"] = (
        100 * float(np.mean(towards[near] > MARGIN)) if near.sum() > LEAST else math.nan
    )
    left, right = _gaps(depth, picture.body)
    for side, widths in (("left", left), ("right", right)):
        for part in (50, 90):
            found[f"{side} gap, {part}% [px]"] = float(np.percentile(widths, part)) if widths else math.nan
    found["holes [%]"] = 100 * float(np.mean(np.isnan(depth[picture.inside]))) if picture.inside.any() else math.nan
    below = picture.shelf.board - points[picture.body & np.isfinite(depth), 2]
    mirrors = len(below) > 0 and np.mean(below > BELOW) > FEW
    found["mirrored down to [mm]"] = 1e3 * float(np.percentile(below, 99)) if mirrors else math.nan
    return found


def means(pictures: Iterable[Picture]) -> dict[str, float]:
    """The mean of each of the `figures` over the images that show it; without those that none shows."""
    rows = [figures(picture) for picture in pictures]
    columns = {name: [row[name] for row in rows if not math.isnan(row[name])] for name in rows[0]}
    return {name: float(np.mean(column)) for name, column in columns.items() if column}


def real_columns(folder: Path) -> dict[str, dict[str, float]]:
    """The figures of each folder of labelled images in a folder.

    Raises:
      InputError: there is none.
    """
    found = {place.name: place for place in sorted(folder.iterdir()) if place.is_dir() and list(place.glob("*.npz"))}
    if not found:
        raise InputError(f"{folder}: holds no folder of images NAME.npz")
    return {f"real {name}": means(real_pictures(place)) for name, place in found.items()}


def simulated_columns(scenes: int) -> dict[str, dict[str, float]]:
    """The figures of every sensor in every view, over a number of scenes."""
    return {
        f"{name}, {view}": means(simulated_pictures(sensor, view, scenes))
        for view in VIEWS
        for name, sensor in SENSORS.items()
    }


def _off_plane(points: np.ndarray, directions: np.ndarray, away: np.ndarray, shelf: Shelf, board: bool):
    """Errors of the depth against the plane of the board or of the back wall, and which pixels show it."""
    if board:
        near = away & (np.abs(points[..., 2] - shelf.board) < NEAR)
    else:
        near = away & (np.abs(points[..., 0] - shelf.back) < NEAR) & (points[..., 2] > shelf.board + NEAR)
    on = near
    for _ in range(10):
        centre = points[on].mean(axis=0)
        normal = np.linalg.svd(points[on][:: max(1, on.sum() // 20000)] - centre, full_matrices=False)[2][2]
        off = (points - centre) @ normal
        on = near & (np.abs(off) < max(4 * 1.4826 * np.median(np.abs(off[on])), 1e-4))
    return off / (directions @ normal), on


def _deviation(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(values.std()) if len(values) >= 2 else math.nan


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    both = np.isfinite(a) & np.isfinite(b)
    return float(np.corrcoef(a[both], b[both])[0, 1]) if both.sum() > LEAST else math.nan


def _block_means(noise: np.ndarray) -> np.ndarray:
    """Means of the blocks most of which is measured."""
    rows, columns = (size // BLOCK for size in noise.shape)
    blocks = noise[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK)
    count = np.isfinite(blocks).sum(axis=(1, 3))
    return np.where(count > 0.6 * BLOCK**2, np.nansum(blocks, axis=(1, 3)) / np.maximum(count, 1), np.nan).reshape(-1)


def _gaps(depth: np.ndarray, body: np.ndarray) -> tuple[list[int], list[int]]:
    """Widths of what is unmeasured in rows on the left and on the right of things before something farther."""
    left, right = [], []
    for row in np.where(body.any(axis=1))[0]:
        edges = np.diff(np.isnan(depth[row]).astype(int))
        starts, ends = np.flatnonzero(edges == 1) + 1, np.flatnonzero(edges == -1) + 1
        ends = ends[ends > starts[0]] if len(starts) else ends
        for start, end in zip(starts, ends, strict=False):
            step = depth[row, start - 1] - depth[row, end]
            if end - start <= WIDEST and abs(step) > JUMP and body[row, end if step > 0 else start - 1]:
                (left if step > 0 else right).append(int(end - start))
    return left, right
