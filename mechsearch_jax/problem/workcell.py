"""What stands around the objects, and what is searched among them: everything of a problem but how it is decided."""

from __future__ import annotations

import dataclasses
from typing import Any

from mechsearch_jax.config.config import ProblemConfig
from mechsearch_jax.images.colour import RED, TargetColour
from mechsearch_jax.problem.cache import cached_problem, is_cached
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.robot.arm_config import ArmConfig
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target


@dataclasses.dataclass(frozen=True)
class Workcell:
    """Camera, shelf, gripper, target and arm; hashable. Frame: the robot's base.

    Attributes:
      camera: what looks into the shelf.
      shelf: where the objects stand.
      gripper: what grasps them.
      target: what is searched; of a scenario, which has its own, how finely it is searched.
      arm: how the arm is used.
      colour: of the target, by which it is seen in colour images: red, green and blue in 0 to 1. What is compiled for a
        problem does not depend on it.
    """

    camera: Camera = dataclasses.field(default_factory=Camera)
    shelf: Shelf = dataclasses.field(default_factory=Shelf)
    gripper: Gripper = dataclasses.field(default_factory=Gripper)
    target: Target = dataclasses.field(default_factory=Target)
    arm: ArmConfig = dataclasses.field(default_factory=ArmConfig)
    colour: tuple[float, float, float] = RED

    def __post_init__(self):
        TargetColour.lit(self.colour)
        room = min(self.shelf.back - self.shelf.front, self.shelf.left - self.shelf.right)
        if not 2 * self.target.inset < room:
            raise InputError(
                f"Target: inset ({self.target.inset}) leaves no place on a board of {room:g} m; it must be below half"
            )

    def problem(self, target: Target | None = None, config: ProblemConfig | None = None) -> Problem:
        """The problem of a target, this workcell's if None; read from disk if it was built before.

        Raises:
          InputError: the target cannot be grasped by the gripper.
        """
        return cached_problem(target or self.target, config, **self._around)

    @property
    def detector(self) -> TargetColour:
        """What tells the target's pixels from others in a colour image: a `detector` of a `Recogniser`."""
        return TargetColour.lit(self.colour)

    def is_cached(self, target: Target, config: ProblemConfig) -> bool:
        """Whether the problem of a target was built before, and need only be read."""
        return is_cached(target, config, **self._around)

    @property
    def _around(self) -> dict[str, Any]:
        return {"camera": self.camera, "shelf": self.shelf, "gripper": self.gripper}
