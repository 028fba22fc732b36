"""Verdicts on the true state, whatever the planner believes: could the target be taken out now?"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, true_target_pose
from mechsearch_jax.envs.world.world import World
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, transform, upright_pose
from mechsearch_jax.planner import Problem, paper
from mechsearch_jax.retrieval import TargetGrasps, best_grasp, no_grasps, straight_hits, target_grasps
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.compiled import kept
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf, hits_shelf
from mechsearch_jax.workspace.target import Target


class Verdict(NamedTuple):
    """Whether a collision-free grasp of a target that has been found truly exists.

    Attributes:
      graspable: among the grasps that the robot takes it out with.
      paper_graspable: among the paper's: see `paper_grasps`.
    """

    graspable: bool = False
    paper_graspable: bool = False


@functools.cache
def paper_grasps(shelf: Shelf, gripper: Gripper, target: Target) -> TargetGrasps:
    """The paper's candidate grasps (appendix B.3), whatever a method's own are: those of g in preset `paper`.

    From the side and tilted by 20 degrees: of a cylinder 7 directions times 3 angles of joint 7, of a box 4 times 3.
    The way in and out is that of all grasps here, from outside the shelf with the whole arm, so that the two verdicts
    differ in the grasps alone. The paper's own way is shorter, the straight 0.3 m of hand and links 6 and 7.

    Raises:
      InputError: the target is too wide for the gripper.
    """
    return target_grasps(shelf, gripper, target, paper().problem.grasps)


def judge(problem: Problem, here: Snapshot) -> Verdict:
    """The verdict on one scene."""
    objects, pose = objects_on_the_board(here), true_target_pose(here.world)
    # Called as the policies call it, so that nothing is compiled twice.
    free = [best_grasp(grasps, objects, pose).success for grasps in judged_sets(problem)]
    return Verdict(*map(bool, jax.device_get(free)))


def judge_many(problem: Problem, worlds: World, active: Bool[Array, " n"]) -> list[Verdict]:
    """The verdicts on several scenes; fields of `worlds` have a leading axis. Next to nothing is computed, and the
    verdict is no, where `active` is false.
    """
    found = jax.device_get(graspable_many(judged_sets(problem), problem.camera, worlds, active))
    return [Verdict(*map(bool, each)) for each in zip(*found, strict=True)]


def judged_sets(problem: Problem) -> tuple[TargetGrasps, TargetGrasps]:
    """The sets of grasps that a `Verdict` is about, in its order."""
    return problem.target_grasps, paper_grasps(problem.shelf, problem.gripper, problem.target)


def swept_free(
    grasps: TargetGrasps, scene: Superquadrics, pose: Float[Array, " 3"], active: Bool[Array, ""]
) -> Bool[Array, ""]:
    """Whether at some grasp what gripper and target sweep, on the straight approach and out again, meets nothing.

    Neither the objects nor the shelf; the arm is not looked at, nor whether it gets there.

    Args:
      grasps: those to choose from.
      scene: the objects, without the target.
      pose: of the target as x, y [m], yaw [rad].
      active: where false, the answer is no, and little is computed.
    """
    tables, shelf = grasps.tables, grasps.shelf
    T_world_target = upright_pose(pose, grasps.target.height(shelf))

    T_world_gripper = compose(T_world_target[None], tables.T_target_gripper)

    def touches(shelf, _, row):
        T, cloud = row
        return jnp.any(hits_shelf(shelf, transform(T, cloud.T)))

    wanted = jnp.broadcast_to(active, tables.q7.shape)
    free = wanted & ~masked_vmap(touches, wanted, shelf, None, (T_world_gripper, tables.clouds))
    found = no_grasps(grasps).replace(T_world_target=T_world_target, feasible=free)
    hits = straight_hits(tables, found, scene, active)
    return jnp.any(free & ~jnp.any(hits, axis=1))


@kept()
def graspable_many(
    sets: Sequence[TargetGrasps], camera: Camera, worlds: World, active: Bool[Array, " n"]
) -> list[Bool[Array, " n"]]:
    """For each set of grasps whether one of them is free, in each of the worlds."""

    def one(here, active):
        objects = objects_on_the_board(Snapshot(camera, sets[0].shelf, here))
        return [best_grasp(grasps, objects, true_target_pose(here), active).success for grasps in sets]

    return jax.vmap(one)(worlds, active)
