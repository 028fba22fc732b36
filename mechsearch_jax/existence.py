"""The existence function f: where can the target still be? (paper section 4.2 and appendix B.2;
docs/method.md, "Existence")

A candidate pose stands for its whole grid cell, so the target is tried at several places of the cell. At each it must
be hidden (it would show no more pixels than the detector needs) and free of collision. f is 1 if any of the places
passes. Shapes count as they are recognised, without margins.

Pixels are counted at a fraction of the camera's resolution, where a sliver beside an object may count for several times
its size. Where few pixels show, what is really seen is therefore counted again, more finely (`allowances`), and a place
at which the target is hidden after all may go on showing as many coarse pixels: predicted states are judged by the
coarse image alone.

A pose whose cell holds any hidden place has to stay possible, or the target is lost. In generated scenes f is 1.13
times as large as that least set (40 scenes, 25 places a cell at full resolution, `mechsearch bench scenes --exact`),
which is itself 1.63 times what the cells' middles alone make.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any, Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.collision import clouds_of, collisions
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import inverse, make, transform, upright_pose
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.options import option
from mechsearch_jax.workspace import render
from mechsearch_jax.workspace.camera import Camera, project
from mechsearch_jax.workspace.detector import FOUND_PIXELS, found_pixels, longer
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

FAR = 1.5
# The most coarse pixels that a target may show for a closer look to be worth it; no target that the detector misses was
# seen to show more than 12.
DOUBTFUL = 16
# Of a pose's places those that show least are looked at again, this many.
CLOSER_PLACES = 3
# A count at a third of the camera's resolution may be off by as much.
CLOSER_TOLERANCE = 1.5
# A target shows so many times what the detector needs where it cannot be missed: neither for a sensor that measures a
# third of its pixels only, nor behind an object that is recognised 5 mm too narrow along one side of it.
PLAIN = 3.0
# An object that is recognised a little elsewhere, or touches the target, reaches no deeper into it than this [m].
TOUCHING = 0.01
# Of a found target's image and the largest one of a candidate.
NEARER = 1.25
# The edges of superquadrics that stand for boxes and cylinders are rounded: what they hide is that of a larger one [m].
ROUNDED = 1e-3


@dataclasses.dataclass(frozen=True)
class ExistenceConfig:
    """How f is decided.

    Attributes:
      criterion: what makes the target visible: "detector" counts the pixels it would show at full resolution;
        "depth-mse" is the paper's mean squared difference of the two depth images.
      found_pixels: more pixels than this of an image of 1280 x 720 and the detector finds the target; of others the
        same share, see `workspace.detector`.
      depth_threshold: threshold of "depth-mse" [m^2].
      downscale: how much coarser than an image of 1280 x 720 f is rendered; with an image of another size by as much
        more or less as keeps what it shows as large, to whole numbers.
      cell_reach: a target is tried at the middle of its grid cell and this far on the way to each of the cell's corners
        in x and y; at the corners themselves (1) it is also turned by half a step in yaw, to either side in turn, and
        those of the outermost cells lie at the walls.
      closer_look: how much coarser than an image of 1280 x 720, likewise, doubtful places are looked at again; 0 for
        not at all.
      erosion: by how much the target is drawn in for the collision test [m]. One that was pushed touches what pushed
        it, often on several sides, and hardly any of its cell's places fits in between.
      reopen: whether f is opened again around what an action may have moved unseen; see `belief.unseen_motion`.
      window: rows and columns of the window an object is rendered in, at the coarse resolution.
      points: points on the target's surface for the collision test.
    """

    criterion: Literal["detector", "depth-mse"] = option(
        "detector",
        "what makes a target visible: its pixels, as the detector counts them, or the depth image, as in the paper",
        ("detector", "depth-mse"),
    )
    found_pixels: int = FOUND_PIXELS
    depth_threshold: float = 0.001
    downscale: int = 7
    cell_reach: tuple[float, ...] = option(
        (1.0,), "how far from the middle of its grid cell to the corners a target is tried; none for the middle alone"
    )
    closer_look: int = option(
        3, "where few of the target's pixels show, they are counted again in an image this much coarser; 0 for never"
    )
    erosion: float = option(
        0.001, "how deep a target that may be somewhere may reach into an object, on all sides [m]; the paper's is 0"
    )
    reopen: bool = option(
        True, "whether f is opened again around what an action may have moved unseen; not in the paper"
    )
    window: tuple[int, int] = (48, 48)
    points: int = 512

    def __post_init__(self):
        if self.criterion not in ("detector", "depth-mse"):
            raise InputError(f'criterion "{self.criterion}" is unknown; use "detector" or "depth-mse"')
        if not all(0.0 < share <= 1.0 for share in self.cell_reach):
            raise InputError(f"cell_reach {self.cell_reach} must be shares above 0 and at most 1")
        if not 0.0 <= self.erosion < math.inf:
            raise InputError(f"erosion {self.erosion} m must be a number that is not negative")
        if self.downscale < 1:
            raise InputError(f"ExistenceConfig: downscale {self.downscale} must be at least 1")
        if not 0 <= self.closer_look < max(self.downscale, 2):
            raise InputError(f"closer_look {self.closer_look} must be 0 or more and below downscale {self.downscale}")

    @property
    def places(self) -> np.ndarray:
        """Where in a cell the target is tried: x, y and yaw as shares of half the cell, shape (S, 3)."""
        corners = [(a, b, a * b * (share == 1.0)) for share in self.cell_reach for a, b in _corners(share)]
        return np.array([(0.0, 0.0, 0.0), *corners], np.float32)

    def step(self, camera: Camera) -> int:
        """How many rows and columns of a camera's image a coarse pixel stands for."""
        return max(round(self.downscale * longer(camera)), 1)

    def closer_step(self, camera: Camera) -> int:
        """The same of a pixel of what is looked at most closely: the coarse image where there is no closer look."""
        if self.criterion != "detector" or not self.closer_look:
            return self.step(camera)
        return max(round(self.closer_look * longer(camera)), 1)

    def allowed(self, camera: Camera) -> int:
        """How many coarse pixels of a camera's image a target may show that the detector does not find."""
        return int(found_pixels(camera, self.found_pixels) // self.step(camera) ** 2)


def _corners(share: float) -> list[tuple[float, float]]:
    return [(x, y) for x in (-share, share) for y in (-share, share)]


class ExistenceTables(flax.struct.PyTreeNode):
    """What f needs of the candidate poses, the camera and the target: constants of a `Problem`.

    Attributes:
      T_world_target: the places where the target is tried, shape (X, S, 4, 4).
      depth: the target's depth in a window at each place, infinite around it, shape (X, S, h, w) [m].
      corner: first row and column of that window in the coarse image, shape (X, S, 2).
      middle: row and column of the pixel in the middle of the target's image at the first place, shape (X, 2).
      nearest: the least depth of the target at the first place, shape (X,) [m].
      cloud: surface of the drawn-in target in its own frame as rows of coordinates, shape (3, P) [m].
      radius: radius of a sphere that holds the target [m].
    """

    T_world_target: jax.Array
    depth: jax.Array
    corner: jax.Array
    middle: jax.Array
    nearest: jax.Array
    cloud: jax.Array
    radius: jax.Array


class ObjectViews(flax.struct.PyTreeNode):
    """Per object, what f needs of it; only what moved has to be computed anew.

    Attributes:
      windows: the objects' images, with a leading axis N.
      collides: whether the target at a place would run into the object, shape (X, S, N); None if that does not count.
    """

    windows: render.Window
    collides: jax.Array | None


def existence_tables(camera: Camera, shelf: Shelf, target: Target, config: ExistenceConfig) -> ExistenceTables:
    """Precompute, for every candidate pose, the target's own depth image and collision cloud."""
    places = target.places(shelf, config.places)
    T = jax.jit(upright_pose)(np.asarray(places, np.float32), target.height(shelf))
    coarse = camera.scaled(config.step(camera))
    half = np.array(target.half_size, np.float32)
    window, around = target_window(coarse, half, T)

    def view(coarse, pose):
        one = Superquadrics(
            size=jnp.asarray(half),
            exponents=jnp.array(target.exponents),
            position=pose[:3, 3],
            rotation=pose[:3, :3],
            valid=jnp.array(True),
        )
        return render.object_window(coarse, one, window), render.window_place(coarse, one, around)[0]

    each = jax.vmap(jax.vmap(view, in_axes=(None, 0)), in_axes=(None, 0))
    views, first = jax.jit(each)(coarse, T)
    depth, corner, first = jax.device_get((views.depth, views.corner, first))
    middle = first[:, 0] + np.array(around, np.int32)[None] // 2
    sample = jax.jit(superquadric.sample_surface, static_argnames="count")
    cloud = np.asarray(
        sample(half - np.float32(config.erosion), np.array(target.exponents, np.float32), count=config.points)
    )
    nearest = depth[:, 0].min(axis=(-1, -2))
    radius = np.float32(np.linalg.norm(half))
    return ExistenceTables(*jax.device_put((T, depth, corner, middle, nearest, cloud.T, radius)))


def _window_side(extent: float) -> int:
    """How many rows or columns of pixels hold an image that is so many pixels long, wherever it begins: an even number.

    A camera that was calibrated again sees the target a little larger or smaller. Were this the least number, such a
    camera would now and then change a shape, and all that is compiled for it.
    """
    # What is measured in single precision may be measured as a little more elsewhere.
    return 2 * math.ceil((math.ceil(extent + 1e-3) + 1) / 2)


def target_window(
    coarse: Camera, half: Float[np.ndarray, "3"], T_world_target: Float[Array, "*batch 4 4"]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Rows and columns of a window that holds what a camera sees of a target at each of some poses, and of the least
    such window, whose middle does not depend on how the other's sides are rounded.

    Hardly larger than the image with one pixel around it, wherever the camera is.

    Args:
      coarse, half, T_world_target: as of `target_extent`.
    """
    rows, columns = target_extent(coarse, half, T_world_target)
    return (_window_side(rows), _window_side(columns)), (math.ceil(rows) + 2, math.ceil(columns) + 2)


def target_extent(
    coarse: Camera, half: Float[np.ndarray, "3"], T_world_target: Float[Array, "*batch 4 4"]
) -> tuple[float, float]:
    """Rows and columns that the largest image of a target at some poses takes, at most those of the camera's image.

    Args:
      coarse: the camera at the resolution that is meant.
      half: half-extents of the target [m].
      T_world_target: the poses.
    """
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)), np.float32) * half
    pixels = np.asarray(_seen_at(coarse, T_world_target, corners), float)
    # As far as `render.window_place` follows what is outside of the image.
    limit = np.array([coarse.height, coarse.width])
    low, high = (np.clip(bound, -1, limit) for bound in (pixels.min(axis=-2), pixels.max(axis=-2)))
    rows, columns = np.minimum((high - low).reshape(-1, 2).max(axis=0), limit)
    return float(rows), float(columns)


@jax.jit
def _seen_at(camera: Camera, T: Float[Array, "*batch 4 4"], points: Float[Array, "k 3"]) -> Float[Array, "*batch k 2"]:
    """Where a camera sees points of bodies that stand at these poses."""
    return project(camera, transform(T[..., None, :, :], points))[0]


def no_views(capacity: int, config: ExistenceConfig, places: tuple[int, int] | None = None) -> ObjectViews:
    """Views of so many objects that are yet to be looked at: they hide nothing, as empty slots never do.

    Args:
      capacity: how many.
      config: static.
      places: number of candidate poses, and of places at each, if collisions count; None if they do not.
    """
    return ObjectViews(
        windows=render.Window(
            depth=jnp.full((capacity, *config.window), jnp.inf),
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
      exists: poses that matter; collisions at the others are not computed and read False. None if collisions do not
        count at all.
      config: static.
      previous: views of the same objects before some of them moved.
      moved: which objects moved since; only they are computed anew.

    Returns:
      The views of all objects.
    """
    coarse = camera.scaled(config.step(camera))
    fresh = scene.valid if moved is None else moved & scene.valid

    def view(coarse, _, one):
        return render.object_window(coarse, one, config.window)

    windows = _seen(masked_vmap(view, fresh, coarse, None, scene, block=8), fresh)
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


def _seen(windows: render.Window, mask: Bool[Array, " n"]) -> render.Window:
    """Windows of which those outside of the mask, that stand for nothing, show nothing."""
    return windows.replace(
        depth=jnp.where(mask[:, None, None], windows.depth, jnp.inf), stride=jnp.maximum(windows.stride, 1)
    )


def _collisions(tables: ExistenceTables, scene: Superquadrics, exists: Array, fresh: Array) -> Bool[Array, "x s n"]:
    """Whether the target at each place of the poses that matter would run into the objects that are fresh."""
    places, spread = tables.T_world_target.shape[:2]
    n = scene.capacity

    T = tables.T_world_target.reshape(-1, 4, 4)
    wanted = jnp.repeat(exists, spread)[:, None] & fresh[None]
    hits = collisions(clouds_of(tables.cloud[None]), np.zeros(len(T), np.int32), T, scene, wanted)
    return hits.reshape(places, spread, n)


def _in_window(camera: Camera, image: Any, corner: Array, window: tuple[int, int]) -> tuple[Array, Array]:
    """What a camera's image shows in a window, and which of the window's pixels are in the image."""
    height, width = camera.height, camera.width
    rows = corner[0] + jnp.arange(window[0])[:, None]
    columns = corner[1] + jnp.arange(window[1])[None]
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    return image[jnp.clip(rows, 0, height - 1), jnp.clip(columns, 0, width - 1)], inside


def _at_places(
    tables: ExistenceTables,
    coarse: Camera,
    image: Float[Array, "h w"],
    exists: Bool[Array, " x"],
    measure: Callable[[Array, Array, Array], Array],
) -> Shaped[Array, "x s"]:
    """What a function tells of a target's window at each place of the poses that matter; 0 at the others.

    Args:
      tables: constants of the problem.
      coarse: the camera at the coarse resolution, whose size alone counts.
      image: its depth image of the objects.
      exists: the poses that matter.
      measure: of the target's depth, the depth behind it, and which pixels are in the image; closes over no array.
    """

    def at_places(_, image, row):
        def at(depth, corner):
            return measure(depth, *_in_window(coarse, image, corner, depth.shape))

        return jax.vmap(at)(*row)

    # All of them at once, for every state of a batch, would be most of a plan's memory.
    return masked_vmap(at_places, exists, None, image, (tables.depth, tables.corner), block=512)


def _shown(
    tables: ExistenceTables,
    coarse: Camera,
    image: Float[Array, "h w"],
    exists: Bool[Array, " x"],
) -> Int[Array, "x s"]:
    """How many coarse pixels the target would show at each place of the poses that matter; 0 at the others."""

    def shown(depth, behind, inside):
        return jnp.sum(inside & (depth < behind))

    return _at_places(tables, coarse, image, exists, shown)


def _alike(
    tables: ExistenceTables,
    coarse: Camera,
    image: Float[Array, "h w"],
    exists: Bool[Array, " x"],
    config: ExistenceConfig,
) -> Bool[Array, "x s"]:
    """Whether the depth image with the target at each place of the poses that matter is like the one without."""

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
) -> Int[Array, "x s"]:
    """How many coarse pixels a target that the detector does not find may show at each place.

    As many as the detector's threshold makes; more where no place of a pose shows as few, but a closer look at what the
    camera sees now says that the target is hidden.

    Args:
      tables: constants of the problem.
      camera: the camera at full resolution.
      target: static.
      views: of the objects that the camera sees.
      closer: of `closer_image`.
      config: static.
    """
    least = config.allowed(camera)
    bound = jnp.full(tables.corner.shape[:2], least, jnp.int32)
    if config.criterion != "detector" or not config.closer_look:
        return bound
    everywhere = jnp.ones(tables.corner.shape[0], bool)
    coarse = camera.scaled(config.step(camera))
    image = render.merge_windows(coarse, views.windows)
    shown = _shown(tables, coarse, image, everywhere)
    free = jnp.ones(shown.shape, bool) if views.collides is None else ~jnp.any(views.collides, axis=-1)
    settled = jnp.any(free & (shown <= least), axis=1)
    doubtful = free & ~settled[:, None] & (shown > least) & (shown <= DOUBTFUL)
    order = jnp.argsort(jnp.where(doubtful, shown, DOUBTFUL + 1), axis=1, stable=True)
    doubtful &= jnp.argsort(order, axis=1) < CLOSER_PLACES
    counted = _counted(tables, camera, target, closer, doubtful, config)
    hidden = doubtful & (counted <= CLOSER_TOLERANCE * found_pixels(camera, config.found_pixels))
    return jnp.where(hidden, shown, bound)


def _counted(
    tables: ExistenceTables,
    camera: Camera,
    target: Target,
    closer: Float[Array, "h w"],
    doubtful: Bool[Array, "x s"],
    config: ExistenceConfig,
) -> Float[Array, "x s"]:
    """Pixels of the full resolution that a target shows at doubtful places, by a closer look; 0 at the others."""

    def counted(shared, closer, T):
        tables, camera = shared
        return _pixels(tables, camera, target, closer, T, config)

    T, mask = tables.T_world_target.reshape(-1, 4, 4), doubtful.reshape(-1)
    return masked_vmap(counted, mask, (tables, camera), closer, T, block=64).reshape(doubtful.shape)


def closer_image(
    camera: Camera, scene: Superquadrics, views: ObjectViews, config: ExistenceConfig
) -> Float[Array, "h w"]:
    """The depth image of a closer look [m]; the coarse one where the configuration has none.

    Args:
      camera: the camera at full resolution.
      scene: the objects that the camera sees, fields (N, ...).
      views: of them.
      config: static.
    """
    scale, step = config.closer_step(camera), config.step(camera)
    closer, grown = camera.scaled(scale), step / scale
    if scale == step:
        return render.merge_windows(closer, views.windows)
    window = math.ceil(config.window[0] * grown), math.ceil(config.window[1] * grown)
    scene = scene.replace(size=scene.size + ROUNDED)

    def view(closer, _, one):
        return render.object_window(closer, one, window)

    windows = _seen(masked_vmap(view, scene.valid, closer, None, scene, block=1), scene.valid)
    return render.merge_windows(closer, windows)


def _pixels(
    tables: ExistenceTables,
    camera: Camera,
    target: Target,
    closer: Any,
    T_world_target: Float[Array, "4 4"],
    config: ExistenceConfig,
    nearer: float = 1.0,
) -> Float[Array, ""]:
    """How many pixels of the full resolution a target would show, counted in the image of a closer look.

    Args:
      tables: constants of the problem.
      camera: the camera at full resolution.
      target: static.
      closer: of `closer_image`.
      T_world_target: where the target would stand.
      config: static.
      nearer: how many times as large as the largest candidate its image may be; static.
    """
    scale = config.closer_step(camera)
    grown = nearer * config.step(camera) / scale
    h, w = tables.depth.shape[-2:]
    window = math.ceil(h * grown), math.ceil(w * grown)
    one = Superquadrics(
        size=jnp.float32(target.half_size),
        exponents=jnp.array(target.exponents, np.float32),
        position=T_world_target[:3, 3],
        rotation=T_world_target[:3, :3],
        valid=jnp.array(True),
    )
    target_image = render.object_window(camera.scaled(scale), one, window)
    behind, inside = _in_window(camera.scaled(scale), closer, target_image.corner, window)
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
    object stands there. In doubt it can.

    Args:
      tables: constants of the problem.
      camera: the camera at full resolution.
      target: static.
      scene: the objects that the camera sees, fields (N, ...).
      closer: of `closer_image`.
      T_world_target: the pose, which need not be a candidate.
      config: static.
    """
    shows = _pixels(tables, camera, target, closer, T_world_target, config, NEARER)
    slim = jnp.maximum(scene.size - TOUCHING, 0.25 * scene.size)
    points = transform(T_world_target, tables.cloud.T)

    def reaches(size, exponents, position, rotation):
        local = transform(inverse(make(rotation, position)), points)
        return jnp.any(superquadric.gauge(size, exponents, local) < 1.0)

    inside = jax.vmap(reaches)(slim, scene.exponents, scene.position, scene.rotation) & scene.valid
    return (shows > PLAIN * found_pixels(camera, config.found_pixels)) | jnp.any(inside)


def existence(
    tables: ExistenceTables,
    camera: Camera,
    views: ObjectViews,
    exists: Bool[Array, " x"],
    allowed: Int[Array, "x s"],
    config: ExistenceConfig,
) -> Bool[Array, " x"]:
    """`f_t` from `f_{t-1}` and the views of the objects (equation 4 with c = 0): it can only shrink.

    Args:
      tables: constants of the problem.
      camera: the camera at full resolution.
      views: of all objects, with the collisions of every pose where `exists` if they count.
      exists: `f_{t-1}`; all True at the start.
      allowed: how many coarse pixels a hidden target may show, see `allowances`.
      config: static.

    Returns:
      Where the target can be.
    """
    coarse = camera.scaled(config.step(camera))
    image = render.merge_windows(coarse, views.windows)
    if config.criterion == "detector":
        possible = _shown(tables, coarse, image, exists) <= allowed
    else:
        possible = _alike(tables, coarse, image, exists, config)
    if views.collides is not None:
        possible &= ~jnp.any(views.collides, axis=-1)
    return exists & jnp.any(possible, axis=-1)


def occluders(tables: ExistenceTables, views: ObjectViews) -> Bool[Array, "x n"]:
    """Which objects hide a target at every candidate pose, judged by the one pixel in the middle of its image.

    An approximation, for telling which objects matter; what is visible, `existence` says.
    """
    windows = views.windows
    pixel = (tables.middle[:, None] - windows.corner[None]) // windows.stride[None, :, None]
    size = jnp.array(windows.depth.shape[-2:])
    inside = jnp.all((pixel >= 0) & (pixel < size[None, None]), axis=-1)
    row, column = jnp.moveaxis(jnp.clip(pixel, 0, size[None, None] - 1), -1, 0)
    depth = windows.depth[jnp.arange(windows.depth.shape[0])[None], row, column]
    return inside & (depth < tables.nearest[:, None])
