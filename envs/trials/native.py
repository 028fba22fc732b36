"""Trials in C MuJoCo, on several threads.

The recognised objects become bodies as in `physics_push`, and a found target one of its own shape; they come to rest,
and the arm moves as the environment's does. The environment's own simulator is not involved.

An approximation: what is not recognised is not there, a hidden target least of all.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions import Action, kind_of
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.envs.pushing.physics_push import bodies, sound
from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
from mechsearch_jax.envs.trials.order import in_order
from mechsearch_jax.envs.trials.scene import TrialScene
from mechsearch_jax.envs.world.world import TARGET, World, bodies_of
from mechsearch_jax.geometry.superquadric import Superquadrics, empty
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.planner import Problem
from mechsearch_jax.planner.trials import TrialResult, TrialScenes
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.motion import MotionConfig
from mechsearch_jax.runtime.compiled import kept
from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.preparing import Program, motions, program
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target


class Cell(NamedTuple):
    """What trials need of a problem."""

    target: Target
    shelf: Shelf
    gripper: Gripper


@dataclasses.dataclass(frozen=True)
class NativeTrials:
    """The `Trials` in C MuJoCo, of many scenes at once, on several threads.

    The same ones always give the same results. An action that the arm cannot follow fails; what becomes of one whose
    simulation diverges, or whose scene is no scene, is not known. The gripper is the problem's.

    Attributes:
      simulation: how it is simulated.
      threads: how many; one for each of `runtime.cores.cores` if left out.
      friction: sliding friction of everything, as a multiple of what it is taken to be; too little of it holds the arm
        up where a trial was not.

    Raises:
      InputError: the friction is not positive.
    """

    simulation: SimulatorConfig = dataclasses.field(default_factory=SimulatorConfig)
    threads: int | None = None
    friction: float = 1.0

    def __post_init__(self):
        if not 0.0 < self.friction < math.inf:
            raise InputError(f"NativeTrials: friction {self.friction} must be a positive number")

    def __call__(
        self, problem: Problem, scenes: TrialScenes, actions: Action, wanted: Bool[Array | np.ndarray, "r k"]
    ) -> Int[np.ndarray, "r k"]:
        """See `trials.Trials`.

        Raises:
          InputError: the simulator has too few slots for the objects.
        """
        return self.in_cell(Cell(problem.target, problem.shelf, problem.gripper), scenes, actions, wanted)

    def in_cell(
        self, cell: Cell, scenes: TrialScenes, actions: Action, wanted: Bool[Array | np.ndarray, "r k"]
    ) -> Int[np.ndarray, "r k"]:
        """`__call__` for who has no problem; see there."""
        if scenes.objects.valid.shape[-1] > TARGET:
            raise InputError(f"the simulator has slots for {TARGET} objects, not for {scenes.objects.valid.shape[-1]}")
        config = self._motion_config(cell)
        simulation = dataclasses.replace(self.simulation, motion=config)
        actions, scenes = jax.device_get((actions, scenes))

        def make(row: int) -> tuple[World, TrialScene | None]:
            objects = jax.tree.map(lambda a: a[row], scenes.objects)
            world = jax.device_get(_world(cell.target, cell.shelf, objects, scenes.pose[row], scenes.found[row]))
            friction, mass = self.friction * float(scenes.friction[row]), float(scenes.mass[row])
            return world, _at_rest(cell.shelf, simulation, world, friction, mass)

        def attempt(
            made: tuple[World, TrialScene | None], row: int, i: int, needed: Callable[[], bool]
        ) -> TrialResult | None:
            world, scene = made
            action: Action = jax.tree.map(lambda a: np.asarray(a[row, i]), actions)
            kind = kind_of(int(action.kind))
            motion = jax.device_get(reference_motion(kind, action, config))
            if motion is None or not motion[1]:
                return TrialResult.FAILED
            if scene is None or not sound(*jax.tree.map(lambda a: np.asarray(a)[None], (world, motion[0]))):
                return TrialResult.UNKNOWN
            try:
                return scene.attempt(kind, motion[0], int(action.object), needed)
            except mujoco.FatalError:
                return TrialResult.UNKNOWN

        return in_order(np.asarray(wanted), self.threads or cores(), make, attempt)

    def programs(self, problem: Problem) -> list[Program]:
        """What is computed with JAX; see `many_slots.PreparesTrials`."""
        return self.cell_programs(Cell(problem.target, problem.shelf, problem.gripper))

    def cell_programs(self, cell: Cell) -> list[Program]:
        """`programs` for who has no problem."""
        nowhere = jax.device_get((empty(TARGET), jnp.zeros(3), jnp.array(False)))
        return [*motions(self._motion_config(cell)), program("small ones", _world, cell.target, cell.shelf, *nowhere)]

    def _motion_config(self, cell: Cell) -> MotionConfig:
        return dataclasses.replace(self.simulation.motion, gripper=cell.gripper)


@kept(static_argnames=("target",), on_host=True)
def _world(
    target: Target, shelf: Shelf, objects: Superquadrics, pose: Float[Array, "3"], found: Bool[Array, ""]
) -> World:
    """The bodies that stand for the objects, and for the target where it is found."""
    T_world_target = upright_pose(pose, target.height(shelf))
    world = bodies(objects)
    return World(
        kind=world.kind.at[TARGET].set(shape_of(target.shape).code),
        half_size=world.half_size.at[TARGET].set(jnp.asarray(target.half_size)),
        position=world.position.at[TARGET].set(T_world_target[:3, 3]),
        rotation=world.rotation.at[TARGET].set(T_world_target[:3, :3]),
        valid=world.valid.at[TARGET].set(found),
    )


def _at_rest(
    shelf: Shelf, simulation: SimulatorConfig, world: World, friction: float, mass: float
) -> TrialScene | None:
    """A scene in which actions can be tried; None where it is none, which must not end those beside it."""
    try:
        return TrialScene(shelf, simulation, bodies_of(world), friction, mass)
    except (ValueError, mujoco.FatalError):
        return None
