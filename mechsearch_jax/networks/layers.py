"""Layers of the networks: attention, feed-forward layers and an encoding of positions.

Products are computed in `dtype`, bfloat16 in training; sums, norms and the residual stream are float32, which resolves
millimetres.
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
    """Positions [m] with their sines and cosines at wavelengths of 0.8 m, 0.4 m, 0.2 m, ..."""
    waves = jnp.asarray(2.0 * np.pi / 0.8 * 2.0 ** np.arange(octaves), jnp.float32)
    angle = points[..., :, None] * waves.reshape(*[1] * points.ndim, -1)
    angle = angle.reshape(*points.shape[:-1], -1)
    return jnp.concatenate([10.0 * points, jnp.sin(angle), jnp.cos(angle)], axis=-1)


class FeedForward(nn.Module):
    """A residual branch: norm, dense layer, GELU, dense layer. `dense(features, dtype=...)` makes the two layers."""

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
    """A residual branch: norm, then attention of tokens (..., n, width) to a context (..., m, width) or themselves."""

    width: int
    heads: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Array, context: Array | None = None) -> Array:
        target = nn.LayerNorm()(x)
        source = target if context is None else nn.LayerNorm()(context)
        query, keys, values = (
            nn.DenseGeneral((self.heads, self.width // self.heads), dtype=self.dtype, name=name)(tokens)
            for name, tokens in (("query", target), ("key", source), ("value", source))
        )
        gathered = jax.nn.dot_product_attention(query, keys, values)
        out = nn.DenseGeneral(self.width, axis=(-2, -1), dtype=self.dtype, name="out")(gathered)
        return out.astype(jnp.float32)
