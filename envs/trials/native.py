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
import threading
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions import Action, Kind, kind_of
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.compiled import kept
from mechsearch_jax.cores import cores
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
from mechsearch_jax.robot.motion import MotionConfig, Reference
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# What the arm is to do, and whether it can; None where nothing is to be done.
Motion = tuple[Reference, Any] | None
# So many motions are computed at once on a GPU, where there are several scenes.
AT_ONCE = 16


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
        config = dataclasses.replace(self.simulation.motion, gripper=problem.gripper)
        simulation = dataclasses.replace(self.simulation, motion=config)
        actions = jax.device_get(actions)
        chosen = np.asarray(wanted)
        # A GPU computes many motions as fast as one.
        together = len(chosen) > 1 and jax.default_backend() != "cpu"
        motions = _Motions(actions, chosen, config, together)

        def one(row: int) -> World:
            return jax.tree.map(lambda a: a[row], worlds)

        def make(row: int) -> TrialScene | None:
            friction, mass = self.friction * float(scenes.friction[row]), float(scenes.mass[row])
            return _at_rest(problem.shelf, simulation, one(row), friction, mass)

        def attempt(scene: TrialScene | None, row: int, i: int, needed: Callable[[], bool]) -> TrialResult | None:
            motion = motions(row, i)
            if motion is None or not motion[1]:
                return TrialResult.FAILED
            if scene is None or not sound(*jax.tree.map(lambda a: np.asarray(a)[None], (one(row), motion[0]))):
                return TrialResult.UNKNOWN
            try:
                return scene.attempt(kind_of(int(actions.kind[row, i])), motion[0], int(actions.object[row, i]), needed)
            except mujoco.FatalError:
                return TrialResult.UNKNOWN

        return in_order(chosen, self.threads or cores(), make, attempt)


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


class _Motions:
    """The motions of actions, each computed when it is first needed; NumPy arrays."""

    def __init__(self, actions: Action, wanted: Bool[np.ndarray, "r k"], config: MotionConfig, together: bool):
        """Args:
        actions, wanted: as of `Trials`, NumPy arrays.
        config: of the motions.
        together: whether those of several scenes are computed at once, `AT_ONCE` of them.
        """
        self._actions, self._wanted, self._config, self._together = actions, wanted, config, together
        self._known: dict[tuple[int, int], Motion] = {}
        self._lock = threading.Lock()

    def __call__(self, row: int, i: int) -> Motion:
        """The motion of an action, by row and column."""
        kind = kind_of(int(self._actions.kind[row, i]))
        if not self._together:
            action: Action = jax.tree.map(lambda a: jnp.asarray(a[row, i]), self._actions)
            return jax.device_get(reference_motion(kind, action, self._config))
        with self._lock:
            if (row, i) not in self._known:
                alike = np.flatnonzero(self._wanted[:, i] & (self._actions.kind[:, i] == kind.code)).tolist()
                # Always the same ones together, whichever is needed first: results must not depend on threads.
                first = alike.index(row) // AT_ONCE * AT_ONCE
                block = alike[first : first + AT_ONCE]
                rows = np.resize(block, AT_ONCE)
                several: Action = jax.tree.map(lambda a: jnp.asarray(a[rows, i]), self._actions)
                found = jax.device_get(_motions(kind, several, self._config))
                for place, r in enumerate(block):
                    self._known[r, i] = jax.tree.map(lambda a, place=place: a[place], found)
            return self._known[row, i]


@functools.partial(jax.jit, static_argnames=("kind", "config"))
def _motions(kind: Kind, actions: Action, config: MotionConfig) -> tuple[Reference, Bool[Array, " n"]] | None:
    """`reference_motion` of several actions."""
    return jax.vmap(lambda action: kind.reference(action, config))(actions)
