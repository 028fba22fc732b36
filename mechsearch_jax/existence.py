"""The existence function f: where can the target still be? (paper section 4.2 and appendix B.2;
docs/method.md, "Existence")

A candidate pose stands for its whole grid cell, so the target is tried at several places of the cell. At each it must
be hidden (it would show no more pixels than the detector needs) and free of collision. f is 1 if any of the places
passes. Margins in depth and size for shapes that are not exactly known are options, and off by default.

An approximation: the places reach half way to the cell's edges. Measured on published scenes, that loses 2.6% of hidden
positions that are anywhere in a cell, and makes the possible set a third larger than one exact place a cell does;
places at the corners would lose 0.3% and make it 60% larger.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from mechsearch_jax.errors import InputError
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.collision import Pair, any_inside
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, inverse, make, transform, upright_pose
from mechsearch_jax.options import option
from mechsearch_jax.workspace import render
from mechsearch_jax.workspace.camera import Camera, project
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

FAR = 1.5


@dataclasses.dataclass(frozen=True)
class ExistenceConfig:
    """How f is decided.

    Attributes:
      criterion: what makes the target visible: "detector" counts the pixels it would show at full resolution;
        "depth-mse" is the paper's mean squared difference of the two depth images; "depth-norm" their Euclidean
        distance.
      found_pixels: more pixels than this at full resolution and the detector finds the target.
      depth_threshold: threshold of "depth-mse" [m^2] and "depth-norm" [m].
      downscale: how much coarser than the camera f is rendered.
      spread: where in a cell the target is tried, as fractions of half a cell along x and y; one place is its centre.
      erosion: by how much the target is drawn in for the collision test [m].
      depth_margin: by how much nearer than an object the target must be to count as visible [m].
      window: rows and columns of the window an object is rendered in, at the coarse resolution.
      points: points on the target's surface for the collision test.
    """

    criterion: Literal["detector", "depth-mse", "depth-norm"] = option(
        "detector",
        "what makes a target visible: its pixels, as the detector counts them, or the depth image, as in the paper",
        ("detector", "depth-mse", "depth-norm"),
    )
    found_pixels: int = 100
    depth_threshold: float = 0.001
    downscale: int = 7
    spread: tuple[tuple[float, float], ...] = ((0.0, 0.0), (-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5))
    erosion: float = 0.0
    depth_margin: float = 0.0
    window: tuple[int, int] = (48, 48)
    points: int = 512

    def __post_init__(self):
        if self.criterion not in ("detector", "depth-mse", "depth-norm"):
            raise InputError(f'criterion "{self.criterion}" is unknown; use "detector", "depth-mse" or "depth-norm"')
        if self.downscale < 1 or not self.spread:
            raise InputError("ExistenceConfig: downscale must be at least 1 and spread hold at least one place")


class ExistenceTables(flax.struct.PyTreeNode):
    """What f needs of the candidate poses, the camera and the target: constants of a `Problem`.

    Attributes:
      T_world_target: the places where the target is tried, shape (X, S, 4, 4).
      depth: the target's depth in a window at each place, infinite around it, shape (X, S, h, w) [m].
      corner: first row and column of that window in the coarse image, shape (X, S, 2).
      nearest: the least depth of the target at the first place, shape (X,) [m].
      cloud: surface of the drawn-in target in its own frame as rows of coordinates, shape (3, P) [m].
      radius: radius of a sphere that holds the target [m].
    """

    T_world_target: jax.Array
    depth: jax.Array
    corner: jax.Array
    nearest: jax.Array
    cloud: jax.Array
    radius: jax.Array


class ObjectViews(flax.struct.PyTreeNode):
    """Per object, what f needs of it; only what moved has to be computed anew.

    Attributes:
      depth: the object's depth in its window, shape (N, h, w) [m].
      corner: first row and column of the window, shape (N, 2).
      collides: whether the target at a place would run into the object, shape (X, S, N); None if that does not count.
      overflow: whether the object's image did not fit the window, shape (N,): f may then be too small.
    """

    depth: jax.Array
    corner: jax.Array
    collides: jax.Array | None
    overflow: jax.Array


def existence_tables(camera: Camera, shelf: Shelf, target: Target, config: ExistenceConfig) -> ExistenceTables:
    """Precompute, for every candidate pose, the target's own depth image and collision cloud."""
    poses = target.candidate_poses(shelf)
    cell = target.cell(shelf)
    offsets = np.array([(a * cell[0] / 2, b * cell[1] / 2) for a, b in config.spread], np.float32)
    places = np.repeat(poses[:, None, :], len(offsets), axis=1)
    places[..., :2] += offsets[None]
    T = jax.jit(upright_pose)(jnp.asarray(places), target.height(shelf))
    coarse = camera.scaled(config.downscale)
    half = np.array(target.half_size, np.float32)
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)), np.float32) * half

    def image_size(T):
        pixels, _ = project(coarse, transform(T[:, :, None], jnp.asarray(corners)))
        return jnp.max(jnp.max(pixels, axis=2) - jnp.min(pixels, axis=2), axis=(0, 1))

    extent = np.asarray(jax.jit(image_size)(T))
    window = (int(np.ceil(extent[0])) + 2, int(np.ceil(extent[1])) + 2)

    def view(pose):
        one = Superquadrics(
            size=jnp.asarray(half),
            exponents=jnp.array(target.exponents),
            position=pose[:3, 3],
            rotation=pose[:3, :3],
            valid=jnp.array(True),
        )
        return render.object_window(coarse, one, window)

    depth, corner = jax.jit(jax.vmap(jax.vmap(view)))(T)
    eroded = jnp.asarray(half - config.erosion)
    sample = jax.jit(superquadric.sample_surface, static_argnames="count")
    cloud = sample(eroded, jnp.array(target.exponents), count=config.points)
    nearest = jnp.min(depth[:, 0], axis=(-1, -2))
    return ExistenceTables(T, depth, corner, nearest, cloud.T, jnp.float32(np.linalg.norm(half)))


