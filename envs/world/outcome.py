"""Outcome of an action, the same for every simulator."""

from __future__ import annotations

import enum

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from mechsearch_jax.envs.world.world import BODIES
from mechsearch_jax.runtime.pytree import PyTreeNode


class Failure(enum.IntEnum):
    """Why an action was not executed as commanded.

    `UNKNOWN`: there is no such kind of action; nothing moved. `UNREACHABLE`: the arm cannot follow the motion; nothing
    moved. `UNSTABLE`: the simulation diverged; the world is as before. `HELD_UP`: something was in the arm's way, so
    that a joint was farther from its reference than `SimulatorConfig.tracking_bound`, or an arm with an `arm_stop`
    stopped. `DROPPED`: the object slipped out of the hand on its way. After the last two the world is as the action
    left it.

    Retrievals only: `MISSED`: the target is not between the closed fingers. `INSIDE`: it is, but not outside the shelf.
    `FALLEN`: a body fell off the board meanwhile.

    If several apply, the failure is the first in this order.
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
        """The failure in words, for records; None for `NONE`."""
        if self is Failure.NONE:
            return None
        return "the arm was held up" if self is Failure.HELD_UP else self.name.lower()


class Overflow(enum.IntFlag):
    """The buffers that overflowed with a world's contacts during simulation; its result cannot be trusted then.

    `ROWS` (more constraint rows than `njmax`) and `SHAPES` (a buffer of the convex collision) concern a single world.
    `CONTACTS` is the buffer that all worlds share: as it is unknown which world lost contacts, every world that was
    running at that moment is marked.
    """

    NONE = 0
    ROWS = 1
    CONTACTS = 2
    SHAPES = 4


class Outcome(PyTreeNode):
    """Outcome of an action, with any leading axes, for example one for the worlds.

    Attributes:
      failure: a `Failure`, int32.
      steps: simulated time steps, int32; 0 if the action was out of reach or none.
      settled: whether everything came to rest within `SimulatorConfig.settle_steps`; what had not was stopped.
      restless: which bodies did not, the target last, shape (..., 9).
      fallen: which bodies are off the board, since this action or before, the target last, shape (..., 9); never a
        target in the hand.
      held: after a retrieval, whether the target is between the closed fingers; else False.
      outside: after a retrieval, whether the target is outside the shelf; else False.
      retrieved: whether a retrieval took the target out and no body fell off the board meanwhile.
      overflow: flags of `Overflow`, int32; always 0 in the native simulator.
      tracking_error: largest distance of a joint from its reference [rad]; 0 if nothing moved.
    """

    failure: jax.Array
    steps: jax.Array
    settled: jax.Array
    restless: jax.Array
    fallen: jax.Array
    held: jax.Array
    outside: jax.Array
    retrieved: jax.Array
    overflow: jax.Array
    tracking_error: jax.Array

    @property
    def took_place(self) -> jax.Array:
        """Whether the action changed the world; False if a failure left it, or restored it, as it was."""
        undone = (Failure.UNREACHABLE, Failure.UNKNOWN, Failure.UNSTABLE)
        return jnp.all(jnp.stack([self.failure != int(code) for code in undone]), axis=0)

    def reason(self, i: int | tuple[int, ...] = ()) -> str | None:
        """Why the action failed, in a few words, or None; `i` indexes a batch."""
        return Failure(int(self.failure[i])).text


def outcome_of(
    failure: Failure,
    steps: int,
    settled: bool,
    fallen: Bool[np.ndarray, " 9"],
    restless: Bool[np.ndarray, " 9"] | None = None,
    held: bool = False,
    outside: bool = False,
) -> Outcome:
    """The outcome of a single action, without a tracking error; no body is restless by default, nor in a world that
    was restored."""
    if restless is None or failure is Failure.UNSTABLE:
        restless = np.zeros(BODIES, bool)
    return Outcome(
        failure=jnp.int32(failure),
        steps=jnp.int32(steps),
        settled=jnp.array(settled),
        restless=jnp.asarray(restless),
        fallen=jnp.asarray(fallen),
        held=jnp.array(held),
        outside=jnp.array(outside),
        retrieved=jnp.array(held and failure is Failure.NONE),
        overflow=jnp.int32(0),
        tracking_error=jnp.float32(0.0),
    )
