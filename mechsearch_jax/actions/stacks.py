"""Objects that stand on others: what carries something is neither picked nor pushed before it, and no push touches it.

What is on top is picked like any other object, and put down on the board.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions.config import ActionSpace
from mechsearch_jax.geometry.footprints import STACKED, Footprints, supports


class Stacks(NamedTuple):
    """Which of N objects stand on others; nothing does with `ActionConfig.as_in_paper`.

    Attributes:
      carries: which object (row) carries which (column), shape (N, N).
      aloft: which do not stand on the board, though what carries them may not be recognised, shape (N,).
    """

    carries: Bool[Array, "n n"]
    aloft: Bool[Array, " n"]


def stacks(space: ActionSpace, prints: Footprints) -> Stacks:
    """The stacks of a scene, from the footprints of its objects."""
    carries = supports(prints) & (not space.config.as_in_paper)
    return Stacks(carries, prints.valid & (jnp.any(carries, axis=0) | (lift(space, prints.low) > 0.0)))


def lift(space: ActionSpace, lowest: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """How far above the board objects with these lowest points are [m]; 0 within `STACKED`, and as in the paper."""
    above = lowest - space.shelf.board
    return jnp.where((above > STACKED) & (not space.config.as_in_paper), above, 0.0)
