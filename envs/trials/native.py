"""Trials in C MuJoCo, on several threads.

The recognised objects become bodies as in `physics_push`, those of several parts compounds, and a found target a body
of its own shape; they come to rest, and the arm moves as in the environment. The environment's own simulator is not
involved.

Approximations: what is not recognised, including a hidden target, is absent from the trials; and of more than eight
objects all but the eight nearest to the path of the gripper.
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

from mechsearch_jax.actions import Action, Kind, kind_of
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.envs.pushing.physics_push import bodies
from mechsearch_jax.envs.pushing.push_rollouts import sound
from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
from mechsearch_jax.envs.trials.attempt import TrialScene
from mechsearch_jax.envs.trials.compounds import with_parts, with_target
from mechsearch_jax.envs.trials.nearby import Perturbations
from mechsearch_jax.envs.trials.order import Once, in_order
from mechsearch_jax.envs.world.world import TARGET, World, bodies_of, outer_shape
from mechsearch_jax.geometry.superquadric import Superquadrics, empty
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.planner import Problem
from mechsearch_jax.planner.trials import TrialResult, TrialScenes
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.motion import MotionConfig, Reference
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.preparing import Program, motions, program
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Places along each straight part of a gripper's path.
_PLACES = 5


class TrialSetup(NamedTuple):
    """The parts of a problem that trials need."""

    target: Target
    shelf: Shelf
    gripper: Gripper


class _Try(NamedTuple):
    """What tries an action in the scene of a number, once, and whether the action takes the target out."""

    tried: Callable[[int, Callable[[], bool]], TrialResult | None]
    takes_target: bool


@dataclasses.dataclass(frozen=True)
class NativeTrials:
    """The `Trials` in C MuJoCo, of many scenes at once, on several threads.

    The same trials always give the same results. An action that the arm cannot follow fails; the result is UNKNOWN if
    the simulation diverges or the scene is invalid. The gripper is the problem's. A retrieval that succeeds
    is unsure unless it does so in a few scenes near the recognised one as well; another action is if it does harm in
    the first of these, the roughest.

    Attributes:
      simulation: its settings.
      nearby: the scenes in which a retrieval has to succeed, too, and the first of which no other action may harm.
      threads: number of threads; `runtime.cores.cores` if None.
      friction: factor on all sliding frictions; with too low a friction the arm is held up in reality where it was not
        in the trial.

    Raises:
      InputError: the friction is not positive.
    """

    simulation: SimulatorConfig = dataclasses.field(default_factory=SimulatorConfig)
    nearby: Perturbations = dataclasses.field(default_factory=Perturbations)
    threads: int | None = None
    friction: float = 1.0

    def __post_init__(self):
        if not 0.0 < self.friction < math.inf:
            raise InputError(f"NativeTrials: friction {self.friction} must be a positive number")

    def __call__(
        self, problem: Problem, scenes: TrialScenes, actions: Action, wanted: Bool[Array | np.ndarray, "r k"]
    ) -> Int[np.ndarray, "r k"]:
        """See `trials.Trials`."""
        return self.in_cell(TrialSetup(problem.target, problem.shelf, problem.gripper), scenes, actions, wanted)

    def in_cell(
        self, cell: TrialSetup, scenes: TrialScenes, actions: Action, wanted: Bool[Array | np.ndarray, "r k"]
    ) -> Int[np.ndarray, "r k"]:
        """`__call__` without a problem."""
        config = self._motion_config(cell)
        simulation = dataclasses.replace(self.simulation, motion=config)
        actions, scenes = jax.device_get((actions, scenes))

        nearby = self.nearby.scenes

        def begun(once: Once, row: int, i: int) -> _Try | TrialResult:
            """What tries an action in the scene of a number, or its result without a trial."""
            action: Action = jax.tree.map(lambda a: np.asarray(a[row, i]), actions)
            kept = near_path(jax.tree.map(lambda a: a[row], scenes.objects), action, cell.gripper.approach)
            kind = kind_of(int(action.kind))
            motion = jax.device_get(reference_motion(kind, action, config))
            if motion is None or not motion[1]:
                return TrialResult.FAILED

            def scene(number: int) -> tuple[World, TrialScene | None]:
                near = self.nearby.drawn(scenes, number)
                return once((number, kept), lambda: self._scene(cell, simulation, near, row, kept))

            if not sound(*jax.tree.map(lambda a: np.asarray(a)[None], (scene(0)[0], motion[0]))):
                return TrialResult.UNKNOWN
            index = kept.index(int(action.object)) if int(action.object) in kept else TARGET

            def tried(number: int, needed: Callable[[], bool]) -> TrialResult | None:
                attempted = lambda: _attempted(scene(number)[1], kind, motion[0], index, needed)  # noqa: E731
                return once((i, number), lambda: attempted() if needed() else None)

            return _Try(tried, kind.takes_target)

        def ahead(once: Once, row: int, i: int) -> None:
            """Try an action that is being tried in the scenes near, while it may succeed."""
            action = begun(once, row, i)
            if isinstance(action, TrialResult):
                return

            def promising() -> bool:
                present = once.begun((i, 0))
                return present is None or not present.done() or present.result() is TrialResult.SUCCEEDED

            # From the other end, so that none waits for the same.
            numbers = (1, *range(nearby, 1, -1)) if action.takes_target else (1,)
            for number in numbers[:nearby]:
                action.tried(number, promising)

        def attempt(once: Once, row: int, i: int, needed: Callable[[], bool]) -> TrialResult | None:
            first = int(np.argmax(wanted[row]))
            if i != first:
                # Most often it is the first that is made: the sooner all of it is known, the better.
                ahead(once, row, first)
            action = begun(once, row, i) if needed() else None
            if action is None or isinstance(action, TrialResult):
                return action
            result = action.tried(0, needed)
            if result is TrialResult.SUCCEEDED and not action.takes_target:
                # Where the arm is only held up, the search goes on.
                harm = nearby > 0 and action.tried(1, needed) is TrialResult.HARMFUL
                return TrialResult.UNSURE if harm else result
            for number in range(1, 1 + nearby * (result is TrialResult.SUCCEEDED)):
                result = action.tried(number, needed)
                if result is not TrialResult.SUCCEEDED:
                    return TrialResult.UNSURE if result is TrialResult.FAILED else result
            return result

        return in_order(np.asarray(wanted), self.threads or cores(), lambda row: Once(), attempt)

    def _scene(
        self, cell: TrialSetup, simulation: SimulatorConfig, scenes: TrialScenes, row: int, kept: tuple[int, ...]
    ) -> tuple[World, TrialScene | None]:
        """The world of a row with the kept objects, and its scene at rest; None if it cannot be built."""
        objects = jax.tree.map(lambda a: a[row, list(kept)], scenes.objects)
        world = jax.device_get(trial_world(cell.target, cell.shelf, objects, scenes.pose[row], scenes.found[row]))
        friction = self.friction * float(scenes.friction[row])
        return world, scene_at_rest(cell, simulation, world, objects, friction)

    def programs(self, problem: Problem) -> list[Program]:
        """The JAX programs of trials; see `many_slots.PreparesTrials`."""
        return self.cell_programs(TrialSetup(problem.target, problem.shelf, problem.gripper))

    def cell_programs(self, cell: TrialSetup) -> list[Program]:
        """`programs` without a problem."""
        nowhere = jax.device_get((empty(TARGET), jnp.zeros(3), jnp.array(False)))
        return [
            *motions(self._motion_config(cell)),
            program("small ones", trial_world, *cell[:2], *nowhere),
        ]

    def _motion_config(self, cell: TrialSetup) -> MotionConfig:
        return dataclasses.replace(self.simulation.motion, gripper=cell.gripper)


def near_path(objects: Superquadrics, action: Action, approach: float) -> tuple[int, ...]:
    """The slots of the objects that a trial has room for: all, or those that are nearest to the path of the gripper.

    Args:
      objects: of a scene, as NumPy arrays.
      action: that is tried.
      approach: length of the gripper's straight approach [m].
    """
    if len(objects.valid) <= TARGET:
        return tuple(range(len(objects.valid)))
    begin, end = action.T_world_gripper, action.T_world_place
    share = np.linspace(0.0, 1.0, _PLACES)[:, None]
    before = begin[:2, 3] - approach * share * begin[:2, 2]
    way = np.concatenate([before, begin[:2, 3] + share * (end - begin)[:2, 3]])
    apart = np.linalg.norm(objects.position[:, None, :2] - way[None], axis=-1).min(axis=1)
    apart -= np.linalg.norm(objects.size[:, :2], axis=-1)
    # What is acted on, unless it is the target.
    apart[int(action.object) : int(action.object) + 1] = -np.inf
    nearest = np.argsort(np.where(objects.valid, apart, np.inf), kind="stable")[:TARGET]
    return tuple(sorted(nearest.tolist()))


def _attempted(
    scene: TrialScene | None, kind: Kind, reference: Reference, index: int, needed: Callable[[], bool]
) -> TrialResult | None:
    """The result of an action in a scene; see `TrialScene.attempt`."""
    if scene is None:
        return TrialResult.UNKNOWN
    try:
        return scene.attempt(kind, reference, index, needed)
    except mujoco.FatalError:
        return TrialResult.UNKNOWN


@cached_jit(on_host=True)
def trial_world(
    target: Target, shelf: Shelf, objects: Superquadrics, pose: Float[Array, "3"], found: Bool[Array, ""]
) -> World:
    """The bodies of the objects, and of the target if it is found."""
    T_world_target = upright_pose(pose, target.height(shelf))
    world = bodies(objects)
    return World(
        kind=world.kind.at[TARGET].set(outer_shape(target).code),
        half_size=world.half_size.at[TARGET].set(jnp.asarray(target.half_size, jnp.float32)),
        position=world.position.at[TARGET].set(T_world_target[:3, 3]),
        rotation=world.rotation.at[TARGET].set(T_world_target[:3, :3]),
        valid=world.valid.at[TARGET].set(found),
    )


def scene_at_rest(
    cell: TrialSetup,
    simulation: SimulatorConfig,
    world: World,
    objects: Superquadrics,
    friction: float,
) -> TrialScene | None:
    """A scene at rest; None if MuJoCo cannot build it, so that one invalid scene does not end the other trials."""
    try:
        made = with_parts(with_target(bodies_of(world), cell.target), objects)
        return TrialScene(cell.shelf, simulation, made, friction)
    except (ValueError, mujoco.FatalError):
        return None
