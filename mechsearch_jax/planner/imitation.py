"""The engine's slots as somebody else's code has them: what a preset takes over that no option says."""

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

# How much the published code's J minds what is in the way of a grasp; the paper's minds it as much as f.
HINDRANCE = 0.1


class Slots(NamedTuple):
    """What the engine samples, predicts and makes small with; all static."""

    propose: Propose
    predict: Predict
    objective: Objective
    drawn_in: DrawnIn = as_predicted


def in_the_present_scene(present: Superquadrics | None, state: State) -> State:
    """A `DrawnIn` as in the published code: later actions are drawn in the present scene, too, whatever has moved."""
    return state if present is None else state.replace(scene=present.replace(valid=present.valid & state.scene.valid))


@dataclasses.dataclass(frozen=True)
class LaterPlacementsStay:
    """A `Predict` as in the published code: what is picked after the first action of a sequence stays where it is.

    Attributes:
      inner: predicts everything else.
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


def _own(slots: Slots) -> Slots:
    return slots


def _published_code(slots: Slots) -> Slots:
    """Later actions are drawn in the present scene, later placements stay, and J minds hindrances less; an objective
    that is not the paper's stays as it is."""
    objective = slots.objective
    if isinstance(objective, SearchForGrasp | SearchAndGrasp):
        objective = dataclasses.replace(objective, hindrance=HINDRANCE)
    return Slots(slots.propose, LaterPlacementsStay(slots.predict), objective, in_the_present_scene)


# What makes a policy's slots those of `PlannerConfig.imitates`.
IMITATIONS: Mapping[Imitated, Callable[[Slots], Slots]] = {"nothing": _own, "published-code": _published_code}
