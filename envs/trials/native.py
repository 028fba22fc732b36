"""Trials in C MuJoCo, on several threads.

The recognised objects become bodies as in `physics_push`, and a found target one of its own shape; they come to rest,
and the arm moves as the environment's does. The environment's own simulator is not involved.

An approximation: what is not recognised is not there, a hidden target least of all.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions import KINDS, Action, Kind, kind_of, no_action
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.compiled import Kept, kept
from mechsearch_jax.cores import cores, on_host
from mechsearch_jax.envs.physics_push import bodies, sound
from mechsearch_jax.envs.simulator import SimulatorConfig
from mechsearch_jax.envs.trials.order import in_order
from mechsearch_jax.envs.trials.scene import TrialScene
from mechsearch_jax.envs.world import TARGET, World, bodies_of
from mechsearch_jax.errors import InputError
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.planner import Problem
from mechsearch_jax.planner.trials import TrialResult, TrialScenes
from mechsearch_jax.preparing import Program, motions
from mechsearch_jax.robot.motion import MotionConfig, Reference
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# What the arm is to do, and whether it can; None where nothing is to be done.
Motion = tuple[Reference, Any] | None


@dataclasses.dataclass(frozen=True)
class NativeTrials:
    """The `Trials` in C MuJoCo, of many scenes at once, on several threads.

    The same ones always give the same results. An action that the arm cannot follow fails; what becomes of one whose
    simulation diverges, or whose scene is no scene, is not known. The gripper is the problem's.

    Attributes:
      simulation: how it is simulated.
      threads: how many; one for each of `cores.cores` if left out.
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
        if scenes.objects.valid.shape[-1] > TARGET:
            raise InputError(f"the simulator has slots for {TARGET} objects, not for {scenes.objects.valid.shape[-1]}")
        worlds: World = jax.device_get(
            _worlds(problem.target, problem.shelf, scenes.objects, jnp.asarray(scenes.pose), jnp.asarray(scenes.found))
        )
        config = self._motion_config(problem)
        simulation = dataclasses.replace(self.simulation, motion=config)
        actions = jax.device_get(actions)
        chosen = np.asarray(wanted)

        def one(row: int) -> World:
            return jax.tree.map(lambda a: a[row], worlds)

        def make(row: int) -> TrialScene | None:
            friction, mass = self.friction * float(scenes.friction[row]), float(scenes.mass[row])
            return _at_rest(problem.shelf, simulation, one(row), friction, mass)

        def attempt(scene: TrialScene | None, row: int, i: int, needed: Callable[[], bool]) -> TrialResult | None:
            kind = kind_of(int(actions.kind[row, i]))
            motion = _motion(kind, jax.tree.map(lambda a: np.asarray(a[row, i]), actions), config)
            if motion is None or not motion[1]:
                return TrialResult.FAILED
            if scene is None or not sound(*jax.tree.map(lambda a: np.asarray(a)[None], (one(row), motion[0]))):
                return TrialResult.UNKNOWN
            try:
                return scene.attempt(kind, motion[0], int(actions.object[row, i]), needed)
            except mujoco.FatalError:
                return TrialResult.UNKNOWN

        return in_order(chosen, self.threads or cores(), make, attempt)

    def programs(self, problem: Problem) -> list[Program]:
        """The motions of all kinds of action; see `slots.PreparesTrials`."""
        config = self._motion_config(problem)
        if jax.default_backend() == "cpu":
            return motions(config)

        def begin(kind: Kind) -> Callable[[], None] | None:
            with on_host():
                return _motion_beside_gpu.begin(kind, jax.device_get(no_action()), config)

        return [Program("motions of trials", lambda: False, functools.partial(begin, kind)) for kind in KINDS.values()]

    def _motion_config(self, problem: Problem) -> MotionConfig:
        return dataclasses.replace(self.simulation.motion, gripper=problem.gripper)


@kept(static_argnames=("target",))
def _worlds(
    target: Target,
    shelf: Shelf,
    objects: Superquadrics,
    pose: Float[Array, "r 3"],
    found: Bool[Array, " r"],
) -> World:
    """The bodies that stand for the objects, and for the target where it is found."""

    def one(objects: Superquadrics, pose: Float[Array, "3"], found: Bool[Array, ""]) -> World:
        T_world_target = upright_pose(pose, target.height(shelf))
        world = bodies(objects)
        return World(
            kind=world.kind.at[TARGET].set(shape_of(target.shape).code),
            half_size=world.half_size.at[TARGET].set(jnp.asarray(target.half_size)),
            position=world.position.at[TARGET].set(T_world_target[:3, 3]),
            rotation=world.rotation.at[TARGET].set(T_world_target[:3, :3]),
            valid=world.valid.at[TARGET].set(found),
        )

    return jax.vmap(one)(objects, pose, found)


def _at_rest(
    shelf: Shelf, simulation: SimulatorConfig, world: World, friction: float, mass: float
) -> TrialScene | None:
    """A scene in which actions can be tried; None where it is none, which must not end those beside it."""
    try:
        return TrialScene(shelf, simulation, bodies_of(world), friction, mass)
    except (ValueError, mujoco.FatalError):
        return None


def _motion(kind: Kind, action: Action, config: MotionConfig) -> Motion:
    """What an action has the arm do, as NumPy arrays.

    The host computes it beside a GPU, too: in a thread of its own, and sooner than a GPU gets through the many small
    steps of one motion.
    """
    compute = reference_motion if jax.default_backend() == "cpu" else _motion_beside_gpu
    with on_host():
        return jax.device_get(compute(kind, action, config))


def _reference(kind: Kind, action: Action, config: MotionConfig) -> tuple[Reference, Bool[Array, ""]] | None:
    return kind.reference(action, config)


# JAX's own cache keeps it: what else is kept on disk is for the first device.
_motion_beside_gpu = Kept(_reference, static_argnames=("kind", "config"), on_disk=False)
