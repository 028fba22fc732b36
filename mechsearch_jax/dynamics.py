"""What an action does to the objects: S of equation 4. F and G follow from it with `existence` and `graspability`."""

from __future__ import annotations

import dataclasses
import math
from typing import Protocol

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.shelf import Shelf
from mechsearch_jax.superquadric import Superquadrics
from mechsearch_jax.transforms import compose, inverse, matmul, transform, yaw_rotation

ROUND_EXPONENT = 0.6
BOUNDARY_POINTS = 24
# Largest height at which a push may begin to touch, in half widths of the object along it, for boxes and for round
# objects. Higher up, friction at the board (0.4 and 0.6) topples them instead of letting them slide; but a push at the
# very bottom never does.
LEVERAGE = (1.8, 1.5)
LOW_CONTACT = 0.03
QUARTER_TURN = math.pi / 2
# Parts of the gripper that come this close together touch an object together [m].
TOUCH = 0.004


class PushOutcome(flax.struct.PyTreeNode):
    """What a push is predicted to do.

    Attributes:
      scene: the objects afterwards.
      residual: deepest penetration that the model could not resolve [m]: objects jammed against a wall or one another.
      topples: probability that an object falls over, shape (N,).
    """

    scene: Superquadrics
    residual: jax.Array
    topples: jax.Array


class PushModel(Protocol):
    """Predicts a push; interchangeable (DESIGN.md section 5)."""

    def __call__(
        self, shelf: Shelf, scene: Superquadrics, pusher: Array, T_world_gripper: Array, displacement: Array, q7: Array
    ) -> PushOutcome:
        """Predict a push; one of no length changes nothing.

        Args:
          shelf: walls; static.
          scene: objects before the push, fields (N, ...).
          pusher: surface of the closed gripper in its own frame, shape (P, 3) [m].
          T_world_gripper: where the push starts, shape (4, 4).
          displacement: how the gripper moves, shape (3,) [m].
          q7: angle of joint 7, which tells the arm's configuration [rad]; models that only know the gripper ignore it.
        """
        ...


class Footprints(flax.struct.PyTreeNode):
    """Objects seen from above: a rectangle or an ellipse and a range of heights, every field with leading axis N."""

    half: jax.Array
    round: jax.Array
    position: jax.Array
    yaw: jax.Array
    low: jax.Array
    high: jax.Array
    valid: jax.Array


def footprints(scene: Superquadrics) -> Footprints:
    """Footprints of objects; of one that lies tilted, those of its bounding box's projection.

    An approximation: exponents e2 above 0.6 about a vertical axis count as round, everything else as a rectangle.
    """
    rows = jnp.arange(scene.capacity)
    vertical = jnp.argmax(jnp.abs(scene.rotation[:, 2, :]), axis=-1)
    first, second = (vertical + 1) % 3, (vertical + 2) % 3
    axis = scene.rotation[rows, :, first]
    yaw = jnp.arctan2(axis[:, 1], axis[:, 0])
    along = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
    across = jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)], axis=-1)
    upright = jnp.abs(scene.rotation[rows, 2, vertical]) > 0.98
    # Each object has directions of its own here.
    one_by_one = jax.vmap(lambda one, u: extents(jax.tree.map(lambda a: a[None], one), u)[0])
    level = jnp.stack([along, across], axis=-1)
    projected = one_by_one(scene, jnp.concatenate([level, jnp.zeros_like(level[:, :1])], axis=1))
    own = [scene.size[rows, first], scene.size[rows, second]]
    half = jnp.where(upright[:, None], jnp.stack(own, axis=-1), projected)
    height = bounding_half_extents(scene)[:, 2]
    z = scene.position[:, 2]
    is_round = upright & (vertical == 2) & (scene.exponents[:, 1] > ROUND_EXPONENT)
    return Footprints(half, is_round, scene.position[:, :2], yaw, z - height, z + height, scene.valid)


def turned(yaw: Float[Array, "..."], v: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
    """Planar vectors turned by angles that belong to their first axes [rad]."""
    c, s = (a.reshape(a.shape + (1,) * (v.ndim - 1 - a.ndim)) for a in (jnp.cos(yaw), jnp.sin(yaw)))
    return jnp.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], axis=-1)


