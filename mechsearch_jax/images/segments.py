"""Input of the recognition network for each segment: its points and their surroundings, in the segment's frame."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from mechsearch_jax.geometry.transforms import inverse, make, transform
from mechsearch_jax.images.cloud import draw
from mechsearch_jax.images.labels import FREE, MISSING
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

# Values of the fourth channel of a segment's cloud. CONTEXT is the paper's 0; INNER, OUTLINE and HIDDEN_EDGE divide its
# 1; CLEAR is ours.
CONTEXT, INNER, OUTLINE, HIDDEN_EDGE, CLEAR = range(5)
MARKS = 5


@dataclasses.dataclass(frozen=True)
class SegmentConfig:
    """How a segment's cloud is drawn.

    Attributes:
      inner: number of points drawn from the whole segment.
      edge: number of points drawn from its edge, where it ends or something hides the rest.
      context: number of points drawn from its surroundings.
      border: how far the surroundings reach beyond the segment's bounding box, in pixels ...
      growth: ... and in shares of the box's sides.
      step: something nearer than an edge by this much hides the object behind it [m].
      minimum: segments of fewer pixels are ignored.
    """

    inner: int = 128
    edge: int = 128
    context: int = 128
    border: int = 6
    growth: float = 0.25
    step: float = 0.006
    minimum: int = 6

    def __post_init__(self):
        if min(self.inner, self.edge, self.context, self.minimum) < 1:
            raise InputError("SegmentConfig: inner, edge, context and minimum must be at least 1")

    @property
    def points(self) -> int:
        return self.inner + self.edge + self.context


class Segments(PyTreeNode):
    """The clouds of an image's segments; every field has the leading axes (..., S).

    A segment's frame has its origin on the board beneath the mean of the segment's points, z up, and x along the
    horizontal part of the ray from the camera.

    Attributes:
      points: in the segment's frame [m], shape (..., S, P, 3).
      mark: the fourth channel, int8, shape (..., S, P): CONTEXT for another thing; of the segment OUTLINE where it ends
        in front of something farther, HIDDEN_EDGE where something nearer hides the rest, INNER elsewhere; CLEAR for the
        shelf beside it, so that the ray up to there is free.
      camera: the camera's position in the segment's frame [m], shape (..., S, 3).
      T_world_segment: the frame, shape (..., S, 4, 4).
      pixels: the segment's number of pixels, shape (..., S).
      valid: whether the slot holds a segment, shape (..., S).
    """

    points: jax.Array
    mark: jax.Array
    camera: jax.Array
    T_world_segment: jax.Array
    pixels: jax.Array
    valid: jax.Array


def edge_marks(
    distance: Float[Array, "h w"], labels: Int[Array, "h w"], step: float = SegmentConfig.step
) -> Int[Array, "h w"]:
    """INNER, OUTLINE or HIDDEN_EDGE for every pixel, by its four neighbours.

    Args:
      distance: of each pixel's point from the camera [m].
      labels: of the pixels; MISSING neighbours and those beyond the image make no edge.
      step: see `SegmentConfig`.
    """

    def neighbour(image, fill, axis, side):
        padded = jnp.pad(image, [(1, 1) if a == axis else (0, 0) for a in range(2)], constant_values=fill)
        size = image.shape[axis]
        return jax.lax.slice_in_dim(padded, 1 + side, 1 + side + size, axis=axis)

    ends, hidden = jnp.zeros(labels.shape, bool), jnp.zeros(labels.shape, bool)
    for axis in (0, 1):
        for side in (-1, 1):
            label = neighbour(labels, MISSING, axis, side)
            other = (label != labels) & (label != MISSING)
            ends |= other
            hidden |= other & (neighbour(distance, jnp.inf, axis, side) < distance - step)
    return jnp.where(hidden, HIDDEN_EDGE, jnp.where(ends, OUTLINE, INNER)).astype(jnp.int8)


@functools.partial(jax.jit, static_argnames=("count", "config"))
def segment_clouds(
    key: Key[Array, ""],
    camera: Camera,
    points: Float[Array, "h w 3"],
    labels: Int[Array, "h w"],
    shelf: Shelf | None = None,
    count: int = 8,
    config: SegmentConfig | None = None,
) -> Segments:
    """The clouds of the segments 0 to `count - 1` of a labelled image of points.

    Args:
      key: PRNG key.
      camera: the camera of the image; only its position counts.
      points: in the world [m]; those that are MISSING may be NaN.
      labels: a segment's number, or one of `images.labels`.
      shelf: the shelf; the default shelf if None.
      count: number of slots; static.
      config: how clouds are drawn; static.
    """
    shelf, config = shelf or Shelf(), config or SegmentConfig()
    eye = jnp.array(camera.position)
    points = jnp.where((labels == MISSING)[..., None], 0.0, points)
    distance = jnp.linalg.norm(points - eye.reshape(1, 1, 3), axis=-1)
    edges = edge_marks(distance, labels, config.step)
    height, width = labels.shape
    rows, columns = jnp.arange(height), jnp.arange(width)
    flat = points.reshape(-1, 3)

    def segment_cloud(key, number):
        is_segment = labels == number
        inner, edge, around = jax.random.split(key, 3)
        chosen, pixels = draw(inner, is_segment.reshape(-1), config.inner)
        rim, rims = draw(edge, (is_segment & (edges != INNER)).reshape(-1), config.edge)
        rim = jnp.where(rims > 0, rim, jnp.resize(chosen, rim.shape))

        def reach(used, index):
            low = jnp.min(jnp.where(used, index, index.size))
            high = jnp.max(jnp.where(used, index, -1))
            margin = config.border + config.growth * (high - low)
            return (index >= low - margin) & (index <= high + margin)

        near = reach(is_segment.any(axis=1), rows)[:, None] & reach(is_segment.any(axis=0), columns)[None, :]
        surroundings = near & ~is_segment & (labels != MISSING)
        context, contexts = draw(around, surroundings.reshape(-1), config.context)
        context = jnp.where(contexts > 0, context, jnp.resize(chosen, context.shape))
        index = jnp.concatenate([chosen, rim, context])

        label = labels.reshape(-1)[index]
        mark = jnp.where(label == number, edges.reshape(-1)[index], jnp.where(label == FREE, CLEAR, CONTEXT))
        middle = jnp.mean(flat[chosen], axis=0)
        T_world_segment = _frame(middle.at[2].set(shelf.board), eye)
        T_segment_world = inverse(T_world_segment)
        return Segments(
            points=transform(T_segment_world, flat[index]),
            mark=mark.astype(jnp.int8),
            camera=transform(T_segment_world, eye),
            T_world_segment=T_world_segment,
            pixels=pixels,
            valid=pixels >= config.minimum,
        )

    return jax.vmap(segment_cloud)(jax.random.split(key, count), jnp.arange(count, dtype=labels.dtype))


def _frame(origin: Float[Array, "3"], eye: Float[Array, "3"]) -> Float[Array, "4 4"]:
    """The frame with z up and x along the horizontal part of the direction from `eye` to `origin`."""
    ahead = (origin - eye).at[2].set(0.0)
    length = jnp.sqrt(jnp.sum(ahead**2))
    ahead = jnp.where(length > 1e-6, ahead / jnp.maximum(length, 1e-6), jnp.array([1.0, 0.0, 0.0]))
    up = jnp.array([0.0, 0.0, 1.0])
    return make(jnp.stack([ahead, jnp.cross(up, ahead), up], axis=-1), origin)
