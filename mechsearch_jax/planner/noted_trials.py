"""Trials of a single scene that keep what they came to, for who looks on."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Int

from mechsearch_jax.actions import Action, no_action
from mechsearch_jax.planner.trials import TrialResult, Trials, TrialScenes
from mechsearch_jax.problem.problem import Problem


class TriedActions(NamedTuple):
    """The actions that were tried out before one was made, in order, up to the first that succeeded; NumPy arrays.

    Attributes:
      action: fields with a leading axis K.
      result: the `TrialResult` of each, shape (K,).
    """

    action: Action
    result: Int[np.ndarray, " k"]


def nothing_tried() -> TriedActions:
    """No actions."""
    return TriedActions(jax.tree.map(lambda a: np.asarray(a)[None][:0], no_action()), np.zeros(0, np.int32))


class NotedTrials:
    """The `Trials` of one decision in a single scene, which are those of another and keep the results."""

    def __init__(self, trials: Trials) -> None:
        """Args:
        trials: that try the actions.
        """
        self._trials = trials
        self._calls: list[tuple[Action, np.ndarray, np.ndarray]] = []

    def __call__(
        self, problem: Problem, scenes: TrialScenes, actions: Action, wanted: Bool[Array | np.ndarray, "1 k"]
    ) -> Int[np.ndarray, "1 k"]:
        """See `trials.Trials`."""
        results = self._trials(problem, scenes, actions, wanted)
        self._calls.append((actions, np.asarray(wanted)[0], results[0]))
        return results

    def tried(self) -> TriedActions:
        """The actions that were tried, and the results.

        Those after the first success of a call are left out: nothing depends on them.
        """
        parts = [_until_success(*call) for call in self._calls]
        if not parts:
            return nothing_tried()
        return TriedActions(*jax.tree.map(lambda *a: np.concatenate(a), *parts))


def _until_success(actions: Action, wanted: np.ndarray, results: np.ndarray) -> TriedActions:
    rows = np.flatnonzero(wanted)
    won = np.flatnonzero(results[rows] == TrialResult.SUCCEEDED)
    rows = rows[: won[0] + 1] if len(won) else rows
    return TriedActions(jax.tree.map(lambda a: np.asarray(a)[0][rows], actions), np.asarray(results, np.int32)[rows])
