"""The check at every look: whether the shelf in the image is where camera and shelf say that it is."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mechsearch_jax.calibration.fit import FEW_PIXELS, REACH, FaceFit, ShelfFit, fit_shelf
from mechsearch_jax.calibration.limits import CalibrationLimits
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera, measured
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.sight import camera_faults, enters

# A limit is passed by so many standard errors.
CERTAIN = 3.0
# Of what is seen through the shelf's opening: least share near the shelf, and largest share farther behind its faces
# than this [m]. The image is thinned for it, in pixels. A face should be in sight if more than this share ends on it.
LEAST_INSIDE, MOST_BEHIND, BEHIND, THINNED, WELL_IN_SIGHT = 0.2, 0.05, 0.03, 8, 0.1
# A fit does not hold with a larger share behind the faces, or if it leaves the face of most pixels, or another one,
# farther from its place than this [m].
MOST_OUTLIERS, MOST_OFF_LARGEST, MOST_OFF = 0.2, 0.005, 0.015
# An image is upside down if turned it shows so many times as many pixels on the shelf's faces.
CLEARLY = 3.0
CAUSES = (
    "check whether the camera or the shelf was moved, the camera's pose and focal lengths, whether the image is "
    "turned, and the unit and scale of the depth (metres along the camera's axis)"
)
MEASURES = "measure the shelf again, and check the scale of the depth and the focal lengths"
REMEDY = "mechsearch calibrate --depth IMAGE --config FILE.toml measures and corrects it"


def placement_faults(
    camera: Camera, shelf: Shelf, depth: Float[np.ndarray, "h w"], limits: CalibrationLimits
) -> tuple[str, ...]:
    """Warnings if the shelf in a depth image, or a face of it, is not where it should be; takes 15 ms.

    Only directions count that the image determines, and faces of which enough is in sight; see `fit.fit_shelf`.

    Args:
      camera, shelf: as they are taken to be.
      depth: an image that `check_images` was called with.
      limits: of shift and turn.

    Raises:
      InputError: it is so far off that the image cannot be used, or hardly anything of it is the shelf.
    """
    opening = _opening(camera, shelf, depth)
    inside, behind = _shares(shelf, opening.points)
    if inside < LEAST_INSIDE:
        raise InputError(
            f"depth image: {100 * inside:.0f}% of what it shows through the shelf's opening is in the shelf; {CAUSES}"
        )
    fit = fit_shelf(camera, shelf, depth, FEW_PIXELS)
    is_far = is_beyond(fit, shelf, limits.refuse_shift, limits.refuse_turn)
    # A mistake that the pose alone gives away explains more.
    if (is_far or not any(part.patches for part in fit.faces)) and (faults := camera_faults(camera, shelf)):
        raise InputError(faults[0])
    if is_far:
        check_upright(fit, shelf, depth)
    check_in_sight(fit, shelf, depth)
    if is_far:
        raise InputError(f"{_appears(fit, shelf)}, which is too far to go on; {CAUSES}; {REMEDY}")
    most = max(MOST_OFF, limits.refuse_shift)
    if fault := _contradiction(fit, most, most):
        raise InputError(f"depth image: the shelf does not fit it: {fault}; {CAUSES}, and the shelf's measures")
    faults = [_misplaced(part) for part in fit.faces if part.patches and abs(part.off) > limits.warn_shift]
    if is_beyond(fit, shelf, limits.warn_shift, limits.warn_turn):
        faults.insert(0, f"{_appears(fit, shelf)}: recognition is worse for it; {REMEDY}")
    if faults:
        return tuple(faults)
    if behind > MOST_BEHIND:
        return (
            f"depth image: {100 * behind:.0f}% of what it shows through the shelf's opening is behind the shelf's "
            f"faces; {CAUSES}, and the shelf's measures",
        )
    return _unseen(fit, shelf, opening)


def check_in_sight(fit: ShelfFit, shelf: Shelf, depth: Float[np.ndarray, "h w"]) -> None:
    """Check that an image determines anything.

    Raises:
      InputError: no face of the shelf is in sight.
    """
    if any(part.patches for part in fit.faces):
        return
    check_upright(fit, shelf, depth)
    raise InputError(
        f"depth image: shows no face of the shelf within {100 * REACH:.0f} cm of its place; check the unit of the "
        "depth (metres along the camera's axis), whether the image is turned, the camera's pose and focal lengths, "
        "and the shelf"
    )


def check_upright(fit: ShelfFit, shelf: Shelf, depth: Float[np.ndarray, "h w"]) -> None:
    """Check that an image of which a fit is bad would not fit better upside down.

    A camera may hang upside down: its pose alone does not tell.

    Raises:
      InputError: it would.
    """
    turned = fit_shelf(fit.camera, shelf, depth[::-1, ::-1], FEW_PIXELS)
    seen, seen_turned = (sum(part.pixels for part in of.faces) for of in (fit, turned))
    if seen_turned > CLEARLY * seen and not holding(turned, shelf, depth[::-1, ::-1]):
        raise InputError(
            "depth image: is upside down for this pose of the camera: turn the images by 180 degrees, or the pose "
            "about the camera's axis (negate the first two columns of the rotation), not both"
        )


def check_holds(fit: ShelfFit, shelf: Shelf, depth: Float[np.ndarray, "h w"]) -> None:
    """Check that a fit explains its image, so that a camera may be corrected by it.

    Raises:
      InputError: it does not.
    """
    if fault := holding(fit, shelf, depth):
        check_upright(fit, shelf, depth)
        raise InputError(f"depth image: the shelf does not fit it: {fault}; {CAUSES}, and the shelf's measures")


def _contradiction(fit: ShelfFit, largest: float, others: float) -> str | None:
    """The face that a fit leaves farther from its place than these [m], the one of most pixels or another, in words.

    The fit ended between faces that contradict each other, or has not reached the only one.
    """
    seen = sorted((part for part in fit.faces if part.patches), key=lambda part: -part.pixels)
    for part, most in zip(seen, (largest, *[others] * 4), strict=False):
        if abs(part.off) > most:
            return f"the {part.face.name} stays {1000 * abs(part.off):.0f} mm {part.side} of its place"
    return None


def holding(fit: ShelfFit, shelf: Shelf, depth: Float[np.ndarray, "h w"]) -> str | None:
    """What speaks against a fit; None if nothing does."""
    _, behind = _shares(shelf, _opening(fit.corrected, shelf, depth).points)
    if behind > MOST_OUTLIERS:
        return f"{100 * behind:.0f}% of what it shows through the shelf's opening is behind the shelf's faces"
    return _contradiction(fit, MOST_OFF_LARGEST, MOST_OFF)


class _Opening(NamedTuple):
    """N rays through the shelf's openings: where they start, their ways at unit depth, and the points they show."""

    place: np.ndarray
    ways: np.ndarray
    points: np.ndarray


