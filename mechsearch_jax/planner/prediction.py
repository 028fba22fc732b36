"""Prediction of a sampled action's effect: the engine's slot `predict` (S of equation 4)."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import jax
import jax.numpy as jnp

from mechsearch_jax.actions.registry import KINDS
from mechsearch_jax.actions.types import Prediction, Sample
from mechsearch_jax.belief.moved_target import beyond_candidates
from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.planner.state import State
from mechsearch_jax.problem.problem import Problem


class Predict(Protocol):
    """Predicts an action; static under jit."""

    def __call__(self, problem: Problem, state: State, sample: Sample, first: bool) -> Prediction:
        """The effect of an action; the scene stays unchanged if the action cannot be executed.

        Args:
          problem: constants of the search.
          state: the state before the action.
          sample: the action.
          first: whether it is the first of its sequence; static.
        """
        ...


@dataclasses.dataclass(frozen=True)
class PredictByKind:
    """The default `Predict`: every kind of action predicts itself, pushes with a push model.

    A found target moves only as the object of the action, and must stay among its candidate poses.

    Attributes:
      push_model: predicts pushes that are the first action of a sequence.
      later_push_model: predicts later pushes.
    """

    push_model: PushModel
    later_push_model: PushModel

    def __call__(self, problem: Problem, state: State, sample: Sample, first: bool) -> Prediction:
        push_model = self.push_model if first else self.later_push_model
        action, scene = sample.action, state.scene
        # An action may move the target only as its own object.
        untouchable = state.is_target & (jnp.arange(scene.capacity) != action.object)
        prediction = Prediction(scene, jnp.zeros_like(scene.valid), jnp.array(False))
        for code, kind in KINDS.items():
            of_kind = kind.predict(problem.space, push_model, scene, untouchable, action, sample.wrist)
            prediction = jax.tree.map(lambda a, b, code=code: jnp.where(action.kind == code, a, b), of_kind, prediction)
        lost = state.is_target & prediction.moved & beyond_candidates(problem, prediction.scene.position)
        possible = prediction.possible & ~jnp.any(lost)
        after = jax.tree.map(lambda new, old: jnp.where(possible, new, old), prediction.scene, scene)
        return Prediction(after, prediction.moved & possible, possible)
