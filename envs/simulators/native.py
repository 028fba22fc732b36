"""The native simulator: many worlds in C MuJoCo, each stepped on a core of the CPU.

    simulator = NativeSimulator()
    world = simulator.reset([scenario])    # one world for each scenario
    outcome = simulator.execute(actions)   # an `Action` whose fields have a leading axis for the worlds

A single world is a `native_world.NativeWorld`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from jaxtyping import Array, Bool

from mechsearch_jax.actions import Action
from mechsearch_jax.envs.simulators.native_world import NativeWorld
from mechsearch_jax.envs.simulators.simulator import Simulator, SimulatorConfig, check_actions
from mechsearch_jax.envs.simulators.trace import Trace
from mechsearch_jax.envs.world.mismatch import ASSUMED_CELL, TrueCell
from mechsearch_jax.envs.world.outcome import Failure, Outcome, outcome_of
from mechsearch_jax.envs.world.world import BODIES, World, alike
from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.preparing import Program, motions
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf


class NativeSimulator(Simulator):
    """Many worlds, each a `NativeWorld`, stepped by threads. Each behaves exactly as a single `NativeWorld`."""

    engine = "NativeSimulator"
    takes_cells = True

    def __init__(
        self,
        threads: int | None = None,
        config: SimulatorConfig | None = None,
        shelf: Shelf | None = None,
        camera: Camera | None = None,
    ):
        """Args:
        threads: number of worlds that are simulated at the same time; one for each core if None.
        config, shelf, camera: of every world.
        """
        self._config, self._shelf, self._camera = config, shelf, camera
        self._threads = threads or cores()
        self._worlds: list[NativeWorld] = []
        self._cells: dict[int, TrueCell] = {}

    @property
    def traces(self) -> list[Trace]:
        """The traces of every world's last action."""
        return [world.trace for world in self._worlds]

    def reset(self, scenarios: Sequence[Scenario]) -> World:
        if not scenarios:
            raise InputError("NativeSimulator: no scenarios are given; reset it with one for each world")
        self._make(len(scenarios))
        return self.replace(dict(enumerate(scenarios)))

    def replace(self, scenarios: Mapping[int, Scenario]) -> World:
        if not self._worlds:
            raise InputError(f"{self.engine}: reset it before use")
        for i, scenario in scenarios.items():
            self._worlds[i].reset(scenario, self._cells.pop(i, ASSUMED_CELL))
        return self._gather()

    def set_cells(self, cells: Mapping[int, TrueCell]) -> None:
        self._cells.update(cells)

    def load(self, world: World, only: Bool[np.ndarray, " worlds"] | None = None) -> World:
        count = len(world.kind)
        if only is None:
            self._make(count)
        else:
            self._check_part(count, only)
        host = jax.device_get(world)
        for i in range(count) if only is None else np.flatnonzero(only):
            self._worlds[i].load(jax.tree.map(lambda leaf, i=i: leaf[i], host))
        return self._gather()

    def execute(self, actions: Action, active: Bool[Array, " worlds"] | None = None) -> Outcome:
        check_actions(self.engine, actions, self._count())
        actions = jax.device_get(actions)
        return self._each(active, lambda i: self._worlds[i].execute(_row(actions, i)))

    def programs(self, world: World) -> list[Program]:
        """The motions of all kinds of action."""
        return motions((self._config or SimulatorConfig()).motion)

    def settle(self, active: Bool[Array, " worlds"] | None = None) -> Outcome:
        self._count()
        return self._each(active, lambda i: self._worlds[i].settle())

    def _make(self, count: int) -> None:
        """Create or drop worlds so that there are `count`."""
        missing = [NativeWorld(self._shelf, self._camera, self._config) for _ in range(count - len(self._worlds))]
        self._worlds = (self._worlds + missing)[:count]

    def _each(self, active: Bool[Array, " worlds"] | None, run: Callable[[int], Outcome]) -> Outcome:
        """The outcomes of `run` in every active world, and of doing nothing in the others."""
        count = len(self._worlds)
        busy = np.flatnonzero(np.ones(count, bool) if active is None else np.asarray(active)).tolist()
        with ThreadPoolExecutor(self._threads) as pool:
            outcomes = dict(zip(busy, jax.device_get(list(pool.map(run, busy))), strict=True))
        self._gather()
        idle = jax.device_get(outcome_of(Failure.NONE, 0, True, np.zeros(BODIES, bool)))
        return jax.tree.map(
            lambda *leaves: jax.device_put(np.stack(leaves)), *(outcomes.get(i, idle) for i in range(count))
        )

    def _gather(self) -> World:
        worlds = alike([jax.device_get(world.world) for world in self._worlds])
        world: World = jax.tree.map(lambda *leaves: jax.device_put(np.stack(leaves)), *worlds)
        self.world = world
        return world


def _row(actions: Action, i: int) -> Action:
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)[i]), actions)
