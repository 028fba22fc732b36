"""What happens during an action, step by step, for pictures."""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
from jaxtyping import Float

from mechsearch_jax.envs.simulators.simulator import ARM, ROBOT
from mechsearch_jax.envs.world.world import BODIES


@dataclasses.dataclass(frozen=True)
class Trace:
    """What happened during an action, for pictures: one row for each kept step.

    Attributes:
      time: since the action began [s].
      q: joint angles [rad], shape (frames, 7).
      fingers: distance of each finger from the middle [m], shape (frames, 2): left, right.
      position: of the nine bodies [m], shape (frames, 9, 3).
      quaternion: (w, x, y, z) of the nine bodies, shape (frames, 9, 4).
    """

    time: Float[np.ndarray, " frames"]
    q: Float[np.ndarray, "frames 7"]
    fingers: Float[np.ndarray, "frames 2"]
    position: Float[np.ndarray, "frames 9 3"]
    quaternion: Float[np.ndarray, "frames 9 4"]


class Recorder:
    """Collects the states that make a trace.

    Attributes:
      steps: how many were taken.
      diverged: whether the simulation did in any of them.
    """

    def __init__(self, data: mujoco.MjData, every: int):
        self.steps = 0
        self.diverged = False
        self._begin = data.time
        self._every = every
        self._kept: list[np.ndarray] = []

    def add(self, states: np.ndarray, diverged: bool) -> None:
        self.diverged |= diverged
        self._kept.extend(states[(-self.steps) % self._every :: self._every])
        self.steps += len(states)

    def trace(self, model: mujoco.MjModel) -> Trace:
        states = np.array(self._kept) if self._kept else np.empty((0, 1 + model.nq))
        qpos = states[:, 1 : 1 + model.nq]
        bodies = qpos[:, ROBOT:].reshape(-1, BODIES, 7)
        time = states[:, 0] - self._begin
        return Trace(time, qpos[:, :ARM], qpos[:, ARM:ROBOT], bodies[..., :3], bodies[..., 3:])
