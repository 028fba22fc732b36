"""Playback of a recorded episode: the robot at home while it looks, its way to the action, the action, its way home.

Simulated motion is shown as it was. A simulator sets the robot directly to where an action begins, and back home; the
playback shows a planned motion in front of the shelf instead (`free_motion`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.world.world import BODIES, superquadrics
from mechsearch_jax.robot.arm_clearance import ArmBody, Obstacles
from mechsearch_jax.robot.free_motion import free_motion
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import rotation_matrix
from mechsearch_jax.workspace.shelf import Shelf

# How long the robot is shown at home before an action, and everything once the hand has stopped for the last time [s].
LOOKS, ENDS = 1.2, 0.5
# A hand whose joints and fingers are slower than this has stopped [rad/s, m/s].
STOPPED = 0.01
# A joint that turns by more than this between rows was set, not moved [rad].
SET = 0.2
# Ways in front of the shelf: time step [s], share of the joints' limits, and duration if planning fails [s].
WAY_STEP, WAY_PACE, WAY_TIME = 0.04, 0.5, 1.5


class Playback(NamedTuple):
    """The scene at evenly spaced moments, one row each.

    Attributes:
      step: index of the step that a row belongs to.
      time: since the beginning, in real time [s].
      q: joint angles [rad], shape (rows, 7).
      opening: distance between the fingers [m].
      position: of the nine bodies [m], shape (rows, 9, 3).
      rotation: `R_world_body`, shape (rows, 9, 3, 3).
    """

    step: Int[np.ndarray, " rows"]
    time: Float[np.ndarray, " rows"]
    q: Float[np.ndarray, "rows 7"]
    opening: Float[np.ndarray, " rows"]
    position: Float[np.ndarray, "rows 9 3"]
    rotation: Float[np.ndarray, "rows 9 3 3"]

    def is_still(self, row: int) -> bool:
        """Whether everything is where it was in the row before, of the same step; the first row has none."""
        values = (self.step, self.q, self.opening, self.position, self.rotation)
        return row > 0 and all(np.array_equal(each[row], each[row - 1]) for each in values)


class _Piece(NamedTuple):
    """Rows of a step; `time` counts from the beginning of the piece, `ends` is its duration [s]."""

    time: np.ndarray
    q: np.ndarray
    opening: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    ends: float


def playback(recording: Recording, fps: int, speed: float = 1.0) -> Playback:
    """A recording as evenly spaced moments; what still moves when the hand has stopped for good is left out.

    Args:
      recording: of the episode.
      fps: moments in a second.
      speed: as a multiple of real time.
    """
    pieces: list[tuple[int, _Piece]] = []
    for i, step in enumerate(recording.steps):
        pieces += [(i, piece) for piece in _pieces(step, recording.shelf)]
    last = pieces[-1][1]
    pieces.append((pieces[-1][0], _still(last.q[-1], last.opening[-1], last.position[-1], last.rotation[-1], ENDS)))
    starts = np.cumsum([0.0, *(piece.ends for _, piece in pieces)])
    moments = np.arange(0.0, starts[-1], speed / fps)
    columns: list[tuple[np.ndarray, ...]] = []
    for (i, piece), begin, end in zip(pieces, starts[:-1], starts[1:], strict=True):
        inside = moments[(moments >= begin) & (moments < end)]
        columns.append((np.full(len(inside), i), inside, *_sampled(piece, inside - begin)))
    step, time, q, opening, *bodies = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    # The first row counts as a motion, so that there always is a last one.
    speed_of_hand = np.abs(np.diff(np.column_stack([q, opening]), axis=0, prepend=0.0)).max(axis=1) * fps / speed
    stops, looks = time[np.flatnonzero(speed_of_hand > STOPPED)[-1]], time[step == step[-1]][0]
    shown = time <= max(stops + ENDS, looks + LOOKS)
    return Playback(*(column[shown] for column in (step, time, q, opening, *bodies)))


def _pieces(step: RecordedStep, shelf: Shelf) -> Iterator[_Piece]:
    """The robot at home, then for each run of the trace without a jump the way to it and its rows."""
    home, world = np.asarray(HOME, float), step.world
    yield _still(home, 0.0, np.asarray(world.position, float), np.asarray(world.rotation, float), LOOKS)
    trace = step.trace
    if not len(trace.time):
        return
    opening = trace.fingers.sum(axis=1).clip(0.0)
    rotation = rotation_matrix(trace.quaternion.reshape(-1, 4)).reshape(-1, BODIES, 3, 3)
    scene = superquadrics(world)
    jumps = 1 + np.flatnonzero(np.abs(np.diff(trace.q, axis=0)).max(axis=1) > SET)
    last_q, gap = home, 0.0
    for rows in np.split(np.arange(len(trace.time)), jumps):
        first = rows[0]
        obstacles = Obstacles.of(
            shelf, (scene.replace(position=trace.position[max(first - 1, 0)], rotation=rotation[max(first - 1, 0)]),)
        )
        way = _way(last_q, trace.q[first], max(gap, float(opening[first])), obstacles)
        times = WAY_STEP * np.arange(len(way))
        still = (np.repeat(a[max(first - 1, 0)][None], len(way), axis=0) for a in (trace.position, rotation))
        yield _Piece(times, way, np.linspace(gap, opening[first], len(way)), *still, ends=WAY_STEP * len(way))
        times = trace.time[rows] - trace.time[first]
        lasts = float(times[-1]) + (float(times[1]) if len(times) > 1 else WAY_STEP)
        yield _Piece(times, trace.q[rows], opening[rows], trace.position[rows], rotation[rows], lasts)
        last_q, gap = trace.q[rows[-1]], float(opening[rows[-1]])


def _way(start: np.ndarray, end: np.ndarray, opening: float, obstacles: Obstacles) -> Float[np.ndarray, "rows 7"]:
    """Joint angles on a collision-free way in front of the shelf, start and end included."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    try:
        motion = free_motion(start, end, ArmBody.of(opening), obstacles, timestep=WAY_STEP, pace=WAY_PACE)
        return np.concatenate([start[None], motion.position])
    except InputError:
        # Interpolated without regard to obstacles: better than showing nothing.
        share = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, round(WAY_TIME / WAY_STEP)))
        return start + share[:, None] * (end - start)


def _still(q: np.ndarray, opening: float, position: np.ndarray, rotation: np.ndarray, lasts: float) -> _Piece:
    return _Piece(np.zeros(1), q[None], np.array([opening]), position[None], rotation[None], lasts)


def _sampled(piece: _Piece, times: np.ndarray) -> tuple[np.ndarray, ...]:
    """Joints, opening, positions and rotations at times, interpolated between rows."""
    row = np.interp(times, piece.time, np.arange(len(piece.time)))
    low = np.floor(row).astype(int)
    high, share = np.minimum(low + 1, len(piece.time) - 1), row - low

    def between(values: np.ndarray) -> np.ndarray:
        weight = share.reshape(-1, *[1] * (values.ndim - 1))
        return values[low] * (1 - weight) + values[high] * weight

    u, _, v = np.linalg.svd(between(piece.rotation))
    return between(piece.q), between(piece.opening), between(piece.position), u @ v
