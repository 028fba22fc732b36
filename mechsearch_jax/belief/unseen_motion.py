"""Where a hidden target may be after an action that may have moved it.

A target slides only while something that moves touches it, and comes to rest at once. So a target that was moved stood
beside the space that hand and objects swept, and stands beside that space now: no farther from its old place than they
travelled and, on a straight way in or out, not behind it. The swept space follows from the action (the hand) and from
the poses of the objects before and after it. Objects are matched by pose and size, never by their slots. A failed
action counts like a successful one: it swept no more than was planned, and what it moved is seen.

The belief is updated with the new observation afterwards, which keeps only poses that the camera allows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.config import CLOSED, OPEN
from mechsearch_jax.actions.registry import KINDS, ActionKind
from mechsearch_jax.actions.types import Action
from mechsearch_jax.geometry.bodies import surfaces
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, inverse, make, matmul, transform
from mechsearch_jax.observation import Observation
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.runtime.compiled import cached_jit

# Smaller displacements of an object's centre are noise of recognition, or cannot move a target to another cell [m].
STILL = 0.003
# Largest gap between the swept points and the surface of a target that counts as touched [m]: a pose represents its
# cell, and the swept space is a cloud of points.
REACH = 0.01
# Spacing of the samples along the way of a pushing hand [m].
STRIDE = 0.03
# A carried object that ends farther than this from the planned pose was dropped or pushed on the way [m].
DROPPED = 0.03
# Samples along the way of an object.
OBJECT_PLACES = 12
# Matching cost of a difference of 1 between the exponents of two objects, as a difference in size [m].
SHAPE = 0.02


def reopened(
    problem: Problem, exists: Bool[Array, " x"], before: Superquadrics, after: Superquadrics, action: Action
) -> Bool[Array, " x"]:
    """Candidate poses where a hidden target may be if the action moved it.

    Args:
      problem: the constants.
      exists: f before the action.
      before, after: the objects observed before and after it, in any order.
      action: a single action, executed to its end or not.
    """
    target = problem.target
    places = problem.poses.reshape(-1, target.yaws, 3)[:, 0, :2]
    radius = target.radius
    now = jnp.any(exists.reshape(-1, target.yaws), axis=1)
    distance2 = jnp.sum((places[:, None] - places[None]) ** 2, axis=-1)
    opened = jnp.zeros_like(now)
    for sweep in sweeps(problem, before, after, action):
        low = sweep.points[:, 2] < problem.shelf.board + target.tall
        counts = sweep.counts & low & (action.kind != ActionKind.NONE)
        swept = jnp.where(counts[:, None], sweep.points[:, :2], jnp.inf)
        gap2 = jnp.min(jnp.sum((places[:, None] - swept[None]) ** 2, axis=-1), axis=1)
        beside = gap2 < (radius + REACH) ** 2
        within = distance2 < (sweep.travel + 2 * REACH) ** 2
        # A pushed target moves forwards or sideways.
        ahead = jnp.sum(places * sweep.heading[None], axis=-1)
        within &= ahead[:, None] - ahead[None] > -2 * REACH
        opened |= beside & jnp.any(within & (now & beside)[None], axis=1)
    return jnp.repeat(opened, target.yaws)


class Sweep(NamedTuple):
    """The space that one stretch of an action swept.

    Attributes:
      points: of the hand and the objects on their way, shape (P, 3) [m].
      counts: which points are swept, shape (P,).
      heading: direction of motion from above, shape (2,); 0 if unknown.
      travel: how far the target can have been taken [m].
    """

    points: Float[Array, "p 3"]
    counts: Bool[Array, " p"]
    heading: Float[Array, "2"]
    travel: Array | float


def moved_by(objects: Superquadrics, action: Action) -> Superquadrics:
    """The objects after an action that moves its own object alone, as planned; also of one that moves none."""
    holds = _any_kind(action, "holds_object")
    moves = (jnp.arange(objects.capacity) == action.object) & objects.valid & ~_any_kind(action, "takes_target")
    carry = compose(action.T_world_place, inverse(action.T_world_gripper))
    position = jnp.where(holds, transform(carry, objects.position), objects.position + action.displacement[None])
    turned = matmul(carry[None, :3, :3], objects.rotation)
    return objects.replace(
        position=jnp.where(moves[:, None], position, objects.position),
        rotation=jnp.where((moves & holds)[:, None, None], turned, objects.rotation),
    )


@cached_jit()
def expected(before: Observation, action: Action) -> Observation:
    """A look's observation with its objects where an action, executed since then, is planned to leave them."""
    return before.replace(objects=moved_by(before.objects, action))


