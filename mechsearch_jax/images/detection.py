"""Detection of the target in a colour and a depth image, by its colour and its known shape and size.

The same on a robot and in simulation: all that is used is the images, the target's colour, shape and size.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from mechsearch_jax.images.cloud import MARGIN, above_board, draw
from mechsearch_jax.images.target_evidence import (
    Evidence,
    Placement,
    Sample,
    away_from,
    depth_tolerance,
    evidence,
    tilted_placements,
    upright_placements,
    within_shelf,
)
from mechsearch_jax.images.target_pixels import SURFACE, coloured_pixels
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.camera import Camera, rays
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Number of points that the densest place is chosen from, and that the target is fitted to.
DRAWN = 256
# Number of pixels by which placements are compared.
COMPARED = 1024
# Where less than this share of the evidence in more than so many of these pixels is for it, the others are left out.
HOPELESS, LEAST_COMPARED = 0.5, 50
# Largest number of places of the target's colour that are examined, the one with the densest pixels first.
PLACES = 16
# Radius of a place, and of the part of it that is not a place again, relative to the diagonal of the target.
PLACE, PASSED = 0.6, 0.25
# The target is where at least this share of the evidence is for it.
SHARE = 0.85
# Pixels of the target's colour up to this far from its surface are its own, such as those across its edges [m].
OWN = 0.012


class ColouredDepth(PyTreeNode):
    """A depth image with colours.

    Attributes:
      points: in the world [m], shape (h, w, 3); NaN where nothing was measured.
      depth: of the points [m], shape (h, w); NaN where nothing was measured, infinite where there is nothing.
      colour: red, green and blue in 0 to 1, shape (h, w, 3).
    """

    points: jax.Array
    depth: jax.Array
    colour: jax.Array


class Detection(PyTreeNode):
    """The target in an image.

    Attributes:
      visible: whether it is there, in more pixels than the threshold.
      coloured: its pixels of its colour, bool, shape (h, w).
      pixels: these, and the others on the surface of an upright target; none if it is not visible.
      unclear: pixels of its colour where too few show to tell what they are; they may be the target's.
      share: of the evidence at the last place that is for the target; 0 where nothing has its colour.
    """

    visible: jax.Array
    coloured: jax.Array
    pixels: jax.Array
    unclear: jax.Array
    share: jax.Array


def no_detection(image: Float[Array, "h w"]) -> Detection:
    """The detection in an image of this shape that shows no target."""
    nowhere = jnp.zeros(image.shape, bool)
    return Detection(jnp.zeros((), bool), nowhere, nowhere, nowhere, jnp.zeros(()))


def detect(
    key: Key[Array, ""],
    detector: Callable[[Array], Array],
    target: Target,
    shelf: Shelf,
    camera: Camera,
    image: ColouredDepth,
    threshold: float,
) -> Detection:
    """Find the target's pixels.

    The target is fitted to the pixels of its colour where they are densest, first upright, then leaning or lying. It
    is there if at least `SHARE` of the evidence is for it (`target_evidence.evidence`): if it is seen on its whole
    surface that nothing hides, and nothing of its colour goes on beyond it. Else the next densest place is looked at,
    up to `PLACES` of them.

    Args:
      key: PRNG key of the drawn points.
      detector: gives the pixels of the target's colour in a colour image.
      target: whose size and shape are known; static.
      shelf, camera: of the image.
      image: of the shelf.
      threshold: a target of at most this many pixels is not visible.
    """
    # Points on the board's faces may be the target's.
    near = above_board(shelf, image.points, -MARGIN)
    coloured = coloured_pixels(detector, image.colour, image.depth) & near
    tolerance = jnp.broadcast_to(depth_tolerance(image.depth, coloured), coloured.shape)
    sample = Sample(rays(camera), image.points, image.depth, coloured, tolerance)
    scene = _Scene(sample, near, jnp.array(camera.position), shelf, threshold)

    def goes_on(state):
        place, left, found = state
        return (place < PLACES) & ~found.visible & jnp.any(left)

    def look(state):
        place, left, found = state
        at = densest_place(jax.random.fold_in(key, place), target, image.points, left)
        apart = jnp.sum((image.points - at.reshape(1, 1, 3)) ** 2, axis=-1) / _diagonal(target) ** 2
        within = apart < PLACE**2
        seen = _at_place(jax.random.fold_in(key, PLACES + place), target, scene, at, left & within)
        few = coloured & within & (jnp.sum(coloured & within) <= threshold)
        seen = seen.replace(unclear=(found.unclear | few) & ~seen.visible)
        return place + 1, left & ~(apart < PASSED**2) & ~few, seen

    return jax.lax.while_loop(goes_on, look, (jnp.int32(0), coloured, no_detection(image.depth)))[2]


class _Scene(PyTreeNode):
    """What is the same at every place: the pixels, which are near the shelf's space, the camera's position, ..."""

    sample: Sample
    near: jax.Array
    origin: jax.Array
    shelf: Shelf
    threshold: jax.Array | float


def _diagonal(target: Target) -> float:
    """Of the box around the target [m]."""
    return 2.0 * float(sum(half**2 for half in target.half_size)) ** 0.5


def densest_place(
    key: Key[Array, ""], target: Target, points: Float[Array, "h w 3"], coloured: Bool[Array, "h w"]
) -> Float[Array, " 3"]:
    """The point around which most pixels are as near as one target's can be [m].

    Args:
      key: PRNG key of the drawn points.
      target: whose size is known; static.
      points: in the world [m].
      coloured: pixels that may be the target's; if there are none, the point is meaningless.
    """
    index, _ = draw(key, coloured.reshape(-1), DRAWN)
    drawn = points.reshape(-1, 3)[index]
    square = sum((drawn[:, None, i] - drawn[None, :, i]) ** 2 for i in range(3))
    return drawn[jnp.argmax(jnp.sum(square < (0.5 * _diagonal(target)) ** 2, axis=1))]


def _at_place(
    key: Key[Array, ""], target: Target, scene: _Scene, at: Float[Array, " 3"], here: Bool[Array, "h w"]
) -> Detection:
    """What is detected at a place, whose middle [m] and pixels are given."""
    sample, shelf, origin = scene.sample, scene.shelf, scene.origin
    fit_key, compare_key = jax.random.split(key)
    flat = jax.tree.map(lambda a: a.reshape(here.size, *a.shape[2:]), sample)
    index, count = draw(fit_key, here.reshape(-1), DRAWN)
    drawn, valid = flat.points[index], jnp.broadcast_to(count > 0, DRAWN)
    # Rays that may meet a target near the place.
    towards = (at - origin).reshape(1, 3)
    reach = jnp.sum(flat.rays * towards, axis=-1, keepdims=True) / jnp.sum(flat.rays**2, axis=-1, keepdims=True)
    passes = jnp.sum((reach * flat.rays - towards) ** 2, axis=-1) < _diagonal(target) ** 2
    region, _ = draw(compare_key, passes, COMPARED)
    compared: Sample = jax.tree.map(lambda a: a[region], flat)

    def best(placements: Placement) -> tuple[Placement, Evidence]:
        each = jax.vmap(lambda placement: evidence(target, placement, origin, compared))(placements)
        possible = jax.vmap(lambda placement: within_shelf(target, placement, shelf))(placements)
        worth = jnp.where(possible, each.support - each.contrary, -2 * COMPARED)
        chosen, rough = jax.tree.map(lambda a: a[jnp.argmax(worth)], (placements, each))
        hopeless = (rough.share < HOPELESS) & (rough.support + rough.contrary > LEAST_COMPARED)
        return chosen, jax.lax.cond(hopeless, lambda: rough, lambda: evidence(target, chosen, origin, flat))

    placement, proof = best(upright_placements(target, shelf, origin, drawn, valid))
    stands = proof.share >= SHARE
    placement, proof = jax.lax.cond(
        stands, lambda: (placement, proof), lambda: best(tilted_placements(target, origin, drawn, valid))
    )
    away = jnp.abs(away_from(target, placement, flat.points)).reshape(here.shape)
    own = sample.coloured & (away < OWN)
    enough = jnp.sum(own) > scene.threshold
    visible = enough & (proof.share >= SHARE) & within_shelf(target, placement, shelf)
    # The pose is unreliable if it would add more pixels than the colour shows.
    on_it = (away < SURFACE) & scene.near & stands
    on_it &= jnp.sum(on_it & ~own) <= jnp.sum(own)
    return Detection(visible, own & visible, (own | on_it) & visible, jnp.zeros(here.shape, bool), proof.share)
