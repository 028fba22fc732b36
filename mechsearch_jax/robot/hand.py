"""The fingers of a real hand: how they are used, and what a trajectory asks of them beside the arm's motion.

A Franka Hand follows no stream of widths. It takes actions: to move to a width at a speed, or to grasp what has about a
width, with a force. A trajectory holds them as events with a start and the time to reserve. Where `waits` is true, the
arm stands still from an event's start to its end; else it moves meanwhile, and stands still at the end.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from mechsearch_jax.geometry.superquadric import ROUND_EXPONENT
from mechsearch_jax.runtime.errors import InputError, check_range, shown

# Peak of the fingers' speed over its mean: they start and stop smoothly.
PEAK = 1.5
# Fingers that are closer together than this, or to their opening, hold nothing [m].
EMPTY = 0.003
# Upper bounds of the hand's speed [m/s], force [N], tolerances [m] and reserve of time [s].
FASTEST, STRONGEST, WIDEST, LONGEST = 1.0, 200.0, 0.1, 10.0


@dataclasses.dataclass(frozen=True)
class HandConfig:
    """How the fingers of the real hand are used; hashable. Decisions and simulated episodes do not depend on it.

    Attributes:
      speed: largest rate at which the distance between the fingers changes [m/s].
      force: of the grip [N].
      inner, outer: by how much what is held may be narrower or wider than it was taken to be [m].
      settle: time for the hand to begin, to press and to answer, beside the time that the fingers move [s].
    """

    speed: float = 0.1
    force: float = 60.0
    inner: float = 0.01
    outer: float = 0.01
    settle: float = 0.2

    def __post_init__(self):
        check_range("HandConfig: speed", self.speed, 1e-3, FASTEST, "m/s")
        check_range("HandConfig: force", self.force, 1.0, STRONGEST, "N")
        for name in ("inner", "outer"):
            check_range(f"HandConfig: {name}", getattr(self, name), 1e-3, WIDEST, "m")
        check_range("HandConfig: settle", self.settle, 0.0, LONGEST, "s")

    def moving_time(self, distance: float) -> float:
        """How long the fingers move to change their distance by `distance` m [s]."""
        return PEAK * abs(distance) / self.speed

    def time(self, distance: float) -> float:
        """The time to reserve for changing the fingers' distance by `distance` m [s]."""
        return self.moving_time(distance) + self.settle


@dataclasses.dataclass(frozen=True)
class HandMove:
    """The fingers move to a distance from each other.

    Attributes:
      start: since the trajectory began [s].
      duration: time reserved for it [s].
      waits: whether the arm stands still meanwhile.
      width: distance between the fingers at its end [m].
      speed: [m/s].
    """

    kind: ClassVar[str] = "move"
    start: float
    duration: float
    waits: bool
    width: float
    speed: float


@dataclasses.dataclass(frozen=True)
class HandGrasp:
    """The fingers close on something and press.

    Attributes:
      start, duration, waits, speed: as of a `HandMove`.
      width: that the held object is expected to have [m].
      force: of the grip [N].
      inner, outer: it is held if the fingers come to rest between `width - inner` and `width + outer` [m].
    """

    kind: ClassVar[str] = "grasp"
    start: float
    duration: float
    waits: bool
    width: float
    speed: float
    force: float
    inner: float
    outer: float


HandEvent = HandMove | HandGrasp


def later(event: HandEvent, seconds: float) -> HandEvent:
    """The same event, `seconds` later."""
    return dataclasses.replace(event, start=event.start + seconds)


@dataclasses.dataclass(frozen=True)
class Grip:
    """How wide something is between the fingers.

    Attributes:
      low, high: bounds of its width as it is recognised [m].
    """

    low: float
    high: float

    @property
    def width(self) -> float:
        """The expected width [m]."""
        return (self.low + self.high) / 2

    def grasp(self, opening: float, start: float, duration: float, hand: HandConfig) -> HandGrasp:
        """The grasp that closes on it, with the arm at rest.

        The tolerances tell it from fingers that have closed on nothing, or did not close.

        Args:
          opening: distance between the fingers before they close [m].
          start, duration: [s].
          hand: speed, force and tolerances.
        """
        spread = (self.high - self.low) / 2
        return HandGrasp(
            start=start,
            duration=duration,
            waits=True,
            width=self.width,
            speed=hand.speed,
            force=hand.force,
            inner=min(spread + hand.inner, self.width - EMPTY),
            outer=max(min(spread + hand.outer, opening - EMPTY - self.width), 0.0),
        )


