"""The batch simulator: MuJoCo's Warp implementation in MJX steps thousands of worlds in one compiled function.

It has the scene, the motion primitives and the verdicts of the native simulator, for W worlds at once:

    simulator = MjxSimulator()
    world = simulator.reset(scenarios)            # W scenarios; a `World` whose fields have a leading axis W
    outcome = simulator.execute(actions)          # an `Action` whose fields have a leading axis W
    outcome = simulator.execute(actions, active)  # worlds whose `active` (W,) is False stay exactly as they are
    simulator.world                               # where everything is now
    outcome.failure                               # (W,) codes of `Failure`; `outcome.reason(i)` is the text
    outcome.overflow                              # (W,) flags of `Overflow`; not 0: do not trust this world

In one call some worlds may push, others pick and place, others take the target out and others do nothing. All step
together until the last of them is at rest; a world that is done before that is frozen. A world whose state is no longer
finite is put back to where it was and frozen at once, so that it touches no other. The first call for a number of
worlds compiles; later ones do not, whatever the actions are.

Everything stays on the device: the host waits for the kinds of the actions, and where a field of an outcome or of
`world` is read.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions import Action
from mechsearch_jax.envs.batch_model import BodyFields
from mechsearch_jax.envs.mjx_model import MjxConfig, MjxModel, where
from mechsearch_jax.envs.mjx_step import Task, acting, advance, begin, taken_over, verdicts, waiting
from mechsearch_jax.envs.outcome import Failure, Outcome
from mechsearch_jax.envs.simulator import ROBOT, check_actions
from mechsearch_jax.envs.world import World, from_scenario
from mechsearch_jax.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf


class MjxSimulator:
    """Many worlds in MuJoCo's Warp implementation, a `Simulator`; see the module's description.

    On a CPU the same scenarios and actions always give the same results, on a GPU they do not.

    Attributes:
      engine: what records call it.
      shelf, camera, config: as given.
      world: the present state of all worlds; None before the first `reset`.
    """

    engine = "MjxSimulator"

    def __init__(self, shelf: Shelf | None = None, camera: Camera | None = None, config: MjxConfig | None = None):
        """Raises:
        InputError: Warp cannot be imported.
        """
        self.shelf = shelf or Shelf()
        self.camera = camera or Camera()
        self.config = config or MjxConfig()
        self.world: World | None = None
        self._model = MjxModel(self.shelf, self.camera, self.config)
        self._fields: BodyFields | None = None
        self._data: Any = None
        self._start = jax.jit(self._model.start)
        self._execute = jax.jit(self._simulate, donate_argnums=1)
        self._rollout = jax.jit(self._follow, donate_argnums=1)

    def reset(self, scenarios: Sequence[Scenario]) -> World:
        """Start episodes, one world for each scenario; see `Simulator.reset`.

        Raises:
          InputError: there are no scenarios, or more objects in one than slots.
        """
        if not scenarios:
            raise InputError("MjxSimulator: no scenarios are given; reset it with one for each world")
        worlds = [from_scenario(scenario) for scenario in scenarios]
        return self.load(jax.tree.map(lambda *leaves: np.stack(leaves), *worlds))

    def replace(self, scenarios: Mapping[int, Scenario]) -> World:
        """Start episodes in some of the worlds; see `Simulator.replace`.

        Raises:
          InputError: the simulator was not reset, or there are more objects in a scenario than slots.
        """
        count = self._count()
        new = jax.tree.map(np.array, self.world)
        for i, scenario in scenarios.items():
            for old, value in zip(jax.tree.leaves(new), jax.tree.leaves(from_scenario(scenario)), strict=True):
                old[i] = value
        return self.load(new, np.isin(np.arange(count), list(scenarios)))

    def load(self, world: World, only: Bool[np.ndarray, " worlds"] | None = None) -> World:
        """Take over the state of all worlds, or of some; see `Simulator.load`.

        Raises:
          InputError: some worlds are to be kept, but there are none, or not as many.
        """
        count = len(world.kind)
        if only is not None and (self.world is None or len(self.world.kind) != count or len(only) != count):
            raise InputError(f"MjxSimulator: some of {count} worlds can be replaced only where there are as many")
        world = jax.tree.map(jnp.asarray, world)
        fields, qpos, ctrl = self._start(world)
        if only is None:
            if self._data is None or self._data.qpos.shape[0] != count:
                self._data = self._model.make_data(count)
            changed = jnp.ones(count, bool)
        else:
            changed = jnp.asarray(only)
            fields, world = jax.tree.map(functools.partial(where, changed), (fields, world), (self._fields, self.world))
        data = self._data
        self._data = data.replace(
            qpos=where(changed, qpos, data.qpos),
            ctrl=where(changed, ctrl, data.ctrl),
            qvel=where(changed, jnp.zeros_like(data.qvel), data.qvel),
            qacc_warmstart=where(changed, jnp.zeros_like(data.qvel), data.qacc_warmstart),
        )
        self._fields, self.world = fields, world
        return world

    def execute(self, actions: Action, active: Bool[Array, " worlds"] | None = None) -> Outcome:
        """Execute an action in every world and let the bodies come to rest; see `Simulator.execute`.

        Raises:
          InputError: the simulator was not reset, there are not as many actions as worlds, or a kind is unknown.
        """
        check_actions(self.engine, actions, self._count())
        return self._act(actions, active)

    def settle(self, active: Bool[Array, " worlds"] | None = None) -> Outcome:
        """Let time pass, with the robot where it is, until everything is at rest; see `Simulator.settle`.

        Raises:
          InputError: the simulator was not reset.
        """
        return self._act(None, active)

    def simulate(self, world: World, actions: Action | None) -> tuple[World, Outcome]:
        """What actions would make of worlds: `load` and `execute` without memory, to be traced.

        This simulator's own worlds stay as they are. An action of an unknown kind changes nothing and fails as such.

        Args:
          world, actions: fields with a leading axis for the worlds; without actions the worlds settle.

        Returns:
          The worlds afterwards, and what came of the actions.
        """
        count = len(world.kind)
        fields, qpos, ctrl = self._start(world)
        data = self._model.make_data(count).replace(qpos=qpos, ctrl=ctrl)
        _, world, outcome = self._simulate(fields, data, world, actions, jnp.ones(count, bool))
        return world, outcome

    def follow(
        self, controls: Float[Array, "steps worlds 9"], start: Float[Array, "worlds 9"] | None = None
    ) -> Outcome:
        """Step all worlds with these controls, without any verdict: for measurements, and for motions of one's own.

        Args:
          controls: joint angles [rad] and distances of the two fingers from the middle [m] that the position actuators
            are told.
          start: where the robot is put first, at rest; by default it begins where it is.
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
        """About how much of the device's memory a world takes [bytes]; see `MjxModel.bytes_per_world`."""
        return self._model.bytes_per_world()

    def _count(self) -> int:
        """Number of worlds."""
        if self.world is None:
            raise InputError("MjxSimulator: reset it before use")
        return len(self.world.kind)

    def _act(self, actions: Action | None, active: Bool[Array, " worlds"] | None) -> Outcome:
        active = jnp.ones(self._count(), bool) if active is None else jnp.asarray(active)
        data, self._data = self._data, None
        self._data, self.world, outcome = self._execute(self._fields, data, self.world, actions, active)
        return outcome

    def _simulate(self, fields: BodyFields, data: Any, world: World, actions: Action | None, active: Array):
        """`execute` or `settle`, compiled: the state, the world and what came of it."""
        idle = data.ctrl
        if actions is None:
            task = waiting(data, active)
        else:
            task, start = acting(data, actions, active, self._model.robot, self.config.simulator)
            data = data.replace(qpos=data.qpos.at[:, :ROBOT].set(where(task.moves, start, data.qpos[:, :ROBOT])))
        data = data.replace(
            qvel=where(task.moves, jnp.zeros_like(data.qvel), data.qvel),
            qacc_warmstart=where(task.moves, jnp.zeros_like(data.qvel), data.qacc_warmstart),
        )
        last = len(task.controls) - 1
        chunk = self.config.chunk
        one_step = self._one_step(fields, task)

        def one(state, i):
            row = jax.lax.dynamic_index_in_dim(task.controls, jnp.minimum(i, last), keepdims=False)
            return one_step(state, i, row), None

        def some(carry):
            i, state = carry
            return i + chunk, jax.lax.scan(one, state, i + jnp.arange(chunk))[0]

        begun = (jnp.int32(0), (data, begin(task, data)))
        _, (data, progress) = jax.lax.while_loop(lambda carry: ~jnp.all(carry[1][1].done), some, begun)

        # What moved is stopped. Where all was undone, the robot is again told what it was told before.
        controlled = where(progress.diverged, idle, task.controls[last])
        resting = data.replace(qvel=where(task.moves, jnp.zeros_like(data.qvel), data.qvel))
        touch = self._model.step(fields, resting)
        in_hand = self._model.holds_target(touch._impl)
        data = touch.replace(qpos=resting.qpos, qvel=resting.qvel, ctrl=controlled, time=resting.time)
        data = data.replace(qacc_warmstart=jnp.zeros_like(data.qvel))
        return data, *verdicts(self.shelf, self.config.simulator, task, progress, world, data.qpos, in_hand)

    def _follow(self, fields: BodyFields, data: Any, world: World, controls: Array):
        """`follow`, compiled."""
        worlds, steps = len(world.kind), len(controls)
        everywhere = jnp.ones(worlds, bool)
        task = waiting(data, everywhere).replace(length=jnp.full(worlds, steps + 1, jnp.int32))
        one_step = self._one_step(fields, task)
        state = (data, begin(task, data))
        (data, progress), _ = jax.lax.scan(
            lambda state, step: (one_step(state, *step), None), state, (jnp.arange(steps), controls)
        )
        world, fallen = taken_over(self.shelf, world, data.qpos, everywhere)
        failure = jnp.where(progress.diverged, int(Failure.UNSTABLE), int(Failure.NONE)).astype(jnp.int32)
        none = ~everywhere
        told = (progress.steps, none, fallen, none, none, none, progress.overflow, progress.error)
        return data, world, Outcome(failure, *told)

    def _one_step(self, fields: BodyFields, task: Task):
        step = functools.partial(self._model.step, fields)
        return functools.partial(advance, self.config.simulator, step, self._model.robot, task)
