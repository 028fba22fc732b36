"""Pushes simulated in C MuJoCo on the host, many at a time, on several threads."""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import jax
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.simulators.simulator import ARM, ROBOT, SimulatorConfig, controls
from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.world import BODIES, World, bodies_of
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.robot.motion import Reference
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf, on_host

# If any object moves or turns by more than this before the push, all come to rest first [m, rad].
LOOSE, LOOSE_TURN = 5e-4, 0.01
_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS


class Poses(PyTreeNode):
    """Poses of bodies, with any leading axes; NumPy arrays on the host.

    Attributes:
      position: [m], shape (..., 9, 3).
      rotation: `R_world_body`, shape (..., 9, 3, 3).
    """

    position: Any
    rotation: Any


class Simulated(PyTreeNode):
    """Simulated pushes, with any leading axes; NumPy arrays on the host.

    Attributes:
      before: poses at the start of the push.
      after: poses after it.
      failed: whether the simulation diverged; the poses then mean nothing.
    """

    before: Poses
    after: Poses
    failed: Any


def differ(a: Poses, b: Poses, distance: float, angle: float) -> Any:
    """Which bodies differ in position by more than a distance [m], or in rotation by more than an angle [rad]."""
    shift = ((a.position - b.position) ** 2).sum(axis=-1)
    # The trace of the rotation between them.
    trace = (a.rotation * b.rotation).sum(axis=(-1, -2))
    return (shift > distance**2) | (trace < 1.0 + 2.0 * math.cos(angle))


@functools.cache
def _blank(shelf: Shelf, timestep: float) -> mujoco.MjModel:
    return models.compile_model(shelf, Camera(), timestep)


def simulate_pushes(
    config: SimulatorConfig, threads: int, shelf: Shelf, world: World, reference: Reference, active: Any
) -> Simulated:
    """Simulate pushes on the host; any leading axes. Must not use JAX, which is waiting for it."""
    shelf, world, reference, active = jax.tree.map(np.asarray, (shelf, world, reference, active))
    lead = active.shape
    shelf, world, reference = jax.tree.map(lambda a: a.reshape(-1, *a.shape[len(lead) :]), (shelf, world, reference))
    blank = _blank(on_host(shelf, 0), config.motion.timestep)
    flat = _Rollouts(blank, config, threads).push(shelf, world, reference, active.reshape(-1))
    return jax.tree.map(lambda a: a.reshape((*lead, *a.shape[1:])), flat)


