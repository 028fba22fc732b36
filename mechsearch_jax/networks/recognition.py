"""The recognition network: from a segment's cloud to size, exponents and pose (paper section 4.1, B.1).

The output is a mixture of hypotheses (classification of a coarse orientation, regression of the residual): a box at one
of six yaw angles within a quarter turn, a standing cylinder, and a lying cylinder at one of six yaw angles within half
a turn. For each hypothesis the network gives a logit, a small residual rotation, size, exponents and position. So the
regression targets are continuous where the paper's parametrisation jumps, as for boxes whose yaw passes 90 degrees and
whose width and depth swap. A prior is that objects stand on the board: height is relative to resting on it, and tilt
relative to being level.
"""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mechsearch_jax.geometry.transforms import matmul
from mechsearch_jax.images.segments import MARKS
from mechsearch_jax.networks.layers import Attention, FeedForward, fourier_features
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.shapes import by_shape, shape_of

BOX_YAWS, LYING_YAWS = 6, 6
HYPOTHESES = BOX_YAWS + 1 + LYING_YAWS
STANDING = BOX_YAWS
# The code of each hypothesis' shape, and whether it is round.
HYPOTHESIS_KINDS = np.repeat([shape_of("box").code, shape_of("cylinder").code], [STANDING, HYPOTHESES - STANDING])
IS_ROUND = by_shape(HYPOTHESIS_KINDS, lambda shape: shape.round, np)
EXPONENT_RANGE = (0.05, 1.2)
# Units of the network's outputs: rotation [rad], logarithm of size, position [m], exponents before their sigmoid.
_TURN, _SIZE, _SHIFT = 0.3, 0.04, 0.1
_SHARP, _ROUND = 0.08, 1.0
OUTPUTS = 11
UNCERTAIN = 6


def _yaws(count: int, period: float) -> np.ndarray:
    """Matrices of evenly spread yaw angles, the middles of `count` parts of `period`."""
    yaw = (np.arange(count) + 0.5) * period / count
    zero, unit = np.zeros(count), np.ones(count)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c, -s, zero, s, c, zero, zero, zero, unit], axis=-1).reshape(count, 3, 3)


_LAID = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
BASE_ROTATIONS = np.concatenate([_yaws(BOX_YAWS, np.pi / 2), np.eye(3)[None], _yaws(LYING_YAWS, np.pi) @ _LAID]).astype(
    np.float32
)


@dataclasses.dataclass(frozen=True)
class RecognitionConfig:
    """Sizes of the network.

    Attributes:
      width: of a token.
      layers: number of attention and feed-forward layers.
      heads: of an attention layer.
    """

    width: int = 192
    layers: int = 4
    heads: int = 6

    def __post_init__(self):
        if min(self.width, self.layers, self.heads) < 1 or self.width % self.heads:
            raise InputError("RecognitionConfig: width, layers and heads must be positive, and heads divide width")


class Hypotheses(PyTreeNode):
    """Hypotheses about a segment, in the segment's frame; every field has the leading axes (..., 13).

    Attributes:
      logit: of the probability of each.
      size: half-extents [m], (..., 13, 3).
      exponents: (e1, e2), (..., 13, 2).
      position: `t_segment_object` [m], (..., 13, 3).
      rotation: `R_segment_object`, (..., 13, 3, 3).
      turn: residual rotation vector after the hypothesis' coarse orientation [rad], (..., 13, 3).
      log_scale: logarithm of the expected absolute error [m] of size and position, (..., 13, 6).
    """

    logit: jax.Array
    size: jax.Array
    exponents: jax.Array
    position: jax.Array
    rotation: jax.Array
    turn: jax.Array
    log_scale: jax.Array


def rotation_of(turn: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """The rotation matrix of a rotation vector [rad] (Rodrigues' formula); smooth at zero."""
    square = jnp.sum(turn**2, axis=-1)[..., None, None]
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    first = jnp.where(small, 1.0 - square / 6.0, jnp.sin(angle) / angle)
    second = jnp.where(small, 0.5 - square / 24.0, (1.0 - jnp.cos(angle)) / angle**2)
    x, y, z = (turn[..., i] for i in range(3))
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*turn.shape, 3)
    identity = jnp.eye(3).reshape(*[1] * (turn.ndim - 1), 3, 3)
    return identity + first * cross + second * matmul(cross, cross)


def resting_height(
    size: Float[Array, "*batch 3"], rotation: Float[Array, "*batch 3 3"], kind: Int[Array, "..."]
) -> Float[Array, "*batch"]:
    """Height of a body's centre above its lowest point [m]; `kind` is the code of its shape."""
    return by_shape(kind, lambda shape: shape.reach(rotation[..., 2, :], size, jnp), jnp)


def _inverse_sigmoid(exponent: float) -> float:
    low, high = EXPONENT_RANGE
    share = (exponent - low) / (high - low)
    return float(np.log(share / (1.0 - share)))


