"""The network that predicts a push: how every object moves in the plane, whether it moves at all, whether it topples.

Like SQPD-Net (S. Kim et al., "SE(2)-equivariant pushing dynamics models for tabletop object manipulations", 2022) it
has the features of every object and its neighbours in the object's planar frame. The frame has its origin in the
object's centre and its first axis along the push, and an object is described by its extents in a few directions. So the
features do not change if a box is turned by half a turn or a cylinder by any angle, and the output is equivariant under
planar motions of everything. Layers act on a push and its mirror image together, so that the network is equivariant
under reflection, too. Walls enter by their distance, up to `REACH`.

`push_geometry` computes the network's input features from a `PushStart`, and `PushNetwork` maps a `PushStart` to a
`PushMotion`. As a baseline that is not equivariant, the same network can use features in the world's frame.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, Literal, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array

from mechsearch_jax.networks.layers import FeedForward
from mechsearch_jax.networks.push_contacts import perpendicular
from mechsearch_jax.networks.push_geometry import Parity, PushGeometry, PushStart, push_geometry
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode

# Units of the network's outputs: lengths [m], angles [rad].
_SHIFT, _TURN = 0.05, 0.3
_EVEN, _ODD = 5, 2
# Stands for an absent neighbour in a maximum.
_NOBODY = -1e9


@dataclasses.dataclass(frozen=True)
class PushConfig:
    """Sizes of the network, and the frame of its input features.

    Attributes:
      width: of an object's features.
      layers: number of message layers.
      frame: "push" for each object's frame along the push; "world" for the baseline without symmetry, which has the
        same number of parameters at 1.4 times the width.
    """

    width: int = 64
    layers: int = 3
    frame: Literal["push", "world"] = "push"

    def __post_init__(self):
        if self.width < 2 or self.layers < 1:
            raise InputError("PushConfig: width must be at least 2 and layers at least 1")
        if self.frame not in ("push", "world"):
            raise InputError(f'PushConfig: frame "{self.frame}" is unknown; use "push" or "world"')


class PushMotion(PyTreeNode):
    """The network's output for each object; every field has the leading axis (N,).

    Attributes:
      shift: planar motion of its centre in the world, if it moves [m], (N, 2).
      turn: about the vertical, if it moves; 0 for a round object [rad].
      moves: logit of the probability that it moves.
      topples: logit of the probability that it falls over, or off the board.
      log_scale: logarithms of the expected absolute errors of shift [m] and turn [rad], (N, 2).
    """

    shift: jax.Array
    turn: jax.Array
    moves: jax.Array
    topples: jax.Array
    log_scale: jax.Array


def _join(halves: Parity) -> Array:
    """Features of a push and of its mirror image, (2, ...), from their even and odd parts (...)."""
    return math.sqrt(0.5) * jnp.stack([halves.even + halves.odd, halves.even - halves.odd])


def _split(images: Array) -> Parity:
    """The inverse of `_join`."""
    return Parity(math.sqrt(0.5) * (images[0] + images[1]), math.sqrt(0.5) * (images[0] - images[1]))


class MirrorDense(nn.Module):
    """A dense layer on a push and its mirror image, (2, ..., width), equivariant under their exchange.

    It has one matrix for the even part and one for the odd part, at the cost of one matrix for each image. If not
    `symmetric`, there is one image, (1, ..., width), and the layer is an ordinary one. The first layer takes the
    features of a push as a `Parity`, (..., width).
    """

    features: int
    symmetric: bool
    use_bias: bool = True
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Parity | Array) -> Array:
        even = nn.Dense(self.features, use_bias=self.use_bias, dtype=self.dtype, name="even")
        if not self.symmetric:
            return even(jnp.concatenate([x.even, x.odd], axis=-1)[None] if isinstance(x, Parity) else x)
        odd = nn.Dense(self.features, use_bias=False, dtype=self.dtype, name="odd")
        halves = x if isinstance(x, Parity) else _split(x)
        return _join(Parity(even(halves.even), odd(halves.odd)))


class Messages(nn.Module):
    """A residual branch: a message to each object, by a maximum over its neighbours in each channel."""

    width: int
    symmetric: bool
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Array, pairs: Parity, other: Array) -> Array:
        dense = functools.partial(MirrorDense, self.width, self.symmetric, dtype=self.dtype)
        h = nn.LayerNorm()(x)
        receiver = dense(name="own")(h)
        sender = dense(use_bias=False, name="theirs")(h)
        pair = dense(use_bias=False, name="pair")(pairs)
        # The receiver is added after the maximum, which it does not change. The inner `where` keeps `_NOBODY` out of
        # `gelu` and its gradient.
        strongest = jnp.max(jnp.where(other[None, ..., None], sender[:, None] + pair, _NOBODY), axis=-2)
        alone = ~jnp.any(other, axis=-1)[None, :, None]
        message = jnp.where(alone, 0.0, nn.gelu(receiver + jnp.where(alone, 0.0, strongest)))
        return dense(name="out")(message).astype(jnp.float32)


class PushTrunk(nn.Module):
    """From the features of a push to outputs for each object, (N, 5) even and (N, 2) odd; arbitrary for absent ones."""

    config: PushConfig
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, geometry: PushGeometry) -> Parity:
        width, symmetric = self.config.width, self.config.frame == "push"
        dense = functools.partial(MirrorDense, symmetric=symmetric)
        n = geometry.valid.shape[0]
        other = geometry.valid[None] & geometry.valid[:, None] & ~jnp.eye(n, dtype=bool)
        x = dense(width, name="objects")(geometry.objects)
        x = x + dense(width, name="bend")(nn.gelu(dense(2 * width, name="widen")(geometry.objects)))
        # A wall out of reach has no effect: its bias fades with the distance, too.
        walls = nn.gelu(dense(width // 2, name="walls")(geometry.walls)) * geometry.wall_near[None, ..., None]
        x = x + dense(width, use_bias=False, name="met")(jnp.sum(walls, axis=-2))
        for i in range(self.config.layers):
            x = x + Messages(width, symmetric, self.dtype, name=f"messages_{i}")(x, geometry.pairs, other)
            x = x + FeedForward(width, 2, self.dtype, dense, name=f"forward_{i}")(x)
        small = nn.initializers.normal(1e-3)
        x = nn.LayerNorm(name="norm")(x)
        halves = _split(x) if symmetric else Parity(x[0], x[0])
        return Parity(
            even=nn.Dense(_EVEN, name="even", kernel_init=small)(halves.even),
            odd=nn.Dense(_ODD, use_bias=not symmetric, name="odd", kernel_init=small)(halves.odd),
        )


class PushNetwork(nn.Module):
    """The network, permutation-equivariant over objects. See the module's docstring."""

    config: PushConfig = PushConfig()
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, start: PushStart) -> PushMotion:
        geometry = push_geometry(start, self.config.frame)
        outputs = cast(Parity, PushTrunk(self.config, self.dtype, name="trunk")(geometry))
        x, y = geometry.axis[None], perpendicular(geometry.axis)[None]
        # The mirror image negates motions across the push and turns, which are odd.
        along, (across, turn) = outputs.even[:, 0], jnp.moveaxis(outputs.odd, -1, 0)
        planar = _SHIFT * jnp.stack([along, across], axis=-1) + geometry.carry[:, None] * geometry.heading[None]
        return PushMotion(
            shift=planar[:, :1] * x + planar[:, 1:] * y,
            turn=jnp.where(geometry.round, 0.0, _TURN * turn),
            moves=outputs.even[:, 1],
            topples=outputs.even[:, 2],
            log_scale=jnp.clip(outputs.even[:, 3:], -4.0, 3.0) + jnp.log(jnp.array([0.01, 0.05]))[None],
        )


def apply_network(network: PushNetwork, parameters: Any, start: PushStart) -> PushMotion:
    """The network's forward pass: the predicted motion of every object in a push."""
    return cast(PushMotion, network.apply({"params": parameters}, start))