def grip_of(
    closing: Float[np.ndarray, " 3"],
    rotation: Float[np.ndarray, "3 3"],
    size: Float[np.ndarray, " 3"],
    exponents: Float[np.ndarray, " 2"],
    opening: float,
) -> Grip:
    """The width of an object along the closing direction.

    Fingers turn a box until its faces lie along them: its width is between that of the axis that is the closest to the
    closing direction and its extent along this direction. An object of exponent e2 above 0.6 counts as round.

    Args:
      closing: unit vector in the world.
      rotation: `R_world_object`.
      size: half-extents [m].
      exponents: (e1, e2).
      opening: distance between the fingers before they close [m].
    """
    local = np.abs(np.asarray(rotation, float).T @ np.asarray(closing, float))
    x, y, z = local * np.asarray(size, float)
    plane = math.hypot(x, y) if float(exponents[1]) > ROUND_EXPONENT else x + y
    nearest = int(np.argmax(local))
    across = float(np.asarray(size, float)[nearest])
    extent = plane + z
    if float(exponents[1]) > ROUND_EXPONENT and nearest < 2:
        across = extent
    return _bounded(2.0 * min(across, extent), 2.0 * extent, opening)


def grip_of_any_yaw(half_size: tuple[float, float, float], opening: float) -> Grip:
    """The width of an upright object of unknown yaw [m]; arguments as of `grip_of`."""
    return _bounded(2.0 * min(half_size[:2]), 2.0 * max(half_size[:2]), opening)


def grip_of_anything(opening: float) -> Grip:
    """The width of what is between fingers that are `opening` m apart, if nothing is known of it."""
    return _bounded(0.0, opening, opening)


def _bounded(low: float, high: float, opening: float) -> Grip:
    """Bounds that open fingers can close on, and that are more than nothing."""
    least = 2.0 * EMPTY
    high = min(max(high, least), max(opening - EMPTY, least))
    return Grip(min(max(low, least), high), high)


def stroke(
    before: float, after: float, rows: int, timestep: float, hand: HandConfig
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
    """The fingers' distance after each time step as they move at once, and the time since they have arrived.

    Args:
      before, after: distance [m].
      rows: number of time steps.
      timestep: [s].
      hand: its speed.

    Returns:
      The distance [m], and the time since it was reached [s], negative before.
    """
    time = np.arange(1, rows + 1) * timestep
    moving = hand.moving_time(after - before)
    share = np.clip(time / moving, 0.0, 1.0) if moving > 0.0 else np.ones(rows)
    eased = before + (after - before) * share * share * (3.0 - 2.0 * share)
    return np.where(share < 1.0, eased, after), time - moving


def longest_way(after: float, max_opening: float) -> float:
    """The longest way to a distance between the fingers [m], if the present one is not known."""
    return max(after, max_opening - after)


def checked_width(width: Any, max_opening: float) -> float:
    """A distance between the fingers that a user or a hand reports, as one that the gripper has [m].

    Raises:
      InputError: it is no number, or no distance that the gripper can have.
    """
    number = np.asarray(width) if isinstance(width, (int, float)) or hasattr(width, "dtype") else np.asarray("")
    if number.ndim or number.dtype.kind not in "fiu":
        raise InputError(f"width: {shown(width)} must be a number, the distance between the fingers in metres")
    value = float(number)
    # A hand reports a little more than its largest opening, or less than none.
    if not -1e-3 <= value <= max_opening + 1e-3:
        raise InputError(f"width: {value} m must be between 0 and the gripper's {max_opening}, in metres")
    return min(max(value, 0.0), max_opening)
