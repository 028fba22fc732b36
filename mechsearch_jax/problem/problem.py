"""What does not change in an episode, and all that can be computed from it before it begins."""

from __future__ import annotations

import flax.struct
import jax
import numpy as np

from mechsearch_jax.actions.config import ActionSpace, ActionTables, action_tables
from mechsearch_jax.actions.registry import check_kinds
from mechsearch_jax.config.config import ProblemConfig
from mechsearch_jax.existence import ExistenceTables, existence_tables
from mechsearch_jax.graspability import GraspConfig, GraspTables, grasp_tables
from mechsearch_jax.robot.entry import check_outside
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.cores import on_host
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.sight import check_camera
from mechsearch_jax.workspace.target import Target

# What is said of a shelf in which no grasp of the target is feasible.
NOWHERE = "shelf: the arm reaches the target nowhere; check the shelf's place before the robot"


class TargetGrasps(flax.struct.PyTreeNode):
    """The grasps that a found target may be taken out with, and what else decides which of them are feasible.

    Attributes:
      tables: their constants; they have no candidate poses.
      shelf: data.
      gripper, target, config: static.
    """

    tables: GraspTables
    shelf: Shelf
    gripper: Gripper = flax.struct.field(pytree_node=False)
    target: Target = flax.struct.field(pytree_node=False)
    config: GraspConfig = flax.struct.field(pytree_node=False)


def target_grasps(shelf: Shelf, gripper: Gripper, target: Target, config: GraspConfig) -> TargetGrasps:
    """The grasps of a configuration for a target that has been found. Not to be called inside `jit`.

    Raises:
      InputError: the target is too wide for the gripper.
    """
    tables = grasp_tables(shelf, gripper, target, config, candidates=False)
    return TargetGrasps(tables, shelf, gripper, target, config)


class Problem(flax.struct.PyTreeNode):
    """What does not change in an episode: the world around the objects, and all that follows from it.

    Attributes:
      existence, grasps, actions: constants of f, of g and of the actions.
      retrieval: a denser set of grasps, for the target once it is found; it has no candidate poses.
      poses: the candidate poses X as x, y [m], yaw [rad], shape (X, 3).
      cell: their spacing in x and y [m], shape (2,).
      camera, shelf: data, but for the image's size, so that other poses compile nothing.
      gripper, target, config: static.
    """

    existence: ExistenceTables
    grasps: GraspTables
    actions: ActionTables
    retrieval: GraspTables
    poses: jax.Array
    cell: jax.Array
    camera: Camera
    shelf: Shelf
    gripper: Gripper = flax.struct.field(pytree_node=False)
    target: Target = flax.struct.field(pytree_node=False)
    config: ProblemConfig = flax.struct.field(pytree_node=False)

    @property
    def space(self) -> ActionSpace:
        """What all actions share: static but for the shelf."""
        return ActionSpace(
            shelf=self.shelf,
            gripper=self.gripper,
            config=self.config.actions,
            max_yaw=self.config.grasps.max_yaw,
            waypoints=self.config.grasps.waypoints,
            wrists=self.actions.q7.shape[1],
        )

    @property
    def target_grasps(self) -> TargetGrasps:
        """The grasps that the target is taken out with."""
        return TargetGrasps(self.retrieval, self.shelf, self.gripper, self.target, self.config.retrieval)


def build_problem(
    target: Target | None = None,
    camera: Camera | None = None,
    shelf: Shelf | None = None,
    gripper: Gripper | None = None,
    config: ProblemConfig | None = None,
) -> Problem:
    """Precompute everything about a target, a camera, a shelf and a gripper that no object changes.

    Takes seconds; what is left out takes its default. Not to be called inside `jit`.

    Raises:
      InputError: the camera does not see the shelf, the target cannot be grasped by the gripper, or nowhere on the
        shelf, a kind of action cannot be sampled, the gripper's places outside the shelf are not, or `config` is of
        something else.
    """
    target, camera, shelf = target or Target(), camera or Camera(), shelf or Shelf()
    gripper, config = gripper or Gripper(), ProblemConfig() if config is None else config
    if not isinstance(config, ProblemConfig):
        raise InputError(f"config: is a {type(config).__name__}; give a ProblemConfig, such as paper().problem")
    check_camera(camera, shelf)
    check_outside(gripper, shelf)
    check_kinds(config.actions.actions)
    # A GPU would compile a hundred small programs for it, each of them more slowly.
    with on_host():
        grasps = grasp_tables(shelf, gripper, target, config.grasps)
        if grasps.pair_pose.shape[0] == 0:
            raise InputError(NOWHERE)
        tables = {
            "existence": existence_tables(camera, shelf, target, config.existence),
            "grasps": grasps,
            "actions": action_tables(gripper, config.grasps.wrists, config.actions),
            "retrieval": target_grasps(shelf, gripper, target, config.retrieval).tables,
            "poses": target.candidate_poses(shelf),
            "cell": np.array(target.cell(shelf)[:2], np.float32),
        }
    tables = jax.tree.map(lambda table: jax.device_put(np.asarray(table)), tables)
    return Problem(**tables, camera=camera, shelf=shelf, gripper=gripper, target=target, config=config)
