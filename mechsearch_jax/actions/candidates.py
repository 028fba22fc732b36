"""Candidate actions for every object of a scene (paper B.5), all kinds evaluated in one batch."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.approach import cloud_index, gripper_clouds
from mechsearch_jax.actions.config import ActionSpace
from mechsearch_jax.actions.kind import SampledKind
from mechsearch_jax.actions.registry import SAMPLED_KINDS
from mechsearch_jax.actions.types import Candidates
from mechsearch_jax.actions.unseen_space import PossibleSpace
from mechsearch_jax.geometry.bodies import part_at, world_parts
from mechsearch_jax.geometry.collision import Clouds, collisions
from mechsearch_jax.geometry.footprints import footprints
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.robot.entry import WaysIn, gripper_enters

# The candidates of every sampled kind, in the order of `SAMPLED_KINDS`.
AllCandidates = tuple[Candidates, ...]


def no_candidates(space: ActionSpace, capacity: int) -> AllCandidates:
    """The candidates of `capacity` objects before any evaluation: none is feasible."""

    def empty(kind: SampledKind) -> Candidates:
        n, v, d = capacity, len(kind.wrists(space)), kind.distances(space)
        return Candidates(
            T_world_gripper=jnp.zeros((n, v, 4, 4)),
            weight=jnp.zeros((n, v)),
            reached=jnp.zeros((n, v, d), bool),
            hits=jnp.zeros((n, v, n), bool),
            enters=jnp.zeros((n, v, d), bool),
        )

    return tuple(empty(kind) for kind in SAMPLED_KINDS)


def all_candidates(
    space: ActionSpace,
    scene: Superquadrics,
    possible: PossibleSpace,
    previous: AllCandidates | None = None,
    moved: Bool[Array, " n"] | None = None,
    available: Bool[Array, "*kinds n"] | None = None,
) -> AllCandidates:
    """Propose and test all candidate actions for all objects.

    Approaches of all kinds are tested in one batch: those of the first kind to all objects, then those of the next.

    Args:
      space: what all actions share.
      scene: the objects, fields (N, ...).
      possible: where the target may be.
      previous: the candidates before objects moved; only what concerns the `moved` objects is computed anew.
      moved: which objects moved since.
      available: which objects may be moved, by all kinds alike or by each of `SAMPLED_KINDS`; default all. `enters` is
        computed for these only.
    """
    n = scene.capacity
    previous = no_candidates(space, n) if previous is None else previous
    fresh = scene.valid if moved is None else moved & scene.valid
    concerns = fresh[:, None] | fresh[None, :]
    tested_pairs = concerns & scene.valid[:, None] & scene.valid[None, :]
    proposed = _proposed(space, scene, previous, fresh)
    T_world_gripper, _, cloud = proposed.approaches
    clouds = gripper_clouds(space.tables)
    near = gripper_enters(
        space.shelf, space.gripper, space.waypoints, clouds.points, proposed.approaches, proposed.wanted
    )

    reached, against = [], []
    for kind, before, T, part in zip(SAMPLED_KINDS, previous, proposed.T_world_gripper, proposed.parts, strict=True):
        travels = kind.travels(space, T_world_gripper[part], near[part]).reshape(*T.shape[:2], -1)
        if kind.surrounds_object and scene.parts is not None:
            tested = jnp.any(travels & fresh[:, None, None], axis=-1)
            travels &= ~_meets_own_parts(scene, clouds, cloud[part], T, tested)[..., None]
        reached.append(jnp.where(fresh[:, None, None], travels, before.reached))
        obstacles = tested_pairs & ~jnp.eye(n, dtype=bool) if kind.surrounds_object else tested_pairs
        owner = np.repeat(np.arange(n), T.shape[1])
        against.append(obstacles[owner] & jnp.any(reached[-1], axis=-1).reshape(-1)[:, None])
    mask = jnp.concatenate(against)
    by_hand = collisions(clouds, cloud, T_world_gripper, scene, mask)

    able = jnp.broadcast_to(True if available is None else available, (len(SAMPLED_KINDS), n))
    tested = []
    for i, (kind, before) in enumerate(zip(SAMPLED_KINDS, previous, strict=True)):
        T, weight, part = proposed.T_world_gripper[i], proposed.weight[i], proposed.parts[i]
        hits = by_hand[part]
        hits |= kind.swept_hits(space, scene, T_world_gripper[part], mask[part] & ~hits)
        hits = jnp.where(concerns[:, None, :], hits.reshape(*T.shape[:2], n), before.hits)
        candidates = Candidates(T, weight, reached[i], hits, before.enters)
        usable = candidates.replace(reached=reached[i] & able[i][:, None, None])
        tested.append(candidates.replace(enters=kind.entering(space, scene, possible, usable)))
    return tuple(tested)


def _meets_own_parts(
    scene: Superquadrics,
    clouds: Clouds,
    cloud: Int[Array | np.ndarray, " k"],
    T: Float[Array, "n v 4 4"],
    tested: Bool[Array, "n v"],
) -> Bool[Array, "n v"]:
    """Which grasps of bodies hit a part of the same body, other than the one between the fingers.

    Args:
      scene: the bodies, with parts.
      clouds: that the gripper sweeps.
      cloud: index of the cloud of each of the K = N V grasps.
      T: poses of the gripper.
      tested: which grasps are tested; the result is False for the others.
    """
    (n, v), shapes = tested.shape, world_parts(scene)
    owner, T = np.repeat(np.arange(n), v), T.reshape(-1, 4, 4)
    held = jax.vmap(lambda i, point: part_at(scene, i, point))(jnp.asarray(owner), T[:, :3, 3])
    p = shapes.capacity // n
    part = np.arange(n * p)
    mask = (part[None] // p == owner[:, None]) & (part[None] % p != held[:, None]) & shapes.valid[None]
    hits = collisions(clouds, cloud, T, shapes, mask & tested.reshape(-1, 1))
    return jnp.any(hits, axis=1).reshape(n, v)


class _Proposed(NamedTuple):
    """Candidates before any test: lists by kind, and arrays over the K candidates of all kinds together.

    Attributes:
      T_world_gripper, weight: as in `Candidates`, by kind.
      parts: slice of the K candidates that belong to each kind.
      approaches: the straight way in, for each of the K.
      wanted: which of the K are tested, shape (K,).
    """

    T_world_gripper: list[Float[Array, "n _ 4 4"]]
    weight: list[Float[Array, "n _"]]
    parts: list[slice]
    approaches: WaysIn
    wanted: Bool[Array, " k"]


def _proposed(space: ActionSpace, scene: Superquadrics, previous: AllCandidates, fresh: Bool[Array, " n"]) -> _Proposed:
    """Propose candidates for the fresh objects; the other objects keep their previous ones."""
    n, prints = scene.capacity, footprints(scene)
    poses, weights, wanted, wrists, openings, parts = [], [], [], [], [], []
    first = 0
    for kind, before in zip(SAMPLED_KINDS, previous, strict=True):
        T, weight = kind.propose(space, scene, prints, fresh)
        poses.append(jnp.where(fresh[:, None, None, None], T, before.T_world_gripper))
        weights.append(jnp.where(fresh[:, None], weight, before.weight))
        wanted.append(((weight > 0.0) & (kind.name in space.config.actions) & fresh[:, None]).reshape(-1))
        count = n * T.shape[1]
        wrists.append(np.tile(kind.wrists(space), n))
        openings.append(np.full(count, kind.opening))
        parts.append(slice(first, first + count))
        first += count
    opening, wrist = np.concatenate(openings), np.concatenate(wrists)
    approaches = WaysIn(
        jnp.concatenate([T.reshape(-1, 4, 4) for T in poses]),
        space.tables.q7[opening, wrist],
        cloud_index(space.tables, opening, wrist),
    )
    return _Proposed(poses, weights, parts, approaches, jnp.concatenate(wanted))


def free_candidates(candidates: Candidates) -> Bool[Array, "n v d"]:
    """Which candidates are reachable and hit no object."""
    return candidates.reached & ~jnp.any(candidates.hits, axis=-1)[..., None]
