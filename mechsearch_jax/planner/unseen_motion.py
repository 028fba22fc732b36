"""Where a hidden target may be now that an action may have moved it.

A target slides only while something that moves touches it, and comes to rest at once. So if it was moved, it stood
beside the space that hand and objects swept, and stands beside that space now, no farther away than they travelled.
What swept it is known: the hand's way from the action, and the objects' ways from where they were seen before and after
it. Whether the action succeeded does not matter: one that failed swept no more than it was meant to, and what it moved
is seen.

Only what the camera allows now stays open: the belief folds the new observation in afterwards.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.approach import object_clouds
from mechsearch_jax.actions.config import CLOSED, OPEN
from mechsearch_jax.actions.registry import KINDS, ActionKind
from mechsearch_jax.actions.types import Action
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, inverse, make, transform
from mechsearch_jax.planner.problem import Problem

# An object whose centre moved by less was recognised anew a little elsewhere, or moved no target to another cell [m].
STILL = 0.003
# How far from what passed a target's surface may be at a pose that counts as touched [m]: a pose stands for its cell,
# and what passed is a cloud of points.
REACH = 0.01
# A hand that pushes travels no farther than this between the places where it is looked at [m].
STRIDE = 0.03
# Places on the way of an object.
OBJECT_PLACES = 12
# By how much two objects must differ in place and size to be taken for one another rather than keep their numbers [m].
RENUMBERED = 0.02


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
    target, shelf = problem.target, problem.shelf
    hand = _hand(problem, action)
    bodies, passed, travel = _bodies(problem, before, after, action)
    points = jnp.concatenate([hand, bodies.reshape(-1, 3)])
    counts = jnp.concatenate([hand[:, 2] < shelf.board + 2 * target.half_size[2], passed.reshape(-1)])
    # What does not count is far away.
    swept = jnp.where((counts & (action.kind != ActionKind.NONE))[:, None], points[:, :2], jnp.inf)

    places = problem.poses.reshape(-1, target.yaws, 3)[:, 0, :2]
    gap2 = jnp.min(jnp.sum((places[:, None] - swept[None]) ** 2, axis=-1), axis=1)
    radius = target.half_size[0] if target.yaws == 1 else math.hypot(*target.half_size[:2])
    beside = gap2 < (radius + REACH) ** 2
    possible = jnp.any(exists.reshape(-1, target.yaws), axis=1) & beside
    away2 = jnp.sum((places[:, None] - places[None]) ** 2, axis=-1)
    within = away2 < (travel + 2 * REACH) ** 2
    return jnp.repeat(beside & jnp.any(within & possible[None], axis=1), target.yaws)


def _hand(problem: Problem, action: Action) -> Float[Array, "p 3"]:
    """Points that the gripper passed, on its ways in and out and in between if it pushed [m]."""
    tables = problem.actions
    opening = jnp.where(action.opening > 0.0, OPEN, CLOSED)
    wrist = jnp.argmin(jnp.abs(tables.q7[opening] - action.q7))
    cloud, still = tables.clouds[opening, wrist].T, tables.still[opening, wrist].T
    places = math.ceil(max(problem.config.actions.push_distances) / STRIDE) + 1
    way = action.displacement[None] * jnp.linspace(0.0, 1.0, places)[:, None]
    between = transform(action.T_world_gripper, still)[None] + way[:, None]
    ends = [transform(T, cloud) for T in (action.T_world_gripper, action.T_world_place)]
    return jnp.concatenate([*ends, between.reshape(-1, 3)])


def _bodies(
    problem: Problem, before: Superquadrics, after: Superquadrics, action: Action
) -> tuple[Float[Array, "n s p 3"], Bool[Array, "n s p"], Float[Array, ""]]:
    """Points that the objects passed [m], which of them count, and how far the target may have been taken [m]."""
    n, target, shelf = before.capacity, problem.target, problem.shelf
    # Where it began to move it touches only what it moves away from.
    approach, share = problem.gripper.approach, jnp.linspace(0.0, 1.0, OBJECT_PLACES + 1)[None, 1:, None, None]
    size = jnp.where(before.valid[:, None], before.size, 1.0)
    clouds = jnp.swapaxes(object_clouds(before.replace(size=size), problem.config.actions.object_points), -1, -2)
    start = transform(make(before.rotation, before.position)[:, None], clouds)

    same, known = _same(before, after)
    end = transform(make(after.rotation[same], after.position[same])[:, None], clouds)
    shift = jnp.sqrt(jnp.sum((after.position[same] - before.position)[:, :2] ** 2, axis=-1))
    own = (jnp.arange(n) == action.object) & before.valid
    # What is pushed is known to move even where it is not seen afterwards.
    end = jnp.where((own & ~known)[:, None, None], start + action.displacement[None, None], end)
    path = start[:, None] + share * (end - start)[:, None]
    moved = known & (shift > STILL)

    holds = jnp.any(jnp.stack([action.kind == code for code, kind in KINDS.items() if kind.holds_object]))
    into = transform(compose(action.T_world_place, inverse(action.T_world_gripper)), start)
    # What is carried goes out along the gripper's z and in again.
    out = approach * jnp.linspace(0.0, 1.0, OBJECT_PLACES // 2 + 1)[:, None]
    ends = ((start, action.T_world_gripper, out[1:]), (into, action.T_world_place, out[:-1]))
    carried = [cloud[:, None] - (back * T[None, :3, 2])[None, :, None] for cloud, T, back in ends]
    held = own & holds
    points = jnp.where(held[:, None, None, None], jnp.concatenate(carried, axis=1), path)
    # What is carried may be dropped, however high it is.
    low = (points[..., 2] < shelf.board + 2 * target.half_size[2]) | held[:, None, None]
    passed = low & (moved | own)[:, None, None]

    turned = jnp.sqrt(jnp.max(jnp.sum((end - start) ** 2, axis=-1), axis=-1))
    farthest = jnp.max(jnp.where(moved & ~held, turned, 0.0), initial=0.0)
    pushed = jnp.sqrt(jnp.sum(action.displacement**2))
    return points, passed, jnp.maximum(jnp.maximum(farthest, pushed), jnp.where(holds, approach, 0.0))


def _same(before: Superquadrics, after: Superquadrics) -> tuple[Int[Array, " n"], Bool[Array, " n"]]:
    """Which object of `after` each of `before` is, by place and size, and whether there is any.

    An approximation: each by itself, so that two may be taken for the same.
    """
    apart = [a[:, None] - b[None] for a, b in ((before.position, after.position), (before.size, after.size))]
    cost = sum(jnp.sqrt(jnp.sum(a**2, axis=-1)) for a in apart)
    cost += RENUMBERED * (jnp.arange(before.capacity)[:, None] != jnp.arange(after.capacity)[None])
    same = jnp.argmin(jnp.where(after.valid[None], cost, jnp.inf), axis=1)
    return same, before.valid & jnp.any(after.valid)