@dataclasses.dataclass(frozen=True)
class _Rollouts:
    """Steps many worlds at a time, each with its own model.

    Attributes:
      blank: a model with empty slots; those of all shelves have the same size.
      config: of the simulation.
      threads: number of worlds that are stepped at the same time.
    """

    blank: mujoco.MjModel
    config: SimulatorConfig
    threads: int

    def push(self, shelf: Shelf, world: World, reference: Reference, active: Bool[np.ndarray, " n"]) -> Simulated:
        """Simulate pushes; see `simulate_pushes`, with a single leading axis n."""
        count = len(active)
        start = Poses(world.position.copy(), world.rotation.copy())
        failed = ~sound(world, reference) & active
        simulated = Simulated(start, jax.tree.map(np.copy, start), failed)
        # The sequences of a plan begin in the same scene, which is built, and comes to rest, only once.
        scene_index: dict[bytes, int] = {}
        scene = np.full(count, -1)
        built: list[mujoco.MjModel] = []
        first: list[np.ndarray] = []
        for row in np.flatnonzero(active & ~failed):
            name = b"".join(leaf[row].tobytes() for leaf in jax.tree.leaves((shelf, world)))
            if name not in scene_index:
                scene_index[name] = len(built)
                slots = bodies_of(jax.tree.map(lambda a, row=row: a[row], world))
                model = models.with_bodies(_blank(on_host(shelf, int(row)), self.config.motion.timestep), slots)
                built.append(model)
                first.append(_state_of(model, models.initial_state(model, slots)))
            scene[row] = scene_index[name]
        if not built:
            return simulated
        rows = np.flatnonzero(scene >= 0)
        scene = scene[rows]

        with mujoco.rollout.Rollout(nthread=self.threads) as pool:
            home = np.tile(np.concatenate([HOME, np.zeros(ROBOT - ARM)]), (len(built), 1))
            begin = np.stack(first)
            rest, lost = self._come_to_rest(pool, built, begin, home)
            loose = differ(self._poses(begin), self._poses(rest), LOOSE, LOOSE_TURN).any(axis=-1)
            rest = np.where(loose[:, None], rest, begin)
            row_models = [built[i] for i in scene]
            states = rest[scene]
            robot = np.asarray(reference.start, float)[rows][:, [*range(ARM + 1), ARM]]
            robot[:, ARM:] = np.maximum(robot[:, ARM:], 0.0)
            _set_robot(states, robot, self.blank.nq)
            arm_controls = [controls(jax.tree.map(lambda a, row=row: a[row], reference)) for row in rows]
            states, broke = self._step(pool, row_models, states, arm_controls)
            _set_robot(states, home[scene], self.blank.nq)
            states, unsound = self._come_to_rest(pool, row_models, states, home[scene])

        for result, final in ((simulated.before, rest[scene]), (simulated.after, states)):
            poses = self._poses(final)
            result.position[rows], result.rotation[rows] = poses.position, poses.rotation
        failed[rows] |= lost[scene] | broke | unsound
        return simulated

    def _poses(self, states: Float[np.ndarray, "n size"]) -> Poses:
        """Poses of the bodies in states; arbitrary where a state is not finite."""
        place = states[:, 1 + ROBOT : 1 + self.blank.nq].reshape(-1, 7)
        place = np.where(np.isfinite(place).all(axis=1, keepdims=True), place, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        rotation = Rotation.from_quat(place[:, [4, 5, 6, 3]]).as_matrix()
        return Poses(place[:, :3].reshape(-1, BODIES, 3), rotation.reshape(-1, BODIES, 3, 3))

    def _step(
        self,
        pool: mujoco.rollout.Rollout,
        row_models: Sequence[mujoco.MjModel],
        states: Float[np.ndarray, "n size"],
        arm_controls: Sequence[Float[np.ndarray, "_ 9"]],
    ) -> tuple[np.ndarray, np.ndarray]:
        """The states after the last row of each world's controls, and which worlds MuJoCo stopped before."""
        lengths = np.array([len(rows) for rows in arm_controls])
        # Shorter ones are padded to the longest, holding still.
        padded = np.stack(
            [np.pad(rows, ((0, lengths.max() - len(rows)), (0, 0)), mode="edge") for rows in arm_controls]
        )
        trajectory = self._trajectory(pool, row_models, states, padded)
        return self._after(trajectory, lengths).copy(), self._stopped(states, trajectory, lengths)

    def _after(self, trajectory: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """The state of each world after `lengths` steps."""
        return trajectory[np.arange(len(trajectory)), lengths - 1]

    def _trajectory(self, pool, row_models, states, padded) -> np.ndarray:
        data = [mujoco.MjData(self.blank) for _ in range(self.threads)]
        trajectory, _ = pool.rollout(list(row_models), data, states, padded)
        return trajectory

    def _stopped(self, states: np.ndarray, trajectory: np.ndarray, lengths: np.ndarray) -> Bool[np.ndarray, " n"]:
        # A rollout, and with it its clock, stands still after any warning of MuJoCo.
        late = states[:, 0] + (lengths - 0.5) * self.config.motion.timestep
        after = self._after(trajectory, lengths)
        return ~(np.isfinite(after).all(axis=1) & (after[:, 0] > late))

    def _come_to_rest(
        self,
        pool: mujoco.rollout.Rollout,
        row_models: Sequence[mujoco.MjModel],
        states: Float[np.ndarray, "n size"],
        robot: Float[np.ndarray, "n 9"],
    ) -> tuple[np.ndarray, np.ndarray]:
        """The states at rest, or stopped after `settle_steps`, and which worlds diverged."""
        config, nq = self.config, self.blank.nq
        states, broke = states.copy(), np.zeros(len(states), bool)
        limit = config.rest_speed * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
        moving = np.arange(len(states))
        for _ in range(config.settle_steps // config.settle_block):
            hold = np.repeat(robot[moving, None], config.settle_block, axis=1)
            trajectory = self._trajectory(pool, [row_models[i] for i in moving.tolist()], states[moving], hold)
            lengths = np.full(len(moving), trajectory.shape[1])
            broke[moving] |= self._stopped(states[moving], trajectory, lengths)
            states[moving] = trajectory[:, -1]
            first = 1 + nq + ROBOT
            speed = np.abs(trajectory[:, :, first : first + 6 * BODIES]).reshape(len(moving), -1, BODIES, 6)
            moving = moving[~((speed < limit).all(axis=(1, 2, 3)) | broke[moving])]
            if not len(moving):
                break
        states[:, 1 + nq : 1 + nq + self.blank.nv] = 0.0
        return states, broke


def sound(world: World, reference: Reference) -> Bool[np.ndarray, " n"]:
    """Which rows are valid: all numbers of scene and motion are finite, and no rotation is a reflection.

    Args:
      world, reference: fields with one leading axis, as NumPy arrays.
    """
    valid = np.asarray(world.valid)
    numbers = [np.asarray(a).reshape(len(valid), -1) for a in (reference.q, reference.velocity)]
    for leaf in (world.half_size, world.position, world.rotation):
        of_body = np.asarray(leaf).reshape(*valid.shape, -1)
        numbers.append(np.where(valid[..., None], of_body, 0.0).reshape(len(valid), -1))
    finite = np.asarray(np.isfinite(np.concatenate(numbers, axis=1)).all(axis=1))
    rotation = np.where((valid & finite[:, None])[..., None, None], world.rotation, np.eye(3, dtype=np.float32))
    return finite & np.asarray((np.linalg.det(rotation) > 0.5).all(axis=1))


def _state_of(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    state = np.empty(mujoco.mj_stateSize(model, _PHYSICS))
    mujoco.mj_getState(model, data, state, _PHYSICS)
    return state


def _set_robot(states: np.ndarray, robot: np.ndarray, nq: int) -> None:
    """Set the robot's positions, at rest. A state begins with time, positions and velocities."""
    states[:, 1 : 1 + ROBOT] = robot
    states[:, 1 + nq : 1 + nq + ROBOT] = 0.0
