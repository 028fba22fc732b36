"""Tasks of the batch simulator's worlds, their progress at each time step, and the verdicts on them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions import KINDS, Action, ActionKind, Kind
from mechsearch_jax.envs.simulators.mjx_model import overflow_of, where
from mechsearch_jax.envs.simulators.simulator import ARM, LAG, ROBOT, SimulatorConfig, unhindered
from mechsearch_jax.envs.world.outcome import Failure, Outcome
from mechsearch_jax.envs.world.world import BODIES, TARGET, World
from mechsearch_jax.robot.kinematics import gripper_pose
from mechsearch_jax.robot.motion import Reference
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.shelf import Shelf

# A state with larger numbers has diverged; the same bound as in C MuJoCo.
LARGEST = 1e10


class Task(PyTreeNode):
    """The task of every world; fields have a leading axis for the worlds, `controls` one for time before it.

    Attributes:
      controls: of the actuators; the last row is held, shape (steps, W, 9).
      length: time steps of the motion, after which the bodies come to rest.
      closed, opens: the time steps, counted from 1, after which the hand has closed and begins to open.
      home: whether the robot is set to its home configuration after the motion.
      moves: whether there is anything to simulate.
      kind: of the action; NONE if there is none.
      object: index of the action's object.
      before: the configuration before the action, to which a diverged world is restored, shape (W, nq).
      idle: the commands before the action, shape (W, 9).
    """

    controls: jax.Array
    length: jax.Array
    closed: jax.Array
    opens: jax.Array
    home: jax.Array
    moves: jax.Array
    kind: jax.Array
    object: jax.Array
    before: jax.Array
    idle: jax.Array


class Progress(PyTreeNode):
    """Progress of every world; fields have a leading axis for the worlds.

    Attributes:
      done: whether nothing is left to simulate.
      settled, diverged: how it ended.
      moving: which bodies were not at rest in the present block of steps, or in the last one, shape (W, 9).
      steps: simulated so far.
      overflow: flags of `Overflow` so far.
      at_grasp, at_release: configurations when the hand has closed, and when it begins to open, shape (W, nq).
      reference: joint angles if nothing held the arm up [rad], shape (W, 7).
      error: the largest distance of a joint from them so far [rad].
    """

    done: jax.Array
    settled: jax.Array
    diverged: jax.Array
    moving: jax.Array
    steps: jax.Array
    overflow: jax.Array
    at_grasp: jax.Array
    at_release: jax.Array
    reference: jax.Array
    error: jax.Array


def commands(reference: Reference) -> Float[Array, "worlds steps 9"]:
    """Commands of the actuators; as `simulator.controls`, for references with a leading axis.

    Rows after the end of a motion repeat its last one.
    """
    arm = reference.q + jnp.asarray(LAG, jnp.float32)[None, None] * reference.velocity
    fingers = reference.fingers[..., None]
    return jnp.concatenate([arm, fingers, fingers], axis=-1)


def waiting(data: Any, active: Bool[Array, " worlds"]) -> Task:
    """The task of holding still with the present commands."""
    none = jnp.zeros(len(active), jnp.int32)
    return Task(data.ctrl[None], none, none, none, none > 0, active, none, none, data.qpos, data.ctrl)


def acting(
    data: Any, actions: Action, active: Bool[Array, " worlds"], home: Float[Array, " 9"], config: SimulatorConfig
) -> tuple[Task, Float[Array, "worlds 9"]]:
    """The tasks of actions, and the robot's configurations at their start.

    If the arm does not reach all of a motion, nothing moves, and the commands are unchanged.

    Args:
      data: the state before.
      actions: of any kinds; fields with a leading axis for the worlds.
      active: in which worlds they are executed.
      home: the robot's home configuration.
      config: lengths and durations.
    """
    kind = jnp.where(active, actions.kind, ActionKind.NONE)
    motions = []
    for registered in KINDS.values():
        motion = jax.vmap(lambda action, kind=registered: kind.reference(action, config.motion))(actions)
        if motion is not None:
            motions.append((registered, *motion))
    # One row more than the longest: the robot at home, or the last command, held from then on.
    steps = max(reference.fingers.shape[1] for _, reference, _ in motions) + 1
    controls = jnp.broadcast_to(data.ctrl, (steps, *data.ctrl.shape))
    start, length = data.qpos[:, :ROBOT], jnp.zeros_like(kind)
    closed = opens = length
    moves = goes_home = jnp.zeros(len(kind), bool)
    for registered, reference, reached in motions:
        applies = (kind == int(registered.code)) & reached
        rows = jnp.moveaxis(commands(reference), 1, 0)
        after = jnp.broadcast_to(home, rows[-1].shape) if registered.returns_home else rows[-1]
        over = jnp.arange(len(rows))[:, None] >= reference.length[None]
        rows = jnp.where(over[..., None], after[None], rows)
        padded = jnp.concatenate([rows, jnp.broadcast_to(after, (steps - len(rows), *after.shape))])
        controls = jnp.where(applies[None, :, None], padded, controls)
        finger = jnp.maximum(reference.start[:, ARM:], 0.0)
        start = where(applies, jnp.concatenate([reference.start[:, :ARM], finger, finger], axis=1), start)
        length = jnp.where(applies, reference.length, length)
        closed = jnp.where(applies, reference.closed, closed)
        opens = jnp.where(applies, reference.opens, opens)
        goes_home |= applies & registered.returns_home
        moves |= applies
    return Task(controls, length, closed, opens, goes_home, moves, kind, actions.object, data.qpos, data.ctrl), start


def merged(
    keep: Bool[Array, " worlds"], old: tuple[Task, Progress], new: tuple[Task, Progress]
) -> tuple[Task, Progress]:
    """Tasks and progress: the old ones in the worlds `keep`, the new ones elsewhere."""
    controls = jnp.where(keep[None, :, None], old[0].controls, new[0].controls)
    task, progress = jax.tree.map(
        lambda a, b: where(keep, a, b), (old[0].replace(controls=keep), old[1]), (new[0].replace(controls=keep), new[1])
    )
    return task.replace(controls=controls), progress


def begin(task: Task, data: Any) -> Progress:
    """Progress before the first step; worlds without a task are done."""
    none, still = jnp.zeros(len(task.moves), bool), jnp.zeros((len(task.moves), BODIES), bool)
    zero = jnp.zeros(len(task.moves), jnp.int32)
    q = data.qpos[:, :ARM]
    return Progress(~task.moves, ~task.moves, none, still, zero, zero, data.qpos, data.qpos, q, jnp.zeros_like(q[:, 0]))


def advance(
    config: SimulatorConfig,
    step: Callable[[Any], Any],
    home: Float[Array, " 9"],
    task: Task,
    state: tuple[Any, Progress],
) -> tuple[Any, Progress]:
    """One time step of all worlds that are not done, each the next of its task.

    Args:
      config: when a world counts as at rest.
      step: steps all worlds.
      home: the robot's home configuration.
      task: of the worlds.
      state: the simulation's state, and the progress.
    """
    data, progress = state
    frozen, i = progress.done, progress.steps
    row = task.controls[jnp.minimum(i, len(task.controls) - 1), jnp.arange(len(i))]
    goes_home = task.home & (i == task.length) & ~frozen
    robot = jnp.broadcast_to(home, (len(frozen), ROBOT))
    qpos = data.qpos.at[:, :ROBOT].set(where(goes_home, robot, data.qpos[:, :ROBOT]))
    qvel = data.qvel.at[:, :ROBOT].set(where(goes_home, jnp.zeros_like(robot), data.qvel[:, :ROBOT]))
    clear = data._impl.replace(overflow=jnp.zeros_like(data._impl.overflow))
    # Warp records its kernels anew whenever an array's address changes. A plain row would be a view into all commands,
    # with another address at every step; selected from two arrays, it is written to a constant one.
    ctrl = where(frozen, data.ctrl, row)
    before = data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl, _impl=clear)
    after = step(before)

    fine = _finite(after.qpos) & _finite(after.qvel)
    diverged = ~frozen & ~fine
    # Diverged worlds are restored at once: a state that is not finite would flood the contact buffer that all share.
    qpos = where(frozen, before.qpos, where(diverged, task.before, after.qpos))
    qvel = where(frozen, before.qvel, where(diverged, jnp.zeros_like(qvel), after.qvel))
    warm = where(frozen, before.qacc_warmstart, where(diverged, jnp.zeros_like(qvel), after.qacc_warmstart))
    data = after.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warm, time=before.time)

    resting = i + 1 - task.length
    limit = config.rest_speed * jnp.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
    speed = jnp.abs(qvel[:, ROBOT:]).reshape(-1, BODIES, 6)
    moving = progress.moving | ((resting >= 1)[:, None] & jnp.any(speed >= limit[None, None], axis=2))
    looks = (resting >= 1) & (resting % config.settle_block == 0)
    rests = looks & ~jnp.any(moving, axis=1)
    late = resting >= config.settle_steps // config.settle_block * config.settle_block
    reference = unhindered(progress.reference, row[:, :ARM], config.motion.timestep)
    off = jnp.max(jnp.abs(qpos[:, :ARM] - reference), axis=1)
    follows = ~frozen & ~diverged & (i < task.length)
    return data, Progress(
        done=frozen | diverged | rests | late,
        settled=jnp.where(frozen, progress.settled, rests & ~diverged),
        diverged=progress.diverged | diverged,
        moving=where(frozen, progress.moving, moving & ~(looks & ~late)[:, None]),
        steps=progress.steps + ~frozen,
        overflow=progress.overflow | jnp.where(frozen, 0, overflow_of(after._impl.overflow)),
        at_grasp=where(i + 1 == task.closed, qpos, progress.at_grasp),
        at_release=where(i + 1 == task.opens, qpos, progress.at_release),
        reference=reference,
        error=jnp.where(follows, jnp.maximum(progress.error, off), progress.error),
    )


def off_board(shelf: Shelf, valid: Bool[Array, "worlds 9"], qpos: Float[Array, "worlds nq"]) -> Bool[Array, "worlds 9"]:
    """Which bodies are off the board in configurations."""
    position = qpos[:, ROBOT:].reshape(-1, BODIES, 7)[..., :3]
    return valid & ((position[..., 0] < shelf.front) | (position[..., 2] < shelf.board))


def taken_over(shelf: Shelf, world: World, qpos: Array, moves: Bool[Array, " worlds"]) -> tuple[World, Array]:
    """The worlds with the bodies' poses from configurations, and which bodies have fallen off the board."""
    poses = qpos[:, ROBOT:].reshape(-1, BODIES, 7)
    fallen = off_board(shelf, world.valid, qpos)
    changed = moves[:, None] & world.valid
    quaternion = poses[..., np.array([4, 5, 6, 3])].reshape(-1, 4)
    rotation = Rotation.from_quat(quaternion).as_matrix().reshape(world.rotation.shape)
    world = world.replace(
        position=jnp.where(changed[..., None], poses[..., :3], world.position),
        rotation=jnp.where(changed[..., None, None], rotation, world.rotation),
    )
    return world, fallen


