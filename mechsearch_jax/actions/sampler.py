"""How actions are sampled (paper appendix B.5)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from mechsearch_jax.actions.config import ActionSpace
from mechsearch_jax.actions.registry import SAMPLED_KINDS, ActionKind
from mechsearch_jax.actions.types import DrawnWay, Sample
from mechsearch_jax.actions.unseen_space import PossibleSpace, touch_probability
from mechsearch_jax.actions.ways import AllWays, free_ways
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import transform

# Random numbers are drawn for so many objects at a time: a scene's eight and the target, which is the last of a scene.
BLOCK = 9


def _numbers(key: Array, kinds: int, capacity: int, width: int) -> Float[Array, "kinds capacity width"]:
    """Random numbers (Gumbel) of all ways of all objects by all kinds; an object's do not depend on the capacity.

    The last object of a scene, which may be the target, has those of the last of the first `BLOCK`.
    """
    blocks = math.ceil(capacity / BLOCK)
    keys = [key, *(jax.random.fold_in(key, i) for i in range(1, blocks))]
    drawn = [jax.random.gumbel(k, (kinds * BLOCK * width,)).reshape(kinds, BLOCK, width) for k in keys]
    if capacity == BLOCK:
        return drawn[0]
    others = jnp.concatenate([drawn[0][:, :-1], *drawn[1:]], axis=1)[:, : capacity - 1]
    return jnp.concatenate([others, drawn[0][:, -1:]], axis=1)


def _choose(weight: Float[Array, " w"], numbers: Float[Array, " w"]) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """A random index in proportion to weights, from random numbers, and whether any weight is positive."""
    logits = jnp.where(weight > 0, jnp.log(jnp.where(weight > 0, weight, 1.0)), -jnp.inf)
    return jnp.argmax(logits + numbers), jnp.any(weight > 0)


def _shares(clean, dirty, weight):
    """One for every object that has an action, shared by weight among its clean ones, or the others in need."""
    usable = jnp.where(jnp.any(clean, axis=-1, keepdims=True), clean, dirty) * weight
    total = jnp.sum(usable, axis=-1, keepdims=True)
    return usable / jnp.where(total > 0.0, total, 1.0)


def _stacked(rows: Sequence[Shaped[Array, "n _ _"]]) -> Shaped[Array, "rows width"]:
    """The ways of all objects by all kinds, padded to the same number."""
    width = max(a.shape[1] * a.shape[2] for a in rows)
    flat = [a.reshape(a.shape[0], -1) for a in rows]
    return jnp.concatenate([jnp.pad(a, ((0, 0), (0, width - a.shape[1]))) for a in flat])


def sample_action(
    key: Array,
    space: ActionSpace,
    scene: Superquadrics,
    possible: PossibleSpace,
    all_ways: AllWays,
    available: Bool[Array, "*kinds n"],
    weights: Float[Array, " n"] | None = None,
) -> Sample:
    """Draw an action: an object and a kind (the multi-set of B.5) by the object's weight, then a way by its own.

    Args:
      key: PRNG key.
      space: what all actions share.
      scene: the objects.
      possible: where the target may be. An object's actions that enter it are drawn only if it has no others.
      all_ways: the ways to move the objects of this scene.
      available: which objects may be moved, by all kinds alike or by each of `SAMPLED_KINDS`.
      weights: sampling weights of the objects, positive; the paper's, and those left out, are equal.
    """
    n = scene.capacity
    key_choice, key_place = jax.random.split(key)
    able = jnp.broadcast_to(available, (len(SAMPLED_KINDS), n))
    ways = _stacked([free_ways(w) & a[:, None, None] for w, a in zip(all_ways, able, strict=True)])
    enters = _stacked([w.enters for w in all_ways])
    beside = _stacked([jnp.broadcast_to(w.weight[..., None], w.reached.shape) for w in all_ways])
    weights = jnp.ones(n) if weights is None else weights
    weight = jnp.tile(weights, len(SAMPLED_KINDS))[:, None] * _shares(ways & ~enters, ways, beside)
    numbers = _numbers(key_choice, len(SAMPLED_KINDS), n, ways.shape[1])
    choice, possible_at_all = _choose(weight.reshape(-1), numbers.reshape(-1))
    row, way = choice // ways.shape[1], choice % ways.shape[1]
    chosen, index = row // n, row % n

    drafts = [
        kind.draft(key_place, space, scene, possible, w, DrawnWay(index, way, possible_at_all & (chosen == i)))
        for i, (kind, w) in enumerate(zip(SAMPLED_KINDS, all_ways, strict=True))
    ]
    draft = drafts[-1]
    for i in reversed(range(len(drafts) - 1)):
        draft = jax.tree.map(lambda a, b, i=i: jnp.where(chosen == i, a, b), drafts[i], draft)
    able = possible_at_all & draft.possible
    kind = jnp.where(able, draft.action.kind, ActionKind.NONE).astype(jnp.int32)
    return Sample(draft.action.replace(kind=kind), draft.wrist, draft.grippers, draft.bodies)


def contact_probability(
    space: ActionSpace, scene: Superquadrics, possible: PossibleSpace, sample: Sample
) -> Float[Array, ""]:
    """Share of the possible poses at which a sampled action would touch the target; 0 where none is possible.

    Args:
      space: what all actions share.
      scene: the objects that the action was sampled for.
      possible: where the target may be.
      sample: the action.
    """
    if sample.grippers is None or sample.bodies is None:
        return jnp.float32(0.0)
    action = sample.action
    opening = jnp.select([action.kind == kind.code for kind in SAMPLED_KINDS], [k.opening for k in SAMPLED_KINDS])
    size, exponents = scene.size[action.object], scene.exponents[action.object]
    body = superquadric.sample_surface(size, exponents, space.config.object_points)
    gripper = space.tables.clouds[opening, sample.wrist].T
    swept = jnp.concatenate(
        [transform(sample.grippers[:, None], gripper[None]), transform(sample.bodies[:, None], body[None])], axis=1
    )
    return jnp.where(action.kind == ActionKind.NONE, 0.0, touch_probability(possible, swept))
