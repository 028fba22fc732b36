"""Actions: pushes and pick-and-places, which of them are possible, and how they are sampled (paper appendix B.5)."""

from __future__ import annotations

import dataclasses
import enum
import functools
import math
from typing import Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.dynamics.push_model import LEVERAGE, LOW_CONTACT, TOUCH
from mechsearch_jax.dynamics.rigid import in_hand
from mechsearch_jax.errors import InputError
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.collision import Pair, any_inside
from mechsearch_jax.geometry.footprints import Footprints, bounding_half_extents, footprints, turned
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import (
    back_off,
    compose,
    inverse,
    make,
    matmul,
    rotate,
    transform,
    translate,
    yaw_rotation,
)
from mechsearch_jax.graspability import WRIST_ORIGIN, boxes_overlap, gripper_rotation
from mechsearch_jax.object_grasps import PASSING_GAP, ObjectGraspConfig, grasp_variants, object_grasps
from mechsearch_jax.robot.gripper import Gripper, arm_hits_shelf, gripper_cloud, swept_cloud
from mechsearch_jax.robot.kinematics import line_kinematics, line_poses, path_kinematics
from mechsearch_jax.workspace.shelf import Shelf, hits_shelf

# Longer pushes would leave the shelf [m].
LONGEST_PUSH = 0.5
# Number of poses on each stretch of a motion where it is followed closely, and of places on the way of a push that
# are tested for collision.
CLOSE_WAYPOINTS = 12
PUSH_PLACES = 3
# How far a joint may turn between where an object is taken out of the shelf and where it is brought in [rad].
LARGEST_TRANSFER = 2.0
# How far the hand extends behind the finger tips' centres [m].
HAND_LENGTH = 0.11


class ActionKind(enum.IntEnum):
    NONE = 0
    PUSH = 1
    PICK_AND_PLACE = 2
    RETRIEVE = 3


class Action(flax.struct.PyTreeNode):
    """One action of the robot; every field may carry leading batch axes.

    Attributes:
      kind: an `ActionKind`, int32.
      object: index of the object that is pushed or picked, int32.
      T_world_gripper: gripper pose where the push starts, or where the object is grasped, shape (..., 4, 4).
      displacement: translation of the gripper while it pushes, in the world [m], shape (..., 3); zero for a
        pick-and-place.
      T_world_place: gripper pose where the object is released, shape (..., 4, 4); for a push, the pose where it ends.
      q7: angle of joint 7 during the whole motion [rad].
      opening: distance between the fingers while the gripper approaches [m]; 0 is closed.
    """

    kind: jax.Array
    object: jax.Array
    T_world_gripper: jax.Array
    displacement: jax.Array
    T_world_place: jax.Array
    q7: jax.Array
    opening: jax.Array


def no_action() -> Action:
    """The action that does nothing."""
    return Action(
        kind=jnp.int32(ActionKind.NONE),
        object=jnp.int32(0),
        T_world_gripper=jnp.eye(4),
        displacement=jnp.zeros(3),
        T_world_place=jnp.eye(4),
        q7=jnp.float32(0.0),
        opening=jnp.float32(0.0),
    )


@dataclasses.dataclass(frozen=True)
class ActionConfig:
    """Which actions there are.

    Attributes:
      kinds: "both", "push" or "pick-and-place".
      push_distances: how far the gripper travels in a push [m].
      push_tilt: angle by which the pushing gripper points downwards [rad].
      push_wrists: angles of joint 7 relative to 45 degrees that pushes are tried with [rad].
      push_yaws: angles between the gripper's approach and +x in a push, seen from above [rad].
      push_height: largest height of the finger tips above the board in a push [m].
      push_leverage: largest height at which a push may begin to touch; see `dynamics.LEVERAGE`.
      topple: a push is not executed if an object is predicted to fall over with a probability above this.
      push_gap: distance between gripper and object where a push starts [m].
      push_depths: how far the finger tips reach past the object's front, or past its centre, in a push [m].
      grasps: the ways in which an object is grasped.
      placements: how many places are tried for a picked object, and how many of those are tested for collision.
      place_yaw: largest angle by which a picked object is turned [rad].
      clearance: distance to keep from neighbours when placing [m].
      give: an object may brush others this deep on its way out [m]: those that touch each other are recognised as
        overlapping as often as not, and would lock each other in.
      jam: deepest unresolved penetration of a predicted push that is still executed [m].
      cloud_points: points on the swept gripper.
      pusher_points: points on the hand and fingers.
      object_points: points on an object.
    """

    kinds: Literal["both", "push", "pick-and-place"] = "both"
    push_distances: tuple[float, ...] = (0.05, 0.10, 0.15)
    push_tilt: float = math.radians(30)
    push_wrists: tuple[float, ...] = (math.radians(-45), math.radians(-15), math.radians(30))
    push_yaws: tuple[float, ...] = (math.radians(-25), 0.0, math.radians(25))
    push_height: float = 0.08
    push_leverage: tuple[float, float] = LEVERAGE
    topple: float = 0.5
    push_gap: float = 0.01
    push_depths: tuple[float, float] = (0.02, 0.02)
    grasps: ObjectGraspConfig = dataclasses.field(default_factory=ObjectGraspConfig)
    placements: tuple[int, int] = (32, 4)
    place_yaw: float = math.radians(30)
    clearance: float = 0.005
    give: float = 0.003
    jam: float = 0.006
    cloud_points: int = 1024
    pusher_points: int = 384
    object_points: int = 128

    def __post_init__(self):
        if self.kinds not in ("both", "push", "pick-and-place"):
            raise InputError(f'actions "{self.kinds}" are unknown; use "both", "push" or "pick-and-place"')
        if not self.give >= 0.0:
            raise InputError(f"ActionConfig: give {self.give} m must not be negative")
        if not self.push_distances or not all(0.0 < d <= LONGEST_PUSH for d in self.push_distances):
            raise InputError(
                f"push_distances {self.push_distances} must be one or more lengths above 0 and at most {LONGEST_PUSH} m"
            )


