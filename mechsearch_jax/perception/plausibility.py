"""Warnings about images that do not fit camera and shelf, one line for each fault that a person would see at once.

On the host, before recognition: otherwise wrong units, poses and masks end in an empty shelf.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from mechsearch_jax.calibration.fit import Face, faces_of
from mechsearch_jax.images.checks import Look
from mechsearch_jax.images.cloud import above_board
from mechsearch_jax.images.detection import BESIDE, TARGET_POINTS, fitted_pose, other_yaw
from mechsearch_jax.images.planes import TOLERANCE, find_plane
from mechsearch_jax.images.target_pose import SampledPixels, distance
from mechsearch_jax.observation import Observation
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera, project
from mechsearch_jax.workspace.detector import found_pixels
from mechsearch_jax.workspace.shelf import FACES, Shelf
from mechsearch_jax.workspace.sight import ends_in_shelf
from mechsearch_jax.workspace.target import Target

# The board is searched within this distance of its height [m], among at most so many points, and counts as seen with so
# many points on one plane.
FLOOR_SEARCH = 0.06
FLOOR_POINTS = 4096
FLOOR_SUPPORT = 200
# Largest distance of the measured board from the given one [m].
FLOOR_TOLERANCE = 0.01
# Least share of the pixels that show the shelf with a measured depth.
LEAST_MEASURED = 0.5
# Walls are searched within this distance of their places [m], among at most `FLOOR_POINTS` points with this distance
# from the other faces [m]. A plane with so many of the points, and such a share, counts as a wall.
WALL_SEARCH = 0.06
WALL_MARGIN = 0.035
WALL_SUPPORT = 150
WALL_SHARE = 0.05
# A plane must cover at least this share of its wall and at least this width [m], or it may be an object's face: the
# widest objects measure 0.16 m.
WALL_SPAN = 0.4
LEAST_WALL_SPAN = 0.2
# Number of strips across the board, and in how many its front edge must be visible.
EDGE_STRIPS, LEAST_STRIPS = 64, 32
# So many points above the board count as an object [pixels of an image of 1280 x 720].
SOMETHING = 100
# A patch of pixels may be the target if this share of its points lies within this distance of the fitted target [m],
# and if its number of pixels is within these shares of an unhidden target's. Other things mostly have more pixels.
PATCH_SHARE, PATCH_DISTANCE = 0.85, 0.003
PATCH_PIXELS = (0.4, 1.6)

EMPTY_SHELF = "the shelf is empty: no object and no target is seen"


def image_faults(look: Look) -> tuple[str, ...]:
    """Warnings about a depth image and a mask that do not fit camera and shelf.

    Raises:
      InputError: nothing was measured, or the camera does not see the shelf.
    """
    camera, shelf, mask = look.camera, look.shelf, look.mask
    measured = np.isfinite(look.whole.depth)
    if not measured.any():
        raise InputError(
            "depth image: nothing was measured where it shows the shelf; it must hold metres along the camera's axis, "
            "and the sensor must be able to see the shelf"
        )
    judged = measured
    if set(shelf.faces) < set(FACES):
        judged = measured[ends_in_shelf(shelf, np.array(camera.position), look.whole.ways)]
    if judged.mean() < LEAST_MEASURED:
        return (
            f"depth image: {100 * judged.mean():.0f}% of the pixels that show the shelf have a depth; it must be in "
            "metres along the camera's axis, and the sensor must be able to see the shelf",
        )
    points = look.whole.points[measured]
    floor = _floor_fault(shelf, points)
    # If the board is not at its place, the walls are not either.
    walls = [_wall_fault(shelf, face, points) for face in faces_of(shelf) if face.axis != 2]
    # A board without any face is a part of a table top, whose edge may be elsewhere.
    edge = _edge_fault(camera, shelf, points) if shelf.faces else None
    faults = [floor] if floor else [edge, *walls]
    x, y, z = points.T
    within = (x > shelf.front) & (x < shelf.back) & (y > shelf.right) & (y < shelf.left) & (z < shelf.ceiling)
    if mask is not None and (z[within] > shelf.board + 2 * FLOOR_TOLERANCE).any() and not (mask >= 0).any():
        faults.append("mask: names no object although something stands on the shelf; objects are 0 to 8, all else -1")
    return tuple(fault for fault in faults if fault)


def _floor_fault(shelf: Shelf, points: Float[np.ndarray, "n 3"]) -> str | None:
    """A warning if the points show no board, or one at another height."""
    x, y, z = points.T
    above = (x > shelf.front) & (x < shelf.back) & (y > shelf.right) & (y < shelf.left)
    low = points[above & (np.abs(z - shelf.board) < FLOOR_SEARCH)]
    chosen = low[np.random.default_rng(0).permutation(len(low))[:FLOOR_POINTS]]
    padded = np.zeros((FLOOR_POINTS, 3), np.float32)
    padded[: len(chosen)] = chosen
    valid = jnp.arange(FLOOR_POINTS) < len(chosen)
    plane = find_plane(jax.random.key(0), jnp.asarray(padded), valid)
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


def _wall_fault(shelf: Shelf, wall: Face, points: Float[np.ndarray, "n 3"]) -> str | None:
    """A warning if the points show a wall at another place; None if they show too little of it.

    The wall is the farthest plane with many points that is wider than any object.
    """
    past, sideways = -wall.height(shelf, points), points[:, 1 - wall.axis]
    low, high = (shelf.right, shelf.left) if wall.axis == 0 else (shelf.front, shelf.back)
    between = (sideways > low + WALL_MARGIN) & (sideways < high - WALL_MARGIN)
    upright = (points[:, 2] > shelf.board + WALL_MARGIN) & (points[:, 2] < shelf.ceiling - WALL_MARGIN)
    near = np.flatnonzero(between & upright & (np.abs(past) < WALL_SEARCH))
    near = near[np.random.default_rng(0).permutation(len(near))[:FLOOR_POINTS]]
    if len(near) < WALL_SUPPORT:
        return None
    counts, edges = np.histogram(past[near], bins=math.ceil(2 * WALL_SEARCH / 0.004), range=(-WALL_SEARCH, WALL_SEARCH))
    # A wall may share its points between two bins.
    many = np.flatnonzero(counts + np.append(counts[1:], 0) >= max(WALL_SUPPORT, WALL_SHARE * len(near)))
    if not len(many):
        return None
    at = edges[many[-1] + 1]
    near = near[np.abs(past[near] - at) < 1.5 * FLOOR_TOLERANCE]
    if abs(np.median(past[near])) < 0.5 * FLOOR_TOLERANCE:
        return None
    # In a frame in which the wall is a floor, so that one compiled `find_plane` serves both.
    local = np.stack([points[near, 2], sideways[near], -past[near]], axis=1)
    padded = np.zeros((FLOOR_POINTS, 3), np.float32)
    padded[: len(local)] = local
    valid = jnp.arange(FLOOR_POINTS) < len(local)
    plane = find_plane(jax.random.key(0), jnp.asarray(padded), valid)
    on = np.abs(np.asarray(plane.height(jnp.asarray(local, jnp.float32)))) <= TOLERANCE
    if int(plane.support) < WALL_SUPPORT:
        return None
    first, last = np.percentile(local[on, 1], (5, 95))
    if last - first < max(LEAST_WALL_SPAN, WALL_SPAN * (high - low)):
        return None
    off = -float(np.median(local[on, 2]))
    if abs(off) <= FLOOR_TOLERANCE:
        return None
    return (
        f"depth image: the {wall.name} appears {100 * abs(off):.1f} cm {_way(wall, off)} than shelf.{wall.field} says; "
        f"check the place of the shelf in {'xy'[wall.axis]} and the pose of the camera"
    )


def _way(wall: Face, off: float) -> str:
    if wall.axis == 0:
        return "farther" if off > 0 else "nearer"
    return "farther out" if off > 0 else "farther in"


def _edge_fault(camera: Camera, shelf: Shelf, points: Float[np.ndarray, "n 3"]) -> str | None:
    """A warning if the points show the board's front edge at another place; None if they show too little of it."""
    x, y, z = points.T
    board = (np.abs(z - shelf.board) < 0.008) & (np.abs(x - shelf.front) < 2 * WALL_SEARCH)
    board &= (y > shelf.right + WALL_MARGIN) & (y < shelf.left - WALL_MARGIN)
    x, strip = x[board], ((y[board] - shelf.right) / (shelf.left - shelf.right) * EDGE_STRIPS).astype(int)
    firsts = []
    for i in np.flatnonzero(_edge_in_image(camera, shelf)):
        in_strip = x[strip == i]
        if len(in_strip) >= 10:
            # Not the minimum: at an edge a sensor may measure a mixture of both depths.
            firsts.append(np.percentile(in_strip, 2))
    if len(firsts) < LEAST_STRIPS:
        return None
    off = float(np.median(firsts)) - shelf.front
    # Objects at the edge hide it, so that the board seems to begin behind them.
    if abs(off) <= FLOOR_TOLERANCE or (off > 0 and np.percentile(firsts, 10) - shelf.front <= FLOOR_TOLERANCE):
        return None
    return (
        f"depth image: the board's front edge appears {100 * abs(off):.1f} cm {'farther' if off > 0 else 'nearer'} "
        "than shelf.front says; check the place of the shelf in x and the pose of the camera"
    )


