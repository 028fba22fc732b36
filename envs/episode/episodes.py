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

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from mechsearch_jax.envs.camera.snapshot import Recogniser, oracle
from mechsearch_jax.envs.episode.compile_clock import CompileClock
from mechsearch_jax.envs.episode.many_slots import ManySlots
from mechsearch_jax.envs.episode.moments import Watcher
from mechsearch_jax.envs.episode.pool import STRICT, EpisodePool, Listeners, RunSettings, Start, keys_at
from mechsearch_jax.envs.episode.protocols import EpisodeProtocol
from mechsearch_jax.envs.episode.records import Episode
from mechsearch_jax.envs.episode.slots import OneSlot, Slots
from mechsearch_jax.envs.simulators.simulator import Prepares, Simulator
from mechsearch_jax.envs.world.world import World, from_scenario
from mechsearch_jax.planner import Policy, Problem
from mechsearch_jax.planner.trials import Trials
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.preparing import Program, prepared, program
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.target import Target


def target_of(scenario: Scenario, usual: Target | None = None) -> Target:
    """The target of a scenario as the planner knows it: its shape, and how finely it is searched.

    Args:
      scenario: says what the target is.
      usual: searched as finely as the scenario's is to be; the default target if None.
    """
    return (usual or Target()).resized(scenario.target.shape, scenario.target.half_size)


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
      problem, policy, simulator: see `run_episodes`. Neither the policy nor the recogniser need be traceable.
      recogniser, max_steps, options, protocol, trials: see `RunSettings`.
      watcher: called at every step.
    """
    episodes: list[tuple[int, Episode]] = []
    settings = RunSettings(recogniser, max_steps, options or {}, protocol, trials)
    listeners = Listeners(episodes.extend, watcher=watcher)
    run_episodes([Start(scenario, seed)], problem, policy, simulator, 1, listeners, settings)
    return episodes[0][1]


def run_episodes(
    starts: Iterable[Start],
    problem: Problem,
    policy: Policy,
    simulator: Simulator,
    slots: int,
    listeners: Listeners,
    settings: RunSettings | None = None,
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
      listeners: who is called, with the places of episodes in `starts`.
      settings: how they are run; the defaults if left out.

    Raises:
      InputError: there is no slot, a watcher is given for several, the policy decides on an unknown kind of action, or
        policies differ in more than numbers.
    """
    settings = settings or RunSettings()
    if slots < 1:
        raise InputError(f"run_episodes: {slots} slots run nothing; give at least 1")
    queue = enumerate(starts)
    first = [pair for _, pair in zip(range(slots), queue, strict=False)]
    if not first:
        return
    if listeners.watcher is not None and len(first) > 1:
        raise InputError(f"run_episodes: a watcher looks on at one slot, not at {len(first)}")
    planner = _planner_slots(first, problem, policy, simulator, settings, listeners)
    with CompileClock() as clock:
        pool = EpisodePool(simulator, problem, planner, len(first), settings, listeners, clock)
        pool.begin(dict(enumerate(first)))
        while pool.running:
            done = pool.round()
            if done:
                listeners.ended([pair for _, pair in done])
            fresh = {slot: pair for (slot, _), pair in zip(done, queue, strict=False)}
            if fresh:
                simulator.replace({slot: start.scenario for slot, (_, start) in fresh.items()})
                pool.begin(fresh)


def _planner_slots(
    first: Sequence[tuple[int, Start]],
    problem: Problem,
    policy: Policy,
    simulator: Simulator,
    settings: RunSettings,
    listeners: Listeners,
) -> Slots:
    """What the planner knows in the slots of the first episodes, for which the simulator is reset; all is compiled."""
    count, recogniser = len(first), settings.protocol.recogniser(settings.recogniser)
    scenarios = [start.scenario for _, start in first]
    if count == 1:
        simulator.reset(scenarios)
        return OneSlot(problem, policy, recogniser, settings.trials)
    shapes: World = jax.tree.map(
        lambda a: jax.ShapeDtypeStruct((count, *a.shape), a.dtype), from_scenario(scenarios[0])
    )
    planner = ManySlots(problem, policy, recogniser, shapes, min(settings.at_once, count), settings.trials)
    # Before anything is compiled in vain.
    planner.decide_by({row: start.policy for row, (_, start) in enumerate(first)})
    with prepared(batch_programs(planner, simulator, shapes), listeners.compiling):
        simulator.reset(scenarios)
    return planner


def batch_programs(planner: ManySlots, simulator: Simulator, world: World) -> list[Program]:
    """All that is compiled for several slots, in the order in which it is to be lowered.

    Args:
      planner: what the planner knows in every slot.
      simulator: see `run_episodes`.
      world: of all slots, or its shapes.
    """
    deciding, *seeing = planner.programs(world)
    simulating = simulator.programs(world) if isinstance(simulator, Prepares) else []
    kernels = [each for each in simulating if each.name == "kernels"]
    keys = jax.ShapeDtypeStruct((len(world.kind), 2, *jax.random.key_data(jax.random.key(0)).shape), np.uint32)
    stepping = program("small ones", keys_at, keys, jax.ShapeDtypeStruct((len(world.kind),), np.int32))
    return [*kernels, deciding, *(each for each in simulating if each not in kernels), *seeing, stepping]
