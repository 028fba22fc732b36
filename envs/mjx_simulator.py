"""The batch simulator: MuJoCo's Warp implementation in MJX steps thousands of worlds in one compiled function.

It has the scene, the motion primitives and the verdicts of `NativeSimulator`, for W worlds at once:

    simulator = MjxSimulator()
    world = simulator.reset(scenarios)             # W scenarios; a `World` whose fields have a leading axis W
    outcomes = simulator.execute(actions)          # an `Action` whose fields have a leading axis W
    outcomes = simulator.execute(actions, active)  # worlds whose `active` (W,) is False stay exactly as they are
    outcomes = simulator.retrieve(T, q7, opening)  # (W, 4, 4), (W,), (W,): take the targets out
    simulator.world                                # where everything is now
    outcomes.failure                               # (W,) codes of `Failure`; `outcomes.reason(i)` is the text
    outcomes.overflow                              # (W,) flags of `Overflow`; not 0: do not trust this world

In one call some worlds may push, others pick and place, others take the target out (an action whose kind is
`RETRIEVE`, see `retrievals` and `choose`) and others do nothing. All step together until the last of them is at rest;
a world that is done before that is frozen. A world whose state is no longer finite is put back to where it was and
frozen at once, so that it touches no other. The first call for a number of worlds compiles; later ones do not,
whatever the actions are.

Everything stays on the device: the host waits only where a field of `outcomes` or `world` is read.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import copy
import dataclasses
import enum
import functools
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions import Action, ActionKind
from mechsearch_jax.envs import model as models
from mechsearch_jax.envs.batch_model import BodyFields, body_fields
from mechsearch_jax.envs.simulator import ARM, ROBOT, SimulatorConfig
from mechsearch_jax.envs.world import BODIES, TARGET, World, from_scenario
from mechsearch_jax.errors import InputError
from mechsearch_jax.robot import motion
from mechsearch_jax.robot.kinematics import HOME, gripper_pose
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf

# Kinds of an action beside those of `ActionKind`: take the target out; hold still until everything is at rest.
RETRIEVE = len(ActionKind)
WAIT = RETRIEVE + 1

# A state beyond this has diverged; the same bound as in C MuJoCo.
LARGEST = 1e10

# The constraint solver's tolerance: the least that MuJoCo Warp takes where it makes its model itself.
SOLVER_TOLERANCE = 1e-6


class Failure(enum.IntEnum):
    """Why an action was not executed as commanded; see `simulator.Outcome` and `simulator.Retrieval`."""

    NONE = 0
    UNREACHABLE = 1
    DROPPED = 2
    UNSTABLE = 3
    MISSED = 4
    INSIDE = 5
    FALLEN = 6


class Overflow(enum.IntFlag):
    """What was too small for a world's contacts while it was simulated; its result cannot be trusted then.

    `ROWS` (more constraint rows than `njmax`) and `SHAPES` (a buffer of the convex collision) are a world's own.
    `CONTACTS` is the buffer that all worlds share: which of them lost contacts is not known, so that every world which
    was running at that moment is marked.
    """

    NONE = 0
    ROWS = 1
    CONTACTS = 2
    SHAPES = 4


@dataclasses.dataclass(frozen=True)
class MjxConfig:
    """How the batch simulator runs.

    Attributes:
      simulator: as for the native simulator; `trace_every` has no meaning here, there are no traces.
      contacts: capacity for contacts, per world on average; the buffer is shared.
      rows: capacity for constraint rows in every world.
      chunk: time steps between looks at whether all worlds are done.
    """

    simulator: SimulatorConfig = dataclasses.field(default_factory=SimulatorConfig)
    contacts: int = 64
    rows: int = 320
    chunk: int = 25

    def __post_init__(self):
        for name in ("contacts", "rows", "chunk"):
            if getattr(self, name) < 1:
                raise InputError(f"MjxConfig: {name} {getattr(self, name)} must be at least 1")


class Outcomes(flax.struct.PyTreeNode):
    """What the actions did; every field has a leading axis for the worlds.

    Attributes:
      failure: a `Failure`, int32.
      steps: simulated time steps, int32; 0 where nothing was to be done, or it was out of reach.
      settled: whether everything was at rest at the end.
      fallen: which bodies have fallen off the board, the target last, shape (W, 9); never a retrieved target in the
        hand.
      held: after a retrieval, whether the target is between the closed fingers; False after anything else.
      outside: after a retrieval, whether the target is outside the shelf; False after anything else.
      retrieved: whether a retrieval took the target out and no body fell off the board.
      overflow: flags of `Overflow`, int32.
    """

    failure: jax.Array
    steps: jax.Array
    settled: jax.Array
    fallen: jax.Array
    held: jax.Array
    outside: jax.Array
    retrieved: jax.Array
    overflow: jax.Array

    def reason(self, world: int) -> str | None:
        """Why a world's action failed, as `NativeSimulator` says it, or None."""
        failure = Failure(int(self.failure[world]))
        return None if failure is Failure.NONE else failure.name.lower()


