"""Grasps of a found compound from all sides: the fingers close on lines between opposite places of its surface.

From points all over the surface a line runs along the inward normal to where it leaves the body. The hand may come from
any direction about the line that is level or points down. As for other closings, the pads must hold, and the open hand
must reach the body free. Of all that is left, with each of several angles of joint 7 that keep the wrist clear of the
board, as many are taken as are wanted, spread evenly over directions, turns, angles and places: which of them arm and
shelf allow depends on where the body stands.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Int

from mechsearch_jax.geometry.spreading import farthest_points
from mechsearch_jax.grasping.closings import BODY_POINTS, OpenHand, held
from mechsearch_jax.robot.grasp_frames import WRIST_ORIGIN
from mechsearch_jax.robot.gripper import Gripper, swept_cloud
from mechsearch_jax.shapes import union
from mechsearch_jax.shapes.compound import Compound
from mechsearch_jax.shapes.solid import surface
from mechsearch_jax.shapes.union import Field, field_of

# Angles of joint 7 relative to the usual one [rad].
WRISTS = tuple(math.radians(30 * step) for step in range(-6, 5))
# A hand that points down by more than the first leaves the arm room only where link 6 is turned about the approach by
# less than the second from where it is above the hand [rad].
LOW, UPRIGHT = math.radians(15), math.radians(80)
# Points of the surface from which lines start, the most lines that are looked at, so many at a time, and the number of
# poses beyond which no more are.
STARTS, LINES, AT_ONCE, ENOUGH = 6000, 1000, 50, 600
# Steps along a line [m], and the angle to the horizontal under which it is also tried level [rad].
ALONG, NEARLY_LEVEL = 0.001, math.radians(14)
# Directions about each line, and the largest angle by which the gripper may point down [rad].
DIRECTIONS, STEEPEST = 24, math.radians(60)
# The pads may be so much askew to the surface [rad]: less than where friction of 1 ends. How far before a line they may
# hold [m], how far from the body the hand then stays [m], and the points of the body that say how far.
ASKEW, BEFORE, APART, FEW = math.radians(30), 0.012, 0.0005, 300
# Points on the gripper's way in that must stay above the board, and how far from the body the board may reach [m].
POINTS, BOARD = 512, 0.2
# What counts as one step of a line's direction, of the approach, of a turn about it, of joint 7 [rad], of a place [m].
AXIS, APPROACH, ROLL, WRIST, PLACE = math.radians(15), math.radians(10), math.radians(20), math.radians(30), 0.02


def antipodal_grasps(
    compound: Compound, gripper: Gripper, count: int, max_yaw: float = math.pi
) -> tuple[Float[np.ndarray, "g 4 4"], Int[np.ndarray, " g"]]:
    """Grasps of a compound, fewer than `count` where there are not as many.

    Args:
      compound: centred.
      gripper: that grasps.
      count: number of grasps.
      max_yaw: largest angle of the approach to the body's x, seen from above [rad].

    Returns:
      `T_body_gripper`, and the index in `WRISTS` of each one's angle of joint 7.
    """
    T = _holding(compound, gripper, max_yaw)
    ways = [swept_cloud(gripper, gripper.max_opening, WRIST_ORIGIN + angle, POINTS) for angle in WRISTS]
    turn, down = np.arctan2(T[:, 2, 1], T[:, 2, 0]), np.arcsin(np.clip(-T[:, 2, 2], -1.0, 1.0))
    swivel = (np.array(WRISTS) + turn[:, None] + math.pi) % (2 * math.pi) - math.pi
    free = np.stack([_above_board(T, way, _bottom(compound)) for way in ways], axis=1)
    row, wrist = np.nonzero(free & ((down < LOW)[:, None] | (np.abs(swivel) < UPRIGHT)))
    features = [
        T[row, :3, 2] / APPROACH,
        np.stack([np.cos(turn), np.sin(turn)], axis=1)[row] / ROLL,
        np.array(WRISTS)[wrist, None] / WRIST,
        T[row, :3, 3] / PLACE,
    ]
    chosen = spread(np.hstack(features), count)
    return T[row[chosen]], wrist[chosen]


def _holding(compound: Compound, gripper: Gripper, max_yaw: float) -> Float[np.ndarray, "k 4 4"]:
    """Poses in which the pads hold the body, and that the open hand reaches free, above the board."""
    field, body = field_of(compound), surface(compound, BODY_POINTS)
    hand, bottom = OpenHand.of(gripper), _bottom(compound)
    middle, axis = _lines(field, surface(compound, STARTS), gripper)
    order = spread(np.hstack([middle / PLACE, (axis[:, :, None] * axis[:, None]).reshape(-1, 9) / AXIS]), LINES)
    found = [np.zeros((0, 4, 4))]
    for start in range(0, len(order), AT_ONCE):
        rows = order[start : start + AT_ONCE]
        T = _approaches(middle[rows], axis[rows], max_yaw)
        T = T[_above_board(T, hand.corners, bottom)]
        # A hand whose palm would meet the body stops short of the line.
        back = np.array([hand.too_deep(body[:FEW], pose[:3, :3], pose[:3, 3]) for pose in T])
        T[:, :3, 3] -= (back + APART * (back > 0.0))[:, None] * T[:, :3, 2]
        T = T[back < BEFORE]
        T[:, :3, 3], share = held(field, gripper, T[:, :3, :3], T[:, :3, 3], ASKEW)
        T = T[share > 0.0]
        free = [hand.too_deep(body, pose[:3, :3], pose[:3, 3]) == 0.0 for pose in T]
        found.append(T[np.array(free, bool)])
        if sum(map(len, found)) >= ENOUGH:
            break
    return np.concatenate(found)


def _lines(
    field: Field, points: Float[np.ndarray, "n 3"], gripper: Gripper
) -> tuple[Float[np.ndarray, "l 3"], Float[np.ndarray, "l 3"]]:
    """Middles and directions of lines between places on which fingers may close: from each point to all places, not
    too far, where its inward normal leaves the body."""
    normal = field.slope(points)
    along = np.arange(ALONG / 2, gripper.usable_opening + ALONG, ALONG)
    inside = np.less(field.at(points[:, None] - along[None, :, None] * normal[:, None]), 0.0)
    start, place = np.nonzero(inside[:, :-1] & ~inside[:, 1:])
    middle, axis = points[start] - 0.5 * along[place + 1, None] * normal[start], normal[start]
    askew = np.abs(axis[:, 2])
    near = (askew > 1e-3) & (askew < math.sin(NEARLY_LEVEL))
    level = axis[near] * [1.0, 1.0, 0.0]
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    return np.concatenate([middle, middle[near]]), np.concatenate([axis, level])


def _approaches(
    middle: Float[np.ndarray, "l 3"], axis: Float[np.ndarray, "l 3"], max_yaw: float
) -> Float[np.ndarray, "k 4 4"]:
    """Poses of the gripper on lines, from all sides that are allowed; its x does not point down."""
    upright = np.linalg.norm(axis[:, :2], axis=1) < 1e-3
    level = np.where(upright[:, None], [1.0, 0.0, 0.0], np.cross([0.0, 0.0, 1.0], axis))
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    # Each line has other directions, so that few lines of one direction have many.
    turn = (np.arange(len(axis)) * 0.618) % 1.0
    angle = 2 * math.pi * (np.arange(DIRECTIONS) + turn[:, None]) / DIRECTIONS
    z = np.cos(angle)[..., None] * level[:, None] + np.sin(angle)[..., None] * np.cross(axis, level)[:, None]
    down = np.arcsin(np.clip(-z[..., 2], -1.0, 1.0))
    allowed = (down > -1e-3) & (down < STEEPEST) & (np.abs(np.arctan2(z[..., 1], z[..., 0])) <= max_yaw + 1e-4)
    line, which = np.nonzero(allowed)
    z, y = z[line, which], axis[line]
    y = np.where(np.cross(y, z)[:, 2:] < 0.0, -y, y)
    T = np.tile(np.eye(4), (len(line), 1, 1))
    T[:, :3, :3] = np.stack([np.cross(y, z), y, z], axis=-1)
    T[:, :3, 3] = middle[line]
    return T


def _bottom(compound: Compound) -> float:
    """How far its lowest point is below its origin [m]."""
    return float(union.reach(compound, np.array([0.0, 0.0, -1.0]), np))


def _above_board(
    T: Float[np.ndarray, "k 4 4"], cloud: Float[np.ndarray, "p 3"], bottom: float
) -> Bool[np.ndarray, " k"]:
    """Whether what is near the body of a cloud in the gripper's frame stays above a board `bottom` below its origin."""
    x, y, z = (T[:, i, :3] @ cloud.T for i in range(3))
    beneath = (x**2 + y**2 < BOARD**2) & (z + T[:, 2, 3, None] < -bottom)
    return np.logical_not(beneath.any(axis=1))


def spread(features: Float[np.ndarray, "n f"], count: int) -> Int[np.ndarray, " m"]:
    """Rows that are far from each other, each the farthest from all before; the first is the nearest to the middle."""
    if not len(features):
        return np.zeros(0, int)
    middle = int(np.argmin(np.linalg.norm(features - features.mean(axis=0), axis=1)))

    def from_row(last: int) -> Float[np.ndarray, " n"]:
        return np.sum((features - features[last]) ** 2, axis=1)

    return farthest_points(min(count, len(features)), middle, from_row)
