"""Label an image with the segmentation network: draw a cloud, segment it, clean up, and spread the labels."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Any, Protocol, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.images.cloud import above_board, cloud_of, hanging, middle, resample, surfaces
from mechsearch_jax.images.labels import CAPACITY, FREE, INSTANCES, MISSING, OTHER
from mechsearch_jax.images.trained_view import TrainedView
from mechsearch_jax.runtime.pytree import PyTreeNode, static
from mechsearch_jax.workspace.shelf import Shelf

if TYPE_CHECKING:
    from mechsearch_jax.networks.segmentation import SegmentationNetwork
    from mechsearch_jax.networks.weights import Weights

# How labels of points are cleaned up: this many nearest points within `REACH` [m] vote on a point's label, itself
# included, in so many rounds; points of segments of fewer than `LEAST_SEGMENT` points take the label of the nearest
# other segment. Points without a label within `REACH` become OTHER.
NEIGHBOURS, ROUNDS, LEAST_SEGMENT, REACH = 9, 1, 8, 0.02
# Smaller surfaces do not count where those of an image are halved [pixels].
SURFACE = 60
# Parts of a cloud in which the nearest point is searched for, if they are of equal size.
_PARTS = 64


class Segmenter(Protocol):
    """Labels the pixels of objects; traceable by JAX, and a pytree if it holds arrays."""

    def __call__(
        self, key: Key[Array, ""], shelf: Shelf, points: Float[Array, "h w 3"], of_target: Bool[Array, "h w"]
    ) -> Int[Array, "h w"]:
        """Label an image.

        Args:
          key: PRNG key.
          shelf: may be traced.
          points: in the world [m]; NaN invalidates the pixel.
          of_target: the target's pixels.

        Returns:
          Labels as in `images.labels`, with at most as many segments as the recogniser has slots, from 0; the
          target's pixels are OTHER.
        """
        ...


def _squares(a: Array, b: Array) -> Array:
    """Squared distances between two clouds [m2]."""
    return sum(((a[:, None, i] - b[None, :, i]) ** 2 for i in range(3)), jnp.zeros(()))


def labels_of(logits: Float[Array, "p classes"]) -> Int[Array, " p"]:
    """The likeliest label of each point: an instance's number, or OTHER for the last class."""
    best = jnp.argmax(logits, axis=-1)
    return jnp.where(best == INSTANCES, OTHER, best).astype(jnp.int8)


@jax.jit
def clean_up(points: Float[Array, "p 3"], labels: Int[Array, " p"], valid: Bool[Array, " p"]) -> Int[Array, " p"]:
    """Labels after neighbours voted and small segments were merged, int8; OTHER where `valid` is false.

    Args:
      points: [m].
      labels: instances' numbers, or OTHER.
      valid: which points exist.
    """
    instances = jnp.arange(INSTANCES)
    square = jnp.where(valid[None, :], _squares(points, points), jnp.inf)
    nearness, nearest = jax.lax.top_k(-square, NEIGHBOURS)
    votes_count = (-nearness < REACH**2)[..., None]
    member = (labels[:, None] == instances[None, :]) & valid[:, None]

    def vote(_, member):
        votes = jnp.sum(member[nearest] & votes_count, axis=1)
        # At a tie the label stays.
        best = jnp.argmax(2 * votes + member, axis=1)
        elected = (best[:, None] == instances[None, :]) & (jnp.max(votes, axis=1) > 0)[:, None]
        return elected & member.any(axis=1)[:, None] & valid[:, None]

    member = jax.lax.fori_loop(0, ROUNDS, vote, member)
    kept = jnp.sum(member, axis=0) >= LEAST_SEGMENT
    lost = member.any(axis=1) & ~(member & kept[None]).any(axis=1)
    stays = (member & kept[None]).any(axis=1)
    distance = jnp.where(stays[None, :], square, jnp.inf)
    source = jnp.argmin(distance, axis=1)
    near = jnp.min(distance, axis=1) < REACH**2
    label = jnp.where(stays, jnp.argmax(member & kept[None], axis=1), OTHER)
    return jnp.where(lost & near, label[source], label).astype(jnp.int8)


@functools.partial(jax.jit, static_argnames="reach")
def spread_labels(
    points: Float[Array, "h w 3"],
    candidates: Bool[Array, "h w"],
    cloud: Float[Array, "p 3"],
    labels: Int[Array, " p"],
    reach: float = 0.015,
) -> Int[Array, "h w"]:
    """Labels of an image's pixels from those of a cloud: each pixel takes the label of the nearest cloud point.

    Args:
      points: of the pixels [m]; NaN invalidates the pixel.
      candidates: pixels that show something on the shelf, not the shelf.
      cloud: points drawn from the image [m].
      labels: of the cloud's points, also OTHER.
      reach: a pixel without a cloud point within this distance becomes OTHER [m]; static.

    Returns:
      Labels as in `images.labels`, int8.
    """
    measured = jnp.isfinite(points).all(axis=-1)
    pixels = jnp.where(measured[..., None], points, 0.0).reshape(-1, 3)
    parts = math.gcd(cloud.shape[0], _PARTS)

    def nearest(_, image, pixel):
        cloud, labels = image
        square = _squares(pixel[None], cloud)[0].reshape(parts, -1)
        # On a CPU the minimum of each part is vectorised, which `argmin` is not.
        least = jnp.min(square, axis=1)
        part = jnp.argmin(least)
        best = part * square.shape[1] + jnp.argmin(square[part])
        return jnp.where(least[part] < reach**2, labels[best], OTHER).astype(jnp.int8)

    # Most of an image shows the shelf.
    wanted = (measured & candidates).reshape(-1)
    nearest_label = masked_vmap(nearest, wanted, None, (cloud, labels), pixels).reshape(measured.shape)
    return jnp.where(~measured, MISSING, jnp.where(candidates, nearest_label, FREE)).astype(jnp.int8)


