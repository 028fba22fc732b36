"""Motion primitives: arm and fingers at every time step of a push, a pick-and-place or a retrieval.

Each primitive is a path of gripper poses, solved once by `path_kinematics` so that the arm stays in one configuration,
and a schedule: a sequence of stretches of the path with the motion of the fingers. A stretch takes as long as the
joints' limits require (`time_scaling`), up to the longest duration in `MotionConfig`. References are padded to the sum
of the longest durations, so that they can be computed, stacked and followed for many worlds at once.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.transforms import translate
from mechsearch_jax.robot.arm_config import PANDA, Arm
from mechsearch_jax.robot.entry import way_in, ways_in
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.kinematics import path_kinematics
from mechsearch_jax.robot.time_scaling import angles_along, progress, smooth_curve, timing
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode

# Least time steps of a stretch: rounding errors must not decide its duration where the hand hardly moves.
SHORTEST = 25
# Durations are multiples of so many time steps, so that rounding errors, which differ between compiled functions,
# seldom change them.
GRAIN = 5
# A stretch in which no joint turns by more than this is left out [rad].
STILL = 1e-4


@dataclasses.dataclass(frozen=True)
class MotionConfig:
    """How the primitives are executed.

    Attributes:
      timestep: of the simulation and of the references [s].
      gripper: the planner's; gives the length of an approach and the places outside the shelf.
      release: how far the gripper backs away from a pushed object before it retreats, in order not to drag it [m].
      clearance: how far above the commanded pose an object is released [m].
      squeeze: how far beyond closed the fingers are commanded when they hold something [m]; sets the grip force, here
        60 to 70 N, which the hand can hold for long. With 40 N long boxes slip.
      approach_longest: longest duration of an approach or a retreat with free fingers [time steps]; a motion that needs
        longer, here or below, counts as out of reach.
      push_longest: longest duration of a push.
      push_least: least duration of a push, so slow that pushed objects stop with the hand.
      release_longest, release_least: of backing away after a push.
      close_steps: duration of closing the fingers.
      carry_longest: longest duration of an approach or a retreat with an object in the hand.
      leave_longest: longest duration of a crossing between the outside and the pre-grasp.
      transfer_longest: longest duration of the way outside to in front of the place of an object.
      open_steps: duration of opening the fingers; opened faster, they leave a narrow box one after the other and turn
        it.
      carry_pace: pace with an object in the hand: velocities stay below this share of the joints' limits, accelerations
        below its square, and jerks below its cube.
      waypoints: number of poses on each stretch of a path, where inverse kinematics is solved.
    """

    timestep: float = 0.004
    gripper: Gripper = dataclasses.field(default_factory=Gripper)
    release: float = 0.01
    clearance: float = 0.002
    squeeze: float = 0.05
    approach_longest: int = 500
    push_longest: int = 400
    push_least: int = 175
    release_longest: int = 150
    release_least: int = 50
    close_steps: int = 100
    carry_longest: int = 700
    leave_longest: int = 400
    transfer_longest: int = 1000
    open_steps: int = 120
    carry_pace: float = 0.7
    waypoints: int = 31

    def __post_init__(self):
        if self.timestep <= 0:
            raise InputError(f"MotionConfig: timestep {self.timestep} must be positive")
        if self.waypoints < 2:
            raise InputError("MotionConfig: needs at least 2 waypoints")
        if not 0 < self.carry_pace <= 1:
            raise InputError(f"MotionConfig: carry_pace {self.carry_pace} must be above 0 and at most 1")


def motion_with(gripper: Gripper, config: MotionConfig | None) -> MotionConfig:
    """The configuration, on the arm of this gripper; the default with this gripper if None."""
    config = config or MotionConfig(gripper=gripper)
    return dataclasses.replace(config, gripper=dataclasses.replace(config.gripper, arm=gripper.arm))


class Reference(PyTreeNode):
    """What the controller follows, one row for each time step. The last row is repeated when the motion is over.

    Attributes:
      q: joint angles [rad], shape (..., steps, 7).
      velocity: their rate of change [rad/s], shape (..., steps, 7).
      fingers: commanded distance of each finger from the middle [m], shape (..., steps); below 0 it squeezes.
      start: joint angles and finger distance before the first step, shape (..., 8).
      length: number of time steps of the motion, shape (...).
      closed: number of time steps until the fingers have closed; 0 if they are closed from the beginning.
      opens: number of time steps until they begin to open; `length` if they stay closed.
    """

    q: jax.Array
    velocity: jax.Array
    fingers: jax.Array
    start: jax.Array
    length: jax.Array
    closed: jax.Array
    opens: jax.Array


@dataclasses.dataclass(frozen=True)
class _Stretch:
    """Part of a schedule: from waypoint `first` to `last`, while the fingers go from one distance to another.

    Its duration is what the joints' limits require, divided by `pace`, but at least `least` and at most `longest` time
    steps; 0 if nothing moves. If `first` equals `last`, the arm waits for `longest`.
    """

    longest: int
    first: int
    last: int
    fingers: tuple[Array | float, Array | float]
    least: int = SHORTEST
    pace: float = 1.0


def _ease(u: Array) -> Array:
    """Progress of the fingers from 0 to 1 with rest at both ends."""
    return u * u * (3 - 2 * u)


def _points(q: Array, stretch: _Stretch, count: int) -> Array:
    """The waypoints of a stretch, resampled to `count`."""
    if stretch.first == stretch.last:
        return jnp.broadcast_to(q[stretch.first], (count, q.shape[1]))
    direction = 1 if stretch.last > stretch.first else -1
    points = q[np.arange(stretch.first, stretch.last + direction, direction)]
    if len(points) == count:
        return points
    return jnp.matmul(jnp.asarray(_respaced(len(points), count)), points, precision="highest")


@functools.cache
def _respaced(given: int, count: int) -> np.ndarray:
    """The matrix that resamples the natural spline through `given` points at `count` evenly spaced points."""
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(np.arange(given), np.eye(given), bc_type="natural")
    return spline(np.linspace(0, given - 1, count)).astype(np.float32)


def _schedule(q: Array, stretches: Sequence[_Stretch], timestep: float, arm: Arm = PANDA) -> tuple[Reference, Array]:
    """The motion along joint angles `q` (waypoints, 7) by the stretches, without pauses between them.

    Returns:
      The reference, and whether no stretch needs more than its longest time.
    """
    count = max(2, *(abs(s.last - s.first) + 1 for s in stretches))
    pace = jnp.array([s.pace for s in stretches], jnp.float32)
    least = np.array([s.longest if s.first == s.last else s.least for s in stretches])
    longest = np.array([s.longest for s in stretches])
    points = jnp.stack([_points(q, s, count) for s in stretches])
    curves = jax.vmap(lambda p: smooth_curve(p, arm))(points)
    seconds, ramp = jax.vmap(lambda curve, fewest, share: timing(curve, fewest, share, arm))(
        curves, jnp.asarray(least * timestep, jnp.float32), pace
    )

    needed = jnp.maximum(jnp.ceil(seconds / timestep / GRAIN - 1e-3) * GRAIN, least)
    # Stretches of zero length, such as the crossing to a pre-grasp outside, are left out.
    travels = np.array([s.first != s.last for s in stretches])
    still = jnp.max(jnp.abs(points - points[:, :1]), axis=(1, 2)) < STILL
    needed = jnp.where(still & travels, 0.0, needed)
    in_time = needed <= longest
    steps = jnp.where(in_time, needed, longest).astype(jnp.int32)
    ends = jnp.cumsum(steps)
    row = jnp.minimum(jnp.arange(int(longest.sum())), ends[-1] - 1)
    now = jnp.sum(row[:, None] >= ends[None], axis=1)
    u = (row + 1 - (ends - steps)[now]) / jnp.maximum(steps[now], 1)
    travelled = angles_along(curves, now, progress(u, ramp[now]))
    first, last = (jnp.stack([jnp.asarray(s.fingers[i], jnp.float32) for s in stretches]) for i in (0, 1))
    fingers = first[now] + (last - first)[now] * _ease(u)

    start = q[stretches[0].first]
    velocity = jnp.diff(travelled, axis=0, prepend=start[None]) / timestep
    waits = [i for i, s in enumerate(stretches) if s.first == s.last]
    closed = ends[waits[0]] if waits else jnp.zeros_like(ends[0])
    opens = ends[waits[1] - 1] if len(waits) > 1 else ends[-1]
    begin = jnp.concatenate([start, first[:1]])
    return Reference(travelled, velocity, fingers, begin, ends[-1], closed, opens), jnp.all(in_time)


def _straight(start: Array, end: Array, waypoints: int) -> Array:
    """Poses on the straight line between the positions of two poses of equal rotation, both ends included."""
    share = jnp.linspace(0.0, 1.0, waypoints)[:, None]
    line = jnp.broadcast_to(start, (waypoints, 4, 4))
    return line.at[:, :3, 3].set((1 - share) * start[None, :3, 3] + share * end[None, :3, 3])


def push_reference(
    T_world_gripper: Float[Array, "4 4"], displacement: Float[Array, " 3"], q7: Float[Array, ""], config: MotionConfig
) -> tuple[Reference, Bool[Array, ""]]:
    """A push with closed fingers: enter the shelf, approach, translate, let go, retreat, leave.

    Args:
      T_world_gripper: pose of the gripper where the push starts.
      displacement: translation of the gripper while it pushes, in the world [m].
      q7: angle of joint 7 [rad].
      config: lengths and durations.

    Returns:
      The reference, and whether the arm reaches all of it in time.
    """
    n, gripper = config.waypoints, config.gripper
    length = jnp.sqrt(jnp.sum(displacement**2))
    end = translate(T_world_gripper, displacement)
    released = translate(end, -config.release * displacement / jnp.maximum(length, 1e-6))
    path = jnp.concatenate(
        [
            way_in(T_world_gripper, gripper.nearest_outside, gripper, n - 1, n),
            _straight(T_world_gripper, end, n)[1:],
            _straight(end, released, n)[1:],
            way_in(released, gripper.nearest_outside, gripper, n - 1, n)[::-1][1:],
        ]
    )
    q, reachable = path_kinematics(path, q7, gripper.arm)
    closed = (0.0, 0.0)
    corners = [int(i) * (n - 1) for i in range(7)]
    longest = (config.leave_longest, config.approach_longest, config.push_longest, config.release_longest)
    longest = (*longest, config.approach_longest, config.leave_longest)
    least = (SHORTEST, SHORTEST, config.push_least, config.release_least, SHORTEST, SHORTEST)
    stretches = tuple(
        _Stretch(most, first, last, closed, fewest)
        for most, first, last, fewest in zip(longest, corners[:-1], corners[1:], least, strict=True)
    )
    reference, in_time = _schedule(q, stretches, config.timestep, config.gripper.arm)
    return reference, reachable & in_time


def retrieve_reference(
    T_world_gripper: Float[Array, "4 4"], q7: Float[Array, ""], opening: Float[Array, ""], config: MotionConfig
) -> tuple[Reference, Bool[Array, ""]]:
    """A retrieval: enter and approach with open fingers, close them, retreat, leave; the hand stays closed.

    Args:
      T_world_gripper: pose of the gripper where it closes.
      q7: angle of joint 7 [rad].
      opening: distance between the fingers on the approach [m].
      config: lengths and durations.

    Returns:
      The reference, and whether the arm reaches all of it, in time.
    """
    q, reachable = _entry(T_world_gripper, q7, config)
    stretches = _pick_stretches(opening, config)
    reference, in_time = _schedule(q[::-1], stretches, config.timestep, config.gripper.arm)
    return reference, reachable & in_time


def pick_and_place_reference(
    T_world_gripper: Float[Array, "4 4"],
    T_world_place: Float[Array, "4 4"],
    q7: Float[Array, ""],
    opening: Float[Array, ""],
    config: MotionConfig,
) -> tuple[Reference, Bool[Array, ""]]:
    """A pick-and-place: retrieve, carry the object to in front of its new place, bring it in, open, retreat, leave.

    Args:
      T_world_gripper: pose of the gripper where it closes.
      T_world_place: pose of the gripper where it opens.
      q7: angle of joint 7 [rad].
      opening: distance between the fingers on the approach and after the release [m].
      config: lengths and durations.

    Returns:
      The reference, and whether the arm reaches all of it, in time.
    """
    raised = translate(T_world_place, jnp.array([0.0, 0.0, config.clearance]))
    pick, pick_reachable = _entry(T_world_gripper, q7, config)
    place, place_reachable = _entry(raised, q7, config)
    q = jnp.concatenate([pick[::-1], place])

    opened, held, pace = opening / 2, -config.squeeze, config.carry_pace
    outside = pick.shape[0]
    front, last = outside + config.waypoints - 1, 2 * outside - 1
    stretches = (
        *_pick_stretches(opening, config),
        _Stretch(config.transfer_longest, outside - 1, outside, (held, held), pace=pace),
        _Stretch(config.leave_longest, outside, front, (held, held), pace=pace),
        _Stretch(config.carry_longest, front, last, (held, held), pace=pace),
        _Stretch(config.open_steps, last, last, (held, opened)),
        _Stretch(config.approach_longest, last, front, (opened, opened)),
        _Stretch(config.leave_longest, front, outside, (opened, opened)),
    )
    reference, in_time = _schedule(q, stretches, config.timestep, config.gripper.arm)
    return reference, pick_reachable & place_reachable & in_time


def _pick_stretches(opening: Array, config: MotionConfig) -> tuple[_Stretch, ...]:
    """Stretches of a path that begins where the fingers close, passes the pre-grasp, and ends outside."""
    front, opened, held, pace = config.waypoints - 1, opening / 2, -config.squeeze, config.carry_pace
    return (
        _Stretch(config.leave_longest, 2 * front, front, (opened, opened)),
        _Stretch(config.approach_longest, front, 0, (opened, opened)),
        _Stretch(config.close_steps, 0, 0, (opened, held)),
        _Stretch(config.carry_longest, 0, front, (held, held), pace=pace),
        _Stretch(config.leave_longest, front, 2 * front, (held, held), pace=pace),
    )


def _entry(T: Array, q7: Array, config: MotionConfig) -> tuple[Array, Array]:
    """Joint angles on the way in from the first reachable place outside; the pre-grasp is row `waypoints - 1`."""
    q, reachable, _ = ways_in(T, q7, config.gripper, config.waypoints - 1, config.waypoints)
    return q, reachable
