"""What a fit of the shelf says, in words and numbers."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from tabulate import tabulate

from mechsearch_jax.calibration.fit import LEVER, FaceFit, ShelfFit

AXES = ("x, into the shelf", "y, to the left", "z, up")
# A direction of an axis counts as undetermined with this much of it in what the image does not determine.
FREE = 0.1
# A face that the fit leaves farther from its place than this has a wrong measure in the configuration [m].
WRONG_MEASURE = 0.005

Moved = Literal["camera", "shelf"]
NOT_DETERMINED: dict[Moved, str] = {
    "camera": (
        "not determined: the faces in sight do not tell; what is added there comes from turning the camera about the "
        "middle of the board"
    ),
    "shelf": "not determined: the faces in sight do not tell",
}


def correction(
    fit: ShelfFit, moved: Moved
) -> tuple[Float[np.ndarray, "2 3"], Float[np.ndarray, "2 3"], Bool[np.ndarray, "2 3"]]:
    """What is to be added to the given place and orientation, along and about the axes of the world.

    Args:
      fit: of the shelf.
      moved: what is corrected: the camera, or the shelf, whose place is the middle of its board.

    Returns:
      Shift [m] and turn [rad], their standard errors, and which of them the image determines.
    """
    arm = np.array(fit.camera.position) - fit.pivot if moved == "camera" else np.zeros(3)
    across = np.eye(6)
    across[:3, 3:] = np.cross(np.eye(3), arm).T
    if moved == "camera":
        shift, turn = np.subtract(fit.corrected.position, fit.camera.position), fit.turn
    else:
        shift, turn = -fit.shift, -fit.turn
    errors = np.sqrt(np.maximum(np.diag(across @ fit.covariance @ across.T), 0.0))
    scale = np.array([1.0] * 3 + [LEVER] * 3)
    free = scale[:, None] * (across @ (fit.undetermined / scale[:, None]))
    determined = np.linalg.norm(free, axis=1) < FREE
    return np.stack([shift, turn]), errors.reshape(2, 3), determined.reshape(2, 3)


def report(fit: ShelfFit, moved: Moved) -> str:
    """The faces in sight, and what is to be added to the camera's pose or the shelf's place, as text."""
    seen = [
        [part.face.name, part.patches and f"{part.pixels:,}", f"{1000 * part.off:+.1f} mm"]
        if part.patches
        else [part.face.name, "not in sight", ""]
        for part in fit.faces
    ]
    values, errors, determined = correction(fit, moved)
    shown = [
        [
            axis,
            *(
                f"{scale * value:+.{digits}f} ± {scale * error:.{digits}f} {unit}"
                if is_determined
                else f"{scale * value:+.{digits}f} {unit}, not determined"
                for value, error, is_determined, scale, digits, unit in (
                    (values[0, i], errors[0, i], determined[0, i], 1000.0, 1, "mm"),
                    (values[1, i], errors[1, i], determined[1, i], np.degrees(1.0), 2, "degrees"),
                )
            ),
        ]
        for i, axis in enumerate(AXES)
    ]
    what = "the camera's pose" if moved == "camera" else "the shelf's place"
    lines = [
        tabulate(seen, headers=["face", "pixels", "off after the fit"], disable_numparse=True),
        "",
        tabulate(shown, headers=[f"to be added to {what}", "along the axis", "turn about it"], disable_numparse=True),
    ]
    if not determined.all():
        lines += ["", NOT_DETERMINED[moved]]
    lines += [_wrong_measure(part) for part in fit.faces if part.patches and abs(part.off) > WRONG_MEASURE]
    return "\n".join(lines)


def _wrong_measure(part: FaceFit) -> str:
    return (
        f"warning: shelf.{part.face.field}: the {part.face.name} is {1000 * abs(part.off):.0f} mm {part.side} of "
        "its place whatever the camera's pose; measure the shelf again, or the focal lengths are wrong"
    )
