"""Check whether a camera sees the shelf, and guess the mistake in its pose if it does not.

Pure geometry of the pose, on the host, before anything else is computed with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

# Shares of the board below which a camera is refused, and below which there is a warning.
LEAST_USABLE = 0.2
LEAST_SEEN = 0.5
# A camera counts as upside down if the z component of its y axis in the world is above this.
UPSIDE_DOWN = 0.5
# Uncertainty of the walls: how far a line of sight may pass into a wall [m].
SLACK = 0.02
# Axes of a camera's frame in a frame with x forward, y left and z up, and in OpenGL's, as columns.
BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
OPENGL = np.diag([1.0, -1.0, -1.0])
AXES = "its frame must have x right, y down and z forward"

# Sides through which one may look into the space where they have no face: their axes, and signs of the way in.
_SIDES = (("front", 0, 1), ("back", 0, -1), ("right", 1, 1), ("left", 1, -1), ("ceiling", 2, -1))

Pose = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]


def check_camera(camera: Camera, shelf: Shelf) -> None:
    """Check that a camera sees the shelf.

    Args:
      camera: with x right, y down and z forward.
      shelf: that it should see.

    Raises:
      InputError: the shelf is behind it, nearly all of the board is outside of its image, or it looks through a wall
        because of a common mistake. The message names the likely mistake.
    """
    fault = blindness(camera, shelf)
    if fault is not None:
        raise InputError(fault)


def blindness(camera: Camera, shelf: Shelf) -> str | None:
    """Why a camera cannot be used, in one line; None if it sees enough of the shelf."""
    sight = _sight(camera, _pose(camera), shelf)
    if sight.ahead and sight.seen >= LEAST_USABLE:
        return None
    if (mistake := _mistake(camera, shelf)) is not None:
        return mistake
    if not sight.ahead:
        return f"camera: looks away from the shelf; {AXES}, and its pose be that in the robot's frame"
    # A wall or a ceiling may be given where there is none.
    return _little(sight) if sight.framed < LEAST_USABLE else None


def camera_faults(camera: Camera, shelf: Shelf) -> tuple[str, ...]:
    """Warnings about a camera's pose relative to the shelf. Only an image tells whether it hangs upside down.

    Args:
      camera: with x right, y down and z forward.
      shelf: that it should see.
    """
    fault = blindness(camera, shelf)
    if fault is not None:
        return (fault,)
    sight = _sight(camera, _pose(camera), shelf)
    return (_mistake(camera, shelf) or _little(sight),) if sight.seen < LEAST_SEEN else ()


def share_seen(camera: Camera, shelf: Shelf) -> float:
    """The share of the board that a camera sees, without the objects on it."""
    return _sight(camera, _pose(camera), shelf).seen


class Sight(NamedTuple):
    """How much a camera sees of the board, without the objects on it.

    Attributes:
      central: cosine of the angle between its axis and the direction to the middle of the shelf's space.
      framed: share of the board within its image, hidden or not.
      seen: share of the board within its image that walls, ceiling and back do not hide.
    """

    central: float
    framed: float
    seen: float

    @property
    def ahead(self) -> bool:
        """Whether the middle of the shelf's space is in front of it."""
        return self.central > 0.0


def _sight(camera: Camera, pose: Pose, shelf: Shelf) -> Sight:
    """The sight of a camera from a pose."""
    rotation, position = pose
    x, y = np.linspace(shelf.front, shelf.back, 21), np.linspace(shelf.right, shelf.left, 21)
    board = np.stack(np.meshgrid(x, y, [shelf.board], indexing="ij"), axis=-1).reshape(-1, 3)
    middle = board.mean(axis=0) + np.array([0.0, 0.0, (shelf.ceiling - shelf.board) / 2])
    right, down, depth = ((board - position) @ rotation).T
    safe = np.maximum(depth, 1e-6)
    row, column = camera.fy * down / safe + camera.cy, camera.fx * right / safe + camera.cx
    framed = (row >= 0.0) & (row < camera.height) & (column >= 0.0) & (column < camera.width) & (depth > 0)
    seen = framed & enters(shelf, position, board - position, -SLACK)
    towards = middle - position
    central = towards @ rotation[:, 2] / max(float(np.linalg.norm(towards)), 1e-9)
    return Sight(float(central), float(framed.mean()), float(seen.mean()))