def _edge_in_image(camera: Camera, shelf: Shelf) -> Bool[np.ndarray, " strips"]:
    """In which strips across the board the image contains its front edge and a little in front of it."""
    y = shelf.right + (np.arange(EDGE_STRIPS) + 0.5) / EDGE_STRIPS * (shelf.left - shelf.right)
    before = np.stack([np.full_like(y, shelf.front - 2 * FLOOR_TOLERANCE), y, np.full_like(y, shelf.board)], axis=1)
    pixels, depth = (np.asarray(a) for a in project(camera, jnp.asarray(before, jnp.float32)))
    inside = (pixels >= 0).all(axis=1) & (pixels < np.array([camera.height, camera.width]) - 1).all(axis=1)
    return inside & (depth > 0)


def identity_faults(look: Look, target_id: int | None) -> tuple[str, ...]:
    """Warnings about images in which the target cannot be identified.

    Args:
      look: the images.
      target_id: the target's number in the mask, if given; negative if the mask does not show it.
    """
    if look.colour is None and target_id is None:
        return (
            "images: the target cannot be told from the objects; give a colour image, or a mask with target_id "
            "(negative where it does not show the target)",
        )
    if look.mask is not None and target_id is not None and target_id >= 0 and not (look.mask == target_id).any():
        return (
            f"mask: no pixel holds the target's number {target_id}, and the target counts as not seen; give the "
            "number that the mask has for it, or a negative one where it does not show it",
        )
    return ()


