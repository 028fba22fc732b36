"""Detection of the target in a colour and a depth image, by its colour and its known shape.

The same on a robot and in simulation: all that is used is the images, the target's colour and its shape.
"""

from __future__ import annotations

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from mechsearch_jax.images.cloud import MARGIN, above_board, draw
from mechsearch_jax.images.target_pixels import coloured_pixels, fitted_pose, near_target
from mechsearch_jax.images.target_pose import distance
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Number of points among which the densest place is sought.
CENTRES = 256
# How many things of the target's colour are looked at, the one with the densest pixels first.
PLACES = 3
# What has the target's colour has its shape, too, if at least this share of its points lies within so many metres of
# the surface of the fitted target: twice the tolerance for points that are added, since depth may be noisier.
SHARE_ON_SURFACE, TOLERANCE = 0.7, 0.008


class Detection(flax.struct.PyTreeNode):
    """The target in an image.

    Attributes:
      coloured: pixels of the target's colour that can be one target's, bool, shape (h, w).
      pixels: these and, if it is visible, what lies on the surface of the fitted target, bool, shape (h, w).
      visible: whether more pixels than the threshold are `coloured`.
    """

    coloured: jax.Array
    pixels: jax.Array
    visible: jax.Array


def no_detection(image: Float[Array, "h w"]) -> Detection:
    """The detection in an image of this shape that shows no target."""
    return Detection(jnp.zeros(image.shape, bool), jnp.zeros(image.shape, bool), jnp.zeros((), bool))


def detect(
    key: Key[Array, ""],
    detector: Callable[[Array], Array],
    target: Target,
    shelf: Shelf,
    camera: Camera,
    points: Float[Array, "h w 3"],
    depth: Float[Array, "h w"],
    colour: Float[Array, "h w 3"],
    threshold: float,
) -> Detection:
    """Find the target's pixels.

    Pixels of the target's colour are gathered at their densest place: those that are farther away than the target is
    large are something else's. They are the target if they are more than the threshold and have its shape; else the
    next densest place is looked at, up to `PLACES` of them.

    Args:
      key: PRNG key of the drawn points.
      detector: gives the pixels of the target's colour in a colour image.
      target: whose size and shape are known; static.
      shelf, camera: of the image.
      points: in the world [m]; NaN where nothing was measured.
      depth: of the points [m].
      colour: red, green and blue in 0 to 1.
      threshold: a target of at most this many pixels is not visible.
    """
    # Points on the board's faces may be the target's.
    near = above_board(shelf, points, -MARGIN)
    left = coloured_pixels(detector, colour, depth) & near
    chosen, on_it, visible = jnp.zeros(depth.shape, bool), jnp.zeros(depth.shape, bool), jnp.zeros((), bool)
    for place in range(PLACES):
        place_key = jax.random.fold_in(key, place)
        here = in_one_place(place_key, target, points, left)
        pose, _ = fitted_pose(place_key, target, shelf, camera, points, here)
        enough = jnp.sum(here) > threshold
        fits = enough & has_shape(target, shelf, pose, points, here) & ~visible
        # Where too little shows to tell, nothing is an object.
        unclear = ~enough if place == 0 else jnp.zeros((), bool)
        chosen |= here & (fits | unclear)
        on_it |= near_target(target, shelf, pose, points) & near & fits
        visible, left = visible | fits, left & ~here
    # The pose is unreliable if it would add more pixels than the colour shows.
    on_it &= jnp.sum(on_it & ~chosen) <= jnp.sum(chosen)
    return Detection(chosen, chosen | on_it, visible)


def in_one_place(
    key: Key[Array, ""], target: Target, points: Float[Array, "h w 3"], coloured: Bool[Array, "h w"]
) -> Bool[Array, "h w"]:
    """The pixels that can show one target: no farther from the densest place than it is large.

    Args:
      key: PRNG key of the drawn points.
      target: whose size is known; static.
      points: in the world [m].
      coloured: pixels that may be the target's.
    """
    index, _ = draw(jax.random.fold_in(key, 1), coloured.reshape(-1), CENTRES)
    drawn = points.reshape(-1, 3)[index]
    # The box around the target has this diagonal.
    extent = 2.0 * float(sum(half**2 for half in target.half_size)) ** 0.5
    square = sum((drawn[:, None, i] - drawn[None, :, i]) ** 2 for i in range(3))
    densest = drawn[jnp.argmax(jnp.sum(square < (0.5 * extent) ** 2, axis=1))]
    return coloured & (jnp.sum((points - densest.reshape(1, 1, 3)) ** 2, axis=-1) < extent**2)


def has_shape(
    target: Target, shelf: Shelf, pose: Float[Array, " 3"], points: Float[Array, "h w 3"], pixels: Bool[Array, "h w"]
) -> Bool[Array, ""]:
    """Whether pixels lie on the surface of the target at a pose x, y [m] and yaw [rad], but for `SHARE_ON_SURFACE`."""
    away = jnp.abs(distance(target, shelf, pose, points.reshape(-1, 3))).reshape(pixels.shape)
    return jnp.sum(pixels & (away < TOLERANCE)) >= SHARE_ON_SURFACE * jnp.sum(pixels)