def leave_out_smallest(labels: Int[Array, "h w"], count: int, capacity: int) -> Int[Array, "h w"]:
    """Labels with the numbers 0 to `capacity - 1`: of `count` segments the smallest become OTHER.

    Later segments take their numbers, or those of absent ones.
    """
    numbers = jnp.arange(count)
    pixels = jnp.sum(labels[..., None] == numbers.reshape(1, 1, -1), axis=(0, 1))
    kept = jnp.zeros(count, bool).at[jnp.argsort(pixels)[max(count - capacity, 0) :]].set(True)
    later = kept & (numbers >= capacity)
    free = jnp.argsort(kept[:capacity])
    number = jnp.where(later, free[jnp.cumsum(later) - 1], jnp.where(kept, numbers, OTHER))
    return jnp.where(labels >= 0, number[labels], labels).astype(jnp.int8)


def on_the_right(objects: Bool[Array, "h w"], surface: Int[Array, "h w"]) -> Bool[Array, "h w"]:
    """The pixels of objects whose surfaces are farther to the right than most: in the image about half of the things.

    Args:
      objects: pixels of objects.
      surface: numbers of their surfaces, below the number of pixels.
    """
    number, there = surface.reshape(-1), objects.reshape(-1).astype(jnp.float32)
    column = jnp.broadcast_to(jnp.arange(objects.shape[1], dtype=jnp.float32)[None], objects.shape).reshape(-1)
    size, total = (jnp.zeros(number.size).at[number].add(weight) for weight in (there, there * column))
    middle = total / jnp.maximum(size, 1.0)
    half = jnp.nanmedian(jnp.where(size >= SURFACE, middle, jnp.nan))
    return objects & (middle > half)[number].reshape(objects.shape)


class NetworkSegmenter(PyTreeNode):
    """The `Segmenter` that segments a cloud of the image's points with the segmentation network.

    Attributes:
      parameters: of the network.
      network: static.
      view: camera and shelf in its training, if its card records them; static.
      capacity: the most segments; static. If the network tells fewer instances apart, it sees the left and the right
        half of the surfaces one after the other.
    """

    parameters: Any
    network: SegmentationNetwork = static()
    view: TrainedView | None = static(default=None)
    capacity: int = static(default=CAPACITY)

    @classmethod
    def of(cls, weights: Weights | None = None, capacity: int = CAPACITY) -> NetworkSegmenter:
        """The segmenter with the given weights, the package's if None, of at most so many segments."""
        from mechsearch_jax.networks.weights import shipped_weights

        weights = weights or shipped_weights("segmentation")
        return cls(weights.parameters, cast("SegmentationNetwork", weights.network), weights.view, capacity)

    def __call__(self, key: Array, shelf: Shelf, points: Array, of_target: Array) -> Array:
        objects = above_board(shelf, points) & ~of_target
        surface = surfaces(points, objects)
        objects &= ~hanging(shelf, points, objects, surface)
        segmented = functools.partial(self._segmented, shelf, points, surface)
        if self.capacity < INSTANCES:
            labels, count = segmented(key, objects), INSTANCES
        else:
            right, count = on_the_right(objects, surface), 2 * INSTANCES
            sides = jnp.stack([objects & ~right, objects & right])
            left_labels, labels = jax.lax.map(lambda side: segmented(*side), (jax.random.split(key), sides))
            labels = jnp.where(right, jnp.where(labels >= 0, labels + INSTANCES, labels), left_labels)
        labels = jnp.where(of_target & (labels != MISSING), OTHER, labels)
        return leave_out_smallest(labels, count, self.capacity)

    def _segmented(
        self, shelf: Shelf, points: Array, surface: Int[Array, "h w"], key: Array, objects: Bool[Array, "h w"]
    ) -> Int[Array, "h w"]:
        """Labels of the pixels of objects, whose `surface` is numbered."""
        from mechsearch_jax.networks.segmentation import apply_network

        cloud = resample(key, cloud_of(jnp.where(objects[..., None], points, jnp.nan)), surface=surface.reshape(-1))
        output = apply_network(self.network, self.parameters, self._as_trained(shelf, cloud.points)[None])
        labels = clean_up(cloud.points, labels_of(output.logits[-1, 0]), cloud.valid)
        return spread_labels(points, objects, cloud.points, labels)

    def _as_trained(self, shelf: Shelf, points: Float[Array, "p 3"]) -> Float[Array, "p 3"]:
        """The points shifted as if the shelf stood where it stood in training, the only place the network knows."""
        if self.view is None:
            return points
        # Both in the same precision, so that the shift is exactly 0 for the shelf of the training.
        trained, present = (jnp.stack(middle(jax.tree.map(jnp.float32, s))) for s in (self.view.shelf, shelf))
        return points + (trained - present).reshape(1, 3)