# Operation by operation it is hundreds of programs.
_fitted_pose = jax.jit(fitted_pose, static_argnames="target")


def colour_faults(look: Look, target: Target) -> tuple[str, ...]:
    """A warning if a colour image seems to have red and blue exchanged.

    Args:
      look: images with colour, and a detector.
      target: which is looked for.

    Raises:
      InputError: the camera does not see the shelf.
    """
    part, shelf = look.thinned, look.shelf
    least = SOMETHING * found_pixels(look.camera, 1) / part.view.stride**2
    exchanged = part.colour[..., ::-1]
    if (part.detected & part.above_board).sum() > least or (part.judged(exchanged) & part.above_board).sum() <= least:
        return ()
    swapped = part.elected(exchanged)
    if swapped.sum() <= least:
        return ()
    camera, points, depth = part.view.camera, jnp.asarray(part.points), jnp.asarray(part.depth)
    pose, _ = _fitted_pose(jax.random.key(0), target, shelf, camera, points, depth, jnp.asarray(swapped))
    from_target = np.abs(np.asarray(distance(target, shelf, pose, points[jnp.asarray(swapped)])))
    whole = 2 * target.half_size[0] * target.tall * (camera.fx / float(np.median(part.depth[swapped]))) ** 2
    as_large = PATCH_PIXELS[0] * whole < swapped.sum() < PATCH_PIXELS[1] * whole
    if not as_large or (from_target < PATCH_DISTANCE).mean() < PATCH_SHARE:
        return ()
    return (
        "colour image: looks like blue, green, red: nothing has the target's colour, but with red and blue exchanged "
        "something of the target's shape has; give red, green, blue",
    )


