"""The network that tells the objects of a cloud apart (paper section 4.1 and appendix B.1).

Edge convolutions over each point's nearest neighbours (Y. Wang et al., "Dynamic graph CNN for learning on point
clouds", 2019) see where surfaces end. Between them a few latent tokens gather from all points and give back (A. Jaegle
et al., "Perceiver", 2021), so that far parts of one object hear of each other. The first of these tokens stand for the
instances, and a point belongs to the one that its features match best (B. Cheng et al., "MaskFormer", 2021). Unlike
DGCNN's, the neighbours are those in space in every layer: they are found once.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, cast

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mechsearch_jax.images.labels import INSTANCES
from mechsearch_jax.networks.layers import Attention, FeedForward, fourier_features
from mechsearch_jax.runtime.errors import InputError

# The middle of the shelf's space [m]: where the network's frame has its origin.
MIDDLE = (0.6, 0.1, 0.5)
# Neighbours that `strongest_neighbour` goes through in one piece, between which the largest so far is in memory.
_UNROLLED = 5


@dataclasses.dataclass(frozen=True)
class SegmentationConfig:
    """Sizes of the network.

    Attributes:
      width: of a point's features and of a token.
      layers: of edge convolution and attention.
      heads: of an attention.
      neighbours: k, how many points an edge convolution looks at.
      latents: tokens that gather from all points; the first nine are the instances.
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


class SegmentationOutput(flax.struct.PyTreeNode):
    """The network's output for the points of a cloud.

    Attributes:
      logits: for each layer, of the probability that a point is of each of nine instances, or (last) of none, shape
        (layers, ..., P, 10); the last layer's are the answer, the others help training.
      centres: the centre of each point's object in the world, as the point sees it [m], shape (..., P, 3).
    """

    logits: jax.Array
    centres: jax.Array


def nearest_neighbours(points: Float[Array, "p 3"], count: int) -> Int[Array, "p count"]:
    """Indices of the `count` nearest points of each point, itself among them, by Euclidean distance.

    Nearer ones come first, and of equally near ones that of the lower index, on every platform.
    """
    passes, sort = (functools.partial(of, count=count) for of in (_neighbours_by_passes, _neighbours_by_sorting))
    # Indices have no slope, and a general reduction knows no derivative.
    return jax.lax.platform_dependent(jax.lax.stop_gradient(points), cuda=passes, rocm=passes, default=sort)


def _neighbours_by_sorting(points: Array, count: int) -> Array:
    return jax.lax.top_k(-_squares(points), count)[1]


def _neighbours_by_passes(points: Array, count: int) -> Array:
    """One pass over all pairs for each neighbour, which finds the next after the last.

    On a GPU `top_k` sorts whole rows where `count` is above 16. A pass is a reduction into which the distances are
    fused: they are never in memory.
    """
    number = jnp.broadcast_to(jnp.arange(len(points), dtype=jnp.int32)[None], (len(points), len(points)))
    beyond = (jnp.float32(jnp.inf), jnp.int32(len(points)))

    def nearer(a, b):
        first = (a[0] < b[0]) | ((a[0] == b[0]) & (a[1] < b[1]))
        return jnp.where(first, a[0], b[0]), jnp.where(first, a[1], b[1])

    def following(last, _):
        square = _squares(points)
        done = (square < last[0][:, None]) | ((square == last[0][:, None]) & (number <= last[1][:, None]))
        found = jax.lax.reduce((jnp.where(done, jnp.inf, square), number), beyond, nearer, (1,))
        return found, found[1]

    none = (jnp.full(len(points), -1.0), jnp.full(len(points), -1, jnp.int32))
    return jax.lax.scan(following, none, length=count)[1].T


def _squares(points: Array) -> Array:
    return sum(((points[:, None, i] - points[None, :, i]) ** 2 for i in range(3)), jnp.zeros((), points.dtype))


@jax.custom_vjp
def strongest_neighbour(
    features: Float[Array, "p width"],
    offsets: Float[Array, "p count 3"],
    place: Float[Array, "3 width"],
    neighbours: Int[Array, "p count"],
) -> Float[Array, "p width"]:
    """For each channel the largest, over a point's neighbours, of their features and of where they are.

    Plainly `max(features[neighbours] + offsets @ place, axis=1)`. But that is `count` times as large as all else in
    the network, so it is gone through neighbour by neighbour; and the gradient reaches one neighbour for each channel,
    while differentiation, left to itself, would add a zero to all others too, at random places in memory.

    Args:
      features: of the points.
      offsets: of each point's neighbours.
      place: what an offset counts in each channel.
      neighbours: of each point, their indices.
    """
    return _strongest(features, offsets, place, neighbours)[0]


def _strongest(features, offsets, place, neighbours):
    """The largest in float32, and the number of the neighbour that it is of."""
    place = place.astype(jnp.float32)
    count = neighbours.shape[1]
    number = jnp.arange(count, dtype=jnp.uint8 if count <= 256 else jnp.int32)

    def stronger(best, neighbour):
        largest, winner = best
        index, offset, number = neighbour
        # Products so thin cost less as sums, which are fused with what is around them.
        where = sum(offset[:, i, None] * place[None, i] for i in range(3))
        response = features[index].astype(jnp.float32) + where
        return (jnp.maximum(largest, response), jnp.where(response > largest, number, winner)), None

    none = (jnp.full(features.shape, -jnp.inf, jnp.float32), jnp.zeros(features.shape, number.dtype))
    each = (neighbours.T, jnp.moveaxis(offsets, 1, 0).astype(jnp.float32), number)
    return jax.lax.scan(stronger, none, each, unroll=_UNROLLED)[0]


def _strongest_forward(features, offsets, place, neighbours):
    best, winner = _strongest(features, offsets, place, neighbours)
    return best, (features, offsets, place, neighbours, winner)


def _strongest_backward(kept, slope):
    features, offsets, place, neighbours, winner = kept
    index = winner.astype(jnp.int32)
    who = jnp.take_along_axis(neighbours, index, axis=1)
    # Sums of many terms lose what is small in 16 bits, and a GPU adds these in memory far more slowly.
    to_features = jnp.zeros(features.shape, jnp.float32).at[who, jnp.arange(features.shape[1])[None]].add(slope)
    to_place = [jnp.sum(slope * jnp.take_along_axis(offsets[..., i], index, axis=1), axis=0) for i in range(3)]
    # Nothing of this is computed where, as in training, nobody asks for the gradient of the offsets.
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
    """The strongest response to a point's neighbours, by what they are and where; to be added to its input.

    The strongest is taken before the activation, unlike DGCNN's: for an activation that never falls it is the same,
    and nothing has to be kept of the other neighbours.
    """

    width: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Array, offsets: Array, neighbours: Array) -> Array:
        h = nn.LayerNorm()(x)
        own = nn.Dense(self.width, dtype=self.dtype, name="own")(h)
        other = nn.Dense(self.width, use_bias=False, dtype=self.dtype, name="other")(h)
        # What the layer says of the axes is its matrix.
        place = nn.Dense(self.width, use_bias=False, dtype=self.dtype, name="place")(jnp.eye(3))
        strongest = jax.vmap(strongest_neighbour, in_axes=(0, 0, None, 0))(other, offsets, place, neighbours)
        response = nn.gelu(own + strongest.astype(self.dtype))
        return nn.Dense(self.width, dtype=self.dtype, name="out")(response).astype(jnp.float32)


class SegmentationNetwork(nn.Module):
    """Permutation-equivariant over the points: reordering them reorders the output. See the module's text."""

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
        # Neighbours are millimetres apart: in units of 2 cm, cut off where distance no longer matters.
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
