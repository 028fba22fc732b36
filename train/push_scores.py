"""The true motion of bodies in pushes, and scores of push models against it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.dynamics.push_model import PushModel, PushOutcome
from mechsearch_jax.envs.pushing.pushes import Pushes
from mechsearch_jax.envs.world.world import superquadrics
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import matmul
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.shapes import by_shape
from mechsearch_jax.workspace.shelf import Shelf

# An object that moves less than this counts as still: objects settle by as much [m, rad].
STILL, STILL_TURN = 1e-3, np.deg2rad(0.5)
# A box is the same after half a turn [rad].
HALF_TURN = np.pi
# Distances of the paper's pushes, and the tolerance within which pushes are grouped with them [m].
DISTANCES, WITHIN = (0.05, 0.10, 0.15), 0.025


class PushTruth(PyTreeNode):
    """True motion of the bodies; fields have the leading axes (..., 9).

    Attributes:
      shift: planar motion of the centre [m], (..., 9, 2).
      turn: about the vertical [rad].
      moved: whether the body moved at all.
      toppled: whether it fell over, or off the board; its shift and turn then mean nothing.
      valid: whether the slot holds a body.
    """

    shift: jax.Array
    turn: jax.Array
    moved: jax.Array
    toppled: jax.Array
    valid: jax.Array


def planar_turn(before: Float[Array, "*batch 3 3"], after: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch"]:
    """The turn about the vertical [rad] nearest to the rotation from one orientation to another."""
    R = matmul(after, jnp.swapaxes(before, -1, -2))
    return jnp.arctan2(R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] + R[..., 1, 1])


def push_truth(pushes: Pushes) -> PushTruth:
    """True motion of the bodies in pushes; bodies that settled by less than `STILL` have not moved."""
    before, after = pushes.before, pushes.after
    shift = (after.position - before.position)[..., :2]
    turn = planar_turn(before.rotation, after.rotation)
    stands = by_shape(before.kind, lambda shape: shape.round, jnp)
    stands &= jnp.abs(before.rotation[..., 2, 2]) > 0.98
    turn = jnp.where(stands, 0.0, turn)
    far = (shift[..., 0] ** 2 + shift[..., 1] ** 2 > STILL**2) | (jnp.abs(turn) > STILL_TURN)
    return PushTruth(shift, turn, before.valid & (far | pushes.toppled), pushes.toppled, before.valid)


def turn_error(a: Float[Array, "*shape"], b: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Difference of two turns of a box [rad], at most a quarter turn."""
    return a - b - HALF_TURN * jnp.round((a - b) / HALF_TURN)


def no_motion(
    shelf: Shelf, scene: Superquadrics, pusher: Array, T_world_gripper: Array, displacement: Array, q7: Array
) -> PushOutcome:
    """The `PushModel` that predicts no motion."""
    nowhere = jnp.zeros(scene.capacity)
    return PushOutcome(scene, nowhere > 0, jnp.zeros(()), jnp.array(True), nowhere)


@functools.partial(jax.jit, static_argnames=("model", "shelf"))
def _predict(model: PushModel, pushes: Pushes, pusher: Array, shelf: Shelf) -> PushOutcome:
    def predict(push: Pushes) -> PushOutcome:
        return model(shelf, superquadrics(push.before), pusher, push.T_world_gripper, push.displacement, push.q7)

    return jax.vmap(predict)(pushes)


def predictions(
    model: PushModel,
    pushes: Pushes,
    pusher: Float[Array, "p 3"],
    shelf: Shelf | None = None,
    batch: int = 128,
    on_progress: Callable[[int], None] = lambda pushes: None,
) -> PushOutcome:
    """A model's predictions of pushes.

    Args:
      model: jitted as a static argument.
      pushes: on the host.
      pusher: surface of the gripper in its own frame [m].
      shelf: the shelf.
      batch: pushes at once.
      on_progress: called with the number of predicted pushes.

    Returns:
      Fields with a leading axis for the pushes, on the host.
    """
    count = len(pushes.object)
    batch = min(batch, count)
    parts = []
    for start in range(0, count, batch):
        # The last batch overlaps the one before it, so that all have the same size.
        first = min(start, count - batch)
        chunk = jax.tree.map(lambda a, first=first: a[first : first + batch], pushes)
        outcome = jax.device_get(_predict(model, chunk, pusher, shelf or Shelf()))
        parts.append(jax.tree.map(lambda a, skip=start - first: a[skip:], outcome))
        on_progress(min(start + batch, count))
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


def average_precision(score: Float[np.ndarray, " n"], truth: Bool[np.ndarray, " n"]) -> float:
    """Mean precision over the positives by falling score; equal scores are one step. NaN without positives."""
    if not truth.any():
        return float("nan")
    order = np.argsort(-score, kind="stable")
    hits = np.cumsum(truth[order])
    last = np.append(np.diff(score[order]) != 0, True)
    hits, seen = hits[last], np.flatnonzero(last) + 1
    return float(np.sum(np.diff(hits, prepend=0) * hits / seen) / truth.sum())


