"""A closer look in a finer image, at places where the coarse image leaves visibility of the target in doubt."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.existence.config import ExistenceConfig
from mechsearch_jax.existence.function import free, in_window, measured_of_target, shown_pixels
from mechsearch_jax.existence.tables import ExistenceTables
from mechsearch_jax.existence.views import ObjectViews, object_windows
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.bodies import enlarged, slimmed, world_parts
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import inverse, make, transform
from mechsearch_jax.images.measured import beside, veiled
from mechsearch_jax.workspace import render
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.detector import found_pixels
from mechsearch_jax.workspace.target import Target
from mechsearch_jax.workspace.target_view import window_image

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
    detector counts measured ones. Where most of it would not be, what it shows right beside that does not count: next
    to a hole of the target's own shape, the places nearest to it show a strip.

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
        strip = jnp.where(2 * shown <= whole, shown - apart, 0)
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
