"""Views of the objects for f: their images in windows, and their collisions with the target."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from mechsearch_jax.existence.config import ExistenceConfig
from mechsearch_jax.existence.tables import ExistenceTables
from mechsearch_jax.geometry.bodies import per_part, world_parts
from mechsearch_jax.geometry.collision import clouds_of, collisions
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace import render
from mechsearch_jax.workspace.camera import Camera


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
