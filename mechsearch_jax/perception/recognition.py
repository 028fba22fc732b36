"""Recognition: from a labelled image of points to superquadrics, by the recognition network."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import matmul, transform
from mechsearch_jax.networks.recognition import Hypotheses, RecognitionNetwork, told_by
from mechsearch_jax.perception.segments import SegmentConfig, Segments, segment_clouds
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf


def best_hypothesis(told: Hypotheses, segments: Segments) -> Superquadrics:
    """The likeliest hypothesis of every segment, in the world; fields with leading axes (S,)."""
    best = jnp.argmax(told.logit, axis=-1)

    def chosen(values):
        return jnp.take_along_axis(values, best.reshape(-1, *[1] * (values.ndim - 1)), axis=1)[:, 0]

    R_world_segment = segments.T_world_segment[:, :3, :3]
    return Superquadrics(
        size=chosen(told.size),
        exponents=chosen(told.exponents),
        position=transform(segments.T_world_segment, chosen(told.position)),
        rotation=matmul(R_world_segment, chosen(told.rotation)),
        valid=segments.valid,
    )


@functools.partial(jax.jit, static_argnames=("network", "camera", "shelf", "count", "config"))
def recognise(
    key: Key[Array, ""],
    network: RecognitionNetwork,
    parameters: Any,
    camera: Camera,
    points: Float[Array, "h w 3"],
    labels: Int[Array, "h w"],
    shelf: Shelf | None = None,
    count: int = 8,
    config: SegmentConfig | None = None,
) -> Superquadrics:
    """The superquadrics of the segments 0 to `count - 1` of a labelled image of points.

    Slot i is segment i; it is not valid where the segment has fewer than `config.minimum` pixels.

    Args:
      key: PRNG key of the points that are drawn.
      network, parameters: as `models.weights` loads them; the network is static.
      camera: the camera of the image, a `View`'s as in training; static.
      points: in the world [m]; NaN where nothing was measured.
      labels: a segment's number, or one of `perception.labels`.
      shelf: the shelf; static.
      count: number of slots; static.
      config: how segments' clouds are drawn; static.
    """
    segments = segment_clouds(key, camera, points, labels, shelf, count, config)
    told = told_by(network, parameters, segments.points, segments.mark, segments.camera)
    return best_hypothesis(told, segments)
