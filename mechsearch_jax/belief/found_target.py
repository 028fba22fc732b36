"""A target that has been found: the grasps that it can be taken out with, and what is in the way of each.

They are ten times as many as the candidates' grasps, and looked at more closely: the way along x in front of the
straight approach counts too, and so do links 2 to 5.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions.approach import CLOSE_WAYPOINTS, CROSSING_PLACES
from mechsearch_jax.geometry.collision import clouds_of, collisions
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, inverse, transform
from mechsearch_jax.graspability import FoundGrasps, GraspTables, feasible_grasps, grasp_hits
from mechsearch_jax.problem.problem import TargetGrasps
from mechsearch_jax.robot.arm_hits import arm_hits
from mechsearch_jax.robot.entry import arm_path, crossing_length, crossing_poses, way_in
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.kinematics import JOINTS

# Poses on the way along x of each grasp: at fewer the arm may pass a singularity unnoticed.
CROSSINGS = 15
# At which poses of the way in the arm is tested against objects: 5.5 cm apart at most, and half of that before the
# fingers close. Any nearer, it rules out grasps that take the target out: the arm is a little stouter here than it is.
ARM_POSES = np.array([*range(2, CROSSINGS, 4), *range(CROSSINGS, CROSSINGS + CLOSE_WAYPOINTS, 2)])


def no_grasps(grasps: TargetGrasps) -> FoundGrasps:
    """Those of a target that has not been found."""
    count = grasps.tables.found_grasp.shape[0]
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
      grasps: as `found_grasps` was told.
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
    hits = grasp_hits(grasps.tables, found, fresh, here[None])
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
