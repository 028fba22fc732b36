"""Warnings about parts of a depth image in which nothing was measured, though things may stand there.

Black, shiny and transparent things, and what a stereo camera sees with one eye only, have no depth.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int

from mechsearch_jax.images.checks.look import Look, Part
from mechsearch_jax.images.cloud import density
from mechsearch_jax.observation import Observation
from mechsearch_jax.workspace.camera import rays
from mechsearch_jax.workspace.detector import found_pixels

# A hole counts if a square of this side at the middle of the board fits into it [m]: a small object.
SMALL = 0.025
# Rays that enter the shelf this close to the edges of its opening do not count [m].
RIM = 0.01


def _numbered(pixels: Bool[np.ndarray, "h w"], around: np.ndarray | None = None) -> Int[np.ndarray, "h w"]:
    """A number for each pixel, the same for connected ones; 0 for the others."""
    from scipy import ndimage

    return np.asarray(ndimage.label(pixels, around)[0])  # pyright: ignore[reportIndexIssue]


def hole_faults(look: Look) -> tuple[str, ...]:
    """A warning if connected pixels without a measurement could hide a small object in the shelf."""
    from scipy import ndimage

    part = look.thinned
    into = _into_shelf(part)
    side = max(3, round(SMALL * density(part.view.camera, look.shelf)))
    # Single pixels in a hole may be measured, by noise.
    holes = ndimage.uniform_filter((np.isnan(part.depth) & into).astype(np.float32), 3) > 0.5
    labels = _numbered(holes)
    fits = np.asarray(ndimage.binary_erosion(holes, np.ones((side, side), bool)), bool)
    large = np.unique(labels[fits])
    if not len(large):
        return ()
    sizes = np.bincount(labels.ravel())[large]
    first = ndimage.find_objects(labels)[large[np.argmax(sizes)] - 1]
    (top, bottom), (left, right) = (
        (start + edge.start * part.view.stride, start + edge.stop * part.view.stride - 1)
        for start, edge in zip((part.view.row, part.view.column), first, strict=True)
    )
    many = f"{len(large)} holes" if len(large) > 1 else "a hole"
    return (
        f"depth image: nothing was measured in {100 * sizes.sum() / into.sum():.0f}% of the shelf's image, in {many} "
        f"(the largest in rows {top} to {bottom}, columns {left} to {right}): what is behind counts as possible, and "
        "nothing is put there",
    )


def unmeasured_target_faults(look: Look, observation: Observation) -> tuple[str, ...]:
    """A warning if the target's colour is seen where nothing was measured, and the target nowhere else.

    Args:
      look: images with colour, and a detector.
      observation: of these images, without batch axes.
    """
    if bool(observation.target_visible):
        return ()
    part = look.thinned
    labels = _numbered(part.detected & np.isnan(part.depth) & _into_shelf(part), np.ones((3, 3)))
    most = int(np.bincount(labels.ravel())[1:].max(initial=0)) * part.view.stride**2
    if most <= found_pixels(look.camera):
        return ()
    return (
        f"colour image: the target's colour is seen where nothing was measured ({most} pixels in one place): it may "
        "stand there; see that the depth camera measures it (light, angle, a matt surface)",
    )


def _into_shelf(part: Part) -> Bool[np.ndarray, "h w"]:
    """Which rays enter the shelf's free space through its opening."""
    camera, shelf = part.view.camera, part.look.shelf
    ways, place = np.asarray(rays(camera)), np.array(camera.position)
    # A camera in the shelf looks through no opening.
    at = (shelf.front - place[0]) / np.where(ways[..., 0] > 1e-6, ways[..., 0], np.inf)
    _, y, z = np.moveaxis(place + np.maximum(at, 0.0)[..., None] * ways, -1, 0)
    inside = (y > shelf.right + RIM) & (y < shelf.left - RIM) & (z > shelf.board + RIM) & (z < shelf.ceiling - RIM)
    return inside & ((ways[..., 0] > 1e-6) | (place[0] > shelf.front))
