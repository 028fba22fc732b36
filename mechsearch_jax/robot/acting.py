"""The motion of an action as a real robot makes it: within the joints' limits, and waiting for a real hand.

A `motion.Reference` closes and opens the fingers as fast as the simulated hand does. Here the arm waits as long as the
real one takes, and what the fingers do is events beside the arm's rows.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from mechsearch_jax.robot.free_motion import SPARE
from mechsearch_jax.robot.hand import Grip, HandConfig, HandEvent, HandMove, stroke
from mechsearch_jax.robot.motion import MotionConfig, Reference
from mechsearch_jax.robot.robot_trajectory import limit_shares, slowed


@dataclasses.dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a motion, one after each time step, and the hand's events.

    Attributes:
      position: joint angles [rad], shape (n, 7).
      width: distance between the fingers [m], shape (n,).
      force: grip force [N], shape (n,).
      events: with starts relative to one time step before the first row.
      rests: numbers of rows after which the arm is at rest, beside all of them.
    """

    position: Float[np.ndarray, "n 7"]
    width: Float[np.ndarray, " n"]
    force: Float[np.ndarray, " n"]
    events: tuple[HandEvent, ...] = ()
    rests: tuple[int, ...] = ()


def joined(parts: list[Rows], timestep: float) -> Rows:
    """Rows one after the other."""
    events, rests, before = [], [], 0
    for part in parts:
        events += [dataclasses.replace(e, start=e.start + before * timestep) for e in part.events]
        rests += [row + before for row in part.rests]
        before += len(part.width)
        rests.append(before)
    return Rows(
        np.concatenate([part.position for part in parts]),
        np.concatenate([part.width for part in parts]),
        np.concatenate([part.force for part in parts]),
        tuple(events),
        tuple(rests),
    )


def closing(q: Float[np.ndarray, " 7"], opening: float, grip: Grip, hand: HandConfig, timestep: float) -> Rows:
    """The arm waits at `q` while the fingers close from `opening` [m] on what is held."""
    rows = _count(hand.time(opening - grip.width), timestep)
    width, arrived = stroke(opening, grip.width, rows, timestep, hand)
    force = np.where(arrived > 0.0, hand.force, 0.0)
    # Without any time to settle the grip begins with the last row.
    force[-1:] = hand.force
    event = grip.grasp(opening, 0.0, rows * timestep, hand)
    return Rows(np.repeat(q[None], rows, axis=0), width, force, (event,))


def opening_to(
    q: Float[np.ndarray, " 7"], before: float, after: float, hand: HandConfig, timestep: float, farthest: float = 0.0
) -> Rows:
    """The arm waits at `q` while the fingers move from one distance to another [m].

    There is time for a way of `farthest` m, if that is more.
    """
    rows = _count(hand.time(max(abs(after - before), farthest)), timestep)
    width, _ = stroke(before, after, rows, timestep, hand)
    event = HandMove(0.0, rows * timestep, True, after, hand.speed)
    return Rows(np.repeat(q[None], rows, axis=0), width, np.zeros(rows), (event,))


def acting(reference: Reference, grip: Grip, motion: MotionConfig, hand: HandConfig, speed: float = 1.0) -> Rows:
    """The rows of an action.

    Args:
      reference: the action's, as arrays of the host.
      grip: how wide what it grasps is; not used if it grasps nothing.
      motion: that the reference was made with.
      hand: of the robot.
      speed: share of the joints' velocity limits; accelerations reach its square, and jerks its cube.
    """
    steps, timestep = int(reference.length), motion.timestep
    start = np.asarray(reference.start, float)
    position = np.concatenate([start[None, :7], np.asarray(reference.q[:steps], float)])
    opening = 2.0 * max(float(start[7]), 0.0)
    velocity, acceleration, jerk = limit_shares(position, timestep, motion.gripper.arm)
    reached = max(velocity, acceleration ** (1 / 2), jerk ** (1 / 3))
    factor = max(1.0, reached / (speed * (1.0 - SPARE)))

    def moving(first: int, last: int, width: float, force: float) -> Rows:
        # From rest to rest; the arm stands still where the fingers move.
        q = slowed(position[first : last + 1], factor)[1:]
        return Rows(q, np.full(len(q), width), np.full(len(q), force))

    closed, opens = int(reference.closed), int(reference.opens)
    if not closed:
        return moving(0, steps, opening, 0.0)
    closes, held = closed - motion.close_steps, grip.width
    parts = [moving(0, closes, opening, 0.0)]
    parts.append(closing(parts[-1].position[-1], opening, grip, hand, timestep))
    parts.append(moving(closed, opens, held, hand.force))
    if opens < steps:
        parts.append(opening_to(parts[-1].position[-1], held, opening, hand, timestep))
        parts.append(moving(opens + motion.open_steps, steps, opening, 0.0))
    return joined(parts, timestep)


def _count(seconds: float, timestep: float) -> int:
    return max(1, math.ceil(seconds / timestep - 1e-9))
