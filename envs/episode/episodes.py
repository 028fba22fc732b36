"""Episodes, many at once or one alone: what they are started with, and what is said of them; `closed_loop` runs them.

Each episode has a slot. All slots look, decide and act together; an episode that ends leaves its slot to the next one,
so that short episodes do not wait for long ones. Each episode has its own random numbers: its decisions depend neither
on its slot nor on its neighbours. A single episode is a pool of one slot, which calls the functions of a single scene
and accepts a watcher.

An episode gets three verdicts, all on the true state: `graspable` (the target is found and a collision-free grasp
exists), `paper_graspable` (a collision-free one among the paper's grasps) and `retrieved` (the hand took it out of the
shelf, and no object fell off the board, neither then nor before). A retrieval does not imply `graspable`: a grasp that
touches something may succeed where no collision-free one exists. An action that fails costs a step and leaves the world
as it made it. Once an object has left the board no retrieval counts: the episode continues until the target is found
and graspable, or the policy decides on a retrieval, which is not executed. An episode ends with its retrieval,
graspable or not, and does not continue for the sake of `paper_graspable`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import jax
import numpy as np

from mechsearch_jax.envs.episode.closed_loop import EpisodePool, Listeners, RunSettings, Start, keys_at
from mechsearch_jax.envs.episode.compile_clock import CompileClock
from mechsearch_jax.envs.episode.many_slots import ManySlots
from mechsearch_jax.envs.episode.moments import Watcher
from mechsearch_jax.envs.episode.records import Episode
from mechsearch_jax.envs.episode.slots import OneSlot, Slots
from mechsearch_jax.envs.simulators.simulator import Simulator
from mechsearch_jax.envs.world.world import World, from_scenario
from mechsearch_jax.planner import Policy, Problem
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.own_settings import in_own_settings
from mechsearch_jax.session.preparing import Program, prepared, program
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.target import Target


def target_of(scenario: Scenario, usual: Target | None = None) -> Target:
    """The planner's description of a scenario's target: its shape and the resolution of its candidate poses.

    Args:
      scenario: the shape's source.
      usual: the resolution's source; the default target if None.
    """
    return (usual or Target()).like(Target.of_body(scenario.target))


@in_own_settings
def run_episode(
    start: Start,
    problem: Problem,
    policy: Policy,
    simulator: Simulator,
    settings: RunSettings | None = None,
    watcher: Watcher | None = None,
) -> Episode:
    """Run one episode to its end.

    Args:
      start: the episode.
      problem, policy, simulator, settings: see `run_episodes`. Neither the policy nor the recogniser need be traceable.
      watcher: follows every step.
    """
    episodes: list[tuple[int, Episode]] = []
    run_episodes([start], problem, policy, simulator, 1, Listeners(episodes.extend, watcher=watcher), settings)
    return episodes[0][1]


@in_own_settings
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
    `Flowing` simulator slots do not wait for each other: those whose action is over look and decide again, while the
    actions of the others continue.

    Args:
      starts: the episodes.
      problem: built for the target of all their scenarios.
      policy: decides; it takes the target out by an action of kind RETRIEVE.
      simulator: executes the actions; it is reset first.
      slots: largest number of episodes that run at the same time.
      listeners: what is called.
      settings: how episodes are run; the defaults if None.

    Raises:
      InputError: there is no slot, a watcher is given for several, the policy decides on an unknown kind of action,
        policies or mismatches differ in more than numbers, or the simulator cannot differ as a mismatch says.
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
    planner_slots = _planner_slots(first, problem, policy, simulator, settings, listeners)
    with CompileClock() as clock:
        pool = EpisodePool(simulator, problem, planner_slots, len(first), settings, listeners, clock)
        pool.begin(dict(enumerate(first)))
        while pool.running:
            done = pool.round()
            if done:
                listeners.ended([pair for _, pair in done])
            fresh = {slot: pair for (slot, _), pair in zip(done, queue, strict=False)}
            if fresh:
                _set_cells(simulator, problem, {slot: start for slot, (_, start) in fresh.items()})
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
    """The planner's slots of the first episodes, for which the simulator is reset and everything is compiled."""
    count, recogniser = len(first), settings.recogniser
    _set_cells(simulator, problem, {row: start for row, (_, start) in enumerate(first)})
    scenarios = [start.scenario for _, start in first]
    if count == 1:
        simulator.reset(scenarios)
        return OneSlot(problem, policy, recogniser, settings.trials)
    shapes: World = jax.tree.map(
        lambda a: jax.ShapeDtypeStruct((count, *a.shape), a.dtype), from_scenario(scenarios[0])
    )
    sensing = first[0][1].sensing(problem)
    planner_slots = ManySlots(
        problem, policy, recogniser, shapes, min(settings.at_once, count), settings.trials, sensing
    )
    # Raises before anything is compiled in vain.
    planner_slots.decide_by({row: start.policy for row, (_, start) in enumerate(first)})
    planner_slots.sense_by({row: start.sensing(problem) for row, (_, start) in enumerate(first)})
    with prepared(batch_programs(planner_slots, simulator, shapes), listeners.compiling):
        simulator.reset(scenarios)
    return planner_slots


def _set_cells(simulator: Simulator, problem: Problem, starts: Mapping[int, Start]) -> None:
    """Tell a simulator the cells of the episodes that begin next in its worlds.

    Raises:
      InputError: one of them is not as the planner assumes, and the simulator cannot differ.
    """
    if simulator.takes_cells:
        simulator.set_cells({row: start.cell(problem) for row, start in starts.items()})
    elif any(start.mismatch.simulates_otherwise for start in starts.values()):
        raise InputError(f"{simulator.engine}: cannot differ from what the planner assumes; use the NativeSimulator")


def batch_programs(planner_slots: ManySlots, simulator: Simulator, world: World) -> list[Program]:
    """All programs of several slots, in the order in which they are lowered.

    Args:
      planner_slots: of the planner.
      simulator: see `run_episodes`.
      world: of all slots, or its shapes.
    """
    deciding, *seeing = planner_slots.programs(world)
    simulating = simulator.programs(world)
    kernels = [task for task in simulating if task.name == "kernels"]
    keys = jax.ShapeDtypeStruct((len(world.kind), 2, *jax.random.key_data(jax.random.key(0)).shape), np.uint32)
    stepping = program("small ones", keys_at, keys, jax.ShapeDtypeStruct((len(world.kind),), np.int32))
    return [*kernels, deciding, *(task for task in simulating if task not in kernels), *seeing, stepping]
