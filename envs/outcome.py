"""What became of an action, as every simulator tells it."""

from __future__ import annotations

import enum

import flax.struct
import jax


class Failure(enum.IntEnum):
    """Why an action was not executed as commanded.

    `UNREACHABLE`: the arm cannot follow the motion; nothing moved. `DROPPED`: the object slipped out of the hand on
    its way. `UNSTABLE`: the simulation diverged; the world is as before. `UNKNOWN`: there is no such kind of action;
    nothing moved. In any other case the world is as it became.

    Of an action that takes the target out: `MISSED`: the target is not between the closed fingers. `INSIDE`: it is, but
    not outside the shelf. `FALLEN`: some body has fallen off the board.
    """

    NONE = 0
    UNREACHABLE = 1
    DROPPED = 2
    UNSTABLE = 3
    MISSED = 4
    INSIDE = 5
    FALLEN = 6
    UNKNOWN = 7


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
      settled: whether everything was at rest at the end.
      fallen: which bodies have fallen off the board, the target last, shape (..., 9); never a target in the hand.
      held: after a retrieval, whether the target is between the closed fingers; False after anything else.
      outside: after a retrieval, whether the target is outside the shelf; False after anything else.
      retrieved: whether a retrieval took the target out and no body fell off the board.
      overflow: flags of `Overflow`, int32; always 0 in the native simulator.
    """

    failure: jax.Array
    steps: jax.Array
    settled: jax.Array
    fallen: jax.Array
    held: jax.Array
    outside: jax.Array
    retrieved: jax.Array
    overflow: jax.Array

    def reason(self, i: int | tuple[int, ...] = ()) -> str | None:
        """Why the action failed, in a word, or None; of a batch, that at index `i`."""
        failure = Failure(int(self.failure[i]))
        return None if failure is Failure.NONE else failure.name.lower()
