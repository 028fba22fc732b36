"""How the arm is used: its home position and speed, and where it puts the target."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import numpy as np

from mechsearch_jax.robot.arm import ARMS, Arm
from mechsearch_jax.robot.free_motion import check_joints
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.runtime.errors import InputError, nearest

# Largest coordinate of a place [m].
FARTHEST = 2.0


@dataclasses.dataclass(frozen=True)
class ArmConfig:
    """Which arm it is and how it is used; hashable. Decisions depend on the model alone, by its joints' limits.

    Attributes:
      home: joint angles where it waits between motions, out of the camera's sight [rad].
      speed: share of the joints' limits that velocities may reach, above 0 and at most 1; accelerations reach its
        square, and jerks its cube.
      place: where a target that was taken out is put down: x, y and z of where its foot is to stand, in the frame
        of the robot's base [m], or seven joint angles at which the hand opens [rad]; it stays in the hand if empty.
      model: the arm whose limits hold and whose joints are named, one of `arm.ARMS`.
    """

    home: tuple[float, ...] = tuple(round(float(q), 4) for q in HOME)
    speed: float = 1.0
    # Searches are saved with a digest of this text, and may go on after the place has changed.
    place: tuple[float, ...] = dataclasses.field(default=(), repr=False)
    # The gripper's text has it, if it is not a Panda.
    model: Literal["panda", "fr3"] = dataclasses.field(default="panda", repr=False)

    def __post_init__(self):
        if self.model not in ARMS:
            raise InputError(f"ArmConfig: model {self.model!r} is unknown; {nearest(self.model, list(ARMS))}")
        check_joints("ArmConfig: home", np.array(self.home, float), self.arm)
        if not 0.0 < self.speed <= 1.0:
            raise InputError(f"ArmConfig: speed {self.speed} must be above 0 and at most 1")
        check_place("ArmConfig: place", self.place, self.arm)

    @property
    def arm(self) -> Arm:
        """The arm of this model."""
        return ARMS[self.model]


def check_place(name: str, place: tuple[float, ...], arm: Arm | None = None) -> None:
    """Check that a place is nothing, a point in the robot's frame, or joint angles, within an arm's limits if given.

    Raises:
      InputError: it is not.
    """
    farthest = {0: 0.0, 3: FARTHEST, len(HOME): 2 * math.pi}.get(len(place), -1.0)
    if arm is not None and len(place) == len(HOME):
        check_joints(name, np.array(place, float), arm)
    elif farthest < 0.0 or not all(abs(value) <= farthest for value in place):
        raise InputError(
            f"{name} {list(place)} must be x, y and z in metres, each within {FARTHEST:g} of the robot's base, or "
            f"{len(HOME)} joint angles in radians"
        )
