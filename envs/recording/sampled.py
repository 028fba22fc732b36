"""The candidates of a decision: the first actions of its sampled sequences, as a recording stores them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from mechsearch_jax.actions import Action, ActionKind, kind_of, no_action
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner.state import Sequences
from mechsearch_jax.workspace.scenario import MAX_OBJECTS


@dataclasses.dataclass(frozen=True, eq=False)
class Sampled:
    """First actions, those of the best sequences first; NumPy arrays with a leading axis K.

    Attributes:
      action: the candidates.
      value: equation 2 of the sequence: the change of the cost, negative is good.
      cost: predicted J after the action.
      position: predicted positions of the objects after the action [m], shape (K, N, 3); without rows if not predicted.
      rotation: predicted rotations, shape (K, N, 3, 3).
    """

    action: Action
    value: Float[np.ndarray, " k"]
    cost: Float[np.ndarray, " k"]
    position: Float[np.ndarray, "k n 3"]
    rotation: Float[np.ndarray, "k n 3 3"]

    def __len__(self) -> int:
        return len(self.value)

    def single(self, k: int) -> Action:
        """One of the actions."""
        return jax.tree.map(lambda a: a[k], self.action)

    def after(self, k: int, scene: Superquadrics) -> Superquadrics:
        """The predicted objects of a scene after one of the actions; unchanged without a prediction."""
        if not len(self.position):
            return scene
        return scene.replace(position=self.position[k], rotation=self.rotation[k])


def sampled(sequences: Sequences) -> Sampled:
    """The candidates of a decision: the first actions of all its sampled sequences."""
    host = jax.device_get(sequences)
    action, value, cost = jax.tree.map(lambda a: a[:, 0], host.actions), host.value, host.cost[:, 0]
    rows = np.flatnonzero((action.kind != ActionKind.NONE) & np.isfinite(value) & np.isfinite(cost))
    if not len(rows):
        return nothing_sampled()
    candidates = jax.tree.map(lambda a: a[rows], (action, value, cost, host.after.position, host.after.rotation))
    return Sampled(*candidates)


def nothing_sampled() -> Sampled:
    """No actions."""
    none = jax.tree.map(lambda a: np.asarray(a)[None][:0], no_action())
    numbers = np.zeros(0, np.float32)
    return Sampled(none, numbers, numbers, np.zeros((0, MAX_OBJECTS, 3)), np.zeros((0, MAX_OBJECTS, 3, 3)))


def packed(steps: Sequence[Sampled]) -> dict[str, np.ndarray]:
    """The candidates of steps as concatenated arrays, with the number of rows of each step."""
    arrays = {"sampled.rows": np.array([len(step) for step in steps])}
    arrays["sampled.foreseen"] = np.array([len(step.position) for step in steps])
    for name in ("value", "cost", "position", "rotation"):
        arrays[f"sampled.{name}"] = np.concatenate([np.asarray(getattr(step, name), np.float32) for step in steps])
    for field in dataclasses.fields(Action):
        arrays[f"sampled.action.{field.name}"] = np.concatenate([getattr(step.action, field.name) for step in steps])
    return arrays


def unpacked(arrays: Mapping[str, np.ndarray], steps: int) -> list[Sampled]:
    """The inverse of `packed`.

    Raises:
      ValueError: shapes, types or values are wrong.
      KeyError: an array is missing.
    """
    rows, foreseen = arrays["sampled.rows"], arrays["sampled.foreseen"]
    _check(arrays, steps, rows, foreseen)
    ends, seen = np.cumsum(rows), np.cumsum(foreseen)
    names = [field.name for field in dataclasses.fields(Action)]
    result = []
    for i in range(steps):
        of_step, predicted = slice(ends[i] - rows[i], ends[i]), slice(seen[i] - foreseen[i], seen[i])
        fields: dict[str, Any] = {name: arrays[f"sampled.action.{name}"][of_step] for name in names}
        action = Action(**fields)
        values = (arrays[f"sampled.{name}"][of_step] for name in ("value", "cost"))
        result.append(Sampled(action, *values, *(arrays[f"sampled.{n}"][predicted] for n in ("position", "rotation"))))
    return result


def _check(
    arrays: Mapping[str, np.ndarray], steps: int, rows: Int[np.ndarray, "..."], foreseen: Int[np.ndarray, "..."]
) -> None:
    for counts in (rows, foreseen):
        if counts.shape != (steps,) or counts.dtype.kind not in "iu" or counts.min() < 0:
            raise ValueError("the numbers of sampled actions are missing")
    if ((foreseen != rows) & (foreseen != 0)).any():
        raise ValueError("predictions are missing")
    empty = packed([nothing_sampled()])
    for name, like in empty.items():
        if name in ("sampled.rows", "sampled.foreseen"):
            continue
        count = int((foreseen if name in ("sampled.position", "sampled.rotation") else rows).sum())
        array = arrays[name]
        if array.shape != (count, *like.shape[1:]) or array.dtype.kind != like.dtype.kind:
            raise ValueError(f"{name} is of another shape or type")
        if not np.isfinite(array).all():
            raise ValueError("there are numbers that are not finite")
    for kind in np.unique(arrays["sampled.action.kind"]):
        kind_of(int(kind))