def _dot(a, b):
    """Product of planar vectors, written out: a sum over an axis would be a kernel of its own on a GPU."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def _depth(half, is_round, points):
    """How deep points are inside a footprint, in its own frame; broadcast, negative outside."""
    gap = half - jnp.abs(points)
    scaled = points / half
    square = _dot(scaled, scaled)
    norm = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    mean = 0.5 * (half[..., 0] + half[..., 1])
    return jnp.where(is_round, (1.0 - norm) * mean, jnp.minimum(gap[..., 0], gap[..., 1]))


def _normal(half, is_round, points):
    """Outward normal of a footprint at points inside it, in its own frame; broadcast."""
    gap = half - jnp.abs(points)
    sign = jnp.where(points < 0, -1.0, 1.0)
    x_is_nearer = gap[..., 0] < gap[..., 1]
    flat = jnp.stack([jnp.where(x_is_nearer, sign[..., 0], 0.0), jnp.where(x_is_nearer, 0.0, sign[..., 1])], axis=-1)
    gradient = points / half / half
    length = jnp.sqrt(jnp.maximum(_dot(gradient, gradient), 1e-12))
    return jnp.where(is_round[..., None], gradient / length[..., None], flat)


def _deepest(depth, points):
    """Depth and place of the deepest of the points along the last axis of `depth`."""
    i = jnp.argmax(depth, axis=-1)[..., None]
    return jnp.take_along_axis(depth, i, axis=-1)[..., 0], jnp.take_along_axis(points, i[..., None], axis=-2)[..., 0, :]


def _yield_to(prints, depth, normal, arm, heading, friction):
    """Move footprints out of contacts, as quasi-static sliders under an ellipsoidal limit surface move.

    A force f at `arm` from the centre moves the slider by f and turns it by (arm x f) / c^2, with c, the ratio of
    torque to force, that of a uniform pressure distribution: 0.6 of the footprint's half diagonal. The contact sticks,
    and the point at `arm` follows `heading` until it has given way by `depth` along `normal`, if the force for that is
    inside the friction cone; otherwise it slides, with the force on the cone's edge (Lynch and Mason, one contact).
    """
    c2 = 0.36 * _dot(prints.half, prints.half)
    side = jnp.stack([-arm[..., 1], arm[..., 0]], axis=-1)
    advance = _dot(heading, normal)
    follows = advance > 0.2
    target = jnp.where(follows[..., None], heading / jnp.where(follows, advance, 1.0)[..., None], normal)
    force = target - side * (_dot(side, target) / (c2 + _dot(side, side)))[..., None]
    tangent = jnp.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    along, across = _dot(force, normal), _dot(force, tangent)
    sticks = jnp.abs(across) <= friction * along
    edge = normal + friction * jnp.where(across < 0, -1.0, 1.0)[..., None] * tangent
    given = _dot(normal, edge) + _dot(normal, side) * _dot(side, edge) / c2
    edge = edge / jnp.maximum(given, 0.1)[..., None]
    force = jnp.where(sticks[..., None], force, edge) * jnp.maximum(depth, 0.0)[..., None]
    # A disc may spin as it likes: its footprint stays the same.
    turn = jnp.where(prints.round, 0.0, _dot(side, force) / c2)
    return prints.replace(position=prints.position + force, yaw=prints.yaw + jnp.clip(turn, -0.2, 0.2))


def _outline(prints):
    angle = np.arange(BOUNDARY_POINTS) * 2 * np.pi / BOUNDARY_POINTS
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    square = circle / np.abs(circle).max(axis=-1, keepdims=True)
    unit = jnp.where(prints.round[:, None, None], jnp.float32(circle)[None], jnp.float32(square)[None])
    return turned(prints.yaw[:, None], unit * prints.half[:, None, :]) + prints.position[:, None, :]


def _pusher_depth(prints, points):
    """How deep the gripper's points are in each footprint, -1 at other heights, and where they are in its frame."""
    local = turned(-prints.yaw[:, None], points[None, :, :2] - prints.position[:, None, :])
    depth = _depth(prints.half[:, None, :], prints.round[:, None], local)
    level = (points[None, :, 2] > prints.low[:, None]) & (points[None, :, 2] < prints.high[:, None])
    return jnp.where(level & prints.valid[:, None], depth, -1.0), local


def _resolve_pusher(prints, points, heading, friction):
    depth, point = _deepest(*_pusher_depth(prints, points))
    away = -turned(prints.yaw, _normal(prints.half, prints.round, point))
    heading = jnp.broadcast_to(heading, away.shape)
    return _yield_to(prints, depth, away, turned(prints.yaw, point), heading, friction)


def _touched_high(scene, prints, points, heading, leverage):
    """Which objects points touch so high above the board that a push along `heading` tips them."""
    local = turned(-prints.yaw[:, None], points[None, :, :2] - prints.position[:, None, :])
    depth = _depth(prints.half[:, None, :], prints.round[:, None], local)
    level = (points[None, :, 2] > prints.low[:, None]) & (points[None, :, 2] < prints.high[:, None])
    touching = level & (depth > -TOUCH) & prints.valid[:, None]
    lowest = jnp.min(jnp.where(touching, points[None, :, 2], jnp.inf), axis=1) - prints.low
    half = extents(scene, jnp.append(heading, 0.0)[:, None])[:, 0]
    limit = jnp.where(prints.round, leverage[1], leverage[0]) * half
    # Half a centimetre more than a planned push is given, since this only sees where the push ends.
    return jnp.any(touching, axis=1) & (lowest > jnp.maximum(limit, LOW_CONTACT) + 0.005)


