"""What the networks are made of: attention, feed-forward layers and an encoding of positions.

Products are computed in `dtype`, which is bfloat16 in training; sums, norms and what flows from layer to layer stay in
float32, so that millimetres survive.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def fourier_features(points: Float[Array, "*batch 3"], octaves: int = 6) -> Float[Array, "*batch features"]:
    """Positions [m] with their sines and cosines at wavelengths from 0.8 m downwards, each half the one before."""
    waves = jnp.asarray(2.0 * np.pi / 0.8 * 2.0 ** np.arange(octaves), jnp.float32)
    angle = points[..., :, None] * waves.reshape(*[1] * points.ndim, -1)
    angle = angle.reshape(*points.shape[:-1], -1)
    return jnp.concatenate([10.0 * points, jnp.sin(angle), jnp.cos(angle)], axis=-1)


class FeedForward(nn.Module):
    """Normalise, widen, bend, narrow; to be added to its input. `dense(features, dtype=...)` makes its two layers."""

    width: int
    growth: int = 4
    dtype: Any = jnp.float32
    dense: Callable[..., nn.Module] = nn.Dense

    @nn.compact
    def __call__(self, x: Array) -> Array:
        h = nn.LayerNorm()(x)
        h = self.dense(self.growth * self.width, dtype=self.dtype)(h)
        return self.dense(self.width, dtype=self.dtype)(nn.gelu(h)).astype(jnp.float32)


class Attention(nn.Module):
    """What tokens (..., n, width) gather from others (..., m, width), normalised first; to be added to the former."""

    width: int
    heads: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Array, others: Array | None = None) -> Array:
        own = nn.LayerNorm()(x)
        source = own if others is None else nn.LayerNorm()(others)
        query, keys, values = (
            nn.DenseGeneral((self.heads, self.width // self.heads), dtype=self.dtype, name=name)(tokens)
            for name, tokens in (("query", own), ("key", source), ("value", source))
        )
        gathered = jax.nn.dot_product_attention(query, keys, values)
        out = nn.DenseGeneral(self.width, axis=(-2, -1), dtype=self.dtype, name="out")(gathered)
        return out.astype(jnp.float32)
