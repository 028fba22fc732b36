"""Which pixels are the target's: what its colour says, made whole by what lies around it and by its known shape.

A detector judges one pixel at a time. In a sensor's noise it misses pixels of the target, and what it misses would be
taken for an obstacle inside the target. So colours are evened out within surfaces before they are judged, neighbours
then vote, and what lies on the surface of the target as it is fitted to those pixels is the target's, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.images.cloud import draw
from mechsearch_jax.images.labels import INSTANCES, OTHER
from mechsearch_jax.images.target_pose import distance, target_pose
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Points of the target that its pose is fitted to.
TARGET_POINTS = 256
# Neighbours are the pixels of a square of so many ...
WINDOW = 5
# ... whose depth differs by no more than this [m], and, where colours are evened out, whose colour does not either: the
# length of the difference of red, green and blue; in noise of 8/255 a channel one in a thousand differs so much.
LIKE_DEPTH = 0.01
LIKE_COLOUR = 0.25
# What is so near to the surface of the fitted target is on it [m]: four standard deviations of a sensor of 1 mm.
SURFACE = 0.004


def _neighbours(image: Array, fill: float | bool) -> list[Array]:
    """An image of (h, w, ...) moved so that each pixel holds one of its neighbours, itself among them."""
    reach, (height, width) = WINDOW // 2, image.shape[:2]
    edges = [(reach, reach), (reach, reach), *[(0, 0)] * (image.ndim - 2)]
    padded = jnp.pad(image, edges, constant_values=fill)
    return [padded[i : i + height, j : j + width] for i in range(WINDOW) for j in range(WINDOW)]


def evened(colour: Float[Array, "h w 3"], depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """Each pixel's colour as the mean of its neighbours' of like depth and colour: less noise, and the same edges.

    Args:
      colour: red, green and blue in 0 to 1.
      depth: [m]; a pixel without a finite one keeps its colour.
    """
    total, count = jnp.zeros(colour.shape, colour.dtype), jnp.zeros(depth.shape, colour.dtype)
    for near, other in zip(_neighbours(depth, math.nan), _neighbours(colour, 0.0), strict=True):
        alike = jnp.sum((other - colour) ** 2, axis=-1) < LIKE_COLOUR**2
        counts = alike & (jnp.abs(near - depth) < LIKE_DEPTH)
        total, count = total + jnp.where(counts[..., None], other, 0.0), count + counts
    return jnp.where((count > 0)[..., None], total / jnp.maximum(count, 1.0)[..., None], colour)


def elected(chosen: Bool[Array, "h w"], depth: Float[Array, "h w"]) -> Bool[Array, "h w"]:
    """What most of a pixel's neighbours of like depth are; a tie, or a pixel without a finite depth, stays.

    Args:
      chosen: what each pixel is.
      depth: [m].
    """
    votes = jnp.zeros(depth.shape, jnp.int32)
    for near, other in zip(_neighbours(depth, math.nan), _neighbours(chosen, False), strict=True):
        votes = votes + jnp.where(jnp.abs(near - depth) < LIKE_DEPTH, jnp.where(other, 1, -1), 0)
    return (votes > 0) | (chosen & (votes == 0))


def coloured_pixels(
    detector: Callable[[Array], Array], colour: Float[Array, "h w 3"], depth: Float[Array, "h w"]
) -> Bool[Array, "h w"]:
    """Where a detector sees the target, whatever the noise of single pixels.

    Args:
      detector: which pixels of an image are the target's.
      colour: red, green and blue in 0 to 1.
      depth: [m]; NaN where nothing was measured.
    """
    return elected(detector(evened(colour, depth)), depth)


def fitted_pose(
    key: Key[Array, ""],
    target: Target,
    shelf: Shelf,
    camera: Camera,
    points: Float[Array, "h w 3"],
    of_target: Bool[Array, "h w"],
) -> tuple[Float[Array, " 3"], Bool[Array, ""]]:
    """The pose of the target whose pixels are known: x, y [m] and yaw [rad], and whether there are any pixels.

    Args:
      key: of the points that are drawn.
      target: static.
      shelf, camera: what it stands on, and what sees it.
      points: in the world [m].
      of_target: which are the target's; without any the pose means nothing, but is finite.
    """
    index, count = draw(key, of_target.reshape(-1), TARGET_POINTS)
    seen = jnp.broadcast_to(count > 0, TARGET_POINTS)
    pose = target_pose(target, shelf, jnp.array(camera.position), points.reshape(-1, 3)[index], seen)
    return pose, count > 0


def near_target(
    target: Target, shelf: Shelf, pose: Float[Array, " 3"], points: Float[Array, "*batch 3"]
) -> Bool[Array, "*batch"]:
    """Which points are on the surface of a target that stands at a pose; False for NaN, and for points deep inside it:
    where something is seen there, the target is not.

    Args:
      target: static.
      shelf: what it stands on.
      pose: x, y [m] and yaw [rad].
      points: in the world [m].
    """
    return (jnp.abs(distance(target, shelf, pose, points.reshape(-1, 3))) < SURFACE).reshape(points.shape[:-1])


def without_phantoms(
    labels: Int[Array, "h w"], on_it: Bool[Array, "h w"], of_target: Bool[Array, "h w"]
) -> Int[Array, "h w"]:
    """Labels in which a segment that lies mostly on the found target is OTHER: its points are the target's.

    Only a segment of which no more is seen than of the target: a narrow part of the target does not say where the rest
    of it is, and a pose that is fitted to one may reach into what stands beside it.

    Args:
      labels: as `images.labels` has them.
      on_it: which pixels are on the found target; none where it is not found.
      of_target: which are known to be its.
    """
    own = labels[..., None] == jnp.arange(INSTANCES, dtype=labels.dtype).reshape(1, 1, -1)
    shown, within = jnp.sum(own, axis=(0, 1)), jnp.sum(own & on_it[..., None], axis=(0, 1))
    is_phantom = (2 * within > shown) & (shown <= jnp.sum(of_target))
    phantom = jnp.any(own & is_phantom.reshape(1, 1, -1), axis=-1)
    return jnp.where(phantom, OTHER, labels).astype(labels.dtype)
