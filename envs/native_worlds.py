"""Many worlds in C MuJoCo, as a batch: one `NativeSimulator` each, stepped by threads.

It takes and returns what `MjxSimulator` does, so that the same closed loop runs with either. What happens in a world is
exactly what a `NativeSimulator` of its own would make of it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from mechsearch_jax.actions import Action
from mechsearch_jax.envs.mjx_simulator import RETRIEVE, Failure, Outcomes
from mechsearch_jax.envs.simulator import NativeSimulator, SimulatorConfig
from mechsearch_jax.envs.world import BODIES, World
from mechsearch_jax.errors import InputError
from mechsearch_jax.workspace.scenario import Scenario


class NativeWorlds:
    """Many worlds, each in a simulator of its own.

    Attributes:
      engine: what steps a world.
      world: the present state of all worlds; None before the first `reset`.
    """

    engine = NativeSimulator.__name__

    def __init__(self, threads: int | None = None, config: SimulatorConfig | None = None):
        """Args:
        threads: how many worlds are simulated at the same time; one for each core if left out.
        config: of every world's simulator.
        """
        self.world: World | None = None
        self._config = config
        self._threads = threads or os.cpu_count() or 1
        self._simulators: list[NativeSimulator] = []

    def reset(self, scenarios: Sequence[Scenario]) -> World:
        """Start episodes, one world for each scenario; see `NativeSimulator.reset`.

        Raises:
          InputError: there are no scenarios, or more objects in one than slots.
        """
        if not scenarios:
            raise InputError("NativeWorlds: no scenarios are given; reset it with one for each world")
        self._simulators = [NativeSimulator(config=self._config) for _ in scenarios]
        return self.replace(dict(enumerate(scenarios)))

    def replace(self, scenarios: Mapping[int, Scenario]) -> World:
        """Start episodes in some of the worlds; the others stay as they are."""
        for world, scenario in scenarios.items():
            self._simulators[world].reset(scenario)
        return self._gather()

    def load(self, world: World, only: Bool[np.ndarray, " worlds"] | None = None) -> World:
        """Take over the state of all worlds, or of some; see `MjxSimulator.load`.

        Raises:
          InputError: some worlds are to be kept, but there are not as many.
        """
        count = len(world.kind)
        if only is None:
            self._simulators = [NativeSimulator(config=self._config) for _ in range(count)]
        elif len(self._simulators) != count or len(only) != count:
            raise InputError(f"NativeWorlds: some of {count} worlds can be replaced only where there are as many")
        host = jax.device_get(world)
        for i in range(count) if only is None else np.flatnonzero(only):
            self._simulators[i].load(jax.tree.map(lambda leaf, i=i: leaf[i], host))
        return self._gather()

    def execute(self, actions: Action, active: Bool[Array, " worlds"] | None = None) -> Outcomes:
        """Execute an action in every active world; see `MjxSimulator.execute`.

        Raises:
          InputError: there are not as many actions as worlds.
        """
        count = len(self._simulators)
        if actions.kind.shape != (count,):
            raise InputError(f"NativeWorlds: {actions.kind.shape} actions for {count} worlds; give one for each")
        actions = jax.device_get(actions)
        busy = np.flatnonzero(np.ones(count, bool) if active is None else np.asarray(active)).tolist()
        found: dict[str, np.ndarray] = {
            **{name: np.zeros(count, np.int32) for name in ("failure", "steps", "overflow")},
            **{name: np.zeros(count, bool) for name in ("held", "outside", "retrieved")},
            "settled": np.ones(count, bool),
            "fallen": np.zeros((count, BODIES), bool),
        }

        def run(world: int) -> None:
            simulator = self._simulators[world]
            action = jax.tree.map(lambda leaf: jnp.asarray(leaf[world]), actions)
            if actions.kind[world] == RETRIEVE:
                result = simulator.retrieve(action.T_world_gripper, action.q7, action.opening)
                found["held"][world], found["outside"][world] = result.held, result.outside
                found["retrieved"][world] = result.retrieved
            else:
                result = simulator.execute(action)
                found["settled"][world] = result.settled
            found["failure"][world] = Failure[(result.failure or "none").upper()]
            found["steps"][world] = result.steps
            found["fallen"][world] = result.fallen

        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(run, busy))
        self._gather()
        return Outcomes(**{name: jnp.asarray(value) for name, value in found.items()})

    def _gather(self) -> World:
        worlds = [jax.device_get(simulator.world) for simulator in self._simulators]
        world: World = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *worlds)
        self.world = world
        return world
