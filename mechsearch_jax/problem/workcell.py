"""The workcell: everything of a problem but its configuration."""

from __future__ import annotations

import dataclasses
from typing import Any

from mechsearch_jax.calibration.limits import CalibrationLimits
from mechsearch_jax.config.config import ProblemConfig
from mechsearch_jax.images.colour import HUE, RED, TargetColour
from mechsearch_jax.images.labels import CAPACITY, check_capacity
from mechsearch_jax.problem.cache import cached_problem, is_cached
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.robot.arm_config import PANDA, ArmConfig, ArmModel
from mechsearch_jax.robot.entry import check_outside
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.hand import HandConfig
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.obstacle import CAMERA, CAMERA_BODY, Obstacle, camera_body
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target


@dataclasses.dataclass(frozen=True)
class Workcell:
    """Camera, shelf, gripper, target, arm and hand; hashable. Frame: the robot's base.

    Attributes:
      target: what is searched; for a scenario, which has its own target, how finely it is searched.
      arm: which it is, home and speed, and where it puts the target.
      calibration: how far the shelf in an image may be from its place; decisions do not depend on it.
      colour: of the target in colour images: red, green and blue in 0 to 1. The planner's programs do not depend on it.
      hand: how the real hand is used.
      hue_tolerance: by how much hues may differ from the target's and count as equal [degrees].
      camera_body: size of the camera's body along its x, y and z, around its pose [m]; zeros for none. Outside the
        shelf it is an obstacle, but not at the default pose, where the camera is simulated.
      obstacles: what else the arm keeps clear of. Decisions depend on it, and on the camera's body, only where the arm
        cannot execute one.
      capacity: number of objects that recognition and planner can hold, 1 to 16.
    """

    camera: Camera = dataclasses.field(default_factory=Camera)
    shelf: Shelf = dataclasses.field(default_factory=Shelf)
    gripper: Gripper = dataclasses.field(default_factory=Gripper)
    target: Target = dataclasses.field(default_factory=Target)
    arm: ArmConfig = dataclasses.field(default_factory=ArmConfig)
    # Not in the representation, which identifies saved searches: they go on with other limits.
    calibration: CalibrationLimits = dataclasses.field(default_factory=CalibrationLimits, repr=False)
    colour: tuple[float, float, float] = RED
    # Searches are saved with a digest of this text, and may go on with another hand.
    hand: HandConfig = dataclasses.field(default_factory=HandConfig, repr=False)
    # Not in the representation, so that searches that were saved before it existed go on.
    hue_tolerance: float = dataclasses.field(default=HUE, repr=False)
    camera_body: tuple[float, float, float] = dataclasses.field(default=CAMERA_BODY, repr=False)
    obstacles: tuple[Obstacle, ...] = dataclasses.field(default=(), repr=False)
    capacity: int = dataclasses.field(default=CAPACITY, repr=False)

    def __post_init__(self):
        TargetColour.lit(self.colour, self.hue_tolerance)
        check_capacity(self.capacity, "Workcell: capacity")
        # What plans is given the gripper, and with it the arm.
        if self.gripper.arm not in (PANDA, self.arm.arm):
            raise InputError(
                f"Workcell: the gripper is on the {self.gripper.arm.name}, but arm.model says {self.arm.model}"
            )
        object.__setattr__(self, "gripper", dataclasses.replace(self.gripper, arm=self.arm.arm))
        check_outside(self.gripper, self.shelf)
        room = min(self.shelf.back - self.shelf.front, self.shelf.left - self.shelf.right)
        if not 2 * self.target.inset < room:
            raise InputError(
                f"Target: inset ({self.target.inset}) leaves no place on a board of {room:g} m; it must be below half"
            )
        if any(self.camera_body):
            # Its size has to be one wherever the camera is.
            Obstacle(CAMERA, self.camera_body, (0.0, 0.0, 0.0))
        names = [CAMERA, *(obstacle.name for obstacle in self.obstacles)]
        for name in names:
            if names.count(name) > 1:
                why = "the camera's body is called so" if name == CAMERA else "there are several"
                raise InputError(f"Obstacle: name {name!r} is taken ({why}); give each another one")

    def problem(self, target: Target | None = None, config: ProblemConfig | None = None) -> Problem:
        """The problem of a target, by default this workcell's; read from disk if it was built before.

        Raises:
          InputError: the target cannot be grasped by the gripper.
        """
        return cached_problem(target or self.target, config, **self._around)

    def with_arm(self, model: ArmModel) -> Workcell:
        """The workcell with another model of the arm.

        Raises:
          InputError: it is unknown, or cannot have the arm's home or place.
        """
        gripper = dataclasses.replace(self.gripper, arm=PANDA)
        return dataclasses.replace(self, arm=dataclasses.replace(self.arm, model=model), gripper=gripper)

    @property
    def bodies(self) -> tuple[Obstacle, ...]:
        """All obstacles, the camera's body first if it is outside the shelf."""
        return (*camera_body(self.camera, self.shelf, self.camera_body), *self.obstacles)

    @property
    def detector(self) -> TargetColour:
        """A `detector` of a `Recogniser`, which finds the target's pixels by their colour."""
        return TargetColour.lit(self.colour, self.hue_tolerance)

    @property
    def told_by(self) -> str:
        """What tells the target from other things, in words."""
        usual = " (the default; [target] colour sets it)" if self.colour == RED else ""
        red, green, blue = self.colour
        return (
            f"without target_id it is told by its colour, red {red:g}, green {green:g} and blue {blue:g}{usual}, "
            "also where a mask is given"
        )

    def is_cached(self, target: Target, config: ProblemConfig) -> bool:
        """Whether the problem of a target was built before and is on disk."""
        return is_cached(target, config, **self._around)

    @property
    def _around(self) -> dict[str, Any]:
        return {"camera": self.camera, "shelf": self.shelf, "gripper": self.gripper}
