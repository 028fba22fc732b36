"""Motion primitives: what arm and fingers do at every time step of a push, a pick-and-place or a retrieval.

Each primitive is a path of gripper poses, solved once by `path_kinematics` so that the arm stays in one configuration,
and a schedule: which stretch of the path is travelled in how many steps, and what the fingers do meanwhile. All lengths
are fixed by the `MotionConfig`, so that references can be computed, stacked and followed for many worlds at once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.errors import InputError
from mechsearch_jax.geometry.transforms import translate
from mechsearch_jax.robot.entry import way_in, ways_in
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.kinematics import path_kinematics

# Added to the turn between two waypoints, so that a stretch along which no joint turns has a length too [rad].
LEAST_TURN = 1e-3


@dataclasses.dataclass(frozen=True)
class MotionConfig:
    """How the primitives are executed.

    Attributes:
      timestep: of the simulation and of the references [s].
      gripper: says how long an approach is and which places are outside the shelf; the planner's.
      release: how far the gripper backs away from what it has pushed before it retreats, not to drag it along [m].
      clearance: how far above the commanded pose an object is released [m].
      squeeze: how far beyond closed the fingers are commanded when they hold something [m]; sets the grip's force, here
        60 to 70 N, which the hand can hold for long. With 40 N long boxes slip.
      approach_steps: duration of an approach or a retreat with free fingers [time steps].
      push_steps: of a push.
      release_steps: of backing away after a push.
      close_steps: of closing the fingers.
      carry_steps: of an approach or a retreat with an object in the hand.
      leave_steps: of the way along x between the outside and where the approach begins.
      transfer_steps: of the way, outside, to in front of where an object is placed.
      open_steps: of opening the fingers; opened at once, they turn a narrow box that they leave one after the other.
      waypoints: number of poses on each stretch of a path, where inverse kinematics is solved.
    """

    timestep: float = 0.004
    gripper: Gripper = dataclasses.field(default_factory=Gripper)
    release: float = 0.01
    clearance: float = 0.002
    squeeze: float = 0.05
    approach_steps: int = 250
    push_steps: int = 175
    release_steps: int = 50
    close_steps: int = 100
    carry_steps: int = 325
    leave_steps: int = 150
    transfer_steps: int = 275
    open_steps: int = 120
    waypoints: int = 31

    def __post_init__(self):
        if self.timestep <= 0:
            raise InputError(f"MotionConfig: timestep {self.timestep} must be positive")
        if self.waypoints < 2:
            raise InputError("MotionConfig: needs at least 2 waypoints")

    @property
    def grasp_step(self) -> int:
        """The time step, counted from 1, after which the fingers have closed, in a pick-and-place or a retrieval."""
        return self.leave_steps + self.approach_steps + self.close_steps

    @property
    def release_step(self) -> int:
        """The time step, counted from 1, after which the fingers begin to open, in a pick-and-place."""
        return self.grasp_step + 2 * (self.carry_steps + self.leave_steps) + self.transfer_steps


class Reference(flax.struct.PyTreeNode):
    """What the controller follows; one row for each time step.

    Attributes:
      q: joint angles [rad], shape (..., steps, 7).
      velocity: their rate of change [rad/s], shape (..., steps, 7).
      fingers: commanded distance of each finger from the middle [m], shape (..., steps); below 0 it squeezes.
      start: joint angles and finger distance before the first step, shape (..., 8).
    """

    q: jax.Array
    velocity: jax.Array
    fingers: jax.Array
    start: jax.Array


@dataclasses.dataclass(frozen=True)
class _Stretch:
    """Part of a schedule: from waypoint `first` to `last`, while the fingers go from one distance to another."""

    steps: int
    first: int
    last: int
    fingers: tuple[Array | float, Array | float]


def _ease(steps: int) -> np.ndarray:
    """Progress from 0 (exclusive) to 1 with rest at both ends."""
    u = np.arange(1, steps + 1) / steps
    return (u * u * (3 - 2 * u)).astype(np.float32)


def _travel(q: Array, stretch: _Stretch) -> Array:
    """Joint angles on a stretch, timed so that the fastest joint speeds up and slows down once, smoothly.

    Near a singularity the joints must turn far for a short way of the hand; timed by the hand's way they would have to
    turn faster than the motors can make them.
    """
    if stretch.first == stretch.last:
        return jnp.broadcast_to(q[stretch.first], (stretch.steps, q.shape[1]))
    direction = 1 if stretch.last > stretch.first else -1
    points = q[np.arange(stretch.first, stretch.last + direction, direction)]
    turned = jnp.max(jnp.abs(jnp.diff(points, axis=0)), axis=1) + LEAST_TURN
    passed = jnp.concatenate([jnp.zeros(1), jnp.cumsum(turned)])
    now = jnp.asarray(_ease(stretch.steps)) * passed[-1]
    return jax.vmap(lambda joint: jnp.interp(now, passed, joint), in_axes=1, out_axes=1)(points)


def _schedule(q: Array, stretches: Sequence[_Stretch], timestep: float) -> Reference:
    """Travel along the joint angles `q` (waypoints, 7) as the stretches say."""
    travelled = jnp.concatenate([_travel(q, s) for s in stretches])
    fingers = jnp.concatenate(
        [s.fingers[0] + (s.fingers[1] - s.fingers[0]) * jnp.asarray(_ease(s.steps)) for s in stretches]
    )
    start = q[stretches[0].first]
    velocity = jnp.diff(travelled, axis=0, prepend=start[None]) / timestep
    opening = jnp.asarray(stretches[0].fingers[0], jnp.float32)
    return Reference(travelled, velocity, fingers, jnp.concatenate([start, opening[None]]))


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
      The reference, and whether the arm reaches all of it.
    """
    n, gripper = config.waypoints, config.gripper
    length = jnp.sqrt(jnp.sum(displacement**2))
    end = translate(T_world_gripper, displacement)
    apart = translate(end, -config.release * displacement / jnp.maximum(length, 1e-6))
    path = jnp.concatenate(
        [
            way_in(T_world_gripper, gripper.nearest_outside, gripper, n - 1, n),
            _straight(T_world_gripper, end, n)[1:],
            _straight(end, apart, n)[1:],
            way_in(apart, gripper.nearest_outside, gripper, n - 1, n)[::-1][1:],
        ]
    )
    q, reachable = path_kinematics(path, q7)
    closed = (0.0, 0.0)
    corners = np.arange(7) * (n - 1)
    steps = (config.leave_steps, config.approach_steps, config.push_steps, config.release_steps)
    steps = (*steps, config.approach_steps, config.leave_steps)
    stretches = tuple(
        _Stretch(count, int(first), int(last), closed)
        for count, first, last in zip(steps, corners[:-1], corners[1:], strict=True)
    )
    return _schedule(q, stretches, config.timestep), reachable


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
      The reference, and whether the arm reaches all of it.
    """
    q, reachable = _entry(T_world_gripper, q7, config)
    return _schedule(q[::-1], _pick_stretches(opening, config), config.timestep), reachable


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
      The reference, and whether the arm reaches all of it.
    """
    raised = translate(T_world_place, jnp.array([0.0, 0.0, config.clearance]))
    pick, pick_reachable = _entry(T_world_gripper, q7, config)
    place, place_reachable = _entry(raised, q7, config)
    q = jnp.concatenate([pick[::-1], place])

    opened, held = opening / 2, -config.squeeze
    outside = pick.shape[0]
    front, last = outside + config.waypoints - 1, 2 * outside - 1
    stretches = (
        *_pick_stretches(opening, config),
        _Stretch(config.transfer_steps, outside - 1, outside, (held, held)),
        _Stretch(config.leave_steps, outside, front, (held, held)),
        _Stretch(config.carry_steps, front, last, (held, held)),
        _Stretch(config.open_steps, last, last, (held, opened)),
        _Stretch(config.approach_steps, last, front, (opened, opened)),
        _Stretch(config.leave_steps, front, outside, (opened, opened)),
    )
    return _schedule(q, stretches, config.timestep), pick_reachable & place_reachable


def _pick_stretches(opening: Array, config: MotionConfig) -> tuple[_Stretch, ...]:
    """Along a path that begins where the fingers close, passes the start of the approach, and ends outside."""
    front, opened, held = config.waypoints - 1, opening / 2, -config.squeeze
    return (
        _Stretch(config.leave_steps, 2 * front, front, (opened, opened)),
        _Stretch(config.approach_steps, front, 0, (opened, opened)),
        _Stretch(config.close_steps, 0, 0, (opened, held)),
        _Stretch(config.carry_steps, 0, front, (held, held)),
        _Stretch(config.leave_steps, front, 2 * front, (held, held)),
    )


def _entry(T: Array, q7: Array, config: MotionConfig) -> tuple[Array, Array]:
    """Joint angles on the way in from the first place outside that is in reach; its corner is row `waypoints - 1`."""
    q, reachable, _ = ways_in(T, q7, config.gripper, config.waypoints - 1, config.waypoints)
    return q, reachable
