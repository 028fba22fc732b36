"""How a target that has been found is taken out: the best of a dense set of grasps."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.approach import CLOSE_WAYPOINTS
from mechsearch_jax.actions.retrieve import retrieve_action
from mechsearch_jax.actions.types import Action
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics, gauge, to_object_frame
from mechsearch_jax.geometry.transforms import compose, upright_pose
from mechsearch_jax.graspability import find_grasps, grasp_hits
from mechsearch_jax.planner.problem import Problem
from mechsearch_jax.robot.gripper import arm_points
from mechsearch_jax.robot.kinematics import line_kinematics, line_poses, path_kinematics

# By how much objects are grown to find the grasp that keeps furthest from them [m].
CLEARANCES = (0.0, 0.004, 0.008, 0.012, 0.02)
# On the approach to a found target: poses of the arm, and points on each of its capsules, that are tested.
ARM_WAYPOINTS, ARM_POINTS = 6, 7
# How far in front of the shelf the gripper has to get with the target [m].
OUTSIDE = 0.04


class GraspChoice(flax.struct.PyTreeNode):
    """How to take out a found target.

    Attributes:
      success: whether there is a grasp that hits nothing.
      hits: number of objects that the best grasp hits; one more than there can be if no grasp is feasible.
      action: takes it out with the best grasp: of those that hit fewest one with which the arm can leave the shelf, of
        those one with which links 2 to 5 touch fewest objects, and of those the one that keeps furthest from the
        objects.
    """

    success: jax.Array
    hits: jax.Array
    action: Action


def _leaves_shelf(
    problem: Problem, T_world_gripper: Float[Array, "g 4 4"], q7: Float[Array, " g"], feasible: Bool[Array, " g"]
) -> Bool[Array, " g"]:
    """Whether the arm can go on from the end of a retreat, along -x, until what it holds is outside the shelf.

    Looked at for feasible grasps only.
    """
    n, gripper, shelf = CLOSE_WAYPOINTS, problem.gripper, problem.shelf

    def leaves(_, row, i):
        T, q7 = row[0][i], row[1][i]
        back = line_poses(T, jnp.float32(gripper.approach), n)
        step = jnp.minimum(shelf.front - OUTSIDE - back[0, 0, 3], 0.0)
        out = jnp.broadcast_to(back[:1], (n - 1, 4, 4))
        out = out.at[:, 0, 3].add(step * jnp.linspace(1.0, 0.0, n)[:-1])
        return path_kinematics(jnp.concatenate([out, back]), q7)[1]

    return masked_vmap(leaves, feasible, None, (T_world_gripper, q7), block=64)


def _arm_touches(
    problem: Problem,
    scene: Superquadrics,
    T_world_gripper: Float[Array, "g 4 4"],
    q7: Float[Array, " g"],
    feasible: Bool[Array, " g"],
) -> Int[Array, " g"]:
    """How many objects links 2 to 5 run into on the approach to each grasp; looked at for feasible grasps only."""
    gripper = problem.gripper

    def touches(_, row, i):
        scene = jax.tree.map(lambda a: a[...], row[2])
        q, _ = line_kinematics(row[0][i], jnp.float32(gripper.approach), row[1][i], ARM_WAYPOINTS)
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

    def count(clearance):
        hits = grasp_hits(tables, found, scene.replace(size=scene.size + clearance), here)
        return jnp.where(found.feasible, jnp.sum(hits, axis=1), scene.capacity + 1)

    counts = jax.lax.map(count, jnp.float32(CLEARANCES))
    T = compose(T_world_target[None], tables.T_target_gripper)
    leaves = _leaves_shelf(problem, T, tables.q7, found.feasible)
    touches = _arm_touches(problem, scene, T, tables.q7, found.feasible)
    order = ((counts[0] * 2 + ~leaves) * 10 + touches) * 100 + jnp.sum(counts[1:], axis=0)
    best = jnp.argmin(order)
    return GraspChoice(
        success=counts[0, best] == 0,
        hits=counts[0, best].astype(jnp.int32),
        action=retrieve_action(T[best], tables.q7[best], jnp.float32(problem.gripper.max_opening)),
    )
