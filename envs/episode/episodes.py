"""The closed loop: look, recognise, update the belief, propose, try, choose, act; many episodes at once, or one alone.

Each episode has a slot. All slots look, decide and act together; an episode that ends leaves its slot to the next one,
so that short episodes do not wait for long ones. The random numbers of an episode are its own: what it decides depends
neither on its slot nor on its neighbours. An episode alone is a pool of one slot, which calls the functions of a single
scene, and which can be watched.

Three verdicts are passed on an episode, all on the true state: `graspable` (the target is found and a collision-free
grasp exists), `paper_graspable` (a collision-free one among the paper's grasps) and `retrieved` (the hand took it out
of the shelf, and no object fell, neither then nor before). A retrieval does not make a target graspable: a grasp that
touches something may take it out where no collision-free one exists. An action that fails costs a step and leaves the
world as it made it. Once an object has left the board nothing can be retrieved any more: the episode goes on until the
target is found and graspable, or would be taken out, and takes nothing out. An episode ends with its retrieval,
graspable or not, and none goes on for the sake of `paper_graspable`.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Int, UInt

from mechsearch_jax.envs.camera.snapshot import Recogniser, Snapshot, oracle
from mechsearch_jax.envs.episode.compile_clock import CompileClock
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
from mechsearch_jax.envs.episode.protocols import ALL_FAILED, EpisodeProtocol, Execution, Strict, chosen_actions
from mechsearch_jax.envs.episode.records import Episode, Step
from mechsearch_jax.envs.episode.slots import ManySlots, OneSlot, Slots
from mechsearch_jax.envs.episode.verdicts import Verdict
from mechsearch_jax.envs.simulators.simulator import Flowing, Prepares, Simulator
from mechsearch_jax.envs.world.outcome import Outcome
from mechsearch_jax.envs.world.world import TARGET, World, from_scenario
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Belief, Decision, Policy, Problem
from mechsearch_jax.planner.trials import Trials
from mechsearch_jax.runtime.compiled import kept
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.preparing import Program, prepared, program
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.target import Target

STRICT = Strict()


def target_of(scenario: Scenario, usual: Target | None = None) -> Target:
    """The target of a scenario as the planner knows it: its shape, and how finely it is searched.

    Args:
      scenario: says what the target is.
      usual: searched as finely as the scenario's is to be; the default target if None.
    """
    return (usual or Target()).resized(scenario.target.shape, scenario.target.half_size)


@dataclasses.dataclass(frozen=True)
class Start:
    """An episode to be run.

    Attributes:
      scenario: where everything stands at the start.
      seed: of the planner's and of the environment's random numbers, which are independent of each other.
      policy, max_steps, options: where they are not None, instead of those of the run. With several slots the policies
        of a run may differ in numbers alone; see `policy_numbers`.
    """

    scenario: Scenario
    seed: int
    policy: Policy | None = None
    max_steps: int | None = None
    options: Mapping[str, Any] | None = None


@dataclasses.dataclass(frozen=True)
class Moment:
    """All that is known at one step of an episode, for who looks on.

    Attributes:
      index: number of actions before it.
      snapshot: what the camera sees.
      observation: what was recognised.
      belief: where the target can be.
      decision: of the policy; None where none was needed or none could be acted upon.
      record: what is written down; its `observed_cost` comes later.
      outcome: what the simulator said of the action; None before it was executed, or without one.
    """

    index: int
    snapshot: Snapshot
    observation: Observation
    belief: Belief
    decision: Decision | None
    record: Step
    outcome: Outcome | None


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


def run_episode(
    seed: int,
    scenario: Scenario,
    problem: Problem,
    policy: Policy,
    simulator: Simulator,
    recogniser: Recogniser = oracle,
    max_steps: int = 10,
    options: Mapping[str, Any] | None = None,
    watcher: Watcher | None = None,
    protocol: EpisodeProtocol = STRICT,
    trials: Trials | None = None,
) -> Episode:
    """Run one episode to its end, whatever that is.

    Args:
      seed: see `Start`.
      scenario: where everything stands at the start.
      problem, policy, simulator, recogniser, max_steps, options, watcher, protocol, trials: see `run_episodes`. Neither
        the policy nor the recogniser need be traceable.
    """
    found: list[tuple[int, Episode]] = []
    start = Start(scenario, seed)
    run_episodes(
        [start],
        problem,
        policy,
        simulator,
        1,
        found.extend,
        recogniser,
        max_steps,
        options,
        watcher=watcher,
        protocol=protocol,
        trials=trials,
    )
    return found[0][1]


def run_episodes(
    starts: Iterable[Start],
    problem: Problem,
    policy: Policy,
    simulator: Simulator,
    slots: int,
    ended: Callable[[Sequence[tuple[int, Episode]]], None],
    recogniser: Recogniser = oracle,
    max_steps: int = 10,
    options: Mapping[str, Any] | None = None,
    at_once: int = 64,
    busy: Callable[[str, int], None] = lambda stage, episodes: None,
    watcher: Watcher | None = None,
    protocol: EpisodeProtocol = STRICT,
    compiling: Callable[[str], None] = lambda text: None,
    trials: Trials | None = None,
) -> None:
    """Run episodes to their ends, many at a time.

    With several slots everything is compiled before the first of them begins; see `session.preparing.prepare`. In a
    simulator that can, `Flowing`, slots do not wait for each other: those that have acted look and decide again, while
    what the others do goes on afterwards.

    Args:
      starts: the episodes.
      problem: built for the target of all their scenarios.
      policy: decides; it takes the target out by an action of kind RETRIEVE.
      simulator: executes the actions; reset first.
      slots: how many episodes run at the same time, at most.
      ended: told after every round of the episodes that ended in it, if any, with their places in `starts`.
      recogniser: what the policy sees the world through; with several slots it has to be traceable, as the policy.
      max_steps: actions in an episode; afterwards the target may still be taken out.
      options: what the records keep of how the episodes were run, beside target, simulator and seed.
      at_once: how many slots look or decide in one computation.
      busy: told of every stage ("recognise", "plan", "judge", "simulate"), with the number of slots in it.
      watcher: told of every step; for one slot only.
      protocol: how they are run and judged. Who gives another has built the problem by `protocol.problem`.
      compiling: told of what is being compiled before the first episode, if anything is.
      trials: what tries the policy's best actions out before one is made; nothing if left out.

    Raises:
      InputError: there is no slot, a watcher is given for several, the policy decides on an unknown kind of action, or
        policies differ in more than numbers.
    """
    if slots < 1:
        raise InputError(f"run_episodes: {slots} slots run nothing; give at least 1")
    queue = enumerate(starts)
    first = [pair for _, pair in zip(range(slots), queue, strict=False)]
    if not first:
        return
    if watcher is not None and len(first) > 1:
        raise InputError(f"run_episodes: a watcher looks on at one slot, not at {len(first)}")
    count, recogniser = len(first), protocol.recogniser(recogniser)
    scenarios = [start.scenario for _, start in first]
    if count == 1:
        simulator.reset(scenarios)
        known: Slots = OneSlot(problem, policy, recogniser, trials)
    else:
        shapes: World = jax.tree.map(
            lambda a: jax.ShapeDtypeStruct((count, *a.shape), a.dtype), from_scenario(scenarios[0])
        )
        known = ManySlots(problem, policy, recogniser, shapes, min(at_once, count), trials)
        # Before anything is compiled in vain.
        known.decide_by({row: start.policy for row, (_, start) in enumerate(first)})
        with prepared(batch_programs(known, simulator, shapes), compiling):
            simulator.reset(scenarios)
    with CompileClock() as clock:
        pool = _EpisodePool(
            simulator, problem, known, count, _Run(max_steps, options or {}, busy, watcher, clock, protocol, at_once)
        )
        pool.begin(dict(enumerate(first)))
        while pool.running:
            done = pool.round()
            if done:
                ended([pair for _, pair in done])
            fresh = {slot: pair for (slot, _), pair in zip(done, queue, strict=False)}
            if fresh:
                simulator.replace({slot: start.scenario for slot, (_, start) in fresh.items()})
                pool.begin(fresh)


def batch_programs(known: ManySlots, simulator: Simulator, world: World) -> list[Program]:
    """All that is compiled for several slots, in the order in which it is to be lowered.

    Args:
      known: what the planner knows in every slot.
      simulator: see `run_episodes`.
      world: of all slots, or its shapes.
    """
    deciding, *seeing = known.programs(world)
    simulating = simulator.programs(world) if isinstance(simulator, Prepares) else []
    kernels = [each for each in simulating if each.name == "kernels"]
    keys = jax.ShapeDtypeStruct((len(world.kind), 2, *jax.random.key_data(jax.random.key(0)).shape), np.uint32)
    stepping = program("small ones", _keys_at, keys, jax.ShapeDtypeStruct((len(world.kind),), np.int32))
    return [*kernels, deciding, *(each for each in simulating if each not in kernels), *seeing, stepping]


@dataclasses.dataclass(frozen=True)
class _Run:
    """What concerns all episodes alike; see `run_episodes`."""

    max_steps: int
    options: Mapping[str, Any]
    told: Callable[[str, int], None]
    watcher: Watcher | None
    compiling: CompileClock
    protocol: EpisodeProtocol
    at_once: int

    def busy(self, stage: str, episodes: int) -> None:
        """Say that a stage begins."""
        self.told(stage, episodes)
        if self.watcher is not None:
            self.watcher.busy(stage)


class _Clock:
    """Wall time of the stages of a step, shared equally by the slots that took part.

    What JAX compiled meanwhile is apart from them, as "compile".
    """

    def __init__(self, slots: int, busy: Callable[[str, int], None], compiling: CompileClock) -> None:
        self._timings: list[dict[str, float]] = [{} for _ in range(slots)]
        self._busy = busy
        self._compiling = compiling

    @contextmanager
    def __call__(self, stage: str, rows: Sequence[int]) -> Iterator[None]:
        if rows:
            self._busy(stage, len(rows))
        start, before = time.perf_counter(), self._compiling.seconds
        yield
        took, compiled = time.perf_counter() - start, self._compiling.seconds - before
        for row in rows:
            timings = self._timings[row]
            timings[stage] = round(timings.get(stage, 0.0) + max(took - compiled, 0.0) / len(rows), 6)
            if compiled:
                timings["compile"] = round(timings.get("compile", 0.0) + compiled / len(rows), 6)

    def timings(self, row: int) -> dict[str, float]:
        """Those of a slot since it was last read."""
        found, self._timings[row] = self._timings[row], {}
        return found


@dataclasses.dataclass
class _Slot:
    """An episode that is running: its place among all, and what is written down of it."""

    place: int
    start: Start
    log: EpisodeLog


class _EpisodePool:
    """All slots, and what happens in a round."""

    def __init__(self, simulator: Simulator, problem: Problem, known: Slots, count: int, run: _Run) -> None:
        """Args:
        simulator: with a world for each slot.
        problem: of all episodes.
        known: what the planner knows in every slot.
        count: of slots; all are free at first.
        run: what concerns all episodes alike.
        """
        self._simulator, self._problem, self._known, self._run = simulator, problem, known, run
        self._slots: list[_Slot | None] = [None] * count
        self._clock = _Clock(count, run.busy, run.compiling)
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
            self._slots[row] = _Slot(place, start, EpisodeLog(start.max_steps or self._run.max_steps))
            self._keys[row] = jax.random.key_data(jax.random.split(jax.random.key(start.seed)))
            fresh[row] = True
        self._known.forget(fresh)
        self._known.decide_by({row: start.policy for row, (_, start) in starts.items()})

    def round(self) -> list[tuple[int, tuple[int, Episode]]]:
        """Look, decide and act once in the slots that wait for nothing.

        Returns:
          The slots whose episodes ended, with their places and records.
        """
        world, clock = self._simulator.world, self._clock
        logs = {row: slot.log for row, slot in self.running.items() if row not in self._moving}
        assert world is not None
        steps = [slot.log.index if slot else 0 for slot in self._slots]
        planner_keys, environment_keys = _keys_at(*jax.device_put((self._keys, np.array(steps, np.int32))))

        with clock("recognise", list(logs)):
            known = self._known.look(world, environment_keys, list(logs))
        found, lost = known.found, self._target_troubles(world, list(logs))
        trouble = {r: reason for r, reason in lost.items() if found[r]}
        sought = [r for r in logs if found[r] and r not in trouble]
        # After the last action the target may still be taken out, where it is found.
        asked = [r for r in logs if r in sought or not (found[r] or logs[r].last)]
        with clock("plan", asked):
            choices = self._known.decide(planner_keys, asked)
        choices = {r: choice for r, choice in choices.items() if not logs[r].last or takes_target(choice)}
        with clock("judge", sought):
            verdicts = self._run.protocol.judge(self._known, world, sought)

        trouble |= {r: reason for r, choice in choices.items() if (reason := distrust(choice))}
        trouble |= self._run.protocol.ends(self._problem.shelf, world, list(logs), verdicts, choices)
        for r, log in logs.items():
            # Where an object has left the board, an episode goes on for what else is to be known of it, no further.
            verdict = verdicts.get(r, Verdict())
            if log.spoilt and (verdict.graspable or (r in choices and takes_target(choices[r]))):
                trouble.setdefault(r, log.spoilt)
            choice = None if r in trouble else choices.get(r)
            size = 1 if found[r] else int(known.size[r])
            truth = None if found[r] or r in lost else bool(known.truth[r])
            log.decide(record(bool(found[r]), size, verdict, choice, truth, int(known.restarts[r])))
        return self._act({r: choice for r, choice in choices.items() if r not in trouble}, trouble)

    def _target_troubles(self, world: World, rows: Sequence[int]) -> dict[int, str]:
        """In which of these slots the target can no longer be taken out, and why."""
        position, rotation = (a[:, TARGET] for a in jax.device_get((world.position, world.rotation)))
        reasons = {r: target_trouble(self._problem.shelf, position[r], rotation[r]) for r in rows}
        return {r: reason for r, reason in reasons.items() if reason}

    def _act(self, choices: Mapping[int, Choice], trouble: Mapping[int, str]) -> list[tuple[int, tuple[int, Episode]]]:
        """Execute what was decided, and note what came of what is over; returns as `round`."""
        decided = {r: slot for r, slot in self.running.items() if r not in self._moving}
        acting = [r for r, slot in decided.items() if slot.log.acts]
        moment = self._moment(choices)
        if self._run.watcher is not None and moment is not None and acting:
            self._run.watcher.decided(moment)
        executed: Execution | None = None
        with self._clock("simulate", [*acting, *self._moving]):
            if acting or self._moving:
                executed = self._executed({r: choices[r] for r in acting})
                others = {r: choice for r, choice in executed.choices.items() if choice is not choices.get(r, choice)}
                self._known.took({r: choice.action for r, choice in others.items()})
                for r, choice in others.items():
                    decided[r].log.took(choice)

        # Without an action there is nothing to wait for.
        ends: dict[int, tuple[Result | None, str | None]] = {
            r: (None, trouble.get(r)) for r in decided if r not in acting
        }
        if executed is not None:
            ends |= {r: _result(executed, r) for r in executed.choices.keys() | executed.stuck}
        done: list[tuple[int, tuple[int, Episode]]] = []
        for r, (result, why) in sorted(ends.items()):
            slot = self.running[r]
            if slot.log.act(result, why, self._clock.timings(r)):
                done.append((r, (slot.place, slot.log.episode(slot.start.scenario, self._options(slot.start)))))
                self._slots[r] = None
        if self._run.watcher is not None and moment is not None:
            told = None if executed is None else jax.tree.map(lambda a: a[0], executed.outcome)
            self._run.watcher.acted(dataclasses.replace(moment, record=decided[0].log.steps[-1], outcome=told))
        return done

    def _executed(self, choices: Mapping[int, Choice]) -> Execution:
        """Execute what was decided in some slots; what came of it in those whose actions are over."""
        if not (self._run.protocol.once and isinstance(self._simulator, Flowing) and len(self._slots) > 1):
            return self._run.protocol.execute(self._simulator, choices)
        if choices:
            self._simulator.begin(*chosen_actions(choices, len(self._slots)))
        self._moving |= choices
        # As many as decide at once, and of few every second one: a decision takes less long than an action.
        done, outcome = self._simulator.advance(min(self._run.at_once, (len(self._moving) + 1) // 2))
        return Execution(outcome, {r: self._moving.pop(r) for r in list(self._moving) if done[r]})

    def _options(self, start: Start) -> dict[str, Any]:
        """The options of an episode, as its record keeps them."""
        engine, shape = self._simulator.engine, self._problem.target.shape
        told = self._run.options if start.options is None else start.options
        return {**told, "target": shape, "simulator": engine, "seed": start.seed}

    def _moment(self, choices: Mapping[int, Choice]) -> Moment | None:
        """What is known in a single slot."""
        known = self._known
        if not isinstance(known, OneSlot) or known.snapshot is None or known.observation is None:
            return None
        log = self.running[0].log
        decision = known.decision if 0 in choices else None
        return Moment(log.index, known.snapshot, known.observation, known.belief, decision, log.steps[-1], None)


@kept()
def _keys_at(data: UInt[Array, "slots 2 *words"], steps: Int[Array, " slots"]) -> tuple[Array, Array]:
    """The planner's and the environment's key of every slot at its present step."""
    keys, fold = jax.random.wrap_key_data(data), jax.vmap(jax.random.fold_in)
    return fold(keys[:, 0], steps), fold(keys[:, 1], steps)


def _result(executed: Execution, row: int) -> tuple[Result | None, str | None]:
    """What came of what was executed in a slot, and why its episode cannot go on, if so."""
    if row in executed.stuck:
        return None, ALL_FAILED
    return result_of(executed.choices[row], executed.outcome, row), overflow_trouble(executed.outcome, row)