def no_views(capacity: int, config: ExistenceConfig, places: tuple[int, int] | None = None) -> ObjectViews:
    """Views of so many objects that are yet to be looked at.

    Args:
      capacity: how many.
      config: static.
      places: number of candidate poses, and of places at each, if collisions count; None if they do not.
    """
    return ObjectViews(
        depth=jnp.zeros((capacity, *config.window)),
        corner=jnp.zeros((capacity, 2), jnp.int32),
        collides=None if places is None else jnp.zeros((*places, capacity), bool),
        overflow=jnp.zeros(capacity, bool),
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
      camera: the camera at full resolution; static.
      scene: the objects, fields (N, ...).
      exists: poses that matter; collisions at the others are not computed and read False. None if collisions do not
        count at all.
      config: static.
      previous: views of the same objects before some of them moved.
      moved: which objects moved since; only they are computed anew.

    Returns:
      The views of all objects.
    """
    coarse = camera.scaled(config.downscale)
    fresh = scene.valid if moved is None else moved & scene.valid

    def view(_, scene, i):
        one = jax.tree.map(lambda a: a[i], scene)
        depth, corner = render.object_window(coarse, one, config.window)
        return depth, corner, jnp.any(render.window_corner(coarse, one, config.window)[1] > 0)

    depth, corner, overflow = masked_vmap(view, fresh, None, scene, block=8)
    depth = jnp.where(fresh[:, None, None], depth, jnp.inf)
    collides = None if exists is None else _collisions(tables, scene, exists, fresh)
    views = ObjectViews(depth, corner, collides, overflow)
    if previous is None or moved is None:
        return views
    if collides is not None and previous.collides is not None:
        collides = jnp.where(moved[None, None], collides, previous.collides)
    return ObjectViews(
        depth=jnp.where(moved[:, None, None], views.depth, previous.depth),
        corner=jnp.where(moved[:, None], views.corner, previous.corner),
        collides=collides,
        overflow=jnp.where(moved, views.overflow, previous.overflow),
    )


def _collisions(tables: ExistenceTables, scene: Superquadrics, exists: Array, fresh: Array) -> Bool[Array, "x s n"]:
    """Whether the target at each place of the poses that matter would run into the objects that are fresh."""
    places, spread = tables.T_world_target.shape[:2]
    n = scene.capacity

    def pair(tables, scene, i):
        place, k = i // n, i % n
        T = tables.T_world_target.reshape(-1, 4, 4)[place]
        T_object_world = inverse(make(scene.rotation[k], scene.position[k]))
        return Pair(tables.cloud, compose(T_object_world, T), scene.size[k], scene.exponents[k])

    offset = tables.T_world_target[:, :, None, :3, 3] - scene.position[None, None]
    reach = superquadric.bounding_radius(scene.size) + tables.radius
    near = jnp.sum(offset**2, axis=-1) < reach[None, None] ** 2
    mask = near & exists[:, None, None] & fresh[None, None]
    return any_inside(mask.reshape(-1), pair, tables, scene).reshape(places, spread, n)


def _depth_hidden(
    tables: ExistenceTables, image: Array, exists: Bool[Array, " x"], config: ExistenceConfig
) -> Bool[Array, "x s"]:
    """Whether a target at each place of the poses that matter would go unnoticed in a depth image."""
    h, w = tables.depth.shape[-2:]
    height, width = image.shape

    def hidden(tables, image, i):
        depth, corner = tables.depth[i], tables.corner[i]
        rows = corner[:, 0, None, None] + jnp.arange(h)[None, :, None]
        columns = corner[:, 1, None, None] + jnp.arange(w)[None, None, :]
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        behind = image[jnp.clip(rows, 0, height - 1), jnp.clip(columns, 0, width - 1)]
        if config.criterion == "detector":
            visible = inside & (depth + config.depth_margin < behind)
            return jnp.sum(visible, axis=(-1, -2)) * config.downscale**2 <= config.found_pixels
        difference = jnp.where(inside, jnp.maximum(jnp.minimum(behind, FAR) - depth, 0.0), 0.0)
        square = jnp.sum(jnp.where(jnp.isfinite(depth), difference, 0.0) ** 2, axis=(-1, -2))
        if config.criterion == "depth-mse":
            return square / (height * width) < config.depth_threshold
        return jnp.sqrt(square) < config.depth_threshold

    # All of them at once, for every state of a batch, would be most of a plan's memory.
    return masked_vmap(hidden, exists, tables, image, block=512)


def existence(
    tables: ExistenceTables, camera: Camera, views: ObjectViews, exists: Bool[Array, " x"], config: ExistenceConfig
) -> Bool[Array, " x"]:
    """`f_t` from `f_{t-1}` and the views of the objects (equation 4 with c = 0): it can only shrink.

    Args:
      tables: constants of the problem.
      camera: the camera at full resolution; static.
      views: of all objects, with the collisions of every pose where `exists` if they count.
      exists: `f_{t-1}`; all True at the start.
      config: static.

    Returns:
      Where the target can be.
    """
    image = render.merge_windows(camera.scaled(config.downscale), views.depth, views.corner)
    possible = _depth_hidden(tables, image, exists, config)
    if views.collides is not None:
        possible &= ~jnp.any(views.collides, axis=-1)
    return exists & jnp.any(possible, axis=-1)


def occluders(tables: ExistenceTables, views: ObjectViews) -> Bool[Array, "x n"]:
    """Which objects hide a target at every candidate pose, judged by the one pixel in the middle of its image.

    An approximation, for telling which objects matter; what is visible, `existence` says.
    """
    middle = tables.corner[:, 0] + jnp.array(tables.depth.shape[-2:])[None] // 2
    pixel = middle[:, None] - views.corner[None]
    size = jnp.array(views.depth.shape[-2:])
    inside = jnp.all((pixel >= 0) & (pixel < size[None, None]), axis=-1)
    row, column = jnp.moveaxis(jnp.clip(pixel, 0, size[None, None] - 1), -1, 0)
    depth = views.depth[jnp.arange(views.depth.shape[0])[None], row, column]
    return inside & (depth < tables.nearest[:, None])
