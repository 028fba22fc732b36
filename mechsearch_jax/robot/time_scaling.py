"""Time scaling: smooth curves through waypoints, timed within the joints' limits.

A stretch of a motion begins and ends at rest. Its waypoints are joined by a natural cubic spline (of class C2, so that
accelerations do not jump at the waypoints), whose parameter s from 0 to 1 grows by about the least time that the
velocity limits allow for each part. So the arm is slow near singularities, where joints turn far for a short way of the
hand. The progress along the curve has a profile of unit duration, at rest and without acceleration at both ends: the
speed rises as a cubic smoothstep, is constant, and falls likewise. Velocities, accelerations and jerks fall with the
first, second and third power of the duration. So the largest of the three ratios to the limits, over all joints and
places, gives the duration. On an arm whose speed is limited by the position, the limits at the places count.

Approximation: peaks are evaluated at `PLACES` places of the curve. Differences of sampled references are averages of
the derivatives, so sampling raises no peak.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mechsearch_jax.robot.arm_config import PANDA, Arm
from mechsearch_jax.runtime.pytree import PyTreeNode

# Candidate shares of a stretch's time in which its speed rises, and falls. Short ramps suit long stretches, which
# velocities limit; the first of equally fast ones is chosen, which is closest to 3 u^2 - 2 u^3.
RAMPS = (1 / 3, 1 / 2, 0.42, 0.26, 0.2, 0.15)
PLACES = 257
# Added to the least time between two waypoints [s], so that it is positive at rest; and its least share of the mean,
# so that the spline's knots are not too uneven.
LEAST_TIME = 1e-4
LEAST_SHARE = 0.5
# How often each of those times is averaged with its neighbours, so that the parameter has no kinks.
SMOOTHINGS = 4


class Curve(PyTreeNode):
    """A natural cubic spline through joint angles.

    Attributes:
      knots: its parameter at the waypoints, rising from 0 to 1, shape (..., n).
      q: joint angles there [rad], shape (..., n, 7).
      bend: second derivatives there [rad], shape (..., n, 7).
    """

    knots: jax.Array
    q: jax.Array
    bend: jax.Array


def smooth_curve(q: Float[Array, "n 7"], arm: Arm = PANDA) -> Curve:
    """An arm's curve through joint angles [rad] at waypoints, evenly spaced along the hand's way; n is at least 2."""
    way = jnp.diff(q, axis=0)
    # A norm of high order instead of the maximum over the joints, which would make kinks.
    fourth = jnp.sum((way / arm.speeds((q[1:] + q[:-1]) / 2, way)) ** 4, axis=1)
    least = LEAST_SHARE * jnp.mean((fourth + LEAST_TIME**4) ** 0.25) + LEAST_TIME
    time = (fourth + least**4) ** 0.25
    for _ in range(SMOOTHINGS):
        padded = jnp.concatenate([time[:1], time, time[-1:]])
        time = (padded[:-2] + 2 * time + padded[2:]) / 4
    step = time / jnp.sum(time)
    knots = jnp.concatenate([jnp.zeros(1, step.dtype), jnp.cumsum(step)])
    return Curve(knots / knots[-1], q, _bends(step, q))


def timing(
    curve: Curve, least: Float[Array, ""] | float, pace: Float[Array, ""] | float = 1.0, arm: Arm = PANDA
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """The least duration of the motion along a curve, and its profile.

    Args:
      curve: without leading axes.
      least: lower bound of the duration [s].
      pace: share of the limits that velocities may reach; accelerations reach its square, and jerks its cube.
      arm: whose limits hold; static.

    Returns:
      The duration [s], and the index of the fastest of `RAMPS`.
    """
    segment = jnp.searchsorted(curve.knots, jnp.asarray(_PLACES), side="right", method="scan_unrolled") - 1
    q, d1, d2, d3 = _derivatives(curve, jnp.clip(segment, 0, curve.knots.shape[0] - 2), jnp.asarray(_PLACES))
    speeds = arm.speeds(q, d1)
    d1, d2, d3 = d1[None], d2[None], d3[None]
    rate, rate2, rate3 = (jnp.asarray(table)[..., None] for table in _RATES)
    velocity = d1 * rate
    acceleration = d2 * rate**2 + d1 * rate2
    jerk = d3 * rate**3 + 3.0 * d2 * rate * rate2 + d1 * rate3
    # The lower bound is so small that its roots are far below a time step.
    ratios = [
        jnp.maximum(jnp.max(jnp.abs(peak) / limit, axis=(1, 2)), 1e-12)
        for peak, limit in (
            (velocity, speeds[None]),
            (acceleration, np.array(arm.acceleration, np.float32)[None, None]),
            (jerk, np.array(arm.jerk, np.float32)[None, None]),
        )
    ]
    needed = jnp.maximum(ratios[0], jnp.maximum(ratios[1] ** (1 / 2), ratios[2] ** (1 / 3)))
    needed = jnp.maximum(needed / pace, least)
    best = jnp.argmin(needed)
    return needed[best], best


def progress(u: Float[Array, "*n"], ramp: Int[Array, "*#n"]) -> Float[Array, "*n"]:
    """Progress of a profile along its curve, from 0 to 1, at the share `u` of its time."""
    return _profile(u, jnp.asarray(RAMPS, jnp.float32)[ramp])


def angles_along(curves: Curve, which: Int[Array, " m"], s: Float[Array, " m"]) -> Float[Array, "m 7"]:
    """Joint angles [rad] at places of several curves.

    Args:
      curves: with one leading axis.
      which: index of the curve of each place.
      s: parameters, from 0 to 1.
    """
    count, n = curves.knots.shape
    flat: Curve = jax.tree.map(lambda a: a.reshape(count * n, *a.shape[2:]), curves)
    # One sorted array for all curves, so that a single search serves all places.
    knots = (curves.knots + 2.0 * jnp.arange(count)[:, None]).reshape(-1)
    segment = jnp.searchsorted(knots, s + 2.0 * which, side="right", method="scan_unrolled") - 1
    return _derivatives(flat, jnp.clip(segment, which * n, which * n + n - 2), s)[0]


def travelled(curve: Curve, ramp: int, steps: int) -> Float[np.ndarray, "{steps} 7"]:
    """Joint angles [rad] along one curve after each of `steps` equal parts of its time, in float64; not for `jit`.

    Args:
      curve: without leading axes.
      ramp: index of its profile in `RAMPS`.
      steps: number of parts of the time; the last row is the curve's end.
    """
    share = _profile(np.arange(1, steps + 1) / steps, RAMPS[ramp])
    knots = np.asarray(curve.knots, float)
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(knots / knots[-1], np.asarray(curve.q, float), bc_type="natural")
    return spline(np.clip(share, 0.0, 1.0))


def _derivatives(curve: Curve, segment: Array, s: Array) -> tuple[Array, Array, Array, Array]:
    """Joint angles and their first three derivatives with respect to the parameter, given the knots before it."""
    low, high = curve.knots[segment], curve.knots[segment + 1]
    step = (high - low)[:, None]
    a, b = (high - s)[:, None] / step, (s - low)[:, None] / step
    q0, q1, bend0, bend1 = curve.q[segment], curve.q[segment + 1], curve.bend[segment], curve.bend[segment + 1]
    q = q0 + b * (q1 - q0) + step**2 / 6 * ((a**3 - a) * bend0 + (b**3 - b) * bend1)
    d1 = (q1 - q0) / step + step / 6 * ((1 - 3 * a**2) * bend0 + (3 * b**2 - 1) * bend1)
    return q, d1, a * bend0 + b * bend1, (bend1 - bend0) / step


def _bends(step: Array, q: Array) -> Array:
    """Second derivatives of the natural spline at its knots, by cyclic reduction of its equations."""
    slope = jnp.diff(q, axis=0) / step[:, None]
    right = 6 * jnp.diff(slope, axis=0)
    before, after = step[:-1, None], step[1:, None]
    middle = 2 * (before + after)
    shift = 1
    while shift < right.shape[0]:
        # Subtract the equations `shift` above and below, which eliminates their unknowns.
        up = [_shifted(a, shift, fill) for a, fill in ((before, 0.0), (middle, 1.0), (after, 0.0), (right, 0.0))]
        down = [_shifted(a, -shift, fill) for a, fill in ((before, 0.0), (middle, 1.0), (after, 0.0), (right, 0.0))]
        above = jnp.where(jnp.arange(right.shape[0])[:, None] < shift, 0.0, before / up[1])
        below = jnp.where(jnp.arange(right.shape[0])[::-1, None] < shift, 0.0, after / down[1])
        middle = middle - above * up[2] - below * down[0]
        right = right - above * up[3] - below * down[3]
        before, after = -above * up[0], -below * down[2]
        shift *= 2
    return jnp.pad(right / middle, ((1, 1), (0, 0)))


def _shifted(a: Array, by: int, fill: float) -> Array:
    """Rows moved down, or up if negative."""
    rows = jnp.full((abs(by), a.shape[1]), fill, a.dtype)
    return jnp.concatenate([rows, a[:-by]]) if by > 0 else jnp.concatenate([a[-by:], rows])


def _profile(u, ramp):
    """Progress at the share `u` of the time, of a profile whose speed rises during the share `ramp`."""
    clip = np.clip if isinstance(u, np.ndarray) else jnp.clip
    rising, falling = (clip(v / ramp, 0.0, 1.0) for v in (u, 1.0 - u))
    rest = 0.5 + rising**3 * (1 - rising / 2) - falling**3 * (1 - falling / 2)
    return (ramp * rest + clip(u - ramp, 0.0, 1.0 - 2.0 * ramp)) / (1.0 - ramp)


def _tables() -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Places on a curve, dense at its ends, and the first three derivatives of the progress of each profile there."""
    place = (1 - np.cos(np.linspace(0.0, np.pi, PLACES))) / 2
    rows: list[list[np.ndarray]] = [[], [], []]
    dense = (1 - np.cos(np.linspace(0.0, np.pi, 40_001))) / 2
    for ramp in RAMPS:
        u = np.interp(place, _profile(dense, ramp), dense)
        top, early = 1 / (1 - ramp), u <= 0.5
        share = np.clip(np.where(early, u, 1 - u) / ramp, 0.0, 1.0)
        inside = share < 1
        rows[0].append(top * share**2 * (3 - 2 * share))
        rows[1].append(np.where(early, 1, -1) * top / ramp * 6 * share * (1 - share))
        rows[2].append(np.where(inside, top / ramp**2 * 6 * (1 - 2 * share), 0.0))
    first, second, third = (np.array(row, np.float32) for row in rows)
    return place.astype(np.float32), (first, second, third)


_PLACES, _RATES = _tables()
