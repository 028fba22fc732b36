"""Where a hidden target may be now that an action may have moved it.

A target slides only while something that moves touches it, and comes to rest at once. So if it was moved, it stood
beside the space that hand and objects swept, and stands beside that space now, no farther away than they travelled, and
not behind where it stood, as seen along a straight way in or out. What swept it is known: the hand's way from the
action, and the objects' ways from where they were seen before and after it. Which object is which afterwards is found
out by what is seen, where they are and how large, and never by the slots that they are in. Whether the action succeeded
does not matter: one that failed swept no more than it was meant to, and what it moved is seen.

Only what the camera allows now stays open: the belief folds the new observation in afterwards.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.approach import object_clouds
from mechsearch_jax.actions.config import CLOSED, OPEN
from mechsearch_jax.actions.registry import KINDS, ActionKind
from mechsearch_jax.actions.types import Action
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, inverse, make, transform
from mechsearch_jax.problem.problem import Problem

# An object whose centre moved by less was recognised anew a little elsewhere, or moved no target to another cell [m].
STILL = 0.003
# How far from what passed a target's surface may be at a pose that counts as touched [m]: a pose stands for its cell,
# and what passed is a cloud of points.
REACH = 0.01
# A hand that pushes travels no farther than this between the places where it is looked at [m].
STRIDE = 0.03
# What is carried and ends farther than this from its place was dropped or pushed on the way [m].
DROPPED = 0.03
# Places on the way of an object.
OBJECT_PLACES = 12
# By how much two objects of different exponents seem to differ in size, for each unit of that difference [m].
SHAPE = 0.02


def reopened(
    problem: Problem, exists: Bool[Array, " x"], before: Superquadrics, after: Superquadrics, action: Action
) -> Bool[Array, " x"]:
    """Where a target may be that an action moved unseen.

    Args:
      problem: what does not change.
      exists: f before the action.
      before, after: the objects as they were seen before and after it, in any order.
      action: a single action, whether or not it was carried out to its end.
    """
    target = problem.target
    places = problem.poses.reshape(-1, target.yaws, 3)[:, 0, :2]
    radius = target.half_size[0] if target.yaws == 1 else math.hypot(*target.half_size[:2])
    now = jnp.any(exists.reshape(-1, target.yaws), axis=1)
    away2 = jnp.sum((places[:, None] - places[None]) ** 2, axis=-1)
    opened = jnp.zeros_like(now)
    for sweep in _sweeps(problem, before, after, action):
        # What does not count is far away.
        swept = jnp.where((sweep.counts & (action.kind != ActionKind.NONE))[:, None], sweep.points[:, :2], jnp.inf)
        gap2 = jnp.min(jnp.sum((places[:, None] - swept[None]) ** 2, axis=-1), axis=1)
        beside = gap2 < (radius + REACH) ** 2
        within = away2 < (sweep.travel + 2 * REACH) ** 2
        # What is pushed gives way forwards or sideways.
        ahead = jnp.sum(places * sweep.heading[None], axis=-1)
        within &= ahead[:, None] - ahead[None] > -2 * REACH
        opened |= beside & jnp.any(within & (now & beside)[None], axis=1)
    return jnp.repeat(opened, target.yaws)


class _Sweep(NamedTuple):
    """What one stretch of an action passed.

    Attributes:
      points: that hand or objects passed, shape (P, 3) [m].
      counts: which of them passed so low that they may have touched the target, shape (P,).
      heading: which way they went, seen from above, shape (2,); 0 if it may have been any.
      travel: how far they can have taken the target [m].
    """

    points: Float[Array, "p 3"]
    counts: Bool[Array, " p"]
    heading: Float[Array, "2"]
    travel: Array | float


def _sweeps(problem: Problem, before: Superquadrics, after: Superquadrics, action: Action) -> tuple[_Sweep, ...]:
    """The stretches of an action: the way in, the push with what it moved, the way out, and the way in to a new place.

    Where something began to move is left out: it only moved away from what is there.
    """
    n, shelf, approach = before.capacity, problem.shelf, problem.gripper.approach
    holds = jnp.any(jnp.stack([action.kind == code for code, kind in KINDS.items() if kind.holds_object]))
    own = (jnp.arange(n) == action.object) & before.valid
    carry = compose(action.T_world_place, inverse(action.T_world_gripper))
    meant = jnp.where(holds, transform(carry, before.position), before.position + action.displacement[None])
    same, known = same_objects(before, after, jnp.where(own[:, None], meant, before.position))
    start, end = _bodies(problem, before, after, same)
    into = transform(carry, start)
    # What the action moves is known to move even where it is not seen afterwards.
    unseen = jnp.where(holds, into, start + action.displacement[None, None])
    end = jnp.where((own & ~known)[:, None, None], unseen, end)
    # What is held arrives at its place, or was dropped or pushed on the way there.
    arrived = jnp.sum((jnp.mean(end, axis=1) - jnp.mean(into, axis=1)) ** 2, axis=-1) < DROPPED**2
    carried = own & holds & arrived
    apart = jnp.sqrt(jnp.sum((after.position[same] - before.position)[:, :2] ** 2, axis=-1))
    moved = (known & (apart > STILL)) | own

    share = (jnp.arange(OBJECT_PLACES) + 1.0) / OBJECT_PLACES
    path = start[:, None] + share[None, :, None, None] * (end - start)[:, None]
    passed = jnp.broadcast_to((moved & ~carried)[:, None, None], path.shape[:-1])
    turned = jnp.sqrt(jnp.max(jnp.sum((end - start) ** 2, axis=-1), axis=-1))
    farthest = jnp.max(jnp.where(moved & ~carried, turned, 0.0), initial=0.0)
    farthest = jnp.maximum(farthest, jnp.sqrt(jnp.sum(action.displacement**2)))
    # An approximation: on its ways in and out, a hand that pushes takes the target no farther than the push does.
    ways = jnp.where(holds, approach, farthest)

    # What is carried goes out along the gripper's z and in again.
    back = approach * jnp.linspace(0.0, 1.0, OBJECT_PLACES // 2 + 1)

    def behind(points, T, along):
        return points[:, None] - (along[:, None] * T[None, :3, 2])[None, :, None]

    out, new = behind(start, action.T_world_gripper, back[1:]), behind(into, action.T_world_place, back[:-1])
    with_it = jnp.broadcast_to((own & holds)[:, None, None], out.shape[:-1])
    hand_in, hand_between, hand_at_end = _hand(problem, action)
    forward, backward = action.T_world_gripper[:2, 2], -action.T_world_place[:2, 2]

    def sweep(parts, heading, travel):
        points = jnp.concatenate([points.reshape(-1, 3) for points, _ in parts])
        counts = jnp.concatenate([jnp.broadcast_to(c, p.shape[:-1]).reshape(-1) for p, c in parts])
        return _Sweep(points, counts & (points[:, 2] < shelf.board + 2 * problem.target.half_size[2]), heading, travel)

    return (
        sweep([(hand_in, True)], forward, ways),
        sweep([(hand_between, ~holds), (path, passed)], jnp.zeros(2), farthest),
        sweep([(hand_at_end, ~holds)], backward, ways),
        sweep([(out, with_it)], -forward, approach),
        sweep([(hand_at_end, holds), (new, with_it)], -backward, approach),
    )


def _hand(problem: Problem, action: Action) -> tuple[Float[Array, "p 3"], Float[Array, "q 3"], Float[Array, "p 3"]]:
    """Points that the gripper passed on the way in, in between if it pushed, and on the way to or from its end [m]."""
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
    """Points of the objects before the action, and of those that they are afterwards [m]."""
    size = jnp.where(before.valid[:, None], before.size, 1.0)
    clouds = jnp.swapaxes(object_clouds(before.replace(size=size), problem.config.actions.object_points), -1, -2)
    start = transform(make(before.rotation, before.position)[:, None], clouds)
    return start, transform(make(after.rotation[same], after.position[same])[:, None], clouds)


def same_objects(
    before: Superquadrics, after: Superquadrics, meant: Float[Array, "n 3"]
) -> tuple[Int[Array, " n"], Bool[Array, " n"]]:
    """Which object of `after` each of `before` is, and whether it is any.

    Those that are most alike in place, size and shape are taken for the same first, and no two for one. The slots that
    they are in do not count.

    Args:
      before, after: the objects, fields (N, ...) and (M, ...).
      meant: where each may be, too, if an action was to move it; elsewhere where it was, shape (N, 3) [m].
    """

    def apart(a, b):
        return jnp.sqrt(jnp.sum((a[:, None] - b[None]) ** 2, axis=-1))

    place = jnp.minimum(apart(before.position, after.position), apart(meant, after.position))
    # Recognised from another side, width and depth may have changed their names.
    size = apart(jnp.sort(before.size, axis=-1), jnp.sort(after.size, axis=-1))
    cost = place + size + SHAPE * apart(before.exponents, after.exponents)
    cost = jnp.where(before.valid[:, None] & after.valid[None], cost, jnp.inf)
    rows, columns = jnp.arange(before.capacity), jnp.arange(after.capacity)

    def pair(_, found):
        cost, same, known = found
        best = jnp.argmin(cost)
        i, j = best // columns.size, best % columns.size
        here = (rows == i) & jnp.isfinite(cost[i, j])
        cost = jnp.where((rows == i)[:, None] | (columns == j)[None], jnp.inf, cost)
        return cost, jnp.where(here, j, same), known | here

    nothing = jnp.zeros(rows.size, jnp.int32), jnp.zeros(rows.size, bool)
    return jax.lax.fori_loop(0, min(rows.size, columns.size), pair, (cost, *nothing))[1:]