def detection_faults(look: Look, observation: Observation) -> tuple[str, ...]:
    """A warning if things have the target's colour, and none of them is taken for the target.

    Args:
      look: images with colour, and a detector.
      observation: of these images, without batch axes.
    """
    if bool(observation.target_visible):
        return ()
    part = look.thinned
    least = found_pixels(look.camera) / part.view.stride**2
    # The vote among neighbours is slow, and needless where next to nothing has the colour.
    if (part.detected & part.above_board).sum() <= least or (count := part.elected(part.colour).sum()) <= least:
        return ()
    return (
        f"colour image: {count * part.view.stride**2} pixels have the target's colour, but nothing that shows them has "
        "its shape and size; if the target is among them, check [target] and the camera's pose",
    )


def yaw_faults(look: Look, observation: Observation, target: Target) -> tuple[str, ...]:
    """A warning if another yaw of the target would explain the images about as well, such as that of its other sides.

    Args:
      look: images with colour, and a detector.
      observation: of these images, without batch axes.
      target: which is looked for.
    """
    if target.round or not bool(observation.target_visible):
        return ()
    part, pose, rng = look.thinned, jnp.asarray(observation.target_pose, jnp.float32), np.random.default_rng(0)
    points, ways, origin = part.points.reshape(-1, 3), part.ways.reshape(-1, 3), np.array(part.view.camera.position)
    chosen = (part.detected & part.above_board).reshape(-1)
    chosen[chosen] = np.linalg.norm(points[chosen, :2] - np.asarray(pose)[:2], axis=1) < 2 * target.solid.breadth
    if not chosen.any():
        return ()
    # As many as fits are made of in recognition, whatever the image shows: nothing is compiled anew.
    drawn = points[rng.choice(np.flatnonzero(chosen), TARGET_POINTS)]
    towards = drawn.mean(axis=0) - origin
    along = (ways @ towards) / np.sum(ways**2, axis=1)
    near = np.linalg.norm(along[:, None] * ways - towards, axis=1) < 2 * np.linalg.norm(target.half_size)
    beside = rng.choice(np.flatnonzero(near), BESIDE)
    rays, ends, depth, like_it = (jnp.asarray(a[beside]) for a in (ways, points, part.depth.reshape(-1), chosen))
    sample = SampledPixels(rays, ends, depth, like_it, jnp.zeros(BESIDE))
    start = jnp.asarray(origin, jnp.float32)
    other = math.degrees(other_yaw(target, look.shelf, start, jnp.asarray(drawn), sample, pose))
    if math.isnan(other):
        return ()
    return (
        f"target: its yaw may be {other:.0f} instead of {math.degrees(pose[2]):.0f} degrees, for what is seen of it "
        "fits both; the hand may find it wider or narrower than planned",
    )


def shows_nothing(observation: Observation) -> bool:
    """Whether neither an object nor the target was recognised; without batch axes."""
    return not (bool(jnp.any(observation.objects.valid)) or bool(observation.target_visible))


def sight_faults(look: Look, observation: Observation) -> tuple[str, ...]:
    """Why an observation, without batch axes, is empty, in one line; nothing if anything was recognised."""
    if not shows_nothing(observation):
        return ()
    part = look.thinned
    standing = int(above_board(look.shelf, part.points, FLOOR_TOLERANCE).sum()) * part.view.stride**2
    if standing > SOMETHING * found_pixels(look.camera, 1):
        return ("recognition: something stands on the shelf, but no object and no target is recognised",)
    return (EMPTY_SHELF,)
