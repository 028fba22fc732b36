"""Recognition: from a labelled image of points to superquadrics and the target's pose."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import matmul, transform
from mechsearch_jax.images.cloud import middle
from mechsearch_jax.images.labels import CAPACITY
from mechsearch_jax.images.segments import SegmentConfig, Segments, segment_clouds
from mechsearch_jax.images.trained_view import TrainedView
from mechsearch_jax.runtime.pytree import PyTreeNode, static
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

if TYPE_CHECKING:
    from mechsearch_jax.networks.recognition import Hypotheses, RecognitionNetwork
    from mechsearch_jax.networks.weights import Weights


def best_hypothesis(hypotheses: Hypotheses, segments: Segments) -> Superquadrics:
    """The likeliest hypothesis of every segment, in the world; fields with leading axes (S,)."""
    best = jnp.argmax(hypotheses.logit, axis=-1)

    def chosen(values):
        return jnp.take_along_axis(values, best.reshape(-1, *[1] * (values.ndim - 1)), axis=1)[:, 0]

    R_world_segment = segments.T_world_segment[:, :3, :3]
    return Superquadrics(
        size=chosen(hypotheses.size),
        exponents=chosen(hypotheses.exponents),
        position=transform(segments.T_world_segment, chosen(hypotheses.position)),
        rotation=matmul(R_world_segment, chosen(hypotheses.rotation)),
        valid=segments.valid,
    )


def expected_error(hypotheses: Hypotheses) -> Float[Array, " s"]:
    """How far the network expects the centre of the likeliest hypothesis to be from the true one, per segment [m]."""
    share = jax.nn.softmax(hypotheses.logit, axis=-1)
    best = jnp.argmax(hypotheses.logit, axis=-1)[:, None, None]
    chosen = jnp.take_along_axis(hypotheses.position, best, axis=1)
    square = jnp.sum((hypotheses.position - chosen) ** 2 + jnp.exp(2.0 * hypotheses.log_scale[..., 3:]), axis=-1)
    return jnp.sum(share * jnp.sqrt(square), axis=-1)


def nearness(camera: Camera, shelf: Shelf) -> Float[Array, ""]:
    """Factor by which a camera's distance from an object is reduced in the network's input.

    The network performs badly with a camera farther away than in its training. So its input is a nearer camera on the
    same ray, from which the points look nearly the same.
    """
    return jnp.minimum(1.0, _distance(Camera(), Shelf()) / jnp.maximum(_distance(camera, shelf), 1e-9))


def _distance(camera: Camera, shelf: Shelf) -> Float[Array, ""]:
    """`cloud.distance` for a traced camera and shelf."""
    return jnp.linalg.norm(jnp.array(camera.position) - jnp.array(middle(shelf)))


@functools.partial(jax.jit, static_argnames=("network", "count", "config"))
def recognise_with_error(
    key: Key[Array, ""],
    network: RecognitionNetwork,
    parameters: Any,
    camera: Camera,
    points: Float[Array, "h w 3"],
    labels: Int[Array, "h w"],
    shelf: Shelf | None = None,
    count: int = 8,
    config: SegmentConfig | None = None,
) -> tuple[Superquadrics, Float[Array, " s"]]:
    """The network's superquadrics for the segments 0 to `count - 1` of a labelled image of points, and its
    `expected_error` of each [m].

    Slot i is segment i; it is not valid if the segment has fewer than `config.minimum` pixels.

    Args:
      key: PRNG key of the drawn points.
      network, parameters: as `networks.weights` loads them; the network is static.
      camera: the camera of the image, a `View`'s as in training.
      points: in the world [m]; NaN invalidates the pixel, whose label is then MISSING.
      labels: a segment's number, or one of `images.labels`.
      shelf: the shelf; the default shelf if None.
      count: number of slots; static.
      config: how segments' clouds are drawn; static.
    """
    from mechsearch_jax.networks.recognition import apply_network

    segments = segment_clouds(key, camera, points, labels, shelf, count, config)
    eyes = nearness(camera, shelf or Shelf()) * segments.camera
    hypotheses = apply_network(network, parameters, segments.points, segments.mark, eyes)
    return best_hypothesis(hypotheses, segments), expected_error(hypotheses)


class ShapeNetwork(PyTreeNode):
    """A trained recognition network.

    Attributes:
      parameters: of the network.
      network: static.
      view: camera and shelf in its training, if its card records them; static.
    """

    parameters: Any
    network: RecognitionNetwork = static()
    view: TrainedView | None = static(default=None)

    @classmethod
    def of(cls, weights: Weights | None = None) -> ShapeNetwork:
        """The network with the given weights; the package's if None."""
        from mechsearch_jax.networks.weights import shipped_weights

        weights = weights or shipped_weights("recognition")
        return cls(weights.parameters, cast("RecognitionNetwork", weights.network), weights.view)


class LabelledImage(PyTreeNode):
    """An image of points with a label for each pixel.

    Attributes:
      points: in the world [m], shape (h, w, 3); NaN where nothing was measured.
      depth: of the points along the camera's axis [m], shape (h, w); infinite where nothing is, NaN where nothing was
        measured.
      labels: as in `images.labels`, shape (h, w).
      of_target: points to which the target's pose is fitted, bool, shape (h, w).
      capacity: number of slots for objects, static; segments with larger numbers have none.
    """

    points: jax.Array
    depth: jax.Array
    labels: jax.Array
    of_target: jax.Array
    capacity: int = static(default=CAPACITY)
