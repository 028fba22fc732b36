"""Every way to move every object of a scene, and what stands in the way: one batched evaluation for all kinds."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from mechsearch_jax.actions.approach import cloud_index, gripper_clouds
from mechsearch_jax.actions.config import ActionSpace, ActionTables
from mechsearch_jax.actions.kind import SampledKind
from mechsearch_jax.actions.registry import SAMPLED_KINDS
from mechsearch_jax.actions.types import Ways
from mechsearch_jax.actions.unseen_space import PossibleSpace
from mechsearch_jax.geometry.collision import collisions
from mechsearch_jax.geometry.footprints import footprints
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.robot.entry import gripper_enters

# The ways of every sampled kind, in the order of `SAMPLED_KINDS`.
Candidates = tuple[Ways, ...]


def no_candidates(space: ActionSpace, capacity: int) -> Candidates:
    """The candidates of so many objects that are yet to be looked at."""

    def none(kind: SampledKind) -> Ways:
        n, v, d = capacity, len(kind.wrists(space)), kind.distances(space)
        return Ways(
            T_world_gripper=jnp.zeros((n, v, 4, 4)),
            weight=jnp.zeros((n, v)),
            reached=jnp.zeros((n, v, d), bool),
            hits=jnp.zeros((n, v, n), bool),
            enters=jnp.zeros((n, v, d), bool),
        )

    return tuple(none(kind) for kind in SAMPLED_KINDS)


def candidates(
    space: ActionSpace,
    tables: ActionTables,
    scene: Superquadrics,
    possible: PossibleSpace,
    previous: Candidates | None = None,
    moved: Bool[Array, " n"] | None = None,
    available: Bool[Array, "*kinds n"] | None = None,
) -> Candidates:
    """All ways to move all objects, and what stands in their way.

    The kinds are tested together as far as they are alike: the approaches of the first kind to all objects, then those
    of the next.

    Args:
      space: all but the shelf is static.
      tables: constants of the problem.
      scene: the objects, fields (N, ...).
      possible: where the target may be.
      previous: candidates before some objects moved.
      moved: which moved since; only what concerns them is computed anew.
      available: which objects may be moved, by all kinds alike or by each of `SAMPLED_KINDS`; all if left out. What the
        ways of the others enter is not looked at.
    """
    n = scene.capacity
    previous = no_candidates(space, n) if previous is None else previous
    fresh = scene.valid if moved is None else moved & scene.valid
    concerns = fresh[:, None] | fresh[None, :]
    others = concerns & scene.valid[:, None] & scene.valid[None, :]
    prints = footprints(scene)

    poses, weights, wanted, wrists, openings, owners, parts = [], [], [], [], [], [], []
    first = 0
    for kind, before in zip(SAMPLED_KINDS, previous, strict=True):
        T, weight = kind.propose(space, tables, scene, prints, fresh)
        poses.append(jnp.where(fresh[:, None, None, None], T, before.T_world_gripper))
        weights.append(jnp.where(fresh[:, None], weight, before.weight))
        wanted.append(((weight > 0.0) & (kind.name in space.config.actions) & fresh[:, None]).reshape(-1))
        count = n * T.shape[1]
        wrists.append(np.tile(kind.wrists(space), n))
        openings.append(np.full(count, kind.opening))
        owners.append(np.repeat(np.arange(n), T.shape[1]))
        parts.append(slice(first, first + count))
        first += count
    flat = jnp.concatenate([T.reshape(-1, 4, 4) for T in poses])
    opening, wrist = np.concatenate(openings), np.concatenate(wrists)
    clouds, cloud = gripper_clouds(tables), cloud_index(tables, opening, wrist)
    near = gripper_enters(
        space.shelf,
        space.gripper,
        space.waypoints,
        clouds.points,
        cloud,
        flat,
        tables.q7[opening, wrist],
        jnp.concatenate(wanted),
    )

    reached, against = [], []
    for kind, before, T, part, owner in zip(SAMPLED_KINDS, previous, poses, parts, owners, strict=True):
        travels = kind.travels(space, tables, flat[part], near[part]).reshape(*T.shape[:2], -1)
        reached.append(jnp.where(fresh[:, None, None], travels, before.reached))
        obstacles = others & ~jnp.eye(n, dtype=bool) if kind.surrounds_object else others
        against.append(obstacles[owner] & jnp.any(reached[-1], axis=-1).reshape(-1)[:, None])
    mask = jnp.concatenate(against)
    by_hand = collisions(clouds, cloud, flat, scene, mask)

    able = jnp.broadcast_to(True if available is None else available, (len(SAMPLED_KINDS), n))
    found = []
    for i, (kind, before, T, weight, part, arrives) in enumerate(
        zip(SAMPLED_KINDS, previous, poses, weights, parts, reached, strict=True)
    ):
        hits = by_hand[part]
        hits |= kind.swept_hits(space, scene, flat[part], mask[part] & ~hits)
        hits = jnp.where(concerns[:, None, :], hits.reshape(*T.shape[:2], n), before.hits)
        ways = Ways(T, weight, arrives, hits, before.enters)
        looked_at = ways.replace(reached=arrives & able[i][:, None, None])
        found.append(ways.replace(enters=kind.entering(space, tables, scene, possible, looked_at)))
    return tuple(found)


def free_ways(ways: Ways) -> Bool[Array, "n v d"]:
    """Which ways nothing stands in the way of."""
    return ways.reached & ~jnp.any(ways.hits, axis=-1)[..., None]