def _opening(camera: Camera, shelf: Shelf, depth: Float[np.ndarray, "h w"]) -> _Opening:
    """The measured rays through the shelf's front, and sides without a face, that end in it or behind a face."""
    rows, columns = np.arange(0, camera.height, THINNED), np.arange(0, camera.width, THINNED)
    v, u = np.meshgrid((rows + 0.5 - camera.cy) / camera.fy, (columns + 0.5 - camera.cx) / camera.fx, indexing="ij")
    ways = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ np.array(camera.rotation).T
    seen, place = np.asarray(depth[np.ix_(rows, columns)], float).ravel(), np.array(camera.position)
    known = np.isfinite(seen) & measured(seen)
    ways, points = ways[known], place + seen[known, None] * ways[known]
    low, high = _corners(shelf)
    # What is behind a side without a face is not the shelf's.
    x, y, z = points.T
    gaps = {"back": high[0] - x, "right": y - low[1], "left": high[1] - y, "ceiling": high[2] - z}
    within = np.all([gap > 0 for face, gap in gaps.items() if face not in shelf.faces] or [True], axis=0)
    kept = enters(shelf, place, ways) & within
    return _Opening(place, ways[kept], points[kept])


def _shares(shelf: Shelf, points: np.ndarray) -> tuple[float, float]:
    """The shares of points that are near the shelf, and well behind its faces; 1 and 0 without points."""
    if not len(points):
        return 1.0, 0.0
    low, high = _corners(shelf)
    inside = np.all((points > low - REACH) & (points < high + REACH), axis=1)
    # What is in front of the opening is not behind a face.
    behind = (points[:, 0] > high[0] + BEHIND) | np.any(
        (points[:, 1:] < low[1:] - BEHIND) | (points[:, 1:] > high[1:] + BEHIND), axis=1
    )
    return float(np.mean(inside)), float(np.mean(behind & (points[:, 0] > low[0])))


