"""The Panda's hand, fingers and arm as few primitives, and the point clouds of collision tests.

The boxes and capsules are fitted to the convex collision meshes of the maker's robot description: for the hand, the
fingers and links 6 and 7 the real surface lies inside their union and at most 8 mm beneath it; links 1 to 5 are wrapped
more loosely in capsules. The same primitives are the contact geometry of the simulator.

Frames: as in `kinematics`. The gripper frame has its origin between the finger tips, z along the approach, y along the
direction in which the fingers open. When joint 7 is at `q7`, links 6 and 7 are rigid with the hand.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.swept_cloud import SolidKey, cloud_of
from mechsearch_jax.robot import kinematics
from mechsearch_jax.robot.arm_config import PANDA, Arm
from mechsearch_jax.robot.kinematics import Numbers
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.shelf import Shelf, placed_spheres_hit_shelf

FINGER_BASE = 0.0584  # z of the fingers' frames in the hand frame [m]
LONGEST = 1.0  # largest opening or approach [m]
FINE = 0.5  # spacing of a cloud's points near the front, relative to the rest


@dataclasses.dataclass(frozen=True)
class Gripper:
    """The two-finger gripper, how it is used, and the arm that carries it [m].

    Attributes:
      max_opening: largest distance between the fingers.
      usable_opening: largest width of an object that may be grasped.
      approach: length of the straight approach and retreat along the gripper's z.
      outside: places outside the shelf, as x of the gripper in the world, ascending: an empty hand enters and leaves at
        the last; a held object is taken to the first that is reachable, where even the longest object is outside the
        shelf. See `entry`.
      front: clouds are dense where z in the gripper frame is above this.
      arm: that carries it; a `Workcell` sets it by its `ArmConfig.model`.
    """

    max_opening: float = 0.08
    usable_opening: float = 0.075
    approach: float = 0.3
    outside: tuple[float, ...] = (0.26, 0.3, 0.34, 0.374)
    front: float = -0.08
    arm: Arm = PANDA

    def __post_init__(self):
        for field in ("max_opening", "usable_opening", "approach"):
            if not 0 < getattr(self, field) <= LONGEST:
                raise InputError(
                    f"Gripper: {field} ({getattr(self, field)}) must be positive, in metres, at most {LONGEST}"
                )
        if not self.outside or list(self.outside) != sorted(self.outside):
            raise InputError(f"Gripper: outside {self.outside} must be one or more places in ascending order")
        if self.usable_opening > self.max_opening:
            raise InputError(
                f"Gripper: usable_opening ({self.usable_opening}) must not exceed max_opening ({self.max_opening})"
            )

    def __repr__(self) -> str:
        # Searches are saved with a digest of this text; those of a Panda go on, which had no arm in it.
        names = [field.name for field in dataclasses.fields(self) if field.name != "arm" or self.arm != PANDA]
        return f"Gripper({', '.join(f'{name}={getattr(self, name)!r}' for name in names)})"

    @property
    def nearest_outside(self) -> float:
        """The place outside that is nearest to the shelf [m]."""
        return self.outside[-1]


@dataclasses.dataclass(frozen=True, eq=False)
class RobotPart:
    """A box or a capsule in the frame of a link.

    Attributes:
      kind: "box" or "capsule".
      size: half-extents of a box (3), or radius and half length (2) of a capsule along its own z, caps excluded [m].
      T_frame_primitive: its pose in the link's frame, shape (4, 4), float64.
    """

    kind: Literal["box", "capsule"]
    size: tuple[float, ...]
    T_frame_primitive: np.ndarray


def _box(
    half_size: tuple[float, float, float],
    centre: tuple[float, float, float],
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> RobotPart:
    """A box from its half-extents, centre and orientation (w, x, y, z)."""
    import trimesh

    return RobotPart("box", half_size, _pose(trimesh.transformations.quaternion_matrix(quaternion), centre))


def _capsule(radius: float, start: tuple[float, float, float], end: tuple[float, float, float]) -> RobotPart:
    """A capsule from its radius and the ends of its axis."""
    import trimesh

    axis = np.subtract(end, start)
    rotation = trimesh.geometry.align_vectors((0.0, 0.0, 1.0), axis)
    return RobotPart("capsule", (radius, float(np.linalg.norm(axis)) / 2), _pose(rotation, np.add(start, end) / 2))


def _pose(rotation: Any, origin: Any) -> np.ndarray:
    """A rotation, given as a 4 x 4 transform, with an origin."""
    pose = np.array(rotation)
    pose[:3, 3] = origin
    return pose


@functools.cache
def hand_parts() -> tuple[RobotPart, ...]:
    """The primitives of the hand without its fingers, in its frame."""
    return (
        _box((0.01129, 0.04649, 0.01977), (-0.00572, -0.05382, -0.0075), (0.32851, -0.03161, 0.9438, -0.01807)),
        _box((0.01961, 0.06294, 0.03174), (-0.00005, 0.00793, 0.0138), (0.02888, 0.70797, -0.02897, -0.70506)),
        _box((0.01492, 0.0463, 0.02958), (0.00831, -0.05895, 0.01312), (0.99484, -0.01118, 0.05441, -0.08495)),
        _box((0.02373, 0.10127, 0.03188), (-0.00051, -0.00013, 0.03583), (0.99995, 0.0087, -0.00375, -0.0006)),
        _box((0.02673, 0.05606, 0.03078), (-0.00004, 0.03764, 0.01604), (-0.06087, 0.99814, 0.00043, 0.00154)),
    )


@functools.cache
def finger_parts() -> tuple[RobotPart, ...]:
    """The primitives of the left finger, in its own frame."""
    return (
        _box((0.0108, 0.0076, 0.0273), (0.0, 0.0073, 0.0270)),
        _box((0.0108, 0.005, 0.0182), (0.0, 0.0152, 0.0345), (0.9886, 0.1508, 0.0, 0.0)),
        _box((0.0108, 0.0135, 0.0102), (0.0, 0.0132, 0.01)),
    )


@functools.cache
def link_parts() -> tuple[tuple[RobotPart, ...], ...]:
    """The primitives of links 1 to 7, each in its own frame."""
    return (
        (
            _capsule(0.07155, (0.00141, -0.01398, -0.14142), (-0.00037, -0.04212, -0.00193)),
            _capsule(0.03295, (-0.03801, -0.00133, -0.1751), (-0.0044, 0.03718, -0.1746)),
            _capsule(0.05628, (0.01556, 0.00741, -0.15736), (-0.00334, -0.08696, -0.00371)),
        ),
        (
            _capsule(0.07369, (0.00036, -0.03256, 0.04395), (-0.00009, -0.14886, 0.00003)),
            _capsule(0.07138, (-0.001, -0.00234, 0.03809), (0.0, -0.00352, 0.06165)),
        ),
        (
            _capsule(0.07045, (0.08243, 0.04239, -0.00006), (0.01428, 0.00831, -0.06747)),
            _capsule(0.03409, (-0.00868, 0.03646, -0.10118), (-0.03492, -0.00002, -0.10157)),
            _capsule(0.03391, (0.02724, -0.0275, -0.10228), (-0.02111, -0.02835, -0.10221)),
        ),
        (
            _capsule(0.03528, (-0.09881, 0.10426, -0.03038), (-0.04961, 0.10394, -0.02364)),
            _capsule(0.03481, (-0.11789, 0.10508, -0.00345), (-0.09068, 0.10515, 0.03865)),
            _capsule(0.07092, (-0.0689, 0.06985, 0.0081), (-0.00009, 0.00013, 0.04226)),
        ),
        (
            _capsule(0.0572, (0.0001, 0.0, -0.2462), (0.0002, 0.0404, -0.0028)),
            _capsule(0.0572, (0.0004, 0.027, -0.2177), (0.0003, 0.0828, -0.0027)),
        ),
        (
            _box((0.03003, 0.03832, 0.03168), (0.10187, -0.01343, -0.00309), (0.99328, -0.00342, 0.11567, 0.00318)),
            _box((0.02344, 0.03959, 0.02744), (0.08156, 0.04066, -0.00917), (0.99431, -0.05223, 0.04435, -0.08157)),
            _box((0.04028, 0.03837, 0.00542), (-0.00839, -0.00951, -0.01476), (0.99872, 0.00396, 0.04986, -0.007)),
            _box((0.0464, 0.05037, 0.02033), (0.02026, 0.00959, -0.01022), (0.97765, 0.01815, 0.07186, 0.19676)),
            _box((0.04083, 0.04002, 0.04438), (0.07839, -0.01179, 0.00207), (0.99372, 0.00087, 0.11191, 0.0018)),
            _capsule(0.04735, (0.06704, 0.04147, 0.00538), (0.08893, 0.03747, 0.00176)),
            _capsule(0.04461, (0.03814, 0.0288, 0.01262), (-0.01039, 0.00071, 0.01471)),
            _capsule(0.04526, (-0.00377, -0.00913, 0.01384), (0.03818, -0.00906, 0.01777)),
            _capsule(0.02457, (0.0269, -0.03191, -0.01215), (0.0088, -0.02828, 0.00533)),
        ),
        (
            _box((0.02548, 0.01692, 0.02809), (-0.01693, -0.02312, 0.07797), (0.95002, -0.06056, 0.02416, -0.30531)),
            _box((0.03753, 0.02851, 0.01536), (0.04415, 0.04421, 0.07774), (0.89954, 0.21258, -0.08736, -0.37149)),
            _box((0.03858, 0.04412, 0.02513), (0.00491, 0.00486, 0.07679), (0.9246, -0.00109, 0.0018, 0.38094)),
            _box((0.03757, 0.05097, 0.01686), (0.0136, 0.01379, 0.09039), (0.92302, -0.01228, 0.00681, -0.38448)),
            _box((0.02695, 0.026, 0.02581), (-0.01714, -0.0144, 0.07612), (0.98562, 0.07825, -0.05998, 0.13722)),
        ),
    )


def fingers(opening: float) -> tuple[RobotPart, ...]:
    """Both fingers, `opening` m apart, in the hand frame."""
    left = np.eye(4)
    left[:3, 3] = (0.0, opening / 2, FINGER_BASE)
    right = np.diag([-1.0, -1.0, 1.0, 1.0])
    right[:3, 3] = (0.0, -opening / 2, FINGER_BASE)
    return tuple(
        dataclasses.replace(part, T_frame_primitive=T @ part.T_frame_primitive)
        for T in (left, right)
        for part in finger_parts()
    )


def primitives_in_gripper(gripper: Gripper, opening: float, q7: float) -> tuple[RobotPart, ...]:
    """The primitives of the hand, both fingers, link 7 and link 6, with their poses in the gripper frame.

    Args:
      gripper: the gripper.
      opening: distance between the fingers [m].
      q7: angle of joint 7 [rad].

    Raises:
      InputError: the opening is negative or larger than the gripper's.
    """
    if not 0.0 <= opening <= gripper.max_opening:
        raise InputError(f"Gripper: opening {opening} m must be between 0 and {gripper.max_opening}")
    T_gripper_hand = _moved(np.eye(4), z=-kinematics.FINGER_TIPS)
    T_gripper_left = _moved(T_gripper_hand, y=opening / 2, z=FINGER_BASE)
    T_gripper_right = _moved(T_gripper_hand, y=-opening / 2, z=FINGER_BASE) @ _rotation(math.pi, "z")
    T_gripper_link7 = _moved(T_gripper_hand, z=-kinematics.FLANGE) @ _rotation(-kinematics.HAND_ANGLE, "z")
    T_link7_link6 = _moved(_rotation(-q7, "z"), x=-kinematics.JOINTS[6][0]) @ _rotation(-math.pi / 2, "x")
    bodies = (
        (T_gripper_hand, hand_parts()),
        (T_gripper_left, finger_parts()),
        (T_gripper_right, finger_parts()),
        (T_gripper_link7, link_parts()[6]),
        (T_gripper_link7 @ T_link7_link6, link_parts()[5]),
    )
    return tuple(
        dataclasses.replace(primitive, T_frame_primitive=T @ primitive.T_frame_primitive)
        for T, primitives in bodies
        for primitive in primitives
    )


def gripper_cloud(
    gripper: Gripper, opening: float, q7: float, count: int, seed: int = 0
) -> Float[np.ndarray, "{count} 3"]:
    """`count` points spread over the surface of the hand, both fingers, link 7 and link 6: `swept_cloud` at rest."""
    return swept_cloud(gripper, opening, q7, count, 0.0, seed)


def swept_cloud(
    gripper: Gripper, opening: float, q7: float, count: int, distance: float | None = None, seed: int = 0
) -> Float[np.ndarray, "{count} 3"]:
    """Points spread over the surface of the volume that the gripper sweeps on a straight approach.

    A convex primitive sweeps the convex hull of its start and its end. The cloud covers the boundary of the union of
    these hulls, twice as densely near the fingers and the front of the hand as behind.

    Args:
      gripper: the gripper.
      opening: distance between the fingers [m].
      q7: angle of joint 7 [rad].
      count: number of points.
      distance: length of the approach along z, which ends at the frame [m]; `gripper.approach` by default.
      seed: equal seeds give equal points.

    Returns:
      points in the gripper frame [m], float32; the first n cover the whole surface for every n, more coarsely.

    Raises:
      InputError: the opening is out of range, the distance negative, or the count below 1.
    """
    distance = gripper.approach if distance is None else distance
    if distance < 0.0 or count < 1:
        raise InputError(f"swept_cloud: distance ({distance} m) must not be negative, count ({count}) at least 1")
    return _sampled(gripper, float(opening), float(q7), int(count), float(distance), int(seed)).copy()


@functools.cache
def _sampled(
    gripper: Gripper, opening: float, q7: float, count: int, distance: float, seed: int
) -> Float[np.ndarray, "{count} 3"]:
    """`swept_cloud` of checked arguments; cached, because several tables of a problem need the same clouds."""
    primitives = primitives_in_gripper(gripper, opening, q7)
    solids: list[SolidKey] = [(p.kind, p.size, p.T_frame_primitive.tobytes()) for p in primitives]
    return cloud_of(tuple(solids), gripper.front, FINE, count, distance, seed)


def arm_points(q: Float[Numbers, "*batch 7"], count: int) -> tuple[Float[Array, "*batch n 3"], Float[Array, " n"]]:
    """Points along the axes of the capsules of links 2 to 5, in the base frame.

    Args:
      q: joint angles [rad].
      count: number of points on each capsule, its ends included; at least 2.

    Returns:
      points: centres of spheres that fill the capsules, up to dents between the spheres [m].
      radii: of the spheres [m].
    """
    sums, radii = _spheres(count)
    return jnp.moveaxis(_centres([jnp.asarray(q)[..., joint] for joint in range(5)], sums), 0, -1), jnp.asarray(radii)


@functools.cache
def _spheres(count: int) -> tuple[Float[np.ndarray, "k n"], Float[np.ndarray, " n"]]:
    """The spheres of `arm_points`: their centres as sums of `kinematics.turned_axes`, and their radii [m]."""
    sums, radii = [], []
    for link in range(1, 5):
        frame = kinematics.frame_in_turned_axes(link)
        for capsule in link_parts()[link]:
            radius, half = capsule.size
            z = np.linspace(-half, half, count)[:, None]
            points = capsule.T_frame_primitive[:3, 3] + z * capsule.T_frame_primitive[:3, 2]
            sums.append(np.pad(points @ frame[:3] + frame[3], ((0, 0), (0, 10 - frame.shape[1]))))
            radii.append(np.full(count, radius))
    return np.concatenate(sums).T.astype(np.float32), np.concatenate(radii).astype(np.float32)


def _centres(q: Sequence[Float[Array, "*batch"]], sums: Float[np.ndarray, "k n"]) -> Float[Array, "3 *batch n"]:
    """Points given as sums of `kinematics.turned_axes`, in the base frame."""
    axes = kinematics.turned_axes(q[: len(sums) // 2])
    rank = axes[0].ndim
    terms = [
        axis[..., None] * share.reshape(*[1] * rank, -1) for axis, share in zip(axes, sums, strict=True) if share.any()
    ]
    shoulder = np.array([0.0, 0.0, kinematics.JOINTS[0][2]], np.float32).reshape(3, *[1] * rank)
    # Written out: a CPU takes ten times as long for a sum over an axis in the middle.
    return functools.reduce(jnp.add, terms) + shoulder


@functools.partial(jax.jit, static_argnames=("count",))
def arm_hits_shelf(q: Float[Numbers, "*batch 7"], shelf: Shelf, count: int = 5) -> Bool[Array, "*batch"]:
    """Whether links 2 to 5 touch the shelf or come closer to it than the planner's margins.

    All that is beyond the plane of the shelf's front and outside its free space counts as solid.

    Args:
      q: joint angles [rad].
      shelf: the shelf.
      count: spheres for each capsule, see `arm_points`.
    """
    q = jnp.asarray(q, jnp.float32)
    return jnp.any(joints_hit_shelf([q[..., joint] for joint in range(5)], shelf, count), axis=-1)


def joints_hit_shelf(q: Sequence[Float[Array, "*batch"]], shelf: Shelf, count: int = 5) -> Bool[Array, "*batch n"]:
    """Which of the spheres about `arm_points` touch the shelf, for angles of each joint in an array of their own."""
    sums, radii = _spheres(count)
    x, y, z = _centres(q, sums)
    return placed_spheres_hit_shelf(shelf, x, y, z, jnp.asarray(radii))


def _moved(T: np.ndarray, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """A pose moved along its own axes."""
    return T @ _pose(np.eye(4), (x, y, z))


def _rotation(angle: float, axis: Literal["x", "y", "z"]) -> np.ndarray:
    import trimesh

    return trimesh.transformations.rotation_matrix(angle, np.eye(3)["xyz".index(axis)])
