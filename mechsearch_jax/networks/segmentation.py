"""The segmentation network, which separates the objects of a cloud (paper section 4.1 and appendix B.1).

Edge convolutions over each point's nearest neighbours (Y. Wang et al., "Dynamic graph CNN for learning on point
clouds", 2019) detect the ends of surfaces. Between them, a few latent tokens attend to all points and the points to the
tokens (A. Jaegle et al., "Perceiver", 2021), which connects distant parts of an object. The first tokens represent the
instances, and a point belongs to the one that its features match best (B. Cheng et al., "MaskFormer", 2021). Unlike in
DGCNN, neighbours are those in space in every layer, so they are computed once.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mechsearch_jax.images.labels import INSTANCES
from mechsearch_jax.networks.layers import Attention, FeedForward, fourier_features
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode

# Origin of the network's frame, the middle of the shelf's space [m].
MIDDLE = (0.6, 0.1, 0.5)
# Unrolled iterations over the neighbours in `strongest_neighbour`.
_UNROLLED = 5


@dataclasses.dataclass(frozen=True)
class SegmentationConfig:
    """Sizes of the network.

    Attributes:
      width: of a point's features and of a token.
      layers: number of layers of edge convolution and attention.
      heads: of an attention layer.
      neighbours: k, number of neighbours in an edge convolution.
      latents: number of latent tokens; the first nine are the instances.
    """

    width: int = 128
    layers: int = 4
    heads: int = 4
    neighbours: int = 20
    latents: int = 32

    def __post_init__(self):
        if min(self.width, self.layers, self.heads, self.neighbours) < 1 or self.width % self.heads:
            raise InputError(
                "SegmentationConfig: width, layers, heads and neighbours must be positive, and heads divide width"
            )
        if self.latents < INSTANCES:
            raise InputError(f"SegmentationConfig: latents {self.latents} must be at least {INSTANCES}")


class SegmentationOutput(PyTreeNode):
    """The network's output for the points of a cloud.

    Attributes:
      logits: for each layer, of the probability that a point belongs to each of nine instances, or (last) to none,
        shape (layers, ..., P, 10); the last layer's are the result, the others are for training.
      centres: predicted centre of each point's object in the world [m], shape (..., P, 3).
    """

    logits: jax.Array
    centres: jax.Array


def nearest_neighbours(points: Float[Array, "p 3"], count: int) -> Int[Array, "p count"]:
    """Indices of the `count` nearest points of each point, itself included, in order of distance.

    Of equally near points, the lower index comes first, on every platform.
    """
    passes, sort = (functools.partial(of, count=count) for of in (_neighbours_by_passes, _neighbours_by_sorting))
    # Indices have no gradient, and JAX cannot differentiate a general reduction.
    return jax.lax.platform_dependent(jax.lax.stop_gradient(points), cuda=passes, rocm=passes, default=sort)


def _neighbours_by_sorting(points: Array, count: int) -> Array:
    return jax.lax.top_k(-_squares(points), count)[1]


def _neighbours_by_passes(points: Array, count: int) -> Array:
    """One pass over all pairs for each neighbour, which finds the next nearest one.

    On a GPU `top_k` sorts whole rows if `count` is above 16. A pass is a reduction that is fused with the computation
    of the distances, which are never in memory.
    """
    number = jnp.broadcast_to(jnp.arange(len(points), dtype=jnp.int32)[None], (len(points), len(points)))
    beyond = (jnp.float32(jnp.inf), jnp.int32(len(points)))

    def nearer(a, b):
        first = (a[0] < b[0]) | ((a[0] == b[0]) & (a[1] < b[1]))
        return jnp.where(first, a[0], b[0]), jnp.where(first, a[1], b[1])

    def next_nearest(last, _):
        square = _squares(points)
        done = (square < last[0][:, None]) | ((square == last[0][:, None]) & (number <= last[1][:, None]))
        following = jax.lax.reduce((jnp.where(done, jnp.inf, square), number), beyond, nearer, (1,))
        return following, following[1]

    none = (jnp.full(len(points), -1.0), jnp.full(len(points), -1, jnp.int32))
    return jax.lax.scan(next_nearest, none, length=count)[1].T


def _squares(points: Array) -> Array:
    return sum(((points[:, None, i] - points[None, :, i]) ** 2 for i in range(3)), jnp.zeros((), points.dtype))


@jax.custom_vjp
def strongest_neighbour(
    features: Float[Array, "p width"],
    offsets: Float[Array, "p count 3"],
    place: Float[Array, "3 width"],
    neighbours: Int[Array, "p count"],
) -> Float[Array, "p width"]:
    """`max(features[neighbours] + offsets @ place, axis=1)`: for each channel the maximum over a point's neighbours.

    The array in the maximum would be `count` times as large as all others in the network, so this iterates over the
    neighbours. The gradient reaches one neighbour for each channel; automatic differentiation would also add zeros to
    all others, at random places in memory.

    Args:
      features: of the points.
      offsets: of each point's neighbours.
      place: matrix from offsets to channels.
      neighbours: indices of each point's neighbours.
    """
    return _strongest(features, offsets, place, neighbours)[0]


def _strongest(features, offsets, place, neighbours):
    """The maximum in float32, and its index among the neighbours."""
    place = place.astype(jnp.float32)
    count = neighbours.shape[1]
    number = jnp.arange(count, dtype=jnp.uint8 if count <= 256 else jnp.int32)

    def stronger(best, neighbour):
        largest, winner = best
        index, offset, number = neighbour
        # Explicit sums instead of a thin matrix product, because XLA fuses them.
        shift = sum(offset[:, i, None] * place[None, i] for i in range(3))
        response = features[index].astype(jnp.float32) + shift
        return (jnp.maximum(largest, response), jnp.where(response > largest, number, winner)), None

    none = (jnp.full(features.shape, -jnp.inf, jnp.float32), jnp.zeros(features.shape, number.dtype))
    inputs = (neighbours.T, jnp.moveaxis(offsets, 1, 0).astype(jnp.float32), number)
    return jax.lax.scan(stronger, none, inputs, unroll=_UNROLLED)[0]


def _strongest_forward(features, offsets, place, neighbours):
    best, winner = _strongest(features, offsets, place, neighbours)
    return best, (features, offsets, place, neighbours, winner)


def _strongest_backward(residuals, slope):
    features, offsets, place, neighbours, winner = residuals
    index = winner.astype(jnp.int32)
    source = jnp.take_along_axis(neighbours, index, axis=1)
    # In 16 bits, sums of many terms lose precision, and a GPU's atomic additions are far slower.
    to_features = jnp.zeros(features.shape, jnp.float32).at[source, jnp.arange(features.shape[1])[None]].add(slope)
    to_place = [jnp.sum(slope * jnp.take_along_axis(offsets[..., i], index, axis=1), axis=0) for i in range(3)]
    # XLA removes this where the gradient of the offsets is not used, as in training.
    wins = winner[:, None] == jnp.arange(neighbours.shape[1], dtype=winner.dtype)[None, :, None]
    to_offsets = jnp.where(wins, slope[:, None], 0.0) @ place.T
    return (
        to_features.astype(features.dtype),
        to_offsets.astype(offsets.dtype),
        jnp.stack(to_place).astype(place.dtype),
        None,
    )


strongest_neighbour.defvjp(_strongest_forward, _strongest_backward)


class EdgeConvolution(nn.Module):
    """A residual branch: the maximum response over a point's neighbours, by their features and positions.

    Unlike in DGCNN, the maximum precedes the activation, which gives the same for a monotonic one, and needs no memory
    for the other neighbours.
    """

    width: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Array, offsets: Array, neighbours: Array) -> Array:
        h = nn.LayerNorm()(x)
        receiver = nn.Dense(self.width, dtype=self.dtype, name="own")(h)
        sender = nn.Dense(self.width, use_bias=False, dtype=self.dtype, name="other")(h)
        # Applied to the axes, the layer gives its matrix.
        place = nn.Dense(self.width, use_bias=False, dtype=self.dtype, name="place")(jnp.eye(3))
        strongest = jax.vmap(strongest_neighbour, in_axes=(0, 0, None, 0))(sender, offsets, place, neighbours)
        response = nn.gelu(receiver + strongest.astype(self.dtype))
        return nn.Dense(self.width, dtype=self.dtype, name="out")(response).astype(jnp.float32)


class SegmentationNetwork(nn.Module):
    """The network, permutation-equivariant over the points. See the module's docstring."""

    config: SegmentationConfig = SegmentationConfig()
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, points: Float[Array, "batch p 3"]) -> SegmentationOutput:
        """Args:
        points: clouds in the world [m].
        """
        config = self.config
        neighbours = jax.vmap(lambda cloud: nearest_neighbours(cloud, config.neighbours))(points)
        around = jax.vmap(lambda cloud, index: cloud[index])(points, neighbours)
        # Offsets of neighbours are millimetres: in units of 2 cm, and saturated beyond.
        offsets = jnp.tanh((around - points[:, :, None, :]) / 0.02)
        features = fourier_features(points - jnp.array(MIDDLE).reshape(1, 1, 3))
        x = nn.Dense(config.width, name="points")(features)
        latents = self.param("latents", nn.initializers.normal(1.0), (config.latents, config.width))
        latents = jnp.broadcast_to(latents[None], (points.shape[0], *latents.shape))
        logits = []
        for _ in range(config.layers):
            x = x + EdgeConvolution(config.width, self.dtype)(x, offsets, neighbours)
            latents = latents + Attention(config.width, config.heads, self.dtype)(latents, x)
            latents = latents + Attention(config.width, config.heads, self.dtype)(latents)
            latents = latents + FeedForward(config.width, dtype=self.dtype)(latents)
            x = x + Attention(config.width, config.heads, self.dtype)(x, latents)
            x = x + FeedForward(config.width, growth=2, dtype=self.dtype)(x)
            read, tokens = nn.LayerNorm()(x), nn.LayerNorm()(latents[:, :INSTANCES])
            masks = nn.Dense(config.width, dtype=self.dtype)(read)
            queries = nn.Dense(config.width, dtype=self.dtype)(tokens)
            matched = jnp.einsum("bpw,bqw->bpq", masks, queries, preferred_element_type=jnp.float32)
            none = nn.Dense(1)(read)
            logits.append(jnp.concatenate([matched / config.width**0.5, none], axis=-1))
        centres = points + 0.1 * nn.Dense(3, name="centres")(nn.LayerNorm()(x))
        return SegmentationOutput(jnp.stack(logits), centres)


def apply_network(
    network: SegmentationNetwork, parameters: Any, points: Float[Array, "batch p 3"]
) -> SegmentationOutput:
    """The network's forward pass: logits and centres of the points of a batch of clouds in the world [m]."""
    return cast(SegmentationOutput, network.apply({"params": parameters}, points))
