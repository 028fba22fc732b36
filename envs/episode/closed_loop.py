"""The closed loop: in a round all slots look, recognise, update the belief, propose, try, choose and act."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Int, UInt

from mechsearch_jax.actions import Action, no_action
from mechsearch_jax.envs.camera.sensing import Sensing, sensing_of
from mechsearch_jax.envs.camera.snapshot import Recogniser, oracle
from mechsearch_jax.envs.episode.compile_clock import CompileClock, StageClock
from mechsearch_jax.envs.episode.episode_log import (
    Choice,
    EpisodeLog,
    Result,
    distrust,
    overflow_trouble,
    record,
    result_of,
    takes_target,
    target_trouble,
)
from mechsearch_jax.envs.episode.moments import Moment, Watcher
from mechsearch_jax.envs.episode.numbering import named_decision, named_observation, named_tried
from mechsearch_jax.envs.episode.records import Episode
from mechsearch_jax.envs.episode.slots import OneSlot, Slots
from mechsearch_jax.envs.episode.verdicts import Verdict
from mechsearch_jax.envs.simulators.simulator import Flowing, Simulator
from mechsearch_jax.envs.world.mismatch import ASSUMED, Mismatch, TrueCell
from mechsearch_jax.envs.world.outcome import Outcome
from mechsearch_jax.envs.world.world import TARGET, World
from mechsearch_jax.planner import Policy, Problem
from mechsearch_jax.planner.trials import Trials, nothing_tried
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.workspace.scenario import Scenario


@dataclasses.dataclass(frozen=True)
class Start:
    """An episode to be run.

    Attributes:
      scenario: where everything stands at the start.
      seed: of the planner's and of the environment's random numbers, which are independent of each other.
      policy, max_steps, options: where they are not None, instead of those of the run. With several slots the policies
        of a run may differ in numbers alone; see `policy_numbers`.
      mismatch: how the simulated world differs from what the planner assumes. With several slots all mismatches of a
        run must have the same `compile_key`.
    """

    scenario: Scenario
    seed: int
    policy: Policy | None = None
    max_steps: int | None = None
    options: Mapping[str, Any] | None = None
    mismatch: Mismatch = ASSUMED

    def cell(self, problem: Problem) -> TrueCell:
        """The cell of the episode, where a problem says what the planner assumes."""
        return self.mismatch.drawn(self.scenario, self.seed, problem.camera, problem.shelf)

    def sensing(self, problem: Problem) -> Sensing | None:
        """What the camera senses in the episode, where a problem says what the planner assumes."""
        return sensing_of(self.mismatch, self.cell(problem))


@dataclasses.dataclass(frozen=True)
class RunSettings:
    """How episodes are run and judged.

    Attributes:
      recogniser: what the policy sees the world through; with several slots it has to be traceable, as the policy.
      max_steps: actions in an episode; afterwards the target may still be taken out.
      options: what the records keep of how the episodes were run, beside target, simulator and seed.
      trials: what tries the policy's best actions out before one is made; nothing if left out.
      at_once: how many slots look or decide in one computation.
    """

    recogniser: Recogniser = oracle
    max_steps: int = 10
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    trials: Trials | None = None
    at_once: int = 64


@dataclasses.dataclass(frozen=True)
class Listeners:
    """Who is called while episodes are run.

    Attributes:
      ended: after every round with the episodes that ended in it, if any, and their places among all.
      busy: at the beginning of every stage ("recognise", "plan", "judge", "simulate"), with the number of slots in it.
      compiling: with what is being compiled before the first episode, if anything is.
      watcher: at every step; for one slot only.
    """

    ended: Callable[[Sequence[tuple[int, Episode]]], None]
    busy: Callable[[str, int], None] = lambda stage, episodes: None
    compiling: Callable[[str], None] = lambda text: None
    watcher: Watcher | None = None

    def stage(self, stage: str, episodes: int) -> None:
        """Say that a stage begins."""
        self.busy(stage, episodes)
        if self.watcher is not None:
            self.watcher.busy(stage)


@dataclasses.dataclass
class _Slot:
    """An episode that is running: its place among all, and what is written down of it."""

    place: int
    start: Start
    log: EpisodeLog


class EpisodePool:
    """All slots, and what happens in a round."""

    def __init__(
        self,
        simulator: Simulator,
        problem: Problem,
        planner: Slots,
        count: int,
        settings: RunSettings,
        listeners: Listeners,
        compiling: CompileClock,
    ) -> None:
        """Args:
        simulator: with a world for each slot.
        problem: of all episodes.
        planner: what the planner knows in every slot.
        count: of slots; all are free at first.
        settings: how all episodes are run.
        listeners: who is called.
        compiling: how long JAX has compiled.
        """
        self._simulator, self._problem, self._planner = simulator, problem, planner
        self._settings, self._listeners = settings, listeners
        self._slots: list[_Slot | None] = [None] * count
        self._clock = StageClock(count, listeners.stage, compiling)
        # What is being done in the slots that wait for the end of it.
        self._moving: dict[int, Choice] = {}
        key = jax.random.key_data(jax.random.key(0))
        self._keys: UInt[np.ndarray, "slots 2 *words"] = np.zeros((count, 2, *key.shape), key.dtype)

    @property
    def running(self) -> dict[int, _Slot]:
        """The episodes that have not ended, by their slots."""
        return {row: slot for row, slot in enumerate(self._slots) if slot is not None}

    def begin(self, starts: Mapping[int, tuple[int, Start]]) -> None:
        """Begin episodes, with their places among all, in slots that are free and whose worlds are theirs."""
        fresh = np.zeros(len(self._slots), bool)
        for row, (place, start) in starts.items():
            self._slots[row] = _Slot(place, start, EpisodeLog(start.max_steps or self._settings.max_steps))
            self._keys[row] = jax.random.key_data(jax.random.split(jax.random.key(start.seed)))
            fresh[row] = True
        self._planner.forget(fresh)
        self._planner.decide_by({row: start.policy for row, (_, start) in starts.items()})
        self._planner.sense_by({row: start.sensing(self._problem) for row, (_, start) in starts.items()})

    def round(self) -> list[tuple[int, tuple[int, Episode]]]:
        """Look, decide and act once in the slots that wait for nothing.

        Returns:
          The slots whose episodes ended, with their places and records.
        """
        world, clock = self._simulator.world, self._clock
        logs = {row: slot.log for row, slot in self.running.items() if row not in self._moving}
        assert world is not None
        steps = [slot.log.index if slot else 0 for slot in self._slots]
        planner_keys, environment_keys = keys_at(*jax.device_put((self._keys, np.array(steps, np.int32))))

        with clock("recognise", list(logs)):
            knowledge = self._planner.look(world, environment_keys, list(logs))
        found, lost = knowledge.found, self._target_troubles(world, list(logs))
        trouble = {r: reason for r, reason in lost.items() if found[r]}
        # What the planner takes for the target may be something else, of which there is no verdict.
        truly_found = found & knowledge.shown
        to_judge = [r for r in logs if truly_found[r] and r not in trouble]
        # After the last action the target may still be taken out, where it is found.
        deciding = [r for r in logs if r not in trouble and (found[r] or not logs[r].last)]
        with clock("plan", deciding):
            choices = self._planner.decide(planner_keys, deciding, [r for r in deciding if logs[r].last])
        # `Slots` number objects as they were recognised, the simulator and records number bodies.
        choices = {
            r: choice.replace(bodies=knowledge.bodies[r], there=knowledge.there[r])
            for r, choice in choices.items()
            if not logs[r].last or takes_target(choice)
        }
        with clock("judge", to_judge):
            verdicts = self._planner.judge(world, to_judge)

        trouble |= {r: reason for r, choice in choices.items() if (reason := distrust(choice))}
        for r, log in logs.items():
            # Where an object has left the board, an episode goes on for what else is to be known of it, no further.
            verdict = verdicts.get(r, Verdict())
            if log.irretrievable and (verdict.graspable or (r in choices and takes_target(choices[r]))):
                trouble.setdefault(r, log.irretrievable)
            choice = None if r in trouble else choices.get(r)
            size = 1 if found[r] else int(knowledge.size[r])
            searched = not found[r] and r not in lost
            truth, around = (bool(a[r]) if searched else None for a in (knowledge.truth, knowledge.around))
            log.decide(record(bool(truly_found[r]), size, verdict, choice, truth, int(knowledge.restarts[r]), around))
        return self._act({r: choice for r, choice in choices.items() if r not in trouble}, trouble)

    def _target_troubles(self, world: World, rows: Sequence[int]) -> dict[int, str]:
        """In which of these slots the target can no longer be taken out, and why."""
        position, rotation = (a[:, TARGET] for a in jax.device_get((world.position, world.rotation)))
        shelf, alike = self._problem.shelf, self._problem.target.solid.ends_alike
        reasons = {r: target_trouble(shelf, position[r], rotation[r], alike) for r in rows}
        return {r: reason for r, reason in reasons.items() if reason}

    def _act(self, choices: Mapping[int, Choice], trouble: Mapping[int, str]) -> list[tuple[int, tuple[int, Episode]]]:
        """Execute what was decided, and note what came of what is over; returns as `round`."""
        decided = {r: slot for r, slot in self.running.items() if r not in self._moving}
        acting = [r for r, slot in decided.items() if slot.log.acts]
        moment = self._moment(choices)
        if self._listeners.watcher is not None and moment is not None and acting:
            self._listeners.watcher.decided(moment)
        outcome: Outcome | None = None
        over: dict[int, Choice] = {}
        with self._clock("simulate", [*acting, *self._moving]):
            if acting or self._moving:
                outcome, over = self._executed({r: choices[r] for r in acting})

        # Without an action there is nothing to wait for.
        ends: dict[int, tuple[Result | None, str | None]] = {
            r: (None, trouble.get(r)) for r in decided if r not in acting
        }
        if outcome is not None:
            ends |= {r: self._result(choice, outcome, r) for r, choice in over.items()}
        done: list[tuple[int, tuple[int, Episode]]] = []
        for r, (result, why) in sorted(ends.items()):
            slot = self.running[r]
            if slot.log.act(result, why, self._clock.timings(r)):
                done.append((r, (slot.place, slot.log.episode(slot.start.scenario, self._options(slot.start)))))
                self._slots[r] = None
        if self._listeners.watcher is not None and moment is not None:
            of_slot = None if outcome is None else jax.tree.map(lambda a: a[0], outcome)
            self._listeners.watcher.acted(dataclasses.replace(moment, record=decided[0].log.steps[-1], outcome=of_slot))
        return done

    def _result(self, choice: Choice, outcome: Outcome, row: int) -> tuple[Result, str | None]:
        """What came of what was executed in a slot, and why its episode cannot go on, if so."""
        world = self._simulator.world
        assert world is not None
        return result_of(choice, outcome, row, world, self._problem.shelf), overflow_trouble(outcome, row)

    def _executed(self, choices: Mapping[int, Choice]) -> tuple[Outcome, dict[int, Choice]]:
        """Execute what was decided in some slots: the outcome in all worlds, and the choices that are over."""
        if not (isinstance(self._simulator, Flowing) and len(self._slots) > 1):
            outcome = jax.device_get(self._simulator.execute(*_chosen_actions(choices, len(self._slots))))
            return outcome, dict(choices)
        if choices:
            self._simulator.begin(*_chosen_actions(choices, len(self._slots)))
        self._moving |= choices
        # As many as decide at once, and of few every second one: a decision takes less long than an action.
        done, outcome = self._simulator.advance(min(self._settings.at_once, (len(self._moving) + 1) // 2))
        return outcome, {r: self._moving.pop(r) for r in list(self._moving) if done[r]}

    def _options(self, start: Start) -> dict[str, Any]:
        """The options of an episode, as its record keeps them."""
        engine, shape = self._simulator.engine, self._problem.target.shape
        options = self._settings.options if start.options is None else start.options
        return {**options, "target": shape, "simulator": engine, "seed": start.seed}

    def _moment(self, choices: Mapping[int, Choice]) -> Moment | None:
        """What is known in a single slot, for a watcher."""
        slot = self._planner
        if self._listeners.watcher is None or not isinstance(slot, OneSlot):
            return None
        state, snapshot, truth, decided = slot.state, slot.snapshot, slot.truth, slot.decided
        if state is None or snapshot is None or truth is None:
            return None
        log, bodies = self.running[0].log, np.asarray(truth.bodies)
        decision = named_decision(decided.decision, bodies) if 0 in choices and decided is not None else None
        seen = named_observation(state.observation, bodies)
        tried = nothing_tried() if decided is None else named_tried(decided.tried, bodies)
        return Moment(log.index, snapshot, seen, state.belief, decision, log.steps[-1], None, tried)


def _chosen_actions(choices: Mapping[int, Choice], count: int) -> tuple[Action, Array]:
    """The actions of `count` worlds, by bodies' numbers, NONE without a choice, and which worlds have a choice."""
    actions: Action = jax.tree.map(
        lambda a: np.broadcast_to(a, (count, *np.shape(a))).copy(), jax.device_get(no_action())
    )
    for row, choice in choices.items():
        for name in Action.__dataclass_fields__:
            getattr(actions, name)[row] = getattr(choice.executed, name)
    return jax.device_put((actions, np.isin(np.arange(count), list(choices))))


@cached_jit()
def keys_at(data: UInt[Array, "slots 2 *words"], steps: Int[Array, " slots"]) -> tuple[Array, Array]:
    """The planner's and the environment's key of every slot at its present step."""
    keys, fold = jax.random.wrap_key_data(data), jax.vmap(jax.random.fold_in)
    return fold(keys[:, 0], steps), fold(keys[:, 1], steps)
