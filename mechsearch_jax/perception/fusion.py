"""Keep what an earlier look recognised better, where the image of this look agrees.

A look may see less of a thing than the one before it, or take two things for one, and then its shape is wrong. A body
is rigid, and mostly stands where it stood: so each object of the last look enters the explanation of this one's image
as it was, and fitted to this image with its size kept. It takes the place of the objects whose pixels lie on it where
it was recognised more surely than they are, and explains the image as well: the same points, and no more rays through
it. What was moved, and so does not lie where it lay, is rejected by points and rays, not by what was planned.

What this image does not show, since something stands before it, is taken to stand where it stood.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Key

from mechsearch_jax.geometry.superquadric import Superquadrics, standard_edges
from mechsearch_jax.geometry.transforms import yaw_rotation
from mechsearch_jax.images.detection import steady_pose
from mechsearch_jax.images.labels import OTHER
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.explanation import ExplanationConfig, Fitted
from mechsearch_jax.perception.recognition import LabelledImage
from mechsearch_jax.perception.refinement import RefinementConfig, refine
from mechsearch_jax.perception.scores import EDGE
from mechsearch_jax.perception.selection import Costs, explanation_cost, passed, point_cost, sample_of
from mechsearch_jax.perception.solids import entries, penetrations, surface_distance
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target
from mechsearch_jax.workspace.target_view import main_body

# Exponents of fits, whose edges are nearly sharp.
SHARP = 0.03
# A remembered object is fitted to the pixels of the objects whose centres are so near to its own [m].
NEAR = 0.06
# With its size kept, and its height to this [m].
LEVEL = 0.015
RIGID = RefinementConfig(
    hypotheses=(), size_prior=0.002, position_prior=0.02, yaw_prior=0.2, stages=((8, 0.008), (12, 0.003))
)
# It may explain so many pixels fewer, and this share of those of the objects whose place it takes.
SLACK, SLACK_SHARE = 8.0, 0.12
# It has to have been surer by this.
SURER = 0.05
# Of a slot without an object.
ABSENT = -1
COSTS = ExplanationConfig()


@cached_jit(static_argnames=("target", "costs"))
def fused(
    key: Key[Array, ""],
    fitted: Fitted,
    before: Observation,
    image: LabelledImage,
    visible: Bool[Array, ""],
    camera: Camera,
    shelf: Shelf,
    target: Target,
    costs: Costs = COSTS,
) -> Fitted:
    """What was made of an image, with objects of an earlier look where they are better supported.

    Args:
      key: of the points drawn from the image.
      fitted: what was made of the image alone; objects without parts.
      before: an earlier look, its objects where they are expected now, with their confidence. A visible target is taken
        to stand where it stood, if the image agrees.
      image: which was fitted.
      visible: whether it shows the target.
      camera, shelf: of the image; they may be traced.
      target, costs: static.

    Returns:
      The objects, with the confidence that they were recognised with, and the pixels of those whose place they take.
      Hidden ones are in slots that this image alone leaves free, their own if it can be.
      `measures` stay those of the image alone.
    """
    slots, now, was, sure = (
        fitted.objects.capacity,
        fitted.objects,
        before.objects,
        jnp.asarray(before.judged().confidence),
    )
    image = image.replace(labels=fitted.labels)
    flat, labels = image.points.reshape(-1, 3), fitted.labels.reshape(-1)
    sample = sample_of(key, image, now, camera, shelf, costs)
    seen = target, shelf, camera, image.points, image.depth, image.of_target
    steady = steady_pose(key, *seen, fitted.target_pose, before.target_pose)
    x, y, yaw = pose = jnp.where(visible & before.target_visible, steady, fitted.target_pose)
    place = jnp.stack([x, y, jnp.float32(target.height(shelf))])
    body = main_body(target, place[None], yaw_rotation(yaw)[None], visible[None])

    # Fitted to the pixels of what is near.
    apart = jnp.linalg.norm((now.position[:, None] - was.position[None])[..., :2], axis=-1)
    apart = jnp.where(was.valid[None] & now.valid[:, None], apart, jnp.inf)
    nearest = jnp.where(jnp.min(apart, axis=1) < NEAR, jnp.argmin(apart, axis=1), OTHER)
    owner = jnp.where(labels >= 0, nearest[jnp.clip(labels, 0, slots - 1)], labels).astype(jnp.int8)
    sharp = was.replace(exponents=jnp.where(was.exponents > EDGE, was.exponents, SHARP))
    moved = refine(camera, shelf, sharp, flat, owner, image.depth, RIGID).scene
    # Where a top is lower than it was, a fit sinks into the board.
    level = jnp.abs(moved.position[:, 2] - was.position[:, 2]) < LEVEL
    moved = moved.replace(valid=moved.valid & level)

    known: Superquadrics = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), was, moved)
    everything: Superquadrics = jax.tree.map(lambda *a: jnp.concatenate(a), now, known, body)
    off = point_cost(surface_distance(everything, sample.points), sample, costs)
    of_now = sample.label[None] == jnp.arange(slots)[:, None]
    pixels = jnp.sum(of_now, axis=1) * sample.weight
    on_it = jnp.einsum("np,kp->nk", of_now.astype(jnp.float32), 1.0 - off[slots:-1])
    share = on_it / jnp.maximum(jnp.sum(of_now, axis=1), 1)[:, None]
    cost = jnp.where(everything.valid[:, None], off, 1.0)
    price = jnp.where(jnp.arange(everything.capacity) == everything.capacity - 1, 0.0, costs.object)
    price = price + passed(everything, sample, costs)
    depth = penetrations(everything)
    overlap = costs.overlap_cost * 100.0 * jnp.maximum(depth - costs.overlap, 0.0)
    table = (cost, price, overlap, sample.weight)
    order, index = jnp.argsort(-sure, stable=True), jnp.arange(everything.capacity)

    def consider(turn, state):
        selected, source, goes_to = state
        r = order[turn]

        def instead(k):
            """What an object replaces, the explanation with it, and by how many pixels that is worse than may be."""
            removed = selected[:slots] & now.valid & (share[:, k] > 0.5)
            after = (selected & ~jnp.pad(removed, (0, everything.capacity - slots))) | (index == slots + k)
            slack = SLACK + SLACK_SHARE * jnp.sum(jnp.where(removed, pixels, 0.0))
            surer = jnp.max(jnp.where(removed, fitted.confidence, 0.0)) + SURER < sure[r]
            worse = explanation_cost(table, after) - explanation_cost(table, selected) - slack
            return removed, after, jnp.where(known.valid[k] & jnp.any(removed) & surer, worse, jnp.inf)

        both = jax.vmap(instead)(jnp.stack([r, r + slots]))
        best = jnp.argmin(both[2])
        removed, after, worse = jax.tree.map(lambda a: a[best], both)
        taken, place = worse <= 0.0, jnp.argmax(jnp.where(removed, pixels, -1.0))
        source = jnp.where(removed & taken, jnp.where(index[:slots] == place, slots + r + best * slots, ABSENT), source)
        return jnp.where(taken, after, selected), source, jnp.where(removed & taken, place, goes_to)

    start = everything.valid & ((index < slots) | (index == everything.capacity - 1))
    source, goes_to = jnp.where(now.valid, index[:slots], ABSENT), index[:slots]
    selected, source, goes_to = jax.lax.fori_loop(0, slots, consider, (start, source, goes_to))

    # Hidden: few rays pass through it, and it is not in what is seen there, which then is the same thing.
    met = jnp.sum(jnp.isfinite(entries(was, sample.origin, sample.directions)), axis=1) * sample.ray_weight
    through = price[slots : 2 * slots] - costs.object
    apart = jnp.where(selected[None], depth[slots : 2 * slots], -jnp.inf)
    kept = selected[slots : 2 * slots]
    hidden = was.valid & ~kept & (through <= SLACK + SLACK_SHARE * met) & (jnp.max(apart, axis=1) <= costs.overlap)

    def remember(turn, source):
        r, free = order[turn], source == ABSENT
        place = jnp.where(free[r], r, jnp.argmax(free))
        return jnp.where(hidden[r] & free & (index[:slots] == place), slots + r, source)

    source = jax.lax.fori_loop(0, slots, remember, source)
    # What is replaced stays in its slot as an absent one.
    row = jnp.where(source == ABSENT, index[:slots], source)
    objects = jax.tree.map(lambda a: a[row], everything)
    objects = standard_edges(objects.replace(valid=source != ABSENT))
    confidence = jnp.concatenate([fitted.confidence, sure, sure])[row]
    labels = jnp.where(labels >= 0, goes_to[jnp.clip(labels, 0, slots - 1)], labels)
    return fitted.replace(
        objects=objects,
        target_pose=pose,
        confidence=jnp.where(objects.valid, confidence, 0.0),
        labels=labels.reshape(fitted.labels.shape).astype(fitted.labels.dtype),
        changed=fitted.changed | (source >= slots),
    )