def _any_kind(action: Action, what: str) -> Bool[Array, ""]:
    """Whether an action is of a kind that has a property of `Kind`."""
    return jnp.any(jnp.stack([action.kind == code for code, kind in KINDS.items() if getattr(kind, what)]))


def sweeps(problem: Problem, before: Superquadrics, after: Superquadrics, action: Action) -> tuple[Sweep, ...]:
    """The stretches of an action: the way in, the push with the objects it moved, the way out, the way to a new place.

    The first pose of a moving object is left out, for it moves away from what touches it there.
    """
    n, approach = before.capacity, problem.gripper.approach
    holds = _any_kind(action, "holds_object")
    is_acted_on = (jnp.arange(n) == action.object) & before.valid & ~_any_kind(action, "takes_target")
    carry = compose(action.T_world_place, inverse(action.T_world_gripper))
    planned = jnp.where(holds, transform(carry, before.position), before.position + action.displacement[None])
    same, matched = same_objects(before, after, jnp.where(is_acted_on[:, None], planned, before.position))
    start, end = _bodies(problem, before, after, same)
    placed = transform(carry, start)
    # An object that the action moved and that is not seen afterwards is taken to have moved as planned.
    unseen = jnp.where(holds, placed, start + action.displacement[None, None])
    end = jnp.where((is_acted_on & ~matched)[:, None, None], unseen, end)
    arrived = jnp.sum((jnp.mean(end, axis=1) - jnp.mean(placed, axis=1)) ** 2, axis=-1) < DROPPED**2
    carried = is_acted_on & holds & arrived
    shift = jnp.sqrt(jnp.sum((after.position[same] - before.position)[:, :2] ** 2, axis=-1))
    moved = (matched & (shift > STILL)) | is_acted_on

    share = (jnp.arange(OBJECT_PLACES) + 1.0) / OBJECT_PLACES
    path = start[:, None] + share[None, :, None, None] * (end - start)[:, None]
    passed = jnp.broadcast_to((moved & ~carried)[:, None, None], path.shape[:-1])
    travelled = jnp.sqrt(jnp.max(jnp.sum((end - start) ** 2, axis=-1), axis=-1))
    farthest = jnp.max(jnp.where(moved & ~carried, travelled, 0.0), initial=0.0)
    farthest = jnp.maximum(farthest, jnp.sqrt(jnp.sum(action.displacement**2)))
    # An approximation: a pushing hand takes the target no farther on its ways in and out than during the push.
    ways = jnp.where(holds, approach, farthest)

    # A carried object goes out along the gripper's z and in again.
    back = approach * jnp.linspace(0.0, 1.0, OBJECT_PLACES // 2 + 1)

    def behind(points, T, along):
        return points[:, None] - (along[:, None] * T[None, :3, 2])[None, :, None]

    out, new = behind(start, action.T_world_gripper, back[1:]), behind(placed, action.T_world_place, back[:-1])
    with_hand = jnp.broadcast_to((is_acted_on & holds)[:, None, None], out.shape[:-1])
    hand_in, hand_between, hand_at_end = _hand(problem, action)
    forward, backward = action.T_world_gripper[:2, 2], -action.T_world_place[:2, 2]

    def sweep(parts, heading, travel):
        points = jnp.concatenate([points.reshape(-1, 3) for points, _ in parts])
        counts = jnp.concatenate([jnp.broadcast_to(c, p.shape[:-1]).reshape(-1) for p, c in parts])
        return Sweep(points, counts, heading, travel)

    return (
        sweep([(hand_in, True)], forward, ways),
        sweep([(hand_between, ~holds), (path, passed)], jnp.zeros(2), farthest),
        sweep([(hand_at_end, ~holds)], backward, ways),
        sweep([(out, with_hand)], -forward, approach),
        sweep([(hand_at_end, holds), (new, with_hand)], -backward, approach),
    )


def _hand(problem: Problem, action: Action) -> tuple[Float[Array, "p 3"], Float[Array, "q 3"], Float[Array, "p 3"]]:
    """Points of the gripper on the way in, during a push, and on the way to or from its last pose [m]."""
    tables = problem.actions
    opening = jnp.where(action.opening > 0.0, OPEN, CLOSED)
    wrist = jnp.argmin(jnp.abs(tables.q7[opening] - action.q7))
    cloud, still = tables.clouds[opening, wrist].T, tables.still[opening, wrist].T
    places = math.ceil(max(problem.config.actions.push_distances) / STRIDE) + 1
    way = action.displacement[None] * jnp.linspace(0.0, 1.0, places)[:, None]
    between = transform(action.T_world_gripper, still)[None] + way[:, None]
    first, last = (transform(T, cloud) for T in (action.T_world_gripper, action.T_world_place))
    return first, between.reshape(-1, 3), last


def _bodies(
    problem: Problem, before: Superquadrics, after: Superquadrics, same: Int[Array, " n"]
) -> tuple[Float[Array, "n p 3"], Float[Array, "n p 3"]]:
    """Points of the objects before the action, and at the poses of their matches after it [m]."""
    size = jnp.where(before.valid[:, None], before.size, 1.0)
    points = surfaces(before.replace(size=size), problem.config.actions.object_points)
    start = transform(make(before.rotation, before.position)[:, None], points)
    return start, transform(make(after.rotation[same], after.position[same])[:, None], points)


def same_objects(
    before: Superquadrics, after: Superquadrics, planned: Float[Array, "n 3"]
) -> tuple[Int[Array, " n"], Bool[Array, " n"]]:
    """Match objects before and after an action: the index in `after` of each of `before`, and whether it has a match.

    A greedy one-to-one assignment by position, size and exponents; slots do not count.

    Args:
      before, after: the objects, fields (N, ...) and (M, ...).
      planned: the position to which the action was to move each, or its old position, shape (N, 3) [m].
    """

    def distance(a, b):
        return jnp.sqrt(jnp.sum((a[:, None] - b[None]) ** 2, axis=-1))

    place = jnp.minimum(distance(before.position, after.position), distance(planned, after.position))
    # Width and depth may be swapped if an object is recognised from another side.
    size = distance(jnp.sort(before.size, axis=-1), jnp.sort(after.size, axis=-1))
    cost = place + size + SHAPE * distance(before.exponents, after.exponents)
    cost = jnp.where(before.valid[:, None] & after.valid[None], cost, jnp.inf)
    rows, columns = jnp.arange(before.capacity), jnp.arange(after.capacity)

    def pair(_, carry):
        cost, same, matched = carry
        best = jnp.argmin(cost)
        i, j = best // columns.size, best % columns.size
        here = (rows == i) & jnp.isfinite(cost[i, j])
        cost = jnp.where((rows == i)[:, None] | (columns == j)[None], jnp.inf, cost)
        return cost, jnp.where(here, j, same), matched | here

    nothing = jnp.zeros(rows.size, jnp.int32), jnp.zeros(rows.size, bool)
    return jax.lax.fori_loop(0, min(rows.size, columns.size), pair, (cost, *nothing))[1:]
