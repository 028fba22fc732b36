"""How the arm is used: its home position and speed."""

from __future__ import annotations

import dataclasses

import numpy as np

from mechsearch_jax.robot.free_motion import check_joints
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.runtime.errors import InputError


@dataclasses.dataclass(frozen=True)
class ArmConfig:
    """How the arm is used; hashable. Decisions do not depend on it.

    Attributes:
      home: joint angles where it waits between motions, out of the camera's sight [rad].
      speed: share of the joints' limits that velocities may reach, above 0 and at most 1; accelerations reach its
        square, and jerks its cube.
    """

    home: tuple[float, ...] = tuple(round(float(q), 4) for q in HOME)
    speed: float = 1.0

    def __post_init__(self):
        check_joints("ArmConfig: home", np.array(self.home, float))
        if not 0.0 < self.speed <= 1.0:
            raise InputError(f"ArmConfig: speed {self.speed} must be above 0 and at most 1")
