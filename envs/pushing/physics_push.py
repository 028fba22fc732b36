"""Push models that simulate: `NativePhysics` on the CPU and `MjxPhysics` on a GPU, both `push_model.PushModel`.

The recognised objects become bodies of the nearest shapes, with the densities and frictions of the environment's own
bodies, and the arm makes the push as `push_simulation` has it. Objects that are not at rest where they were recognised,
because their shapes overlap a little or float, come to rest first. What the push has moved is then moved by as much
from where it was recognised, and everything else stays exactly where it was. The environment's own simulator is not
involved.

Two approximations: a superquadric whose exponent e2 is above `ROUND_EXPONENT` is a body of a round shape, of the same
cross-section, and any other one of a shape that is not round; and what is not recognised is not there.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial.transform import Rotation

from mechsearch_jax.actions import Action, ActionKind, no_action
from mechsearch_jax.dynamics.push_model import PushOutcome
from mechsearch_jax.envs.pushing.pushes import push_simulation, toppled
from mechsearch_jax.envs.simulators.mjx_simulator import MjxConfig, MjxSimulator
from mechsearch_jax.envs.simulators.simulator import ARM, ROBOT, SimulatorConfig, controls
from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.outcome import Overflow
from mechsearch_jax.envs.world.world import BODIES, World, bodies_of
from mechsearch_jax.geometry.footprints import ROUND_EXPONENT
from mechsearch_jax.geometry.superquadric import Superquadrics, pad
from mechsearch_jax.geometry.transforms import matmul, rotate
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.robot.motion import Reference, push_reference
from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import by_shape, in_order
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf, on_host

# An object that has moved by less than this [m], and turned by less than this [rad], was not pushed.
STILL, STILL_TURN = 1e-3, 0.02
# Where any object moves or turns by more than this of its own accord, all come to rest first [m, rad].
LOOSE, LOOSE_TURN = 5e-4, 0.01
# No body is thinner [m]: contact geometry is smaller than the body by `model.MARGIN`.
THINNEST = 2e-3

# What of a shelf a simulation is about, and how far it may be off [m].
WALLS = ("front", "back", "right", "left", "board", "ceiling", "thickness")
SAME = 1e-6

_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS


class Poses(flax.struct.PyTreeNode):
    """Where bodies are, with any leading axes; on the host arrays of NumPy.

    Attributes:
      position: [m], shape (..., 9, 3).
      rotation: `R_world_body`, shape (..., 9, 3, 3).
    """

    position: Any
    rotation: Any


class Simulated(flax.struct.PyTreeNode):
    """What became of a push, with any leading axes; on the host arrays of NumPy.

    Attributes:
      before: where the bodies were when it began.
      after: the bodies after it.
      failed: whether the simulation diverged; the poses then mean nothing.
    """

    before: Poses
    after: Poses
    failed: Any


def _poses(world: World) -> Poses:
    return Poses(world.position, world.rotation)


def _nearest_kind(exponents: Float[Array, "n 2"]) -> Int[Array, " n"]:
    """Codes of the shapes of superquadrics: as round, or as little, as they are, and of those the nearest in e1."""
    is_round = exponents[:, 1] > ROUND_EXPONENT
    apart = [
        jnp.where(is_round == shape.round, jnp.abs(exponents[:, 0] - shape.exponents[0]), jnp.inf)
        for shape in in_order()
    ]
    return jnp.argmin(jnp.stack(apart), axis=0).astype(jnp.int32)


def bodies(scene: Superquadrics) -> World:
    """The bodies that come nearest to superquadrics, in the slots of a `World`.

    Args:
      scene: fields (N, ...), N at most 9.

    Raises:
      InputError: there are more slots for superquadrics than for bodies.
    """
    if scene.capacity > BODIES:
        raise InputError(f"the simulator has slots for {BODIES} bodies, not for {scene.capacity} superquadrics")
    scene = pad(scene, BODIES)
    size = jnp.maximum(scene.size, THINNEST)
    kind = _nearest_kind(scene.exponents)
    return World(
        kind=kind,
        half_size=by_shape(kind[:, None], lambda shape: shape.nearest(size, jnp), jnp),
        position=scene.position,
        rotation=scene.rotation,
        valid=scene.valid,
    )


def _differ(a: Poses, b: Poses, distance: float, angle: float) -> Any:
    """Which bodies are farther apart in two arrangements than a distance [m], or turned by more than an angle [rad]."""
    shift = ((a.position - b.position) ** 2).sum(axis=-1)
    # The trace of the rotation between them.
    trace = (a.rotation * b.rotation).sum(axis=(-1, -2))
    return (shift > distance**2) | (trace < 1.0 + 2.0 * math.cos(angle))


def _outcome(shelf: Shelf, scene: Superquadrics, world: World, simulated: Simulated, failed: Array) -> PushOutcome:
    """A `PushOutcome` from what was simulated."""
    n = scene.capacity
    before, after = simulated.before, simulated.after
    turn = matmul(after.rotation, jnp.swapaxes(before.rotation, -1, -2))
    moved = (world.valid & _differ(before, after, STILL, STILL_TURN) & ~failed)[:n]
    position = rotate(turn, world.position - before.position) + after.position
    rotation = matmul(turn, world.rotation)
    fell = (after.position[:, 0] < shelf.front) | (after.position[:, 2] < shelf.board)
    over = toppled(*(world.replace(position=p.position, rotation=p.rotation) for p in (before, after))) | fell
    return PushOutcome(
        scene=scene.replace(
            position=jnp.where(moved[:, None], position[:n], scene.position),
            rotation=jnp.where(moved[:, None, None], rotation[:n], scene.rotation),
        ),
        moved=moved,
        residual=jnp.where(failed, jnp.inf, 0.0),
        resolved=~failed,
        topples=jnp.where(moved & over[:n], 1.0, 0.0),
    )


@dataclasses.dataclass(frozen=True)
class NativePhysics:
    """The `PushModel` that runs pushes in C MuJoCo, all that are mapped over at once, on several threads.

    `jax.pure_callback` takes them to the host; one call of a plan is one call there. A plan calls for the first draw
    of all sequences, and once more for each further one, of those that have no possible action yet: at most as often
    as a first action is drawn (`PlannerConfig.first_draws`, or `draws` where that is more). The same pushes always give
    the same results. One that diverges, that the arm cannot follow, or whose scene is no scene, has an infinite
    residual.

    Attributes:
      simulation: how it is simulated.
      threads: how many; one for each of `runtime.cores.cores` if left out.
    """

    simulation: SimulatorConfig = dataclasses.field(default_factory=push_simulation)
    threads: int | None = None

    def __call__(
        self, shelf: Shelf, scene: Superquadrics, pusher: Array, T_world_gripper: Array, displacement: Array, q7: Array
    ) -> PushOutcome:
        """See `push_model.PushModel`."""
        world = bodies(scene)
        reference, reachable = push_reference(T_world_gripper, displacement, q7, self.simulation.motion)
        pushes = jnp.any(displacement != 0.0)
        poses = Poses(jax.ShapeDtypeStruct((BODIES, 3), jnp.float32), jax.ShapeDtypeStruct((BODIES, 3, 3), jnp.float32))
        simulated = jax.pure_callback(
            functools.partial(_simulate, self.simulation, self.threads or cores()),
            Simulated(poses, poses, jax.ShapeDtypeStruct((), jnp.bool_)),
            shelf,
            world,
            reference,
            pushes & reachable,
            vmap_method="broadcast_all",
        )
        return _outcome(shelf, scene, world, simulated, simulated.failed | (pushes & ~reachable))


@dataclasses.dataclass(frozen=True)
class MjxPhysics:
    """The `PushModel` that runs pushes in `MjxSimulator`, all that are mapped over at once, in the same computation.

    One that diverges, that the arm cannot follow, or that had too little room for its contacts, has an infinite
    residual. On a CPU the same pushes always give the same results, on a GPU they do not.

    Attributes:
      shelf: where it simulates; a model is made of its numbers. In any other shelf every push has an infinite residual.
      config: of the simulator.
    """

    shelf: Shelf = dataclasses.field(default_factory=Shelf)
    config: MjxConfig = dataclasses.field(default_factory=lambda: MjxConfig(simulator=push_simulation()))

    def __call__(
        self, shelf: Shelf, scene: Superquadrics, pusher: Array, T_world_gripper: Array, displacement: Array, q7: Array
    ) -> PushOutcome:
        """See `push_model.PushModel`."""
        world = bodies(scene)
        pushes = jnp.any(displacement != 0.0)
        # Warp's worlds share what numbers they cannot make sense of, so that a scene that has any is not pushed in.
        sound = _finite(world, T_world_gripper, displacement, q7)
        action = no_action().replace(
            kind=jnp.where(pushes & sound, ActionKind.PUSH, ActionKind.NONE).astype(jnp.int32),
            T_world_gripper=jnp.where(sound, T_world_gripper, jnp.eye(4)),
            displacement=jnp.where(sound, displacement, 0.0),
            q7=jnp.where(sound, q7, 0.0),
        )
        world = jax.tree.map(lambda a, b: jnp.where(sound, a, b), world, jax.tree.map(jnp.zeros_like, world))
        one = jax.tree.map(lambda a: a[None], (world, action))
        simulated = jax.tree.map(lambda a: a[0], _batched(self.shelf, self.config)(*one))
        other = jnp.any(jnp.stack([jnp.abs(getattr(shelf, name) - getattr(self.shelf, name)) > SAME for name in WALLS]))
        return _outcome(shelf, scene, world, simulated, pushes & (simulated.failed | ~sound | other))


def _finite(world: World, *others: Array) -> Bool[Array, ""]:
    """Whether all numbers are finite, of bodies that are there."""
    leaves = (world.half_size, world.position, world.rotation)
    fine = [jnp.isfinite(a).reshape(BODIES, -1).all(axis=1) | ~world.valid for a in leaves]
    return jnp.all(jnp.stack(fine)) & jnp.all(jnp.stack([jnp.isfinite(a).all() for a in others]))


@functools.cache
def _batched(shelf: Shelf, config: MjxConfig) -> Callable[[World, Action], Simulated]:
    """Simulates worlds with a leading axis; mapped over, it simulates as many more at once."""
    # Called while a plan is traced, it still has to give numbers.
    with jax.ensure_compile_time_eval():
        simulator = MjxSimulator(shelf, config=config)

    @jax.custom_batching.custom_vmap
    def simulate(world: World, action: Action) -> Simulated:
        rested, waited = simulator.simulate(world, None)
        loose = _differ(_poses(world), _poses(rested), LOOSE, LOOSE_TURN).any(axis=-1)
        world = jax.tree.map(lambda a, b: jnp.where(loose.reshape(-1, *[1] * (a.ndim - 1)), a, b), rested, world)
        after, pushed = simulator.simulate(world, action)
        failed = ~(waited.took_place & pushed.took_place)
        failed |= (waited.overflow | pushed.overflow) != Overflow.NONE
        return Simulated(_poses(world), _poses(after), failed)

    @simulate.def_vmap
    def _(size: int, batched: Sequence[Any], world: World, action: Action) -> tuple[Simulated, Simulated]:
        full = jax.tree.map(
            lambda a, has: a if has else jnp.broadcast_to(a, (size, *a.shape)), (world, action), tuple(batched)
        )
        merged = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), full)
        simulated = jax.tree.map(lambda a: a.reshape(size, -1, *a.shape[1:]), simulate(*merged))
        return simulated, jax.tree.map(lambda _: True, simulated)

    return simulate


@functools.cache
def _blank(shelf: Shelf, timestep: float) -> mujoco.MjModel:
    return models.compile_model(shelf, Camera(), timestep)


def _simulate(
    config: SimulatorConfig, threads: int, shelf: Shelf, world: World, reference: Reference, active: Any
) -> Simulated:
    """Simulate pushes on the host; any leading axes. It must not compute with JAX, which is waiting for it."""
    shelf, world, reference, active = jax.tree.map(np.asarray, (shelf, world, reference, active))
    lead = active.shape
    shelf, world, reference = jax.tree.map(lambda a: a.reshape(-1, *a.shape[len(lead) :]), (shelf, world, reference))
    blank = _blank(on_host(shelf, 0), config.motion.timestep)
    flat = _Rollouts(blank, config, threads).push(shelf, world, reference, active.reshape(-1))
    return jax.tree.map(lambda a: a.reshape((*lead, *a.shape[1:])), flat)


@dataclasses.dataclass(frozen=True)
class _Rollouts:
    """Steps many worlds at a time, each with a model of its own.

    Attributes:
      blank: a model with empty slots; all shelves' are of the same size.
      config: of the simulation.
      threads: how many worlds are stepped at the same time.
    """

    blank: mujoco.MjModel
    config: SimulatorConfig
    threads: int

    def push(self, shelf: Shelf, world: World, reference: Reference, active: Bool[np.ndarray, " n"]) -> Simulated:
        """What becomes of pushes; see `_simulate`, with a single leading axis n."""
        count = len(active)
        start = Poses(world.position.copy(), world.rotation.copy())
        failed = ~sound(world, reference) & active
        simulated = Simulated(start, jax.tree.map(np.copy, start), failed)
        # The sequences of a plan begin in the same scene, which is built once, and comes to rest once.
        of_scene: dict[bytes, int] = {}
        scene = np.full(count, -1)
        built: list[mujoco.MjModel] = []
        first: list[np.ndarray] = []
        for row in np.flatnonzero(active & ~failed):
            one: World = jax.tree.map(lambda a, row=row: a[row], world)
            name = b"".join(leaf[row].tobytes() for leaf in jax.tree.leaves((shelf, world)))
            if name not in of_scene:
                of_scene[name] = len(built)
                slots = bodies_of(one)
                model = models.with_bodies(_blank(on_host(shelf, int(row)), self.config.motion.timestep), slots)
                built.append(model)
                first.append(_state_of(model, models.initial_state(model, slots)))
            scene[row] = of_scene[name]
        if not built:
            return simulated
        rows = np.flatnonzero(scene >= 0)
        scene = scene[rows]

        with mujoco.rollout.Rollout(nthread=self.threads) as pool:
            home = np.tile(np.concatenate([HOME, np.zeros(ROBOT - ARM)]), (len(built), 1))
            begin = np.stack(first)
            rest, lost = self._come_to_rest(pool, built, begin, home)
            rested, given = self._poses(rest), self._poses(begin)
            loose = _differ(given, rested, LOOSE, LOOSE_TURN).any(axis=-1)
            rest = np.where(loose[:, None], rest, begin)
            each = [built[i] for i in scene]
            states = rest[scene]
            robot = np.asarray(reference.start, float)[rows][:, [*range(ARM + 1), ARM]]
            robot[:, ARM:] = np.maximum(robot[:, ARM:], 0.0)
            _set_robot(states, robot, self.blank.nq)
            told_arm = [controls(jax.tree.map(lambda a, row=row: a[row], reference)) for row in rows]
            states, broke = self._step(pool, each, states, told_arm)
            _set_robot(states, home[scene], self.blank.nq)
            states, unsound = self._come_to_rest(pool, each, states, home[scene])

        for kept, found in ((simulated.before, rest[scene]), (simulated.after, states)):
            now = self._poses(found)
            kept.position[rows], kept.rotation[rows] = now.position, now.rotation
        failed[rows] |= lost[scene] | broke | unsound
        return simulated

    def _poses(self, states: Float[np.ndarray, "n size"]) -> Poses:
        """Where the bodies are; anywhere in a state that is none."""
        place = states[:, 1 + ROBOT : 1 + self.blank.nq].reshape(-1, 7)
        place = np.where(np.isfinite(place).all(axis=1, keepdims=True), place, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        rotation = Rotation.from_quat(place[:, [4, 5, 6, 3]]).as_matrix()
        return Poses(place[:, :3].reshape(-1, BODIES, 3), rotation.reshape(-1, BODIES, 3, 3))

    def _step(
        self,
        pool: mujoco.rollout.Rollout,
        each: Sequence[mujoco.MjModel],
        states: Float[np.ndarray, "n size"],
        simulated: Sequence[Float[np.ndarray, "_ 9"]],
    ) -> tuple[np.ndarray, np.ndarray]:
        """The states after as many steps as each has rows, and where MuJoCo gave up before."""
        lengths = np.array([len(rows) for rows in simulated])
        # All are stepped as long as the longest, holding still.
        padded = np.stack([np.pad(rows, ((0, lengths.max() - len(rows)), (0, 0)), mode="edge") for rows in simulated])
        trajectory = self._trajectory(pool, each, states, padded)
        return self._after(trajectory, lengths).copy(), self._stopped(states, trajectory, lengths)

    def _after(self, trajectory: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """The states after so many steps of each."""
        return trajectory[np.arange(len(trajectory)), lengths - 1]

    def _trajectory(self, pool, each, states, simulated) -> np.ndarray:
        data = [mujoco.MjData(self.blank) for _ in range(self.threads)]
        trajectory, _ = pool.rollout(list(each), data, states, simulated)
        return trajectory

    def _stopped(self, states: np.ndarray, trajectory: np.ndarray, lengths: np.ndarray) -> Bool[np.ndarray, " n"]:
        # After any warning of MuJoCo a rollout stands still, and so does its clock.
        late = states[:, 0] + (lengths - 0.5) * self.config.motion.timestep
        after = self._after(trajectory, lengths)
        return ~(np.isfinite(after).all(axis=1) & (after[:, 0] > late))

    def _come_to_rest(
        self,
        pool: mujoco.rollout.Rollout,
        each: Sequence[mujoco.MjModel],
        states: Float[np.ndarray, "n size"],
        robot: Float[np.ndarray, "n 9"],
    ) -> tuple[np.ndarray, np.ndarray]:
        """The states once nothing moves or the time for that is over, with all motion stopped, and which diverged."""
        config, nq = self.config, self.blank.nq
        states, broke = states.copy(), np.zeros(len(states), bool)
        limit = config.rest_speed * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
        moving = np.arange(len(states))
        for _ in range(config.settle_steps // config.settle_block):
            simulated = np.repeat(robot[moving, None], config.settle_block, axis=1)
            trajectory = self._trajectory(pool, [each[i] for i in moving.tolist()], states[moving], simulated)
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
    """Where there is a scene and a motion: numbers that are finite, and rotations that are none of mirrors.

    Args:
      world, reference: fields with one leading axis, as NumPy arrays.
    """
    here = np.asarray(world.valid)
    numbers = [np.asarray(a).reshape(len(here), -1) for a in (reference.q, reference.velocity)]
    for leaf in (world.half_size, world.position, world.rotation):
        each = np.asarray(leaf).reshape(*here.shape, -1)
        numbers.append(np.where(here[..., None], each, 0.0).reshape(len(here), -1))
    fine = np.asarray(np.isfinite(np.concatenate(numbers, axis=1)).all(axis=1))
    known = np.where((here & fine[:, None])[..., None, None], world.rotation, np.eye(3, dtype=np.float32))
    return fine & np.asarray((np.linalg.det(known) > 0.5).all(axis=1))


def _state_of(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    state = np.empty(mujoco.mj_stateSize(model, _PHYSICS))
    mujoco.mj_getState(model, data, state, _PHYSICS)
    return state


def _set_robot(states: np.ndarray, robot: np.ndarray, nq: int) -> None:
    """Put the robot somewhere, at rest. A state begins with time, positions and velocities."""
    states[:, 1 : 1 + ROBOT] = robot
    states[:, 1 + nq : 1 + nq + ROBOT] = 0.0
