"""How a target that has been found is taken out: the best of a dense set of grasps."""

from __future__ import annotations

import functools
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.retrieve import retrieve_action
from mechsearch_jax.actions.types import Action
from mechsearch_jax.compiled import kept
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, upright_pose
from mechsearch_jax.graspability import grasp_hits
from mechsearch_jax.planner.found_target import found_grasps, found_hits
from mechsearch_jax.planner.problem import Problem, TargetGrasps

# By how much objects are grown to find the grasp that keeps furthest from them [m].
CLEARANCES = (0.004, 0.008, 0.012, 0.02)


class GraspChoice(flax.struct.PyTreeNode):
    """How to take out a found target.

    Attributes:
      success: whether there is a grasp with which neither gripper, target nor arm hits anything on the whole way from
        outside the shelf and out again.
      hits: number of objects that the best grasp hits; one more than there can be if no grasp is feasible.
      action: takes it out with the best grasp: of those that hit fewest the one whose straight way keeps furthest from
        the objects.
    """

    success: jax.Array
    hits: jax.Array
    action: Action


@kept()
def graspable_at(
    problem: Problem, scene: Superquadrics, pose: Float[Array, "3"], active: Bool[Array, ""] | bool = True
) -> GraspChoice:
    """Whether and how a target at a pose can be grasped without hitting anything, with the problem's own grasps.

    Args:
      problem: what does not change.
      scene, pose, active: as in `best_grasp`.
    """
    return best_grasp(problem.target_grasps, scene, pose, active)


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
    return choice.replace(success=fewest == 0, hits=fewest.astype(jnp.int32))


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
    """All grasps: where the gripper closes, how many objects each hits, and by what they are ranked, least first."""

    T_world_gripper: Float[Array, "f 4 4"]
    hits: Int[Array, " f"]
    order: Int[Array, " f"]


def _ranked(
    grasps: TargetGrasps, scene: Superquadrics, pose: Float[Array, "3"], active: Bool[Array, ""] | bool
) -> _Ranked:
    T_world_target = upright_pose(pose, grasps.target.height(grasps.shelf))
    tables = grasps.tables
    found = found_grasps(grasps, T_world_target, active)
    here = jnp.asarray(active)[None]
    worst = scene.capacity + 1

    def count(clearance):
        return jnp.sum(grasp_hits(tables, found, scene.replace(size=scene.size + clearance), here), axis=1)

    hits = jnp.where(found.feasible, jnp.sum(found_hits(grasps, found, scene, active), axis=1), worst)
    crowd = jnp.sum(jax.lax.map(count, jnp.float32(CLEARANCES)), axis=0)
    return _Ranked(compose(T_world_target[None], tables.T_target_gripper), hits, hits * 100 + crowd)


def _choice(grasps: TargetGrasps, ranked: _Ranked, i: Int[Array, ""]) -> GraspChoice:
    T, q7 = ranked.T_world_gripper[i], grasps.tables.q7[i]
    return GraspChoice(
        success=ranked.hits[i] == 0,
        hits=ranked.hits[i].astype(jnp.int32),
        action=retrieve_action(T, q7, jnp.float32(grasps.gripper.max_opening)),
    )