def model_scores(
    model: PushModel, pushes: Pushes, pusher: Float[Array, "p 3"], shelf: Shelf | None = None, batch: int = 128
) -> dict[str, Any]:
    """The `outcome_scores` of a model's `predictions`; see there."""
    return outcome_scores(predictions(model, pushes, pusher, shelf, batch), pushes)


class _Compared(PyTreeNode):
    """Predictions next to the truth; fields have the leading axes (pushes, 9)."""

    shift_error: jax.Array
    turn_error: jax.Array
    shift: jax.Array
    topples: jax.Array


@jax.jit
def _compare(outcomes: PushOutcome, pushes: Pushes, truth: PushTruth) -> _Compared:
    before = pushes.before
    shift = (outcomes.scene.position - before.position)[..., :2]
    gap = shift - truth.shift
    turn = planar_turn(before.rotation, outcomes.scene.rotation)
    return _Compared(
        shift_error=jnp.sqrt(gap[..., 0] ** 2 + gap[..., 1] ** 2),
        turn_error=jnp.abs(turn_error(turn, truth.turn)),
        shift=jnp.sqrt(shift[..., 0] ** 2 + shift[..., 1] ** 2),
        topples=outcomes.topples,
    )


def outcome_scores(outcomes: PushOutcome, pushes: Pushes) -> dict[str, Any]:
    """Scores of predicted outcomes: over all, by distance, by the number of objects, and by both.

    Args:
      outcomes: predictions of the pushes, with all nine bodies of a world in their scenes.
      pushes: on the host.

    Returns:
      For each group: the number of `pushes`, and of those that the model `failed` at (an infinite residual; its
      predictions count all the same); mean errors of the pushed object (`pushed_mm`, `pushed_deg`, the latter of
      boxes) and of other objects that moved (`other_mm`); the share of still objects that are predicted to move by less
      than `STILL` (`still`); the average precision of toppling (`topple_ap`). Objects that toppled, over or off the
      board, count for the last score only; `toppled` is their number, and `pushed_toppled` how many of them were the
      pushed object.

    Raises:
      InputError: a prediction is not finite.
    """
    valid = np.asarray(pushes.before.valid)
    numbers = outcomes.scene.position, outcomes.scene.rotation, outcomes.topples
    if not all(np.isfinite(np.asarray(a)[valid]).all() for a in numbers):
        raise InputError("predictions of pushes are not finite numbers; the model's weights may be damaged")
    truth = push_truth(jax.tree.map(jnp.asarray, pushes))
    compared, truth = jax.device_get((_compare(outcomes, pushes, truth), truth))
    failed = np.isinf(np.asarray(outcomes.residual))
    length = np.linalg.norm(pushes.displacement, axis=1)
    objects = np.asarray(pushes.before.valid)[:, :-1].sum(axis=1)
    sideways = np.abs(np.asarray(pushes.displacement)[:, 0]) < 1e-3
    groups: dict[str, np.ndarray] = {
        "all": np.ones(len(length), bool),
        "sideways": sideways,
        "forward and diagonal": ~sideways,
    }
    near = {f"{100 * d:.0f} cm": np.abs(length - d) <= WITHIN for d in DISTANCES}
    counts = {f"{n} objects": objects == n for n in range(1, pushes.before.valid.shape[1])}
    # The union of the three; their ranges leave no gap.
    together = f"{100 * (DISTANCES[0] - WITHIN):.1f} to {100 * (DISTANCES[-1] + WITHIN):.1f} cm"
    groups |= near | {together: np.any(list(near.values()), axis=0)} | counts
    groups |= {f"{a}, {b}": x & y for a, x in near.items() for b, y in counts.items()}
    return {name: _summary(compared, truth, failed, pushes, chosen) for name, chosen in groups.items() if chosen.any()}


def _summary(
    compared: _Compared, truth: PushTruth, failed: np.ndarray, pushes: Pushes, chosen: np.ndarray
) -> dict[str, Any]:
    valid = chosen[:, None] & truth.valid
    upright = valid & ~truth.toppled
    pushed = np.arange(truth.valid.shape[1])[None] == pushes.object[:, None]
    turns = ~by_shape(np.asarray(pushes.before.kind), lambda shape: shape.round, np)
    still = upright & ~truth.moved

    def mean(value, where, unit):
        return round(float(value[where].mean() * unit), 3) if where.any() else None

    precision = average_precision(np.asarray(compared.topples)[valid], np.asarray(truth.toppled)[valid])
    return {
        "pushes": int(chosen.sum()),
        "failed": int(failed[chosen].sum()),
        "toppled": int((valid & truth.toppled).sum()),
        "pushed_toppled": int((valid & truth.toppled & pushed).sum()),
        "pushed_mm": mean(compared.shift_error, upright & pushed, 1e3),
        "pushed_deg": mean(compared.turn_error, upright & pushed & turns, 180 / np.pi),
        "other_mm": mean(compared.shift_error, upright & ~pushed & truth.moved, 1e3),
        "still": mean((compared.shift < STILL).astype(float), still, 1.0),
        "topple_ap": None if np.isnan(precision) else round(precision, 4),
    }