def verdicts(
    shelf: Shelf,
    config: SimulatorConfig,
    task: Task,
    progress: Progress,
    world: World,
    qpos: Array,
    in_hand: Bool[Array, " worlds"],
) -> tuple[World, Outcome]:
    """The worlds after a task, and its outcomes.

    Args:
      shelf: off which bodies fall.
      config: bounds of a held object's slip and of the tracking error.
      task, progress: of the worlds.
      world: before the task.
      qpos: the configuration afterwards.
      in_hand: whether both fingers press on the target.
    """
    kind = task.kind
    world, fallen = taken_over(shelf, world, qpos, task.moves)
    retrieves = (
        _is_one_of(kind, [kind for kind in KINDS.values() if kind.takes_target]) & task.moves & ~progress.diverged
    )
    held = retrieves & in_hand
    outside = retrieves & (qpos[:, ROBOT:].reshape(-1, BODIES, 7)[:, TARGET, 0] < shelf.front)
    fallen = fallen & ~(held[:, None] & (jnp.arange(BODIES) == TARGET)[None])
    off_before = off_board(shelf, world.valid, task.before)
    error = jnp.where(progress.diverged, 0.0, progress.error)
    holds = _is_one_of(kind, [kind for kind in KINDS.values() if kind.holds_object])
    dropped = holds & (_slip(progress, task.object) >= config.slip)
    failure = jnp.zeros_like(kind)
    for code, applies in (
        (Failure.FALLEN, retrieves & jnp.any(fallen & ~off_before, axis=1)),
        (Failure.INSIDE, retrieves & ~outside),
        (Failure.MISSED, retrieves & ~held),
        (Failure.DROPPED, dropped),
        (Failure.HELD_UP, error > config.tracking_bound),
        (Failure.UNSTABLE, progress.diverged),
        (Failure.UNREACHABLE, (kind != ActionKind.NONE) & ~task.moves),
        (Failure.UNKNOWN, ~_is_one_of(kind, list(KINDS.values()))),
    ):
        failure = jnp.where(applies, int(code), failure)
    return world, Outcome(
        failure=failure,
        steps=progress.steps,
        settled=progress.settled,
        restless=progress.moving & ~progress.settled[:, None] & ~progress.diverged[:, None],
        fallen=fallen,
        held=held,
        outside=outside,
        retrieved=retrieves & (failure == Failure.NONE),
        overflow=progress.overflow,
        tracking_error=error,
    )


