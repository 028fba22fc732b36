"""The existence function f: where a target would be hidden and free of collision."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from mechsearch_jax.existence.config import ExistenceConfig
from mechsearch_jax.existence.tables import ExistenceTables
from mechsearch_jax.existence.views import ObjectViews
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.images.measured import unmeasured, veiled
from mechsearch_jax.workspace import render
from mechsearch_jax.workspace.camera import Camera

# Depth of the background where depth images are compared [m].
FAR = 1.5


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

    Pixels that were mostly not measured are left out; 1 if no other is left.
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
