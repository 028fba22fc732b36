"""Forward and inverse kinematics of the Franka Emika Panda and the FR3, in closed form and batched.

The arm is described by modified Denavit-Hartenberg parameters (Craig's convention, from the maker's documentation).
Its seventh joint is redundant: with joint 7 given, the hand's pose fixes the wrist centre W, where the axes of joints
5 and 6 meet; the shoulder S, the elbow E (on the axis of joint 4) and W form a triangle with known sides, which gives
joint 4 and the angle between the forearm and the line WS; two directions of the forearm have that angle and are
perpendicular to the axis of joint 6; and the upper arm's orientation is then a rotation about z, y and z by joints 1,
2 and 3, in two ways.

Frames: the base frame is the world. The hand frame is the flange turned by -45 degrees about z; the gripper frame is
the hand frame moved to between the finger tips: z is the approach direction, y the one in which the fingers open.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.transforms import back_off
from mechsearch_jax.robot.arm_config import HOME, PANDA, Arm
from mechsearch_jax.runtime.errors import InputError

Numbers = Array | np.ndarray


# One row for each joint: distance a [m] and angle alpha [quarter turns] along the previous x, distance d [m] along z.
JOINTS = (
    (0.0, 0, 0.333),
    (0.0, -1, 0.0),
    (0.0, 1, 0.316),
    (0.0825, 1, 0.0),
    (-0.0825, -1, 0.384),
    (0.0, 1, 0.0),
    (0.088, 1, 0.0),
)
FLANGE = 0.107
HAND_ANGLE = -math.pi / 4
FINGER_TIPS = 0.1034

POSITION_TOLERANCE = 1e-4
# How far a joint may turn between neighbouring waypoints of a path [rad]: a constant, and for each metre and radian.
STEP_FLOOR = 0.1
STEP_PER_METRE = 6.0
STEP_PER_RADIAN = 3.0

_SHOULDER = JOINTS[0][2]
_UPPER, _FORE, _OFFSET, _WRIST = JOINTS[2][2], JOINTS[4][2], JOINTS[3][0], JOINTS[6][0]
_UPPER_SIDE, _FORE_SIDE = math.hypot(_UPPER, _OFFSET), math.hypot(_FORE, _OFFSET)


@jax.jit
def forward_kinematics(q: Float[Numbers, "*batch 7"]) -> Float[Array, "*batch 8 4 4"]:
    """Poses in the base frame of links 1 to 7 and of the hand, for joint angles `q` [rad].

    Returns:
      `T_base_link`; entry `i` is link `i + 1` for `i` up to 6, entry 7 is the hand.
    """
    return jnp.stack([_pose(*frame) for frame in _frames(jnp.asarray(q, jnp.float32))], axis=-3)


def _frames(q: Float[Array, "*batch 7"]) -> list[tuple[Array, Array, Array, Array]]:
    """Axes x, y and z and the origin of links 1 to 7 and of the hand, each (*batch, 3)."""
    x, y, z, p = (jnp.broadcast_to(jnp.array(v, jnp.float32), (*q.shape[:-1], 3)) for v in (*np.eye(3), np.zeros(3)))
    frames = []
    for i, (a, turns, d) in enumerate(JOINTS):
        p = p + a * x if a else p
        y, z = {0: (y, z), 1: (z, -y), -1: (-z, y)}[turns]
        c, s = jnp.cos(q[..., i, None]), jnp.sin(q[..., i, None])
        x, y = c * x + s * y, c * y - s * x
        p = p + d * z if d else p
        frames.append((x, y, z, p))
    c, s = math.cos(HAND_ANGLE), math.sin(HAND_ANGLE)
    return [*frames, (c * x + s * y, c * y - s * x, z, p + FLANGE * z)]


def turned_axes(q: Sequence[Float[Array, "*batch"]]) -> list[Float[Array, "3 *batch"]]:
    """The axes x and y that each joint turns about its z, in order: the frames of the links are sums of these.

    `frame_in_turned_axes` gives the sums. With the coordinates as the first axis, all arithmetic is elementwise.

    Args:
      q: angles of the first joints [rad].
    """
    x, y, z = (
        jnp.broadcast_to(jnp.asarray(axis, jnp.float32).reshape(3, *[1] * q[0].ndim), (3, *q[0].shape))
        for axis in np.eye(3)
    )
    axes = []
    for angle, (_, turns, _) in zip(q, JOINTS, strict=False):
        y, z = {0: (y, z), 1: (z, -y), -1: (-z, y)}[turns]
        c, s = (jax.lax.broadcast(a, (3,)) for a in (jnp.cos(angle), jnp.sin(angle)))
        x, y = c * x + s * y, c * y - s * x
        axes += [x, y]
    return axes


def frame_in_turned_axes(link: int) -> Float[np.ndarray, "4 k"]:
    """Axes x, y and z and the origin of a link, counted from 0, as sums of its `turned_axes`, without the base's.

    The origin is given from the shoulder, which joint 1 does not move.
    """
    x, y, z, p = np.zeros((4, 2 * (link + 1)))
    for joint, (a, turns, d) in enumerate(JOINTS[: link + 1]):
        p = p + a * x
        y, z = {0: (y, z), 1: (z, -y), -1: (-z, y)}[turns]
        x, y = np.eye(2 * (link + 1))[2 * joint : 2 * joint + 2]
        p = p + d * z
    return np.stack([x, y, z, p])


def gripper_pose(q: Float[Numbers, "*batch 7"]) -> Float[Array, "*batch 4 4"]:
    """Pose of the gripper in the base frame, `T_base_gripper`, for joint angles `q` [rad]."""
    x, y, z, p = _frames(jnp.asarray(q, jnp.float32))[-1]
    return _pose(x, y, z, p + FINGER_TIPS * z)


@functools.partial(jax.jit, static_argnames="arm")
def inverse_kinematics(
    T_base_gripper: Float[Numbers, "*batch 4 4"], q7: Float[Numbers, "*#batch"], arm: Arm = PANDA
) -> tuple[Float[Array, "*batch 4 7"], Bool[Array, "*batch 4"]]:
    """All joint angles with a bent elbow that reach a pose with joint 7 at a given angle, in closed form.

    The elbow bends by at least 27 degrees, the outer edge of the reach; a straighter arm reaches nothing more.

    Args:
      T_base_gripper: pose of the gripper in the base frame.
      q7: angle of joint 7 [rad].
      arm: whose limits hold; static.

    Returns:
      q: four solutions (two forearms times two shoulders, always in the same order) [rad]; finite but meaningless
        where there is none.
      valid: which solutions lie within the joint limits and reproduce the position to 1e-4 m; the rotation is
        reproduced to rounding errors.
    """
    T = jnp.asarray(T_base_gripper, jnp.float32)
    q7 = jnp.broadcast_to(jnp.asarray(q7, jnp.float32), T.shape[:-2])
    four = _solutions(T, q7, arm)
    rest = [jnp.broadcast_to(four.q4, four.wrist[0].shape), *four.wrist, jnp.broadcast_to(q7, four.wrist[0].shape)]
    # Axes: joints, shoulders, forearms.
    q = jnp.stack([jnp.stack([*shoulder, *rest]) for shoulder in four.shoulders], axis=1)
    q = jnp.moveaxis(q, (2, 1, 0), (-3, -2, -1)).reshape(*T.shape[:-2], 4, 7)
    valid = jnp.moveaxis(jnp.stack(four.valid, axis=1), (0, 1), (-2, -1))
    return q, valid.reshape(*T.shape[:-2], 4)


class _Solutions(NamedTuple):
    """The four solutions for poses of shape (*batch), with an axis for the two forearms in front.

    Attributes:
      shoulders: angles of joints 1 to 3 for each of the two shoulders, (2, *batch) each [rad].
      q4: angle of joint 4, which all share, (1, *batch) [rad].
      wrist: angles of joints 5 and 6, which both shoulders share, (2, *batch) each [rad].
      valid: for each of the shoulders.
    """

    shoulders: tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]
    q4: Array
    wrist: tuple[Array, Array]
    valid: tuple[Array, Array]


def _solutions(T: Float[Array, "*batch 4 4"], q7: Float[Array, "*#batch"], arm: Arm) -> _Solutions:
    """See `inverse_kinematics`.

    Written in single coordinates: XLA fuses elementwise arithmetic into one GPU kernel, but not stacks and slices.
    """
    # The axis of the forearms has a length of 1 until they part.
    T, q7 = T[None], q7[None]
    x, y, z, p = ([T[..., row, column] for row in range(3)] for column in range(4))
    # Frame 6 has its x axis along the offset from the wrist centre to the axis of joint 7, its z axis on joint 6; its
    # y axis is -z of the gripper.
    c, s = jnp.cos(HAND_ANGLE + q7), jnp.sin(HAND_ANGLE + q7)
    x6 = [c * a - s * b for a, b in zip(x, y, strict=True)]
    z6 = [s * a + c * b for a, b in zip(x, y, strict=True)]
    wrist = [o - (FLANGE + FINGER_TIPS) * a - _WRIST * b for o, a, b in zip(p, z, x6, strict=True)]
    wrist[2] = wrist[2] - _SHOULDER

    square = _dot(wrist, wrist)
    distance = jnp.sqrt(jnp.maximum(square, 1e-6))
    bent = _arccos((_UPPER_SIDE**2 + _FORE_SIDE**2 - square) / (2.0 * _UPPER_SIDE * _FORE_SIDE))
    q4 = bent + (math.atan2(_UPPER, _OFFSET) + math.atan2(_FORE, _OFFSET) - 2.0 * math.pi)
    c4, s4 = jnp.cos(q4), jnp.sin(q4)

    # The forearm's axis z5 = sin(q6) x6 + cos(q6) y6 makes a known angle with the line from the wrist to the shoulder.
    along_x, along_y, along_z = -_dot(wrist, x6), _dot(wrist, z), -_dot(wrist, z6)
    span = jnp.sqrt(jnp.maximum(along_x * along_x + along_y * along_y, 1e-12))
    side = (square + (_FORE_SIDE**2 - _UPPER_SIDE**2)) / (2.0 * _FORE_SIDE)
    side = jax.lax.clamp(-distance, side, distance)
    height = jnp.sqrt(jnp.maximum(square - side * side, 0.0))
    opening = _arccos((height * (_OFFSET / _FORE_SIDE) - side * (_FORE / _FORE_SIDE)) / span)
    middle = jnp.arctan2(along_x, along_y)

    sign = np.array([1.0, -1.0], np.float32).reshape(2, *[1] * (q7.ndim - 1))
    centre = float(arm.lower[5] + arm.upper[5]) / 2
    q6 = middle + sign * opening
    q6 = q6 - 2.0 * math.pi * jax.lax.round((q6 - centre) / (2.0 * math.pi))
    c6, s6 = jnp.cos(q6), jnp.sin(q6)

    # The elbow lies in the plane of the forearm and the shoulder, off the forearm's axis towards the shoulder.
    off = c6 * along_x - s6 * along_y
    q5 = jnp.arctan2(along_z, off)
    c5, s5 = jnp.cos(q5), jnp.sin(q5)
    # Axes of frame 3, given in frame 6 with -y6 in place of y6, and from there in the base.
    c56, c5s6 = c5 * c6, c5 * s6
    x3 = c4 * c56 - s4 * s6, c4 * c5s6 + s4 * c6, c4 * s5
    y3 = s5 * c6, s5 * s6, -c5
    z3 = s4 * c56 + c4 * s6, s4 * c5s6 - c4 * c6, s4 * s5
    z3_x, z3_y, z3_z = (_dot(z3, axis) for axis in zip(x6, z, z6, strict=True))
    q1 = jnp.arctan2(z3_y, z3_x)
    c1, s1 = jnp.cos(q1), jnp.sin(q1)
    y1 = [c1 * axis[1] - s1 * axis[0] for axis in (x6, z, z6)]
    q2 = jnp.arctan2(c1 * z3_x + s1 * z3_y, z3_z)
    q3 = jnp.arctan2(_dot(x3, y1), _dot(y3, y1))

    # The rotation is right by construction. A pose out of reach shows in the plane of the forearm and the shoulder:
    # there the line from the wrist to the shoulder differs from the one that joint 4 gives.
    off = jnp.sqrt(off * off + along_z * along_z) - (_OFFSET - _OFFSET * c4 - _UPPER * s4)
    back = s6 * along_x + c6 * along_y + (_FORE - _OFFSET * s4 + _UPPER * c4)
    reached = (off * off + back * back < POSITION_TOLERANCE**2) & _within(arm, q4, 3) & _within(arm, q7, 6)
    reached &= _within(arm, q2, 1) & _within(arm, q5, 4) & _within(arm, q6, 5)
    # The other shoulder turns about the same axes to the same upper arm.
    other = _opposite(q1), -q2, _opposite(q3)
    shoulders = (q1, q2, q3), other
    valid = [reached & _within(arm, a[0], 0) & _within(arm, a[2], 2) for a in shoulders]
    return _Solutions(shoulders, q4, (q5, q6), (valid[0], valid[1]))


@functools.partial(jax.jit, static_argnames="arm")
def path_kinematics(
    T_base_gripper: Float[Numbers, "*batch waypoints 4 4"], q7: Float[Numbers, "*#batch"], arm: Arm = PANDA
) -> tuple[Float[Array, "*batch waypoints 7"], Bool[Array, "*batch"]]:
    """Joint angles along a path of gripper poses, with joint 7 at rest.

    One of the four solutions of `inverse_kinematics` is followed all the way: the one nearest to `HOME` on average, of
    those that are valid at every waypoint and in which no joint turns between neighbours by more than 0.1 rad plus
    6 rad for each metre and 3 rad for each radian of the hand's motion (a joint that does passes a singularity).

    Args:
      T_base_gripper: poses along the path in the base frame.
      q7: angle of joint 7 [rad].
      arm: whose limits hold; static.

    Returns:
      q: joint angles at the waypoints [rad]; finite, but meaningless, where the path is out of reach.
      reachable: whether there is such a solution.
    """
    q, reachable = path_joints(T_base_gripper, q7, arm)
    return jnp.stack(q, axis=-1), reachable


@functools.partial(jax.jit, static_argnames="arm")
def path_joints(
    T_base_gripper: Float[Numbers, "*batch waypoints 4 4"], q7: Float[Numbers, "*#batch"], arm: Arm = PANDA
) -> tuple[list[Float[Array, "*batch waypoints"]], Bool[Array, "*batch"]]:
    """`path_kinematics`, with one array of angles for each joint."""
    T = jnp.asarray(T_base_gripper, jnp.float32)
    q7 = jnp.broadcast_to(jnp.asarray(q7, jnp.float32), T.shape[:-3])
    four = _solutions(T, q7[..., None], arm)

    step = T[..., 1:, :3, :] - T[..., :-1, :3, :]
    step = step * step
    moved = jnp.sqrt(jnp.sum(step[..., 3], axis=-1))
    turned = jnp.sqrt(jnp.sum(step[..., :3], axis=(-2, -1)) / 2)
    allowed = (STEP_FLOOR + STEP_PER_METRE * moved + STEP_PER_RADIAN * turned)[None]
    # Joint 7 rests, and joint 2 turns as much in one shoulder as in the other.
    q5, q6 = four.wrist
    turn = jnp.maximum(jnp.maximum(_turn(four.q4), _turn(four.shoulders[0][1])), jnp.maximum(_turn(q5), _turn(q6)))
    detour = _detour(four.q4, 3) + _detour(q5, 4) + _detour(q6, 5)
    costs = []
    for (q1, q2, q3), valid in zip(four.shoulders, four.valid, strict=True):
        smooth = jnp.all(jnp.maximum(jnp.maximum(turn, _turn(q1)), _turn(q3)) < allowed, axis=-1)
        cost = detour + _detour(q1, 0) + _detour(q2, 1) + _detour(q3, 2)
        cost = jnp.sum(_or_never(valid, cost), axis=-1)
        costs.append(_or_never(smooth, cost))

    # The first of the cheapest, in the order of `inverse_kinematics`.
    other = _at_every_waypoint(costs[1] < costs[0], T.shape[-3])
    q = [jax.lax.select(other, b, a) for a, b in zip(*four.shoulders, strict=True)]
    cost = jnp.minimum(*costs)
    second = _at_every_waypoint(cost[1] < cost[0], T.shape[-3])
    q = [jax.lax.select(second, a[1], a[0]) for a in (*q, q5, q6)]
    q = [*q[:3], four.q4[0], *q[3:], _at_every_waypoint(q7, T.shape[-3])]
    return q, jnp.minimum(cost[0], cost[1]) < jnp.inf


def line_poses(
    T_base_gripper: Float[Numbers, "*batch 4 4"], distance: Float[Numbers, "*#batch"], waypoints: int
) -> Float[Array, "*batch waypoints 4 4"]:
    """Evenly spaced gripper poses on the straight approach to a pose, from `distance` [m] back along its z, inclusive.

    Raises:
      InputError: there are fewer than two waypoints.
    """
    ahead = still_ahead(waypoints)
    T = jnp.asarray(T_base_gripper, jnp.float32)
    distance = jnp.broadcast_to(jnp.asarray(distance, jnp.float32), T.shape[:-2])
    back = distance[..., None] * ahead.reshape(*[1] * distance.ndim, -1)
    return back_off(T[..., None, :, :], back)


def still_ahead(waypoints: int) -> Float[np.ndarray, " {waypoints}"]:
    """Remaining share of a straight approach at its evenly spaced poses, both ends included: from 1 to 0.

    Raises:
      InputError: there are fewer than two waypoints.
    """
    if waypoints < 2:
        raise InputError(f"straight approach: {waypoints} waypoints make no line; ask for at least 2")
    return np.linspace(1.0, 0.0, waypoints, dtype=np.float32)


def line_kinematics(
    T_base_gripper: Float[Numbers, "*batch 4 4"],
    distance: Float[Numbers, "*#batch"],
    q7: Float[Numbers, "*#batch"],
    waypoints: int,
) -> tuple[Float[Array, "*batch {waypoints} 7"], Bool[Array, "*batch"]]:
    """Joint angles along the straight approach to a pose: `path_kinematics` of `line_poses`.

    Args:
      T_base_gripper: pose of the gripper at the end of the approach, in the base frame.
      distance: length of the approach along the gripper's z [m].
      q7: angle of joint 7 [rad].
      waypoints: number of poses on the line, both ends included.

    Returns:
      q: joint angles [rad], the first row at the start of the approach, the last at the pose itself.
      reachable: whether one solution reaches all of them.

    Raises:
      InputError: there are fewer than two waypoints.
    """
    return path_kinematics(line_poses(T_base_gripper, distance, waypoints), q7)


def _pose(x: Array, y: Array, z: Array, p: Array) -> Array:
    """The 4 x 4 transform with the given axes and origin."""
    top = jnp.stack([x, y, z, p], axis=-1)
    bottom = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0]), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


def _at_every_waypoint(a: Array, count: int) -> Array:
    """The array repeated along a new last axis."""
    return jax.lax.broadcast_in_dim(a, (*a.shape, count), tuple(range(a.ndim)))


def _dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _within(arm: Arm, q: Array, joint: int) -> Array:
    """Whether angles of a joint lie within its limits."""
    low, high = float(arm.lower[joint]), float(arm.upper[joint])
    return jnp.abs(q) <= high if low == -high else (q >= low) & (q <= high)


def _opposite(q: Array) -> Array:
    return jax.lax.select(q > 0.0, q - math.pi, q + math.pi)


def _or_never(possible: Array, cost: Array) -> Array:
    """The cost where possible, else infinity."""
    return jax.lax.select(possible, cost, jnp.full_like(cost, jnp.inf))


def _turn(q: Array) -> Array:
    """How far a joint turns between neighbouring waypoints."""
    return jnp.abs(q[..., 1:] - q[..., :-1])


def _detour(q: Array, joint: int) -> Array:
    return jnp.square(q - float(HOME[joint]))


def _arccos(cosine: Array) -> Array:
    """`arccos` that clips its argument: poses out of reach are recognised otherwise."""
    cosine = jnp.minimum(jnp.maximum(cosine, -1.0), 1.0)
    return jnp.arctan2(jnp.sqrt((1.0 - cosine) * (1.0 + cosine)), cosine)
