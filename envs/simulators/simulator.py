"""What all simulators offer and share: settings, and commands of actuators."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions import Action, kind_of
from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.mismatch import TrueCell
from mechsearch_jax.envs.world.outcome import Outcome
from mechsearch_jax.envs.world.world import World
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.robot.motion import MotionConfig, Reference
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.preparing import Program
from mechsearch_jax.workspace.scenario import Scenario

ARM = len(HOME)
ROBOT = ARM + 2
# A position actuator with a velocity gain lags behind its command by this many seconds of its motion; per joint.
LAG = (np.array(models.ARM_VELOCITY_GAIN) + models.ARM_DAMPING) / np.array(models.ARM_STIFFNESS)


@dataclasses.dataclass(frozen=True)
class SimulatorConfig:
    """Settings of the simulation.

    Attributes:
      motion: durations and lengths of the motion primitives.
      rest_speed: bodies slower than this are at rest [m/s, and rad/s times 0.1 m].
      settle_steps: largest number of time steps for the bodies to come to rest after an action.
      settle_block: time steps between checks whether they have.
      slip: an object that has moved farther than this in the closed hand counts as dropped [m].
      tracking_bound: an arm with a joint farther than this from its reference counts as held up, and its action fails
        [rad]. Ordinary actions stay below 0.01, a few reach 0.027; a hand that shoves a box against a wall reaches
        0.065 and more.
      trace_every: time steps between rows of a trace; only the native simulator has traces.
    """

    motion: MotionConfig = dataclasses.field(default_factory=MotionConfig)
    rest_speed: float = 2e-3
    settle_steps: int = 1500
    settle_block: int = 25
    slip: float = 0.03
    tracking_bound: float = 0.05
    trace_every: int = 25

    def __post_init__(self):
        for name in ("rest_speed", "settle_steps", "settle_block", "slip", "tracking_bound", "trace_every"):
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise InputError(f"SimulatorConfig: {name} {value} must be a positive number")


class Simulator(abc.ABC):
    """W simulated worlds: `NativeSimulator` on a CPU, `MjxSimulator` on a GPU.

    Attributes:
      engine: the simulator's name in records.
      world: the present state, its fields with a leading axis W; None before the first `reset` or `load`.
      takes_cells: whether its worlds may differ from what the planner assumes.
    """

    engine: str
    world: World | None = None
    takes_cells: bool = False

    @abc.abstractmethod
    def reset(self, scenarios: Sequence[Scenario]) -> World:
        """Start episodes: every body at rest at its pose in the scenario, and the robot at home.

        Args:
          scenarios: one for each world.

        Raises:
          InputError: there are no scenarios, or more objects in one than slots.
        """
        ...

    @abc.abstractmethod
    def replace(self, scenarios: Mapping[int, Scenario]) -> World:
        """Start episodes in the given worlds, as `reset` does; the others stay exactly as they are.

        Raises:
          InputError: it was not reset before, or there are more objects in a scenario than slots.
        """
        ...

    @abc.abstractmethod
    def load(self, world: World, only: Bool[np.ndarray, " worlds"] | None = None) -> World:
        """Set the state of all worlds, or of those in `only`, at rest and with the robot at home.

        Args:
          world: fields with a leading axis for the worlds.
          only: which worlds to change; the others keep their state. The number of worlds must be the present one.

        Raises:
          InputError: `only` is given, but the number of worlds differs from the present one.
        """
        ...

    @abc.abstractmethod
    def execute(self, actions: Action, active: Bool[Array, " worlds"] | None = None) -> Outcome:
        """Execute an action in every active world, let the bodies come to rest, and update `world`.

        Args:
          actions: of any registered kinds; fields with a leading axis for the worlds.
          active: which worlds; all by default. The others do not change and report no failure and 0 steps.

        Raises:
          InputError: it was not reset before, there are not as many actions as worlds, or a kind is unknown.
        """
        ...

    @abc.abstractmethod
    def settle(self, active: Bool[Array, " worlds"] | None = None) -> Outcome:
        """Step with the robot where it is until everything is at rest, for at most `settle_steps`.

        Args:
          active: which worlds; all by default.

        Raises:
          InputError: it was not reset before.
        """
        ...

    def set_cells(self, cells: Mapping[int, TrueCell]) -> None:
        """Set the cells of worlds, by their numbers, for the next episodes that begin in them.

        Raises:
          InputError: one of them has what this simulator cannot simulate.
        """
        raise InputError(f"{self.engine}: its worlds cannot differ from what the planner assumes")

    def programs(self, world: World) -> Sequence[Program]:
        """The programs that it will call for these worlds, so that they are compiled beforehand; longest first.

        Args:
          world: of all worlds, or its shapes.
        """
        return []

    def _count(self) -> int:
        """Number of worlds."""
        if self.world is None:
            raise InputError(f"{self.engine}: reset it before use")
        return len(self.world.kind)

    def _check_part(self, count: int, only: Bool[np.ndarray, " worlds"]) -> None:
        """Raise InputError unless so many worlds, of which some are to be set, are the present ones."""
        now = 0 if self.world is None else self._count()
        if not count == now == len(only):
            raise InputError(f"{self.engine}: {count} worlds cannot be set in part: there are {now} now")


class Flowing(Simulator):
    """A simulator whose worlds can begin actions while others are still moving."""

    @abc.abstractmethod
    def begin(self, actions: Action, active: Bool[Array, " worlds"] | None = None) -> None:
        """Begin actions; worlds that are not active continue.

        Args:
          actions: of any kinds; fields with a leading axis for the worlds.
          active: which worlds; all by default. None of them may be moving.

        Raises:
          InputError: as `execute`, or one of the worlds is moving.
        """
        ...

    @abc.abstractmethod
    def advance(self, least: int) -> tuple[Bool[np.ndarray, " worlds"], Outcome]:
        """Step the moving worlds until more of them are done, and update `world` for these.

        Args:
          least: least number of worlds that become done; all moving ones if there are fewer.

        Returns:
          Which worlds became done, and the outcomes of their actions; outcomes of other worlds mean nothing.

        Raises:
          InputError: the simulator was not reset.
        """
        ...


def check_actions(name: str, actions: Action, worlds: int) -> None:
    """Check that there is an action of a registered kind for each world.

    Args:
      name: of the simulator, for the message.
      actions: concrete.
      worlds: number of worlds.

    Raises:
      InputError: there are not as many actions as worlds, or a kind is unknown.
    """
    if actions.kind.shape != (worlds,):
        raise InputError(f"{name}: {actions.kind.shape} actions for {worlds} worlds; give one for each")
    for code in np.unique(jax.device_get(actions.kind)):
        kind_of(int(code))


def controls(reference: Reference) -> Float[np.ndarray, "steps 9"]:
    """Commands of the actuators so that the arm follows a reference without lag: ahead by `LAG`.

    One row for each step until the motion is over.
    """
    length = int(reference.length)
    # Cut on the host: on a device every length would be compiled.
    fields = (reference.q, reference.velocity, reference.fingers)
    q, velocity, fingers = (np.asarray(a, float)[:length] for a in jax.device_get(fields))
    arm, fingers = q + LAG * velocity, fingers[:, None]
    return np.concatenate([arm, fingers, fingers], axis=1)


def way_back(reference: Reference, steps: int) -> Float[np.ndarray, "steps 9"]:
    """Commands with which the arm goes back over the first steps of a reference, as `controls`; the fingers, too."""
    q, velocity, fingers = (
        np.asarray(a, float)[:steps][::-1] for a in (reference.q, reference.velocity, reference.fingers)
    )
    return np.concatenate([q - LAG * velocity, fingers[:, None], fingers[:, None]], axis=1)


def resampled(reference: Reference, timestep: float, other: float) -> Reference:
    """A reference for steps of another length, linear between the rows of the given one; the same for the same length.

    Args:
      reference: of a single motion, without leading axes.
      timestep: between its rows [s].
      other: between the rows of the result [s].
    """
    if timestep == other:
        return reference
    host: Any = jax.device_get(reference)
    length = int(host.length)
    rows = round(length * timestep / other)
    before, times = timestep * np.arange(length + 1), other * np.arange(1, rows + 1)

    def between(start: np.ndarray, values: np.ndarray) -> np.ndarray:
        columns = np.concatenate([start[None], values[:length]]).reshape(length + 1, -1)
        sampled = np.stack([np.interp(times, before, column) for column in columns.T], axis=1)
        return sampled.reshape(rows, *values.shape[1:])

    def steps(count: np.ndarray) -> np.signedinteger:
        return np.int32(np.round(count * timestep / other))

    return host.replace(
        q=between(host.start[:ARM], host.q),
        velocity=between(np.zeros(ARM), host.velocity),
        fingers=between(np.asarray(host.start[ARM]), host.fingers),
        length=np.int32(rows),
        closed=steps(host.closed),
        opens=steps(host.opens),
    )


def unhindered(
    q: Float[Array, "*batch 7"], command: Float[Array, "*batch 7"], timestep: float
) -> Float[Array, "*batch 7"]:
    """Joint angles a time step later if nothing holds the arm up: the inverse of `controls`.

    Args:
      q: joint angles [rad].
      command: of their actuators [rad].
      timestep: of the simulation [s].
    """
    gain = jnp.asarray(timestep / (timestep + LAG), q.dtype)
    return q + (command - q) * jnp.broadcast_to(gain, q.shape)
