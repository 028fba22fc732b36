"""What simulators have in common: how they are used, how they are set, and what they tell the robot's motors."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions import Action, kind_of
from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.outcome import Outcome
from mechsearch_jax.envs.world.world import World
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.robot.motion import MotionConfig, Reference
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.preparing import Program
from mechsearch_jax.workspace.scenario import Scenario

ARM = len(HOME)
ROBOT = ARM + 2
# A position actuator with a velocity gain trails its command by this many seconds of its motion, for each joint.
LAG = (np.array(models.ARM_VELOCITY_GAIN) + models.ARM_DAMPING) / np.array(models.ARM_STIFFNESS)


@dataclasses.dataclass(frozen=True)
class SimulatorConfig:
    """How worlds are simulated.

    Attributes:
      motion: durations and lengths of the motion primitives.
      rest_speed: bodies slower than this are at rest [m/s, and rad/s times 0.1 m].
      settle_steps: after an action the bodies are given at most so many steps to come to rest.
      settle_block: how many steps pass between looks at whether they have.
      slip: an object that has moved farther than this in the closed hand was dropped [m].
      tracking_bound: an arm with a joint farther than this from its reference is held up, and its action fails [rad].
        Ordinary actions stay below 0.01, a few reach 0.027; a hand that shoves a box against a wall reaches 0.065 and
        more.
      trace_every: a trace keeps the state of every so many steps; only the native simulator has traces.
    """

    motion: MotionConfig = dataclasses.field(default_factory=MotionConfig)
    rest_speed: float = 2e-3
    settle_steps: int = 1500
    settle_block: int = 50
    slip: float = 0.03
    tracking_bound: float = 0.05
    trace_every: int = 25

    def __post_init__(self):
        for name in ("rest_speed", "settle_steps", "settle_block", "slip", "tracking_bound", "trace_every"):
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise InputError(f"SimulatorConfig: {name} {value} must be a positive number")


@runtime_checkable
class Simulator(Protocol):
    """Worlds that can be acted in, W at once: `NativeSimulator` on a CPU, `MjxSimulator` on a GPU.

    Attributes:
      engine: what records call it.
      world: the present state, its fields with a leading axis W; None before the first `reset` or `load`.
    """

    engine: str
    world: World | None

    def reset(self, scenarios: Sequence[Scenario]) -> World:
        """Start episodes: every body is exactly where its scenario has it, at rest, and the robot at home.

        Args:
          scenarios: one for each world.

        Raises:
          InputError: there are no scenarios, or more objects in one than slots.
        """
        ...

    def replace(self, scenarios: Mapping[int, Scenario]) -> World:
        """Start episodes in some of the worlds, as `reset` does; the others stay exactly as they are.

        Raises:
          InputError: it was not reset before, or there are more objects in a scenario than slots.
        """
        ...

    def load(self, world: World, only: Bool[np.ndarray, " worlds"] | None = None) -> World:
        """Take over the state of all worlds, or of some; the robot is at home there and everything at rest.

        Args:
          world: fields with a leading axis for the worlds.
          only: which worlds to change; the others keep their state. There must be as many worlds as now.

        Raises:
          InputError: some worlds are to be kept, but there are none, or not as many.
        """
        ...

    def execute(self, actions: Action, active: Bool[Array, " worlds"] | None = None) -> Outcome:
        """Execute an action in every world and let the bodies come to rest; `world` is then what became of them.

        Args:
          actions: of any kinds that are registered; fields with a leading axis for the worlds.
          active: in which worlds; all by default. The others do not change and report no failure and 0 steps.

        Raises:
          InputError: it was not reset before, there are not as many actions as worlds, or a kind is unknown.
        """
        ...

    def settle(self, active: Bool[Array, " worlds"] | None = None) -> Outcome:
        """Let time pass, with the robot where it is, until everything is at rest or the time for that is over.

        Args:
          active: in which worlds; all by default.

        Raises:
          InputError: it was not reset before.
        """
        ...


@runtime_checkable
class Flowing(Protocol):
    """A `Simulator` some of whose worlds begin with an action while others are still moving."""

    def begin(self, actions: Action, active: Bool[Array, " worlds"] | None = None) -> None:
        """Begin with actions in the worlds that are active, none of which may be moving; the others go on."""
        ...

    def advance(self, least: int) -> tuple[Bool[np.ndarray, " worlds"], Outcome]:
        """Step what moves until at least so many more worlds are done, or all that move.

        Returns:
          Which are done that were not before, and what came of their actions; of others the outcome says nothing.
        """
        ...


@runtime_checkable
class Prepares(Protocol):
    """What knows the programs that it will call."""

    def programs(self, world: World) -> Sequence[Program]:
        """Those for so many worlds, the longest first.

        Args:
          world: of all worlds, or its shapes.
        """
        ...


def check_actions(name: str, actions: Action, worlds: int) -> None:
    """Check that there is an action of a known kind for each world.

    Args:
      name: of the simulator, for the message.
      actions: concrete.
      worlds: how many there are.

    Raises:
      InputError: there are not as many actions as worlds, or a kind is unknown.
    """
    if actions.kind.shape != (worlds,):
        raise InputError(f"{name}: {actions.kind.shape} actions for {worlds} worlds; give one for each")
    for code in np.unique(jax.device_get(actions.kind)):
        kind_of(int(code))


def controls(reference: Reference) -> Float[np.ndarray, "steps 9"]:
    """What the actuators are told at each step so that the arm follows a reference without lag: ahead by `LAG`.

    One row for each step until the motion is over.
    """
    length = int(reference.length)
    # Cut on the host: on a device every length would be compiled.
    told = (reference.q, reference.velocity, reference.fingers)
    q, velocity, fingers = (np.asarray(a, float)[:length] for a in jax.device_get(told))
    arm, fingers = q + LAG * velocity, fingers[:, None]
    return np.concatenate([arm, fingers, fingers], axis=1)


def unhindered(
    q: Float[Array, "*batch 7"], told: Float[Array, "*batch 7"], timestep: float
) -> Float[Array, "*batch 7"]:
    """Where the joints are a time step later if nothing holds them up: what `controls` were made of.

    Args:
      q: where they were [rad].
      told: what their actuators are told [rad].
      timestep: of the simulation [s].
    """
    gain = jnp.asarray(timestep / (timestep + LAG), q.dtype)
    return q + (told - q) * jnp.broadcast_to(gain, q.shape)
