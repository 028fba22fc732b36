"""Arms as values: the names of the joints and what the maker's controller lets them do, and how the arm is used.

Sources: for a Panda the maker's interface specification; for an FR3 the positions of `franka_description`
(robots/fr3/joint_limits.yaml) and the rates of `libfranka` (rate_limiting.h), without its tolerance of 0.001. A newer
firmware may allow other figures.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mechsearch_jax.runtime.errors import InputError, nearest

# Largest coordinate of a place [m].
FARTHEST = 2.0
# Where the arm waits if nothing else is said [rad].
HOME = np.array([0.0301, -1.4702, 0.0279, -2.4376, 0.1466, 2.3087, 0.7012], np.float32)
# Share of the joints' limits that velocities reach on a robot if nothing else is said.
SPEED = 0.3
ArmModel = Literal["panda", "fr3"]
Seven = tuple[float, float, float, float, float, float, float]
# At its very end a joint may not move outwards at all; this is libfranka's tolerance, and keeps shares finite [rad/s].
SLOWEST = 1e-3


@dataclasses.dataclass(frozen=True)
class Arm:
    """An arm with the Panda's geometry and its own limits, one figure for each joint from the base on; hashable.

    Attributes:
      name: of the model, and what the names of its joints begin with.
      least, most: joint angles between which it may be [rad].
      velocity: largest speeds [rad/s].
      acceleration: largest accelerations [rad/s2].
      jerk: largest jerks [rad/s3].
      slowing: what its speed is limited by near the ends of a joint, as offset [rad/s], rate [rad/s2] and the angles of
        both ends [rad]: at a distance d [rad] from the end that it moves to, sqrt(rate d) - offset. Nothing if empty.
    """

    name: str
    least: Seven
    most: Seven
    velocity: Seven
    acceleration: Seven
    jerk: Seven
    slowing: tuple[tuple[float, float, float, float], ...] = ()

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the seven joints in ROS."""
        return tuple(f"{self.name}_joint{i}" for i in range(1, 8))

    @property
    def lower(self) -> Float[np.ndarray, " 7"]:
        """`least` in single precision."""
        return np.array(self.least, np.float32)

    @property
    def upper(self) -> Float[np.ndarray, " 7"]:
        """`most` in single precision."""
        return np.array(self.most, np.float32)

    def speeds(self, q: Any, way: Any) -> Any:
        """Largest speeds at joint angles, at least `SLOWEST` [rad/s].

        Args:
          q: joint angles, shape (..., 7), of NumPy or JAX [rad].
          way: of the same shape; its signs are the directions in which the joints move.

        Returns:
          Shape (..., 7), or (1, ..., 7) where they do not depend on the angles.
        """
        row = (*[1] * (q.ndim - 1), 7)
        fastest = np.array(self.velocity, np.float32).reshape(row)
        if not self.slowing:
            return fastest
        xp: Any = np if isinstance(q, np.ndarray) else jnp
        offset, rate, low, high = (np.reshape(each, row) for each in np.array(self.slowing, np.float32).T)
        room = xp.maximum(xp.where(way > 0, high - q, q - low), 1e-9)
        return xp.clip(xp.sqrt(rate * room) - offset, SLOWEST, fastest)


PANDA = Arm(
    name="panda",
    least=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    most=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
    velocity=(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
    acceleration=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
    jerk=(7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0),
)
FR3 = Arm(
    name="fr3",
    least=(-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159),
    most=(2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159),
    velocity=(2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26),
    acceleration=(10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0),
    jerk=(5000.0, 5000.0, 5000.0, 5000.0, 5000.0, 5000.0, 5000.0),
    slowing=(
        (0.30, 12.0, -2.7501, 2.7501),
        (0.20, 5.17, -1.7918, 1.7918),
        (0.20, 7.0, -2.9065, 2.9065),
        (0.30, 8.0, -3.0481, -0.1458),
        (0.35, 34.0, -2.8101, 2.8101),
        (0.35, 11.0, 0.54092, 4.5205),
        (0.35, 34.0, -3.0196, 3.0196),
    ),
)
ARMS = {arm.name: arm for arm in (PANDA, FR3)}


@dataclasses.dataclass(frozen=True)
class ArmConfig:
    """Which arm it is and how it is used; hashable. Decisions depend on the model alone, by its joints' limits.

    Attributes:
      model: the arm whose limits hold and whose joints are named, one of `ARMS`.
      home: joint angles where it waits between motions, out of the camera's sight [rad].
      speed: share of the joints' limits that velocities may reach, above 0 and at most 1; accelerations reach its
        square, and jerks its cube.
      place: where a target that was taken out is put down: x, y and z of where its foot is to stand, in the frame
        of the robot's base [m], or seven joint angles at which the hand opens [rad]; it stays in the hand if empty.
    """

    # First, since the others are checked by it where settings are restored one by one; the gripper's text has it.
    model: ArmModel = dataclasses.field(default="panda", repr=False)
    home: tuple[float, ...] = tuple(round(float(q), 4) for q in HOME)
    speed: float = SPEED
    # Searches are saved with a digest of this text, and may go on after the place has changed.
    place: tuple[float, ...] = dataclasses.field(default=(), repr=False)

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


def check_joints(name: str, q: Float[np.ndarray, "..."], arm: Arm = PANDA) -> None:
    """Check that joint angles are seven numbers within the limits of an arm.

    Raises:
      InputError: they are not.
    """
    if np.shape(q) != (7,) or not np.isfinite(q).all():
        raise InputError(f"{name}: {np.asarray(q).tolist()} must be seven joint angles in radians")
    outside = _outside(q, arm)
    if len(outside):
        i = int(outside[0])
        others = [other.name for other in ARMS.values() if not len(_outside(q, other))]
        mend = f"if this is the {others[0]}, say so by model in [arm]" if others else "give radians"
        raise InputError(
            f"{name}: joint {i + 1} at {q[i]:.4f} rad is beyond its limits on the {arm.name}, "
            f"{arm.least[i]:.4f} to {arm.most[i]:.4f}; {mend}"
        )


def _outside(q: np.ndarray, arm: Arm) -> np.ndarray:
    """Indices of the joints that are beyond the limits of an arm."""
    return np.flatnonzero((q < arm.lower - 1e-4) | (q > arm.upper + 1e-4))
