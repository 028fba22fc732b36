"""Edges of a depth image against those of its colour image and of its mask: all should be at the same pixels.

Matching blocks, a stereo camera lets nearer surfaces reach beyond their edges, and things are recognised too large, or
elsewhere. In the depth image alone that looks like larger things; in the colour image the edges are where they are.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from mechsearch_jax.images.cloud import above_board, shelf_view, surfaces, thinned_view
from mechsearch_jax.images.labels import CAPACITY, MOST, OTHER
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.workspace.camera import Camera, back_project
from mechsearch_jax.workspace.detector import longer
from mechsearch_jax.workspace.shelf import Shelf

# An end of a surface: what is measured next, after at most so many pixels without a depth, is farther by this [m].
JUMP, GAP = 0.04, 24
# Beside a mask's edges fewer may be without one: along a column so few that a slanted face of which little was measured
# has no ends. And points so near to the shelf's faces are not judged, for they may be the shelf's [m].
GAPS, FACES = (2, 8), 0.015
# How far from an end other edges are looked for [pixels], and how many ends must be seen to say anything.
REACH, ENDS = 12, 60
# Nearer surfaces may reach so far beyond their edges in the colour image [pixels of 1280 x 720, but at least of the
# image itself].
BEYOND = 0.75
# The mask should have an edge within so many pixels [of 1280 x 720] of such a share of the ends in each direction.
NEAR, LEAST_NEAR = 3, 0.4
# Such a share of an object's pixels may lie on surfaces of other things [and at least so many pixels of 1280 x 720].
LEFT_OUT, LEAST_LEFT_OUT = 0.1, 100


class Ends(NamedTuple):
    """Where surfaces end in one direction, in an image that was turned so that the direction is to the right.

    Attributes:
      row, column: of the last pixel of each surface.
      gap: number of pixels without a depth after it.
      axis, sign: the direction: 1 for along rows, 0 for along columns; 1 upwards, -1 downwards in number.
    """

    row: np.ndarray
    column: np.ndarray
    gap: np.ndarray
    axis: int
    sign: int

    def turned(self, image: Shaped[np.ndarray, "h w *channels"]) -> np.ndarray:
        return (image if self.axis else image.swapaxes(0, 1))[:, :: self.sign]

    def along(self, image: Shaped[np.ndarray, "h w *channels"]) -> np.ndarray:
        """The pixels of an image from `REACH` before to `REACH` + 1 after each end, shape (ends, 2 REACH + 2, ...)."""
        return self.turned(image)[self.row[:, None], self.column[:, None] + np.arange(-REACH, REACH + 2)]


def ends_of(depth: Float[np.ndarray, "h w"], axis: int, sign: int) -> Ends:
    """The ends of surfaces in a direction; what is not measured, such as a stereo camera's shadow, is passed over."""
    none = np.zeros(0, int)
    ends = Ends(none, none, none, axis, sign)
    turned = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    turned = np.pad(ends.turned(turned), ((0, 0), (1, 1)), constant_values=np.nan)
    width = turned.shape[1]
    following = np.where(np.isnan(turned), width, np.arange(width))
    following = np.minimum.accumulate(following[:, ::-1], axis=1)[:, ::-1][:, 1:]
    gap = following - np.arange(width - 1) - 1
    beyond, farther = (np.take_along_axis(turned, np.minimum(following + i, width - 1), axis=1) for i in (0, 1))
    # Of two pixels on either side, lest noise on slanted surfaces make ends.
    before, last = np.roll(turned, 1, axis=1)[:, :-1], turned[:, :-1]
    jumps = np.minimum(beyond, farther) - np.maximum(before, last) > JUMP
    row, column = np.nonzero(jumps & (gap <= GAP))
    inside = (column > REACH) & (column < width - REACH - 2)
    row, column = row[inside], column[inside]
    return ends._replace(row=row, column=column - 1, gap=gap[row, column])


def edge_faults(
    camera: Camera, shelf: Shelf, depth: Float[np.ndarray, "h w"], colour: Shaped[np.ndarray, "h w 3"] | None
) -> tuple[str, ...]:
    """A warning if nearer surfaces reach beyond their edges in the colour image, to the left and right together.

    Args:
      camera, shelf: of the images.
      depth: metres along the camera's z; 0 or NaN where nothing was measured.
      colour: floats in 0 to 1 or uint8; without it nothing is said.

    Raises:
      InputError: the camera does not see the shelf.
    """
    if colour is None:
        return ()
    view = shelf_view(camera, shelf, 1)
    depth, colour = (view.cut(np.asarray(image)) for image in (depth, colour))
    beyond = [_beyond(ends_of(depth, 1, sign), colour) for sign in (1, -1)]
    # Where one side is not seen, a colour image beside the depth image would look the same.
    reach = float(np.mean(beyond))
    if not reach >= BEYOND * max(1.0, longer(camera)):
        return ()
    faces = ", and faces of the shelf seem to be" if shelf.faces else ""
    return (
        f"depth image: its edges lie {reach:.0f} pixels beyond those of the colour image, so that nearer things look "
        f"larger, as where a stereo camera matches blocks; things may be recognised centimetres too large or elsewhere"
        f"{faces}: let the camera match smaller blocks, or leave out the depth beside edges",
    )


