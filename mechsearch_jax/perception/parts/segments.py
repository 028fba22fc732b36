"""Segments of things of any shape from those of the segmentation network, which knows boxes and cylinders.

Of a thing that is no box or cylinder the network makes several segments, and one of things that stand apart. Nearby
pixels whose points are near show the same thing more often than the network says: so its segments are cut where depth
jumps, and those are joined that border on each other over some length without a jump.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from mechsearch_jax.images.labels import CAPACITY, OTHER
from mechsearch_jax.perception.explanation import Fitted, Fitter, as_segmented
from mechsearch_jax.perception.hypotheses import bordering, connected
from mechsearch_jax.perception.recognition import LabelledImage, ShapeNetwork
from mechsearch_jax.perception.refinement import RefinementConfig
from mechsearch_jax.perception.selection import check_numbers
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# The largest connected pieces of segments that are kept; further ones are crumbs.
_PIECES = 32


@dataclasses.dataclass(frozen=True)
class SegmentsConfig:
    """Which pixels show one thing.

    Attributes:
      jump: neighbouring pixels whose points are farther apart are not connected [m].
      border: connected pieces are joined that have more than so many neighbouring pixels in common, of the thinned
        image, in which a metre at the middle of the board has about 400.
      least: smaller segments are no things [pixels of the same image].
    """

    jump: float = 0.02
    border: float = 12.0
    least: float = 12.0

    def __post_init__(self):
        check_numbers(self, positive=("jump",))


@dataclasses.dataclass(frozen=True)
class Connected:
    """The `Fitter` that hands another one connected segments.

    Attributes:
      of: the other one.
      config: of the segments.
    """

    of: Fitter = as_segmented
    config: SegmentsConfig = dataclasses.field(default_factory=SegmentsConfig)

    def __call__(
        self,
        keys: Key[Array, "2"],
        image: LabelledImage,
        shapes: ShapeNetwork,
        camera: Camera,
        shelf: Shelf,
        target: Target,
        refinement: RefinementConfig,
        least: Float[Array, ""] | float = 0.0,
    ) -> Fitted:
        labels = connected_segments(image.points, image.labels, self.config, least, image.capacity)
        return self.of(keys, image.replace(labels=labels), shapes, camera, shelf, target, refinement, least)


@cached_jit(static_argnames=("config", "capacity"))
def connected_segments(
    points: Float[Array, "h w 3"],
    labels: Int[Array, "h w"],
    config: SegmentsConfig,
    least: Float[Array, ""] | float = 0.0,
    capacity: int = CAPACITY,
) -> Int[Array, "h w"]:
    """Labels whose segments are cut where depth jumps, and joined where it does not.

    Of more than `capacity` the largest are kept; pixels of the others become OTHER. Approximation: two things that
    touch without a jump in depth along a border of more than `config.border` pixels are taken for one.

    Args:
      points: in the world [m].
      labels: as of `images.labels`.
      config: static.
      least: segments of at most so many pixels become OTHER, too.
      capacity: static.
    """
    numbers = connected(points, labels, config.jump).reshape(-1)
    in_segment = (labels >= 0).reshape(-1)
    sizes = jnp.zeros(labels.size, jnp.int32).at[numbers].add(in_segment.astype(jnp.int32))
    sizes, first = jax.lax.top_k(sizes, _PIECES)
    # The piece of each pixel, or OTHER.
    piece_of = jnp.full(labels.size, OTHER).at[first].set(jnp.where(sizes > 0, jnp.arange(_PIECES), OTHER))
    pieces = jnp.where(in_segment, piece_of[numbers], OTHER)
    borders = bordering(points, pieces.reshape(labels.shape), config.jump, _PIECES)

    def join(_, state):
        owner, borders = state
        longest = jnp.argmax(borders)
        one, other = longest // _PIECES, longest % _PIECES
        both = (borders[one] + borders[other]).at[one].set(0.0)
        after = borders.at[one].set(both).at[:, one].set(both).at[other].set(0.0).at[:, other].set(0.0)
        joins = borders[one, other] > config.border
        return (
            jnp.where(joins, jnp.where(owner == other, one, owner), owner),
            jnp.where(joins, after, borders),
        )

    owner, _ = jax.lax.fori_loop(0, _PIECES - 1, join, (jnp.arange(_PIECES), borders + borders.T))
    total = jnp.zeros(_PIECES, jnp.int32).at[owner].add(sizes)
    pixels, largest = jax.lax.top_k(total, capacity)
    enough = (pixels >= config.least) & (pixels > least)
    slot_of = jnp.full(_PIECES, OTHER).at[largest].set(jnp.where(enough, jnp.arange(capacity), OTHER))
    joined = jnp.where(pieces >= 0, slot_of[owner[jnp.maximum(pieces, 0)]], OTHER)
    return jnp.where(labels >= 0, joined.reshape(labels.shape), labels).astype(labels.dtype)
