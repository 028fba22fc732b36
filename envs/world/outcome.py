"""What became of an action, as every simulator tells it."""

from __future__ import annotations

import enum

import flax.struct
import jax
import jax.numpy as jnp


class Failure(enum.IntEnum):
    """Why an action was not executed as commanded.

    `UNREACHABLE`: the arm cannot follow the motion; nothing moved. `DROPPED`: the object slipped out of the hand on
    its way. `UNSTABLE`: the simulation diverged; the world is as before. `UNKNOWN`: there is no such kind of action;
    nothing moved. `HELD_UP`: something was in the arm's way, so that a joint was farther from its reference than
    `SimulatorConfig.tracking_bound`. In any other case the world is as it became.

    Of an action that takes the target out: `MISSED`: the target is not between the closed fingers. `INSIDE`: it is, but
    not outside the shelf. `FALLEN`: some body fell off the board meanwhile.

    Where several apply, the first of `UNKNOWN`, `UNREACHABLE`, `UNSTABLE`, `HELD_UP`, `DROPPED`, `MISSED`, `INSIDE`,
    `FALLEN` is told.
    """

    NONE = 0
    UNREACHABLE = 1
    DROPPED = 2
    UNSTABLE = 3
    MISSED = 4
    INSIDE = 5
    FALLEN = 6
    UNKNOWN = 7
    HELD_UP = 8

    @property
    def text(self) -> str | None:
        """What records say of it; None for `NONE`."""
        if self is Failure.NONE:
            return None
        return "the arm was held up" if self is Failure.HELD_UP else self.name.lower()


class Overflow(enum.IntFlag):
    """What was too small for a world's contacts while it was simulated; its result cannot be trusted then.

    `ROWS` (more constraint rows than `njmax`) and `SHAPES` (a buffer of the convex collision) are a world's own.
    `CONTACTS` is the buffer that all worlds share: which of them lost contacts is not known, so that every world which
    was running at that moment is marked.
    """

    NONE = 0
    ROWS = 1
    CONTACTS = 2
    SHAPES = 4


class Outcome(flax.struct.PyTreeNode):
    """What an action did, with any leading axes, for example one for the worlds.

    Attributes:
      failure: a `Failure`, int32.
      steps: simulated time steps, int32; 0 where nothing was to be done, or it was out of reach.
      settled: whether everything came to rest in the time that there is for it; what did not was stopped as it moved.
      fallen: which bodies are off the board, since then or before, the target last, shape (..., 9); never a target in
        the hand.
      held: after a retrieval, whether the target is between the closed fingers; False after anything else.
      outside: after a retrieval, whether the target is outside the shelf; False after anything else.
      retrieved: whether a retrieval took the target out and no body fell off the board meanwhile.
      overflow: flags of `Overflow`, int32; always 0 in the native simulator.
      tracking_error: how far the joint that was farthest from its reference was from it [rad]; 0 where nothing moved.
    """

    failure: jax.Array
    steps: jax.Array
    settled: jax.Array
    fallen: jax.Array
    held: jax.Array
    outside: jax.Array
    retrieved: jax.Array
    overflow: jax.Array
    tracking_error: jax.Array

    @property
    def took_place(self) -> jax.Array:
        """Whether the world is what the action made of it; False where a failure left or put everything as it was."""
        undone = (Failure.UNREACHABLE, Failure.UNKNOWN, Failure.UNSTABLE)
        return jnp.all(jnp.stack([self.failure != int(code) for code in undone]), axis=0)

    def reason(self, i: int | tuple[int, ...] = ()) -> str | None:
        """Why the action failed, in a few words, or None; of a batch, that at index `i`."""
        return Failure(int(self.failure[i])).text
