"""The existence function f: where can the target still be? (paper section 4.2 and appendix B.2;
docs/method.md, "Existence")

A candidate pose represents its whole grid cell, so the target is tested at several places of the cell. At each it must
be hidden (it would show no more pixels than the detector needs) and free of collision. f is 1 if any place passes.
Recognised shapes are used without margins. A pixel in which nothing was measured shows nothing: it rules no place out.

Pixels are counted at a fraction of the camera's resolution, where a sliver beside an object may count for several times
its size. Where few pixels show, the observed scene is therefore counted again at a finer resolution (`allowances`). If
the target is hidden there, the place may keep showing as many coarse pixels, since predicted states are judged by the
coarse image alone.

A pose whose cell contains any hidden place must stay possible, or the target is lost. In generated scenes f is 1.13
times as large as that least set (40 scenes, 25 places a cell at full resolution, `python -m
mechsearch_jax.benchmarks.lab scenes --exact`), which is itself 1.63 times as large as with the cells' middles alone.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.bodies import enlarged, per_part, slimmed, world_parts
from mechsearch_jax.geometry.collision import clouds_of, collisions
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import inverse, make, transform, upright_pose
from mechsearch_jax.images.measured import beside, unmeasured, veiled
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace import render
from mechsearch_jax.workspace.camera import Camera, project
from mechsearch_jax.workspace.detector import FOUND_PIXELS, found_pixels, longer
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target
from mechsearch_jax.workspace.target_view import box_around, extent, framed, surface_cloud, window_image

# Factor by which the image of a closer look is coarser than 1280 x 720; scaled likewise for other images.
CLOSER_LOOK = 3
# Places whose images are computed at once, and the multiple to which the number of places is rounded up.
BLOCK, ROWS = 32, 1024
# Sides of the windows of targets of pieces, so that all that are about as large share their programs.
SIDES = (32, 48, 64, 96, 128)
# Depth of the background where depth images are compared [m].
FAR = 1.5
# Largest number of coarse pixels for which a closer look is made; no target that the detector missed was observed to
# show more than 12.
DOUBTFUL = 16
# Number of places of a pose with the fewest pixels that are counted again.
CLOSER_PLACES = 3
# Factor by which a count at a third of the camera's resolution may be wrong.
CLOSER_TOLERANCE = 1.5
# Multiple of the detector's threshold above which a target cannot be missed: neither by a sensor that measures only a
# third of its pixels, nor beside an object that is recognised 5 mm too narrow on one side.
PLAIN = 3.0
# Largest depth to which an object overlaps the target by an error of its recognised pose, or by touching it [m].
TOUCHING = 0.01
# Size of a found target's image relative to the largest image at a candidate pose.
NEARER = 1.25
# Added to objects for the rounded edges of superquadrics that represent boxes and cylinders [m].
ROUNDED = 1e-3


@dataclasses.dataclass(frozen=True)
class ExistenceConfig:
    """Settings of f.

    Attributes:
      found_pixels: the detector finds the target if it shows more pixels than this in an image of 1280 x 720; in other
        images the same share, see `workspace.detector`.
      depth_threshold: threshold of the mean squared difference, for preset `paper` alone [m^2].
      downscale: factor by which f is rendered coarser than an image of 1280 x 720; with other images scaled to keep the
        size of a coarse pixel, rounded to a whole number.
      as_in_paper: set by preset `paper` alone: what makes the target visible is then the mean squared difference of the
        two depth images instead of the pixels that it would show at full resolution, as the detector counts them; it is
        tested half-way to the corners of its grid cell; and f is never opened again.
      window: rows and columns of the window an object is rendered in, at the coarse resolution.
      points: points on the target's surface for the collision test.
    """

    found_pixels: int = FOUND_PIXELS
    depth_threshold: float = 0.001
    downscale: int = 7
    as_in_paper: bool = False
    window: tuple[int, int] = (48, 48)
    points: int = 512

    def __post_init__(self):
        if self.downscale < 1:
            raise InputError(f"ExistenceConfig: downscale {self.downscale} must be at least 1")
        if self.looks_closer and self.downscale <= CLOSER_LOOK:
            raise InputError(
                f"ExistenceConfig: downscale {self.downscale} must be above that of a closer look, {CLOSER_LOOK}"
            )

    @property
    def looks_closer(self) -> bool:
        """Whether pixels are counted again in a finer image where few of the target's show."""
        return not self.as_in_paper

    @property
    def places(self) -> np.ndarray:
        """Places in a cell where the target is tested: x, y and yaw as shares of half the cell, shape (S, 3).

        The middle and the corners, where it is also turned by half a step in yaw, to alternating sides; the corners of
        the outermost cells lie at the walls.
        """
        share = 0.5 if self.as_in_paper else 1.0
        corners = [(a, b, a * b * (share == 1.0)) for a in (-share, share) for b in (-share, share)]
        return np.array([(0.0, 0.0, 0.0), *corners], np.float32)

    def step(self, camera: Camera) -> int:
        """Side of a coarse pixel in pixels of a camera's image."""
        return max(round(self.downscale * longer(camera)), 1)

    def closer_step(self, camera: Camera) -> int:
        """Side of a pixel of the closer look in pixels of a camera's image; `step` if there is no closer look."""
        return max(round(CLOSER_LOOK * longer(camera)), 1) if self.looks_closer else self.step(camera)

    def allowed(self, camera: Camera) -> int:
        """How many coarse pixels a target may show that the detector does not find."""
        return int(found_pixels(camera, self.found_pixels) // self.step(camera) ** 2)


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


class ObjectViews(PyTreeNode):
    """Image and collisions of each object; after a motion only those of the moved objects are recomputed.

    Attributes:
      windows: the objects' images, with a leading axis N.
      collides: whether the target at a place would collide with the object, shape (X, S, N); None if collisions do not
        count.
    """

    windows: render.Window
    collides: jax.Array | None


def no_views(capacity: int, config: ExistenceConfig, places: tuple[int, int] | None = None) -> ObjectViews:
    """Views of `capacity` objects before any rendering: they hide nothing, like empty slots.

    Args:
      capacity: number of objects.
      config: static.
      places: number of candidate poses, and of places at each, if collisions count; None if they do not.
    """
    return ObjectViews(
        windows=render.Window(
            depth=jnp.full((capacity, *config.window), jnp.inf, jnp.float32),
            corner=jnp.zeros((capacity, 2), jnp.int32),
            stride=jnp.ones(capacity, jnp.int32),
        ),
        collides=None if places is None else jnp.zeros((*places, capacity), bool),
    )


def object_views(
    tables: ExistenceTables,
    camera: Camera,
    scene: Superquadrics,
    exists: Bool[Array, " x"] | None,
    config: ExistenceConfig,
    previous: ObjectViews | None = None,
    moved: Bool[Array, " n"] | None = None,
) -> ObjectViews:
    """Render the objects and test them against the target's places.

    Args:
      tables: constants of the problem.
      camera: the camera at full resolution.
      scene: the objects, fields (N, ...).
      exists: poses at which collisions are computed; they are False elsewhere. None if collisions do not count.
      config: static.
      previous: views of the same objects before objects moved.
      moved: which objects moved since; only they are computed anew.

    Returns:
      The views of all objects.
    """
    coarse = camera.scaled(config.step(camera))
    fresh = scene.valid if moved is None else moved & scene.valid

    windows = object_windows(coarse, scene, fresh, config.window, block=8)
    collides = None if exists is None else _collisions(tables, scene, exists, fresh)
    if previous is None or moved is None:
        return ObjectViews(windows, collides)
    if collides is not None and previous.collides is not None:
        collides = jnp.where(moved[None, None], collides, previous.collides)
    return ObjectViews(
        windows=jax.tree.map(
            lambda a, b: jnp.where(moved.reshape(-1, *[1] * (a.ndim - 1)), a, b), windows, previous.windows
        ),
        collides=collides,
    )


def object_windows(
    camera: Camera, scene: Superquadrics, mask: Bool[Array, " n"], window: tuple[int, int], block: int
) -> render.Window:
    """The images of the masked objects; the others' show nothing.

    Args:
      camera: the camera at the windows' resolution.
      scene: the objects, fields (N, ...).
      mask: which of them are rendered.
      window: rows and columns; static.
      block: number rendered at once on a CPU; static.
    """
    if scene.parts is not None:
        return _windows_of_parts(camera, scene, mask, window, block)

    def view(camera, _, body):
        return render.object_window(camera, body, window)

    return _without_unseen(masked_vmap(view, mask, camera, None, scene, block=block), mask)


def _windows_of_parts(
    camera: Camera, scene: Superquadrics, mask: Bool[Array, " n"], window: tuple[int, int], block: int
) -> render.Window:
    """`object_windows` of bodies with parts: absent parts cost nothing, and a depth is the least of the parts."""

    def view(camera, _, row):
        body, part = row
        return render.object_window(camera, body, window, part)

    parts = world_parts(scene)
    owners = jax.tree.map(lambda a: jnp.repeat(a, parts.capacity // scene.capacity, axis=0), scene.replace(parts=None))
    drawn = per_part(scene, mask) & parts.valid
    windows = _without_unseen(masked_vmap(view, drawn, camera, None, (owners, parts), block=block), drawn)
    windows = jax.tree.map(lambda a: a.reshape(scene.capacity, -1, *a.shape[1:]), windows)
    # All parts of a body have the same window, but where they are absent.
    first = jnp.argmax(drawn.reshape(scene.capacity, -1), axis=1)
    one = jax.tree.map(lambda a: a[jnp.arange(scene.capacity), first], windows)
    return one.replace(depth=jnp.min(windows.depth, axis=1))


def _without_unseen(windows: render.Window, mask: Bool[Array, " n"]) -> render.Window:
    """The windows; those outside of the mask show nothing."""
    return windows.replace(
        depth=jnp.where(mask[:, None, None], windows.depth, jnp.inf), stride=jnp.maximum(windows.stride, 1)
    )


def _collisions(tables: ExistenceTables, scene: Superquadrics, exists: Array, fresh: Array) -> Bool[Array, "x s n"]:
    """Whether the target at each place of the poses where `exists` would collide with each fresh object."""
    places, spread = tables.T_world_target.shape[:2]
    n = scene.capacity

    T = tables.T_world_target.reshape(-1, 4, 4)
    mask = jnp.repeat(exists, spread)[:, None] & fresh[None]
    hits = collisions(clouds_of(tables.cloud[None]), np.zeros(len(T), np.int32), T, scene, mask)
    return hits.reshape(places, spread, n)


def occluders(tables: ExistenceTables, views: ObjectViews) -> Bool[Array, "x n"]:
    """Which objects hide a target at each candidate pose, judged by the pixel in the middle of its image.

    An approximation to weight the objects; `existence` decides on visibility.
    """
    windows = views.windows
    pixel = (tables.middle[:, None] - windows.corner[None]) // windows.stride[None, :, None]
    size = jnp.array(windows.depth.shape[-2:])
    inside = jnp.all((pixel >= 0) & (pixel < size[None, None]), axis=-1)
    row, column = jnp.moveaxis(jnp.clip(pixel, 0, size[None, None] - 1), -1, 0)
    depth = windows.depth[jnp.arange(windows.depth.shape[0])[None], row, column]
    return inside & (depth < tables.nearest[:, None])


def existence(
    tables: ExistenceTables,
    camera: Camera,
    views: ObjectViews,
    exists: Bool[Array, " x"],
    allowed: Int[Array, "x s"],
    config: ExistenceConfig,
    measured: Float[Array, "h w"] | None = None,
) -> Bool[Array, " x"]:
    """`f_t` from `f_{t-1}` and the views of the objects (equation 4 with c = 0): it can only shrink.

    Args:
      tables: constants of the problem.
      camera: the camera at full resolution.
      views: views of all objects, with collisions at every pose where `exists` if collisions count.
      exists: `f_{t-1}`; all True at the start.
      allowed: how many coarse pixels a hidden target may show, see `allowances`.
      config: static.
      measured: share of each pixel of the coarse image that was measured; None if everything was. What was not measured
        shows nothing, and so rules nothing out.

    Returns:
      Where the target can be.
    """
    return exists & jnp.any(
        undetected(tables, camera, views, exists, allowed, config, measured) & free(views, exists), axis=-1
    )


def undetected(
    tables: ExistenceTables,
    camera: Camera,
    views: ObjectViews,
    exists: Bool[Array, " x"],
    allowed: Int[Array, "x s"],
    config: ExistenceConfig,
    measured: Float[Array, "h w"] | None = None,
) -> Bool[Array, "x s"]:
    """At which places of the poses where `exists` the target would not be detected; arguments as of `existence`."""
    coarse = camera.scaled(config.step(camera))
    image = veiled(render.merge_windows(coarse, views.windows), measured)
    if config.as_in_paper:
        return _alike(tables, coarse, image, exists, config)
    return shown_pixels(tables, coarse, image, exists) <= allowed


def free(views: ObjectViews, exists: Bool[Array, " x"]) -> Bool[Array, "x #s"]:
    """At which places the target meets no object: at all of them if collisions do not count."""
    if views.collides is None:
        return jnp.ones((exists.shape[0], 1), bool)
    return ~jnp.any(views.collides, axis=-1)


def _at_places(
    tables: ExistenceTables,
    coarse: Camera,
    image: Float[Array, "h w"],
    exists: Bool[Array, " x"],
    measure: Callable[[Array, Array, Array], Array],
) -> Shaped[Array, "x s"]:
    """A measure of the target's window at each place of the poses where `exists`; 0 elsewhere.

    Args:
      tables: constants of the problem.
      coarse: the camera at the coarse resolution; only its size is used.
      image: its depth image of the objects.
      exists: poses to measure.
      measure: function of the target's depth, the depth behind it, and which pixels are in the image; closes over no
        array.
    """

    def at_places(_, image, row):
        def at(depth, corner):
            return measure(depth, *in_window(coarse, image, corner, depth.shape))

        return jax.vmap(at)(*row)

    # Without blocks, this would take most of a plan's memory.
    return masked_vmap(at_places, exists, None, image, (tables.depth, tables.corner), block=512)


def in_window(camera: Camera, image: Any, corner: Array, window: tuple[int, int]) -> tuple[Array, Array]:
    """A camera's image in a window, and which of the window's pixels are in the image."""
    height, width = camera.height, camera.width
    rows = corner[0] + jnp.arange(window[0])[:, None]
    columns = corner[1] + jnp.arange(window[1])[None]
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    return image[jnp.clip(rows, 0, height - 1), jnp.clip(columns, 0, width - 1)], inside


def shown_pixels(
    tables: ExistenceTables,
    coarse: Camera,
    image: Float[Array, "h w"],
    exists: Bool[Array, " x"],
) -> Int[Array, "x s"]:
    """How many coarse pixels the target would show at each place of the poses where `exists`; 0 elsewhere."""

    def shown(depth, behind, inside):
        return jnp.sum(inside & (depth < behind))

    return _at_places(tables, coarse, image, exists, shown)


def measured_of_target(
    tables: ExistenceTables, coarse: Camera, measured: Float[Array, "h w"], exists: Bool[Array, " x"]
) -> Float[Array, "x s"]:
    """The share of its measured pixels' area that was measured of the target at each place of the poses where `exists`.

    Pixels that were hardly measured are left out; 1 if no other is left.
    """

    def share(depth, behind, inside):
        counts = inside & jnp.isfinite(depth) & ~unmeasured(behind)
        total = jnp.sum(counts)
        return jnp.where(total > 0, jnp.sum(jnp.where(counts, behind, 0.0)) / jnp.maximum(total, 1), 1.0)

    at_places = _at_places(tables, coarse, measured, exists, share)
    return jnp.where(exists[:, None], at_places, 1.0)


def _alike(
    tables: ExistenceTables,
    coarse: Camera,
    image: Float[Array, "h w"],
    exists: Bool[Array, " x"],
    config: ExistenceConfig,
) -> Bool[Array, "x s"]:
    """Whether the depth image hardly changes with the target at each place of the poses where `exists`."""

    def alike(depth, behind, inside):
        difference = jnp.where(inside, jnp.maximum(jnp.minimum(behind, FAR) - depth, 0.0), 0.0)
        square = jnp.sum(jnp.where(jnp.isfinite(depth), difference, 0.0) ** 2)
        return square / (coarse.height * coarse.width) < config.depth_threshold

    return _at_places(tables, coarse, image, exists, alike)


def allowances(
    tables: ExistenceTables,
    camera: Camera,
    target: Target,
    views: ObjectViews,
    closer: Float[Array, "h w"],
    config: ExistenceConfig,
    measured: Float[Array, "a b"] | None = None,
) -> Int[Array, "x s"]:
    """How many coarse pixels a hidden target may show at each place.

    By default the detector's threshold; more if no place of a pose shows so few pixels, but a closer look at the
    present scene shows that the target is hidden; and more where only a part of its pixels would be measured, since the
    detector counts measured ones. Where two thirds of it would not be, what it shows right beside that does not count:
    next to a hole of the target's own shape, the places nearest to it show a strip.

    Args:
      tables: constants of the problem.
      camera: the camera at full resolution.
      target: static.
      views: of the objects that the camera sees.
      closer: image of `closer_image`.
      config: static.
      measured: as of `existence`.
    """
    coarse, everywhere = camera.scaled(config.step(camera)), jnp.ones(tables.corner.shape[0], bool)
    seen: Float[Array, "x s"] | float = 1.0
    bound = jnp.full(tables.corner.shape[:2], config.allowed(camera), jnp.int32)
    bodies = render.merge_windows(coarse, views.windows)
    shown = shown_pixels(tables, coarse, veiled(bodies, measured), everywhere)
    if measured is not None:
        seen = measured_of_target(tables, coarse, measured, everywhere)
        unseen = found_pixels(camera, config.found_pixels) / config.step(camera) ** 2
        whole, apart = (
            shown_pixels(tables, coarse, image, everywhere) for image in (bodies, veiled(bodies, beside(measured)))
        )
        strip = jnp.where(3 * shown <= whole, shown - apart, 0)
        bound = jnp.floor(unseen / seen).astype(jnp.int32) + strip
    if not config.looks_closer:
        return bound
    is_free = free(views, everywhere)
    settled = jnp.any(is_free & (shown <= bound), axis=1)
    doubtful = is_free & ~settled[:, None] & (shown > bound) & (shown <= DOUBTFUL)
    order = jnp.argsort(jnp.where(doubtful, shown, DOUBTFUL + 1), axis=1, stable=True)
    doubtful &= jnp.argsort(order, axis=1) < CLOSER_PLACES
    counted = _counted(tables, camera, target, closer, doubtful, config)
    hidden = doubtful & (counted * seen <= CLOSER_TOLERANCE * found_pixels(camera, config.found_pixels))
    return jnp.where(hidden, shown, bound)


def _counted(
    tables: ExistenceTables,
    camera: Camera,
    target: Target,
    closer: Float[Array, "h w"],
    doubtful: Bool[Array, "x s"],
    config: ExistenceConfig,
) -> Float[Array, "x s"]:
    """Pixels at full resolution that a target shows at doubtful places, by a closer look; 0 elsewhere."""

    def counted(shared, closer, T):
        tables, camera, target = shared
        return _pixels(tables, camera, target, closer, T, config)

    T, mask = tables.T_world_target.reshape(-1, 4, 4), doubtful.reshape(-1)
    return masked_vmap(counted, mask, (tables, camera, target), closer, T, block=64).reshape(doubtful.shape)


def closer_image(
    camera: Camera,
    scene: Superquadrics,
    views: ObjectViews,
    config: ExistenceConfig,
    measured: Float[Array, "a b"] | None = None,
) -> Float[Array, "h w"]:
    """The depth image of a closer look [m]; the coarse image if the configuration has no closer look.

    Args:
      camera: the camera at full resolution.
      scene: the objects that the camera sees, fields (N, ...).
      views: of them.
      config: static.
      measured: share of each pixel of the closer image that was measured; None if everything was.
    """
    scale, step = config.closer_step(camera), config.step(camera)
    closer, grown = camera.scaled(scale), step / scale
    if scale == step:
        return veiled(render.merge_windows(closer, views.windows), measured)
    window = math.ceil(config.window[0] * grown), math.ceil(config.window[1] * grown)
    windows = object_windows(closer, enlarged(scene, ROUNDED), scene.valid, window, block=1)
    return veiled(render.merge_windows(closer, windows), measured)


def _pixels(
    tables: ExistenceTables,
    camera: Camera,
    target: Target,
    closer: Any,
    T_world_target: Float[Array, "4 4"],
    config: ExistenceConfig,
    nearer: float = 1.0,
) -> Float[Array, ""]:
    """How many pixels at full resolution a target would show, counted in the image of a closer look.

    Args:
      tables: constants of the problem.
      camera: the camera at full resolution.
      target: static.
      closer: image of `closer_image`.
      T_world_target: pose of the target.
      config: static.
      nearer: size of its image relative to the largest image at a candidate pose, at most; static.
    """
    scale = config.closer_step(camera)
    grown = nearer * config.step(camera) / scale
    h, w = tables.depth.shape[-2:]
    window = math.ceil(h * grown), math.ceil(w * grown)
    target_image = window_image(camera.scaled(scale), target, T_world_target, window)
    behind, inside = in_window(camera.scaled(scale), closer, target_image.corner, window)
    return jnp.sum(inside & (target_image.depth < behind)) * float(scale**2)


def plainly_elsewhere(
    tables: ExistenceTables,
    camera: Camera,
    target: Target,
    scene: Superquadrics,
    closer: Float[Array, "h w"],
    T_world_target: Float[Array, "4 4"],
    config: ExistenceConfig,
) -> Bool[Array, ""]:
    """Whether a target that the detector does not see cannot be at a pose: it would be in plain sight there, or an
    object is there. False in doubt.

    Args:
      tables: constants of the problem.
      camera: the camera at full resolution.
      target: static.
      scene: the objects that the camera sees, fields (N, ...).
      closer: image of `closer_image`.
      T_world_target: the pose; need not be a candidate pose.
      config: static.
    """
    shows = _pixels(tables, camera, target, closer, T_world_target, config, NEARER)
    slim = world_parts(slimmed(scene, TOUCHING, 0.25))
    points = transform(T_world_target, tables.cloud.T)

    def reaches(size, exponents, position, rotation):
        local = transform(inverse(make(rotation, position)), points)
        return jnp.any(superquadric.gauge(size, exponents, local) < 1.0)

    inside = jax.vmap(reaches)(slim.size, slim.exponents, slim.position, slim.rotation) & slim.valid
    return (shows > PLAIN * found_pixels(camera, config.found_pixels)) | jnp.any(inside)
