"""The grasps of a target that has been found: which of them arm and shelf allow, what each hits, and which are best.

They are ten times as many as the candidates' grasps, and looked at more closely than g does: the way along x in front
of the straight approach counts too, and so do links 2 to 5.

A grasp counts if nothing is hit on the whole way in and out. But many that hit something only brush it, or push aside
what is free to move. So a few grasps are worth trying out, the clearest first; see `planner.trials`.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.approach import CLOSE_WAYPOINTS, CROSSING_PLACES
from mechsearch_jax.actions.kinds.retrieve import retrieve_action
from mechsearch_jax.actions.types import Action
from mechsearch_jax.geometry.collision import clouds_of, collisions
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, inverse, transform, upright_pose
from mechsearch_jax.graspability import INFEASIBLE, GraspConfig, GraspTables, feasible_grasps, grasp_tables
from mechsearch_jax.robot.arm_hits import arm_hits
from mechsearch_jax.robot.entry import arm_path, crossing_length, crossing_poses, way_in
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.kinematics import JOINTS
from mechsearch_jax.runtime.compiled import kept
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# So many grasps are tried out at most.
TRIES = 8
# Poses on the way along x of each grasp: at fewer the arm may pass a singularity unnoticed.
CROSSINGS = 15
# At which poses of the way in the arm is tested against objects: 5.5 cm apart at most, and half of that before the
# fingers close. Any nearer, it rules out grasps that take the target out: the arm is a little stouter here than it is.
ARM_POSES = np.array([*range(2, CROSSINGS, 4), *range(CROSSINGS, CROSSINGS + CLOSE_WAYPOINTS, 2)])
# By how much objects are grown to find the grasp that keeps furthest from them [m].
CLEARANCES = (0.004, 0.008, 0.012, 0.02)
# By how much they are shrunk to find the grasp that runs into them least deep [m].
DEPTHS = (0.006, 0.012, 0.024)
# Grasps are alike whose approaches differ by less than this, and whose angles of joint 7 do by less than that [rad].
ALIKE, ALIKE_WRIST = math.radians(10), math.radians(20)
# More than any rank of a grasp that arm and shelf allow.
FAR = 1_000_000


class TargetGrasps(flax.struct.PyTreeNode):
    """The grasps that a found target may be taken out with, and what else decides which of them are feasible.

    Attributes:
      tables: their constants.
      shelf: data.
      gripper, target, config: static.
    """

    tables: GraspTables
    shelf: Shelf
    gripper: Gripper = flax.struct.field(pytree_node=False)
    target: Target = flax.struct.field(pytree_node=False)
    config: GraspConfig = flax.struct.field(pytree_node=False)


class FoundGrasps(flax.struct.PyTreeNode):
    """The grasps of a target that has been found, whose pose need not be a candidate.

    Attributes:
      T_world_target: pose of the target, shape (4, 4).
      feasible: which grasps the arm and the shelf allow, shape (F,).
      q: joint angles at a few poses on the way in to each, shape (F, W, 7) [rad].
    """

    T_world_target: jax.Array
    feasible: jax.Array
    q: jax.Array


class GraspChoice(flax.struct.PyTreeNode):
    """How to take out a found target.

    Attributes:
      success: whether there is a grasp with which neither gripper, target nor arm hits anything on the whole way from
        outside the shelf and out again.
      feasible: whether arm and shelf allow the grasp.
      hits: number of objects that the grasp hits; `graspability.INFEASIBLE` if it is not feasible.
      action: takes it out with the best grasp: of those that hit fewest the one whose straight way keeps furthest from
        the objects.
    """

    success: jax.Array
    feasible: jax.Array
    hits: jax.Array
    action: Action


def target_grasps(shelf: Shelf, gripper: Gripper, target: Target, config: GraspConfig) -> TargetGrasps:
    """The grasps of a configuration for a target that has been found. Not to be called inside `jit`.

    Raises:
      InputError: the target is too wide for the gripper.
    """
    return TargetGrasps(grasp_tables(gripper, target, config), shelf, gripper, target, config)


def no_grasps(grasps: TargetGrasps) -> FoundGrasps:
    """Those of a target that has not been found."""
    count = grasps.tables.q7.shape[0]
    return FoundGrasps(jnp.eye(4), jnp.zeros(count, bool), jnp.zeros((count, len(ARM_POSES), len(JOINTS))))


def found_grasps(
    grasps: TargetGrasps, T_world_target: Float[Array, "4 4"], active: Bool[Array, ""] | bool = True
) -> FoundGrasps:
    """The grasps of a target at any pose that the arm and the shelf allow on the whole way in and out.

    Args:
      grasps: those to choose from.
      T_world_target: pose of the target.
      active: where false, none is feasible and little is computed: there is no target yet.
    """
    tables, gripper, shelf = grasps.tables, grasps.gripper, grasps.shelf
    feasible = feasible_grasps(tables, shelf, gripper, grasps.config, T_world_target[None], active)[0]

    def enters(shelf, _, row):
        T, q7 = row
        path = way_in(T, gripper.nearest_outside, gripper, CROSSINGS, CLOSE_WAYPOINTS)
        q, follows = arm_path(path, q7, shelf)
        return follows, q[ARM_POSES]

    T = compose(T_world_target[None], tables.T_target_gripper)
    able, q = masked_vmap(enters, feasible, shelf, None, (T, tables.q7), block=64)
    return FoundGrasps(T_world_target, feasible & able, q)


def straight_hits(
    tables: GraspTables, found: FoundGrasps, scene: Superquadrics, active: Bool[Array, ""] | bool = True
) -> Bool[Array, "f n"]:
    """Which objects gripper or target hit on the straight approach of each feasible grasp, and out again.

    Args:
      tables: the grasps.
      found: the target.
      scene: the objects, without the target.
      active: where false, nothing is hit and little is computed.
    """
    T_world_gripper = compose(found.T_world_target[None], tables.T_target_gripper)
    wanted = (found.feasible & jnp.asarray(active))[:, None] & scene.valid[None]
    return collisions(tables.swept, np.arange(len(tables.q7), dtype=np.int32), T_world_gripper, scene, wanted)


def found_hits(
    grasps: TargetGrasps,
    found: FoundGrasps,
    scene: Superquadrics,
    active: Bool[Array, ""] | bool = True,
    previous: Bool[Array, "f n"] | None = None,
    moved: Bool[Array, " n"] | None = None,
) -> Bool[Array, "f n"]:
    """Which objects the whole way of each grasp of a found target would hit; those that are not feasible hit none.

    Args:
      grasps: as of `found_grasps`.
      found: the target.
      scene: the objects, without the target.
      active: where false, nothing is hit and little is computed.
      previous: the same before some objects moved.
      moved: which objects moved since; only their columns are computed anew.
    """
    if found.feasible.shape[0] == 0:
        return jnp.zeros((0, scene.capacity), bool)
    here = jnp.asarray(active)
    fresh = scene.replace(valid=scene.valid if moved is None else scene.valid & moved)
    hits = straight_hits(grasps.tables, found, fresh, here)
    feasible = found.feasible & here
    hits |= crossing_hits(grasps.tables, grasps.gripper, fresh, found.T_world_target, feasible)

    def touches(_, scene, q):
        return jnp.any(arm_hits(q, scene), axis=0)

    hits |= masked_vmap(touches, feasible & jnp.any(fresh.valid), None, fresh, found.q, block=16)
    return hits if previous is None or moved is None else jnp.where(moved[None], hits, previous)


def crossing_hits(
    tables: GraspTables,
    gripper: Gripper,
    scene: Superquadrics,
    T_world_target: Float[Array, "4 4"],
    feasible: Bool[Array, " g"],
) -> Bool[Array, "g n"]:
    """Which objects gripper or target hit on the crossing of each grasp of a found target.

    Args:
      tables: the grasps.
      gripper: static.
      scene: the objects, without the target.
      T_world_target: where the target is.
      feasible: which grasps are looked at.
    """
    g, n, p = tables.q7.shape[0], scene.capacity, CROSSING_PLACES
    T = compose(T_world_target[None], tables.T_target_gripper)
    length = crossing_length(T, gripper.nearest_outside, gripper)
    places = crossing_poses(T, gripper.nearest_outside, gripper, p)
    target = transform(inverse(tables.T_target_gripper)[:, None], tables.still_target.T[None])
    still = clouds_of(jnp.concatenate([tables.still_gripper[tables.wrist], jnp.swapaxes(target, 1, 2)], axis=-1))
    # Few grasps cross.
    crosses = feasible & (length > 0.0)
    wanted = jnp.repeat(crosses[:, None] & scene.valid[None], p, axis=0)
    hits = collisions(still, jnp.repeat(jnp.arange(g), p), places.reshape(-1, 4, 4), scene, wanted)
    return jnp.any(hits.reshape(g, p, n), axis=1)


@kept()
def worth_trying(
    grasps: TargetGrasps, scene: Superquadrics, pose: Float[Array, "3"], active: Bool[Array, ""] | bool = True
) -> GraspChoice:
    """`TRIES` grasps of a target at a pose that differ from each other, leading axis, best first.

    Those that hit nothing come first, ranked as for `best_grasp`, then those that run into objects least deep.

    Args:
      grasps, scene, pose, active: as in `best_grasp`.
    """
    ranked = _ranked(grasps, scene, pose, active, DEPTHS)
    way, q7 = ranked.T_world_gripper[:, :3, 2], grasps.tables.q7

    def pick(order, _):
        i = jnp.argmin(order)
        alike = (jnp.sum(way * way[i][None], axis=-1) > math.cos(ALIKE)) & (jnp.abs(q7 - q7[i]) < ALIKE_WRIST)
        return (order + jnp.where(alike, FAR, 0)).at[i].add(100 * FAR), i

    _, best = jax.lax.scan(pick, ranked.order, length=min(TRIES, len(q7)))
    return jax.vmap(lambda i: _choice(grasps, ranked, i))(best)


@kept()
def best_grasp(
    grasps: TargetGrasps, scene: Superquadrics, pose: Float[Array, "3"], active: Bool[Array, ""] | bool = True
) -> GraspChoice:
    """Whether and how a target at a pose can be grasped with some grasps without hitting anything.

    Args:
      grasps: those to choose from.
      scene: the objects, without the target.
      pose: of the target as x, y [m], yaw [rad]; need not be a candidate.
      active: where false, no grasp is feasible and little is computed: there is no target yet.
    """
    ranked = _ranked(grasps, scene, pose, active)
    # Not of the best: who asks for these alone need not know how near others are.
    fewest = jnp.min(ranked.hits)
    choice = _choice(grasps, ranked, jnp.argmin(ranked.order))
    return choice.replace(success=fewest == 0, feasible=jnp.any(ranked.feasible), hits=fewest.astype(jnp.int32))


@functools.partial(jax.jit, static_argnames=("count",))
def best_grasps(grasps: TargetGrasps, scene: Superquadrics, pose: Float[Array, "3"], count: int) -> GraspChoice:
    """The `count` best grasps of a target at a pose, ranked as for `best_grasp`; leading axis, best first.

    Args:
      grasps, scene, pose: as in `best_grasp`.
      count: how many; not more than there are.
    """
    ranked = _ranked(grasps, scene, pose, True)
    best = jnp.argsort(ranked.order, stable=True)[:count]
    return jax.vmap(lambda i: _choice(grasps, ranked, i))(best)


class _Ranked(NamedTuple):
    """All grasps: where the gripper closes, whether each is feasible, how many objects it hits, and by what they are
    ranked, least first."""

    T_world_gripper: Float[Array, "f 4 4"]
    feasible: Bool[Array, " f"]
    hits: Int[Array, " f"]
    order: Int[Array, " f"]


def _ranked(
    grasps: TargetGrasps,
    scene: Superquadrics,
    pose: Float[Array, "3"],
    active: Bool[Array, ""] | bool,
    depths: tuple[float, ...] = (),
) -> _Ranked:
    """All grasps, ranked by how many objects they hit and how near they come to others.

    Args:
      grasps, scene, pose, active: as in `best_grasp`.
      depths: by how much objects are shrunk [m]: what a grasp hits even then goes before how many it hits.
    """
    T_world_target = upright_pose(pose, grasps.target.height(grasps.shelf))
    tables = grasps.tables
    found = found_grasps(grasps, T_world_target, active)

    def near(clearance):
        return jnp.sum(straight_hits(tables, found, scene.replace(size=scene.size + clearance), active), axis=1)

    def hit(depth):
        slim = scene.replace(size=jnp.maximum(scene.size - depth, 0.25 * scene.size))
        return jnp.sum(found_hits(grasps, found, slim, active), axis=1)

    all_hits, *deeper = jax.lax.map(hit, jnp.float32((0.0, *depths)))
    hits = jnp.where(found.feasible, all_hits, INFEASIBLE)
    crowd = jnp.sum(jax.lax.map(near, jnp.float32(CLEARANCES)), axis=0)
    # What arm or shelf do not allow comes last, after all that is alike.
    order = jnp.where(found.feasible, 1000 * sum(deeper, jnp.zeros_like(hits)) + 100 * hits + crowd, 10 * FAR)
    return _Ranked(compose(T_world_target[None], tables.T_target_gripper), found.feasible, hits, order)


def _choice(grasps: TargetGrasps, ranked: _Ranked, i: Int[Array, ""]) -> GraspChoice:
    T, q7 = ranked.T_world_gripper[i], grasps.tables.q7[i]
    return GraspChoice(
        success=ranked.feasible[i] & (ranked.hits[i] == 0),
        feasible=ranked.feasible[i],
        hits=ranked.hits[i].astype(jnp.int32),
        action=retrieve_action(T, q7, jnp.float32(grasps.gripper.max_opening)),
    )
