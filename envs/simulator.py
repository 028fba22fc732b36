"""The native simulator: C MuJoCo steps the robot and the shelf on one CPU core.

Only what touches or may touch is simulated: before an action the joints are set to where its approach begins, after it
to the home configuration. Between actions all bodies are at rest, and the world is their poses alone.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import copy
import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions import Action, ActionKind
from mechsearch_jax.envs import model as models
from mechsearch_jax.envs.world import BODIES, TARGET, World, bodies_of, from_scenario, slots
from mechsearch_jax.robot import motion
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.robot.motion import MotionConfig, Reference
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, Scenario, rotation_matrix
from mechsearch_jax.workspace.shelf import Shelf

ARM = len(HOME)
ROBOT = ARM + 2


@dataclasses.dataclass(frozen=True)
class SimulatorConfig:
    """How the native simulator runs.

    Attributes:
      motion: durations and lengths of the motion primitives.
      rest_speed: bodies slower than this are at rest [m/s, and rad/s times 0.1 m].
      settle_steps: after an action the bodies are given at most so many steps to come to rest.
      settle_block: how many steps pass between looks at whether they have.
      slip: an object that has moved farther than this in the closed hand was dropped [m].
      trace_every: the trace keeps the state of every so many steps.
    """

    motion: MotionConfig = dataclasses.field(default_factory=MotionConfig)
    rest_speed: float = 2e-3
    settle_steps: int = 1500
    settle_block: int = 50
    slip: float = 0.03
    trace_every: int = 25


@dataclasses.dataclass(frozen=True)
class Trace:
    """What happened, for pictures: one row for each kept step.

    Attributes:
      time: since the action began [s].
      q: joint angles [rad], shape (frames, 7).
      fingers: distance of each finger from the middle [m], shape (frames, 2): left, right.
      position: of the nine bodies [m], shape (frames, 9, 3).
      quaternion: (w, x, y, z) of the nine bodies, shape (frames, 9, 4).
    """

    time: Float[np.ndarray, " frames"]
    q: Float[np.ndarray, "frames 7"]
    fingers: Float[np.ndarray, "frames 2"]
    position: Float[np.ndarray, "frames 9 3"]
    quaternion: Float[np.ndarray, "frames 9 4"]


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What an action did.

    Attributes:
      failure: None, or why the action was not executed as commanded: "unreachable" (the arm cannot follow the motion;
        nothing moved), "dropped" (the object slipped out of the hand on its way; the world is as it became),
        "unstable" (the simulation diverged; the world is as before).
      steps: simulated time steps.
      settled: whether everything was at rest at the end.
      fallen: which bodies have fallen off the board, the target last.
      trace: what happened on the way.
    """

    failure: str | None
    steps: int
    settled: bool
    fallen: Bool[np.ndarray, " 9"]
    trace: Trace


@dataclasses.dataclass(frozen=True)
class Retrieval:
    """What became of an attempt to take the target out; see `Outcome`.

    Attributes:
      retrieved: the target is between the closed fingers and outside the shelf, and no body fell off the board.
      held: the target is between the closed fingers.
      outside: the target is outside the shelf.
      failure: None, or "unreachable", "missed" (not held), "inside" (held, but not outside), "fallen" (some body fell
        off the board), or "unstable".
      steps: simulated time steps.
      fallen: which bodies have fallen off the board; never the target in the hand.
      trace: what happened on the way.
    """

    retrieved: bool
    held: bool
    outside: bool
    failure: str | None
    steps: int
    fallen: Bool[np.ndarray, " 9"]
    trace: Trace


