"""Motions of the arm through free space, from rest to rest: straight in joint space, or around obstacles.

Around obstacles, RRT-Connect (Kuffner and LaValle, ICRA 2000) plans a path that is then shortened; it tests whole
straight pieces at once, draws from a fixed seed and gives up after a fixed number of attempts. OMPL was tried and
dropped: its bindings offer no seed, and test one configuration at a time.

Between actions nothing passes the plane of the shelf's front, even where it is open: unseen objects may be there.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mechsearch_jax.robot.arm_clearance import FARTHEST, ArmBody, Obstacles, clearance, touched
from mechsearch_jax.robot.arm_config import PANDA, Arm
from mechsearch_jax.robot.robot_trajectory import limit_shares
from mechsearch_jax.robot.time_scaling import smooth_curve, timing, travelled
from mechsearch_jax.runtime.errors import InputError

# No point of the arm, the hand or what it holds is farther than this from the axis of each joint [m].
REACH = np.array([1.15, 1.15, 0.85, 0.8, 0.4, 0.4, 0.2])
# Waypoints that are timed together.
WAYPOINTS = 31
# Samples of a line that are tested together, and the stride of the first samples, which soon find an obstacle.
LOOK, STRIDES = 16, 8
# Share of the limits that is left free for peaks between the samples of `timing`.
SPARE = 0.01

# Nothing that is not held up by a joint's end takes longer at full pace [s].
LONGEST = 60.0

_smooth_curve, _timing = (jax.jit(function, static_argnames="arm") for function in (smooth_curve, timing))


@dataclasses.dataclass(frozen=True)
class FreeMotionConfig:
    """How motions through free space are planned.

    Attributes:
      clearance: least distance of the arm from everything [m]; half of an end's distance if that is less.
      step: largest distance that a point of the arm moves between two tested configurations [m]; at most twice
        `clearance`, so that the arm touches nothing between them.
      slack: how much farther than at either end the arm may reach into the shelf's opening [m].
      deepest: largest distance beyond the shelf's front from which the arm is moved [m].
      extension: how far a tree grows towards a random configuration [rad].
      attempts: of growing a tree before the search is given up.
      shortcuts: attempts to shorten the path.
      seed: of the random numbers; equal seeds give equal paths.
      floor: height of the floor [m].
    """

    clearance: float = 0.01
    step: float = 0.02
    slack: float = 0.005
    deepest: float = 0.03
    extension: float = 0.6
    attempts: int = 1500
    shortcuts: int = 60
    seed: int = 0
    floor: float = 0.0

    def __post_init__(self):
        for name in ("clearance", "step", "slack", "deepest", "extension"):
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise InputError(f"FreeMotionConfig: {name} {value} must be a positive number")
        if self.step > 2 * self.clearance or self.clearance > FARTHEST:
            raise InputError(
                f"FreeMotionConfig: step {self.step} must be at most twice clearance {self.clearance},"
                f" and that at most {FARTHEST}"
            )
        if self.attempts < 1 or self.shortcuts < 0:
            raise InputError("FreeMotionConfig: attempts must be at least 1, and shortcuts at least 0")


@dataclasses.dataclass(frozen=True, eq=False)
class FreeMotion:
    """A motion through free space; it begins and ends at rest.

    Attributes:
      position: joint angles after each time step [rad], shape (steps, 7); no rows if nothing moves.
      clearance: least distance from everything on the way [m], at most `arm_clearance.FARTHEST`.
      straight: whether it is the straight line in joint space.
    """

    position: Float[np.ndarray, "steps 7"]
    clearance: float
    straight: bool


@dataclasses.dataclass(frozen=True, eq=False)
class _Space:
    """Allowed configurations: at least `least` from everything, and at most `deepest` beyond the shelf's front [m]."""

    body: ArmBody
    obstacles: Obstacles
    least: float
    deepest: float
    step: float

    def allowed(self, q: np.ndarray) -> Bool[np.ndarray, " m"]:
        distances = clearance(self.body, self.obstacles, q)
        return (distances.free >= self.least) & (distances.inside <= self.deepest)

    def travel(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """The last allowed configuration on the straight line to the end; the start itself if blocked at once."""
        line = _line(start, end, self.step)
        for first in range(0, len(line), LOOK):
            stopped = np.flatnonzero(~self.allowed(line[first : first + LOOK]))
            if len(stopped):
                return line[max(first + stopped[0] - 1, 0)]
        return end

    def passes(self, start: np.ndarray, end: np.ndarray) -> bool:
        """Whether the straight line is free; tested in strides, which soon find an obstacle."""
        line = _line(start, end, self.step)
        order = np.concatenate([np.arange(i, len(line), STRIDES) for i in range(STRIDES)])
        return all(self.allowed(line[order[i : i + LOOK]]).all() for i in range(0, len(line), LOOK))


def free_motion(
    start: Float[np.ndarray, " 7"],
    end: Float[np.ndarray, " 7"],
    body: ArmBody,
    obstacles: Obstacles,
    *,
    timestep: float,
    pace: float = 1.0,
    least: float = 0.0,
    config: FreeMotionConfig | None = None,
    arm: Arm = PANDA,
) -> FreeMotion:
    """A motion between two configurations [rad], through free space and within the joints' limits.

    Args:
      start, end: joint angles within the limits [rad].
      body: the arm, the opening of its fingers and the held object.
      obstacles: what it must not touch.
      timestep: time between rows [s].
      pace: share of the limits that velocities may reach; accelerations reach its square, and jerks its cube.
      least: shortest duration, also if nothing moves [s].
      config: how it is planned; the default if None.
      arm: whose limits hold.

    Raises:
      InputError: an end is not free, no path was found, or a joint is so near its end that the arm may hardly move.
    """
    config = config or FreeMotionConfig()
    path = free_path(start, end, body, obstacles, config, arm)
    straight = len(path) == 2
    if straight and np.max(np.abs(end - start)) < 1e-9:
        waits = np.repeat(start[None], math.ceil(least / timestep - 1e-9), axis=0)
        return FreeMotion(waits, float(clearance(body, obstacles, start[None]).free[0]), True)
    space = _space(path, body, obstacles, config)
    rows = timed_rows(respaced(path, WAYPOINTS), timestep, pace, least, arm)
    few = rows[few_rows(rows, config.step)]
    if not straight and not space.allowed(few).all():
        # The smooth curve cuts a corner and touches something: stop at each corner.
        pieces = [
            timed_rows(respaced(np.array(pair), WAYPOINTS), timestep, pace, 0.0, arm)
            for pair in itertools.pairwise(path)
        ]
        rows = np.concatenate(pieces)
        few = rows[few_rows(rows, config.step)]
    nearest = clearance(body, obstacles, np.concatenate([start[None], few])).free.min()
    return FreeMotion(rows, float(nearest), straight)


def free_path(
    start: Float[np.ndarray, " 7"],
    end: Float[np.ndarray, " 7"],
    body: ArmBody,
    obstacles: Obstacles,
    config: FreeMotionConfig,
    arm: Arm = PANDA,
) -> Float[np.ndarray, "corners 7"]:
    """Corners, ends included, of a path of straight lines in joint space on which the arm touches nothing [rad].

    Raises:
      InputError: an end is not free, or no path was found.
    """
    ends = np.array([start, end], float)
    at_ends = clearance(body, obstacles, ends)
    for name, each, inside in zip(("where it begins", "where it ends"), at_ends.each, at_ends.inside, strict=True):
        if inside > config.deepest:
            raise InputError(
                f"free motion: {name} the arm is {100 * inside:.0f} cm inside the shelf; take it out along its way in"
            )
        if each.min() <= 0.0:
            raise InputError(f"free motion: {name} the arm touches {touched(obstacles, each[None])}")
    space = _space(ends, body, obstacles, config)
    if space.passes(*ends):
        return ends
    rng = np.random.default_rng(config.seed)
    path = _connected(ends, space, config, rng, arm)
    if path is None:
        near = clearance(body, obstacles, _line(start, end, config.step)).each.min(axis=0) < space.least
        what = " and ".join(dict.fromkeys(itertools.compress(obstacles.names, near))) or "the shelf's front"
        raise InputError(f"free motion: no way around {what} was found in {config.attempts} attempts")
    return _shortened(path, space, config, rng)


def _space(path: np.ndarray, body: ArmBody, obstacles: Obstacles, config: FreeMotionConfig) -> _Space:
    at_ends = clearance(body, obstacles, path[[0, -1]])
    least = min(config.clearance, 0.5 * float(at_ends.free.min()))
    deepest = max(-config.clearance, float(at_ends.inside.max())) + config.slack
    return _Space(body, obstacles, least, deepest, config.step)


def _line(start: np.ndarray, end: np.ndarray, step: float) -> np.ndarray:
    """Configurations on a straight line, ends included, between which no point of the arm moves more than `step`."""
    count = max(1, math.ceil(float(np.sum(np.abs(end - start) * REACH)) / step))
    return start + np.linspace(0.0, 1.0, count + 1)[:, None] * (end - start)


def few_rows(rows: Float[np.ndarray, "n 7"], step: float) -> Int[np.ndarray, " m"]:
    """Numbers of a few rows of a motion, the last included, between which no point of the arm moves more than `step`.

    Where it moves farther from one row to the next, both are among them.
    """
    way = np.concatenate([[0.0], np.cumsum(np.sum(np.abs(np.diff(rows, axis=0)) * REACH, axis=1))])
    kept, last = [], -math.inf
    for i in range(len(rows)):
        if i + 1 == len(rows) or way[i + 1] - last > step:
            kept.append(i)
            last = way[i]
    return np.array(kept, int)


def _connected(
    ends: np.ndarray, space: _Space, config: FreeMotionConfig, rng: np.random.Generator, arm: Arm
) -> np.ndarray | None:
    """A path between the ends from two trees that grow towards each other; None if they do not meet."""
    trees = [([end], [-1]) for end in ends]
    low, high = ends.min(axis=0) - 1.0, ends.max(axis=0) + 1.0
    for attempt in range(config.attempts):
        # A path around obstacles is rarely far from both ends; if it is, later attempts draw from everywhere.
        near = attempt < config.attempts // 2
        lower, upper = arm.lower, arm.upper
        lower, upper = (np.maximum(low, lower), np.minimum(high, upper)) if near else (lower, upper)
        place = rng.uniform(lower, upper)
        grown = _grown(trees[attempt % 2], place, space, config.extension)
        if grown is None:
            continue
        other = trees[1 - attempt % 2]
        met = _grown(other, grown, space, math.inf)
        if met is not None and np.array_equal(met, grown):
            branches = [_branch(tree) for tree in trees]
            return np.concatenate([branches[0], branches[1][::-1][1:]])
    return None


def _grown(tree: tuple[list, list], place: np.ndarray, space: _Space, farthest: float) -> np.ndarray | None:
    """Grow a tree from its nearest node towards a configuration; the new node, or None if blocked at once."""
    nodes, parents = tree
    nearest = int(np.argmin(np.sum(((np.array(nodes) - place) * REACH) ** 2, axis=1)))
    way = place - nodes[nearest]
    length = float(np.linalg.norm(way))
    reached = space.travel(nodes[nearest], place if length <= farthest else nodes[nearest] + farthest / length * way)
    if np.array_equal(reached, nodes[nearest]):
        return None
    nodes.append(reached)
    parents.append(nearest)
    return reached


def _branch(tree: tuple[list, list]) -> np.ndarray:
    """The nodes from the root of a tree to its newest one."""
    nodes, parents = tree
    branch, i = [], len(nodes) - 1
    while i >= 0:
        branch.append(nodes[i])
        i = parents[i]
    return np.array(branch[::-1])


def _shortened(path: np.ndarray, space: _Space, config: FreeMotionConfig, rng: np.random.Generator) -> np.ndarray:
    """A shorter path: random pieces are replaced by straight lines if these are free."""
    for _ in range(config.shortcuts):
        if len(path) == 2:
            break
        lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0) * REACH, axis=1))])
        first, last = np.sort(rng.uniform(0.0, lengths[-1], 2))
        i, j = np.searchsorted(lengths, [first, last], side="right")
        if i == j:
            continue
        a, b = (_at(path, lengths, place) for place in (first, last))
        if space.passes(a, b):
            path = np.concatenate([path[:i], [a, b], path[j:]])
    # Remove the corners that can be skipped.
    corner = 1
    while corner < len(path) - 1:
        if space.passes(path[corner - 1], path[corner + 1]):
            path = np.delete(path, corner, axis=0)
        else:
            corner += 1
    return path