def retrievals(
    T_world_gripper: Float[Array, "worlds 4 4"],
    q7: Float[Array, " worlds"],
    opening: Float[Array, " worlds"],
) -> Action:
    """The actions that take the targets out; arguments as in `MjxSimulator.retrieve`."""
    worlds = len(T_world_gripper)
    return Action(
        kind=jnp.full(worlds, RETRIEVE, jnp.int32),
        object=jnp.full(worlds, TARGET, jnp.int32),
        T_world_gripper=T_world_gripper,
        displacement=jnp.zeros((worlds, 3)),
        T_world_place=T_world_gripper,
        q7=q7,
        opening=opening,
    )


def choose(first: Bool[Array, " worlds"], a: Action, b: Action) -> Action:
    """In every world the action of `a` where `first` is set, and else that of `b`."""
    return jax.tree.map(lambda x, y: jnp.where(first.reshape(-1, *[1] * (x.ndim - 1)), x, y), a, b)


class _Task(flax.struct.PyTreeNode):
    """What every world is to do; fields have a leading axis for the worlds, `controls` for time before it.

    Attributes:
      controls: of the actuators; the last row is held, shape (steps, W, 9).
      length: time steps of the motion, after which the bodies come to rest.
      home: whether the robot is then set to its home configuration.
      before: the configuration before the action, which a diverged world gets back, shape (W, nq).
    """

    controls: jax.Array
    length: jax.Array
    home: jax.Array
    before: jax.Array


class _Progress(flax.struct.PyTreeNode):
    """How far every world has come; fields have a leading axis for the worlds.

    Attributes:
      done: nothing is to be simulated any more.
      settled, diverged: how it ended.
      moving: whether any body was not at rest in the present block of steps.
      steps: simulated so far.
      overflow: flags of `Overflow` so far.
      at_grasp, at_release: configurations when the hand has closed, and when it is to open, shape (W, nq).
    """

    done: jax.Array
    settled: jax.Array
    diverged: jax.Array
    moving: jax.Array
    steps: jax.Array
    overflow: jax.Array
    at_grasp: jax.Array
    at_release: jax.Array


def _where(condition: Array, a: Array, b: Array) -> Array:
    """`jnp.where` of a condition per world."""
    return jnp.where(condition.reshape(-1, *[1] * (b.ndim - 1)), a, b)


