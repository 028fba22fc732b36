"""Forward and inverse kinematics of the Franka Emika Panda, in closed form and batched.

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

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.errors import InputError

Numbers = Array | np.ndarray

JOINT_LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973], np.float32)
JOINT_UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973], np.float32)
# What the maker allows each joint: velocity [rad/s], acceleration [rad/s2], jerk [rad/s3].
VELOCITY_LIMIT = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61], np.float32)
ACCELERATION_LIMIT = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0], np.float32)
JERK_LIMIT = 500.0 * ACCELERATION_LIMIT
HOME = np.array([0.0301, -1.4702, 0.0279, -2.4376, 0.1466, 2.3087, 0.7012], np.float32)

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
ROTATION_TOLERANCE = 1e-3
# How far a joint may turn between neighbouring waypoints of a path [rad]: at rest, and for each metre and radian moved.
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


def link_frames(q: Float[Numbers, "*batch 7"], links: Sequence[int]) -> Float[Array, "*batch n 4 3"]:
    """Axes x, y and z and the origin of a few links in the base frame, counted from 0, for joint angles `q` [rad]."""
    frames = _frames(jnp.asarray(q, jnp.float32))
    return jnp.stack([jnp.stack(frames[link], axis=-2) for link in links], axis=-3)


def gripper_pose(q: Float[Numbers, "*batch 7"]) -> Float[Array, "*batch 4 4"]:
    """Pose of the gripper in the base frame, `T_base_gripper`, for joint angles `q` [rad]."""
    x, y, z, p = _frames(jnp.asarray(q, jnp.float32))[-1]
    return _pose(x, y, z, p + FINGER_TIPS * z)


@jax.jit
def inverse_kinematics(
    T_base_gripper: Float[Numbers, "*batch 4 4"], q7: Float[Numbers, "*#batch"]
) -> tuple[Float[Array, "*batch 4 7"], Bool[Array, "*batch 4"]]:
    """All joint angles with a bent elbow that reach a pose with joint 7 at a given angle, in closed form.

    The elbow is taken as bent by at least 27 degrees, the outer edge of the reach; the almost straight arm reaches
    nothing more.

    Args:
      T_base_gripper: pose of the gripper in the base frame.
      q7: angle of joint 7 [rad].

    Returns:
      q: four solutions (two forearms times two shoulders, always in the same order) [rad]. Where there is none, the
        numbers are finite but mean nothing.
      valid: which solutions lie within the joint limits and reproduce the pose to 1e-4 m and 1e-3 rad.
    """
    T = jnp.asarray(T_base_gripper, jnp.float32)
    q7 = jnp.broadcast_to(jnp.asarray(q7, jnp.float32), T.shape[:-2])

    # Frame 6 has its x axis along the offset from the wrist centre to the axis of joint 7, its z axis on joint 6.
    turn = (HAND_ANGLE + q7)[..., None]
    x6 = jnp.cos(turn) * T[..., :3, 0] - jnp.sin(turn) * T[..., :3, 1]
    y6 = -T[..., :3, 2]
    z6 = jnp.cross(x6, y6)
    wrist = T[..., :3, 3] + (FLANGE + FINGER_TIPS) * y6 - _WRIST * x6

    to_shoulder = _batch(np.array([0.0, 0.0, _SHOULDER], np.float32), wrist.ndim) - wrist
    distance = jnp.sqrt(jnp.maximum(_dot(to_shoulder, to_shoulder), 1e-6))
    at_elbow = _triangle_angle(_UPPER_SIDE, _FORE_SIDE, distance)
    at_wrist = _triangle_angle(_FORE_SIDE, distance, _UPPER_SIDE)
    q4 = at_elbow + math.atan2(_UPPER, _OFFSET) + math.atan2(_FORE, _OFFSET) - 2.0 * math.pi

    # The forearm's axis z5 = sin(q6) x6 + cos(q6) y6 makes a known angle with the line from the wrist to the shoulder.
    along_x, along_y = _dot(to_shoulder, x6), _dot(to_shoulder, y6)
    span = jnp.sqrt(jnp.maximum(along_x**2 + along_y**2, 1e-12))
    opening = _arccos(-distance * jnp.cos(at_wrist + math.atan2(_OFFSET, _FORE)) / span)
    middle = jnp.arctan2(along_x, along_y)
    q6 = jnp.stack([middle + opening, middle - opening], axis=-1)
    centre = float(JOINT_LOWER[5] + JOINT_UPPER[5]) / 2
    q6 = jnp.mod(q6 - centre + math.pi, 2.0 * math.pi) - math.pi + centre

    x6, y6, z6, to_shoulder = (v[..., None, :] for v in (x6, y6, z6, to_shoulder))
    c, s = jnp.cos(q6)[..., None], jnp.sin(q6)[..., None]
    x5, y5, z5 = c * x6 - s * y6, -z6, s * x6 + c * y6

    # The elbow lies in the plane of the forearm and the shoulder, off the forearm's axis towards the shoulder.
    x4 = _normalised(to_shoulder - _dot(to_shoulder, z5)[..., None] * z5)
    q5 = jnp.arctan2(-_dot(x4, y5), _dot(x4, x5))
    q4 = jnp.broadcast_to(q4[..., None], q5.shape)
    c, s = jnp.cos(q4)[..., None], jnp.sin(q4)[..., None]
    y4 = z5
    x3, y3, z3 = c * x4 - s * y4, -jnp.cross(x4, y4), s * x4 + c * y4

    yaw = jnp.arctan2(z3[..., 1], z3[..., 0])
    q1 = jnp.stack([yaw, jnp.where(yaw > 0.0, yaw - math.pi, yaw + math.pi)], axis=-1)
    c, s = jnp.cos(q1), jnp.sin(q1)
    x3, y3, z3 = (v[..., None, :] for v in (x3, y3, z3))
    q2 = jnp.arctan2(c * z3[..., 0] + s * z3[..., 1], jnp.broadcast_to(z3[..., 2], c.shape))
    q3 = jnp.arctan2(c * x3[..., 1] - s * x3[..., 0], c * y3[..., 1] - s * y3[..., 0])

    q4, q5, q6 = (jnp.broadcast_to(angle[..., None], q1.shape) for angle in (q4, q5, q6))
    q7 = jnp.broadcast_to(q7[..., None, None], q1.shape)
    q = jnp.stack([q1, q2, q3, q4, q5, q6, q7], axis=-1).reshape(*T.shape[:-2], 4, 7)

    error = gripper_pose(q) - T[..., None, :, :]
    moved = jnp.sqrt(jnp.sum(error[..., :3, 3] ** 2, axis=-1))
    turned = jnp.sqrt(jnp.sum(error[..., :3, :3] ** 2, axis=(-2, -1)) / 2)
    within = jnp.all((q >= _batch(JOINT_LOWER, q.ndim)) & (q <= _batch(JOINT_UPPER, q.ndim)), axis=-1)
    return q, within & (moved < POSITION_TOLERANCE) & (turned < ROTATION_TOLERANCE)


@jax.jit
def path_kinematics(
    T_base_gripper: Float[Numbers, "*batch waypoints 4 4"], q7: Float[Numbers, "*#batch"]
) -> tuple[Float[Array, "*batch waypoints 7"], Bool[Array, "*batch"]]:
    """Joint angles along a path of gripper poses, with joint 7 at rest.

    One of the four solutions of `inverse_kinematics` is followed all the way: the one nearest to `HOME` on average, of
    those that are valid at every waypoint and in which no joint turns between neighbours by more than 0.1 rad plus
    6 rad for each metre and 3 rad for each radian of the hand's motion (a joint that does passes a singularity).

    Args:
      T_base_gripper: poses along the path in the base frame.
      q7: angle of joint 7 [rad].

    Returns:
      q: joint angles at the waypoints [rad]; finite, but meaningless, where the path is out of reach.
      reachable: whether there is such a solution.
    """
    T = jnp.asarray(T_base_gripper, jnp.float32)
    q7 = jnp.broadcast_to(jnp.asarray(q7, jnp.float32), T.shape[:-3])
    q, valid = inverse_kinematics(T, jnp.broadcast_to(q7[..., None], T.shape[:-2]))

    step = jnp.diff(T, axis=-3)
    moved = jnp.sqrt(jnp.sum(step[..., :3, 3] ** 2, axis=-1))
    turned = jnp.sqrt(jnp.sum(step[..., :3, :3] ** 2, axis=(-2, -1)) / 2)
    allowed = STEP_FLOOR + STEP_PER_METRE * moved + STEP_PER_RADIAN * turned
    smooth = jnp.all(jnp.abs(jnp.diff(q, axis=-3)) < allowed[..., None, None], axis=(-3, -1))
    reachable = jnp.all(valid, axis=-2) & smooth

    detour = jnp.sum((q - _batch(HOME, q.ndim)) ** 2, axis=(-3, -1))
    best = jnp.argmin(jnp.where(reachable, detour, jnp.inf), axis=-1)
    q = jnp.take_along_axis(q, best[..., None, None, None], axis=-2)[..., 0, :]
    return q, jnp.any(reachable, axis=-1)


def line_poses(
    T_base_gripper: Float[Numbers, "*batch 4 4"], distance: Float[Numbers, "*#batch"], waypoints: int
) -> Float[Array, "*batch waypoints 4 4"]:
    """Evenly spaced gripper poses on the straight approach to a pose, from `distance` [m] back along its z, inclusive.

    Raises:
      InputError: there are fewer than two waypoints.
    """
    if waypoints < 2:
        raise InputError(f"line_poses: {waypoints} waypoints make no line; ask for at least 2")
    T = jnp.asarray(T_base_gripper, jnp.float32)
    distance = jnp.broadcast_to(jnp.asarray(distance, jnp.float32), T.shape[:-2])
    back = distance[..., None] * _batch(np.linspace(1.0, 0.0, waypoints, dtype=np.float32), distance.ndim + 1)
    line = jnp.broadcast_to(T[..., None, :, :], (*T.shape[:-2], waypoints, 4, 4))
    return line.at[..., :3, 3].add(-back[..., None] * T[..., None, :3, 2])


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


def _batch(constant: np.ndarray, rank: int) -> Array:
    """A constant with as many axes as what it is combined with."""
    return jnp.asarray(constant).reshape((1,) * (rank - constant.ndim) + constant.shape)


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=-1)


def _normalised(a: Array) -> Array:
    return a / jnp.sqrt(jnp.maximum(_dot(a, a), 1e-12))[..., None]


def _arccos(cosine: Array) -> Array:
    """`arccos` that clips its argument: what is out of reach is recognised by the pose that it gives."""
    cosine = jnp.clip(cosine, -1.0, 1.0)
    return jnp.arctan2(jnp.sqrt((1.0 - cosine) * (1.0 + cosine)), cosine)


def _triangle_angle(a: Array | float, b: Array | float, opposite: Array | float) -> Array:
    """The angle between the sides `a` and `b` of a triangle."""
    return _arccos(jnp.asarray((a * a + b * b - opposite * opposite) / (2.0 * a * b)))
