"""Other segments than the network's: parts of doubtful ones, unions of bordering ones, and objects fitted to them."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.geometry.masked import masked_vmap, on_cpu
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.images.cloud import numbered
from mechsearch_jax.images.labels import MISSING
from mechsearch_jax.perception.recognition import LabelledImage, ShapeNetwork, recognise_with_error
from mechsearch_jax.perception.refinement import RefinementConfig, refine, select
from mechsearch_jax.perception.rough_shapes import SHAPES, rough_shapes
from mechsearch_jax.perception.solids import surface_distance
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

# Ways in which a segment is divided: see `parts`.
WAYS = 3
# Ways whose parts differ in less than this share of the segment's pixels are one.
_ALIKE = 0.05
# An object with a larger misfit is also fitted around its points, and that one is taken if its misfit is so many times
# as large; how far its centre may be from the true one [m].
DOUBTFUL, BETTER, ROUGH_ERROR = 0.06, 0.7, 0.01
ROUGH = RefinementConfig.rough(hypotheses=(), stages=((6, 0.01), (10, 0.004)))
# A thing stands on another if more than the first share of its points are over the other, and less than the second
# beneath its top, which is higher than such a share of its points, by more than this [m].
OVER, BENEATH, TOP, UNEVEN = 0.3, 0.05, 0.97, 0.012


def connected(points: Float[Array, "h w 3"], labels: Int[Array, "h w"], jump: float) -> Int[Array, "h w"]:
    """A number for each pixel, the same for connected pixels of a segment."""

    def near(axis):
        apart = jnp.linalg.norm(jnp.diff(points, axis=axis), axis=-1)
        first, second = (jax.lax.slice_in_dim(labels, i, labels.shape[axis] - 1 + i, axis=axis) for i in (0, 1))
        return (first == second) & (apart < jump)

    return numbered(near(0), near(1))


def _two_means(points: Float[Array, "p 3"], member: Bool[Array, " p"]) -> Bool[Array, " p"]:
    """Which points of a segment are nearer to the second of two centres, seen from above."""
    level = jnp.where(member[:, None], points[:, :2], 0.0)
    weight = member.astype(jnp.float32)
    mean = jnp.sum(level, axis=0) / jnp.maximum(jnp.sum(weight), 1.0)
    offset = (level - mean[None]) * weight[:, None]
    spread = jnp.einsum("pi,pj->ij", offset, offset, precision="highest")
    angle = 0.5 * jnp.arctan2(2.0 * spread[0, 1], spread[0, 0] - spread[1, 1])
    axis = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    side = offset[:, 0] * axis[0] + offset[:, 1] * axis[1]

    def assign(_, cut):
        def middle(chosen):
            return jnp.sum(jnp.where(chosen, side, 0.0)) / jnp.maximum(jnp.sum(chosen), 1)

        return (middle(member & (side > cut)) + middle(member & (side <= cut))) / 2.0

    return member & (side > jax.lax.fori_loop(0, 8, assign, jnp.float32(0.0)))


def parts(
    image: LabelledImage, base: Superquadrics, chosen: Int[Array, " k"], near: Array, jump: float
) -> Bool[Array, "k ways h w"]:
    """First parts of segments in each way of division: the points that are on the fitted object; the largest connected
    piece; the points on one side of a vertical plane."""
    shape = image.labels.shape
    numbers = connected(image.points, image.labels, jump).reshape(-1)
    flat = jnp.where((image.labels == MISSING).reshape(-1, 1), 0.0, image.points.reshape(-1, 3))
    labels = image.labels.reshape(-1)

    def divide(slot):
        member = labels == slot
        solid = jax.tree.map(lambda a: a[slot][None], base)
        on_it = member & (jnp.abs(surface_distance(solid, flat)[0]) < near)
        sizes = jnp.zeros(labels.size, jnp.int32).at[numbers].add(member.astype(jnp.int32))
        piece = member & (numbers == jnp.argmax(sizes))
        return jnp.stack([on_it, piece, _two_means(flat, member)]).reshape(WAYS, *shape)

    return jax.lax.map(divide, chosen)


def distinct(first: Bool[Array, "k ways h w"], pixels: Int[Array, " k"]) -> Bool[Array, "k ways"]:
    """Which ways of division differ from all the ways before them.

    Args:
      first: as of `parts`.
      pixels: number of pixels of each segment.
    """
    flat = first.reshape(*first.shape[:2], first.shape[2] * first.shape[3])
    differ = jnp.sum(flat[:, :, None] != flat[:, None], axis=-1)
    # Which of the parts is the first does not matter.
    differ = jnp.minimum(differ, pixels[:, None, None] - differ)
    alike = differ < _ALIKE * pixels[:, None, None]
    return ~jnp.any(jnp.tril(alike, -1), axis=-1)


def bordering(points: Float[Array, "h w 3"], labels: Int[Array, "h w"], jump: float, count: int) -> Float[Array, "n n"]:
    """Number of neighbouring pixels of every two of `count` segments whose points are near; each pair once, above the
    diagonal."""
    total = jnp.zeros((count, count))
    for axis in (0, 1):
        apart = jnp.linalg.norm(jnp.diff(points, axis=axis), axis=-1)
        size = labels.shape[axis]
        first, second = (
            jax.lax.slice_in_dim(labels, i, size - 1 + i, axis=axis).reshape(-1).astype(jnp.int32) for i in (0, 1)
        )
        close = (apart.reshape(-1) < jump) & (first >= 0) & (second >= 0) & (first != second)
        low, high = jnp.minimum(first, second), jnp.maximum(first, second)
        pair = jnp.where(close, low * count + high, 0)
        total = total + jnp.zeros(count * count).at[pair].add(close * 1.0).reshape(count, count)
    return total


class Fits(PyTreeNode):
    """Objects fitted to masks.

    Attributes:
      objects: one for each mask.
      error: how far the network expects each centre to be from the true one, shape (C,) [m].
      misfit: see `Refined`, shape (C,).
    """

    objects: Superquadrics
    error: jax.Array
    misfit: jax.Array


def fitted(
    key: Array,
    image: LabelledImage,
    masks: Bool[Array, "c h w"],
    active: Bool[Array, " c"],
    boards: Float[Array, " c"],
    shapes: ShapeNetwork,
    camera: Camera,
    shelf: Shelf,
    refinement: RefinementConfig,
) -> Fits:
    """The object of every mask that is active: the network's, refined.

    The objects of other masks are not valid.

    Args:
      key: of the points drawn from the image.
      image: of the camera.
      masks, active: the pixels of each object, and which are fitted.
      boards: height of what each stands on: it is recognised like an object on a board at that height [m].
      shapes: the network.
      camera, shelf: of the image.
      refinement: static.
    """
    network = shapes.network

    def fit(shared, element, row):
        parameters, camera, shelf = shared
        points, depth, labels = element
        mask, board, seed = row
        alone, shelf = _alone(labels, mask), dataclasses.replace(shelf, board=board)
        key = jax.random.key(seed)
        scene, error = recognise_with_error(key, network, parameters, camera, points, alone, shelf, 1)
        refined = refine(camera, shelf, scene, points.reshape(-1, 3), alone.reshape(-1), depth, refinement)
        return jax.tree.map(lambda a: a[0], Fits(refined.scene, error, refined.misfit))

    seeds = jax.random.bits(key, (masks.shape[0],), jnp.uint32)
    shared, element = (shapes.parameters, camera, shelf), (image.points, image.depth, image.labels)
    # On a CPU, the network and the refinement are the faster the fewer segments they get at once; on a GPU, the more,
    # up to the few that a batch of images still has in the second turn.
    block = 1 if on_cpu() else 2
    fits = masked_vmap(fit, active, shared, element, (masks, boards, seeds), block=block)
    objects = fits.objects.replace(
        valid=fits.objects.valid & active, size=jnp.where(active[:, None], fits.objects.size, 0.01)
    )
    return fits.replace(objects=objects)


def mended(
    fits: Fits,
    image: LabelledImage,
    masks: Bool[Array, "c h w"],
    boards: Float[Array, " c"],
    camera: Camera,
    shelf: Shelf,
) -> Fits:
    """Objects of which those that explain little are fitted around their points alone, where that explains much more.

    Args:
      fits: the objects.
      image: of the camera.
      masks: their pixels.
      boards: height of what each stands on [m].
      camera, shelf: of the image.
    """

    def fit(shared, element, row):
        camera, shelf = shared
        points, depth, labels = element
        mask, board = row
        alone, shelf = _alone(labels, mask).reshape(-1), dataclasses.replace(shelf, board=board)
        flat = points.reshape(-1, 3)
        index, weight = select(alone, jnp.int8(0), ROUGH.points)
        guesses = rough_shapes(flat[index], weight > 0.0, jnp.array(camera.position), board)
        refined = refine(camera, shelf, guesses, flat, alone, depth, ROUGH, jnp.zeros(SHAPES, jnp.int8))
        best = jnp.argmin(jnp.where(refined.scene.valid, refined.misfit, jnp.inf))
        error = jnp.full(SHAPES, ROUGH_ERROR)
        return jax.tree.map(lambda a: a[best], Fits(refined.scene, error, refined.misfit))

    doubtful = fits.objects.valid & ~(fits.misfit < DOUBTFUL)
    element = (image.points, image.depth, image.labels)
    rough = masked_vmap(fit, doubtful, (camera, shelf), element, (masks, boards), block=1)
    better = doubtful & rough.objects.valid & (rough.misfit < BETTER * fits.misfit)
    return jax.tree.map(functools.partial(rows_where, better), rough, fits)


def rows_where(chosen: Bool[Array, " c"], a: Array, b: Array) -> Array:
    """Rows of `a` where chosen, else of `b`."""
    return jnp.where(chosen.reshape(-1, *[1] * (a.ndim - 1)), a, b)


def _alone(labels: Int[Array, "h w"], mask: Bool[Array, "h w"]) -> Int[Array, "h w"]:
    """Labels in which a mask is segment 0, and other segments have other numbers."""
    return jnp.where(mask, 0, jnp.where(labels >= 0, labels + 1, labels)).astype(jnp.int8)


def standing(
    masks: Bool[Array, "c h w"], base: Superquadrics, sample: Any, board: Float[Array, ""] | float
) -> Float[Array, " c"]:
    """The height of what stands beneath each mask: the board, or the top of an object of another segment.

    A thing stands on another if its points lie over the other's footprint, and none beneath the other's top. What
    stands behind another has no points over it.

    Args:
      masks: pixels of things.
      base: the objects of the segments.
      sample: points of the image.
      board: its height [m].
    """
    member = masks.reshape(masks.shape[0], -1)[:, sample.index] & (sample.label >= 0)[None]
    points, of_base = sample.points, sample.label[None] == jnp.arange(base.capacity)[:, None]
    tops = jax.vmap(lambda own: _percentile(points[:, 2], own, TOP))(of_base)

    def over_it(solid):
        level = points.at[:, 2].set(solid.position[2])
        return surface_distance(jax.tree.map(lambda a: a[None], solid), level)[0] < 0.0

    over = jax.vmap(over_it)(base)
    below = points[None, :, 2] < tops[:, None] - UNEVEN
    count = jnp.maximum(jnp.sum(member, axis=1), 1)[:, None]

    def share(of):
        return jnp.einsum("cp,np->cn", member.astype(jnp.float32), of.astype(jnp.float32)) / count

    carries = (share(over) > OVER) & (share(below) < BENEATH) & (share(of_base) < BENEATH) & base.valid[None]
    return jnp.max(jnp.where(carries, tops[None], board), axis=1)


def _percentile(values: Float[Array, " p"], chosen: Bool[Array, " p"], share: float) -> Float[Array, ""]:
    ordered = jnp.sort(jnp.where(chosen, values, jnp.inf))
    last = jnp.floor(share * jnp.maximum(jnp.sum(chosen) - 1, 0)).astype(int)
    return jnp.where(jnp.any(chosen), ordered[last], -jnp.inf)


def pixels_of(labels: Int[Array, "h w"], count: int) -> Int[Array, " count"]:
    """Number of pixels of each of `count` objects."""
    return jnp.sum(labels.reshape(-1)[None] == jnp.arange(count)[:, None], axis=1)