def _matrices(quaternion: Array) -> Array:
    """Rotation matrices of quaternions (w, x, y, z), which are normalised first."""
    norm = jnp.sqrt(jnp.sum(quaternion**2, axis=-1, keepdims=True))
    w, x, y, z = jnp.moveaxis(quaternion / jnp.maximum(norm, 1e-12), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def import_mjx() -> Any:
    """The module `mujoco.mjx`, once Warp is known to be there.

    Raises:
      InputError: Warp cannot be imported.
    """
    try:
        import warp  # pyright: ignore[reportMissingImports]

        # By default it announces itself, and every kernel that it loads, on standard output.
        if warp.config.log_level == warp.LOG_INFO:
            warp.config.log_level = warp.LOG_WARNING
        from mujoco import mjx
    except (ImportError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"the batch simulator needs Warp ({reason}); install it with: pip install 'mechsearch-jax[gpu]'"
        ) from error
    return mjx


class MjxSimulator:
    """Many worlds in MuJoCo's Warp implementation; see the module's description.

    On a CPU the same scenarios and actions always give the same results, on a GPU they do not.

    Attributes:
      engine: what steps a world.
      shelf, camera, config: as given.
      world: the present state of all worlds; None before the first `reset`.
    """

    engine = "MjxSimulator"

    def __init__(self, shelf: Shelf | None = None, camera: Camera | None = None, config: MjxConfig | None = None):
        """Raises:
        InputError: Warp cannot be imported.
        """
        self.shelf = shelf or Shelf()
        self.camera = camera or Camera()
        self.config = config or MjxConfig()
        self.world: World | None = None
        self._mjx = import_mjx()
        blank = copy.copy(models.compile_model(self.shelf, self.camera, self.config.simulator.motion.timestep))
        # Warp has no midphase that could be disabled.
        blank.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
        # To Warp this flag says what collides two boxes: the algorithm of C MuJoCo, rather than that for any two convex
        # shapes, which in float32 misses or misjudges every tenth contact of a finger with a box.
        blank.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
        self._blank = blank
        with warnings.catch_warnings():
            # The planes have no friction of their own: that of a contact is the larger of the two.
            warnings.filterwarnings("ignore", message=r".*friction\[")
            self._model = self._mjx.put_model(blank, impl="warp")
        option = self._model.opt
        # What overflows is in the outcomes; printed from the device, it would be a line for every world and step.
        option = option.replace(_impl=option._impl.replace(warn_overflow=0))
        # MJX takes over the tolerance of C MuJoCo, which is too small for float32: the solver would only hop about the
        # solution, and all worlds wait for the one that hops longest.
        option = option.replace(tolerance=jnp.maximum(option.tolerance, SOLVER_TOLERANCE))
        self._model = self._model.replace(opt=option)
        self._axes = jax.tree.map(lambda _: None, self._model).replace(
            **dict.fromkeys(BodyFields.__dataclass_fields__, 0)
        )
        self._empty = jnp.asarray(np.concatenate([self._home(), *self._parked()]), jnp.float32)
        self._fields: BodyFields | None = None
        self._data: Any = None
        self._start = jax.jit(self._begin_state)
        self._execute = jax.jit(self._simulate, donate_argnums=1)
        self._rollout = jax.jit(self._follow, donate_argnums=1)

    def reset(self, scenarios: Sequence[Scenario]) -> World:
        """Start episodes: every body is exactly where its scenario has it, at rest, and the robot at home.

        Args:
          scenarios: one for each world.

        Raises:
          InputError: there are no scenarios, or more objects in one than slots.
        """
        if not scenarios:
            raise InputError("MjxSimulator: no scenarios are given; reset it with one for each world")
        worlds = [from_scenario(scenario) for scenario in scenarios]
        return self.load(jax.tree.map(lambda *leaves: np.stack(leaves), *worlds))

    def replace(self, scenarios: Mapping[int, Scenario]) -> World:
        """Start episodes in some of the worlds, as `reset` does; the others stay exactly as they are.

        Raises:
          InputError: the simulator was not reset, or there are more objects in a scenario than slots.
        """
        count = self._count()
        new = jax.tree.map(np.array, self.world)
        for i, scenario in scenarios.items():
            for old, value in zip(jax.tree.leaves(new), jax.tree.leaves(from_scenario(scenario)), strict=True):
                old[i] = value
        return self.load(new, np.isin(np.arange(count), list(scenarios)))

    def load(self, world: World, only: Bool[np.ndarray, " worlds"] | None = None) -> World:
        """Take over the state of all worlds, or of some; the robot is at home there and everything at rest.

        Args:
          world: fields with a leading axis for the worlds.
          only: which worlds to change; the others keep their state. There must be as many worlds as now.

        Raises:
          InputError: some worlds are to be kept, but there are none, or not as many.
        """
        count = len(world.kind)
        if only is not None and (self.world is None or len(self.world.kind) != count or len(only) != count):
            raise InputError(f"MjxSimulator: some of {count} worlds can be replaced only where there are as many")
        world = jax.tree.map(jnp.asarray, world)
        fields, qpos, ctrl = self._start(world)
        if only is None:
            if self._data is None or self._data.qpos.shape[0] != count:
                self._data = self._make_data(count)
            changed = jnp.ones(count, bool)
        else:
            changed = jnp.asarray(only)
            fields, world = jax.tree.map(
                functools.partial(_where, changed), (fields, world), (self._fields, self.world)
            )
        data = self._data
        self._data = data.replace(
            qpos=_where(changed, qpos, data.qpos),
            ctrl=_where(changed, ctrl, data.ctrl),
            qvel=_where(changed, jnp.zeros_like(data.qvel), data.qvel),
            qacc_warmstart=_where(changed, jnp.zeros_like(data.qvel), data.qacc_warmstart),
        )
        self._fields, self.world = fields, world
        return world

    def simulate(self, world: World, actions: Action) -> tuple[World, Outcomes]:
        """What actions would make of worlds: `load` and `execute` without memory, to be traced.

        This simulator's own worlds stay as they are.

        Args:
          world, actions: fields with a leading axis for the worlds.

        Returns:
          The worlds afterwards, and what came of the actions.
        """
        count = len(world.kind)
        fields, qpos, ctrl = self._start(world)
        data = self._make_data(count).replace(qpos=qpos, ctrl=ctrl)
        _, world, outcomes = self._simulate(fields, data, world, actions, jnp.ones(count, bool))
        return world, outcomes

    def settle(self, active: Bool[Array, " worlds"] | None = None) -> Outcomes:
        """Let time pass, with the robot where it is, until everything is at rest or the time for that is over.

        Args:
          active: in which worlds; all by default.
        """
        pose = jnp.tile(jnp.eye(4), (self._count(), 1, 1))
        zero = jnp.zeros(self._count())
        wait = retrievals(pose, zero, zero)
        return self.execute(wait.replace(kind=jnp.full_like(wait.kind, WAIT)), active)

    def execute(self, actions: Action, active: Bool[Array, " worlds"] | None = None) -> Outcomes:
        """Execute an action in every world and let the bodies come to rest; `world` is then what became of them.

        Args:
          actions: fields with a leading axis for the worlds; `kind` is an `ActionKind` or `RETRIEVE`.
          active: in which worlds; all by default. The others do not change and report no failure and 0 steps.

        Raises:
          InputError: the simulator was not reset, or there are not as many actions as worlds.
        """
        count = self._count()
        if actions.kind.shape != (count,):
            raise InputError(f"MjxSimulator: {actions.kind.shape} actions for {count} worlds; give one for each")
        active = jnp.ones(count, bool) if active is None else jnp.asarray(active)
        data, self._data = self._data, None
        self._data, self.world, outcomes = self._execute(self._fields, data, self.world, actions, active)
        return outcomes

    def retrieve(
        self,
        T_world_gripper: Float[Array, "worlds 4 4"],
        q7: Float[Array, " worlds"],
        opening: Float[Array, " worlds"],
        active: Bool[Array, " worlds"] | None = None,
    ) -> Outcomes:
        """Take the targets out: approach, close the fingers, retreat, and leave the shelf with them.

        Args:
          T_world_gripper: pose of the gripper where it closes, in every world.
          q7: angle of joint 7 during the approach and the retreat [rad].
          opening: distance between the fingers on the approach [m].
          active: in which worlds; all by default.
        """
        return self.execute(retrievals(T_world_gripper, q7, opening), active)

    def follow(
        self, controls: Float[Array, "steps worlds 9"], start: Float[Array, "worlds 9"] | None = None
    ) -> Outcomes:
        """Step all worlds with these controls, without any verdict: for measurements, and for motions of one's own.

        Args:
          controls: joint angles [rad] and distances of the two fingers from the middle [m] that the position actuators
            are told.
          start: where the robot is put first, at rest; by default it begins where it is.
        """
        self._count()
        data, self._data = self._data, None
        if start is not None:
            data = data.replace(
                qpos=data.qpos.at[:, :ROBOT].set(start), qvel=data.qvel.at[:, :ROBOT].set(jnp.zeros_like(start))
            )
        self._data, self.world, outcomes = self._rollout(self._fields, data, self.world, controls)
        return outcomes

    def bytes_per_world(self) -> int:
        """About how much of the device's memory a world takes [bytes]: its state, and the commands of an action.

        Each is counted as often as it lies in memory when one becomes the next.
        """
        state = self._mjx.make_data(self._blank, impl="warp", naconmax=self.config.contacts, njmax=self.config.rows)
        plan = self.config.simulator.motion
        longest = plan.release_step + plan.open_steps + plan.approach_steps
        # One row of commands for each kind of motion, the chosen one, and the joint angles that they came from.
        commands = 8 * longest * ROBOT * np.dtype(np.float32).itemsize
        return 3 * sum(leaf.nbytes for leaf in jax.tree.leaves(state)) + commands

    def _count(self) -> int:
        """Number of worlds."""
        if self.world is None:
            raise InputError("MjxSimulator: reset it before use")
        return len(self.world.kind)

    @staticmethod
    def _home() -> np.ndarray:
        return np.concatenate([HOME, np.zeros(ROBOT - ARM)])

    @staticmethod
    def _parked() -> list[np.ndarray]:
        return [np.array([*models.parking_place(i), 1.0, 0.0, 0.0, 0.0]) for i in range(BODIES)]

    def _begin_state(self, world: World) -> tuple[BodyFields, Array, Array]:
        """The fields of the model, the configuration and the commands of worlds at rest with the robot at home."""
        count = len(world.kind)
        fields = body_fields(self._blank, world.kind, world.half_size, world.valid)
        upright = jnp.where(world.valid[..., None, None], world.rotation, jnp.eye(3)[None, None])
        quaternion = Rotation.from_matrix(upright.reshape(-1, 3, 3)).as_quat()[:, np.array([3, 0, 1, 2])]
        poses = jnp.concatenate([world.position, quaternion.reshape(count, BODIES, 4)], axis=-1)
        parked = self._empty[ROBOT:].reshape(1, BODIES, 7)
        poses = jnp.where(world.valid[..., None], poses, parked).reshape(count, -1)
        robot = jnp.broadcast_to(self._empty[:ROBOT], (count, ROBOT))
        return fields, jnp.concatenate([robot, poses], axis=1), robot

    def _make_data(self, worlds: int) -> Any:
        capacity = self.config.contacts * worlds
        # Within a plan that is traced, it still has to give numbers.
        with jax.ensure_compile_time_eval():
            one = self._mjx.make_data(self._blank, impl="warp", naconmax=capacity, njmax=self.config.rows)
            # MJX ties it to a device, and with it all results; what was compiled for free arrays would not serve for
            # those.
            one = jax.device_get(one)
        return jax.jit(jax.vmap(lambda _, data: data, in_axes=(0, None)))(jnp.arange(worlds), one)

    def _step(self, fields: BodyFields, data: Any) -> Any:
        model = self._model.replace(**{name: getattr(fields, name) for name in BodyFields.__dataclass_fields__})
        return jax.vmap(self._mjx.step, in_axes=(self._axes, 0))(model, data)

    def _task(self, data: Any, actions: Action, kind: Array) -> tuple[_Task, Array, Array]:
        """What the actions ask of the actuators, where the robot begins, and in which worlds there is anything to do.

        Where the arm does not reach all of a motion, there is not: the robot is told what it was told before.
        """
        plan = self.config.simulator.motion

        def references(action: Action) -> tuple[tuple[motion.Reference, Array], ...]:
            T, q7, opening = action.T_world_gripper, action.q7, action.opening
            return (
                motion.push_reference(T, action.displacement, q7, plan),
                motion.pick_and_place_reference(T, action.T_world_place, q7, opening, plan),
                motion.retrieve_reference(T, q7, opening, plan),
            )

        found = jax.vmap(references)(actions)
        home = (kind == ActionKind.PUSH) | (kind == ActionKind.PICK_AND_PLACE)
        lengths = [reference.fingers.shape[1] for reference, _ in found]
        # One row more than the longest: the robot at home, or the last command of a retrieval, held from then on.
        steps = max(lengths) + 1
        controls = jnp.broadcast_to(data.ctrl, (steps, *data.ctrl.shape))
        start, length, moves = data.qpos[:, :ROBOT], jnp.zeros_like(kind), kind == WAIT
        rest = jnp.asarray(self._home(), jnp.float32)
        for code, (reference, reached) in zip(
            (ActionKind.PUSH, ActionKind.PICK_AND_PLACE, RETRIEVE), found, strict=True
        ):
            this = (kind == code) & reached
            told = jnp.moveaxis(commands(reference), 1, 0)
            after = told[-1] if code == RETRIEVE else jnp.broadcast_to(rest, told[-1].shape)
            padded = jnp.concatenate([told, jnp.broadcast_to(after, (steps - len(told), *after.shape))])
            controls = jnp.where(this[None, :, None], padded, controls)
            finger = jnp.maximum(reference.start[:, ARM:], 0.0)
            start = _where(this, jnp.concatenate([reference.start[:, :ARM], finger, finger], axis=1), start)
            length = jnp.where(this, len(told), length)
            moves |= this
        return _Task(controls, length, home, data.qpos), start, moves

    def _advance(self, fields: BodyFields, task: _Task, data: Any, progress: _Progress, i: Array, row: Array):
        """One time step, the `i`-th, of all worlds that are not done."""
        config = self.config.simulator
        frozen = progress.done
        goes_home = task.home & (i == task.length) & ~frozen
        home = jnp.broadcast_to(self._empty[:ROBOT], (len(frozen), ROBOT))
        qpos = data.qpos.at[:, :ROBOT].set(_where(goes_home, home, data.qpos[:, :ROBOT]))
        qvel = data.qvel.at[:, :ROBOT].set(_where(goes_home, jnp.zeros_like(home), data.qvel[:, :ROBOT]))
        clear = data._impl.replace(overflow=jnp.zeros_like(data._impl.overflow))
        # Warp records its kernels anew whenever an array lies elsewhere. A plain row would be read where it lies among
        # all commands, another place at every step; chosen from two, it is written to where the last one was.
        ctrl = _where(frozen, data.ctrl, row)
        before = data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl, _impl=clear)
        after = self._step(fields, before)

        fine = _finite(after.qpos) & _finite(after.qvel)
        diverged = ~frozen & ~fine
        # Finite everywhere, whatever became of a world: a state that is not would flood the contacts that all share.
        qpos = _where(frozen, before.qpos, _where(diverged, task.before, after.qpos))
        qvel = _where(frozen, before.qvel, _where(diverged, jnp.zeros_like(qvel), after.qvel))
        warm = _where(frozen, before.qacc_warmstart, _where(diverged, jnp.zeros_like(qvel), after.qacc_warmstart))
        data = after.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warm, time=before.time)

        resting = i + 1 - task.length
        limit = config.rest_speed * jnp.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
        speed = jnp.abs(qvel[:, ROBOT:]).reshape(-1, BODIES, 6)
        moving = progress.moving | ((resting >= 1) & jnp.any(speed >= limit[None, None], axis=(1, 2)))
        looks = (resting >= 1) & (resting % config.settle_block == 0)
        rests = looks & ~moving
        late = resting >= config.settle_steps // config.settle_block * config.settle_block
        grasps, releases = (i + 1 == step for step in (config.motion.grasp_step, config.motion.release_step))
        return data, _Progress(
            done=frozen | diverged | rests | late,
            settled=jnp.where(frozen, progress.settled, rests & ~diverged),
            diverged=progress.diverged | diverged,
            moving=moving & ~looks,
            steps=progress.steps + ~frozen,
            overflow=progress.overflow | jnp.where(frozen, 0, _overflow(after._impl.overflow)),
            at_grasp=jnp.where(grasps, qpos, progress.at_grasp),
            at_release=jnp.where(releases, qpos, progress.at_release),
        )

    def _begin(self, data: Any, done: Array, settled: Array) -> _Progress:
        none = jnp.zeros(len(done), bool)
        zero = jnp.zeros(len(done), jnp.int32)
        return _Progress(done, settled, none, none, zero, zero, data.qpos, data.qpos)

    def _simulate(self, fields: BodyFields, data: Any, world: World, actions: Action, active: Array):
        """`execute`, compiled: the state, the world and what came of the actions."""
        chunk = self.config.chunk
        kind = jnp.where(active, actions.kind, ActionKind.NONE)
        task, start, moves = self._task(data, actions, kind)
        idle = data.ctrl
        data = data.replace(
            qpos=data.qpos.at[:, :ROBOT].set(_where(moves, start, data.qpos[:, :ROBOT])),
            qvel=_where(moves, jnp.zeros_like(data.qvel), data.qvel),
            qacc_warmstart=_where(moves, jnp.zeros_like(data.qvel), data.qacc_warmstart),
        )
        last = len(task.controls) - 1

        def one(carry, i):
            row = jax.lax.dynamic_index_in_dim(task.controls, jnp.minimum(i, last), keepdims=False)
            return self._advance(fields, task, carry[0], carry[1], i, row), None

        def some(carry):
            i, state = carry
            return i + chunk, jax.lax.scan(one, state, i + jnp.arange(chunk))[0]

        begun = (jnp.int32(0), (data, self._begin(data, ~moves, ~moves)))
        _, (data, progress) = jax.lax.while_loop(lambda carry: ~jnp.all(carry[1][1].done), some, begun)

        # What moved is stopped. Where all was undone, the robot is again told what it was told before.
        controlled = _where(progress.diverged, idle, task.controls[last])
        resting = data.replace(qvel=_where(moves, jnp.zeros_like(data.qvel), data.qvel))
        touch = self._step(fields, resting)
        in_hand = self._touches(touch._impl, "left") & self._touches(touch._impl, "right")
        data = touch.replace(qpos=resting.qpos, qvel=resting.qvel, ctrl=controlled, time=resting.time)
        data = data.replace(qacc_warmstart=jnp.zeros_like(data.qvel))

        poses = data.qpos[:, ROBOT:].reshape(-1, BODIES, 7)
        fallen = world.valid & ((poses[..., 0] < self.shelf.front) | (poses[..., 2] < self.shelf.board))
        changed = moves[:, None] & world.valid
        world = world.replace(
            position=jnp.where(changed[..., None], poses[..., :3], world.position),
            rotation=jnp.where(changed[..., None, None], _matrices(poses[..., 3:]), world.rotation),
        )
        retrieves = (kind == RETRIEVE) & moves & ~progress.diverged
        held = retrieves & in_hand
        outside = retrieves & (poses[:, TARGET, 0] < self.shelf.front)
        fallen = fallen & ~(held[:, None] & (jnp.arange(BODIES) == TARGET)[None])
        slipped = self._slip(progress, actions.object) >= self.config.simulator.slip
        dropped = (kind == ActionKind.PICK_AND_PLACE) & slipped
        failure = jnp.zeros_like(kind)
        for code, applies in (
            (Failure.FALLEN, retrieves & jnp.any(fallen, axis=1)),
            (Failure.INSIDE, retrieves & ~outside),
            (Failure.MISSED, retrieves & ~held),
            (Failure.DROPPED, dropped),
            (Failure.UNSTABLE, progress.diverged),
            (Failure.UNREACHABLE, (kind != ActionKind.NONE) & ~moves),
        ):
            failure = jnp.where(applies, int(code), failure)
        outcomes = Outcomes(
            failure=failure,
            steps=progress.steps,
            settled=progress.settled,
            fallen=fallen,
            held=held,
            outside=outside,
            retrieved=retrieves & (failure == Failure.NONE),
            overflow=progress.overflow,
        )
        return data, world, outcomes

    def _follow(self, fields: BodyFields, data: Any, world: World, controls: Array):
        """`follow`, compiled."""
        worlds, steps = len(world.kind), len(controls)
        none = jnp.zeros(worlds, bool)
        task = _Task(controls, jnp.full(worlds, steps + 1, jnp.int32), none, data.qpos)

        def one(carry, step):
            return self._advance(fields, task, carry[0], carry[1], *step), None

        state = (data, self._begin(data, none, none))
        (data, progress), _ = jax.lax.scan(one, state, (jnp.arange(steps), controls))
        poses = data.qpos[:, ROBOT:].reshape(-1, BODIES, 7)
        fallen = world.valid & ((poses[..., 0] < self.shelf.front) | (poses[..., 2] < self.shelf.board))
        world = world.replace(
            position=jnp.where(world.valid[..., None], poses[..., :3], world.position),
            rotation=jnp.where(world.valid[..., None, None], _matrices(poses[..., 3:]), world.rotation),
        )
        failure = jnp.where(progress.diverged, int(Failure.UNSTABLE), int(Failure.NONE)).astype(jnp.int32)
        return (
            data,
            world,
            Outcomes(failure, progress.steps, none, fallen, none, none, none, progress.overflow),
        )

    def _touches(self, contacts: Any, side: str) -> Array:
        """In which worlds a finger presses on the target."""
        worlds = contacts.nefc.shape[0]
        owner = jnp.asarray(self._blank.geom_bodyid)
        finger = self._blank.body(f"{side}_finger").id
        target = self._blank.body(f"body{TARGET}").id
        found = jnp.arange(len(contacts.contact__worldid)) < contacts.nacon[0]
        found &= contacts.contact__efc_address[:, 0] >= 0
        a, b = owner[contacts.contact__geom[:, 0]], owner[contacts.contact__geom[:, 1]]
        found &= ((a == finger) & (b == target)) | ((a == target) & (b == finger))
        return jnp.zeros(worlds, bool).at[jnp.where(found, contacts.contact__worldid, worlds)].set(True, mode="drop")

    def _slip(self, progress: _Progress, body: Int[Array, " worlds"]) -> Float[Array, " worlds"]:
        """How far a body has moved in the hand between when it closed and when it was to open [m]."""
        places = []
        for qpos in (progress.at_grasp, progress.at_release):
            T = gripper_pose(qpos[:, :ARM])
            poses = qpos[:, ROBOT:].reshape(-1, BODIES, 7)
            position = jnp.take_along_axis(poses, body[:, None, None], axis=1)[:, 0, :3]
            offset = position - T[:, :3, 3]
            places.append(jnp.sum(T[:, :3, :3] * offset[:, :, None], axis=1))
        return jnp.sqrt(jnp.sum((places[1] - places[0]) ** 2, axis=1))


