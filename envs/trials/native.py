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
from collections.abc import Callable, Sequence
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
        simulation = dataclasses.replace(self.simulation, motion=self._motion_config(cell))
        actions, scenes = jax.device_get((actions, scenes))
        near, wanted = [self.nearby.drawn(scenes, i) for i in range(1 + self.nearby.scenes)], np.asarray(wanted)

        def row_of(row: int) -> _Row:
            here, own = jax.tree.map(lambda a: np.asarray(a[row]), (near, actions))
            return _Row(cell, simulation, self.friction, here, own, int(np.argmax(wanted[row])))

        rows = {row: row_of(row) for row in np.flatnonzero(wanted.any(axis=1)).tolist()}
        return in_order(wanted, self.threads or cores(), lambda row, i, needed: rows[row].attempt(i, needed))

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


class _Prepared(NamedTuple):
    """An action that can be tried.

    Attributes:
      kind: of the action.
      reference: of the arm.
      kept: the slots of the objects that its trials hold.
      index: slot of the object that it moves, among these.
    """

    kind: Kind
    reference: Reference
    kept: tuple[int, ...]
    index: int


class _Row:
    """The trials of the actions of one row; several threads may call it at once."""

    def __init__(
        self,
        cell: TrialSetup,
        simulation: SimulatorConfig,
        friction: float,
        scenes: Sequence[TrialScenes],
        actions: Action,
        first: int,
    ):
        """Args:
        cell, simulation: of all trials.
        friction: factor on all sliding frictions.
        scenes: the row's scene as it is recognised, then those near it, as NumPy arrays without the leading axis.
        actions: fields (K, ...), NumPy arrays.
        first: the action that is made most often.
        """
        self._cell, self._simulation, self._friction = cell, simulation, friction
        self._scenes, self._actions, self._first = scenes, actions, first
        self._once = Once()

    def attempt(self, i: int, needed: Callable[[], bool]) -> TrialResult | None:
        """The result of an action, with what becomes of it in the scenes near; None if it is not needed any more."""
        if i != self._first:
            # The sooner all of the first is known, the better.
            self._ahead(self._first)
        action = self._prepared(i) if needed() else None
        if not isinstance(action, _Prepared):
            return action
        result = self._tried(i, action, 0, needed)
        if result is not TrialResult.SUCCEEDED:
            return result
        for number in self._near(action):
            near = self._tried(i, action, number, needed)
            if action.kind.takes_target and near is not TrialResult.SUCCEEDED:
                return TrialResult.UNSURE if near is TrialResult.FAILED else near
            # Where the arm is only held up, the search goes on.
            if near is TrialResult.HARMFUL:
                return TrialResult.UNSURE
        return result

    def _ahead(self, i: int) -> None:
        """Try an action that is being tried in the scenes near, while it may succeed."""
        action = self._prepared(i)
        if not isinstance(action, _Prepared):
            return

        def promising() -> bool:
            present = self._once.begun((i, 0))
            return present is None or not present.done() or present.result() is TrialResult.SUCCEEDED

        # From the other end, so that none waits for the same.
        near = self._near(action)
        for number in (*near[:1], *near[:0:-1]):
            self._tried(i, action, number, promising)

    def _near(self, action: _Prepared) -> range:
        """The numbers of the scenes near in which an action is tried."""
        count = len(self._scenes)
        return range(1, count if action.kind.takes_target else min(count, 2))

    def _prepared(self, i: int) -> _Prepared | TrialResult:
        """An action that can be tried, or its result without a trial."""

        def prepare() -> _Prepared | TrialResult:
            action: Action = jax.tree.map(lambda a: a[i], self._actions)
            kind, index = kind_of(int(action.kind)), int(action.object)
            motion = jax.device_get(reference_motion(kind, action, self._simulation.motion))
            if motion is None or not motion[1]:
                return TrialResult.FAILED
            kept = near_path(self._scenes[0].objects, action, self._cell.gripper.approach)
            if not sound(*jax.tree.map(lambda a: np.asarray(a)[None], (self._scene(0, kept)[0], motion[0]))):
                return TrialResult.UNKNOWN
            return _Prepared(kind, motion[0], kept, kept.index(index) if index in kept else TARGET)

        return self._once(i, prepare)

    def _tried(self, i: int, action: _Prepared, number: int, needed: Callable[[], bool]) -> TrialResult | None:
        """The result of an action in the scene of a number; None if it is not needed any more."""

        def attempt() -> TrialResult | None:
            if not needed():
                return None
            scene = self._scene(number, action.kept)[1]
            if scene is None:
                return TrialResult.UNKNOWN
            try:
                return scene.attempt(action.kind, action.reference, action.index, needed)
            except mujoco.FatalError:
                return TrialResult.UNKNOWN

        return self._once((i, number), attempt)

    def _scene(self, number: int, kept: tuple[int, ...]) -> tuple[World, TrialScene | None]:
        """The world of a number with the kept objects, and its scene at rest; None if it cannot be built."""

        def made() -> tuple[World, TrialScene | None]:
            cell, near = self._cell, self._scenes[number]
            objects = jax.tree.map(lambda a: a[list(kept)], near.objects)
            world = jax.device_get(trial_world(cell.target, cell.shelf, objects, near.pose, near.found))
            friction = self._friction * float(near.friction)
            return world, scene_at_rest(cell, self._simulation, world, objects, friction)

        return self._once((number, kept), made)


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
