"""The Panda in pictures: its collision primitives in the colours of its parts."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mechsearch_jax.robot.arm_clearance import FOOT
from mechsearch_jax.robot.gripper import RobotPart, fingers, hand_parts, link_parts
from mechsearch_jax.shapes import Capsule, shape_of
from mechsearch_jax.viz.raycast import Colour, VisibleSolid

WHITE, GREY, DARK = (0.93, 0.94, 0.95), (0.62, 0.65, 0.69), (0.27, 0.30, 0.34)
# Colours of links 1 to 7.
COLOURS = (WHITE, WHITE, WHITE, WHITE, WHITE, GREY, GREY)
_BOX, _CAPSULE = shape_of("box"), Capsule()


def panda_solids(poses: Float[np.ndarray, "8 4 4"], opening: float) -> list[VisibleSolid]:
    """The foot, the arm, the hand and its fingers.

    Args:
      poses: of links 1 to 7 and of the hand, as from `kinematics.forward_kinematics`.
      opening: distance between the fingers [m].
    """
    solids = [
        _solid(poses[frame] @ primitive.T_frame_primitive, primitive, colour)
        for frame, primitives, colour in _parts(opening)
        for primitive in primitives
    ]
    return [_foot(), *solids]


def panda_pieces() -> list[list[VisibleSolid]]:
    """The rigid pieces: links 1 to 7 and the hand in their frames, the left and the right finger in the hand's frame,
    closed, and the foot in the world."""
    pieces = [
        [_solid(primitive.T_frame_primitive, primitive, colour) for primitive in primitives]
        for _, primitives, colour in _parts(0.0)
    ]
    return [*pieces, [_foot()]]


def _parts(opening: float) -> list[tuple[int, tuple[RobotPart, ...], Colour]]:
    """The frame, the primitives and the colour of each link, of the hand and of its fingers."""
    both = fingers(opening)
    half = len(both) // 2
    links = [(i, tuple(link), colour) for i, (link, colour) in enumerate(zip(link_parts(), COLOURS, strict=True))]
    return [*links, (7, tuple(hand_parts()), DARK), (7, both[:half], GREY), (7, both[half:], GREY)]


def _foot() -> VisibleSolid:
    start, end, radius = FOOT
    return _capsule_solid(radius, (np.array(end) - start)[2] / 2, np.eye(3), (np.array(start) + end) / 2, GREY)


def _solid(T: np.ndarray, part: RobotPart, colour: Colour) -> VisibleSolid:
    if part.kind == "box":
        return VisibleSolid(_BOX, np.array(part.size), T[:3, :3], T[:3, 3], colour)
    radius, half = part.size
    return _capsule_solid(radius, half, T[:3, :3], T[:3, 3], colour)


def _capsule_solid(
    radius: float, half: float, rotation: np.ndarray, position: np.ndarray, colour: Colour
) -> VisibleSolid:
    return VisibleSolid(_CAPSULE, np.array([radius, radius, half + radius]), rotation, position, colour)
