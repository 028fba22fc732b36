"""A scene at rest in which actions are tried, each from the same state.

Bodies at rest are asleep: MuJoCo skips them until something touches them, so that a trial costs only the arm and what
it moves.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from mechsearch_jax.actions import Kind
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.simulators.simulator import ARM, ROBOT, SimulatorConfig, controls
from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.mismatch import TrueCell
from mechsearch_jax.envs.world.outcome import Failure
from mechsearch_jax.envs.world.world import BODIES, TARGET
from mechsearch_jax.planner.trials import TrialResult
from mechsearch_jax.robot.motion import Reference
from mechsearch_jax.shapes import in_order
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, rotation_matrix
from mechsearch_jax.workspace.shelf import Shelf

# Time steps between checks whether the result of an action is certain.
BLOCK = 100
# Time steps between checks whether all is at rest after an action.
REST_BLOCK = 25
# A body so far below the board has fallen [m].
BELOW = 0.05
# A target that leans further than this falls over [rad].
TIPPED = math.radians(45)
# Fingers closer to the middle than this hold nothing [m].
EMPTY = 1e-3


@functools.cache
def blank_model(shelf: Shelf, timestep: float) -> mujoco.MjModel:
    """The model with empty slots, in which bodies at rest sleep; not to be changed."""
    return _sleepy(models.compile_model(shelf, Camera(), timestep))


def _sleepy(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model, changed so that bodies at rest sleep."""
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    # Few bodies are awake at a time.
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return model


