"""Constants of f: the target's images and collision cloud at its candidate poses, computed once for a problem."""

from __future__ import annotations

import itertools
import math

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from mechsearch_jax.existence.config import ExistenceConfig
from mechsearch_jax.geometry.transforms import transform, upright_pose
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace import render
from mechsearch_jax.workspace.camera import Camera, project
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target
from mechsearch_jax.workspace.target_view import box_around, extent, framed, surface_cloud, window_image

# Places whose images are computed at once, and the multiple to which the number of places is rounded up.
BLOCK, ROWS = 32, 1024
# Sides of the windows of targets of pieces, so that all that are about as large share their programs.
SIDES = (32, 48, 64, 96, 128)


class ExistenceTables(PyTreeNode):
    """Constants of f in a `Problem`, for S places at each of X candidate poses.

    Attributes:
      T_world_target: poses of the target at the places, shape (X, S, 4, 4).
      depth: the target's depth in a window at each place, infinite around it, shape (X, S, h, w) [m].
      corner: first row and column of that window in the coarse image, shape (X, S, 2).
      middle: row and column of the pixel in the middle of the target's image at the first place, shape (X, 2).
      nearest: the least depth of the target at the first place, shape (X,) [m].
      cloud: surface of the target in its own frame as rows of coordinates, shape (3, P) [m].
      radius: radius of a sphere that contains the target [m].
    """

    T_world_target: jax.Array
    depth: jax.Array
    corner: jax.Array
    middle: jax.Array
    nearest: jax.Array
    cloud: jax.Array
    radius: jax.Array


def existence_tables(camera: Camera, shelf: Shelf, target: Target, config: ExistenceConfig) -> ExistenceTables:
    """Precompute, for every candidate pose, the target's own depth image and collision cloud."""
    places = target.places(shelf, config.places)
    T = jax.jit(upright_pose)(np.asarray(places, np.float32), target.height(shelf))
    coarse = camera.scaled(config.step(camera))
    half = np.array(target.half_size, np.float32)
    window, around = target_window(coarse, extent(target)[1], framed(target, T))

    views, first = (_views_of_pieces if target.is_compound else _views)(coarse, target, T, window, around)
    depth, corner, first = jax.device_get((views.depth, views.corner, first))
    middle = first[:, 0] + np.array(around, np.int32)[None] // 2
    cloud = surface_cloud(target, config.points)
    nearest = depth[:, 0].min(axis=(-1, -2))
    radius = np.float32(np.linalg.norm(half))
    return ExistenceTables(*jax.device_put((T, depth, corner, middle, nearest, cloud.T, radius)))


def _views(
    coarse: Camera,
    target: Target,
    T_world_target: Float[Array, "x s 4 4"],
    window: tuple[int, int],
    around: tuple[int, int],
) -> tuple[render.Window, Int[Array, "x s 2"]]:
    """The images of a target in windows, and the first rows and columns of windows of another size."""

    def view(coarse, pose):
        first, _ = render.window_place(coarse, box_around(target, pose), around)
        return window_image(coarse, target, pose, window), first

    return jax.jit(jax.vmap(jax.vmap(view, in_axes=(None, 0)), in_axes=(None, 0)))(coarse, T_world_target)


def _views_of_pieces(
    coarse: Camera,
    target: Target,
    T_world_target: Float[Array, "x s 4 4"],
    window: tuple[int, int],
    around: tuple[int, int],
) -> tuple[render.Window, Int[np.ndarray, "x s 2"]]:
    """`_views` of a target of pieces, for which the faces of all pieces are tested at every pixel."""
    rows, columns = (next((side for side in SIDES if side >= least), least) for least in window)
    T = np.asarray(T_world_target).reshape(-1, 4, 4)
    # Neighbouring cells have their corners in common.
    _, index, inverse = np.unique(
        np.round(T[:, :3], 5).reshape(len(T), -1), axis=0, return_index=True, return_inverse=True
    )
    missing = -len(index) % ROWS
    once = T[np.pad(index, (0, missing), mode="edge")]
    views, first = jax.device_get(
        _views_in_blocks(coarse, target, once, np.asarray(around, np.float32), (rows, columns))
    )
    shape = T_world_target.shape[:2]
    return jax.tree.map(lambda a: a[inverse].reshape(*shape, *a.shape[1:]), (views, first))


@cached_jit(static_argnames=("window",), on_host=True)
def _views_in_blocks(
    coarse: Camera,
    target: Target,
    T_world_target: Float[Array, "n 4 4"],
    around: Float[Array, "2"],
    window: tuple[int, int],
) -> tuple[render.Window, Int[Array, "n 2"]]:
    """The images of a target, few at once, and the first rows and columns of windows of another size."""

    def view(pose):
        first, _ = render.window_place(coarse, box_around(target, pose), around)
        return window_image(coarse, target, pose, window), first

    return jax.lax.map(view, T_world_target, batch_size=BLOCK)


def _window_side(extent: float) -> int:
    """Number of rows or columns of a window that contains an image of this length in pixels: an even number.

    It is even because after a new calibration the target's image is a little larger or smaller: the least number would
    often change shapes, and everything would compile anew.
    """
    # The extent is computed in single precision and may be slightly larger on another machine.
    return 2 * math.ceil((math.ceil(extent + 1e-3) + 1) / 2)


def target_window(
    coarse: Camera, half: Float[np.ndarray, "3"], T_world_target: Float[Array, "*batch 4 4"]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Rows and columns of a window that contains a target's image at each of several poses, and of the least such
    window, whose middle does not depend on how the other's sides are rounded.

    The window is hardly larger than the image with a margin of one pixel.

    Args:
      coarse, half, T_world_target: as of `target_extent`.
    """
    rows, columns = target_extent(coarse, half, T_world_target)
    return (_window_side(rows), _window_side(columns)), (math.ceil(rows) + 2, math.ceil(columns) + 2)


def target_extent(
    coarse: Camera, half: Float[np.ndarray, "3"], T_world_target: Float[Array, "*batch 4 4"]
) -> tuple[float, float]:
    """Rows and columns of the largest image of a target at several poses, at most those of the camera's image.

    Args:
      coarse: the camera at the window's resolution.
      half: half-extents of the target [m].
      T_world_target: the poses.
    """
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)), np.float32) * half
    pixels = np.asarray(_pixels_of(coarse, T_world_target, corners), float)
    # The limit of `render.window_place` outside of the image.
    limit = np.array([coarse.height, coarse.width])
    low, high = (np.clip(bound, -1, limit) for bound in (pixels.min(axis=-2), pixels.max(axis=-2)))
    rows, columns = np.minimum((high - low).reshape(-1, 2).max(axis=0), limit)
    return float(rows), float(columns)


@jax.jit
def _pixels_of(
    camera: Camera, T: Float[Array, "*batch 4 4"], points: Float[Array, "k 3"]
) -> Float[Array, "*batch k 2"]:
    """Pixels of points of bodies at poses T."""
    return project(camera, transform(T[..., None, :, :], points))[0]
