"""Why an action was not carried out: from its recorded motion, and of a trial by simulating it once more.

A recording holds what the trial of an action came to, but not why. A trial in the recorded scene takes 50 ms.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mechsearch_jax.actions import Action, kind_of
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.envs.page.contacts import ARM, BESIDE, HAND, WALLS, Party, Touch, chain, knocked, pressed, touches
from mechsearch_jax.envs.page.facts import action_words, executed_words, moves, plain
from mechsearch_jax.envs.recording.recording import TRACE_EVERY, Recording
from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
from mechsearch_jax.envs.simulators.trace import Trace
from mechsearch_jax.envs.trials.native import Cell, scene_at_rest, trial_world
from mechsearch_jax.envs.world.outcome import Failure
from mechsearch_jax.envs.world.world import TARGET, bodies_of
from mechsearch_jax.planner.trials import TrialResult
from mechsearch_jax.robot.gripper import Gripper

_SIMULATION = SimulatorConfig(trace_every=TRACE_EVERY)


class Stop(NamedTuple):
    """Why an action was not carried out.

    Attributes:
      reason: in a few words.
      path: of an arm that was held up what it touched, up to a wall if it pressed something against one; may be empty.
    """

    reason: str
    path: tuple[Party, ...] = ()

    @property
    def words(self) -> str:
        """The reason, and what touched what."""
        return f"{self.reason}: {pressed(self.path)}" if self.path else self.reason


@functools.lru_cache(maxsize=512)
def trial_stop(recording: Recording, i: int, k: int) -> Stop | None:
    """Why the k-th trial of a step failed, by simulating it once more; None if it did not, or does not again.

    None also for scenes of several parts, and for trials that learned how the cell differs from what is assumed.
    """
    step = recording.steps[i]
    if step.evidence is None or TrialResult(int(step.evidence.tried.result[k])) is not TrialResult.FAILED:
        return None
    options = {} if recording.episode is None else recording.episode.config
    if options.get("rehearsal") != "physics" or step.scene.parts is not None or recording.target.is_compound:
        return None
    action: Action = jax.tree.map(lambda a: np.asarray(a[k]), step.evidence.tried.action)
    pose = step.evidence.believed_pose
    known = bool(np.isfinite(pose).all())
    objects = jax.tree.map(jnp.asarray, step.scene)
    at = jnp.asarray(pose if known else np.zeros(3), jnp.float32)
    world = jax.device_get(trial_world(recording.target, recording.shelf, objects, at, jnp.array(known)))
    cell = Cell(recording.target, recording.shelf, Gripper())
    scene = scene_at_rest(cell, _SIMULATION, world, step.scene, 1.0, 1.0)
    if scene is None or scene.diverged:
        return None
    try:
        failure = Failure(int(scene.execute(action).failure))
    except mujoco.FatalError:
        return None
    if failure in (Failure.NONE, Failure.UNSTABLE, Failure.UNKNOWN):
        return None
    path = _held_up_by(recording, bodies_of(world), scene.trace, action) if failure is Failure.HELD_UP else ()
    return Stop(_in_words(failure, action), path)


@functools.lru_cache(maxsize=64)
def run_stop(recording: Recording, i: int) -> Stop | None:
    """Why the action of a step was not carried out in the run; None if it was, or if that is not recorded."""
    step, record = recording.steps[i], None if recording.episode is None else recording.episode.steps[i]
    if record is None or step.action is None or not record.failure:
        return None
    made = record.held_up and _as_decided(recording, i)
    path = _held_up_by(recording, bodies_of(step.world), step.trace, step.action) if made else ()
    return Stop(plain(record.failure), path)


def _as_decided(recording: Recording, i: int) -> bool:
    """Whether a step executed what it decided on, with the robot where it is assumed to be."""
    options = {} if recording.episode is None else recording.episode.config
    mismatch = any(name.startswith("mismatch.") for name in options)
    return not mismatch and executed_words(recording, i) == action_words(recording.steps[i])


@functools.lru_cache(maxsize=64)
def touched(recording: Recording, i: int) -> tuple[frozenset[Touch], ...]:
    """What touched what at each row of the trace of a step."""
    step = recording.steps[i]
    return tuple(touches(recording.shelf, bodies_of(step.world), step.trace))


@functools.lru_cache(maxsize=64)
def knocks(recording: Recording, i: int, victim: int) -> tuple[Party, ...]:
    """By what the action of a step moved a body; see `contacts.knocked`. Empty if the robot stood elsewhere."""
    step = recording.steps[i]

    @functools.cache
    def near() -> list[frozenset[Touch]]:
        return touches(recording.shelf, bodies_of(step.world), step.trace, BESIDE)

    if not len(step.trace.time) or not _as_decided(recording, i):
        return ()
    return knocked(touched(recording, i), near, step.trace, victim)


def _in_words(failure: Failure, action: Action) -> str:
    words = plain(failure.text or "")
    if kind_of(int(action.kind)).takes_target:
        return plain(f"retrieval: {failure.text}")
    return words.replace("the object", f"object {int(action.object)}") if moves(action) else words


def _held_up_by(recording: Recording, bodies: Sequence, trace: Trace, action: Action) -> tuple[Party, ...]:
    """What an arm touched at the moment at which it was held up: a chain to a wall, else the object it ran into."""
    motion = jax.device_get(reference_motion(kind_of(int(action.kind)), action, _SIMULATION.motion))
    if motion is None or not len(trace.time):
        return ()
    reference = np.asarray(motion[0].q)[: int(motion[0].length)]
    # The first row is of the first time step.
    at = np.rint(np.asarray(trace.time) / _SIMULATION.motion.timestep).astype(int) - 1
    rows = np.flatnonzero(at < len(reference))
    off = np.abs(trace.q[rows] - reference[at[rows]]).max(axis=1)
    late = rows[off > _SIMULATION.tracking_bound]
    row = int(late[0]) if len(late) else int(rows[off.argmax()])
    there = dataclasses.replace(
        trace, **{field.name: getattr(trace, field.name)[row : row + 1] for field in dataclasses.fields(trace)}
    )
    (contacts,) = touches(recording.shelf, bodies, there)
    if path := chain(contacts, WALLS):
        return path
    own = int(action.object) if moves(action) else TARGET
    beside = [k for k in range(TARGET + 1) if k != own and any({k, part} in contacts for part in (HAND, ARM))]
    return chain(contacts, beside)