class ActionTables(flax.struct.PyTreeNode):
    """Constants of the actions.

    Attributes:
      q7: angles of joint 7 in grasps, then in pushes, shape (2, W) [rad].
      clouds: what the gripper sweeps on its way in, in its own frame, open and then closed: shape (2, W, 3, P) [m].
      low, high: boxes around them, shape (2, W, 3) [m].
      pusher: surface of the closed hand and fingers in the gripper's frame, shape (Q, 3) [m].
    """

    q7: jax.Array
    clouds: jax.Array
    low: jax.Array
    high: jax.Array
    pusher: jax.Array


def action_tables(gripper: Gripper, grasp_wrists: tuple[float, ...], config: ActionConfig) -> ActionTables:
    """Sample the clouds of the open and the closed gripper for every wrist.

    Args:
      gripper: the gripper.
      grasp_wrists: angles of joint 7 in grasps, relative to 45 degrees [rad].
      config: has as many angles for pushes.

    Raises:
      InputError: it has not.
    """
    if len(grasp_wrists) != len(config.push_wrists):
        raise InputError(
            f"{len(grasp_wrists)} wrist angles for grasps but {len(config.push_wrists)} for pushes; give as many each"
        )
    q7 = WRIST_ORIGIN + np.array([grasp_wrists, config.push_wrists])
    clouds = np.stack(
        [
            [swept_cloud(gripper, opening, float(angle), config.cloud_points) for angle in angles]
            for opening, angles in zip((gripper.max_opening, 0.0), q7, strict=True)
        ]
    )
    # Only the hand and the fingers push; the links behind them would thin out the points that matter.
    surface = gripper_cloud(gripper, 0.0, float(q7[1][0]), 2048)
    pusher = surface[surface[:, 2] > -HAND_LENGTH][: config.pusher_points]
    return ActionTables(
        q7=jnp.float32(q7),
        clouds=jnp.float32(np.swapaxes(clouds, -1, -2)),
        low=jnp.float32(clouds.min(axis=-2)),
        high=jnp.float32(clouds.max(axis=-2)),
        pusher=jnp.float32(pusher),
    )


class PossibleSpace(flax.struct.PyTreeNode):
    """Where a target that has not been ruled out would stand, as a raster at the spacing of the candidate poses.

    Attributes:
      occupied: whether any of it lies in a cell, shape (rows along x, columns along y).
      chance: share of the possible poses whose centre is in a cell, same shape; the sum is 1, or 0 if there are none.
      origin: centre of the first cell [m], shape (2,).
      cell: spacing [m], shape (2,).
      top: height up to which a target reaches [m].
    """

    occupied: jax.Array
    chance: jax.Array
    origin: jax.Array
    cell: jax.Array
    top: jax.Array


def widen(cells: Bool[Array, "r c"]) -> Bool[Array, "r c"]:
    """A raster with the neighbours of its cells. A cell is 15 mm wide and a target's radius 20 mm: one is enough."""
    return jax.lax.reduce_window(cells, False, jax.lax.bitwise_or, (3, 3), (1, 1), "SAME")


def _cells(space: PossibleSpace, points):
    """Row and column of the cells of world points (N, 3), and whether they are on the raster and not above a target."""
    index = jnp.round((points[:, :2] - space.origin[None]) / space.cell[None]).astype(jnp.int32)
    shape = jnp.array(space.occupied.shape)[None]
    inside = jnp.all((index >= 0) & (index < shape), axis=-1) & (points[:, 2] < space.top)
    return jnp.clip(index, 0, shape - 1), inside


def _enters(space: PossibleSpace, points: Float[Array, "... 3"]) -> Bool[Array, "..."]:
    """Whether world points lie in possible space."""
    index, inside = _cells(space, points.reshape(-1, 3))
    return (space.occupied[index[:, 0], index[:, 1]] & inside).reshape(points.shape[:-1])


def _risk(space: PossibleSpace, points: Float[Array, "... 3"]) -> Float[Array, ""]:
    """Share of the possible poses at which the target would be touched by world points."""
    index, inside = _cells(space, points.reshape(-1, 3))
    touched = jnp.zeros(space.occupied.shape, bool).at[index[:, 0], index[:, 1]].max(inside)
    return jnp.sum(jnp.where(widen(touched), space.chance, 0.0))


class Candidates(flax.struct.PyTreeNode):
    """The pushes and grasps of every object in a scene, and what stands in their way.

    Attributes:
      grasp: gripper poses, shape (N, A, 4, 4).
      grasp_reached: whether the gripper opens wide enough, the arm reaches and the shelf leaves room, shape (N, A).
      grasp_hits: which objects the gripper, or the object on its way out, would hit, shape (N, A, N).
      grasp_enters: whether the gripper would enter possible space, shape (N, A).
      push: gripper poses where pushes start, shape (N, B, 4, 4).
      push_reached: by distance, shape (N, B, D).
      push_hits: which objects the gripper would hit on its way in, shape (N, B, N).
      push_enters: whether gripper or object would enter possible space, by distance, shape (N, B, D).
    """

    grasp: jax.Array
    grasp_reached: jax.Array
    grasp_hits: jax.Array
    grasp_enters: jax.Array
    push: jax.Array
    push_reached: jax.Array
    push_hits: jax.Array
    push_enters: jax.Array


