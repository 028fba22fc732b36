"""How a target that has been found is taken out: the best of a dense set of grasps."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.approach import CLOSE_WAYPOINTS, CROSSING_PLACES
from mechsearch_jax.actions.retrieve import retrieve_action
from mechsearch_jax.actions.types import Action
from mechsearch_jax.geometry.collision import Pair, any_inside
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics, gauge, to_object_frame
from mechsearch_jax.geometry.transforms import compose, inverse, make, transform, upright_pose
from mechsearch_jax.graspability import GraspTables, boxes_overlap, find_grasps, grasp_hits
from mechsearch_jax.planner.problem import Problem
from mechsearch_jax.robot.entry import (
    CLOSE_CROSSINGS,
    FEW_CROSSINGS,
    arm_follows,
    crossing_length,
    crossing_poses,
    way_in,
)
from mechsearch_jax.robot.gripper import Gripper, arm_points
from mechsearch_jax.robot.kinematics import path_kinematics

# By how much objects are grown to find the grasp that keeps furthest from them [m].
CLEARANCES = (0.0, 0.004, 0.008, 0.012, 0.02)
# On the way in to a found target: poses of the arm on the approach, and points on each of its capsules, that are
# tested.
ARM_WAYPOINTS, ARM_POINTS = 6, 7


class GraspChoice(flax.struct.PyTreeNode):
    """How to take out a found target.

    Attributes:
      success: whether there is a grasp that hits nothing on its whole way from outside the shelf and out again.
      hits: number of objects that the best grasp hits; one more than there can be if no grasp is feasible.
      action: takes it out with the best grasp: of those that hit fewest one with which links 2 to 5 touch fewest
        objects, and of those the one that keeps furthest from the objects.
    """

    success: jax.Array
    hits: jax.Array
    action: Action


def _enters_shelf(
    problem: Problem, T_world_gripper: Float[Array, "g 4 4"], q7: Float[Array, " g"], feasible: Bool[Array, " g"]
) -> Bool[Array, " g"]:
    """Whether the arm can follow the way in closely from outside the shelf; out again it is the same.

    Looked at for feasible grasps only.
    """
    gripper = problem.gripper

    def enters(_, row, i):
        path = way_in(row[0][i], gripper.nearest_outside, gripper, CLOSE_CROSSINGS, CLOSE_WAYPOINTS)
        return arm_follows(path, row[1][i], problem.shelf)

    return masked_vmap(enters, feasible, None, (T_world_gripper, q7), block=64)


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
    # Boxes around gripper and target in the gripper's frame.
    target = transform(inverse(tables.T_target_gripper)[:, None], tables.still_target.T[None])
    low = jnp.minimum(jnp.min(tables.still_gripper, axis=-1)[tables.wrist], jnp.min(target, axis=1))
    high = jnp.maximum(jnp.max(tables.still_gripper, axis=-1)[tables.wrist], jnp.max(target, axis=1))
    T_objects = make(scene.rotation, scene.position)
    T_gripper_object = compose(inverse(places)[:, :, None], T_objects[None, None])
    mask = boxes_overlap(low[:, None, None], high[:, None, None], T_gripper_object, scene.size[None, None])
    mask &= (feasible & (length > 0.0))[:, None, None] & scene.valid[None, None]

    def pair(tables, row, i):
        places, scene = row
        k, place, j = i // (p * n), i // n % p, i % n
        target = transform(inverse(tables.T_target_gripper[k]), tables.still_target.T)
        cloud = jnp.concatenate([tables.still_gripper[tables.wrist[k]], target.T], axis=-1)
        T_object_world = inverse(make(scene.rotation[j], scene.position[j]))
        return Pair(cloud, compose(T_object_world, places[k, place]), scene.size[j], scene.exponents[j])

    hits = any_inside(mask.reshape(-1), pair, tables, (places, scene), block=128)
    return jnp.any(hits.reshape(g, p, n), axis=1)


def _arm_touches(
    problem: Problem,
    scene: Superquadrics,
    T_world_gripper: Float[Array, "g 4 4"],
    q7: Float[Array, " g"],
    feasible: Bool[Array, " g"],
) -> Int[Array, " g"]:
    """How many objects links 2 to 5 run into on the way in to each grasp; looked at for feasible grasps only."""
    gripper = problem.gripper

    def touches(_, row, i):
        scene = jax.tree.map(lambda a: a[...], row[2])
        path = way_in(row[0][i], gripper.nearest_outside, gripper, FEW_CROSSINGS, ARM_WAYPOINTS)
        q, _ = path_kinematics(path, row[1][i])
        points, radius = arm_points(q, ARM_POINTS)
        # A superquadric that is larger by the radius on every side holds all that is nearer than that to the object.
        size = scene.size[None] + radius[:, None, None]
        near = gauge(size, scene.exponents[None], to_object_frame(scene, points)) < 1.0
        return jnp.sum(jnp.any(near, axis=(0, 1)) & scene.valid)

    return masked_vmap(touches, feasible, None, (T_world_gripper, q7, scene), block=16)


@jax.jit
def graspable_at(
    problem: Problem, scene: Superquadrics, pose: Float[Array, "3"], active: Bool[Array, ""] | bool = True
) -> GraspChoice:
    """Whether and how a target at a pose can be grasped without hitting anything.

    Args:
      problem: what does not change.
      scene: the objects, without the target.
      pose: of the target as x, y [m], yaw [rad]; need not be a candidate.
      active: where false, no grasp is feasible and little is computed: there is no target yet.
    """
    T_world_target = upright_pose(pose, problem.target.height(problem.shelf))
    tables = problem.retrieval
    found = find_grasps(tables, problem.shelf, problem.gripper, problem.config.retrieval, T_world_target, active)
    here = jnp.asarray(active)[None]

    T = compose(T_world_target[None], tables.T_target_gripper)
    found = found.replace(feasible=_enters_shelf(problem, T, tables.q7, found.feasible))
    crossing = crossing_hits(tables, problem.gripper, scene, T_world_target, found.feasible)

    def count(clearance):
        hits = grasp_hits(tables, found, scene.replace(size=scene.size + clearance), here) | crossing
        return jnp.where(found.feasible, jnp.sum(hits, axis=1), scene.capacity + 1)

    counts = jax.lax.map(count, jnp.float32(CLEARANCES))
    touches = _arm_touches(problem, scene, T, tables.q7, found.feasible)
    order = (counts[0] * 10 + touches) * 100 + jnp.sum(counts[1:], axis=0)
    best = jnp.argmin(order)
    return GraspChoice(
        success=counts[0, best] == 0,
        hits=counts[0, best].astype(jnp.int32),
        action=retrieve_action(T[best], tables.q7[best], jnp.float32(problem.gripper.max_opening)),
    )
