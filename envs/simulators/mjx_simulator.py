"""The batch simulator: MuJoCo Warp in MJX steps thousands of worlds in one compiled function.

It has the scene, the motion primitives and the verdicts of the native simulator, for W worlds at once:

    simulator = MjxSimulator()
    world = simulator.reset(scenarios)            # W scenarios; a `World` whose fields have a leading axis W
    outcome = simulator.execute(actions)          # an `Action` whose fields have a leading axis W
    outcome = simulator.execute(actions, active)  # worlds whose `active` (W,) is False stay exactly as they are
    simulator.world                               # the present state
    outcome.failure                               # (W,) codes of `Failure`; `outcome.reason(i)` is the text
    outcome.overflow                              # (W,) flags of `Overflow`; not 0: do not trust this world

The kinds of action may differ between the worlds of a call. All worlds step together until the last of them is at rest;
a world that is done before that is frozen. A world whose state diverges is restored and frozen at once, so that it
affects no other. The first call for a number of worlds compiles; later ones do not, whatever the actions are.

A step of few worlds takes as long as one of hundreds. So with many worlds one need not wait for the last of them:

    simulator.begin(actions, active)               # worlds that are not active continue
    done, outcome = simulator.advance(64)          # until 64 more are done: which ones, and their outcomes

All arrays stay on the device: the host waits for the kinds of the actions, and for fields of an outcome or of `world`
that are read.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions import Action, ActionKind, no_action
from mechsearch_jax.envs.simulators.batch_model import BodyFields, cells_of, fitting, like_present, room_for
from mechsearch_jax.envs.simulators.mjx_model import MjxConfig, MjxModel, where
from mechsearch_jax.envs.simulators.mjx_step import (
    Progress,
    Task,
    acting,
    advance,
    at_rest,
    begin,
    placed,
    taken_over,
    tasks_merged,
    verdicts,
    waiting,
)
from mechsearch_jax.envs.simulators.simulator import ROBOT, Flowing, check_actions
from mechsearch_jax.envs.world.mismatch import ASSUMED_CELL, TrueCell
from mechsearch_jax.envs.world.outcome import Failure, Outcome
from mechsearch_jax.envs.world.world import TARGET, World, alike, from_scenario
from mechsearch_jax.runtime.compiled import CachedJit
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.preparing import Program
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf


class MjxSimulator(Flowing):
    """Many worlds in MuJoCo Warp; see the module's description.

    The same scenarios and actions always give the same results on a CPU, but not on a GPU.

    Attributes:
      shelf, camera, config: as given.
    """

    engine = "MjxSimulator"
    takes_cells = True

    def __init__(self, shelf: Shelf | None = None, camera: Camera | None = None, config: MjxConfig | None = None):
        """Raises:
        InputError: Warp cannot be imported.
        """
        self.shelf = shelf or Shelf()
        self.camera = camera or Camera()
        self.config = config or MjxConfig()
        self._fields: BodyFields | None = None
        # Of all worlds now, and of those that begin next.
        self._cells: list[TrueCell] = []
        self._next_cells: dict[int, TrueCell] = {}
        self._data: Any = None
        # Task and progress of all worlds, and which outcomes were reported already; which worlds are moving.
        self._tasks: tuple[Task, Progress, Array] | None = None
        self._moving = np.zeros(0, bool)
        self._adopt(MjxModel(self.shelf, self.camera, self.config))

    def reset(self, scenarios: Sequence[Scenario]) -> World:
        if not scenarios:
            raise InputError("MjxSimulator: no scenarios are given; reset it with one for each world")
        worlds = alike([from_scenario(scenario) for scenario in scenarios])
        self._cells = [self._next_cells.pop(i, ASSUMED_CELL) for i in range(len(worlds))]
        return self.load(jax.tree.map(lambda *leaves: np.stack(leaves), *worlds))

    def replace(self, scenarios: Mapping[int, Scenario]) -> World:
        count = self._count()
        new = jax.tree.map(np.array, self.world)
        for i, scenario in scenarios.items():
            self._cells[i] = self._next_cells.pop(i, ASSUMED_CELL)
            for old, value in zip(
                jax.tree.leaves(new), jax.tree.leaves(like_present(self.world, scenario)), strict=True
            ):
                old[i] = value
        return self.load(new, np.isin(np.arange(count), list(scenarios)))

    def _adopt(self, model: MjxModel) -> None:
        """Take another model, with which everything is compiled anew."""
        self._model, self._data = model, None
        # These depend on this simulator's model, so that no other process could use them.
        self._start = CachedJit(model.start, on_disk=False)
        self._place = CachedJit(placed, on_disk=False, donate_argnums=(1,))
        self._begin = CachedJit(self._begun, on_disk=False, donate_argnums=(0,))
        self._go_on = CachedJit(self._gone_on, on_disk=False, donate_argnums=(1,))
        self._prepared: frozenset[int] = frozenset()
        self._merge = CachedJit(tasks_merged, on_disk=False)
        self._settle = jax.jit(self._simulate, donate_argnums=1)
        self._rollout = jax.jit(self._follow, donate_argnums=1)

    def _use(self, world: World) -> None:
        """Have the model that worlds need: that of compounds once there are any, and then for all with this target."""
        room, now = room_for(world), self._model.room
        if room.get(TARGET) != now.get(TARGET) or (room and not now):
            self._adopt(MjxModel(self.shelf, self.camera, self.config, room))

    def set_cells(self, cells: Mapping[int, TrueCell]) -> None:
        if any(cell.physics != ASSUMED_CELL.physics for cell in cells.values()):
            raise InputError("MjxSimulator: all worlds have the usual physics; use the NativeSimulator")
        if any(cell.arm_stop for cell in cells.values()):
            raise InputError("MjxSimulator: the arm never stops (arm_stop); use the NativeSimulator")
        self._next_cells.update(cells)

    def load(self, world: World, only: Bool[np.ndarray, " worlds"] | None = None) -> World:
        count = len(world.kind)
        if only is not None:
            self._check_part(count, only)
        world = jax.tree.map(lambda a: a if isinstance(a, jax.Array) else jax.device_put(a), world)
        if only is None:
            self._use(world)
        world = fitting(world, self._model.room)
        if len(self._cells) != count:
            self._cells = [ASSUMED_CELL] * count
        fields, qpos, ctrl = self._start(world, cells_of(self._model.blank, self._cells))
        new = fields, world
        if only is None:
            if self._data is None or self._data.qpos.shape[0] != count:
                self._data = self._model.make_data(count)
            self._tasks, self._moving = None, np.zeros(count, bool)
        changed = jax.device_put(np.ones(count, bool) if only is None else np.array(only))
        data, self._data = self._data, None
        old = new if only is None else (self._fields, self.world)
        self._data, (self._fields, now) = self._place(changed, data, qpos, ctrl, new, old)
        self.world = now
        return now

    def execute(self, actions: Action, active: Bool[Array, " worlds"] | None = None) -> Outcome:
        self.begin(actions, active)
        outcome = self._advanced(self._count())[1]
        self._moving[:] = False
        return outcome

    def begin(self, actions: Action, active: Bool[Array, " worlds"] | None = None) -> None:
        count = self._count()
        check_actions(self.engine, actions, count)
        begins = np.ones(count, bool) if active is None else np.array(active)
        if np.any(begins & self._moving):
            raise InputError(f"MjxSimulator: world {np.argmax(begins & self._moving)} is moving; advance it to its end")
        data, self._data = self._data, None
        self._data, *new = self._begin(data, actions, jax.device_put(begins))
        if self._moving.any():
            new = self._merge(jax.device_put(self._moving), self._tasks, tuple(new))
        self._tasks, self._moving = tuple(new), self._moving | begins

    def advance(self, least: int) -> tuple[Bool[np.ndarray, " worlds"], Outcome]:
        self._count()
        done, outcome = jax.device_get(self._advanced(least))
        self._moving = self._moving & ~done
        return done, outcome

    def settle(self, active: Bool[Array, " worlds"] | None = None) -> Outcome:
        active = jnp.ones(self._count(), bool) if active is None else jnp.asarray(active)
        data, self._data = self._data, None
        self._data, self.world, outcome = self._settle(self._fields, data, self.world, None, active)
        return outcome

    def programs(self, world: World) -> list[Program]:
        """All programs that reset, and act in, worlds of these shapes."""
        self._use(world)
        count = len(world.kind)
        mask = jax.ShapeDtypeStruct((count,), bool)
        actions = jax.tree.map(lambda a: jax.ShapeDtypeStruct((count, *a.shape), a.dtype), no_action())
        usual = cells_of(self._model.blank, [ASSUMED_CELL] * count)

        # Traced only when the first program is lowered, since it takes long.
        @functools.cache
        def shapes() -> tuple[Any, Any, Any]:
            start = jax.eval_shape(self._model.start, world, usual)
            data, *tasks = jax.eval_shape(self._begun, self._model.data_shapes(count), actions, mask)
            return start, data, tuple(tasks)

        def going() -> Callable[[], None] | None:
            (fields, _, _), data, tasks = shapes()
            return self._go_on.begin(fields, data, world, tasks, np.int32(count))

        def placing() -> Callable[[], None] | None:
            (fields, qpos, ctrl), data, _ = shapes()
            return self._place.begin(mask, data, qpos, ctrl, (fields, world), (fields, world))

        begins = {
            "kernels": lambda: self._model.kernels(count),
            "simulate": going,
            "motions": lambda: self._begin.begin(shapes()[1], actions, mask),
            "reset": lambda: self._start.begin(world, usual),
            "next episodes": placing,
            "next motions": lambda: self._merge.begin(mask, shapes()[2], shapes()[2]),
        }
        prepared, self._prepared = self._prepared, self._prepared | {count}
        return [Program(name, lambda: count in prepared, begin) for name, begin in begins.items()]

    def simulate(self, world: World, actions: Action | None) -> tuple[World, Outcome]:
        """`load` and `execute` as a pure, traceable function.

        This simulator's state is unchanged, and the worlds are as the planner assumes. An action of an unknown kind
        changes nothing and fails as such.

        Args:
          world, actions: fields with a leading axis for the worlds; without actions the worlds settle.

        Returns:
          The worlds afterwards, and the outcomes.
        """
        count = len(world.kind)
        fields, qpos, ctrl = self._start(world, cells_of(self._model.blank, [ASSUMED_CELL] * count))
        data = self._model.make_data(count).replace(qpos=qpos, ctrl=ctrl)
        _, world, outcome = self._simulate(fields, data, world, actions, jnp.ones(count, bool))
        return world, outcome

    def follow(
        self, controls: Float[Array, "steps worlds 9"], start: Float[Array, "worlds 9"] | None = None
    ) -> Outcome:
        """Step all worlds with the given controls, without verdicts: for measurements and custom motions.

        Args:
          controls: commands of the position actuators: joint angles [rad], and distances of the two fingers from the
            middle [m].
          start: the robot's configuration at the start, at rest; by default the present one.
        """
        self._count()
        data, self._data = self._data, None
        if start is not None:
            data = data.replace(
                qpos=data.qpos.at[:, :ROBOT].set(start), qvel=data.qvel.at[:, :ROBOT].set(jnp.zeros_like(start))
            )
        self._data, self.world, outcome = self._rollout(self._fields, data, self.world, controls)
        return outcome

    def bytes_per_world(self) -> int:
        """An estimate of a world's device memory [bytes]; see `MjxModel.bytes_per_world`."""
        return self._model.bytes_per_world()

    def _advanced(self, least: int) -> tuple[Array, Outcome]:
        """Which worlds became done, and the outcomes."""
        data, self._data = self._data, None
        self._data, self.world, self._tasks, done, outcome = self._go_on(
            self._fields, data, self.world, self._tasks, np.int32(least)
        )
        return done, outcome

    def _begun(self, data: Any, actions: Action, active: Array) -> tuple[Any, Task, Progress, Array]:
        """`begin`, compiled, for worlds of which none is moving: the state, tasks, progress and reported worlds."""
        task, start = acting(data, actions, active, self._model.robot, self.config.simulator)
        data = data.replace(qpos=data.qpos.at[:, :ROBOT].set(where(task.moves, start, data.qpos[:, :ROBOT])))
        data = at_rest(data, task.moves)
        return data, task, begin(task, data), ~active

    def _gone_on(self, fields: BodyFields, data: Any, world: World, tasks: tuple[Task, Progress, Array], least: Array):
        """`advance`, compiled: the state, the worlds, the tasks, which became done, and the outcomes."""
        task, progress, reported = tasks
        chunk, step = self.config.chunk, self._time_step(fields, task)

        def steps(state):
            return jax.lax.scan(lambda state, _: (step(state), None), state, None, chunk)[0]

        def waits(state):
            done = state[1].done
            return (jnp.sum(done & ~reported) < least) & ~jnp.all(done)

        data, progress = jax.lax.while_loop(waits, steps, (data, progress))
        ended = progress.done & ~reported
        # Motion is stopped. A restored world gets back the commands of before the action.
        controls = where(progress.diverged, task.idle, task.controls[-1])
        resting = at_rest(data, ended & task.moves)
        touch = self._model.step(fields, resting)
        in_hand = self._model.holds_target(touch._impl)
        data = touch.replace(
            qpos=resting.qpos, qvel=resting.qvel, ctrl=where(ended, controls, data.ctrl), time=resting.time
        )
        warm = resting.qacc_warmstart
        data = data.replace(qacc_warmstart=where(ended, jnp.zeros_like(warm), warm))
        # Other worlds get no verdict, and their state is not taken over.
        ending = task.replace(moves=task.moves & ended, kind=jnp.where(ended, task.kind, ActionKind.NONE))
        simulator = self.config.simulator
        world, outcome = verdicts(self.shelf, simulator, ending, progress, world, data.qpos, in_hand)
        return data, world, (task, progress, reported | ended), ended, outcome

    def _simulate(self, fields: BodyFields, data: Any, world: World, actions: Action | None, active: Array):
        """`execute` or `settle` as a whole: the state, the world and the outcome."""
        if actions is None:
            task = waiting(data, active)
            data = at_rest(data, task.moves)
            tasks = task, begin(task, data), ~active
        else:
            data, task, progress, reported = self._begun(data, actions, active)
            tasks = task, progress, reported
        data, world, _, _, outcome = self._gone_on(fields, data, world, tasks, jnp.int32(len(active)))
        return data, world, outcome

    def _follow(self, fields: BodyFields, data: Any, world: World, controls: Array):
        """`follow`, compiled."""
        worlds, steps = len(world.kind), len(controls)
        everywhere = jnp.ones(worlds, bool)
        task = waiting(data, everywhere).replace(controls=controls, length=jnp.full(worlds, steps + 1, jnp.int32))
        step = self._time_step(fields, task)
        state = (data, begin(task, data))
        (data, progress), _ = jax.lax.scan(lambda state, _: (step(state), None), state, None, steps)
        world, fallen = taken_over(self.shelf, world, data.qpos, everywhere)
        failure = jnp.where(progress.diverged, int(Failure.UNSTABLE), int(Failure.NONE)).astype(jnp.int32)
        none, still = ~everywhere, jnp.zeros_like(fallen)
        rest = (progress.steps, none, still, fallen, none, none, none, progress.overflow, progress.error)
        return data, world, Outcome(failure, *rest)

    def _time_step(self, fields: BodyFields, task: Task):
        step = functools.partial(self._model.step, fields)
        return functools.partial(advance, self.config.simulator, step, self._model.robot, task)
