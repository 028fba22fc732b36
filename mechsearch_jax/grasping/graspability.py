"""The graspability function g: could the target be grasped where it is? (paper appendix B.3; docs/method.md,
"Graspability")

The swept volume of a grasp (hand, fingers, links 7 and 6 on their straight way in, and the target on its way out) is a
constant point cloud in the target's frame. Which grasps arm and shelf allow at a candidate pose does not depend on the
objects. So the feasible pairs of a candidate pose and a grasp are listed once, and a scene only adds the table
H[pair, object] of hits. When one object moves, its column is recomputed.

An approximation: if the straight way in begins inside the shelf, the gripper first moves there along x. Feasibility
includes this motion of the arm, but H includes neither its hits nor those of links 2 to 5; `retrieval` tests both for a
found target.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from mechsearch_jax.actions.kinds.object_grasps import PALM
from mechsearch_jax.geometry.collision import Clouds, collisions, dense_clouds
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, make, upright_pose
from mechsearch_jax.grasping.antipodal import WRISTS, antipodal_grasps
from mechsearch_jax.grasping.closings import MOST, level_grasps
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.robot.entry import WaysIn, gripper_enters
from mechsearch_jax.robot.grasp_frames import WRIST_ORIGIN, gripper_rotation
from mechsearch_jax.robot.gripper import Gripper, gripper_cloud, swept_cloud
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.shapes.compound import Compound
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target
from mechsearch_jax.workspace.target_view import swept_target

# Number of points of a swept cloud that cover it coarsely.
COARSE = 256
# Number of hits that a pose without a feasible grasp counts for: one more than the eight objects of a scene and its
# target, for any number of slots.
INFEASIBLE = 10
# The numbers of feasible pairs in all, and at a pose, are rounded up to multiples of these.
PAIRS_STEP, POSE_STEP = 1024, 8
# Of a target of pieces a pose has so many pairs at most, and all poses together half as many each on average; and the
# same for one that is a solid of revolution. Fixed numbers, so that all such targets share their programs.
PIECES_PAIRS, ROUND_PAIRS = 16, 32
# Where the gripper is in rows that hold no grasp: out of the arm's reach [m].
NO_GRASP = 10.0


class GraspTables(PyTreeNode):
    """Grasps of the target and their swept clouds: constants of a `Problem`. Clouds are rows of coordinates [m].

    Attributes:
      T_target_gripper: pose of the gripper where it closes, shape (G, 4, 4).
      q7: angle of joint 7 in each grasp [rad], shape (G,).
      wrist: index of the wrist's swept gripper cloud, shape (G,).
      turned: whether the approach is turned from square to a flat side, see `GraspConfig.turn`, shape (G,).
      ahead: least cosine of the angle between the approach and +x, seen from above, shape (G,).
      swept: the G clouds of points that gripper and target sweep in each grasp, in the gripper's frame.
      still_gripper: points on the open gripper with each wrist, in its own frame, shape (W, 3, S).
      still_target: surface of the target in its own frame, shape (3, R).
    """

    T_target_gripper: jax.Array
    q7: jax.Array
    wrist: jax.Array
    turned: jax.Array
    ahead: jax.Array
    swept: Clouds
    still_gripper: jax.Array
    still_target: jax.Array


class CandidateGrasps(GraspTables):
    """Grasps of the target, and which of them are feasible at its candidate poses: constants of a `Problem`.

    Attributes:
      T_world_target: candidate poses, shape (X, 4, 4).
      pair_pose, pair_grasp: the feasible pairs, shape (K,), ordered by pose; padded with the last one, so that the
        shape seldom changes if the shelf is moved a little.
      pair_valid: false for padding, shape (K,).
      pose_pairs: indices of the pairs of each candidate pose, padded with K, shape (X, P).
    """

    T_world_target: jax.Array
    pair_pose: jax.Array
    pair_grasp: jax.Array
    pair_valid: jax.Array
    pose_pairs: jax.Array


class _Grasps(NamedTuple):
    """Grasps of a target, the index of the wrist of each, the angles of the wrists [rad], the room for grasps, and
    those that are turned from square."""

    T_target_gripper: Float[Array, "g 4 4"]
    wrist: Int[np.ndarray, " g"]
    wrists: tuple[float, ...]
    room: int
    turned: Bool[np.ndarray, " g"]


def _target_grasps(target: Target, gripper: Gripper, config: GraspConfig) -> _Grasps:
    """The grasps of a target.

    Raises:
      InputError: no grasp fits the target.
    """
    if target.compound is not None:
        return _compound_grasps(target, target.compound, gripper, config)
    shape = shape_of(target.shape)
    yaws, widths = shape.grasps(target.half_size, config.yaws, config.max_yaw)
    yaws = yaws[widths <= gripper.usable_opening]
    if len(yaws) == 0:
        raise InputError(
            f"Target: {min(widths):.3f} m wide, but the gripper takes {gripper.usable_opening} m; use a thinner target"
        )
    square = len(yaws)
    if config.turn and not shape.round:
        yaws = np.append(yaws, _turned(yaws, target.half_size, gripper, config.turn))
    grasps = np.stack(np.meshgrid(yaws, config.tilts, np.arange(len(config.wrists)), indexing="ij"), -1).reshape(-1, 3)
    yaw, tilt = grasps[:, :2].T.astype(np.float32)
    wrist = grasps[:, 2].astype(int)
    height = min(config.height, 0.6 * target.half_size[2])
    above = np.broadcast_to(np.array([0.0, 0.0, height], np.float32), (len(grasps), 3))
    turned = np.repeat(np.arange(len(yaws)) >= square, len(wrist) // len(yaws))
    return _Grasps(_posed(yaw, tilt, above), wrist, config.wrists, len(wrist), turned)


def _turned(
    yaws: Float[np.ndarray, " y"], half_size: tuple[float, float, float], gripper: Gripper, turn: float
) -> Float[np.ndarray, " t"]:
    """The yaws turned to either side by an angle [rad], where the box fits between fingers and palm all the same."""
    yaws = np.concatenate([yaws - turn, yaws + turn])
    x, y = half_size[:2]
    across, along = np.abs([[np.sin(yaws), np.cos(yaws)], [np.cos(yaws), np.sin(yaws)]]).swapaxes(1, 2) @ [x, y]
    return yaws[(2 * across <= gripper.usable_opening) & (along <= PALM)]


def _posed(yaw: np.ndarray, tilt: np.ndarray, point: np.ndarray) -> Float[Array, "g 4 4"]:
    """`T_target_gripper` of grasps with these angles [rad] and points between the fingers [m]."""
    return jax.jit(lambda yaw, tilt, point: make(gripper_rotation(yaw, tilt), point))(yaw, tilt, point)


def _compound_grasps(target: Target, compound: Compound, gripper: Gripper, config: GraspConfig) -> _Grasps:
    """`_target_grasps` of a target of pieces: its `antipodal_grasps` if they are wanted or there are no level ones."""
    room = config.antipodal or MOST * len(config.tilts) * len(config.wrists)
    if not config.antipodal:
        directions = shape_of("cylinder").grasps(target.half_size, config.yaws, config.max_yaw)[0]
        yaws = directions.tolist() if target.solid.round else None
        T, wrist = level_grasps(compound, gripper, yaws, config.tilts, len(config.wrists), config.height)
        if len(T):
            return _Grasps(jnp.asarray(T, jnp.float32), wrist, config.wrists, room, np.zeros(room, bool))
    # Of one that looks alike at every yaw grasps about +x do.
    widest = config.max_yaw if target.solid.round else math.pi
    T, wrist = antipodal_grasps(compound, gripper, room, widest)
    if not len(T):
        raise InputError(
            f"Target: the gripper fits nowhere: it takes {gripper.usable_opening} m between two opposite sides that its"
            " open fingers reach from the side or from above; use another target"
        )
    return _Grasps(jnp.asarray(T, jnp.float32), wrist, WRISTS, room, np.zeros(room, bool))


def feasible_grasps(
    tables: GraspTables,
    shelf: Shelf,
    gripper: Gripper,
    config: GraspConfig,
    T_world_target: Float[Array, "n 4 4"],
    active: Bool[Array, ""] | bool = True,
) -> Bool[Array, "n g"]:
    """Which grasps arm and shelf allow at target poses, regardless of the objects.

    The approach must be within the grasp's limit of +x, the whole way in from outside the shelf reachable, and neither
    the arm nor the swept cloud may touch the shelf. If `active` is false, no grasp is feasible and little is computed.
    """
    n, g = T_world_target.shape[0], tables.q7.shape[0]
    T = compose(T_world_target[:, None], tables.T_target_gripper[None])
    ahead = T[..., 0, 2] >= tables.ahead[None] * jnp.sqrt(T[..., 0, 2] ** 2 + T[..., 1, 2] ** 2)
    ahead &= active

    ways = WaysIn(T.reshape(-1, 4, 4), jnp.tile(tables.q7, n), np.tile(np.arange(g), n))
    return gripper_enters(shelf, gripper, config.waypoints, tables.swept.points, ways, ahead.reshape(-1)).reshape(n, g)


def grasp_tables(gripper: Gripper, target: Target, config: GraspConfig) -> GraspTables:
    """Precompute the target's grasps and their swept clouds.

    Raises:
      InputError: the target is too wide for the gripper.
    """
    T_target_gripper, wrist, wrists, room, turned = _target_grasps(target, gripper, config)
    count = len(wrist)
    if target.is_compound:
        T_target_gripper, wrist = filled_up(T_target_gripper, wrist, room)
    angles = [WRIST_ORIGIN + a for a in wrists]
    swept = [swept_cloud(gripper, gripper.max_opening, a, config.points) for a in angles]
    still = [gripper_cloud(gripper, gripper.max_opening, a, config.still_points[0]) for a in angles]
    outward = -np.asarray(T_target_gripper)[:, :3, 2]
    # Every leading part of a cloud covers gripper and target evenly.
    progress = [np.arange(n) / n for n in (config.points, config.target_points)]
    order = np.argsort(np.concatenate(progress), kind="stable")
    clouds = []
    # Grasps that differ only in their wrists take the target out in the same direction.
    directions = {d.tobytes(): d for d in outward}
    swept_targets = {
        key: swept_target(target, direction, gripper.approach, config.target_points, config.erosion)
        for key, direction in directions.items()
    }
    for T, w, direction in list(zip(np.asarray(T_target_gripper), wrist, outward, strict=True))[:count]:
        inside = (swept_targets[direction.tobytes()] - T[:3, 3]) @ T[:3, :3]
        clouds.append(np.concatenate([swept[w], inside])[order])
    of_grasps = dense_clouds(np.stack(clouds), COARSE)
    filled = np.minimum(np.arange(len(wrist)), count - 1)
    still_target = swept_target(target, np.array([1.0, 0.0, 0.0]), 0.0, config.still_points[1], config.erosion)
    fields = {
        "T_target_gripper": T_target_gripper,
        "q7": np.asarray(angles, np.float32)[wrist],
        "wrist": np.int32(wrist),
        "turned": turned,
        # Approaches at the limit count.
        "ahead": np.full(len(wrist), math.cos(config.max_yaw + 1e-4), np.float32),
        "swept": jax.tree.map(lambda a: a[filled], of_grasps),
        "still_gripper": np.float32(np.stack([cloud.T for cloud in still])),
        "still_target": np.float32(still_target.T),
    }
    return GraspTables(**jax.device_put(fields))


def candidate_grasps(shelf: Shelf, gripper: Gripper, target: Target, config: GraspConfig) -> CandidateGrasps:
    """Precompute the target's grasps and the feasible pairs of a candidate pose and a grasp.

    Raises:
      InputError: the target is too wide for the gripper.
    """
    tables = grasp_tables(gripper, target, config)
    poses = np.asarray(jax.jit(upright_pose)(target.candidate_poses(shelf), target.height(shelf)))
    feasible = jax.jit(lambda tables, shelf, poses: feasible_grasps(tables, shelf, gripper, config, poses))
    able = np.asarray(feasible(tables, shelf, jax.device_put(poses)))
    most = None if not target.is_compound else ROUND_PAIRS if target.round else PIECES_PAIRS
    fields = {"T_world_target": poses, **pair_tables(able, most)}
    return CandidateGrasps(**vars(tables), **jax.device_put(fields))


class Pairs(NamedTuple):
    """Meaning of the rows of H: those of the candidate poses, then those of a found target.

    Attributes:
      pose: index of the pose, candidate poses first and then the found pose, shape (K,), in ascending order.
      allowed: whether arm and shelf allow the grasp, shape (K,).
      pose_pairs: the rows of each candidate pose, padded with `candidate_pose_rows`, shape (X, P).
      candidate_pose_rows: number of rows of the candidate poses.
      found: whether rows of a found target follow.
    """

    pose: Int[Array, " k"]
    allowed: Bool[Array, " k"]
    pose_pairs: Int[Array, "x p"]
    candidate_pose_rows: int
    found: bool


def pairs(tables: CandidateGrasps, feasible: Bool[Array, " f"] | None = None) -> Pairs:
    """The rows of H.

    Args:
      tables: constants of the problem.
      feasible: which grasps of a found target are feasible; if left out, there are only rows of candidate poses.
    """
    pose, allowed, table = tables.pair_pose, tables.pair_valid, tables.pose_pairs
    if feasible is None:
        return Pairs(pose, allowed, table, len(pose), False)
    both = jnp.concatenate([pose, jnp.full(feasible.shape, len(table), jnp.int32)])
    return Pairs(both, jnp.concatenate([allowed, feasible]), table, len(pose), True)


def no_hits(rows: Pairs, capacity: int) -> Bool[Array, "k n"]:
    """H of `capacity` objects before any test: no hits."""
    return jnp.zeros((rows.pose.shape[0], capacity), bool)


def grasp_hits(
    tables: CandidateGrasps,
    scene: Superquadrics,
    exists: Bool[Array, " x"],
    previous: Bool[Array, "k n"] | None = None,
    moved: Bool[Array, " n"] | None = None,
) -> Bool[Array, "k n"]:
    """H of the candidate poses: which objects the grasp of each feasible pair would hit.

    Args:
      tables: constants of the problem.
      scene: the objects, fields (N, ...).
      exists: candidate poses for which H is computed; it is False elsewhere.
      previous: H before some objects moved.
      moved: which objects moved since; only their columns are computed anew.

    Returns:
      H, shape (pairs, N).
    """
    fresh = scene.valid if moved is None else moved & scene.valid
    grasp, T_world_target = tables.pair_grasp, tables.T_world_target[tables.pair_pose]
    counts = exists[tables.pair_pose] & tables.pair_valid
    T_world_gripper = compose(T_world_target, tables.T_target_gripper[grasp])
    hit = collisions(tables.swept, grasp, T_world_gripper, scene, counts[:, None] & fresh[None])
    if previous is None or moved is None:
        return hit
    return jnp.where(moved[None], hit, previous)


def _per_pose(reduce: Callable[[Array], Array], rows: Pairs, hits: Bool[Array, "k n"]) -> Shaped[Array, " y"]:
    """Reduce the numbers of hits of the grasps at each pose, shape (*batch, P), with -1 for infeasible grasps."""
    count = jnp.where(rows.allowed, jnp.sum(hits, axis=1, dtype=jnp.int32), -1)
    at_candidate_poses, at_found_pose = jnp.split(count, [rows.candidate_pose_rows])
    values = reduce(jnp.append(at_candidate_poses, -1)[rows.pose_pairs])
    return jnp.append(values, reduce(at_found_pose)) if rows.found else values


def graspability(rows: Pairs, hits: Bool[Array, "k n"]) -> Int[Array, " y"]:
    """g at all poses from H: 1 minus the least number of objects that a feasible grasp hits (equation 17).

    A pose without a feasible grasp counts as hitting `INFEASIBLE` objects, for any number of slots.
    """

    def least(count):
        return jnp.min(jnp.where(count < 0, INFEASIBLE, count), axis=-1, initial=INFEASIBLE)

    return 1 - _per_pose(least, rows, hits)


def crowding(rows: Pairs, hits: Bool[Array, "k n"]) -> Float[Array, " y"]:
    """Mean number of objects that the feasible grasps of each pose hit; 0 if none is feasible."""

    def mean(count):
        feasible = jnp.maximum(jnp.sum(count >= 0, axis=-1), 1)
        return jnp.sum(jnp.maximum(count, 0), axis=-1) / feasible.astype(jnp.float32)

    return _per_pose(mean, rows, hits)


def split_found(values: Shaped[Array, " y"]) -> tuple[Shaped[Array, " x"], Shaped[Array, ""]]:
    """Split values at all poses into those at candidate poses and that at the found pose."""
    return values[:-1], values[-1]


def filled_up(
    T_target_gripper: Float[Array | np.ndarray, "g 4 4"], wrist: Int[np.ndarray, " g"], rows: int
) -> tuple[Float[np.ndarray, "rows 4 4"], Int[np.ndarray, " rows"]]:
    """Grasps with as many rows as others have; those beyond the given ones are feasible nowhere."""
    T = np.asarray(T_target_gripper)
    none = T[-1:].copy()
    none[:, 2, 3] = -NO_GRASP
    missing = rows - len(T)
    return np.concatenate([T, np.repeat(none, missing, axis=0)]), np.pad(wrist, (0, missing), mode="edge")


def is_grasp(T_target_gripper: Float[Array | np.ndarray, "g 4 4"]) -> Bool[np.ndarray, " g"]:
    """Which of the rows of `filled_up` hold a grasp."""
    return np.asarray(T_target_gripper)[:, 2, 3] > -0.5 * NO_GRASP


def pair_tables(able: Bool[np.ndarray, "x g"], most: int | None = None) -> dict[str, Any]:
    """The fields of `CandidateGrasps` for the feasible pairs of a candidate pose and a grasp.

    Args:
      able: which grasps are feasible at which poses.
      most: room for pairs at a pose; there are half as many rows in all on average. The least in steps if None.
    """
    pose, grasp = np.nonzero(able if most is None else thinned(able, most))
    poses = len(able)
    count = np.bincount(pose, minlength=poses)
    place = np.arange(len(pose)) - np.repeat(np.cumsum(count) - count, count)
    width, rows = int(count.max(initial=0)), len(pose) + -len(pose) % PAIRS_STEP
    width = width + -width % POSE_STEP
    if most is not None:
        rows, width = poses * most // 2, most
    pose_pairs = np.full((poses, width), rows, np.int32)
    pose_pairs[pose, place] = np.arange(len(pose))
    return {
        "pair_pose": np.int32(np.pad(pose, (0, rows - len(pose)), mode="edge") if len(pose) else pose),
        "pair_grasp": np.int32(np.pad(grasp, (0, rows - len(pose)), mode="edge") if len(pose) else grasp),
        "pair_valid": np.arange(rows if len(pose) else 0) < len(pose),
        "pose_pairs": pose_pairs,
    }


def thinned(able: Bool[np.ndarray, "x g"], most: int) -> Bool[np.ndarray, "x g"]:
    """Feasible pairs of poses and grasps, at most `most` at a pose and half as many on average.

    What is left out lies evenly between what stays: neighbouring grasps are alike.
    """
    count, room = able.sum(axis=1), len(able) * most // 2
    while np.minimum(count, most).sum() > room:
        most -= 1
    kept = np.minimum(count, most)
    rank = np.cumsum(able, axis=1) - 1
    # Of `count` in order, those where the number of the kept ones so far rises.
    share = kept[:, None] / np.maximum(count, 1)[:, None]
    return able & (np.floor((rank + 1) * share + 1e-9) > np.floor(rank * share + 1e-9))