def _is_one_of(kind: Int[Array, " worlds"], kinds: Sequence[Kind]) -> Bool[Array, " worlds"]:
    """In which worlds the action is of one of the given kinds."""
    codes = jnp.array([int(registered.code) for registered in kinds], jnp.int32)
    return jnp.any(kind[:, None] == codes[None], axis=1)


def _slip(progress: Progress, body: Int[Array, " worlds"]) -> Float[Array, " worlds"]:
    """Displacement of a body in the hand between its closing and its opening [m]."""
    places = []
    for qpos in (progress.at_grasp, progress.at_release):
        T = gripper_pose(qpos[:, :ARM])
        poses = qpos[:, ROBOT:].reshape(-1, BODIES, 7)
        position = jnp.take_along_axis(poses, body[:, None, None], axis=1)[:, 0, :3]
        offset = position - T[:, :3, 3]
        places.append(jnp.sum(T[:, :3, :3] * offset[:, :, None], axis=1))
    return jnp.sqrt(jnp.sum((places[1] - places[0]) ** 2, axis=1))


def _finite(state: Array) -> Array:
    """In which worlds a state is finite: it has not diverged."""
    return jnp.all(jnp.abs(state) < LARGEST, axis=1)


def placed(
    changed: Bool[Array, " worlds"], data: Any, qpos: Array, ctrl: Array, new: tuple[Any, World], old: tuple[Any, World]
) -> tuple[Any, tuple[Any, World]]:
    """`load`, compiled: the state, and fields and worlds, with the changed worlds at rest."""
    data = at_rest(data, changed).replace(qpos=where(changed, qpos, data.qpos), ctrl=where(changed, ctrl, data.ctrl))
    return data, jax.tree.map(functools.partial(where, changed), new, old)


def at_rest(data: Any, which: Bool[Array, " worlds"]) -> Any:
    """The state with all motion stopped in the worlds `which`."""
    still = jnp.zeros_like(data.qvel)
    return data.replace(qvel=where(which, still, data.qvel), qacc_warmstart=where(which, still, data.qacc_warmstart))


def tasks_merged(keep: Bool[Array, " worlds"], old: tuple[Task, Progress, Array], new: tuple[Task, Progress, Array]):
    """Tasks, progress and reported worlds: the old ones in the worlds `keep`, the new ones elsewhere."""
    task, progress = merged(keep, old[:2], new[:2])
    return task, progress, jnp.where(keep, old[2], new[2])
