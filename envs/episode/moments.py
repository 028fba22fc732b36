"""What is known at each step of an episode, for who looks on."""

from __future__ import annotations

import dataclasses
from typing import Protocol, runtime_checkable

from mechsearch_jax.envs.camera.snapshot import Snapshot
from mechsearch_jax.envs.episode.records import Step
from mechsearch_jax.envs.world.outcome import Outcome
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Belief, Decision
from mechsearch_jax.planner.trials import TriedActions, nothing_tried


@dataclasses.dataclass(frozen=True)
class Moment:
    """All that is known at one step of an episode, for who looks on.

    Attributes:
      index: number of actions before it.
      snapshot: what the camera sees.
      observation: what was recognised, the objects by the numbers of the bodies that they stand for.
      belief: where the target can be.
      decision: of the policy, by the same numbers; None where none was needed or none could be acted upon.
      record: what is written down; its `observed_cost` comes later.
      outcome: what the simulator said of the action; None before it was executed, or without one.
      tried: what trials came to at this step, the objects by the same numbers.
    """

    index: int
    snapshot: Snapshot
    observation: Observation
    belief: Belief
    decision: Decision | None
    record: Step
    outcome: Outcome | None
    tried: TriedActions = dataclasses.field(default_factory=nothing_tried)


@runtime_checkable
class Watcher(Protocol):
    """Looks on while an episode runs alone."""

    def busy(self, stage: str) -> None:
        """A stage begins: "recognise", "plan", "judge" or "simulate"."""
        ...

    def decided(self, moment: Moment) -> None:
        """The robot has looked and decided, and is about to act."""
        ...

    def acted(self, moment: Moment) -> None:
        """The action is over. Also called, without an action, when the episode ends."""
        ...
