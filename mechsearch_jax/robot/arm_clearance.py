"""Distance of the whole arm from the shelf, objects and itself at any joint angles, for free motions.

Every primitive of links 1 to 7, the hand, the fingers and the held object is covered by spheres, which reach at most
`CELL` / 2 beyond it; objects are represented by their bounding boxes, other obstacles as they are. So distances are
never too large, and up to about 1 cm too small. The planner's tests only cover straight approaches with a fixed wrist
inside the shelf; here any joint may turn. NumPy suffices: a few milliseconds for a path.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mechsearch_jax.geometry.superquadric import ROUND_EXPONENT, Superquadrics
from mechsearch_jax.robot import kinematics
from mechsearch_jax.robot.gripper import RobotPart, fingers, hand_parts, link_parts
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.obstacle import Obstacle
from mechsearch_jax.workspace.shelf import Shelf

# Edge of the cells into which boxes are divided, with a sphere around each [m]. Coarse cells are for self-collisions,
# since the hand is usually far from the arm.
CELL, COARSE_CELL = 0.03, 0.06
# Larger distances are clipped to this [m].
FARTHEST = 0.2
# Joint angles that are evaluated together, so that one compiled function serves all paths.
BLOCK = 64
# The foot of the robot, which no primitive covers: a capsule about the axis of joint 1 [m].
FOOT = ((0.0, 0.0, 0.06), (0.0, 0.0, 0.333), 0.08)
HAND_FRAME = 7
# In an image, what is this near to the arm may be the arm: the primitives' error and the camera's [m].
AROUND = 0.02
# What there is beside objects and obstacles.
ALWAYS = ITSELF, FLOOR, SHELF = ("itself", "the floor", "the shelf")
TARGET = "the target"


class Spheres(NamedTuple):
    """Spheres fixed in frames of `forward_kinematics`.

    Attributes:
      frame: of each, ascending, shape (n,).
      centre: in that frame [m], shape (n, 3).
      radius: [m], shape (n,).
      edges: of the box's cell inside it, as columns in that frame [m]; zeros if it covers a capsule. Shape (n, 3, 3).
    """

    frame: Int[np.ndarray, " n"]
    centre: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, " n"]
    edges: Float[np.ndarray, "n 3 3"]


@dataclasses.dataclass(frozen=True, eq=False)
class Held:
    """The object in the closed hand, as a box, or a cylinder about its z.

    Attributes:
      T_gripper_held: its pose in the gripper frame, shape (4, 4).
      half_size: half-extents [m].
      round: whether it is a cylinder.
    """

    T_gripper_held: np.ndarray
    half_size: tuple[float, float, float]
    round: bool = False

    @classmethod
    def of(cls, T_gripper_held: np.ndarray, size: tuple[float, float, float], exponents: tuple[float, float]) -> Held:
        """A superquadric in the hand."""
        (half_size,), (is_round,) = bounds(np.array([size], float), np.array([exponents], float))
        x, y, z = half_size.tolist()
        return cls(T_gripper_held, (x, y, z), bool(is_round))


@dataclasses.dataclass(frozen=True, eq=False)
class ArmBody:
    """The arm with a certain opening of its fingers, and the held object, if any.

    Attributes:
      fine: spheres around all of it.
      coarse: fewer and larger spheres around links 6 and 7, the hand, the fingers and the held object.
    """

    fine: Spheres
    coarse: Spheres

    @classmethod
    def of(cls, opening: float, held: Held | None = None) -> ArmBody:
        """The arm with `opening` m between the fingers."""
        extra = ((HAND_FRAME, _in_hand(held)),) if held else ()
        bodies = (
            *((i, link_parts()[i]) for i in range(7)),
            (HAND_FRAME, hand_parts()),
            (HAND_FRAME, fingers(opening)),
            *extra,
        )
        return cls(_spheres(bodies, CELL), _spheres(bodies[5:], COARSE_CELL))


@dataclasses.dataclass(frozen=True, eq=False)
class Obstacles:
    """What the arm must not touch.

    Attributes:
      shelf: with the planner's margins; everything beyond its front plane and outside its free space is solid.
      half_size: of what bounds the objects, and of obstacles [m], shape (n, 3); see `bounds`.
      T_box_world: inverse poses of the boxes, shape (n, 4, 4).
      floor: height of the floor [m].
      names: how messages call what there is: the arm itself, the floor, the shelf, and each of the n.
      round: which of the n are no boxes but cylinders about z.
    """

    shelf: Shelf
    half_size: Float[np.ndarray, "n 3"]
    T_box_world: Float[np.ndarray, "n 4 4"]
    floor: float
    names: tuple[str, ...]
    round: tuple[bool, ...]

    @classmethod
    def of(
        cls,
        shelf: Shelf,
        scenes: tuple[Superquadrics, ...] = (),
        floor: float = 0.0,
        *,
        target: tuple[Superquadrics, ...] = (),
        bodies: tuple[Obstacle, ...] = (),
    ) -> Obstacles:
        """The shelf, the valid objects of scenes with fields (N, ...), those that the target is made of, and others."""
        sizes: list[np.ndarray] = [np.zeros((0, 3))]
        round_ones: list[bool] = []
        poses: list[np.ndarray] = [np.zeros((0, 4, 4))]
        names = [*ALWAYS]
        for scene in (*scenes, *target):
            valid = np.asarray(scene.valid)
            pose = np.tile(np.eye(4), (int(valid.sum()), 1, 1))
            pose[:, :3, :3] = np.asarray(scene.rotation, float)[valid]
            pose[:, :3, 3] = np.asarray(scene.position, float)[valid]
            half_size, are_round = bounds(*(np.asarray(a, float)[valid] for a in (scene.size, scene.exponents)))
            sizes.append(half_size)
            round_ones += are_round.tolist()
            poses.append(np.linalg.inv(pose))
            is_target = any(scene is other for other in target)
            names += [TARGET if is_target else f"object {i}" for i in np.flatnonzero(valid)]
        for body in bodies:
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = body.rotation, body.position
            sizes.append(np.array(body.size, float)[None] / 2)
            poses.append(np.linalg.inv(pose)[None])
            round_ones.append(body.shape == "cylinder")
            names.append(f'obstacle "{body.name}"')
        half_size, inverse = (np.concatenate(rows).astype(np.float32) for rows in (sizes, poses))
        return cls(shelf, half_size, inverse, floor, tuple(names), tuple(round_ones))

    @property
    def bare(self) -> Obstacles:
        """Without objects, target and other bodies."""
        return Obstacles.of(self.shelf, floor=self.floor)


def bounds(
    size: Float[np.ndarray, "n 3"], exponents: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Half-extents of a box, or of a cylinder about z, around superquadrics [m], and which of them are cylinders.

    Round ones of nearly a circle are; at e2 below 1 the circle has to go through what is left of corners.
    """
    x, y, e2 = size[:, 0], size[:, 1], exponents[:, 1]
    across = np.maximum(x, y)
    are_round = (e2 > ROUND_EXPONENT) & (e2 < 1.0 + ROUND_EXPONENT) & (np.minimum(x, y) > 0.8 * across)
    # Beyond 1 the corners are at the axes' ends.
    radius = across * 2.0 ** ((1.0 - np.minimum(e2, 1.0)) / 2.0)
    around = np.stack([radius, radius, size[:, 2]], axis=1)
    return np.where(are_round[:, None], around, size), are_round


