"""The log of a running episode, and the reasons for which it ends."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mechsearch_jax.actions import Action, ActionKind, kind_of
from mechsearch_jax.envs.episode.numbering import named_action
from mechsearch_jax.envs.episode.records import ActionRecord, Episode, Step, record_action
from mechsearch_jax.envs.episode.verdicts import Verdict
from mechsearch_jax.envs.world.outcome import Failure, Outcome, Overflow
from mechsearch_jax.envs.world.touching import unrest
from mechsearch_jax.envs.world.world import TARGET, World, fallen_over
from mechsearch_jax.planner import Decision
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf


class Choice(PyTreeNode):
    """A policy's decision without the sequences that it did not choose.

    Attributes:
      action, cost, predicted_cost: of the `Decision`.
      sequences: number of sequences that it was chosen from.
      refused: number of further sequences whose first action did harm in a trial.
      bodies: the number of the body that each object stands for, shape (N,); None if objects have the bodies' numbers.
      there: whether it stands for that body, shape (N,); None if all do.
      blind: whether it sweeps space that was not measured, see `belief.sweeps_unmeasured`.
    """

    action: Action
    cost: jax.Array
    predicted_cost: jax.Array
    sequences: jax.Array
    refused: jax.Array | int = 0
    bodies: Int[np.ndarray, " objects"] | None = None
    there: Bool[np.ndarray, " objects"] | None = None
    blind: jax.Array | bool = False

    @property
    def executed(self) -> Action:
        """The action, with the number of a body."""
        return self.action if self.bodies is None else named_action(self.action, self.bodies)

    @property
    def recorded(self) -> ActionRecord:
        """The record of the action, without an object where that stands for no body."""
        record, index = record_action(self.executed), int(self.action.object)
        is_phantom = self.there is not None and 0 <= index < len(self.there) and not self.there[index]
        return dataclasses.replace(record, object=None) if is_phantom else record


@cached_jit()
def chosen(decision: Decision) -> Choice:
    """The `Choice` of a decision."""
    count = jnp.sum(jnp.isfinite(decision.sequences.value))
    return Choice(decision.action, decision.cost, decision.predicted_cost, count, decision.refused)


def takes_target(choice: Choice) -> bool:
    """Whether the chosen action is a retrieval."""
    return kind_of(int(choice.action.kind)).takes_target


def distrust(choice: Choice) -> str | None:
    """Why a choice must not be executed; None if it may."""
    numbers = [choice.cost, *jax.tree.leaves(choice.action)]
    return None if all(np.all(np.isfinite(n)) for n in numbers) else "error: the decision is not finite"


def target_trouble(
    shelf: Shelf, position: Float[np.ndarray, " 3"], rotation: Float[np.ndarray, "3 3"], ends_alike: bool = True
) -> str | None:
    """Why a target at this pose can no longer be retrieved; None if it can. See `world.fallen_over`."""
    if position[0] < shelf.front or position[2] < shelf.board:
        return "the target fell off the board"
    return "the target fell over" if fallen_over(rotation, ends_alike) else None


def overflow_trouble(outcome: Outcome, i: int) -> str | None:
    """An error that names the buffers that overflowed with contacts of world `i`; None without overflow."""
    flags = Overflow(int(outcome.overflow[i]))
    if flags is Overflow.NONE:
        return None
    names = ", ".join(str(flag.name).lower() for flag in Overflow if flag and flag in flags)
    return f"error: the simulator's buffers were too small ({names})"


@dataclasses.dataclass(frozen=True)
class Result:
    """The simulator's outcome of a decision, in the words of a record.

    Attributes:
      failure: why the action was not carried out as chosen; None if it was.
      takes_target: whether it was a retrieval.
      retrieved: whether a retrieval succeeded and nothing fell meanwhile.
      final: whether another attempt cannot succeed.
      off_board: bodies that are off the board after the action.
      held_up, at_rest, restless, tracking_error: as in `Step`.
    """

    failure: str | None
    takes_target: bool
    retrieved: bool
    final: bool
    off_board: frozenset[int]
    held_up: bool
    at_rest: bool
    restless: tuple[str, ...]
    tracking_error: float


def result_of(choice: Choice, outcome: Outcome, i: int, world: World, shelf: Shelf) -> Result:
    """The result of the action in world `i` of all worlds on a shelf, after it."""
    code, takes = Failure(int(outcome.failure[i])), takes_target(choice)
    # The grasp stays out of reach, a fallen body stays off the board, and a target outside cannot be taken out again.
    final = code in (Failure.UNREACHABLE, Failure.FALLEN) or bool(outcome.held[i] & outcome.outside[i])
    return Result(
        failure=failure_of(choice, outcome, i),
        takes_target=takes,
        retrieved=bool(outcome.retrieved[i]),
        final=takes and final,
        off_board=frozenset(np.flatnonzero(outcome.fallen[i]).tolist()),
        held_up=code is Failure.HELD_UP,
        at_rest=bool(outcome.settled[i]),
        restless=unrest(world, np.asarray(outcome.restless[i]), shelf, i),
        tracking_error=float(outcome.tracking_error[i]),
    )


def failure_of(choice: Choice, outcome: Outcome, i: int) -> str | None:
    """Why the action in world `i` was not carried out as chosen, in the words of a record; None if it was."""
    kind, reason = kind_of(int(choice.action.kind)), outcome.reason(i)
    if kind.code == ActionKind.NONE:
        return "all that was tried out did harm" if int(choice.refused) else "no action is possible"
    return f"retrieval: {reason}" if reason and kind.takes_target else reason


def record(
    found: bool,
    belief_size: int,
    verdict: Verdict,
    choice: Choice | None,
    truth_possible: bool | None = None,
    restarts: int = 0,
    around_possible: bool | None = None,
) -> Step:
    """The record of a step when it is decided; its results are filled in later.

    Args:
      found: whether the target has been found.
      belief_size: number of poses where it can be.
      verdict: on the true state.
      choice: None if nothing is done.
      truth_possible, restarts, around_possible: as in `Step`.
    """
    cost = predicted = action = None
    sequences = 0
    if choice is not None:
        action, cost = choice.recorded, float(choice.cost)
        if not takes_target(choice):
            predicted = _expected(choice)
            sequences = int(choice.sequences)
    return Step(
        belief_size=belief_size,
        found=found,
        graspable=verdict.graspable,
        cost=cost,
        action=action,
        predicted_cost=predicted,
        observed_cost=None,
        sequences=sequences,
        failure=None,
        timings={},
        truth_possible=truth_possible,
        restarts=restarts,
        paper_graspable=verdict.paper_graspable,
        around_possible=around_possible,
        blind=None if choice is None else bool(choice.blind),
    )


def _expected(choice: Choice) -> float | None:
    """The predicted cost after a choice; None if the policy predicts none."""
    return float(choice.predicted_cost) if np.isfinite(choice.predicted_cost) else None


class EpisodeLog:
    """The steps of a running episode, and the verdicts on them.

    At every step `decide` records belief and decision, and then `act` the result.

    Attributes:
      steps: so far, the decided one included.
      irretrievable: why no retrieval counts any more: an object has left the board; None as long as none has.
    """

    def __init__(self, max_steps: int) -> None:
        self.steps: list[Step] = []
        self.irretrievable: str | None = None
        self._off_board: frozenset[int] = frozenset()
        self._max_steps = max_steps
        self._index = 0
        self._found_step: int | None = None
        self._graspable_step: int | None = None
        self._paper_graspable_step: int | None = None
        self._retrieved = False
        self._failure: str | None = None

    @property
    def index(self) -> int:
        """Index of the present step, from 0."""
        return self._index

    @property
    def last(self) -> bool:
        """Whether only a retrieval is allowed at the present step."""
        return self._index == self._max_steps

    @property
    def acts(self) -> bool:
        """Whether the present step has an action."""
        return self.steps[-1].action is not None

    def decide(self, step: Step) -> Step:
        """Record belief and decision of the present step."""
        if self.steps:
            self.steps[-1] = dataclasses.replace(self.steps[-1], observed_cost=step.cost)
        if step.found and self._found_step is None:
            self._found_step = self._index
        if step.graspable and self._graspable_step is None:
            self._graspable_step = self._index
        if step.paper_graspable and self._paper_graspable_step is None:
            self._paper_graspable_step = self._index
        self.steps.append(step)
        return step

    def act(self, result: Result | None, trouble: str | None, timings: dict[str, float]) -> bool:
        """Record the result of the decision; returns whether the episode ends with it.

        Args:
          result: of the executed action; None if nothing was executed.
          trouble: why the episode cannot continue unless the result is a success; None if it can.
          timings: of the step's stages [s].
        """
        self.steps[-1] = dataclasses.replace(self.steps[-1], timings=timings)
        if result is not None:
            self._note(result)
        error = trouble is not None and trouble.startswith("error")
        self._retrieved = result is not None and result.retrieved and not error and self.irretrievable is None
        self._failure = None if self._retrieved else trouble or self._end(result is not None and result.final)
        if self._failure and self.irretrievable and not error:
            self._failure = self.irretrievable
        self._index += 1
        return self._retrieved or self._failure is not None

    def _note(self, result: Result) -> None:
        """Record the result of the executed action."""
        left = result.off_board - self._off_board
        self._off_board |= result.off_board
        objects = tuple(sorted(left - {TARGET}))
        self.steps[-1] = dataclasses.replace(
            self.steps[-1],
            failure=result.failure,
            fallen=objects,
            target_fallen=TARGET in left,
            held_up=result.held_up,
            at_rest=result.at_rest,
            restless=result.restless,
            tracking_error=result.tracking_error,
        )
        if objects and self.irretrievable is None:
            blamed = "retrieval: " if result.takes_target else ""
            self.irretrievable = f"{blamed}an object fell off the board at action {self._index + 1}"

    def _end(self, final: bool) -> str | None:
        """Why an episode without a retrieval ends here; None if it goes on.

        Args:
          final: whether the present failure ends it.
        """
        step = self.steps[-1]
        if final:
            return step.failure or self.irretrievable
        # Both verdicts are decided: the target was graspable, and it cannot be retrieved.
        if self.irretrievable and self._graspable_step is not None:
            return self.irretrievable
        if not self.last:
            return None
        return step.failure or ("found, but not graspable" if step.found else "not found")

    def episode(self, scenario: Scenario, options: dict[str, Any]) -> Episode:
        """The record of the ended episode."""
        return Episode(
            scenario=scenario.name,
            objects=len(scenario.objects),
            config=options,
            versions=versions(),
            steps=tuple(self.steps),
            found_step=self._found_step,
            graspable_step=self._graspable_step,
            retrieved=self._retrieved,
            failure=self._failure,
            content_hash=scenario.content_hash,
            paper_graspable_step=self._paper_graspable_step,
        )