def _misplaced(part: FaceFit) -> str:
    """What is said of a face that is not where the other faces put it."""
    return (
        f"depth image: the {part.face.name} is {1000 * abs(part.off):.0f} mm {part.side} of shelf.{part.face.field}, "
        f"whatever the camera's pose; {MEASURES}"
    )


def _unseen(fit: ShelfFit, shelf: Shelf, opening: _Opening) -> tuple[str, ...]:
    """A warning about each face that should be well in sight in an empty shelf, and is not in sight at all."""
    if not len(opening.ways):
        return ()
    ends = []
    for part in fit.faces:
        towards = -part.face.inward * opening.ways[:, part.face.axis]
        far = part.face.inward * (opening.place[part.face.axis] - getattr(shelf, part.face.field))
        ends.append(np.where(towards > 1e-6, far / np.where(towards > 1e-6, towards, 1.0), np.inf))
    first = np.argmin(ends, axis=0)
    return tuple(
        f"depth image: the {part.face.name} should be in sight, and is not within {100 * REACH:.0f} cm of "
        f"shelf.{part.face.field}; {CAUSES}, and the shelf's measures"
        for i, part in enumerate(fit.faces)
        if not part.patches and np.mean(first == i) > WELL_IN_SIGHT
    )


def _corners(shelf: Shelf) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and the highest corner of the shelf's space [m]."""
    low, high = (shelf.front, shelf.right, shelf.board), (shelf.back, shelf.left, shelf.ceiling)
    return np.array(low), np.array(high)


def apparent(fit: ShelfFit, shelf: Shelf) -> tuple[float, float]:
    """How far a corner of the board appears at most from its place [m], and by how much the shelf is turned [rad]."""
    arms = np.array([(x, y, shelf.board) for x in (shelf.front, shelf.back) for y in (shelf.right, shelf.left)])
    moves = fit.shift + np.cross(fit.turn, arms - fit.pivot)
    return float(np.linalg.norm(moves, axis=1).max()), float(np.linalg.norm(fit.turn))


def is_beyond(fit: ShelfFit, shelf: Shelf, shift: float, turn: float) -> bool:
    """Whether the shelf appears farther from its place than a shift [m] or a turn [rad], for certain."""
    errors = np.sqrt(np.diag(fit.covariance))
    off, turned = apparent(fit, shelf)
    return bool(
        off > shift + CERTAIN * np.linalg.norm(errors[:3]) or turned > turn + CERTAIN * np.linalg.norm(errors[3:])
    )


def _appears(fit: ShelfFit, shelf: Shelf) -> str:
    off, turned = apparent(fit, shelf)
    return (
        f"camera or shelf: in the depth image the shelf is up to {1000 * off:.0f} mm and {math.degrees(turned):.1f} "
        "degrees from where camera and shelf are said to be"
    )
