"""How actions are sampled (paper appendix B.5)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from mechsearch_jax.actions.candidates import AllCandidates, free_candidates
from mechsearch_jax.actions.config import ActionSpace
from mechsearch_jax.actions.registry import SAMPLED_KINDS, ActionKind
from mechsearch_jax.actions.types import DrawnCandidate, Sample
from mechsearch_jax.actions.unseen_space import PossibleSpace, touch_probability
from mechsearch_jax.geometry.bodies import surface_of
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import transform

# Number of objects for which random numbers are drawn at a time: a scene's eight, and the target in the last slot.
BLOCK = 9


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
    row, number = choice // free.shape[1], choice % free.shape[1]
    drawn_kind, index = row // n, row % n

    drafts = [
        kind.draft(
            key_place, space, scene, possible, c, DrawnCandidate(index, number, any_possible & (drawn_kind == i))
        )
        for i, (kind, c) in enumerate(zip(SAMPLED_KINDS, all_candidates, strict=True))
    ]
    draft = drafts[-1]
    for i in reversed(range(len(drafts) - 1)):
        draft = jax.tree.map(lambda a, b, i=i: jnp.where(drawn_kind == i, a, b), drafts[i], draft)
    executable = any_possible & draft.possible
    kind = jnp.where(executable, draft.action.kind, ActionKind.NONE).astype(jnp.int32)
    return Sample(draft.action.replace(kind=kind), draft.wrist, draft.grippers, draft.bodies)


def contact_probability(
    space: ActionSpace, scene: Superquadrics, possible: PossibleSpace, sample: Sample
) -> Float[Array, ""]:
    """Share of the possible poses at which a sampled action would touch the target; 0 if no pose is possible.

    Args:
      space: what all actions share.
      scene: the objects for which the action was sampled.
      possible: where the target may be.
      sample: the action.
    """
    if sample.grippers is None or sample.bodies is None:
        return jnp.float32(0.0)
    action = sample.action
    opening = jnp.select([action.kind == kind.code for kind in SAMPLED_KINDS], [k.opening for k in SAMPLED_KINDS])
    body = surface_of(scene, action.object, space.config.object_points)
    gripper = space.tables.clouds[opening, sample.wrist].T
    swept = jnp.concatenate(
        [transform(sample.grippers[:, None], gripper[None]), transform(sample.bodies[:, None], body[None])], axis=1
    )
    return jnp.where(action.kind == ActionKind.NONE, 0.0, touch_probability(possible, swept))
