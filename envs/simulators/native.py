"""The native simulator: C MuJoCo, each world stepped on a core of the CPU.

    simulator = NativeSimulator()
    world = simulator.reset([scenario])    # one world for each scenario
    outcome = simulator.execute(actions)   # an `Action` whose fields have a leading axis for the worlds

A single world is a `NativeWorld`. Only what touches or may touch is simulated: before an action the joints are set to
where its approach begins, after it to the home configuration. Between actions all bodies are at rest, and the world is
their poses alone.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions import Action, Kind, kind_of
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.envs.simulators.simulator import (
    ARM,
    ROBOT,
    Simulator,
    SimulatorConfig,
    check_actions,
    controls,
    resampled,
    way_back,
)
from mechsearch_jax.envs.simulators.trace import Recorder, Trace
from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.mismatch import ASSUMED_CELL, PhysicsName, TrueCell
from mechsearch_jax.envs.world.outcome import Failure, Outcome, outcome_of
from mechsearch_jax.envs.world.touching import Touch, touches
from mechsearch_jax.envs.world.world import BODIES, TARGET, World, alike, bodies_of, fallen_over, from_scenario, slots
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.robot.motion import Reference
from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.preparing import Program, motions
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, Scenario, rotation_matrix
from mechsearch_jax.workspace.shelf import Shelf

FINE_STEP, COARSE_STEP = 0.002, 0.005
# Time constants of contacts, twice MuJoCo's default and twice that of the robot's contacts [s].
SOFT, SOFT_ROBOT = 0.04, 0.02
# Iterations of MuJoCo's solver against slip.
NO_SLIP = 10
# Time steps between two looks at the error of an arm that may stop.
GUARD_BLOCK = 5


def _fine(model: mujoco.MjModel) -> None:
    model.opt.timestep = FINE_STEP


def _coarse(model: mujoco.MjModel) -> None:
    model.opt.timestep = COARSE_STEP


def _soft(model: mujoco.MjModel) -> None:
    robot = model.geom_priority > 0
    model.geom_solref[:, 0] = SOFT
    model.geom_solref[robot, 0] = SOFT_ROBOT


def _soft_friction(model: mujoco.MjModel) -> None:
    model.opt.impratio = 1.0


def _pyramidal(model: mujoco.MjModel) -> None:
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    # Without them most of what is grasped slips out of the hand.
    model.opt.noslip_iterations = NO_SLIP


# Each changes a model of the usual physics.
PHYSICS: Mapping[PhysicsName, Callable[[mujoco.MjModel], None]] = {
    "usual": lambda model: None,
    "fine-step": _fine,
    "coarse-step": _coarse,
    "soft-contacts": _soft,
    "soft-friction": _soft_friction,
    "pyramidal-cone": _pyramidal,
}


class NativeWorld:
    """One world in C MuJoCo: the same scenario and actions always give the same result on the same machine.

    Attributes:
      shelf, camera, config: as given.
      world: the present state; None before the first `reset` or `load`.
      restless: which bodies did not come to rest the last time that they were given time to, shape (9,).
    """

    def __init__(
        self,
        shelf: Shelf | None = None,
        camera: Camera | None = None,
        config: SimulatorConfig | None = None,
        blank: mujoco.MjModel | None = None,
    ):
        """Args:
        shelf, camera, config: the defaults if left out.
        blank: the compiled model of these, which is not changed; compiled anew if left out.
        """
        self.shelf = shelf or Shelf()
        self.camera = camera or Camera()
        self.config = config or SimulatorConfig()
        self.world: World | None = None
        self._blank = blank or models.compile_model(self.shelf, self.camera, self.config.motion.timestep)
        self._data = mujoco.MjData(self._blank)
        self._model = self._blank
        self._bodies: list[Body | None] = [None] * BODIES
        self._cell = ASSUMED_CELL
        self.restless = np.zeros(BODIES, bool)
        self._recorder = Recorder(self._data, self.config.trace_every)

    @property
    def trace(self) -> Trace:
        """What happened during the last action."""
        return self._recorder.trace(self._model)

    def reset(self, scenario: Scenario, cell: TrueCell = ASSUMED_CELL) -> World:
        """Start an episode; see `Simulator.reset`.

        Args:
          scenario: of the episode.
          cell: until the next reset.

        Raises:
          InputError: there are more objects than slots.
        """
        self._cell = cell
        return self._begin(slots(scenario), from_scenario(scenario))

    def load(self, world: World) -> World:
        """Start from a world, everything at rest and the robot at home.

        Args:
          world: fields without leading axes.
        """
        return self._begin(bodies_of(world), jax.tree.map(jnp.asarray, world))

    def execute(self, action: Action) -> Outcome:
        """Execute a single action, and let the bodies come to rest; see `Simulator.execute`.

        Raises:
          InputError: its kind is unknown.
        """
        kind = kind_of(int(action.kind))
        self._record()
        motion = reference_motion(kind, action, self.config.motion)
        if motion is None:
            return self._finish(Failure.NONE, True)
        reference, reachable = motion
        if not reachable:
            return self._finish(Failure.UNREACHABLE, True)
        before, gone = copy.copy(self._data), self._fallen()
        failure, error, settled = self._perform(kind, reference, int(action.object))
        if self._recorder.diverged:
            self._data = before
            return self._finish(Failure.UNSTABLE, False)
        if kind.takes_target:
            return self._finish_retrieval(failure, settled, gone).replace(tracking_error=jnp.float32(error))
        return self._finish(failure, settled).replace(tracking_error=jnp.float32(error))

    def settle(self) -> Outcome:
        """Let time pass, with the robot where it is, until everything is at rest or the time for that is over."""
        self._record()
        before = copy.copy(self._data)
        settled = self._come_to_rest()
        if self._recorder.diverged:
            self._data = before
            return self._finish(Failure.UNSTABLE, False)
        return self._finish(Failure.NONE, settled)

    def scenario(self, name: str) -> Scenario:
        """The present state as a scenario, its numbers rounded to a micrometre."""
        bodies: dict[int, Body] = {}
        for i, body in enumerate(self._bodies):
            if body is not None:
                position, quaternion = np.split(self._data.joint(f"body{i}").qpos, [3])
                place = tuple(round(float(p), 6) for p in position)
                turn = tuple(round(float(q), 9) for q in quaternion / np.linalg.norm(quaternion))
                bodies[i] = dataclasses.replace(body, position=place, quaternion=turn)
        target = bodies.pop(TARGET)
        return Scenario(name, tuple(bodies.values()), target)

    def place(self, bodies: list[Body | None], cell: TrueCell = ASSUMED_CELL) -> None:
        """Start from bodies, everything at rest and the robot at home; `world` stays what it was.

        Args:
          bodies: in their slots.
          cell: with the factors on sliding frictions and masses, the physics, and where the robot stands.
        """
        self._bodies = bodies
        self._model = models.with_bodies(self._model_for(bodies), bodies, mass=cell.mass * cell.body_mass)
        self._model.geom_friction[:, 0] *= cell.friction
        slots = models.geometry_slots(self._model)
        self._model.geom_friction[slots >= 0, 0] *= cell.body_friction[slots[slots >= 0]]
        models.move_robot(self._model, cell.T_world_base)
        PHYSICS[cell.physics](self._model)
        self._data = models.initial_state(self._model, bodies)
        self._go_home()

    def _model_for(self, bodies: list[Body | None]) -> mujoco.MjModel:
        """The model with the geometry of the compounds among the bodies, in 6 ms; the blank one without compounds."""
        compounds = models.compounds_in(bodies)
        if not compounds:
            return self._blank
        return models.compile_model(self.shelf, self.camera, self._blank.opt.timestep, compounds)

    def drive(self, controls: Float[np.ndarray, "steps 9"], at_once: bool = False) -> Float[np.ndarray, "steps 9"]:
        """Step with one row of controls per step from where everything is, and let the bodies come to rest.

        `world` stays what it was.

        Args:
          controls: of joints [rad] and fingers [m].
          at_once: set the robot to where the first row says beforehand, rather than move it there.

        Returns:
          Joints and fingers after each step.
        """
        if at_once:
            self._set_robot(controls[0, :ARM], float(controls[0, ARM]))
        self._record()
        states = self._run(np.ascontiguousarray(controls))
        self._come_to_rest()
        return states[:, 1 : 1 + ROBOT]

    @property
    def positions(self) -> Float[np.ndarray, " coordinates"]:
        """Joints [rad], fingers [m], and position [m] and quaternion of every body, as MuJoCo has them."""
        return self._data.qpos.copy()

    @property
    def fallen(self) -> Bool[np.ndarray, " 9"]:
        """Which bodies are off the board, the target last."""
        return self._fallen()

    @property
    def holds_target(self) -> tuple[bool, bool]:
        """Whether both fingers press on the target, and whether it is outside the shelf."""
        return self._holds(TARGET), bool(self._data.joint(f"body{TARGET}").qpos[0] < self.shelf.front)

    def touching(self) -> list[Touch]:
        """What the bodies touch where they are."""
        mujoco.mj_forward(self._model, self._data)
        return touches(self._model, self._data)

    def _record(self) -> None:
        """Begin a trace."""
        self.restless = np.zeros(BODIES, bool)
        self._recorder = Recorder(self._data, self.config.trace_every)

    def _target_lies(self) -> bool:
        """Whether there is a target that has fallen over."""
        quaternion, body = self._data.joint(f"body{TARGET}").qpos[3:], self._bodies[TARGET]
        return body is not None and fallen_over(rotation_matrix(quaternion), body.compound is None)

    def _perform(self, kind: Kind, reference: Reference, index: int) -> tuple[Failure, float, bool]:
        """Run a motion and let everything come to rest: why it failed, the tracking error [rad], and whether all is."""
        # The blank model's step has as many digits as MuJoCo was given, and is the usual one.
        reference = resampled(reference, self._blank.opt.timestep, self._model.opt.timestep)
        stop = self._cell.arm_stop
        states, stopped = self._guarded(reference, stop) if stop else (self._follow(reference), False)
        error = self._tracking_error(states, reference)
        held_up = stopped or error > self.config.tracking_bound
        dropped = not held_up and kind.holds_object and not self._slip(states, reference, index) < self.config.slip
        if kind.returns_home or stopped:
            self._go_home()
        settled = self._come_to_rest()
        failure = Failure.DROPPED if dropped else Failure.NONE
        return Failure.HELD_UP if held_up else failure, error, settled

    def _begin(self, bodies: list[Body | None], world: World) -> World:
        self.place(bodies, self._cell)
        self.world = world
        return world

    def _run(self, controls: np.ndarray) -> np.ndarray:
        """Step with one row of controls per step; the states after each step."""
        size = mujoco.mj_stateSize(self._model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        state = np.empty(size)
        mujoco.mj_getState(self._model, self._data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        states = np.empty((1, len(controls), size))
        mujoco.rollout.rollout(self._model, self._data, state[None], controls[None], state=states)
        mujoco.mj_setState(self._model, self._data, states[0, -1], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self._data.ctrl[:] = controls[-1]
        self._recorder.add(states[0], self._diverged())
        return states[0]

    def _follow(self, reference: Reference) -> np.ndarray:
        """Put the robot where a reference starts, and run it until its motion is over; the states after each step."""
        start = np.asarray(reference.start, float)
        self._set_robot(start[:ARM], float(start[ARM]))
        return self._run(controls(reference))

    def _guarded(self, reference: Reference, arm_stop: float) -> tuple[np.ndarray, bool]:
        """As `_follow`, but an arm that is held up stops and goes back the way it came, or out once the hand opens.

        Args:
          reference: of the arm.
          arm_stop: error of a joint at which it stops [rad].

        Returns:
          The states until it stops, and whether it did.
        """
        start, commands = np.asarray(reference.start, float), controls(reference)
        self._set_robot(start[:ARM], float(start[ARM]))
        states: list[np.ndarray] = []
        for first in range(0, len(commands), GUARD_BLOCK):
            states.append(self._run(np.ascontiguousarray(commands[first : first + GUARD_BLOCK])))
            rows = slice(first, first + len(states[-1]))
            error = np.abs(states[-1][:, 1 : 1 + ARM] - np.asarray(reference.q[rows], float)).max()
            if error > arm_stop:
                out = rows.stop >= int(reference.opens)
                # On its way back the hand would close again on what it has put down.
                rest = commands[rows.stop :] if out else way_back(reference, rows.stop)
                if len(rest):
                    self._run(np.ascontiguousarray(rest))
                return np.concatenate(states), True
        return np.concatenate(states), False

    def _tracking_error(self, states: np.ndarray, reference: Reference) -> float:
        """How far a joint was at most from its reference [rad]."""
        return float(np.abs(states[:, 1 : 1 + ARM] - np.asarray(reference.q[: len(states)], float)).max())

    def _slip(self, states: np.ndarray, reference: Reference, body: int) -> float:
        """How far a body has moved in the hand between when it closed and when it was to open [m]."""
        held = [self._in_gripper(states[int(step) - 1], body) for step in (reference.closed, reference.opens)]
        return float(np.linalg.norm(held[1] - held[0]))

    def _in_gripper(self, state: np.ndarray, body: int) -> np.ndarray:
        """Position of a body in the gripper's frame."""
        scratch = mujoco.MjData(self._model)
        mujoco.mj_setState(self._model, scratch, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_kinematics(self._model, scratch)
        site = scratch.site("gripper")
        return site.xmat.reshape(3, 3).T @ (scratch.body(f"body{body}").xpos - site.xpos)

    def _come_to_rest(self) -> bool:
        """Hold the robot still until the bodies are at rest; whether they are. Their last motion is then stopped."""
        limit = self.config.rest_speed * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
        block = round(self.config.settle_block * self.config.motion.timestep / self._model.opt.timestep)
        hold = np.tile(self._data.ctrl, (block, 1))
        first = 1 + self._model.nq + ROBOT
        for _ in range(self.config.settle_steps // self.config.settle_block):
            states = self._run(hold)
            speed = np.abs(states[:, first : first + 6 * BODIES]).reshape(-1, BODIES, 6)
            # Also of what is not a number.
            self.restless = np.asarray(~(speed < limit).all(axis=(0, 2)), bool)
            if not self.restless.any():
                break
        self._data.qvel[:] = 0.0
        return not self.restless.any()

    def _set_robot(self, q: np.ndarray, finger: float) -> None:
        fingers = np.full(2, max(finger, 0.0))
        self._data.qpos[:ROBOT] = self._data.ctrl[:] = np.concatenate([q, fingers])
        self._data.qvel[:ROBOT] = 0.0

    def _go_home(self) -> None:
        self._set_robot(HOME, 0.0)

    def _holds(self, body: int) -> bool:
        """Whether both fingers press on a body."""
        mujoco.mj_forward(self._model, self._data)
        owner = self._model.geom_bodyid
        touching = {(owner[c.geom1], owner[c.geom2]) for c in self._data.contact if c.efc_address >= 0}
        held = self._model.body(f"body{body}").id
        fingers = (self._model.body(f"{side}_finger").id for side in ("left", "right"))
        return all((f, held) in touching or (held, f) in touching for f in fingers)

    def _diverged(self) -> bool:
        """Whether the steps of the last `_run` went wrong; what MuJoCo then makes of the state means nothing."""
        warnings = (
            mujoco.mjtWarning.mjWARN_BADQPOS,
            mujoco.mjtWarning.mjWARN_BADQVEL,
            mujoco.mjtWarning.mjWARN_BADQACC,
        )
        return not np.isfinite(self._data.qpos).all() or any(self._data.warning[w].number for w in warnings)

    def _fallen(self) -> Bool[np.ndarray, " 9"]:
        """Which bodies have fallen off the board."""
        position = self._data.qpos[ROBOT:].reshape(BODIES, 7)[:, :3]
        valid = np.array([body is not None for body in self._bodies])
        return valid & ((position[:, 0] < self.shelf.front) | (position[:, 2] < self.shelf.board))

    def _retrieval(self, gone: Bool[np.ndarray, " 9"]) -> _Retrieval:
        """What became of an attempt to take the target out, before which some bodies were gone."""
        held = self._holds(TARGET)
        outside = bool(self._data.joint(f"body{TARGET}").qpos[0] < self.shelf.front)
        fallen = self._fallen() & ~(held & (np.arange(BODIES) == TARGET))
        lost = (fallen & ~gone).any()
        checks = ((Failure.MISSED, not held), (Failure.INSIDE, not outside), (Failure.FALLEN, lost))
        failure = next((code for code, applies in checks if applies), Failure.NONE)
        return _Retrieval(failure, held, outside, fallen)

    def _finish_retrieval(self, failure: Failure, settled: bool, gone: Bool[np.ndarray, " 9"]) -> Outcome:
        """Say what became of an attempt to take the target out, before which some bodies were gone."""
        retrieval = self._retrieval(gone)
        self._take_over()
        failure = failure or retrieval.failure
        how = retrieval.fallen, self.restless, retrieval.held, retrieval.outside
        return outcome_of(failure, self._recorder.steps, settled, *how)

    def _finish(self, failure: Failure, settled: bool) -> Outcome:
        """Say what became of anything else."""
        self._take_over()
        return outcome_of(failure, self._recorder.steps, settled, self._fallen(), self.restless)

    def _take_over(self) -> None:
        """Take the world over from the simulation, if anything was simulated."""
        if self.world is None or not self._recorder.steps:
            return
        poses = self._data.qpos[ROBOT:].reshape(BODIES, 7)
        valid = np.array([body is not None for body in self._bodies])
        rotation = rotation_matrix(poses[:, 3:])
        self.world = self.world.replace(
            position=jnp.where(valid[:, None], jnp.asarray(poses[:, :3], jnp.float32), self.world.position),
            rotation=jnp.where(valid[:, None, None], jnp.asarray(rotation, jnp.float32), self.world.rotation),
        )


class _Retrieval(NamedTuple):
    """What became of an attempt to take the target out; fields as of `Outcome`."""

    failure: Failure
    held: bool
    outside: bool
    fallen: Bool[np.ndarray, " 9"]


class NativeSimulator(Simulator):
    """Many worlds, each a `NativeWorld`, stepped by threads. Each behaves exactly as a single `NativeWorld`."""

    engine = "NativeSimulator"
    takes_cells = True

    def __init__(
        self,
        threads: int | None = None,
        config: SimulatorConfig | None = None,
        shelf: Shelf | None = None,
        camera: Camera | None = None,
    ):
        """Args:
        threads: number of worlds that are simulated at the same time; one for each core if None.
        config, shelf, camera: of every world.
        """
        self._config, self._shelf, self._camera = config, shelf, camera
        self._threads = threads or cores()
        self._worlds: list[NativeWorld] = []
        self._cells: dict[int, TrueCell] = {}

    @property
    def traces(self) -> list[Trace]:
        """The traces of every world's last action."""
        return [world.trace for world in self._worlds]

    def reset(self, scenarios: Sequence[Scenario]) -> World:
        if not scenarios:
            raise InputError("NativeSimulator: no scenarios are given; reset it with one for each world")
        self._make(len(scenarios))
        return self.replace(dict(enumerate(scenarios)))

    def replace(self, scenarios: Mapping[int, Scenario]) -> World:
        if not self._worlds:
            raise InputError(f"{self.engine}: reset it before use")
        for i, scenario in scenarios.items():
            self._worlds[i].reset(scenario, self._cells.pop(i, ASSUMED_CELL))
        return self._gather()

    def set_cells(self, cells: Mapping[int, TrueCell]) -> None:
        self._cells.update(cells)

    def load(self, world: World, only: Bool[np.ndarray, " worlds"] | None = None) -> World:
        count = len(world.kind)
        if only is None:
            self._make(count)
        else:
            self._check_part(count, only)
        host = jax.device_get(world)
        for i in range(count) if only is None else np.flatnonzero(only):
            self._worlds[i].load(jax.tree.map(lambda leaf, i=i: leaf[i], host))
        return self._gather()

    def execute(self, actions: Action, active: Bool[Array, " worlds"] | None = None) -> Outcome:
        check_actions(self.engine, actions, self._count())
        actions = jax.device_get(actions)
        return self._each(active, lambda i: self._worlds[i].execute(_row(actions, i)))

    def programs(self, world: World) -> list[Program]:
        """The motions of all kinds of action."""
        return motions((self._config or SimulatorConfig()).motion)

    def settle(self, active: Bool[Array, " worlds"] | None = None) -> Outcome:
        self._count()
        return self._each(active, lambda i: self._worlds[i].settle())

    def _make(self, count: int) -> None:
        """Create or drop worlds so that there are `count`."""
        missing = [NativeWorld(self._shelf, self._camera, self._config) for _ in range(count - len(self._worlds))]
        self._worlds = (self._worlds + missing)[:count]

    def _each(self, active: Bool[Array, " worlds"] | None, run: Callable[[int], Outcome]) -> Outcome:
        """The outcomes of `run` in every active world, and of doing nothing in the others."""
        count = len(self._worlds)
        busy = np.flatnonzero(np.ones(count, bool) if active is None else np.asarray(active)).tolist()
        with ThreadPoolExecutor(self._threads) as pool:
            outcomes = dict(zip(busy, jax.device_get(list(pool.map(run, busy))), strict=True))
        self._gather()
        idle = jax.device_get(outcome_of(Failure.NONE, 0, True, np.zeros(BODIES, bool)))
        return jax.tree.map(
            lambda *leaves: jax.device_put(np.stack(leaves)), *(outcomes.get(i, idle) for i in range(count))
        )

    def _gather(self) -> World:
        worlds = alike([jax.device_get(world.world) for world in self._worlds])
        world: World = jax.tree.map(lambda *leaves: jax.device_put(np.stack(leaves)), *worlds)
        self.world = world
        return world


def _row(actions: Action, i: int) -> Action:
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)[i]), actions)
