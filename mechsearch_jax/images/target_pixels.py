"""The target's pixels: by colour, completed by their neighbours and by the target's known shape.

A detector judges single pixels. In a sensor's noise it misses pixels of the target, which would be taken for an
obstacle inside the target. So colours are averaged within surfaces before detection, neighbours then vote, and pixels
on the surface of the fitted target are the target's, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.images.cloud import draw
from mechsearch_jax.images.labels import INSTANCES, OTHER
from mechsearch_jax.images.target_evidence import Sample, depth_tolerance, evidence, upright
from mechsearch_jax.images.target_pose import distance, target_poses
from mechsearch_jax.workspace.camera import Camera, rays
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Number of points for fitting the target's pose.
TARGET_POINTS = 256
# Where its fits begin, see `target_poses`, and the number of pixels near it by which they are compared.
SIDES, BESIDE = (0.0, -0.5, 0.5, -1.0, 1.0), 1024
# Fits whose evidence differs by less than this share of the best one's are compared by the distances of points alone.
EQUAL = 0.03
# Neighbours are pixels within a square of this width whose depth differs by at most `LIKE_DEPTH` [m] and, where colours
# are averaged, whose colour differs by at most `LIKE_COLOUR`, as the length of the difference of red, green and blue:
# with noise of 8/255 in each channel, one in a thousand differs more.
WINDOW = 5
LIKE_DEPTH = 0.01
LIKE_COLOUR = 0.25
# Points within this distance of the fitted target's surface are on it [m]: four standard deviations of 1 mm noise.
SURFACE = 0.004


def _neighbours(image: Array, fill: float | bool) -> list[Array]:
    """Shifted copies of an image (h, w, ...), in which each pixel holds one of its neighbours or itself."""
    reach, (height, width) = WINDOW // 2, image.shape[:2]
    edges = [(reach, reach), (reach, reach), *[(0, 0)] * (image.ndim - 2)]
    padded = jnp.pad(image, edges, constant_values=fill)
    return [padded[i : i + height, j : j + width] for i in range(WINDOW) for j in range(WINDOW)]


def evened(colour: Float[Array, "h w 3"], depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """Mean colour of each pixel's neighbours of similar depth and colour: less noise, and the same edges.

    Args:
      colour: red, green and blue in 0 to 1.
      depth: [m]; a pixel without a finite depth keeps its colour.
    """
    total, count = jnp.zeros(colour.shape, colour.dtype), jnp.zeros(depth.shape, colour.dtype)
    for near, other in zip(_neighbours(depth, math.nan), _neighbours(colour, 0.0), strict=True):
        alike = jnp.sum((other - colour) ** 2, axis=-1) < LIKE_COLOUR**2
        counts = alike & (jnp.abs(near - depth) < LIKE_DEPTH)
        total, count = total + jnp.where(counts[..., None], other, 0.0), count + counts
    return jnp.where((count > 0)[..., None], total / jnp.maximum(count, 1.0)[..., None], colour)


def elected(chosen: Bool[Array, "h w"], depth: Float[Array, "h w"]) -> Bool[Array, "h w"]:
    """Majority vote among each pixel's neighbours of similar depth; at a tie or without a finite depth [m] it stays."""
    votes = jnp.zeros(depth.shape, jnp.int32)
    for near, other in zip(_neighbours(depth, math.nan), _neighbours(chosen, False), strict=True):
        votes = votes + jnp.where(jnp.abs(near - depth) < LIKE_DEPTH, jnp.where(other, 1, -1), 0)
    return (votes > 0) | (chosen & (votes == 0))


def coloured_pixels(
    detector: Callable[[Array], Array], colour: Float[Array, "h w 3"], depth: Float[Array, "h w"]
) -> Bool[Array, "h w"]:
    """The pixels in which a detector sees the target, robust to the noise of single pixels.

    Args:
      detector: gives the target's pixels of a colour image.
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
    depth: Float[Array, "h w"],
    of_target: Bool[Array, "h w"],
) -> tuple[Float[Array, " 3"], Bool[Array, ""]]:
    """The pose of the target from its pixels: x, y [m] and yaw [rad]; and whether it has any pixels.

    Of the poses that its points fit equally well, it is one where nothing is seen behind the target's surface.

    Args:
      key: PRNG key of the drawn points.
      target: static.
      shelf, camera: of the image.
      points: in the world [m].
      depth: of the points [m]; NaN where nothing was measured, infinite where there is nothing.
      of_target: the target's pixels; if there are none, the pose is meaningless, but finite.
    """
    flat, origin = points.reshape(-1, 3), jnp.array(camera.position)
    index, count = draw(key, of_target.reshape(-1), TARGET_POINTS)
    drawn, seen = flat[index], jnp.broadcast_to(count > 0, TARGET_POINTS)
    poses, costs = target_poses(target, shelf, origin, drawn, seen, SIDES)
    # Rays that may meet the target at one of the poses.
    reach = 2.0 * float(sum(half**2 for half in target.half_size)) ** 0.5
    middle = jnp.sum(jnp.where(seen[:, None], drawn, 0.0), axis=0) / TARGET_POINTS - origin
    along = rays(camera).reshape(-1, 3)
    nearest = jnp.sum(along * middle[None], axis=-1, keepdims=True) / jnp.sum(along**2, axis=-1, keepdims=True)
    passes = jnp.sum((nearest * along - middle[None]) ** 2, axis=-1) < reach**2
    beside, _ = draw(jax.random.fold_in(key, 1), passes, BESIDE)
    chosen, tolerance = of_target.reshape(-1), depth_tolerance(depth, of_target)
    sample = Sample(
        along[beside], flat[beside], depth.reshape(-1)[beside], chosen[beside], jnp.broadcast_to(tolerance, BESIDE)
    )
    proof = jax.vmap(lambda pose: evidence(target, upright(target, shelf, pose), origin, sample))(poses)
    worth = proof.support - proof.contrary
    good = worth >= jnp.max(worth) - jnp.maximum(2.0, EQUAL * jnp.max(proof.support))
    return poses[jnp.argmin(jnp.where(good, costs, jnp.inf))], count > 0


def near_target(
    target: Target, shelf: Shelf, pose: Float[Array, " 3"], points: Float[Array, "*batch 3"]
) -> Bool[Array, "*batch"]:
    """Which world points [m] are on the surface of a target at a pose x, y [m] and yaw [rad].

    False for NaN, and for points deep inside the target, since something seen there is not the target.
    """
    return (jnp.abs(distance(target, shelf, pose, points.reshape(-1, 3))) < SURFACE).reshape(points.shape[:-1])


def without_phantoms(
    labels: Int[Array, "h w"], on_it: Bool[Array, "h w"], of_target: Bool[Array, "h w"]
) -> Int[Array, "h w"]:
    """Labels in which a segment that lies mostly on the fitted target is OTHER, for its points are the target's.

    A segment that is larger than the visible part of the target stays: the pose fitted to a narrow part is uncertain,
    and may reach into a neighbour.

    Args:
      labels: as in `images.labels`.
      on_it: pixels on the fitted target; none if it is not visible.
      of_target: the target's pixels.
    """
    member = labels[..., None] == jnp.arange(INSTANCES, dtype=labels.dtype).reshape(1, 1, -1)
    size, within = jnp.sum(member, axis=(0, 1)), jnp.sum(member & on_it[..., None], axis=(0, 1))
    is_phantom = (2 * within > size) & (size <= jnp.sum(of_target))
    phantom = jnp.any(member & is_phantom.reshape(1, 1, -1), axis=-1)
    return jnp.where(phantom, OTHER, labels).astype(labels.dtype)