def _exit_distance(half, is_round, points, direction):
    """How far points must move along a direction to leave a footprint, in its own frame; 0 if they never are inside."""
    safe = jnp.where(jnp.abs(direction) < 1e-6, 1e-6, direction)
    a, b = (-half - points) / safe, (half - points) / safe
    enter, leave = jnp.max(jnp.minimum(a, b), axis=-1), jnp.min(jnp.maximum(a, b), axis=-1)
    flat = jnp.where(enter < leave, leave, 0.0)
    p, d = points / half, direction / half
    dd, pd, pp = jnp.sum(d * d, axis=-1), jnp.sum(p * d, axis=-1), jnp.sum(p * p, axis=-1)
    square = pd**2 - dd * (pp - 1.0)
    meets = square > 0
    circle = jnp.where(meets, (-pd + jnp.sqrt(jnp.where(meets, square, 1.0))) / dd, 0.0)
    return jnp.maximum(jnp.where(is_round, circle, flat), 0.0)


def object_pushes(
    shelf: Shelf,
    tables: ActionTables,
    scene: Superquadrics,
    prints: Footprints,
    config: ActionConfig,
    fresh: Bool[Array, " n"],
) -> tuple[Float[Array, "n b 4 4"], Bool[Array, "n b"]]:
    """Gripper poses where pushes start, beside each object at `push_gap` from it, and whether it would stay upright.

    Only for `fresh` objects. For each side (pushing towards +y, then -y), for two depths (fingers just past the
    object's front, then past its centre so that the palm pushes), for each yaw of the gripper, for each wrist.
    """
    wrists = tables.q7.shape[1]
    side, deep, yaw, _ = _push_grid(config, wrists)
    rotation = gripper_rotation(jnp.float32(yaw), jnp.full(len(yaw), config.push_tilt, jnp.float32))
    extent = bounding_half_extents(scene)
    x = jnp.where(
        jnp.asarray(deep == 0)[None],
        (prints.position[:, 0] - extent[:, 0] + config.push_depths[0])[:, None],
        (prints.position[:, 0] + config.push_depths[1])[:, None],
    )
    height = prints.high - shelf.board
    leverage = jnp.where(prints.round, config.push_leverage[1], config.push_leverage[0]) * extent[:, 1]
    limit = jnp.minimum(leverage, 0.75 * height)
    shape = (scene.capacity, len(side))
    z = jnp.broadcast_to(shelf.board + jnp.clip(limit, LOW_CONTACT, config.push_height)[:, None], shape)
    centre = jnp.stack([x, jnp.broadcast_to(prints.position[:, 1:2], shape), z], axis=-1)
    T = make(jnp.broadcast_to(rotation[None], (*shape, 3, 3)), centre)

    def beside(tables, row, i):
        k, variant = i // len(side), i % len(side)
        one = jax.tree.map(lambda a: a[k], row[0])
        world = transform(row[1][k, variant], tables.pusher)
        level = (world[:, 2] > one.low - config.push_gap) & (world[:, 2] < one.high + config.push_gap)
        local = turned(-one.yaw, world[:, :2] - one.position[None])
        heading = turned(-one.yaw, jnp.array([0.0, 1.0]) * -jnp.float32(side)[variant])
        # In front of the object the palm may pass close by; only sideways does it keep the whole gap.
        grown = one.half + PASSING_GAP
        away = _exit_distance(grown[None], one.round, local, jnp.broadcast_to(heading[None], local.shape))
        away = jnp.where(level, away, 0.0)
        farthest = jnp.max(away)
        touching = level & (away > farthest - TOUCH)
        lowest = jnp.min(jnp.where(touching, world[:, 2], jnp.inf))
        return farthest + config.push_gap - PASSING_GAP, lowest - shelf.board

    beside_all = masked_vmap(beside, jnp.repeat(fresh, len(side)), tables, (prints, T))
    distance, contact = (a.reshape(shape) for a in beside_all)
    stable = contact <= jnp.maximum(leverage, LOW_CONTACT)[:, None]
    return T.at[..., 1, 3].add(-jnp.float32(side)[None] * distance), stable


def _push_grid(config: ActionConfig, wrists: int):
    """Side, depth, yaw and wrist of each push of an object."""
    grid = np.meshgrid([1.0, -1.0], [0, 1], np.asarray(config.push_yaws), np.arange(wrists), indexing="ij")
    return [g.reshape(-1) for g in grid]


def push_variants(config: ActionConfig, wrists: int) -> tuple[np.ndarray, np.ndarray]:
    """Side (+1 or -1 along y) and wrist of each push of `object_pushes`, each of shape (B,)."""
    side, _, _, wrist = _push_grid(config, wrists)
    return np.asarray(side, np.float32), wrist


@dataclasses.dataclass(frozen=True)
class ActionSpace:
    """All that is static about actions, gathered so that it can be passed on as one argument.

    Attributes:
      shelf, gripper, config: as elsewhere.
      max_yaw: of grasps, as in `graspability.GraspConfig`.
      waypoints: poses at which an approach has to be reachable.
    """

    shelf: Shelf
    gripper: Gripper
    config: ActionConfig
    max_yaw: float
    waypoints: int


