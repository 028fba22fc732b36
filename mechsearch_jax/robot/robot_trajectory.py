"""A trajectory for a robot's controller, and how close it comes to the limits."""

from __future__ import annotations

import dataclasses
import enum
import itertools
import math
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int

from mechsearch_jax.robot.arm_config import PANDA, Arm
from mechsearch_jax.robot.hand import HandEvent
from mechsearch_jax.runtime.errors import InputError


class Part(enum.IntEnum):
    """Which part of a motion a row belongs to; `PLACE`, where the target is put down, comes before the way home."""

    WAY_THERE = 0
    ACTION = 1
    WAY_HOME = 2
    PLACE = 3


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Where a controller should stop.

    Attributes:
      tracking: largest error of a joint's angle [rad]. In the simulator ordinary actions stay below 0.01, a few reach
        0.027; a hand that pushes a box against a wall reaches 0.065 and more.
      effort: largest torque of each joint beyond what gravity and the motion require [N m].
      force: largest force on the hand, without its grip and the weight of the held object [N].
    """

    tracking: float = 0.05
    effort: tuple[float, ...] = (40.0, 40.0, 40.0, 40.0, 10.0, 10.0, 10.0)
    force: float = 40.0

    def __post_init__(self):
        for name in ("tracking", "force"):
            if not (getattr(self, name) > 0 and math.isfinite(getattr(self, name))):
                raise InputError(f"Bounds: {name} {getattr(self, name)} must be a positive number")
        if len(self.effort) != 7 or not all(0 < e < math.inf for e in self.effort):
            raise InputError(f"Bounds: effort {self.effort} must be 7 positive torques in N m")


@dataclasses.dataclass(frozen=True)
class Nearest:
    """How near a motion comes to a body.

    Attributes:
      body: "object 4", "the target", "the shelf" (with the planner's margins), "the floor", or 'obstacle "camera"'.
      distance: least distance of the arm, the hand and what it holds from it [m], at most 0.2; negative by how deep
        they may enter it. Objects are their bounding boxes, where they stood before the action or are to be after it.
      time: when it is least [s].
    """

    body: str
    distance: float
    time: float


@dataclasses.dataclass(frozen=True)
class Report:
    """Properties of a trajectory before it is executed.

    Attributes:
      duration: [s].
      position_margin: least distance of a joint from its limits [rad]; negative beyond them.
      velocity, acceleration, jerk: largest share of the limits that a joint reaches, by differences of the rows.
      clearance: least distance from everything in free space [m], at most 0.2.
      straight: whether the ways through free space are straight lines in joint space.
      ends_at_home: False if home is not free and the arm stops outside the shelf.
      place_fault: why the target stays in the hand though there is a place for it; empty if it does not.
      nearest: how near the whole motion, the action in the shelf included, comes to each body, the nearest first.
      intended: the same for what the action pushes or grasps, from the action's beginning to its end.
    """

    duration: float
    position_margin: float
    velocity: float
    acceleration: float
    jerk: float
    clearance: float
    straight: bool
    ends_at_home: bool
    place_fault: str = ""
    nearest: tuple[Nearest, ...] = ()
    intended: tuple[Nearest, ...] = ()

    def within(self, tolerance: float = 1e-3) -> bool:
        """Whether all joints stay within their limits, up to a tolerance for rounding."""
        return self.position_margin >= -1e-4 and max(self.velocity, self.acceleration, self.jerk) <= 1.0 + tolerance

    def __str__(self) -> str:
        shares = ", ".join(f"{name} {100 * getattr(self, name):.0f} %" for name in ("velocity", "acceleration", "jerk"))
        return (
            f"{self.duration:.1f} s; of the limits: {shares}; joints {self.position_margin:.2f} rad from theirs; "
            f"{1000 * self.clearance:.0f} mm from everything in free space"
            f"{'' if self.straight else ', around what is in the way'}"
            f"{self._nearest}"
            f"{'' if self.ends_at_home else '; stops outside the shelf: the way home is not free'}"
            f"{self.place_fault and '; the target stays in the hand: '}{self.place_fault}"
        )

    @property
    def _nearest(self) -> str:
        """What the whole motion comes nearest to, in words."""
        if not self.nearest:
            return ""
        first = self.nearest[0]
        return f"; nearest to {first.body}: {1000 * first.distance:.0f} mm after {first.time:.1f} s"


@dataclasses.dataclass(frozen=True, eq=False)
class RobotTrajectory:
    """The motion of arm and fingers from the present joints through an action and home, one row for each time step.

    It begins and ends at rest. Positions, velocities and accelerations are those of one smooth curve.

    Attributes:
      time: since the motion began [s], shape (T,); the first row is 0.
      position: joint angles [rad], shape (T, 7).
      velocity: [rad/s], shape (T, 7).
      acceleration: [rad/s2], shape (T, 7).
      width: distance between the fingers [m], shape (T,): as a hand that executes the events has it; where it grips,
        what is held is taken to be as wide.
      force: grip force [N], shape (T,); 0 where they hold nothing.
      part: a `Part` for each row, shape (T,).
      action: name of the kind of action.
      bounds: where a controller should stop.
      clearance: least distance from everything in free space [m], at most 0.2.
      straight: whether the ways through free space are straight lines in joint space.
      ends_at_home: False if home is not free and the arm stops outside the shelf.
      events: what the hand does, in order; where an event `waits`, and where any ends, the arm stands still.
      place_fault: why the target stays in the hand though there is a place for it; empty if it does not.
      arm: that it was made for.
      nearest, intended: as of its `Report`.
    """

    time: Float[np.ndarray, " t"]
    position: Float[np.ndarray, "t 7"]
    velocity: Float[np.ndarray, "t 7"]
    acceleration: Float[np.ndarray, "t 7"]
    width: Float[np.ndarray, " t"]
    force: Float[np.ndarray, " t"]
    part: Int[np.ndarray, " t"]
    action: str
    bounds: Bounds
    clearance: float
    straight: bool
    ends_at_home: bool
    events: tuple[HandEvent, ...] = ()
    place_fault: str = ""
    arm: Arm = PANDA
    nearest: tuple[Nearest, ...] = ()
    intended: tuple[Nearest, ...] = ()

    @property
    def put_down(self) -> int | None:
        """The row from which the hand opens to put the target down at its place; None if it does not."""
        rows = np.flatnonzero((self.part[1:] == Part.PLACE) & (self.force[1:] == 0.0) & (self.force[:-1] > 0.0))
        return int(rows[0]) if len(rows) else None

    def report(self) -> Report:
        """Duration, shares of the limits and clearance."""
        timestep = self.time[1] - self.time[0] if len(self.time) > 1 else 1.0
        shares = limit_shares(self.position, float(timestep), self.arm)
        margin = np.minimum(self.position - self.arm.lower, self.arm.upper - self.position).min()
        return Report(
            float(self.time[-1]),
            float(margin),
            *shares,
            clearance=self.clearance,
            straight=self.straight,
            ends_at_home=self.ends_at_home,
            place_fault=self.place_fault,
            nearest=self.nearest,
            intended=self.intended,
        )


def limit_shares(position: Float[np.ndarray, "t 7"], timestep: float, arm: Arm = PANDA) -> tuple[float, float, float]:
    """Largest shares of an arm's limits of velocity, acceleration and jerk, by differences of rows, from rest to rest.

    Where the limit of the velocity depends on the position, the smaller of those at both rows counts.
    """
    first, last = (np.repeat(end, 3, axis=0) for end in (position[:1], position[-1:]))
    position = np.concatenate([first, position, last])
    velocity = np.diff(position, axis=0) / timestep
    acceleration = np.diff(velocity, axis=0) / timestep
    jerk = np.diff(acceleration, axis=0) / timestep
    speeds = np.minimum(arm.speeds(position[:-1], velocity), arm.speeds(position[1:], velocity))
    limits = (speeds, np.array(arm.acceleration, np.float32), np.array(arm.jerk, np.float32))
    by_velocity, by_acceleration, by_jerk = (
        float((np.abs(values) / limit).max())
        for values, limit in zip((velocity, acceleration, jerk), limits, strict=True)
    )
    return by_velocity, by_acceleration, by_jerk


def derivatives(
    position: Float[np.ndarray, "t 7"], timestep: float, rests: Iterable[int] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Velocities and accelerations of the smooth curves through rows; shapes (t, 7).

    Args:
      position: the rows [rad].
      timestep: between them [s].
      rests: rows at which the arm is at rest, beside the first and the last; both are exactly 0 there.
    """
    velocity, acceleration = np.zeros_like(position), np.zeros_like(position)
    for first, last in itertools.pairwise(sorted({0, *rests, len(position) - 1})):
        rows = slice(first, last + 1)
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(np.arange(last + 1 - first) * timestep, position[rows], bc_type="clamped")
        velocity[rows], acceleration[rows] = spline(spline.x, 1), spline(spline.x, 2)
        velocity[[first, last]] = acceleration[[first, last]] = 0.0
    return velocity, acceleration


def slowed(position: Float[np.ndarray, "t 7"], factor: float) -> Float[np.ndarray, "s 7"]:
    """Rows of the same motion from rest to rest that takes about `factor` times as long, at least 1.

    Args:
      position: the rows, the first configuration included [rad].
      factor: of the duration.
    """
    if len(position) < 2:
        return position
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(np.arange(len(position)), position, bc_type="clamped")
    rows = math.ceil((len(position) - 1) * factor - 1e-9) + 1
    return spline(np.linspace(0.0, len(position) - 1, rows))
