"""Which recognised bodies are one: by `separate` none, by `join_floating` those that float and what they touch.

Things stand on the board, so that a body above it is a piece of another one, such as the neck of a bottle whose segment
was divided.
"""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.perception.parts.unions import Evidence, distance

# A body floats whose lowest point is higher above the board than this [m].
FLOATS = 0.01
# It touches another one if a point of the image of either is this near to the surface of the other [m].
TOUCHES = 0.01


class Joining(Protocol):
    """Decides which recognised bodies are one. It is traced, and hashable: a function, not a new lambda each time."""

    def __call__(
        self, parts: Superquadrics, evidence: Evidence, board: Array | float
    ) -> tuple[Superquadrics, Int[Array, " n"]]:
        """Join bodies.

        Args:
          parts: of N bodies in the world, fields (N, P, ...).
          evidence: the points of each body's segment, fields (N, ...).
          board: height of the board [m].

        Returns:
          The parts, in the same shapes: those of joined bodies with the body that they belong to, none left where they
          were. And for each body the number of the one that it belongs to: its own where it is not joined or not
          there, never that of a body which is joined itself.
        """
        ...


def separate(parts: Superquadrics, evidence: Evidence, board: Array | float) -> tuple[Superquadrics, Int[Array, " n"]]:
    """The `Joining` by which every body stays one of its own; parts (N, P, ...) as they are, and numbers (N,)."""
    return parts, jnp.arange(parts.valid.shape[0])


def join_floating(
    parts: Superquadrics, evidence: Evidence, board: Array | float
) -> tuple[Superquadrics, Int[Array, " n"]]:
    """The `Joining` after which no body floats that touches another one.

    The floating body that is nearest to another is joined to it, as often as there is one. Of more parts than there is
    room for, the largest are kept.

    Args:
      parts, evidence, board: see `Joining`.

    Returns:
      See `Joining`.
    """
    n = parts.valid.shape[0]
    there = jnp.any(parts.valid, axis=1)
    gaps = _gaps(parts, evidence)
    others = there[:, None] & there[None] & ~jnp.eye(n, dtype=bool)
    apart = jnp.where(others, jnp.minimum(gaps, gaps.T), jnp.inf)

    def join(_, state):
        parts, owner, apart = state
        touches = _floats(parts, board)[:, None] & (apart < TOUCHES)
        nearest = jnp.argmin(jnp.where(touches, apart, jnp.inf))
        piece, body = nearest // n, nearest % n
        joined = _with_piece(parts, piece, body)
        nearer = jnp.minimum(apart[body], apart[piece]).at[body].set(jnp.inf)
        after = apart.at[body].set(nearer).at[:, body].set(nearer)
        after = after.at[piece].set(jnp.inf).at[:, piece].set(jnp.inf)
        return jax.tree.map(
            lambda a, b: jnp.where(jnp.any(touches), a, b),
            (joined, jnp.where(owner == piece, body, owner), after),
            state,
        )

    parts, owner, _ = jax.lax.fori_loop(0, n - 1, join, (parts, jnp.arange(n), apart))
    return parts, owner


def _gaps(parts: Superquadrics, evidence: Evidence) -> Float[Array, "n n"]:
    """How near a point of the segment of each body is to the surface of each other one [m]."""
    off = jax.vmap(lambda points: jax.vmap(lambda body: jnp.abs(distance(body, points)))(parts))(evidence.points)
    counts = (evidence.point_weight > 0)[:, None, None] & parts.valid[None, :, :, None]
    return jnp.min(jnp.where(counts, off, jnp.inf), axis=(2, 3))


def _floats(parts: Superquadrics, board: Array | float) -> Bool[Array, " n"]:
    """Which bodies are nowhere near the board."""
    # The rows of the rotation are the world's axes in the part's frame.
    reach = superquadric.support(parts.size, parts.exponents, parts.rotation[..., 2, :])
    low = jnp.where(parts.valid, parts.position[..., 2] - reach, jnp.inf)
    return jnp.any(parts.valid, axis=1) & (jnp.min(low, axis=1) > board + FLOATS)


def _with_piece(parts: Superquadrics, piece: Int[Array, ""], body: Int[Array, ""]) -> Superquadrics:
    """The parts with those of a piece as parts of a body, and the piece absent."""
    p = parts.valid.shape[1]
    both = jax.tree.map(lambda a: jnp.concatenate([a[body], a[piece]]), parts)
    largest = jnp.argsort(jnp.where(both.valid, -jnp.prod(both.size, axis=-1), jnp.inf), stable=True)[:p]
    joined = jax.tree.map(lambda a, b: a.at[body].set(b[largest]), parts, both)
    return joined.replace(valid=joined.valid.at[piece].set(False))