def _object_cloud(scene: Superquadrics, count: int) -> Float[Array, "n 3 p"]:
    return jnp.swapaxes(superquadric.sample_surface(scene.size, scene.exponents, count), -1, -2)


def _swept_object(cloud, R_object_gripper, distance, steps=7):
    """An object's surface at several places on its way along the gripper's -z, in its own frame, as rows."""
    shift = -R_object_gripper[:, 2, None] * (jnp.arange(steps) * (distance / (steps - 1)))[None]
    return (cloud[:, :, None] + shift[:, None, :]).reshape(3, -1)


def _gripper_hits(tables, opening, wrist, T, scene, mask):
    """Which objects the swept gripper hits: poses (C, 4, 4) against objects (N), where the mask (C, N) is true.

    `opening` and `wrist` say for each pose which of the clouds is meant.
    """
    c, n = mask.shape
    opening, wrist = jnp.broadcast_to(opening, c), jnp.asarray(wrist)

    def pair(tables, row, i):
        T, opening, wrist, scene = row
        k, j = i // n, i % n
        cloud = tables.clouds[opening[k], wrist[k]]
        T_object_world = inverse(make(scene.rotation[j], scene.position[j]))
        return Pair(cloud, compose(T_object_world, T[k]), scene.size[j], scene.exponents[j])

    T_gripper_object = compose(inverse(T)[:, None], make(scene.rotation, scene.position)[None])
    low, high = tables.low[opening, wrist], tables.high[opening, wrist]
    near = boxes_overlap(low[:, None], high[:, None], T_gripper_object, scene.size[None])
    return any_inside((mask & near).reshape(-1), pair, tables, (T, opening, wrist, scene)).reshape(c, n)


def _object_hits(T, owner, held, scene, clouds, distance, mask):
    """Which others an object hits on its way along the gripper's -z: (C,) grasps of objects `owner` against (N).

    `held` says how each owner is turned in the hand. Its own column has to be masked out.
    """
    c, n = mask.shape

    def pair(_, row, i):
        T, scene, clouds, owner, held = row
        k, j = i // n, i % n
        o = owner[k]
        cloud = _swept_object(clouds[o], matmul(held[k].T, T[k][:3, :3]), distance)
        T_object_world = inverse(make(scene.rotation[j], scene.position[j]))
        T_object_owner = compose(T_object_world, make(held[k], scene.position[o]))
        return Pair(cloud, T_object_owner, scene.size[j], scene.exponents[j])

    # A sphere around the owner, swept along a segment, against a sphere around the other.
    start = scene.position[owner]
    along = -T[:, :3, 2] * distance
    offset = scene.position[None] - start[:, None]
    t = jnp.clip(jnp.sum(offset * along[:, None], axis=-1) / distance**2, 0.0, 1.0)
    gap2 = jnp.sum((offset - t[..., None] * along[:, None]) ** 2, axis=-1)
    radius = superquadric.bounding_radius(scene.size)
    near = gap2 < (radius[owner][:, None] + radius[None]) ** 2
    return any_inside((mask & near).reshape(-1), pair, None, (T, scene, clouds, owner, held)).reshape(c, n)


def _approach_clear(space: ActionSpace, tables: ActionTables, opening: np.ndarray, wrist: np.ndarray, T, mask):
    """Whether the arm reaches along the approaches to poses (C, 4, 4) and nothing of it touches the shelf."""

    def clear(tables, row, i):
        q7 = tables.q7[jnp.asarray(opening)[i], jnp.asarray(wrist)[i]]
        q, reachable = line_kinematics(row[i], jnp.float32(space.gripper.approach), q7, space.waypoints)
        return reachable & ~jnp.any(arm_hits_shelf(q, space.shelf))

    def touches(tables, row, i):
        points = transform(row[i], tables.clouds[jnp.asarray(opening)[i], jnp.asarray(wrist)[i]].T)
        return jnp.any(hits_shelf(space.shelf, points))

    reached = masked_vmap(clear, mask, tables, T, block=512)
    return reached & ~masked_vmap(touches, reached, tables, T, block=512)


def _enters_possible(tables: ActionTables, space: PossibleSpace, opening: int, wrist, T, mask):
    """Whether the swept gripper enters possible space, for poses (C, 4, 4) where the mask is true."""

    def enters(tables, row, i):
        T, space = row
        points = transform(T[i], tables.clouds[opening, jnp.asarray(wrist)[i]].T)
        return jnp.any(_enters(jax.tree.map(lambda a: a[...], space), points))

    return masked_vmap(enters, mask, tables, (T, space))


def no_candidates(space: ActionSpace, tables: ActionTables, capacity: int) -> Candidates:
    """The candidates of so many objects that are yet to be looked at."""
    wrists = tables.q7.shape[1]
    n, a = capacity, len(grasp_variants(space.config.grasps, wrists)[0])
    b, d = len(_push_grid(space.config, wrists)[0]), len(space.config.push_distances)
    return Candidates(
        grasp=jnp.zeros((n, a, 4, 4)),
        grasp_reached=jnp.zeros((n, a), bool),
        grasp_hits=jnp.zeros((n, a, n), bool),
        grasp_enters=jnp.zeros((n, a), bool),
        push=jnp.zeros((n, b, 4, 4)),
        push_reached=jnp.zeros((n, b, d), bool),
        push_hits=jnp.zeros((n, b, n), bool),
        push_enters=jnp.zeros((n, b, d), bool),
    )


