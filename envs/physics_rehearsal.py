"""Rehearsals in simulation: what the planner would do is tried out in C MuJoCo first.

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
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions import KINDS, Action, kind_of
from mechsearch_jax.actions.registry import ActionKind
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
from mechsearch_jax.planner.rehearsal import Rehearsed
from mechsearch_jax.robot.motion import Reference
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.shelf import Shelf

# What the arm is to do, and whether it can; None where nothing is to be done.
Motion = tuple[Reference, Any] | None


@dataclasses.dataclass(frozen=True)
class NativeRehearsal:
    """The `Rehearsal` in C MuJoCo, of all that are mapped over at once, on several threads.

    The actions of a scene are tried in the order that they are given in, until one succeeds. The same ones always give
    the same results. One that the arm cannot follow fails; one that diverges, or whose scene is no scene, does harm.
    The gripper is the problem's.

    While it is traced, `jax.pure_callback` takes the actions to the host, for which JAX needs two cores.

    Attributes:
      simulation: how it is simulated.
      threads: how many; one for each of `cores.cores` if left out.
      friction: sliding friction of everything, as a multiple of what it is taken to be; too little of it holds the arm
        up where a rehearsal was not.

    Raises:
      InputError: the friction is not positive.
    """

    simulation: SimulatorConfig = dataclasses.field(default_factory=SimulatorConfig)
    threads: int | None = None
    friction: float = 1.0

    def __post_init__(self):
        if not 0.0 < self.friction < math.inf:
            raise InputError(f"NativeRehearsal: friction {self.friction} must be a positive number")

    def __call__(
        self,
        problem: Problem,
        scene: Superquadrics,
        pose: Float[Array, "3"],
        found: Bool[Array, ""] | bool,
        actions: Action,
        asked: Bool[Array, " k"],
        kinds: tuple[ActionKind, ...],
    ) -> Int[Array, " k"]:
        """See `rehearsal.Rehearsal`.

        Raises:
          InputError: the simulator has too few slots for the objects.
        """
        if scene.capacity > TARGET:
            raise InputError(f"the simulator has slots for {TARGET} objects, not for {scene.capacity}")
        world = _world(problem, scene, pose, jnp.asarray(found))
        motion = dataclasses.replace(self.simulation.motion, gripper=problem.gripper)
        simulation = dataclasses.replace(self.simulation, motion=motion)
        where = problem.shelf, dataclasses.replace(self, simulation=simulation, threads=self.threads or cores())
        if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((world, actions, asked))):
            host: tuple[World, Action, np.ndarray] = jax.device_get((world, actions, asked))
            return jax.device_put(_tried_alone(*where, *host))
        result = jax.ShapeDtypeStruct(asked.shape, jnp.int32)
        told = world, actions.kind, actions.object, *_references(actions, simulation, kinds), asked
        return jax.pure_callback(functools.partial(_tried, *where), result, *told, vmap_method="broadcast_all")


@kept()
def _world(problem: Problem, scene: Superquadrics, pose: Float[Array, "3"], found: Bool[Array, ""]) -> World:
    """The bodies that stand for the objects, and for the target where it is found."""
    target = problem.target
    T_world_target = upright_pose(pose, target.height(problem.shelf))
    world = bodies(scene)
    return World(
        kind=world.kind.at[TARGET].set(shape_of(target.shape).code),
        half_size=world.half_size.at[TARGET].set(jnp.asarray(target.half_size)),
        position=world.position.at[TARGET].set(T_world_target[:3, 3]),
        rotation=world.rotation.at[TARGET].set(T_world_target[:3, :3]),
        valid=world.valid.at[TARGET].set(found),
    )


def _references(
    actions: Action, config: SimulatorConfig, kinds: tuple[ActionKind, ...]
) -> tuple[Reference, Bool[Array, " k"]]:
    """What actions of some kinds have the arm do, in arrays as long as the longest kind's, and whether it can.

    Where nothing is to be done, it cannot.
    """
    found = {k: jax.vmap(lambda a, k=k: KINDS[k].reference(a, config.motion))(actions) for k in kinds}
    motions = {code: motion for code, motion in found.items() if motion is not None}
    steps = max(reference.fingers.shape[1] for reference, _ in motions.values())

    def longer(rows):
        return jnp.pad(rows, ((0, 0), (0, steps - rows.shape[1])) + ((0, 0),) * (rows.ndim - 2), mode="edge")

    def of_its_kind(*leaves):
        mine = [(actions.kind == int(code)).reshape(-1, *[1] * (leaves[0].ndim - 1)) for code in motions]
        return functools.reduce(lambda rest, one: jnp.where(one[0], one[1], rest), zip(mine, leaves, strict=True), 0)

    padded = [
        (r.replace(**{name: longer(getattr(r, name)) for name in ("q", "velocity", "fingers")}), able)
        for r, able in motions.values()
    ]
    reference, able = jax.tree.map(of_its_kind, *padded)
    return reference, able.astype(bool)


def _tried_alone(
    shelf: Shelf, how: NativeRehearsal, world: World, actions: Action, asked: Bool[np.ndarray, " k"]
) -> Int[np.ndarray, " k"]:
    """What becomes of the actions in one scene; a motion is computed when its action is tried."""

    def motion(_: int, i: int) -> Motion:
        action: Action = jax.tree.map(lambda a: jnp.asarray(a[i]), actions)
        return jax.device_get(reference_motion(kind_of(int(actions.kind[i])), action, how.simulation.motion))

    told: Any = jax.tree.map(lambda a: a[None], (world, actions.kind, actions.object, asked))
    worlds, kind, index, some = told
    return _in_turn(shelf, how, worlds, kind, index, some, motion)[0]


def _tried(
    shelf: Shelf,
    how: NativeRehearsal,
    world: World,
    kind: Array,
    index: Array,
    reference: Reference,
    able: Array,
    asked: Array,
) -> Int[np.ndarray, "*lead k"]:
    """What becomes of the actions in many scenes; any leading axes.

    It must not compute with JAX, which is waiting for it.
    """
    lead = asked.shape[:-1]
    told: Any = jax.tree.map(
        lambda a: np.asarray(a).reshape(-1, *a.shape[len(lead) :]), (world, kind, index, (reference, able), asked)
    )
    worlds, kinds, indices, motions, some = told

    def motion(row: int, i: int) -> Motion:
        return jax.tree.map(lambda a: a[row, i], motions)

    return _in_turn(shelf, how, worlds, kinds, indices, some, motion).reshape(*lead, -1)


def _in_turn(
    shelf: Shelf,
    how: NativeRehearsal,
    world: World,
    kind: Int[np.ndarray, "n k"],
    index: Int[np.ndarray, "n k"],
    asked: Bool[np.ndarray, "n k"],
    motion: Callable[[int, int], Motion],
) -> Int[np.ndarray, "n k"]:
    """What becomes of the actions of each scene, tried in their order until one succeeds.

    Args:
      shelf: where.
      how: as it is tried out; its threads are known.
      world: fields with a leading axis.
      kind, index: codes of the actions, and the objects that they move.
      asked: which are to be tried.
      motion: of an action by row and column.
    """

    def one(row: int) -> World:
        return jax.tree.map(lambda a: a[row], world)

    def attempt(scene: TrialScene | None, row: int, i: int, needed: Callable[[], bool]) -> Rehearsed | None:
        told = motion(row, i)
        if told is None or not told[1]:
            return Rehearsed.FAILED
        if scene is None or not sound(*jax.tree.map(lambda a: a[None], (one(row), told[0]))):
            return Rehearsed.HARMFUL
        try:
            return scene.attempt(kind_of(int(kind[row, i])), told[0], int(index[row, i]), needed)
        except mujoco.FatalError:
            return Rehearsed.HARMFUL

    return in_order(asked, how.threads or 1, lambda row: _at_rest(shelf, how, one(row)), attempt)


def _at_rest(shelf: Shelf, how: NativeRehearsal, world: World) -> TrialScene | None:
    """A scene in which actions can be tried; None where it is none, which must not end those beside it."""
    try:
        return TrialScene(shelf, how.simulation, bodies_of(world), how.friction)
    except (ValueError, mujoco.FatalError):
        return None
