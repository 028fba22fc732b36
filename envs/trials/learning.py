"""Trials that learn friction and mass from where objects come to rest after an action."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions import Action, ActionKind
from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
from mechsearch_jax.envs.trials.native import NativeTrials
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner import Problem
from mechsearch_jax.planner.learning import posterior
from mechsearch_jax.planner.trials import Trials, TrialScenes
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.preparing import Program


class PredictsEnds(Trials, Protocol):
    """`Trials` that also say where objects come to rest: `NativeTrials`, `ProcessTrials`."""

    def ends(
        self, problem: Problem, scenes: TrialScenes, actions: Action, arm_stop: float
    ) -> Float[np.ndarray, "r 2 n 3"]:
        """See `NativeTrials.ends`."""
        ...

    def programs(self, problem: Problem) -> list[Program]:
        """See `many_slots.PreparesTrials`."""
        ...


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """What friction and mass may be.

    Attributes:
      friction, mass: multiples of the assumed sliding frictions and masses of all bodies.
      weight: how probable it is before the first action, relative to the others.
    """

    friction: float = 1.0
    mass: float = 1.0
    weight: float = 1.0


# From half to twice the assumed friction.
FRICTIONS = (
    Hypothesis(0.5, weight=0.1),
    Hypothesis(0.7, weight=0.15),
    Hypothesis(1.0, weight=0.5),
    Hypothesis(1.4, weight=0.15),
    Hypothesis(2.0, weight=0.1),
)


@dataclasses.dataclass(frozen=True)
class LearningTrials:
    """`Trials` that assume the most probable of some hypotheses; see `planner.learning.LearnsFriction`.

    After an action it is simulated under every hypothesis. An arm that is held up may go on or stop and go back: the
    way that fits better counts.

    An approximation: what is not recognised is absent from the simulation, as it is from trials.

    Attributes:
      trials: in which actions are tried, and which say where objects come to rest.
      hypotheses: two or more.
      spread: scale of the distance between where an object is predicted and where it is seen [m].
      arm_stop: error of a joint at which the robot's controller may stop the arm and bring it back [rad].

    Raises:
      InputError: there are too few hypotheses, two are equal, or a number is not positive.
    """

    trials: PredictsEnds = dataclasses.field(default_factory=NativeTrials)
    hypotheses: tuple[Hypothesis, ...] = FRICTIONS
    spread: float = 0.006
    arm_stop: float = SimulatorConfig().tracking_bound

    def __post_init__(self) -> None:
        if len(self.hypotheses) < 2:
            raise InputError(f"LearningTrials: {len(self.hypotheses)} hypotheses are too few; give two at least")
        for hypothesis in self.hypotheses:
            if not all(0.0 < value < np.inf for value in dataclasses.astuple(hypothesis)):
                raise InputError(f"LearningTrials: {hypothesis} must have positive numbers only")
        if len(set(self.names)) < len(self.names):
            raise InputError(f"LearningTrials: hypotheses are equal: {'; '.join(self.names)}; give each once")
        for name in ("spread", "arm_stop"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InputError(f"LearningTrials: {name} {getattr(self, name)} must be a positive number")

    @property
    def names(self) -> tuple[str, ...]:
        """See `LearnsFriction`."""
        return tuple(f"friction {h.friction:g}, mass {h.mass:g}" for h in self.hypotheses)

    @property
    def prior(self) -> Float[np.ndarray, " h"]:
        """See `LearnsFriction`."""
        weights = np.array([hypothesis.weight for hypothesis in self.hypotheses], np.float32)
        return weights / weights.sum()

    def __call__(
        self, problem: Problem, scenes: TrialScenes, actions: Action, wanted: Bool[Array | np.ndarray, "r k"]
    ) -> Int[np.ndarray, "r k"]:
        """See `trials.Trials`."""
        return self.trials(problem, scenes, actions, wanted)

    def programs(self, problem: Problem) -> list[Program]:
        """The JAX programs of trials; see `many_slots.PreparesTrials`."""
        return self.trials.programs(problem)

    def assumed(self, probabilities: Float[np.ndarray, "r h"], scenes: TrialScenes) -> TrialScenes:
        """See `LearnsFriction`."""
        return _under([self.hypotheses[i] for i in probabilities.argmax(axis=1)], scenes)

    def learned(
        self,
        problem: Problem,
        probabilities: Float[np.ndarray, "r h"],
        scenes: TrialScenes,
        actions: Action,
        seen: Superquadrics,
    ) -> Float[np.ndarray, "r h"]:
        """See `LearnsFriction`."""
        scenes, actions, seen = jax.device_get((scenes, actions, seen))
        rows = np.flatnonzero(np.asarray(actions.kind) != ActionKind.NONE)
        updated, count = probabilities.copy(), len(self.hypotheses)
        if not len(rows):
            return updated
        before, executed = jax.tree.map(lambda a: np.repeat(np.asarray(a)[rows], count, axis=0), (scenes, actions))
        under = _under([*self.hypotheses] * len(rows), before)
        ends = self.trials.ends(problem, under, executed, self.arm_stop)
        for row, predicted in zip(rows.tolist(), np.split(ends, len(rows)), strict=True):
            there, visible = np.asarray(scenes.objects.valid)[row], np.asarray(seen.valid)[row]
            places = np.asarray(seen.position)[row]
            updated[row] = posterior(probabilities[row], predicted, there, places, visible, self.spread)
        return updated


def _under(hypotheses: list[Hypothesis], scenes: TrialScenes) -> TrialScenes:
    """Scenes with the friction and the mass of a hypothesis each."""
    friction, mass = np.array([(h.friction, h.mass) for h in hypotheses], np.float32).T
    return scenes.replace(friction=np.asarray(scenes.friction) * friction, mass=np.asarray(scenes.mass) * mass)