class TrialScene(NativeWorld):
    """Bodies at rest. Trials do not change the scene and may run in several threads at once.

    Attributes:
      diverged: whether the simulation diverged before everything was at rest; all trials are UNKNOWN then.
    """

    def __init__(
        self,
        shelf: Shelf,
        config: SimulatorConfig,
        bodies: list[Body | None],
        friction: float = 1.0,
    ):
        """Let bodies come to rest.

        Args:
          shelf: of the scene.
          config: of the simulation.
          bodies: in their slots.
          friction: factor on all sliding frictions.

        Raises:
          ValueError, mujoco.FatalError: MuJoCo cannot build the scene.
        """
        super().__init__(shelf, config=config, blank=blank_model(shelf, config.motion.timestep))
        self.place(bodies, TrueCell(friction))
        self._model.opt.sleep_tolerance = config.rest_speed
        self._hide_what_is_no_body()
        self._rest_again(np.empty((0, 0)))
        self.diverged = self._recorder.diverged
        self._gone, self._lay = self._fallen(), self._target_lies()
        if not self.diverged:
            self._fall_asleep()

    def attempt(
        self, kind: Kind, reference: Reference, index: int, needed: Callable[[], bool] = lambda: True
    ) -> TrialResult | None:
        """The result of an action; None if it is not needed any more. Uses no JAX.

        Args:
          kind: of the action.
          reference: of the arm, as NumPy arrays.
          index: slot of the object that the action moves.
          needed: called repeatedly; whether the result is still wanted.
        """
        if self.diverged:
            return TrialResult.UNKNOWN
        scene = copy.copy(self)
        scene._data = copy.copy(self._data)
        scene._record()
        return scene._attempted(kind, reference, index, needed)

    def _attempted(
        self, kind: Kind, reference: Reference, index: int, needed: Callable[[], bool]
    ) -> TrialResult | None:
        start = np.asarray(reference.start, float)
        self._set_robot(start[:ARM], float(start[ARM]))
        commands = controls(reference)
        states = np.empty((0, 0))
        for first in range(0, len(commands), BLOCK):
            block = self._run(np.ascontiguousarray(commands[first : first + BLOCK]))
            states = np.concatenate([states, block]) if first else block
            if not needed():
                return None
            if self._recorder.diverged:
                return TrialResult.UNKNOWN
            if self._harm_is_certain(kind):
                return TrialResult.HARMFUL
            if kind.takes_target and self._fails_for_certain(states, reference):
                return TrialResult.FAILED
        failed = self._tracking_error(states, reference) > self.config.tracking_bound
        if kind.holds_object:
            failed |= not self._slip(states, reference, index) < self.config.slip
        if kind.returns_home:
            self._go_home()
        self._rest_again(states)
        if self._recorder.diverged:
            return TrialResult.UNKNOWN
        held, fallen = False, self._fallen()
        if kind.takes_target:
            taken = self._retrieval(self._gone)
            failed, held, fallen = failed or taken.failure is not Failure.NONE, taken.held, taken.fallen
        toppled = self._target_lies() and not (self._lay or held)
        if toppled or (fallen & ~self._gone).any():
            return TrialResult.HARMFUL
        return TrialResult.FAILED if failed else TrialResult.SUCCEEDED

    def _model_for(self, bodies: list[Body | None]) -> mujoco.MjModel:
        model = super()._model_for(bodies)
        return model if model is self._blank else _sleepy(model)

    def _hide_what_is_no_body(self) -> None:
        """Disable contacts of geometry in empty slots or hidden inside of a body."""
        for i, body in enumerate(self._bodies):
            for shape in () if body is not None and body.compound else in_order():
                if body is None or body.shape != shape.name:
                    geom = self._model.geom(models.geometry_name(shape, i)).id
                    self._model.geom_contype[geom] = self._model.geom_conaffinity[geom] = 0

    def _fall_asleep(self) -> None:
        """Put all bodies to sleep where they are, until they are touched."""
        positions = self._data.qpos.copy()
        self._go_home()
        # They sleep after one more step without motion.
        self._data.tree_asleep[1:] = np.maximum(self._data.tree_asleep[1:], -1)
        mujoco.mj_step(self._model, self._data)
        self._data.qpos[:] = positions
        self._data.qvel[:] = 0.0

    def _rest_again(self, states: Float[np.ndarray, "steps size"]) -> None:
        """Hold the robot still until no body has moved for `settle_block` steps, for at most `settle_steps`.

        Args:
          states: the preceding states, whose last ones count, too.
        """
        hold = np.tile(self._data.ctrl, (REST_BLOCK, 1))
        quiet = self._quiet(states)
        for _ in range(self.config.settle_steps // REST_BLOCK):
            now = self._quiet(self._run(hold))
            quiet = now + (quiet if now == REST_BLOCK else 0)
            if quiet >= self.config.settle_block or self._recorder.diverged:
                break
        self._data.qvel[:] = 0.0

    def _quiet(self, states: Float[np.ndarray, "steps size"]) -> int:
        """For how many states up to the last all bodies have been at rest."""
        limit = self.config.rest_speed * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
        if not len(states):
            return 0
        first = 1 + self._model.nq + ROBOT
        speed = np.abs(states[:, first : first + 6 * BODIES]).reshape(-1, BODIES, 6)
        moves = np.flatnonzero(~(speed < limit).all(axis=(1, 2)))
        return len(states) - 1 - int(moves[-1]) if len(moves) else len(states)

    def _harm_is_certain(self, kind: Kind) -> bool:
        """Whether a body has left the board, or a target that stood, and is not being retrieved, is bound to fall."""
        deep = self._data.qpos[ROBOT:].reshape(BODIES, 7)[:, 2] < self.shelf.board - BELOW
        if (deep & self._there & ~self._gone).any():
            return True
        if kind.takes_target or self._lay or self._bodies[TARGET] is None:
            return False
        up = rotation_matrix(self._data.joint(f"body{TARGET}").qpos[3:])[2, 2]
        return bool(abs(up) < math.cos(TIPPED))

    def _fails_for_certain(self, states: Float[np.ndarray, "steps size"], reference: Reference) -> bool:
        """Whether a retrieval cannot succeed any more."""
        if self._tracking_error(states, reference) > self.config.tracking_bound:
            return True
        return len(states) > int(reference.closed) and bool((self._data.qpos[ARM:ROBOT] < EMPTY).all())

    @property
    def _there(self) -> Bool[np.ndarray, " 9"]:
        return np.array([body is not None for body in self._bodies])