def decode(outputs: Float[Array, "*batch k o"], logit: Float[Array, "*batch k"]) -> Hypotheses:
    """Hypotheses from the network's outputs; zeros are 8 cm cubes and cylinders on the board, at the segment's origin.

    Args:
      outputs: for each hypothesis, rotation (3), size (3), position (3), exponents (2), logarithms of errors (6).
      logit: of each hypothesis.
    """
    batch = [1] * (outputs.ndim - 2)
    is_round = jnp.asarray(IS_ROUND).reshape(*batch, HYPOTHESES)
    turn = _TURN * outputs[..., :3]
    # A round object has no rotation about its axis, and one radius.
    turn = jnp.where(is_round[..., None] & (jnp.arange(3) == 2).reshape(*batch, 1, 3), 0.0, turn)
    base = jnp.asarray(BASE_ROTATIONS).reshape(*batch, HYPOTHESES, 3, 3)
    rotation = matmul(base, rotation_of(turn))
    raw_size = jnp.where(is_round[..., None], outputs[..., jnp.array([3, 3, 5])], outputs[..., 3:6])
    size = _SIZE * jnp.exp(jnp.clip(raw_size, -3.0, 2.0))
    rest = resting_height(size, rotation, jnp.asarray(HYPOTHESIS_KINDS).reshape(*batch, HYPOTHESES))
    position = _SHIFT * outputs[..., 6:9]
    position = position.at[..., 2].add(rest)
    bias = np.where(IS_ROUND, _inverse_sigmoid(_ROUND), _inverse_sigmoid(_SHARP))
    bias = np.stack([np.full(HYPOTHESES, _inverse_sigmoid(_SHARP)), bias], axis=-1).astype(np.float32)
    low, high = EXPONENT_RANGE
    exponents = low + (high - low) * jax.nn.sigmoid(outputs[..., 9:11] + bias.reshape(*batch, HYPOTHESES, 2))
    log_scale = jnp.log(0.005) + jnp.clip(outputs[..., 11:17], -5.0, 5.0)
    return Hypotheses(logit, size, exponents, position, rotation, turn, log_scale)


class RecognitionNetwork(nn.Module):
    """Self-attention among a segment's points and one summary token; see the module's docstring.

    Permutation-invariant over a segment's points, and independent between segments.
    """

    config: RecognitionConfig = RecognitionConfig()
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(
        self, points: Float[Array, "s p 3"], mark: Int[Array, "s p"], camera: Float[Array, "s 3"]
    ) -> Hypotheses:
        """Args:
        points: of each segment, in its frame [m].
        mark: their fourth channel, see `images.segments`.
        camera: the camera's position in that frame [m].
        """
        config = self.config
        marks = jax.nn.one_hot(mark, MARKS)
        features = jnp.concatenate([fourier_features(points), marks], axis=-1)
        x = nn.Dense(config.width, name="points")(features)
        x = x + nn.Dense(config.width, name="embed")(nn.gelu(nn.Dense(config.width, name="widen")(features)))
        whole = nn.Dense(config.width, name="whole")(camera)[:, None]
        x = jnp.concatenate([whole, x], axis=1)
        for _ in range(config.layers):
            x = x + Attention(config.width, config.heads, self.dtype)(x)
            x = x + FeedForward(config.width, dtype=self.dtype)(x)
        x = nn.LayerNorm()(x)
        is_segment = (mark > 0) & (mark < MARKS - 1)
        share = is_segment / jnp.maximum(jnp.sum(is_segment, axis=-1, keepdims=True), 1)
        pooled = jnp.concatenate([x[:, 0], jnp.sum(x[:, 1:] * share[..., None], axis=1)], axis=-1)
        pooled = nn.gelu(nn.Dense(2 * config.width, name="summary")(pooled))
        logit = nn.Dense(HYPOTHESES, name="logit")(pooled)
        outputs = nn.Dense(
            HYPOTHESES * (OUTPUTS + UNCERTAIN), name="outputs", kernel_init=nn.initializers.normal(1e-3)
        )(pooled)
        return decode(outputs.reshape(-1, HYPOTHESES, OUTPUTS + UNCERTAIN), logit)


def apply_network(
    network: RecognitionNetwork,
    parameters: Any,
    points: Float[Array, "s p 3"],
    mark: Int[Array, "s p"],
    camera: Float[Array, "s 3"],
) -> Hypotheses:
    """The network's forward pass: the hypotheses of a batch of segments, in the segments' frames.

    Args:
      network, parameters: the network and its Flax parameters.
      points: of each segment, in its frame [m].
      mark: their fourth channel, see `images.segments`.
      camera: the camera's position in that frame [m].
    """
    return cast(Hypotheses, network.apply({"params": parameters}, points, mark, camera))