def enters(
    shelf: Shelf, place: Float[np.ndarray, "3"], ways: Float[np.ndarray, "*batch 3"], margin: float = 0.0
) -> Bool[np.ndarray, "*batch"]:
    """Which rays enter the shelf's space through its front, or a side without a face, or begin in it.

    Args:
      shelf: the shelf.
      place: where the rays begin [m].
      ways: their directions, of any length.
      margin: how far inside of such a side's edges they must pass [m].
    """
    ends = (shelf.front, shelf.right, shelf.board), (shelf.back, shelf.left, shelf.ceiling)
    entered = np.full(ways.shape[:-1], _in_space(place, shelf))
    for face, axis, inward in _SIDES:
        if face in shelf.faces:
            continue
        is_towards = inward * ways[..., axis] > 1e-9
        time = (ends[inward < 0][axis] - place[axis]) / np.where(is_towards, ways[..., axis], np.inf)
        crossing = place + time[..., None] * ways
        entered |= (
            is_towards
            & (time >= 0.0)
            & np.all(
                [
                    (crossing[..., k] > ends[0][k] + margin) & (crossing[..., k] < ends[1][k] - margin)
                    for k in {0, 1, 2} - {axis}
                ],
                axis=0,
            )
        )
    return entered


def ends_in_shelf(
    shelf: Shelf, place: Float[np.ndarray, "3"], ways: Float[np.ndarray, "*batch 3"]
) -> Bool[np.ndarray, "*batch"]:
    """Which rays, of those that `enters` is true of, would end on the board or on a face if nothing stood on it; behind
    a side without a face there may be nothing to measure."""
    walls, ends = shelf.walls, np.full(ways.shape[:-1], np.inf)
    for axis, face, outward in (
        (2, shelf.board, -1),
        (0, walls.back, 1),
        (1, walls.right, -1),
        (1, walls.left, 1),
        (2, walls.ceiling, 1),
    ):
        is_towards = outward * ways[..., axis] > 1e-9
        time = (face - place[axis]) / np.where(is_towards, ways[..., axis], 1.0)
        ends = np.minimum(ends, np.where(is_towards, time, np.inf))
    x, y, z = np.moveaxis(place + ends[..., None] * ways, -1, 0)
    near = (x > shelf.front - SLACK) & (x < shelf.back + SLACK) & (y > shelf.right - SLACK) & (y < shelf.left + SLACK)
    return near & (z < shelf.ceiling + SLACK)


def _in_space(position: Float[np.ndarray, "3"], shelf: Shelf) -> bool:
    """Whether a position is in the shelf's space."""
    x, y, z = position
    high, wide = shelf.board <= z <= shelf.ceiling, shelf.right <= y <= shelf.left
    return bool(shelf.front <= x <= shelf.back and wide and high)


def _little(sight: Sight) -> str:
    if sight.framed < LEAST_SEEN:
        return f"camera: its image shows {100 * sight.framed:.0f}% of the board only; check its pose and focal lengths"
    return (
        f"camera: {100 * (1.0 - sight.seen):.0f}% of the board are outside of its image or behind walls and ceiling; "
        "check its pose and the shelf"
    )


def _mistake(camera: Camera, shelf: Shelf) -> str | None:
    """The common mistake that would explain the pose, as a message; None if none does."""
    sights = {line: (pose, _sight(camera, pose, shelf)) for line, pose in _mended(_pose(camera)).items()}
    # Corrected poses that are upright and outside the shelf; the best is level and has the shelf in the middle.
    doubts = {
        line: (round(abs(pose[0][2, 0]), 2), -sight.central)
        for line, (pose, sight) in sights.items()
        if sight.ahead and sight.seen >= LEAST_SEEN and pose[0][2, 1] < UPSIDE_DOWN and not _in_space(pose[1], shelf)
    }
    return min(doubts, key=lambda line: doubts[line], default=None)


def _mended(pose: Pose) -> Mapping[str, Pose]:
    """The pose corrected for each common mistake, by the message about it; the most common first."""
    rotation, position = pose
    back = rotation.T, -rotation.T @ position
    inverted = "camera: T_world_camera looks inverted: its inverse sees the shelf"
    transposed = "camera: its rotation looks transposed: the shelf is seen with its rows as columns"
    opengl = "OpenGL's axes (y up, z backward): negate the second and third columns"
    return {
        f"{inverted}; give the camera's pose in the robot's frame": back,
        f"{transposed}; give the rows of R_world_camera": (rotation.T, position),
        f"camera: looks away from the shelf, as with {opengl} of the rotation": (rotation @ OPENGL, position),
        f"{inverted}, with {opengl} of its rotation, and give that": (back[0] @ OPENGL, back[1]),
        f"{transposed} and {opengl} of the transposed": (rotation.T @ OPENGL, position),
        f"camera: looks elsewhere, as with the axes of a robot's body (x forward, y left, z up); {AXES}, as the "
        "optical frame of ROS has": (rotation @ BODY, position),
    }


def _pose(camera: Camera) -> Pose:
    return np.array(camera.rotation, float), np.array(camera.position, float)