class Clearance(NamedTuple):
    """Clearance of m configurations of the arm.

    Attributes:
      free: distance to the nearest obstacle, or of the hand from the arm's foot and upper arm, at most `FARTHEST`;
        0 or less where the arm may touch [m], shape (m,).
      inside: how far the arm reaches beyond the plane of the shelf's front; negative in front of it [m], shape (m,).
      each: distance to each of `Obstacles.names`; `free` is the least of them [m], shape (m, n).
    """

    free: Float[np.ndarray, " m"]
    inside: Float[np.ndarray, " m"]
    each: Float[np.ndarray, "m n"]


def clearance(body: ArmBody, obstacles: Obstacles, q: Float[np.ndarray, "m 7"]) -> Clearance:
    """The clearance of the arm at joint angles `q` [rad]."""
    parts = [_block_clearance(body, obstacles, q[i : i + BLOCK]) for i in range(0, len(q), BLOCK)]
    return Clearance(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def touched(obstacles: Obstacles, each: Float[np.ndarray, "m n"]) -> str:
    """What the arm reaches into the deepest, and how deep, from `Clearance.each`, in words."""
    nearest = int(np.argmin(each.min(axis=0)))
    return f"{obstacles.names[nearest]} ({-1000 * float(each[:, nearest].min()):.0f} mm deep)"


def link_poses(q: Float[np.ndarray, "m 7"]) -> Float[np.ndarray, "m 8 4 4"]:
    """`kinematics.forward_kinematics` by blocks of `BLOCK` rows, so that it is compiled only once."""
    parts = []
    for i in range(0, len(q), BLOCK):
        rows = q[i : i + BLOCK]
        padded = np.concatenate([rows, np.repeat(rows[-1:], BLOCK - len(rows), axis=0)])
        parts.append(np.asarray(kinematics.forward_kinematics(padded.astype(np.float32)))[: len(rows)])
    return np.concatenate(parts)


def tip_positions(q: Float[np.ndarray, "m 7"]) -> Float[np.ndarray, "m 3"]:
    """Position of the point between the finger tips [m]."""
    hand = link_poses(q)[:, HAND_FRAME]
    return hand[:, :3, 3] + kinematics.FINGER_TIPS * hand[:, :3, 2]


def _block_clearance(body: ArmBody, obstacles: Obstacles, q: np.ndarray) -> Clearance:
    frames = link_poses(q)
    centres, radius = placed(body.fine, frames), body.fine.radius
    # The foot and links 1 and 2 stand on the floor.
    to_floor = (centres[..., 2] - radius - obstacles.floor)[:, body.fine.frame >= 2]
    around = (
        _self_distance(body.coarse, frames),
        to_floor.min(axis=1),
        _shelf_clearance(obstacles.shelf, centres, radius),
    )
    each = np.stack([*around, *_objects_clearance(obstacles, centres, radius)], axis=1).astype(float)
    each = np.minimum(each, FARTHEST)
    inside = np.max(centres[..., 0] + radius, axis=1) - obstacles.shelf.front
    return Clearance(each.min(axis=1), inside.astype(float), each)


def placed(spheres: Spheres, frames: np.ndarray) -> np.ndarray:
    """Centres of spheres in the base frame, shape (m, n, 3)."""
    parts = []
    for frame in np.unique(spheres.frame):
        local = spheres.centre[spheres.frame == frame]
        parts.append(local @ np.swapaxes(frames[:, frame, :3, :3], 1, 2) + frames[:, frame, None, :3, 3])
    return np.concatenate(parts, axis=1)


def _shelf_clearance(shelf: Shelf, centres: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Distance of the spheres to the shelf's solid parts, at most `FARTHEST`, shape (m,)."""
    least = np.full(len(centres), FARTHEST)
    row, column = np.nonzero(centres[..., 0] + radius > shelf.front - FARTHEST)
    np.minimum.at(least, row, shelf_distance(shelf, centres[row, column]) - radius[column])
    return least


def shelf_distance(shelf: Shelf, points: np.ndarray) -> np.ndarray:
    """Distance to the shelf's solid parts, negative inside; beside its free space, to the front plane."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    walls = shelf.walls
    to_wall = np.minimum(y - walls.right, walls.left - y) - shelf.side_margin
    to_board = np.minimum(z - shelf.board, walls.ceiling - z - shelf.ceiling_margin)
    beside, before = np.minimum(to_wall, to_board), shelf.front - x
    in_front = np.hypot(np.maximum(beside, 0.0), before)
    return np.where(before > 0.0, in_front, np.minimum(beside, walls.back - x))


def _objects_clearance(obstacles: Obstacles, centres: np.ndarray, radius: np.ndarray) -> list[np.ndarray]:
    """Distance to each box or cylinder, at most `FARTHEST`, shapes (m,)."""
    distances = []
    for i, (half_size, T) in enumerate(zip(obstacles.half_size, obstacles.T_box_world, strict=True)):
        least = np.full(len(centres), FARTHEST)
        middle, reach = -T[:3, :3].T @ T[:3, 3], float(np.linalg.norm(half_size)) + FARTHEST
        apart = centres - middle
        row, column = np.nonzero(np.einsum("mni,mni->mn", apart, apart) < (reach + radius) ** 2)
        if len(row):
            np.minimum.at(least, row, body_distance(obstacles, i, centres[row, column]) - radius[column])
        distances.append(least)
    return distances


def body_distance(obstacles: Obstacles, i: int, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Distance of points to a box or cylinder, negative inside [m]."""
    half_size, T = obstacles.half_size[i], obstacles.T_box_world[i]
    local = points @ T[:3, :3].T + T[:3, 3]
    if obstacles.round[i]:
        across = np.hypot(local[:, 0], local[:, 1]) - half_size[0]
        past = np.stack([across, np.abs(local[:, 2]) - half_size[2]], axis=1)
    else:
        past = np.abs(local) - half_size
    return np.linalg.norm(np.maximum(past, 0.0), axis=-1) + np.minimum(past.max(axis=-1), 0.0)


def _self_distance(coarse: Spheres, frames: np.ndarray) -> np.ndarray:
    """Distance of the wrist, the hand and the held object from the foot and links 1 and 2."""
    points = placed(coarse, frames)
    least = np.full(len(frames), np.inf)
    for frame, start, end, radius in _base_capsules():
        T = frames[:, frame] if frame >= 0 else np.broadcast_to(np.eye(4, dtype=np.float32), (len(frames), 4, 4))
        a = (T[:, :3, :3] @ start + T[:, :3, 3])[:, None]
        along = (T[:, :3, :3] @ (end - start))[:, None]
        share = np.sum((points - a) * along, axis=-1) / np.sum(along**2, axis=-1)
        nearest = a + np.clip(share, 0.0, 1.0)[..., None] * along
        gap = np.linalg.norm(points - nearest, axis=-1) - coarse.radius - radius
        least = np.minimum(least, gap.min(axis=1))
    return least


@functools.cache
def _base_capsules() -> tuple[tuple[int, np.ndarray, np.ndarray, float], ...]:
    """Capsules of the foot (frame -1) and of links 1 and 2: frame, ends of the axis, radius."""
    start, end, radius = FOOT
    capsules = [(-1, np.array(start, np.float32), np.array(end, np.float32), radius)]
    for frame in (0, 1):
        for capsule in link_parts()[frame]:
            T, (radius, half) = capsule.T_frame_primitive, capsule.size
            first, last = ((T[:3, 3] + sign * half * T[:3, 2]).astype(np.float32) for sign in (-1.0, 1.0))
            capsules.append((frame, first, last, radius))
    return tuple(capsules)


class _Cylinder(NamedTuple):
    """A cylinder about its z; the attributes of a `RobotPart`, with half-extents as size [m]."""

    size: tuple[float, float, float]
    T_frame_primitive: np.ndarray
    kind: str = "cylinder"


def _in_hand(held: Held) -> tuple[RobotPart | _Cylinder, ...]:
    """The held object, in the hand frame."""
    pose = np.array(held.T_gripper_held, float)
    pose[2, 3] += kinematics.FINGER_TIPS
    return (_Cylinder(held.half_size, pose) if held.round else RobotPart("box", tuple(held.half_size), pose),)


def _spheres(bodies: Sequence[tuple[int, tuple[RobotPart | _Cylinder, ...]]], cell: float) -> Spheres:
    """Spheres around all primitives of pairs of a frame, ascending, and its primitives."""
    frames, centres, radii, edges = [], [], [], []
    for frame, primitives in bodies:
        for primitive in primitives:
            local, radius, steps = _cover(primitive.kind, primitive.size, cell)
            T = primitive.T_frame_primitive
            frames.append(np.full(len(local), frame))
            centres.append(local @ T[:3, :3].T + T[:3, 3])
            radii.append(np.full(len(local), radius))
            edges.append(np.tile(T[:3, :3] * steps, (len(local), 1, 1)))
    numbers = (np.concatenate(rows).astype(np.float32) for rows in (centres, radii, edges))
    return Spheres(np.concatenate(frames), *numbers)


@functools.cache
def _cover(kind: str, size: tuple[float, ...], cell: float) -> tuple[np.ndarray, float, np.ndarray]:
    """Centres and radius of spheres that cover a primitive, in its own frame, and the edges of a box's cells."""
    if kind == "capsule":
        radius, half = size
        count = max(2, int(np.ceil(2 * half / cell)) + 1)
        z = np.linspace(-half, half, count)
        between = half / (count - 1)
        return np.stack([0 * z, 0 * z, z], axis=1), float(np.hypot(radius, between)), np.zeros(3)
    counts = [max(1, int(np.ceil(2 * s / cell))) for s in size]
    steps = [2 * s / n for s, n in zip(size, counts, strict=True)]
    axes = [(np.arange(n) - (n - 1) / 2) * step for n, step in zip(counts, steps, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    if kind == "cylinder":
        inner = np.maximum(np.abs(grid[:, :2]) - np.array(steps[:2]) / 2, 0.0)
        grid = grid[np.hypot(inner[:, 0], inner[:, 1]) < size[0]]
    return grid, float(np.linalg.norm(steps)) / 2, np.array(steps)


def shows_arm(
    camera: Camera, depth: Float[np.ndarray, "h w"], body: ArmBody, q: Float[np.ndarray, " 7"]
) -> Bool[np.ndarray, "h w"]:
    """Which pixels of a depth image show the arm, or something up to `AROUND` beside it.

    Args:
      camera: of the image.
      depth: along the camera's axis [m]; other numbers than positive ones are not measured.
      body: the arm.
      q: its joint angles [rad].
    """
    frames, shown = link_poses(q[None]), np.zeros(depth.shape, bool)
    turn, radius = np.array(camera.rotation), body.fine.radius + AROUND
    centres = (placed(body.fine, frames)[0] - np.array(camera.position)) @ turn
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy]) - 0.5
    for centre, reach in zip(centres, radius, strict=True):
        if centre[2] <= reach:
            continue
        # A little more than the image of the sphere.
        half = focal * reach / (centre[2] - reach) * (1.0 + np.linalg.norm(centre[:2]) / centre[2])
        pixel = focal * centre[:2] / centre[2] + middle
        low, high = np.floor(pixel - half).astype(int), np.ceil(pixel + half).astype(int) + 1
        (left, top), (right, bottom) = np.maximum(low, 0), np.minimum(high, (depth.shape[1], depth.shape[0]))
        if left >= right or top >= bottom:
            continue
        z = depth[top:bottom, left:right]
        x = (np.arange(left, right) - middle[0])[None] / camera.fx * z - centre[0]
        y = (np.arange(top, bottom) - middle[1])[:, None] / camera.fy * z - centre[1]
        with np.errstate(invalid="ignore"):
            shown[top:bottom, left:right] |= x**2 + y**2 + (z - centre[2]) ** 2 < reach**2
    return shown