def _pair_contacts(prints):
    """For every ordered pair (i, j): the deepest contact, and the direction in which j has to give way."""
    outline = _outline(prints)
    into_j = turned(-prints.yaw[None, :, None], outline[:, None] - prints.position[None, :, None, :])
    depth, point = _deepest(_depth(prints.half[None, :, None, :], prints.round[None, :, None], into_j), into_j)
    normal = _normal(prints.half[None], prints.round[None], point)
    yaw = jnp.broadcast_to(prints.yaw[None, :], depth.shape)
    direction, arm = -turned(yaw, normal), turned(yaw, point)
    # The same the other way round: a corner of j inside a face of i, where j gives way along i's normal.
    other_direction = -jnp.swapaxes(direction, 0, 1)
    world = arm + prints.position[None, :, :]
    other_arm = jnp.swapaxes(world, 0, 1) - prints.position[None, :, :]
    swap = depth < depth.T
    deeper = jnp.where(swap[..., None], other_direction, direction), jnp.where(swap[..., None], other_arm, arm)
    both = prints.valid[:, None] & prints.valid[None, :] & ~jnp.eye(prints.valid.size, dtype=bool)
    return jnp.where(both, jnp.maximum(depth, depth.T), -1.0), *deeper


def _resolve_neighbours(prints, heading, friction):
    """Objects further along the push give way to those behind them."""
    depth, direction, arm = _pair_contacts(prints)
    along = _dot(prints.position[None] - prints.position[:, None], heading[None, None])
    depth = jnp.where(along > 0, depth, -1.0)
    i = jnp.argmax(depth, axis=0)
    j = jnp.arange(prints.valid.size)
    return _yield_to(prints, depth[i, j], direction[i, j], arm[i, j], direction[i, j], friction)


def _wall_depth(shelf, prints):
    outline = _outline(prints)
    x, y = outline[..., 0], outline[..., 1]
    return jnp.stack([x - shelf.back, shelf.right - y, y - shelf.left], axis=-1), outline