def _beyond(ends: Ends, colour: np.ndarray) -> float:
    """How far surfaces reach beyond the edges of their colour [pixels]; NaN where that cannot be said."""
    if len(ends.row) < ENDS:
        return np.nan
    steps = np.abs(np.diff(ends.along(colour).astype(np.float32), axis=1)).max(axis=-1)
    share = np.mean(steps / np.maximum(steps.sum(axis=1, keepdims=True), 1e-6), axis=0)
    share = np.maximum(share - np.median(share), 0.0)
    peak = int(np.argmax(share))
    around = np.arange(max(peak - 1, 0), min(peak + 2, len(share)))
    # Most ends should have their edge at one place.
    if share[around].sum() <= 0.5 * share.sum():
        return np.nan
    return float(REACH - np.sum(around * share[around]) / share[around].sum())


def mask_faults(
    camera: Camera, shelf: Shelf, depth: Float[np.ndarray, "h w"], mask: Int[np.ndarray, "h w"] | None
) -> tuple[str, ...]:
    """A warning if a mask does not fit the depth image: its edges are elsewhere, or objects lie on others' surfaces.

    Args:
      camera, shelf, depth: as of `edge_faults`.
      mask: the object's number for each pixel, negative for none; without it nothing is said.

    Raises:
      InputError: the camera does not see the shelf.
    """
    if mask is None:
        return ()
    reasons = (_away_from_edges(camera, shelf, depth, mask), _on_others(camera, shelf, depth, mask))
    if not any(reasons):
        return ()
    return (
        f"mask: does not fit the depth image: {', and '.join(filter(None, reasons))}; give the mask of this image, "
        "registered to the depth, and enlarge it without interpolation",
    )


def _away_from_edges(camera: Camera, shelf: Shelf, depth: np.ndarray, mask: np.ndarray) -> str | None:
    view = shelf_view(camera, shelf, 1)
    depth, mask = (view.cut(np.asarray(image)) for image in (depth, mask))
    points = back_project(view.camera, jnp.asarray(np.where(depth > 0, depth, np.nan)))
    standing = np.asarray(above_board(shelf, points, FACES))
    named = np.where((mask >= 0) & (mask <= MOST), mask, OTHER)
    near = round(max(1.0, NEAR * longer(camera)))
    shares = []
    for axis, sign in ((1, 1), (1, -1), (0, 1), (0, -1)):
        ends = ends_of(depth, axis, sign)
        pixels = ends.along(named)
        # What has no number anywhere near is not in the mask.
        judged = ends.along(standing)[:, REACH] & (pixels >= 0).any(axis=1) & (ends.gap <= GAPS[axis])
        if judged.sum() >= ENDS:
            off = np.arange(-REACH, REACH + 1)[None]
            within = (np.diff(pixels, axis=1) != 0) & (off >= -near) & (off <= ends.gap[:, None] + near)
            shares.append(float(within.any(axis=1)[judged].mean()))
    if min(shares, default=1.0) >= LEAST_NEAR:
        return None
    return f"at {100 - 100 * min(shares):.0f}% of the places where depth jumps, it has no edge within {near} pixels"


def _on_others(camera: Camera, shelf: Shelf, depth: np.ndarray, mask: np.ndarray) -> str | None:
    view = thinned_view(camera, shelf)
    seen = view.of(jnp.asarray(depth, jnp.float32))
    points = back_project(view.camera, jnp.where(seen > 0, seen, jnp.nan))
    instances = view.of(jnp.asarray(mask))
    instances = jnp.where((instances >= 0) & (instances <= MOST), instances, OTHER).astype(jnp.int8)
    capacity = CAPACITY if int(jnp.max(instances)) <= CAPACITY else MOST
    own = on_own_surfaces(points, instances, above_board(shelf, points), capacity)
    before, after = (
        np.bincount(np.asarray(labels)[np.asarray(labels) >= 0], minlength=MOST + 1) for labels in (instances, own)
    )
    left_out = before - after
    least = LEAST_LEFT_OUT * longer(camera) ** 2 / view.stride**2
    share = np.where(left_out > least, left_out / np.maximum(before, 1), 0.0)
    worst = int(np.argmax(share))
    if share[worst] <= LEFT_OUT:
        return None
    return f"{100 * share[worst]:.0f}% of number {worst} lies on other things, and is left out"


@cached_jit(static_argnames=("capacity",))
def on_own_surfaces(
    points: Float[Array, "h w 3"],
    instances: Int[Array, "h w"],
    standing: Bool[Array, "h w"],
    capacity: int = CAPACITY,
) -> Int[Array, "h w"]:
    """A mask in which those pixels of an instance are OTHER that lie on a surface of another thing.

    An instance keeps the `surfaces` that show more of it than of anything else, such as the parts of what something in
    front of it divides, and the one that shows most of it and least of others, although something that touches it may
    show more there.

    Args:
      points: in the world [m]; NaN where nothing was measured.
      instances: the mask as labels of `images.labels`.
      standing: pixels that show something on the shelf; others keep their labels.
      capacity: instances are numbered up to it; static.
    """
    labels, counted = instances.reshape(-1), standing.reshape(-1)
    number = surfaces(points, standing).reshape(-1)
    named = labels >= 0
    pixels = jnp.zeros((labels.size, capacity + 2), jnp.int32)
    pixels = pixels.at[number, jnp.where(named, labels, capacity + 1)].add(counted.astype(jnp.int32))
    share = pixels / jnp.maximum(jnp.sum(pixels, axis=1, keepdims=True), 1)
    main, owner = jnp.argmax((share * pixels)[:, : capacity + 1], axis=0), jnp.argmax(pixels, axis=1)
    own = (owner[number] == labels) | (main[jnp.maximum(labels, 0)] == number)
    return jnp.where(named & counted & ~own, OTHER, labels).astype(instances.dtype).reshape(instances.shape)
