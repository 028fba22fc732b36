"""Whether images fit what is known of camera and shelf: each fault that a person would see at once, in one line.

Looked at on the host, before anything is recognised: wrong units, poses and masks otherwise end in an empty shelf.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mechsearch_jax.perception.cloud import shelf_view
from mechsearch_jax.perception.planes import PlaneConfig, find_plane
from mechsearch_jax.workspace.camera import Camera, back_project
from mechsearch_jax.workspace.shelf import Shelf

# The board is looked for so far above and below where it should be [m], among at most so many points, and is believed
# to be seen where so many lie on one plane.
FLOOR_SEARCH = 0.06
FLOOR_POINTS = 4096
FLOOR_SUPPORT = 200
# How far the board that is seen may be from the one that is known [m].
FLOOR_TOLERANCE = 0.01
# Least share of the pixels that show the shelf with a measured depth.
LEAST_MEASURED = 0.5


def image_faults(
    camera: Camera,
    shelf: Shelf,
    depth: Float[np.ndarray, "h w"],
    mask: Int[np.ndarray, "h w"] | None = None,
) -> tuple[str, ...]:
    """What in a depth image and a mask does not fit camera and shelf; empty if everything does.

    Args:
      camera: what took them, whose own pose has no fault.
      shelf: what it sees.
      depth: metres along the camera's z; 0 or NaN where nothing was measured.
      mask: the number of the object that a pixel shows, negative for none.

    Raises:
      InputError: the camera does not see the shelf.
    """
    view = shelf_view(camera, shelf, 1)
    part = np.asarray(view.of(jnp.asarray(depth)), np.float32)
    measured = np.isfinite(part) & (part > 0)
    if measured.mean() < LEAST_MEASURED:
        return (
            f"depth image: {100 * measured.mean():.0f}% of the pixels that show the shelf have a depth; it must be in "
            "metres along the camera's axis, and the sensor must be able to see the shelf",
        )
    points = np.asarray(back_project(view.camera, jnp.asarray(np.where(measured, part, np.nan))))[measured]
    faults = [_floor_fault(shelf, points)]
    x, y, z = points.T
    within = (x > shelf.front) & (x < shelf.back) & (y > shelf.right) & (y < shelf.left) & (z < shelf.ceiling)
    if mask is not None and (z[within] > shelf.board + 2 * FLOOR_TOLERANCE).any() and not (mask >= 0).any():
        faults.append("mask: names no object although something stands on the shelf; objects are 0 to 8, all else -1")
    return tuple(fault for fault in faults if fault)


def _floor_fault(shelf: Shelf, points: Float[np.ndarray, "n 3"]) -> str | None:
    """What is wrong with the board that the points show."""
    x, y, z = points.T
    over = (x > shelf.front) & (x < shelf.back) & (y > shelf.right) & (y < shelf.left)
    low = points[over & (np.abs(z - shelf.board) < FLOOR_SEARCH)]
    chosen = low[np.random.default_rng(0).permutation(len(low))[:FLOOR_POINTS]]
    padded = np.zeros((FLOOR_POINTS, 3), np.float32)
    padded[: len(chosen)] = chosen
    valid = jnp.arange(FLOOR_POINTS) < len(chosen)
    plane = find_plane(jax.random.key(0), jnp.asarray(padded), valid, config=PlaneConfig())
    if int(plane.support) < FLOOR_SUPPORT:
        return (
            f"depth image: shows no board within {100 * FLOOR_SEARCH:.0f} cm of z = {shelf.board:.3f} m; check the "
            "pose of the camera, the unit of the depth and the shelf"
        )
    normal, offset = np.asarray(plane.normal, float), float(plane.offset)
    corners = [(a, b) for a in (shelf.front, shelf.back) for b in (shelf.right, shelf.left)]
    off = [(offset - normal[0] * a - normal[1] * b) / normal[2] - shelf.board for a, b in corners]
    worst = max(off, key=abs)
    if abs(worst) <= FLOOR_TOLERANCE:
        return None
    return (
        f"depth image: the board appears up to {100 * abs(worst):.1f} cm too {'high' if worst > 0 else 'low'}; check "
        "the pose of the camera and the height of the board"
    )