def _resolve_walls(shelf, prints):
    inward = jnp.array([[-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    depth, outline = _wall_depth(shelf, prints)
    depth, points = _deepest(jnp.swapaxes(depth, -1, -2), outline[:, None])
    depth = jnp.where(prints.valid[:, None], depth, -1.0)
    for wall in range(3):
        point = points[:, wall]
        direction = jnp.broadcast_to(inward[wall], point.shape)
        prints = _yield_to(prints, depth[:, wall], direction, point - prints.position, direction, 0.0)
    return prints


def unresolved(shelf: Shelf, before: Footprints, after: Footprints, points: Float[Array, "p 3"]) -> Float[Array, ""]:
    """Deepest penetration after a push [m]: of the gripper, of walls, and of objects as far as it is new; at least 0.

    Args:
      shelf: walls.
      before, after: the objects.
      points: surface of the gripper where the push ends, in the world [m].
    """
    held = jnp.max(_pusher_depth(after, points)[0])
    jammed = jnp.max(_pair_contacts(after)[0]) - jnp.maximum(jnp.max(_pair_contacts(before)[0]), 0.0)
    wall = jnp.max(jnp.where(after.valid[:, None], jnp.max(_wall_depth(shelf, after)[0], axis=1), -1.0))
    return jnp.maximum(jnp.maximum(jnp.maximum(held, jammed), wall), 0.0)


@dataclasses.dataclass(frozen=True)
class QuasiStatic:
    """An analytic `PushModel`: the gripper moves in small steps, and what it runs into gives way.

    Objects are planar footprints that slide under an ellipsoidal limit surface without inertia; objects pushed back by
    others are neglected, and only what the gripper itself touches too high is taken to topple.

    Attributes:
      steps: number of steps of the gripper.
      sweeps: how often contacts are resolved in each.
      gripper_friction, object_friction: coefficients at contacts with the gripper and between objects.
      leverage: how high the gripper may touch an object without tipping it; see `LEVERAGE`.
    """

    steps: int = 16
    sweeps: int = 2
    gripper_friction: float = 0.8
    object_friction: float = 0.4
    leverage: tuple[float, float] = LEVERAGE

    def __call__(
        self, shelf: Shelf, scene: Superquadrics, pusher: Array, T_world_gripper: Array, displacement: Array, q7: Array
    ) -> PushOutcome:
        """See `PushModel`."""
        start = transform(T_world_gripper, pusher)
        length = jnp.sqrt(jnp.maximum(jnp.sum(displacement**2), 1e-12))
        heading = displacement[:2] / length

        def step(prints, points):
            for _ in range(self.sweeps):
                prints = _resolve_pusher(prints, points, heading, self.gripper_friction)
                prints = _resolve_walls(shelf, _resolve_neighbours(prints, heading, self.object_friction))
            return prints, prints

        before = footprints(scene)
        fraction = (jnp.arange(self.steps) + 1.0) / self.steps
        points = start[None] + fraction[:, None, None] * displacement[None, None]
        after, stages = jax.lax.scan(step, before, points)
        # A gripper that cannot move what is jammed would pass through it, so the worst moment counts, not the last.
        held = jnp.max(jax.vmap(_pusher_depth)(stages, points)[0])
        residual = jnp.maximum(held, unresolved(shelf, before, after, points[-1]))
        turn = after.yaw - before.yaw
        moved = (jnp.abs(turn) > 1e-3) | (jnp.max(jnp.abs(after.position - before.position), axis=-1) > 1e-4)
        moved_scene = rigid_motion(scene, before.position, after.position, turn)
        pick = lambda new, old: jnp.where(moved.reshape(-1, *[1] * (new.ndim - 1)), new, old)  # noqa: E731
        scene = jax.tree.map(pick, moved_scene, scene)
        high = _touched_high(scene, after, start + displacement[None], heading, self.leverage)
        return PushOutcome(scene, residual, jnp.where(high, 1.0, 0.0))


def rigid_motion(
    scene: Superquadrics, before: Float[Array, "n 2"], after: Float[Array, "n 2"], turn: Float[Array, " n"]
) -> Superquadrics:
    """Objects moved in the plane from `before` to `after` [m] and turned about the vertical through `before` [rad]."""
    arm = turned(turn, scene.position[:, :2] - before) + after
    return scene.replace(
        position=jnp.concatenate([arm, scene.position[:, 2:]], axis=-1),
        rotation=matmul(yaw_rotation(turn), scene.rotation),
    )


def in_hand(scene: Superquadrics, index: Int[Array, ""], T_world_grasp: Float[Array, "4 4"]) -> Float[Array, "3 3"]:
    """`R_world_object` of an object once the fingers have closed on it.

    An approximation: one with flat sides turns about its own vertical axis until the nearest of them lies flat against
    a finger, and does not shift; a round one stays as it is.
    """
    one = footprints(jax.tree.map(lambda a: a[index][None], scene))
    approach = jnp.arctan2(T_world_grasp[1, 2], T_world_grasp[0, 2])
    skew = approach - one.yaw[0]
    skew = skew - QUARTER_TURN * jnp.round(skew / QUARTER_TURN)
    return matmul(yaw_rotation(jnp.where(one.round[0], 0.0, skew)), scene.rotation[index])


def pick_and_place(
    scene: Superquadrics, index: Int[Array, ""], T_world_grasp: Float[Array, "4 4"], T_world_place: Float[Array, "4 4"]
) -> Superquadrics:
    """The scene after an object, turned `in_hand`, has moved with the gripper from one pose to the other."""
    motion = compose(T_world_place, inverse(T_world_grasp))
    position = transform(motion, scene.position[index])
    rotation = matmul(motion[:3, :3], in_hand(scene, index, T_world_grasp))
    return scene.replace(
        position=scene.position.at[index].set(position), rotation=scene.rotation.at[index].set(rotation)
    )


def changed(before: Superquadrics, after: Superquadrics) -> Bool[Array, " n"]:
    """Which objects differ in pose between two scenes."""
    return jnp.any(before.position != after.position, axis=-1) | jnp.any(
        before.rotation != after.rotation, axis=(-1, -2)
    )


def extents(scene: Superquadrics, directions: Float[Array, "3 d"]) -> Float[Array, "n d"]:
    """How far objects reach from their centres along directions [m].

    An approximation: the objects are taken as elliptic cylinders if their exponent e2 is above 0.6, else as boxes; both
    hold the superquadric, however it is turned.

    Args:
      scene: the objects, fields (N, ...).
      directions: unit vectors in the world, as columns.
    """
    local = jnp.sum(scene.rotation[:, :, :, None] * directions[None, :, None, :], axis=1)
    x, y, z = (jnp.abs(local[:, i]) * scene.size[:, i, None] for i in range(3))
    square = x**2 + y**2
    plane = jnp.sqrt(jnp.where(square > 0, square, 1.0)) * (square > 0)
    return jnp.where((scene.exponents[:, 1] > ROUND_EXPONENT)[:, None], plane, x + y) + z


def bounding_half_extents(scene: Superquadrics) -> Float[Array, "n 3"]:
    """Half-extents of the objects' bounding boxes along the world's axes [m]; see `extents`."""
    return extents(scene, jnp.eye(3))