def commands(reference: motion.Reference) -> Float[Array, "worlds steps 9"]:
    """What the actuators are told at each step; as `simulator.controls`, for references with a leading axis."""
    lead = (np.array(models.ARM_VELOCITY_GAIN) + models.ARM_DAMPING) / np.array(models.ARM_STIFFNESS)
    arm = reference.q + jnp.asarray(lead, jnp.float32)[None, None] * reference.velocity
    fingers = reference.fingers[..., None]
    return jnp.concatenate([arm, fingers, fingers], axis=-1)


def _finite(state: Array) -> Array:
    """In which worlds a state has not diverged."""
    return jnp.all(jnp.abs(state) < LARGEST, axis=1)


def _overflow(flags: Array) -> Array:
    """Warp's flags as flags of `Overflow`; those that only say that a solver stopped early are none."""
    from mujoco.mjx.third_party.mujoco_warp import OverflowType

    groups = {
        Overflow.ROWS: OverflowType.NEFC | OverflowType.NJMAX_NNZ,
        Overflow.CONTACTS: OverflowType.BROADPHASE | OverflowType.NARROWPHASE,
        Overflow.SHAPES: OverflowType.CCD | OverflowType.EPA_HORIZON,
    }
    terms = [jnp.where((flags & int(mask)) != 0, int(flag), 0) for flag, mask in groups.items()]
    return functools.reduce(jnp.bitwise_or, terms).astype(jnp.int32)
