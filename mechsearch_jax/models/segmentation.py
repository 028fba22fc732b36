"""The network that tells the objects of a cloud apart (paper section 4.1 and appendix B.1).

Edge convolutions over each point's nearest neighbours (Y. Wang et al., "Dynamic graph CNN for learning on point
clouds", 2019) see where surfaces end. Between them a few latent tokens gather from all points and give back (A. Jaegle
et al., "Perceiver", 2021), so that far parts of one object hear of each other. The first of these tokens stand for the
instances, and a point belongs to the one that its features match best (B. Cheng et al., "MaskFormer", 2021). Unlike
DGCNN's, the neighbours are those in space in every layer: they are found once.
"""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mechsearch_jax.errors import InputError
from mechsearch_jax.models.layers import Attention, FeedForward, fourier_features
from mechsearch_jax.perception.labels import INSTANCES

# The middle of the shelf's space [m]: where the network's frame has its origin.
MIDDLE = (0.6, 0.1, 0.5)


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
    """What the network says of a cloud's points.

    Attributes:
      logits: for each layer, of the probability that a point is of each of nine instances, or (last) of none, shape
        (layers, ..., P, 10); the last layer's are the answer, the others help training.
      centres: the centre of each point's object in the world, as the point sees it [m], shape (..., P, 3).
    """

    logits: jax.Array
    centres: jax.Array


def nearest_neighbours(points: Float[Array, "p 3"], count: int) -> Int[Array, "p count"]:
    """Indices of the `count` nearest points of each point, itself among them, by Euclidean distance."""
    square = sum((points[:, None, i] - points[None, :, i]) ** 2 for i in range(3))
    return jax.lax.top_k(-square, count)[1]


def _activated(features: Array, rest: Array, neighbours: Array) -> Array:
    return nn.gelu(features[neighbours] + rest)


@jax.custom_vjp
def strongest_response(
    features: Float[Array, "p width"], rest: Float[Array, "p count width"], neighbours: Int[Array, "p count"]
) -> Float[Array, "p width"]:
    """Largest activation over a point's neighbours, for each channel: gelu of a neighbour's features and of `rest`.

    Its gradient reaches one neighbour for each channel. Left to itself, differentiation would add a zero to all others
    too, at random places in memory: `count` times as many additions, which would take most of a training step.
    """
    return jnp.max(_activated(features, rest, neighbours), axis=-2)


def _strongest_forward(features, rest, neighbours):
    activated = _activated(features, rest, neighbours)
    winner = jnp.argmax(activated, axis=-2)
    return jnp.max(activated, axis=-2), (features, rest, neighbours, winner)


def _strongest_backward(kept, slope):
    features, rest, neighbours, winner = kept
    channels = jnp.arange(features.shape[1])[None]
    who = jnp.take_along_axis(neighbours, winner, axis=1)
    before = features[who, channels] + jnp.take_along_axis(rest, winner[:, None], axis=1)[:, 0]
    _, through = jax.vjp(nn.gelu, before)
    (slope,) = through(slope.astype(before.dtype))
    # Sums of many terms lose what is small in 16 bits, and a GPU adds these in memory far more slowly.
    exact = slope.astype(jnp.float32)
    to_features = jnp.zeros(features.shape, jnp.float32).at[who, channels].add(exact).astype(features.dtype)
    wins = jnp.arange(rest.shape[1])[None, :, None] == winner[:, None]
    return to_features, jnp.where(wins, slope[:, None], 0).astype(rest.dtype), None


strongest_response.defvjp(_strongest_forward, _strongest_backward)


class EdgeConvolution(nn.Module):
    """The strongest response to a point's neighbours, by what they are and where; to be added to its input."""

    width: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Array, offsets: Array, neighbours: Array) -> Array:
        h = nn.LayerNorm()(x)
        own = nn.Dense(self.width, dtype=self.dtype, name="own")(h)
        other = nn.Dense(self.width, use_bias=False, dtype=self.dtype, name="other")(h)
        place = nn.Dense(self.width, use_bias=False, dtype=self.dtype, name="place")(offsets)
        strongest = jax.vmap(strongest_response)(other, own[..., None, :] + place, neighbours)
        return nn.Dense(self.width, dtype=self.dtype, name="out")(strongest).astype(jnp.float32)


class SegmentationNetwork(nn.Module):
    """See the module's text. With the order of the points, that of what is said of them changes, and nothing else."""

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


def told_by(network: SegmentationNetwork, parameters: Any, points: Float[Array, "batch p 3"]) -> SegmentationOutput:
    """What the network with these parameters says of clouds."""
    return cast(SegmentationOutput, network.apply({"params": parameters}, points))
