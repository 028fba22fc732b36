"""The constants of an episode: the workcell and the target, and all tables computed from them beforehand."""

from __future__ import annotations

import functools
import math
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from mechsearch_jax.actions.config import ActionSpace, ActionTables, action_tables
from mechsearch_jax.actions.registry import check_kinds
from mechsearch_jax.config.config import ProblemConfig
from mechsearch_jax.existence import ExistenceConfig, ExistenceTables, existence_tables
from mechsearch_jax.grasping.graspability import CandidateGrasps, GraspTables, candidate_grasps, grasp_tables
from mechsearch_jax.grasping.retrieval import TargetGrasps
from mechsearch_jax.robot.entry import check_outside
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.cores import on_host
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.own_settings import in_own_settings
from mechsearch_jax.runtime.pytree import PyTreeNode, static
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.sight import check_camera
from mechsearch_jax.workspace.target import Target

# `ActionTables.contact` of actions for where no other has a gain [m].
BOLDER_CONTACT = 0.008
# The error for a shelf in which no grasp of the target is feasible.
NOWHERE = "shelf: the arm reaches the target nowhere; check the shelf's place before the robot"


class Problem(PyTreeNode):
    """The constants of an episode: everything but the objects, and the tables that follow from it.

    Attributes:
      existence, grasps, actions: tables of f, g and the actions.
      retrieval: a denser set of grasps for the found target.
      poses: the candidate poses X as x, y [m], yaw [rad], shape (X, 3).
      cell: their spacing in x and y [m], shape (2,).
      camera, shelf: dynamic but for the image's size, so that other poses compile nothing.
      target: static, but for the geometry of one of several pieces.
      gripper, config: static.
    """

    existence: ExistenceTables
    grasps: CandidateGrasps
    actions: ActionTables
    retrieval: GraspTables
    poses: jax.Array
    cell: jax.Array
    camera: Camera
    shelf: Shelf
    gripper: Gripper = static()
    target: Target
    config: ProblemConfig = static()

    @property
    def space(self) -> ActionSpace:
        """The settings and tables that all actions share."""
        return ActionSpace(
            shelf=self.shelf,
            tables=self.actions,
            gripper=self.gripper,
            config=self.config.actions,
            max_yaw=self.config.grasps.max_yaw,
            waypoints=self.config.grasps.waypoints,
        )

    @functools.cached_property
    def bolder(self) -> Problem:
        """The same with actions for where no other has a gain. Not for use inside `jit`.

        Only data differ, so that nothing is compiled for it. The pushing hand is turned by a right angle about its
        approach, one finger above the other: beside a wall it has room where a level hand, 20 cm wide, has none. And
        objects that stand against each other may be recognised as overlapping deeper (`BOLDER_CONTACT`) before they
        lock each other in.
        """
        config = self.config.actions
        tables = action_tables(self.gripper, self.config.grasps.wrists, config, turn=-math.pi / 2)
        return self.replace(actions=tables.replace(contact=jnp.float32(max(BOLDER_CONTACT, config.contact_tolerance))))

    @property
    def target_grasps(self) -> TargetGrasps:
        """The grasps that the target is taken out with."""
        return TargetGrasps(self.retrieval, self.shelf, self.gripper, self.target, self.config.retrieval)


@in_own_settings
def build_problem(
    target: Target | None = None,
    camera: Camera | None = None,
    shelf: Shelf | None = None,
    gripper: Gripper | None = None,
    config: ProblemConfig | None = None,
) -> Problem:
    """Precompute everything that does not depend on the objects. Takes seconds; not to be called inside `jit`.

    Raises:
      InputError: the camera does not see the shelf, the target is taller than it, the gripper cannot grasp the target,
        or reaches it nowhere, a kind of action cannot be sampled, the gripper's poses outside the shelf are inside, or
        `config` is of another class.
    """
    target, camera, shelf = target or Target(), camera or Camera(), shelf or Shelf()
    gripper, config = gripper or Gripper(), ProblemConfig() if config is None else config
    if not isinstance(config, ProblemConfig):
        raise InputError(f"config: is a {type(config).__name__}; give a ProblemConfig, such as paper().problem")
    check_camera(camera, shelf)
    target.check_fits(shelf)
    check_outside(gripper, shelf)
    check_kinds(config.actions.actions)
    # This compiles a hundred small programs, which takes longer for a GPU.
    with on_host():
        grasps = candidate_grasps(shelf, gripper, target, config.grasps)
        if grasps.pair_valid.shape[0] == 0:
            raise InputError(NOWHERE)
        # The images of the target's poses take as long as the rest, and mostly outside of Python.
        with ThreadPoolExecutor(1) as pool:
            existence = pool.submit(_existence_tables, camera, shelf, target, config.existence)
            tables = {
                "grasps": grasps,
                "actions": action_tables(gripper, config.grasps.wrists, config.actions),
                "retrieval": grasp_tables(gripper, target, config.retrieval),
                "poses": target.candidate_poses(shelf),
                "cell": np.array(target.cell(shelf)[:2], np.float32),
                "existence": existence.result(),
            }
    tables = jax.tree.map(lambda table: jax.device_put(np.asarray(table)), tables)
    return Problem(**tables, camera=camera, shelf=shelf, gripper=gripper, target=target, config=config)


# In a thread of its own.
@in_own_settings
def _existence_tables(camera: Camera, shelf: Shelf, target: Target, config: ExistenceConfig) -> ExistenceTables:
    """`existence_tables` in a thread of its own, to which JAX's default device does not pass on."""
    with on_host():
        return existence_tables(camera, shelf, target, config)
