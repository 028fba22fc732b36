"""The candidate actions of a scene, and how one of them is drawn (paper appendix B.5)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from mechsearch_jax.actions.approach import cloud_index, gripper_clouds
from mechsearch_jax.actions.config import ActionSpace
from mechsearch_jax.actions.kind import SampledKind
from mechsearch_jax.actions.registry import SAMPLED_KINDS, ActionKind
from mechsearch_jax.actions.stacks import stacks
from mechsearch_jax.actions.types import Candidates, DrawnCandidate, Sample
from mechsearch_jax.actions.unseen_space import PossibleSpace, touch_probability
from mechsearch_jax.geometry.bodies import part_at, surface_of, world_parts
from mechsearch_jax.geometry.collision import Clouds, collisions
from mechsearch_jax.geometry.footprints import Footprints, footprints
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import transform
from mechsearch_jax.robot.entry import WaysIn, gripper_enters

# The candidates of every sampled kind, in the order of `SAMPLED_KINDS`.
AllCandidates = tuple[Candidates, ...]
# Number of objects for which random numbers are drawn at a time: a scene's eight, and the target in the last slot.
BLOCK = 9


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
    Every action on an object counts as hitting what the object carries, and what does not stand on the board is not
    pushed.

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
    prints = footprints(scene)
    carries, aloft = stacks(space, prints)
    proposed = _proposed(space, scene, prints, aloft, previous, fresh)
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
        hits |= carries[:, None]
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


def _proposed(
    space: ActionSpace,
    scene: Superquadrics,
    prints: Footprints,
    aloft: Bool[Array, " n"],
    previous: AllCandidates,
    fresh: Bool[Array, " n"],
) -> _Proposed:
    """Propose candidates for the fresh objects; the other objects keep their previous ones."""
    n = scene.capacity
    poses, weights, wanted, wrists, openings, parts = [], [], [], [], [], []
    first = 0
    for kind, before in zip(SAMPLED_KINDS, previous, strict=True):
        T, weight = kind.propose(space, scene, prints, fresh)
        weight = weight if kind.holds_object else jnp.where(aloft[:, None], 0.0, weight)
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


def _gumbel(key: Array, kinds: int, capacity: int, width: int) -> Float[Array, "kinds capacity width"]:
    """Gumbel noise for the candidates of all objects and kinds; an object's noise does not depend on the capacity.

    The last slot, which may hold the target, always has the noise of the last slot of the first `BLOCK`.
    """
    blocks = math.ceil(capacity / BLOCK)
    keys = [key, *(jax.random.fold_in(key, i) for i in range(1, blocks))]
    drawn = [jax.random.gumbel(k, (kinds * BLOCK * width,)).reshape(kinds, BLOCK, width) for k in keys]
    if capacity == BLOCK:
        return drawn[0]
    all_but_last = jnp.concatenate([drawn[0][:, :-1], *drawn[1:]], axis=1)[:, : capacity - 1]
    return jnp.concatenate([all_but_last, drawn[0][:, -1:]], axis=1)


def _choose(weight: Float[Array, " w"], gumbel: Float[Array, " w"]) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """Draw an index in proportion to weights from Gumbel noise; also whether any weight is positive."""
    logits = jnp.where(weight > 0, jnp.log(jnp.where(weight > 0, weight, 1.0)), -jnp.inf)
    return jnp.argmax(logits + gumbel), jnp.any(weight > 0)


def _shares(preferred, free, weight):
    """Share of each candidate in its object: 1 in all by weight, among the preferred, or among all free if none is."""
    usable = jnp.where(jnp.any(preferred, axis=-1, keepdims=True), preferred, free) * weight
    total = jnp.sum(usable, axis=-1, keepdims=True)
    return usable / jnp.where(total > 0.0, total, 1.0)


def _stacked(rows: Sequence[Shaped[Array, "n _ _"]]) -> Shaped[Array, "rows width"]:
    """Rows of candidates, one row for each kind and object, padded to the same width."""
    width = max(a.shape[1] * a.shape[2] for a in rows)
    flat = [a.reshape(a.shape[0], -1) for a in rows]
    return jnp.concatenate([jnp.pad(a, ((0, 0), (0, width - a.shape[1]))) for a in flat])


def sample_action(
    key: Array,
    space: ActionSpace,
    scene: Superquadrics,
    possible: PossibleSpace,
    all_candidates: AllCandidates,
    available: Bool[Array, "*kinds n"],
    weights: Float[Array, " n"] | None = None,
    wanted: Bool[Array, ""] | bool = True,
) -> Sample:
    """Draw an action: object and kind (the multi-set of B.5) by the object's weight, then a candidate by its own.

    Args:
      key: PRNG key.
      space: what all actions share.
      scene: the objects.
      possible: where the target may be. Candidates that enter it are drawn only if their object has no others.
      all_candidates: the candidates of this scene.
      available: which objects may be moved, by all kinds alike or by each of `SAMPLED_KINDS`.
      weights: sampling weights of the objects, positive; equal if left out, as in the paper.
      wanted: whether the action is used; if not, it is of kind NONE, and little is computed.
    """
    n = scene.capacity
    key_choice, key_place = jax.random.split(key)
    able = jnp.broadcast_to(available, (len(SAMPLED_KINDS), n))
    free = _stacked([free_candidates(c) & a[:, None, None] for c, a in zip(all_candidates, able, strict=True)])
    enters = _stacked([c.enters for c in all_candidates])
    within = _stacked([jnp.broadcast_to(c.weight[..., None], c.reached.shape) for c in all_candidates])
    weights = jnp.ones(n) if weights is None else weights
    weight = jnp.tile(weights, len(SAMPLED_KINDS))[:, None] * _shares(free & ~enters, free, within)
    gumbel = _gumbel(key_choice, len(SAMPLED_KINDS), n, free.shape[1])
    choice, any_possible = _choose(weight.reshape(-1), gumbel.reshape(-1))
    wanted = any_possible & wanted
    row, number = choice // free.shape[1], choice % free.shape[1]
    drawn_kind, index = row // n, row % n

    drafts = [
        kind.draft(key_place, space, scene, possible, c, DrawnCandidate(index, number, wanted & (drawn_kind == i)))
        for i, (kind, c) in enumerate(zip(SAMPLED_KINDS, all_candidates, strict=True))
    ]
    draft = drafts[-1]
    for i in reversed(range(len(drafts) - 1)):
        draft = jax.tree.map(lambda a, b, i=i: jnp.where(drawn_kind == i, a, b), drafts[i], draft)
    executable, sample = draft
    kind = jnp.where(wanted & executable, sample.action.kind, ActionKind.NONE).astype(jnp.int32)
    return sample.replace(action=sample.action.replace(kind=kind))


def contact_probability(
    space: ActionSpace, scene: Superquadrics, possible: PossibleSpace, sample: Sample
) -> Float[Array, "2"]:
    """Share of the possible poses at which a sampled action would touch the target, 0 if no pose is possible; and 1 if
    it enters space that was not measured, else 0.

    Args:
      space: what all actions share.
      scene: the objects for which the action was sampled.
      possible: where the target may be.
      sample: the action.
    """
    if sample.grippers is None or sample.bodies is None:
        return jnp.zeros(2)
    action = sample.action
    opening = jnp.select([action.kind == kind.code for kind in SAMPLED_KINDS], [k.opening for k in SAMPLED_KINDS])
    body = surface_of(scene, action.object, space.config.object_points)
    gripper = space.tables.clouds[opening, sample.wrist].T
    swept = jnp.concatenate(
        [transform(sample.grippers[:, None], gripper[None]), transform(sample.bodies[:, None], body[None])], axis=1
    )
    return jnp.where(action.kind == ActionKind.NONE, 0.0, touch_probability(possible, swept))
