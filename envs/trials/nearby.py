"""Scenes near a recognised one, in which a grasp of the target has to succeed, too, and nothing may do harm.

A grasp that brushes something may take the target out in one scene and be held up in another that is a third of a
millimetre off, less than recognition can know, or where things are rougher than assumed. One trial says
nothing of that.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from mechsearch_jax.planner.trials import TrialScenes
from mechsearch_jax.runtime.errors import InputError

# Of the drawn differences, which are the same for all scenes and decisions.
SEED = 7


@dataclasses.dataclass(frozen=True)
class Perturbations:
    """How many scenes near a recognised one, and how far off they are: about recognition's own error.

    Attributes:
      scenes: their number; 0 for none.
      place: standard deviation of the places of objects and target along x and y [m].
      size: standard deviation of the objects' sizes along their own x and y, as a share.
      friction: factor on all frictions: of the first scene, its inverse of the second, none of the third, and so on;
        about how far off an assumed friction is. Masses stay: an arm that is held up by heavier things hides what
        would fall.

    Raises:
      InputError: a number is negative or not finite, or the factor below 1.
    """

    scenes: int = 3
    place: float = 5e-4
    size: float = 5e-3
    friction: float = 2.0

    def __post_init__(self):
        if not 1 <= self.friction < math.inf:
            raise InputError(f"Perturbations: friction {self.friction} must be a finite factor of at least 1")
        for name in ("scenes", "place", "size"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"Perturbations: {name} {getattr(self, name)} must be finite and not negative")
        if self.scenes != int(self.scenes):
            raise InputError(f"Perturbations: scenes {self.scenes} must be a whole number")

    def drawn(self, scenes: TrialScenes, number: int) -> TrialScenes:
        """All scenes, each a little off; the same differences whenever the number is the same.

        An approximation: turns, heights and the parts of bodies of several parts stay.

        Args:
          scenes: as NumPy arrays.
          number: 1 or more; 0 changes nothing.
        """
        if number == 0:
            return scenes
        rng, level = np.random.default_rng([SEED, number]), np.array([1.0, 1.0, 0.0], np.float32)
        objects = scenes.objects
        slots = objects.position.shape[1:]
        position = objects.position + np.float32(rng.normal(0.0, self.place, slots)) * level
        size = objects.size * (1 + np.float32(rng.normal(0.0, self.size, slots)) * level)
        pose = scenes.pose + np.append(rng.normal(0.0, self.place, 2), 0.0).astype(np.float32)
        # More friction first: it is what holds the arm up.
        power = (0, 1, -1)[number % 3]
        return scenes.replace(
            objects=objects.replace(position=position, size=size),
            pose=pose,
            friction=scenes.friction * np.float32(self.friction**power),
        )
