"""How a target that has been found is taken out: the best of a dense set of grasps.

A grasp counts if nothing is hit on the whole way in and out. But many that hit something only brush it, or push aside
what is free to move. So a few grasps are worth trying out, the clearest first; see `trials`.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.retrieve import retrieve_action
from mechsearch_jax.actions.types import Action
from mechsearch_jax.belief.found_target import found_grasps, found_hits
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, upright_pose
from mechsearch_jax.graspability import INFEASIBLE, grasp_hits
from mechsearch_jax.planner.trials import TRIES
from mechsearch_jax.problem.problem import Problem, TargetGrasps
from mechsearch_jax.runtime.compiled import kept

# By how much objects are grown to find the grasp that keeps furthest from them [m].
CLEARANCES = (0.004, 0.008, 0.012, 0.02)
# By how much they are shrunk to find the grasp that runs into them least deep [m].
DEPTHS = (0.006, 0.012, 0.024)
# Grasps are alike whose approaches differ by less than this, and whose angles of joint 7 do by less than that [rad].
ALIKE, ALIKE_WRIST = math.radians(10), math.radians(20)
# More than any rank of a grasp that arm and shelf allow.
FAR = 1_000_000


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


@kept()
def worth_trying(
    problem: Problem, scene: Superquadrics, pose: Float[Array, "3"], active: Bool[Array, ""] | bool = True
) -> GraspChoice:
    """`TRIES` grasps of a target at a pose that differ from each other, leading axis, best first.

    Those that hit nothing come first, ranked as for `best_grasp`, then those that run into objects least deep.

    Args:
      problem, scene, pose, active: as in `graspable_at`.
    """
    grasps = problem.target_grasps
    ranked = _ranked(grasps, scene, pose, active, DEPTHS)
    way, q7 = ranked.T_world_gripper[:, :3, 2], grasps.tables.q7

    def pick(order, _):
        i = jnp.argmin(order)
        alike = (jnp.sum(way * way[i][None], axis=-1) > math.cos(ALIKE)) & (jnp.abs(q7 - q7[i]) < ALIKE_WRIST)
        return (order + jnp.where(alike, FAR, 0)).at[i].add(100 * FAR), i

    _, best = jax.lax.scan(pick, ranked.order, length=min(TRIES, len(q7)))
    return jax.vmap(lambda i: _choice(grasps, ranked, i))(best)


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
    here = jnp.asarray(active)[None]

    def near(clearance):
        return jnp.sum(grasp_hits(tables, found, scene.replace(size=scene.size + clearance), here), axis=1)

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
