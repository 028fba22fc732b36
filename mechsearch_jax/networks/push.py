"""The network that predicts a push: how every object moves in the plane, whether it moves at all, whether it topples.

Like SQPD-Net (S. Kim et al., "SE(2)-equivariant pushing dynamics models for tabletop object manipulations", 2022) it
sees every object in a planar frame of its own and its neighbours from there. The frame has its origin in the object's
centre and its first axis along the push, and an object is described by how far it reaches in a few directions: so a box
turned by half a turn, or a cylinder turned at all, is the same to the network, and turning and moving everything turns
and moves the answer. A push and its mirror image are looked at together, by layers that treat both alike, so that what
is symmetric stays symmetric. Walls are seen by how near they are, and not at all beyond `REACH`.

`push_geometry` computes the network's input features from a `PushStart`, and `PushNetwork` maps a `PushStart` to a
`PushMotion`. As a baseline that is not equivariant, the same network can be given the features in the world's frame.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, Literal, cast

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array

from mechsearch_jax.networks.layers import FeedForward
from mechsearch_jax.networks.push_geometry import (
    Parity,
    PushGeometry,
    PushStart,
    perpendicular,
    push_geometry,
)
from mechsearch_jax.runtime.errors import InputError

# Units of the network's outputs: lengths [m], angles [rad].
_SHIFT, _TURN = 0.05, 0.3
_EVEN, _ODD = 5, 2
# Weaker than any neighbour.
_NOBODY = -1e9


@dataclasses.dataclass(frozen=True)
class PushConfig:
    """Sizes of the network, and the frame of its input features.

    Attributes:
      width: of what is known of an object.
      layers: of messages between objects.
      frame: "push" for each object's own frame along the push; "world" for the baseline without symmetry, which has as
        many parameters as the other if it is 1.4 times as wide.
    """

    width: int = 64
    layers: int = 3
    frame: Literal["push", "world"] = "push"

    def __post_init__(self):
        if self.width < 2 or self.layers < 1:
            raise InputError("PushConfig: width must be at least 2 and layers at least 1")
        if self.frame not in ("push", "world"):
            raise InputError(f'PushConfig: frame "{self.frame}" is unknown; use "push" or "world"')


class PushMotion(flax.struct.PyTreeNode):
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
    """Numbers of a push and of its mirror image, (2, ...), from what is even and what is odd in them (...)."""
    return math.sqrt(0.5) * jnp.stack([halves.even + halves.odd, halves.even - halves.odd])


def _split(images: Array) -> Parity:
    """The inverse of `_join`."""
    return Parity(math.sqrt(0.5) * (images[0] + images[1]), math.sqrt(0.5) * (images[0] - images[1]))


class MirrorDense(nn.Module):
    """A dense layer on a push and its mirror image, (2, ..., width): if they are exchanged, so is what comes out.

    Its matrix is one for what is even in them and another for what is odd, which costs no more than one for each image.
    Without `symmetric` there is one image, (1, ..., width), and the layer is an ordinary one. The features of a push
    come in as its `Parity`, (..., width).
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
    """A message from the strongest neighbour of each object, by what both are and how they stand; to be added."""

    width: int
    symmetric: bool
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Array, pairs: Parity, other: Array) -> Array:
        dense = functools.partial(MirrorDense, self.width, self.symmetric, dtype=self.dtype)
        h = nn.LayerNorm()(x)
        own = dense(name="own")(h)
        theirs = dense(use_bias=False, name="theirs")(h)
        pair = dense(use_bias=False, name="pair")(pairs)
        # What an object is itself does not change which neighbour is the strongest, in each channel by itself. The
        # inner `where` keeps `gelu` and its gradient from `_NOBODY`.
        strongest = jnp.max(jnp.where(other[None, ..., None], theirs[:, None] + pair, _NOBODY), axis=-2)
        alone = ~jnp.any(other, axis=-1)[None, :, None]
        message = jnp.where(alone, 0.0, nn.gelu(own + jnp.where(alone, 0.0, strongest)))
        return dense(name="out")(message).astype(jnp.float32)


class PushTrunk(nn.Module):
    """From the features of a push to numbers for each object, (N, 5) even and (N, 2) odd ones.

    What is said of absent objects means nothing.
    """

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
        # Nothing is said of a wall out of reach: its bias too fades with the distance.
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
    """Permutation-equivariant over objects: reordering them reorders the motions. See the module's text."""

    config: PushConfig = PushConfig()
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, start: PushStart) -> PushMotion:
        geometry = push_geometry(start, self.config.frame)
        outputs = cast(Parity, PushTrunk(self.config, self.dtype, name="trunk")(geometry))
        x, y = geometry.axis[None], perpendicular(geometry.axis)[None]
        # In the mirror, what goes to the left goes to the right, and turns are the other way round.
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
