"""Ways of the arm through free space, from rest to rest: straight in the joints where nothing is there, else around it.

Around obstacles an RRT-Connect searches (Kuffner and LaValle, ICRA 2000) that looks at whole straight pieces at once,
shortens what it finds, draws from a fixed seed and gives up after a fixed number of attempts. Planning libraries such
as OMPL were tried and left: its bindings offer no seed, and ask for one pose of the arm at a time.

Nothing passes the plane of the shelf's front between actions, not even where the shelf is open: what the camera did
not see may be there.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import jax
import numpy as np
from jaxtyping import Bool, Float

from mechsearch_jax.robot.arm_clearance import FARTHEST, ArmBody, Obstacles, clearance
from mechsearch_jax.robot.kinematics import JOINT_LOWER, JOINT_UPPER
from mechsearch_jax.robot.robot_trajectory import limit_shares
from mechsearch_jax.robot.time_scaling import smooth_curve, timing, travelled
from mechsearch_jax.runtime.errors import InputError

# No point of the arm, the hand or what it holds is farther than this from the axis of each joint [m].
REACH = np.array([1.15, 1.15, 0.85, 0.8, 0.4, 0.4, 0.2])
# Waypoints that are timed together.
WAYPOINTS = 31
# Places of a line that are looked at together, and the strides in which a line is looked at that is free or of no use.
LOOK, STRIDES = 16, 8
# Share of the limits that is left free, for what peaks between the places that `timing` looks at.
SPARE = 0.01

_smooth_curve, _timing = jax.jit(smooth_curve), jax.jit(timing)


@dataclasses.dataclass(frozen=True)
class FreeMotionConfig:
    """How ways through free space are found.

    Attributes:
      clearance: how far the arm keeps from everything [m]; where an end is closer, half of what it has.
      step: the arm is looked at so closely that no point of it moves farther between two looks [m]; at most twice
        `clearance`, so that nothing is touched between them either.
      slack: the arm may reach so much farther into the shelf's opening than at either end [m].
      deepest: an arm that reaches farther beyond the shelf's front than this to begin with is not moved [m].
      extension: how far a tree grows towards a random place [rad].
      attempts: of growing a tree before the search is given up.
      shortcuts: attempts to shorten what was found.
      seed: of the random numbers; the same always finds the same.
      floor: height of what the robot stands on [m].
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
      position: joint angles after each time step [rad], shape (steps, 7); without rows where nothing moves.
      clearance: least distance from everything on the way [m], at most `arm_clearance.FARTHEST`.
      straight: whether it is the straight line in the joints.
    """

    position: Float[np.ndarray, "steps 7"]
    clearance: float
    straight: bool


@dataclasses.dataclass(frozen=True, eq=False)
class _Space:
    """Where the arm may be: at least `least` from everything, and no farther beyond the front than `deepest` [m]."""

    body: ArmBody
    obstacles: Obstacles
    least: float
    deepest: float
    step: float

    def allowed(self, q: np.ndarray) -> Bool[np.ndarray, " m"]:
        found = clearance(self.body, self.obstacles, q)
        return (found.free >= self.least) & (found.inside <= self.deepest)

    def travel(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """How far towards the end the arm gets on the straight line, looked at closely; the start itself if nowhere."""
        line = _line(start, end, self.step)
        for first in range(0, len(line), LOOK):
            stopped = np.flatnonzero(~self.allowed(line[first : first + LOOK]))
            if len(stopped):
                return line[max(first + stopped[0] - 1, 0)]
        return end

    def passes(self, start: np.ndarray, end: np.ndarray) -> bool:
        """Whether the straight line is free; looked at in strides, which soon find what is in the way."""
        line = _line(start, end, self.step)
        order = np.concatenate([np.arange(i, len(line), STRIDES) for i in range(STRIDES)])
        return all(self.allowed(line[order[i : i + LOOK]]).all() for i in range(0, len(line), LOOK))


def check_joints(name: str, q: Float[np.ndarray, "..."]) -> None:
    """Check that joint angles are seven numbers within the limits.

    Raises:
      InputError: they are not.
    """
    if np.shape(q) != (7,) or not np.isfinite(q).all():
        raise InputError(f"{name}: {np.asarray(q).tolist()} must be seven joint angles in radians")
    outside = np.flatnonzero((q < JOINT_LOWER - 1e-4) | (q > JOINT_UPPER + 1e-4))
    if len(outside):
        i = int(outside[0])
        limits = f"{JOINT_LOWER[i]:.4f} to {JOINT_UPPER[i]:.4f}"
        raise InputError(f"{name}: joint {i + 1} at {q[i]:.4f} rad is beyond its limits, {limits}; give radians")


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
) -> FreeMotion:
    """A motion between two joint angles [rad], through free space and within the joints' limits.

    Args:
      start, end: within the limits.
      body: the arm, the opening of its fingers and what it holds.
      obstacles: what it must not touch.
      timestep: time between rows [s].
      pace: share of the limits that velocities may reach; accelerations reach its square, and jerks its cube.
      least: it takes no less than this [s], also where nothing moves.
      config: how it is found; the default if None.

    Raises:
      InputError: an end is not free, or no way was found.
    """
    config = config or FreeMotionConfig()
    path = free_path(start, end, body, obstacles, config)
    straight = len(path) == 2
    if straight and np.max(np.abs(end - start)) < 1e-9:
        waits = np.repeat(start[None], math.ceil(least / timestep - 1e-9), axis=0)
        return FreeMotion(waits, float(clearance(body, obstacles, start[None]).free[0]), True)
    space = _space(path, body, obstacles, config)
    rows = _timed(_respaced(path, WAYPOINTS), timestep, pace, least)
    if not straight and not space.allowed(_thinned(rows, config.step)).all():
        # The smooth curve cuts a corner where there is no room: stop at each.
        pieces = [
            _timed(_respaced(np.array(pair), WAYPOINTS), timestep, pace, 0.0) for pair in itertools.pairwise(path)
        ]
        rows = np.concatenate(pieces)
    nearest = clearance(body, obstacles, np.concatenate([start[None], _thinned(rows, config.step)])).free.min()
    return FreeMotion(rows, float(nearest), straight)


def free_path(
    start: Float[np.ndarray, " 7"],
    end: Float[np.ndarray, " 7"],
    body: ArmBody,
    obstacles: Obstacles,
    config: FreeMotionConfig,
) -> Float[np.ndarray, "corners 7"]:
    """Corners of a path of straight lines in the joints [rad], the ends included, on which the arm touches nothing.

    Raises:
      InputError: an end is not free, or no way was found.
    """
    ends = np.array([start, end], float)
    found = clearance(body, obstacles, ends)
    for name, free, inside in zip(("where it begins", "where it ends"), found.free, found.inside, strict=True):
        if inside > config.deepest:
            raise InputError(
                f"free motion: {name} the arm is {100 * inside:.0f} cm inside the shelf; take it out along its way in"
            )
        if free <= 0.0:
            raise InputError(f"free motion: {name} the arm touches the shelf, an object, the floor or itself")
    space = _space(ends, body, obstacles, config)
    if space.passes(*ends):
        return ends
    rng = np.random.default_rng(config.seed)
    path = _connected(ends, space, config, rng)
    if path is None:
        raise InputError(f"free motion: no way around what is there was found in {config.attempts} attempts")
    return _shortened(path, space, config, rng)


def _space(path: np.ndarray, body: ArmBody, obstacles: Obstacles, config: FreeMotionConfig) -> _Space:
    found = clearance(body, obstacles, path[[0, -1]])
    least = min(config.clearance, 0.5 * float(found.free.min()))
    deepest = max(-config.clearance, float(found.inside.max())) + config.slack
    return _Space(body, obstacles, least, deepest, config.step)


def _line(start: np.ndarray, end: np.ndarray, step: float) -> np.ndarray:
    """Places on a straight line in the joints, both ends included, between which no point moves farther than `step`."""
    count = max(1, math.ceil(float(np.sum(np.abs(end - start) * REACH)) / step))
    return start + np.linspace(0.0, 1.0, count + 1)[:, None] * (end - start)


def _thinned(rows: np.ndarray, step: float) -> np.ndarray:
    """As few of the rows of a motion as leave no point more than `step` of way between them; the last is kept."""
    way = np.concatenate([[0.0], np.cumsum(np.sum(np.abs(np.diff(rows, axis=0)) * REACH, axis=1))])
    kept, last = [], -math.inf
    for i in range(len(rows)):
        if i + 1 == len(rows) or way[i + 1] - last > step:
            kept.append(i)
            last = way[i]
    return rows[kept]


def _connected(
    ends: np.ndarray, space: _Space, config: FreeMotionConfig, rng: np.random.Generator
) -> np.ndarray | None:
    """A path between the ends by two trees that grow towards each other; None if they do not meet."""
    trees = [([end], [-1]) for end in ends]
    low, high = ends.min(axis=0) - 1.0, ends.max(axis=0) + 1.0
    for attempt in range(config.attempts):
        # The way round is rarely far from both ends; where it is, later attempts look everywhere.
        near = attempt < config.attempts // 2
        lower, upper = (
            (np.maximum(low, JOINT_LOWER), np.minimum(high, JOINT_UPPER)) if near else (JOINT_LOWER, JOINT_UPPER)
        )
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
    """Grow a tree from its nearest node towards a place; the new node, or None where that is blocked at once."""
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
    """A path without detours: random pieces of it are replaced by straight lines where these are free."""
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
    # What is still a corner between its neighbours goes, where it can.
    corner = 1
    while corner < len(path) - 1:
        if space.passes(path[corner - 1], path[corner + 1]):
            path = np.delete(path, corner, axis=0)
        else:
            corner += 1
    return path


def _at(path: np.ndarray, lengths: np.ndarray, place: float) -> np.ndarray:
    """The joint angles at a place along a path whose corners are at `lengths`."""
    return np.array([np.interp(place, lengths, path[:, k]) for k in range(path.shape[1])])


def _respaced(path: np.ndarray, count: int) -> np.ndarray:
    """Evenly spaced places of a path, its ends included."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0) * REACH, axis=1))])
    return np.array([_at(path, lengths, place) for place in np.linspace(0.0, lengths[-1], count)])


def _timed(points: np.ndarray, timestep: float, pace: float, least: float) -> np.ndarray:
    """Joint angles after each time step of the fastest way along a smooth curve through the points."""
    curve = _smooth_curve(points.astype(np.float32))
    seconds, ramp = _timing(curve, np.float32(least), np.float32(pace * (1.0 - SPARE)))
    steps = max(1, math.ceil(float(seconds) / timestep - 1e-6))
    rows = travelled(curve, int(ramp), steps)
    # Near the corners of a planned path there may be peaks between the places that `timing` looks at.
    velocity, acceleration, jerk = limit_shares(np.concatenate([points[:1], rows]), timestep)
    over = max(velocity, acceleration ** (1 / 2), jerk ** (1 / 3)) / pace
    if over > 1.0:
        rows = travelled(curve, int(ramp), math.ceil(steps * over * (1.0 + SPARE)))
    # The curve knows its ends in single precision.
    share = np.linspace(0.0, 1.0, len(rows) + 1)[1:, None]
    return rows + (1.0 - share) * (points[0] - points[0].astype(np.float32)) + share * (points[-1] - rows[-1])