class NativeSimulator:
    """One world in C MuJoCo: the same scenario and actions always give the same result on the same machine.

    Attributes:
      shelf, camera, config: as given.
      world: the present state.
    """

    def __init__(self, shelf: Shelf | None = None, camera: Camera | None = None, config: SimulatorConfig | None = None):
        self.shelf = shelf or Shelf()
        self.camera = camera or Camera()
        self.config = config or SimulatorConfig()
        plan = self.config.motion
        self._blank = models.compile_model(self.shelf, self.camera, plan.timestep)
        self._push = functools.partial(jax.jit(motion.push_reference, static_argnames="config"), config=plan)
        self._pick = functools.partial(jax.jit(motion.pick_and_place_reference, static_argnames="config"), config=plan)
        self._retrieve = functools.partial(jax.jit(motion.retrieve_reference, static_argnames="config"), config=plan)
        self._data = mujoco.MjData(self._blank)
        self._model = self._blank
        self._bodies: list[Body | None] = [None] * BODIES
        self.world: World | None = None

    def reset(self, scenario: Scenario) -> World:
        """Start an episode: every body is exactly where the scenario has it, at rest.

        Raises:
          InputError: there are more objects than slots.
        """
        return self._begin(slots(scenario), from_scenario(scenario))

    def load(self, world: World) -> World:
        """Start from a world, everything at rest and the robot at home.

        Args:
          world: fields without leading axes.
        """
        return self._begin(bodies_of(world), jax.tree.map(jnp.asarray, world))

    def _begin(self, bodies: list[Body | None], world: World) -> World:
        self._bodies = bodies
        self._model = models.with_bodies(self._blank, bodies)
        self._data = models.initial_state(self._model, bodies)
        self.world = world
        return world

    def settle(self) -> Outcome:
        """Let time pass, with the robot at home, until everything is at rest or the time for that is over."""
        self._go_home()
        recorder = _Recorder(self._data, self.config.trace_every)
        settled = self._come_to_rest(recorder)
        return self._finish(recorder, settled, None)

    def execute(self, action: Action) -> Outcome:
        """Execute an action and let the bodies come to rest; `world` is then what it made of the world.

        Args:
          action: a single action, of any kind; "none" does nothing.
        """
        kind = ActionKind(int(action.kind))
        recorder = _Recorder(self._data, self.config.trace_every)
        if kind is ActionKind.NONE:
            return self._finish(recorder, True, None)
        if kind is ActionKind.PUSH:
            reference, reachable = self._push(action.T_world_gripper, action.displacement, action.q7)
        else:
            reference, reachable = self._pick(action.T_world_gripper, action.T_world_place, action.q7, action.opening)
        if not reachable:
            return self._finish(recorder, True, "unreachable")
        before = copy.copy(self._data)
        held = self._follow(reference, recorder, int(action.object))
        self._go_home()
        settled = self._come_to_rest(recorder)
        if self._diverged():
            self._data = before
            return self._finish(recorder, False, "unstable")
        return self._finish(recorder, settled, None if kind is ActionKind.PUSH or held else "dropped")

    def retrieve(self, T_world_gripper: Array, q7: Array | float, opening: Array | float) -> Retrieval:
        """Take the target out: approach, close the fingers, retreat, and leave the shelf with it.

        Args:
          T_world_gripper: pose of the gripper where it closes, shape (4, 4).
          q7: angle of joint 7 during the approach and the retreat [rad].
          opening: distance between the fingers on the approach [m].
        """
        recorder = _Recorder(self._data, self.config.trace_every)
        reference, reachable = self._retrieve(T_world_gripper, jnp.float32(q7), jnp.float32(opening))
        if not reachable:
            outcome = self._finish(recorder, True, None)
            return Retrieval(False, False, False, "unreachable", 0, outcome.fallen, outcome.trace)
        before = copy.copy(self._data)
        self._follow(reference, recorder, TARGET)
        settled = self._come_to_rest(recorder)
        if self._diverged():
            self._data = before
            outcome = self._finish(recorder, False, None)
            return Retrieval(False, False, False, "unstable", outcome.steps, outcome.fallen, outcome.trace)
        held = self._holds(TARGET)
        outside = bool(self._position(TARGET)[0] < self.shelf.front)
        outcome = self._finish(recorder, settled, None)
        fallen = outcome.fallen & ~(held & (np.arange(BODIES) == TARGET))
        failure = "missed" if not held else "inside" if not outside else "fallen" if fallen.any() else None
        return Retrieval(failure is None, held, outside, failure, outcome.steps, fallen, outcome.trace)

    def scenario(self, name: str) -> Scenario:
        """The present state as a scenario, its numbers rounded to a micrometre."""
        found = []
        for i, body in enumerate(self._bodies):
            if body is not None:
                position, quaternion = np.split(self._data.joint(f"body{i}").qpos, [3])
                place = tuple(round(float(p), 6) for p in position)
                turn = tuple(round(float(q), 9) for q in quaternion / np.linalg.norm(quaternion))
                found.append(dataclasses.replace(body, position=place, quaternion=turn))
        return Scenario(name, tuple(found[:-1]), found[-1])

    def _run(self, controls: np.ndarray, recorder: _Recorder) -> np.ndarray:
        """Step with one row of controls per step; the states after each step."""
        size = mujoco.mj_stateSize(self._model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        state = np.empty(size)
        mujoco.mj_getState(self._model, self._data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        states = np.empty((1, len(controls), size))
        mujoco.rollout.rollout(self._model, self._data, state[None], controls[None], state=states)
        mujoco.mj_setState(self._model, self._data, states[0, -1], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self._data.ctrl[:] = controls[-1]
        recorder.add(states[0])
        return states[0]

    def _follow(self, reference: Reference, recorder: _Recorder, body: int) -> bool:
        """Run a reference; whether a body kept its place in the hand from when it closed to when it is to open."""
        start = np.asarray(reference.start, float)
        self._set_robot(start[:ARM], float(start[ARM]))
        states = self._run(controls(reference), recorder)
        plan = self.config.motion
        if len(states) < plan.release_step:
            return True
        held = [self._in_gripper(states[step - 1], body) for step in (plan.grasp_step, plan.release_step)]
        return bool(np.linalg.norm(held[1] - held[0]) < self.config.slip)

    def _in_gripper(self, state: np.ndarray, body: int) -> np.ndarray:
        """Position of a body in the gripper's frame."""
        scratch = mujoco.MjData(self._model)
        mujoco.mj_setState(self._model, scratch, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_kinematics(self._model, scratch)
        site = scratch.site("gripper")
        return site.xmat.reshape(3, 3).T @ (scratch.body(f"body{body}").xpos - site.xpos)

    def _come_to_rest(self, recorder: _Recorder) -> bool:
        """Hold the robot still until the bodies are at rest; whether they are. Their last motion is then stopped."""
        limit = self.config.rest_speed * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
        hold = np.tile(self._data.ctrl, (self.config.settle_block, 1))
        first = 1 + self._model.nq + ROBOT
        settled = False
        for _ in range(self.config.settle_steps // self.config.settle_block):
            states = self._run(hold, recorder)
            speed = np.abs(states[:, first : first + 6 * BODIES]).reshape(-1, BODIES, 6)
            settled = bool((speed < limit).all())
            if settled:
                break
        self._data.qvel[:] = 0.0
        return settled

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
        warnings = (
            mujoco.mjtWarning.mjWARN_BADQPOS,
            mujoco.mjtWarning.mjWARN_BADQVEL,
            mujoco.mjtWarning.mjWARN_BADQACC,
        )
        return not np.isfinite(self._data.qpos).all() or any(self._data.warning[w].number for w in warnings)

    def _position(self, body: int) -> np.ndarray:
        return self._data.joint(f"body{body}").qpos[:3]

    def _finish(self, recorder: _Recorder, settled: bool, failure: str | None) -> Outcome:
        """Take the world over from the simulation."""
        poses = self._data.qpos[ROBOT:].reshape(BODIES, 7)
        valid = np.array([body is not None for body in self._bodies])
        rotation = np.stack([rotation_matrix(q) for q in poses[:, 3:]])
        if self.world is not None and recorder.steps:
            self.world = self.world.replace(
                position=jnp.where(valid[:, None], jnp.asarray(poses[:, :3], jnp.float32), self.world.position),
                rotation=jnp.where(valid[:, None, None], jnp.asarray(rotation, jnp.float32), self.world.rotation),
            )
        fallen = valid & ((poses[:, 0] < self.shelf.front) | (poses[:, 2] < self.shelf.board))
        return Outcome(failure, recorder.steps, settled, fallen, recorder.trace(self._model))


def controls(reference: Reference) -> Float[np.ndarray, "steps 9"]:
    """What the actuators are told at each step so that the arm follows a reference without lag.

    A position actuator with a velocity gain trails its command by (gain + damping) / stiffness times the speed; the
    command is ahead by as much.
    """
    lead = (np.array(models.ARM_VELOCITY_GAIN) + models.ARM_DAMPING) / np.array(models.ARM_STIFFNESS)
    arm = np.asarray(reference.q, float) + lead * np.asarray(reference.velocity, float)
    fingers = np.asarray(reference.fingers, float)[:, None]
    return np.concatenate([arm, fingers, fingers], axis=1)


class _Recorder:
    """Collects the states that make a trace."""

    def __init__(self, data: mujoco.MjData, every: int):
        self.steps = 0
        self._begin = data.time
        self._every = every
        self._kept: list[np.ndarray] = []

    def add(self, states: np.ndarray) -> None:
        self._kept.extend(states[(-self.steps) % self._every :: self._every])
        self.steps += len(states)

    def trace(self, model: mujoco.MjModel) -> Trace:
        states = np.array(self._kept) if self._kept else np.empty((0, 1 + model.nq))
        qpos = states[:, 1 : 1 + model.nq]
        bodies = qpos[:, ROBOT:].reshape(-1, BODIES, 7)
        time = states[:, 0] - self._begin
        return Trace(time, qpos[:, :ARM], qpos[:, ARM:ROBOT], bodies[..., :3], bodies[..., 3:])