def candidates(
    space: ActionSpace,
    tables: ActionTables,
    scene: Superquadrics,
    possible: PossibleSpace,
    previous: Candidates | None = None,
    moved: Bool[Array, " n"] | None = None,
) -> Candidates:
    """All pushes and grasps of all objects, and what stands in their way.

    Args:
      space: static.
      tables: constants of the problem.
      scene: the objects, fields (N, ...).
      possible: where the target may be.
      previous: candidates before some objects moved.
      moved: which moved since; only what concerns them is computed anew.
    """
    n, config = scene.capacity, space.config
    wrists = tables.q7.shape[1]
    prints = footprints(scene)
    fresh = scene.valid if moved is None else moved & scene.valid
    concerns = fresh[:, None] | fresh[None, :]
    others = scene.valid[:, None] & scene.valid[None, :]
    clouds = _object_cloud(scene, config.object_points)

    grasp, fits = object_grasps(space.shelf, space.gripper, prints, config.grasps, space.max_yaw, wrists)
    push, stable = object_pushes(space.shelf, tables, scene, prints, config, fresh)
    if previous is not None:
        push = jnp.where(fresh[:, None, None, None], push, previous.push)
    side, push_wrist = push_variants(config, wrists)
    a, b, d = grasp.shape[1], push.shape[1], len(config.push_distances)
    # Grasps and pushes are tested together as far as they are alike: grasps of all objects first, then pushes of all.
    opening = np.repeat([0, 1], [n * a, n * b])
    wrist = np.concatenate([np.tile(grasp_variants(config.grasps, wrists)[1], n), np.tile(push_wrist, n)])
    owner = np.concatenate([np.repeat(np.arange(n), a), np.repeat(np.arange(n), b)])
    flat = jnp.concatenate([grasp.reshape(-1, 4, 4), push.reshape(-1, 4, 4)])
    grasps, pushes = slice(n * a), slice(n * a, None)

    wanted = [fits & (config.kinds != "push"), stable & (config.kinds != "pick-and-place")]
    new = jnp.concatenate([(w & fresh[:, None]).reshape(-1) for w in wanted])
    near = _approach_clear(space, tables, opening, wrist, flat, new)
    displacement = jnp.asarray(np.tile(side, n))[:, None] * jnp.float32(config.push_distances)[None]
    shift = jnp.stack([jnp.zeros_like(displacement), displacement, jnp.zeros_like(displacement)], axis=-1)
    ends = translate(jnp.broadcast_to(flat[pushes, None], (n * b, d, 4, 4)), shift)

    def push_path(tables, row, i):
        starts, ends = row
        T, end = starts[i // d], ends[i // d, i % d]
        w = jnp.asarray(wrist[pushes])[i // d]
        back = jnp.float32(space.gripper.approach)
        middle = translate(T, 0.5 * (end[:3, 3] - T[:3, 3]))
        q, reachable = path_kinematics(
            jnp.stack([back_off(T, back), T, middle, end, back_off(end, back)]), tables.q7[1, w]
        )
        points = transform(end, tables.clouds[1, w].T)
        return reachable & ~jnp.any(arm_hits_shelf(q, space.shelf)) & ~jnp.any(hits_shelf(space.shelf, points))

    reached = near[grasps].reshape(n, a)
    travels = masked_vmap(push_path, jnp.repeat(near[pushes], d), tables, (flat[pushes], ends), block=512)
    travels = travels.reshape(n, b, d)
    if previous is not None:
        reached = jnp.where(fresh[:, None], reached, previous.grasp_reached)
        travels = jnp.where(fresh[:, None, None], travels, previous.push_reached)

    # An open hand is around the object that it grasps, so that object is no obstacle.
    against = concerns & others
    against = jnp.concatenate([(against & ~jnp.eye(n, dtype=bool))[owner[grasps]], against[owner[pushes]]])
    mask = against & jnp.concatenate([reached.reshape(-1), jnp.any(travels, axis=-1).reshape(-1)])[:, None]
    hits = _gripper_hits(tables, opening, wrist, flat, scene, mask)
    by_hand, push_hits = hits[grasps], hits[pushes].reshape(n, b, n)
    grasped = jnp.asarray(owner[grasps])
    held = jax.vmap(functools.partial(in_hand, scene))(grasped, flat[grasps])
    distance = space.gripper.approach
    slim = scene.replace(size=jnp.maximum(scene.size - config.give, 0.5 * scene.size))
    brushing = _object_cloud(slim, config.object_points)
    by_object = _object_hits(flat[grasps], grasped, held, scene, brushing, distance, mask[grasps] & ~by_hand)
    grasp_hits = (by_hand | by_object).reshape(n, a, n)
    if previous is not None:
        grasp_hits = jnp.where(concerns[:, None, :], grasp_hits, previous.grasp_hits)
        push_hits = jnp.where(concerns[:, None, :], push_hits, previous.push_hits)

    usable = (reached & ~jnp.any(grasp_hits, axis=-1)).reshape(-1)
    grasp_enters = _enters_possible(tables, possible, 0, wrist[grasps], flat[grasps], usable).reshape(n, a)

    def push_enters(tables, row, i):
        flat, shift, space, scene, clouds = row
        k, j = i // d, i % d
        w, o = jnp.asarray(wrist[pushes])[k], jnp.asarray(owner[pushes])[k]
        # Places on the way less than two finger widths apart.
        way = shift[k, j][None] * jnp.linspace(0.0, 1.0, 5)[:, None]
        gripper = transform(flat[k], tables.clouds[1, w].T)
        body = transform(make(scene.rotation[o], scene.position[o]), clouds[o].T)
        both = jnp.concatenate([gripper[None] + way[:, None], body[None] + way[:, None]], axis=1)
        return jnp.any(_enters(jax.tree.map(lambda a: a[...], space), both))

    usable = (travels & ~jnp.any(push_hits, axis=-1)[..., None]).reshape(-1)
    entering = masked_vmap(push_enters, usable, tables, (flat[pushes], shift, possible, scene, clouds), block=64)
    return Candidates(
        grasp=grasp,
        grasp_reached=reached,
        grasp_hits=grasp_hits,
        grasp_enters=grasp_enters,
        push=push,
        push_reached=travels,
        push_hits=push_hits,
        push_enters=entering.reshape(n, b, d),
    )


def free_ways(options: Candidates) -> tuple[Bool[Array, "n a"], Bool[Array, "n b d"]]:
    """Which grasps and which pushes of each object nothing stands in the way of."""
    grasps = options.grasp_reached & ~jnp.any(options.grasp_hits, axis=-1)
    pushes = options.push_reached & ~jnp.any(options.push_hits, axis=-1)[..., None]
    return grasps, pushes


def followable(space: ActionSpace, action: Action) -> Bool[Array, ""]:
    """Whether the arm can follow an action closely, in one configuration and without passing a singularity.

    `candidates` looks at few poses on a motion, which is enough to rule out most; this is for the few that are drawn.
    """
    n, back = CLOSE_WAYPOINTS, jnp.float32(space.gripper.approach)
    is_push = action.kind == ActionKind.PUSH
    start, end = action.T_world_gripper, action.T_world_place
    way = translate(jnp.broadcast_to(start, (n, 4, 4)), jnp.linspace(0.0, 1.0, n)[:, None] * (end - start)[None, :3, 3])
    into, out = line_poses(start, back, n), line_poses(end, back, n)[::-1]
    pushing = path_kinematics(jnp.concatenate([into, way[1:], out[1:]]), action.q7)[1]
    # Between picking and placing the arm is outside the shelf, where it may turn as it likes, but not into another of
    # its configurations: it would fling away what it holds.
    q, reachable = path_kinematics(jnp.stack([into, out]), jnp.broadcast_to(action.q7, 2))
    picking = jnp.all(reachable) & jnp.all(jnp.abs(q[1, -1] - q[0, 0]) < LARGEST_TRANSFER)
    return jnp.where(is_push, pushing, picking)


def push_hits_others(
    space: ActionSpace,
    tables: ActionTables,
    scene: Superquadrics,
    action: Action,
    wrist: Int[Array, ""],
    still: Bool[Array, " n"],
) -> Bool[Array, ""]:
    """Whether a pushing gripper, on its way or on its retreat, hits an object that the push should leave in place.

    A `PushModel` knows the hand and the fingers; links 6 and 7 and the retreat are tested here.

    Args:
      space: static.
      tables: constants of the problem.
      scene: the objects, before or after the push.
      action: the push.
      wrist: index of its wrist angle.
      still: which objects it leaves in place.
    """
    share = (jnp.arange(PUSH_PLACES) + 1.0) / PUSH_PLACES
    T = jnp.broadcast_to(action.T_world_gripper, (PUSH_PLACES, 4, 4))
    T = translate(T, share[:, None] * action.displacement[None])
    mask = jnp.broadcast_to(still & scene.valid, (PUSH_PLACES, scene.capacity))
    return jnp.any(_gripper_hits(tables, 1, jnp.broadcast_to(wrist, PUSH_PLACES), T, scene, mask))


class Sample(flax.struct.PyTreeNode):
    """A sampled action.

    Attributes:
      action: the action; of kind NONE where none is possible.
      wrist: index of its wrist angle.
      risk: share of the possible poses at which it would touch the target.
    """

    action: Action
    wrist: jax.Array
    risk: jax.Array


def _choose(key, weight):
    """A random index in proportion to weights, and whether any weight is positive."""
    logits = jnp.where(weight > 0, jnp.log(jnp.where(weight > 0, weight, 1.0)), -jnp.inf)
    return jnp.argmax(logits + jax.random.gumbel(key, weight.shape)), jnp.any(weight > 0)


def _shares(clean, dirty):
    """One for every object that has an action, shared evenly among its clean ones, or the others in need."""
    usable = jnp.where(jnp.any(clean, axis=-1, keepdims=True), clean, dirty)
    return usable / jnp.maximum(jnp.sum(usable, axis=-1, keepdims=True), 1)


def _placement(key, space, tables, scene, possible, index, T_grasp, wrist):
    """A place for a picked object, and the gripper pose that puts it there: (found, T_world_place, T_world_object)."""
    shelf, config = space.shelf, space.config
    tries, tests = config.placements
    n = scene.capacity
    key_x, key_y, key_yaw, key_turn, key_order = jax.random.split(key, 5)
    x = jax.random.uniform(key_x, (tries,), minval=shelf.front, maxval=shelf.back)
    y = jax.random.uniform(key_y, (tries,), minval=shelf.right, maxval=shelf.left)
    turn = jax.random.uniform(key_yaw, (tries,), minval=-config.place_yaw, maxval=config.place_yaw)
    turn = jnp.where(jax.random.bernoulli(key_turn, 0.5, (tries,)), turn, 0.0)
    approach = jnp.arctan2(T_grasp[1, 2], T_grasp[0, 2])
    turn = jnp.clip(turn, -space.max_yaw - approach, space.max_yaw - approach)

    position = jnp.stack([x, y, jnp.full(tries, scene.position[index, 2])], axis=-1)
    rotation = matmul(yaw_rotation(turn), in_hand(scene, index, T_grasp))
    cloud = superquadric.sample_surface(scene.size[index], scene.exponents[index], config.object_points)
    points = transform(make(rotation, position)[:, None], cloud[None])
    on_board = ~jnp.any(hits_shelf(shelf, points + jnp.array([0.0, 0.0, 1e-3])[None, None]), axis=1)
    on_board &= jnp.min(points[..., 0], axis=1) > shelf.front + config.clearance
    other = scene.replace(size=scene.size + config.clearance, valid=scene.valid.at[index].set(False))
    offset = position[:, None] - scene.position[None]
    reach = superquadric.bounding_radius(other.size) + superquadric.bounding_radius(scene.size[index])
    near = (jnp.sum(offset**2, axis=-1) < reach[None] ** 2) & other.valid[None] & on_board[:, None]

    def overlap(_, row, i):
        position, rotation, cloud, other = row
        k, j = i // n, i % n
        T_object_world = inverse(make(other.rotation[j], other.position[j]))
        T = compose(T_object_world, make(rotation[k], position[k]))
        return Pair(cloud[...].T, T, other.size[j], other.exponents[j])

    row = (position, rotation, cloud, other)
    overlapping = jnp.any(any_inside(near.reshape(-1), overlap, None, row).reshape(near.shape), axis=1)
    intrudes = jnp.any(_enters(possible, points), axis=1)

    # The most promising places, those clear of possible space first, have their approach tested.
    score = jax.random.uniform(key_order, (tries,)) - 2.0 * intrudes - 8.0 * (overlapping | ~on_board)
    _, best = jax.lax.top_k(score, tests)
    candidate = (~overlapping & on_board)[best]
    # The object turns about its own centre, and the gripper with it.
    arm = T_grasp[:3, 3] - scene.position[index]
    T_place = make(
        matmul(yaw_rotation(turn[best]), T_grasp[:3, :3]),
        rotate(yaw_rotation(turn[best]), arm) + position[best],
    )

    def clear(tables, row, i):
        T, wrist = row[0], row[1][...]
        q, reachable = line_kinematics(T[i], jnp.float32(space.gripper.approach), tables.q7[0, wrist], space.waypoints)
        points = transform(T[i], tables.clouds[0, wrist].T)
        return reachable & ~jnp.any(arm_hits_shelf(q, shelf)) & ~jnp.any(hits_shelf(shelf, points))

    clear_way = masked_vmap(clear, candidate, tables, (T_place, wrist))

    mask = clear_way[:, None] & other.valid[None]
    hits = _gripper_hits(tables, 0, jnp.full(tests, wrist), T_place, other, mask)

    def body_pair(_, row, i):
        T, position, rotation, cloud, scene = row
        k, j = i // n, i % n
        swept = _swept_object(cloud[...].T, matmul(rotation[k].T, T[k][:3, :3]), space.gripper.approach)
        T_object_world = inverse(make(scene.rotation[j], scene.position[j]))
        T_object_body = compose(T_object_world, make(rotation[k], position[k]))
        return Pair(swept, T_object_body, scene.size[j], scene.exponents[j])

    row = (T_place, position[best], rotation[best], cloud, scene)
    mask = clear_way[:, None] & other.valid[None] & ~hits
    hits |= any_inside(mask.reshape(-1), body_pair, None, row, block=32).reshape(mask.shape)
    free = clear_way & ~jnp.any(hits, axis=1)
    first = jnp.argmax(free)
    return jnp.any(free), T_place[first], make(rotation[best][first], position[best][first])


def sample_action(
    key: Array,
    space: ActionSpace,
    tables: ActionTables,
    scene: Superquadrics,
    possible: PossibleSpace,
    options: Candidates,
    available: Bool[Array, " n"],
    weights: Float[Array, " n"] | None = None,
) -> Sample:
    """Draw an action: an object and a kind (the multi-set of B.5) by the object's weight, then one of its ways evenly.

    Args:
      key: PRNG key.
      space: static.
      tables: constants of the problem.
      scene: the objects.
      possible: where the target may be. An object's actions that enter it are drawn only if it has no others.
      options: of this scene.
      available: which objects may be moved.
      weights: how often each object is drawn, positive; the paper's, and those left out, are equal.
    """
    config = space.config
    wrists = tables.q7.shape[1]
    n, a = options.grasp_reached.shape
    b, d = options.push_reached.shape[1:]
    key_choice, key_place = jax.random.split(key)
    grasps, pushes = free_ways(options)
    grasps, pushes = grasps & available[:, None], pushes & available[:, None, None]
    ways = jnp.concatenate([jnp.pad(grasps, ((0, 0), (0, b * d - a))), pushes.reshape(n, -1)]) if b * d >= a else None
    if ways is None:
        ways = jnp.concatenate([grasps, jnp.pad(pushes.reshape(n, -1), ((0, 0), (0, a - b * d)))])
    width = max(a, b * d)
    enters = jnp.concatenate(
        [
            jnp.pad(options.grasp_enters, ((0, 0), (0, width - a))),
            jnp.pad(options.push_enters.reshape(n, -1), ((0, 0), (0, width - b * d))),
        ]
    )
    weights = jnp.ones(n) if weights is None else weights
    weight = jnp.tile(weights, 2)[:, None] * _shares(ways & ~enters, ways)
    choice, possible_at_all = _choose(key_choice, weight.reshape(-1))
    row, way = choice // width, choice % width
    is_grasp = row < n
    index = row % n

    grasp_wrist = jnp.asarray(grasp_variants(config.grasps, wrists)[1])
    side, push_wrist = (jnp.asarray(v) for v in push_variants(config, wrists))
    grasp = jnp.clip(way, 0, a - 1)
    push, distance = jnp.clip(way, 0, b * d - 1) // d, jnp.clip(way, 0, b * d - 1) % d
    T_grasp, T_push = options.grasp[index, grasp], options.push[index, push]
    wrist = jnp.where(is_grasp, grasp_wrist[grasp], push_wrist[push])
    length = side[push] * jnp.float32(config.push_distances)[distance]
    displacement = jnp.stack([jnp.zeros_like(length), length, jnp.zeros_like(length)])
    placed, T_place, T_object_place = _placement(
        key_place, space, tables, scene, possible, index, T_grasp, grasp_wrist[grasp]
    )
    able = possible_at_all & (~is_grasp | placed)
    kind = jnp.where(is_grasp, ActionKind.PICK_AND_PLACE, ActionKind.PUSH)
    T_world_gripper = jnp.where(is_grasp, T_grasp, T_push)
    T_world_place = jnp.where(is_grasp, T_place, translate(T_push, displacement))
    action = Action(
        kind=jnp.where(able, kind, ActionKind.NONE).astype(jnp.int32),
        object=index.astype(jnp.int32),
        T_world_gripper=T_world_gripper,
        displacement=jnp.where(is_grasp, jnp.zeros(3), displacement),
        T_world_place=T_world_place,
        q7=tables.q7[jnp.where(is_grasp, 0, 1), wrist],
        opening=jnp.where(is_grasp, space.gripper.max_opening, 0.0).astype(jnp.float32),
    )

    # A push sweeps the space between its ends, at places less than two finger widths apart; a placement only its end.
    T_object = make(scene.rotation[index], scene.position[index])
    way = displacement[None] * jnp.linspace(0.0, 1.0, 5)[:, None]
    ends = jnp.stack([T_grasp, T_place, T_place, T_place, T_place])
    grippers = jnp.where(is_grasp, ends, translate(jnp.broadcast_to(T_push, (5, 4, 4)), way))
    pushed = translate(jnp.broadcast_to(T_object, (5, 4, 4)), way)
    bodies = jnp.where(is_grasp, jnp.broadcast_to(T_object_place, (5, 4, 4)), pushed)
    cloud = tables.clouds[jnp.where(is_grasp, 0, 1), wrist].T
    body = superquadric.sample_surface(scene.size[index], scene.exponents[index], config.object_points)
    swept = jnp.concatenate([transform(grippers[:, None], cloud[None]), transform(bodies[:, None], body[None])], axis=1)
    return Sample(action, wrist, jnp.where(able, _risk(possible, swept), 0.0))


# --- A stand-in for the registry of kinds, until there is one -----------------------------------------------------------


def retrieve_action(T_world_gripper: Array, q7: Array, opening: Array) -> Action:
    """The action that takes the target out; any leading axes."""
    lead = jnp.shape(q7)
    return Action(
        kind=jnp.full(lead, ActionKind.RETRIEVE, jnp.int32),
        object=jnp.zeros(lead, jnp.int32),
        T_world_gripper=T_world_gripper,
        displacement=jnp.zeros((*lead, 3)),
        T_world_place=T_world_gripper,
        q7=jnp.asarray(q7, jnp.float32),
        opening=jnp.asarray(opening, jnp.float32),
    )


@dataclasses.dataclass(frozen=True)
class Kind:
    code: int
    name: str
    reference: object
    moves_object: bool = False
    holds_object: bool = False
    takes_target: bool = False
    returns_home: bool = False


def _reference(kind, action, config):
    from mechsearch_jax.robot import motion

    T, q7, opening = action.T_world_gripper, action.q7, action.opening
    if kind is ActionKind.PUSH:
        return motion.push_reference(T, action.displacement, q7, config)
    if kind is ActionKind.PICK_AND_PLACE:
        return motion.pick_and_place_reference(T, action.T_world_place, q7, opening, config)
    return motion.retrieve_reference(T, q7, opening, config) if kind is ActionKind.RETRIEVE else None


def _made(kind: ActionKind, name: str, **flags: bool) -> Kind:
    return Kind(int(kind), name, functools.partial(_reference, kind), **flags)


KINDS = {
    ActionKind.NONE: _made(ActionKind.NONE, "none"),
    ActionKind.PUSH: _made(ActionKind.PUSH, "push", moves_object=True, returns_home=True),
    ActionKind.PICK_AND_PLACE: _made(
        ActionKind.PICK_AND_PLACE, "pick-and-place", moves_object=True, holds_object=True, returns_home=True
    ),
    ActionKind.RETRIEVE: _made(ActionKind.RETRIEVE, "retrieve", takes_target=True),
}


def kind_of(code: int) -> Kind:
    if code not in set(KINDS):
        raise InputError(
            f"action kind {code} is unknown; there are {', '.join(f'{k.code} ({k.name})' for k in KINDS.values())}"
        )
    return KINDS[ActionKind(code)]
