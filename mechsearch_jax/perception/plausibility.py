"""Whether images fit what is known of camera and shelf: each fault that a person would see at once, in one line.

Looked at on the host, before anything is recognised: wrong units, poses and masks otherwise end in an empty shelf.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mechsearch_jax.perception.cloud import BLOCK, shelf_view
from mechsearch_jax.perception.planes import PlaneConfig, find_plane
from mechsearch_jax.workspace.camera import Camera, back_project, project
from mechsearch_jax.workspace.shelf import Shelf

# The board is looked for so far above and below where it should be [m], among at most so many points, and is believed
# to be seen where so many lie on one plane.
FLOOR_SEARCH = 0.06
FLOOR_POINTS = 4096
FLOOR_SUPPORT = 200
# How far the board that is seen may be from the one that is known [m].
FLOOR_TOLERANCE = 0.01
# Least share of the board that the image must show, and least share of its pixels with a measured depth.
LEAST_SEEN = 0.5
LEAST_MEASURED = 0.5


def camera_faults(camera: Camera, shelf: Shelf) -> tuple[str, ...]:
    """What is wrong with a camera's pose, as seen from the shelf; empty if nothing is.

    Args:
      camera: with x right, y down and z forward.
      shelf: what it is to see.
    """
    rotation, position = np.array(camera.rotation), np.array(camera.position)
    middle = np.array(
        [(shelf.front + shelf.back) / 2, (shelf.right + shelf.left) / 2, (shelf.board + shelf.ceiling) / 2]
    )
    if (middle - position) @ rotation[:, 2] <= 0.0:
        return (
            "camera: looks away from the shelf; its frame must have x right, y down and z forward (OpenGL's has y up "
            "and z backward: negate the second and third column of the rotation)",
        )
    if rotation[2, 1] > 0.5:
        return (
            "camera: is upside down: the rows of its image run upwards in the world; negate the first two columns of "
            "the rotation, or turn the image",
        )
    share = _board_in_image(camera, shelf)
    if share < LEAST_SEEN:
        return (f"camera: its image shows {100 * share:.0f}% of the board only; check its pose and focal lengths",)
    return ()


def _board_in_image(camera: Camera, shelf: Shelf) -> float:
    """The share of the board that lies within the image, whatever stands before it."""
    x, y = np.linspace(shelf.front, shelf.back, 21), np.linspace(shelf.right, shelf.left, 21)
    board = np.stack(np.meshgrid(x, y, [shelf.board], indexing="ij"), axis=-1).reshape(-1, 3)
    pixels, depth = (np.asarray(a) for a in project(camera, jnp.asarray(board, jnp.float32)))
    inside = (pixels >= -0.5).all(axis=1) & (pixels < np.array([camera.height, camera.width]) - 0.5).all(axis=1)
    return float(np.mean(inside & (depth > 0)))


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
    view = shelf_view(camera, shelf, 1, BLOCK)
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
