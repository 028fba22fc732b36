"""The engine's slots as in the authors' published code: behaviour of a preset that is no option."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from mechsearch_jax.actions.registry import KINDS
from mechsearch_jax.actions.types import Prediction, Sample
from mechsearch_jax.config.config import Imitated
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner.objective import Objective, SearchAndGrasp, SearchForGrasp
from mechsearch_jax.planner.prediction import Predict
from mechsearch_jax.planner.proposal import DrawnIn, Propose, as_predicted
from mechsearch_jax.planner.state import State
from mechsearch_jax.problem.problem import Problem

# `hindrance` of the published code's J; the paper's is 1.
HINDRANCE = 0.1


class Slots(NamedTuple):
    """How the engine samples and predicts, and what it minimises; all static."""

    propose: Propose
    predict: Predict
    objective: Objective
    drawn_in: DrawnIn = as_predicted


def in_the_present_scene(present: Superquadrics | None, state: State) -> State:
    """A `DrawnIn` as in the published code: later actions, too, are drawn in the present scene."""
    return state if present is None else state.replace(scene=present.replace(valid=present.valid & state.scene.valid))


@dataclasses.dataclass(frozen=True)
class LaterPlacementsStay:
    """A `Predict` as in the published code: an object picked after the first action of a sequence does not move.

    Attributes:
      inner: predicts all other actions.
    """

    inner: Predict

    def __call__(self, problem: Problem, state: State, sample: Sample, first: Bool[Array, ""]) -> Prediction:
        prediction = self.inner(problem, state, sample, first)
        held = functools.reduce(
            jnp.logical_or, [sample.action.kind == code for code, kind in KINDS.items() if kind.holds_object]
        )
        stays = held & ~first
        scene = jax.tree.map(lambda old, new: jnp.where(stays, old, new), state.scene, prediction.scene)
        return prediction.replace(scene=scene, moved=prediction.moved & ~stays)


def _unchanged(slots: Slots) -> Slots:
    return slots


def _published_code(slots: Slots) -> Slots:
    """Later actions are drawn in the present scene, later placements stay, and the objectives of the paper have a
    smaller `hindrance`."""
    objective = slots.objective
    if isinstance(objective, SearchForGrasp | SearchAndGrasp):
        objective = dataclasses.replace(objective, hindrance=HINDRANCE)
    return Slots(slots.propose, LaterPlacementsStay(slots.predict), objective, in_the_present_scene)


# Changes a policy's slots by `PlannerConfig.imitates`.
IMITATIONS: Mapping[Imitated, Callable[[Slots], Slots]] = {"nothing": _unchanged, "published-code": _published_code}