def _at(path: np.ndarray, lengths: np.ndarray, place: float) -> np.ndarray:
    """The joint angles at length `place` along a path whose corners are at `lengths`."""
    return np.array([np.interp(place, lengths, path[:, k]) for k in range(path.shape[1])])


def respaced(path: np.ndarray, count: int) -> np.ndarray:
    """Evenly spaced configurations on a path, its ends included."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0) * REACH, axis=1))])
    return np.array([_at(path, lengths, place) for place in np.linspace(0.0, lengths[-1], count)])


def timed_rows(
    points: Float[np.ndarray, "n 7"], timestep: float, pace: float, least: float = 0.0, arm: Arm = PANDA
) -> Float[np.ndarray, "steps 7"]:
    """Joint angles after each time step of the fastest motion along a smooth curve, from rest to rest.

    Args:
      points: of the curve [rad]; it is compiled once for each number of them.
      timestep, pace, least, arm: as of `free_motion`.

    Raises:
      InputError: a joint is so near its end that the arm may hardly move.
    """
    curve = _smooth_curve(points.astype(np.float32), arm=arm)
    seconds, ramp = _timing(curve, np.float32(least), np.float32(pace * (1.0 - SPARE)), arm=arm)
    if seconds > max(least, LONGEST / pace):
        raise InputError(f"free motion: near its end a joint of the {arm.name} may hardly move; keep farther from it")
    steps = max(1, math.ceil(float(seconds) / timestep - 1e-6))
    rows = travelled(curve, int(ramp), steps)
    # Near the corners of a planned path there may be peaks between the samples of `timing`.
    velocity, acceleration, jerk = limit_shares(np.concatenate([points[:1], rows]), timestep, arm)
    excess = max(velocity, acceleration ** (1 / 2), jerk ** (1 / 3)) / pace
    if excess > 1.0:
        rows = travelled(curve, int(ramp), math.ceil(steps * excess * (1.0 + SPARE)))
    # The curve is in single precision; make its ends exact.
    share = np.linspace(0.0, 1.0, len(rows) + 1)[1:, None]
    return rows + (1.0 - share) * (points[0] - points[0].astype(np.float32)) + share * (points[-1] - rows[-1])
