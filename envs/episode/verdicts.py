"""Verdicts on the true state, independent of the planner's belief: could the target be taken out now?"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, true_target_pose
from mechsearch_jax.envs.world.world import World
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.grasping.retrieval import (
    TargetGrasps,
    can_be_joined,
    found_grasps,
    found_hits,
    joined,
    target_grasps,
)
from mechsearch_jax.planner import Problem, paper
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.session.preparing import Program, program
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target


class Verdict(NamedTuple):
    """Whether a collision-free grasp of a target that has been found truly exists.

    Attributes:
      graspable: with the robot's own grasps.
      paper_graspable: with the paper's: see `paper_grasps`.
    """

    graspable: bool = False
    paper_graspable: bool = False


@functools.cache
def paper_grasps(shelf: Shelf, gripper: Gripper, target: Target) -> TargetGrasps:
    """The paper's candidate grasps (appendix B.3), independent of the method: those of g in preset `paper`.

    From the side and tilted by 20 degrees: of a cylinder 7 directions times 3 angles of joint 7, of a box 4 times 3.
    The way in and out is that of all grasps here, from outside the shelf with the whole arm, so that the two verdicts
    differ in the grasps alone. The paper's own way is shorter: straight, 0.3 m, checked for hand and links 6 and 7.

    Raises:
      InputError: the target is too wide for the gripper.
    """
    return target_grasps(shelf, gripper, target, paper().problem.grasps)


def judge(problem: Problem, snapshot: Snapshot) -> Verdict:
    """The verdict on a single scene."""
    objects, pose = objects_on_the_board(snapshot), true_target_pose(snapshot.world)
    return Verdict(*map(bool, jax.device_get(free_in_sets(judged_sets(problem), objects, pose))))


def programs(problem: Problem, objects: Superquadrics) -> list[Program]:
    """The programs of `judge` that take long to compile, for such objects."""
    return [program("verdict", free_in_sets, judged_sets(problem), objects, jnp.zeros(3))]


def judge_many(problem: Problem, worlds: World, active: Bool[Array, " n"]) -> list[Verdict]:
    """The verdicts on several scenes.

    Args:
      problem: of all scenes.
      worlds: fields with a leading axis.
      active: if False, the verdict is False, and hardly anything is computed.
    """
    success = jax.device_get(graspable_many(judged_sets(problem), problem.camera, worlds, active))
    return [Verdict(*map(bool, flags)) for flags in zip(*success, strict=True)]


def judged_sets(problem: Problem) -> tuple[TargetGrasps, TargetGrasps]:
    """The sets of grasps of a `Verdict`, in its order."""
    return problem.target_grasps, paper_grasps(problem.shelf, problem.gripper, problem.target)


@cached_jit()
def free_in_sets(
    sets: Sequence[TargetGrasps],
    scene: Superquadrics,
    pose: Float[Array, " 3"],
    active: Bool[Array, ""] | bool = True,
) -> list[Bool[Array, ""]]:
    """For each set of grasps of a target whether one hits nothing on its whole way: `best_grasp(...).success` of each,
    without a ranking, and all together where their grasps are tested alike.

    Args:
      sets: of the same target.
      scene, pose, active: as of `best_grasp`.
    """
    if not can_be_joined(sets):
        return [free for one in sets for free in free_in_sets([one], scene, pose, active)]
    grasps = joined(sets)
    found = found_grasps(grasps, grasps.standing(pose), active)
    free = found.feasible & ~jnp.any(found_hits(grasps, found, scene, active), axis=1)
    ends = np.cumsum([len(one.tables.q7) for one in sets])[:-1]
    return [jnp.any(part) for part in jnp.split(free, ends)]


@cached_jit()
def graspable_many(
    sets: Sequence[TargetGrasps], camera: Camera, worlds: World, active: Bool[Array, " n"]
) -> list[Bool[Array, " n"]]:
    """For each set of grasps whether it has a free one, in each of the worlds."""

    def graspable(world, active):
        objects = objects_on_the_board(Snapshot(camera, sets[0].shelf, world))
        return free_in_sets(sets, objects, true_target_pose(world), active)

    return jax.vmap(graspable)(worlds, active)
