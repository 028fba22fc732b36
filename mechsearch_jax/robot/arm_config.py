"""How the arm is used: its home position and speed, and where it puts the target."""

from __future__ import annotations

import dataclasses

import numpy as np

from mechsearch_jax.robot.free_motion import check_joints
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.runtime.errors import InputError

# Largest coordinate of a place [m].
FARTHEST = 2.0


@dataclasses.dataclass(frozen=True)
class ArmConfig:
    """How the arm is used; hashable. Decisions do not depend on it.

    Attributes:
      home: joint angles where it waits between motions, out of the camera's sight [rad].
      speed: share of the joints' limits that velocities may reach, above 0 and at most 1; accelerations reach its
        square, and jerks its cube.
      place: where a target that was taken out is put down: x, y and z of where its foot is to stand, in the frame
        of the robot's base [m], or seven joint angles at which the hand opens [rad]; it stays in the hand if empty.
    """

    home: tuple[float, ...] = tuple(round(float(q), 4) for q in HOME)
    speed: float = 1.0
    # Searches are saved with a digest of this text, and may go on after the place has changed.
    place: tuple[float, ...] = dataclasses.field(default=(), repr=False)

    def __post_init__(self):
        check_joints("ArmConfig: home", np.array(self.home, float))
        if not 0.0 < self.speed <= 1.0:
            raise InputError(f"ArmConfig: speed {self.speed} must be above 0 and at most 1")
        check_place("ArmConfig: place", self.place)


def check_place(name: str, place: tuple[float, ...]) -> None:
    """Check that a place is nothing, a point in the robot's frame, or joint angles within the limits.

    Raises:
      InputError: it is not.
    """
    if len(place) == len(HOME):
        check_joints(name, np.array(place, float))
    elif len(place) not in (0, 3) or not all(abs(value) <= FARTHEST for value in place):
        raise InputError(
            f"{name} {list(place)} must be x, y and z in metres, each within {FARTHEST:g} of the robot's base, or "
            f"{len(HOME)} joint angles in radians"
        )
