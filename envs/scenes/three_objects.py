"""Scenes of the paper's 3-object toy experiment (appendix D.1): two large cylinders hide a target behind them.

Seen from above, the camera, the two cylinders and the target are in one line. Each cylinder alone hides the target, so
that both have to be moved before it is found.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from mechsearch_jax.envs.scenes.generator import GeneratorConfig, ScenarioGenerator
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class LineConfig:
    """Parameters of 3-object scenes that the paper leaves open.

    Attributes:
      target: x and y of the target in all scenes [m].
      radius: range of the large cylinders' radii [m]; up to what the hand can hold.
      height: range of their heights [m].
      gap: least distance between the three bodies, and between a cylinder and the board's front edge [m].
      attempts: number of draws of sizes and places for one seed.
    """

    target: tuple[float, float] = (0.70, 0.05)
    radius: tuple[float, float] = (0.026, 0.036)
    height: tuple[float, float] = (0.12, 0.21)
    gap: float = 0.005
    attempts: int = 1000


class LineGenerator:
    """Makes 3-object scenes; the same seed gives the same scene on the same machine."""

    def __init__(self, config: LineConfig | None = None, checks: GeneratorConfig | None = None):
        """Args:
        config: of the scenes.
        checks: when a target counts as hidden and at rest.
        """
        self.config = config or LineConfig()
        self._shelf, self._camera, self._target = Shelf(), Camera(), Target.cylinder()
        # It only checks scenes, so that graspability does not matter.
        self._checks = ScenarioGenerator(self._target, self._shelf, self._camera, checks, lambda pose: True)

    def generate(self, seed: int, name: str | None = None) -> Scenario:
        """A scene at rest with two cylinders, the nearer to the camera first.

        Args:
          seed: any whole number from 0.
          name: of the scenario; made from the seed by default.

        Raises:
          InputError: the seed is negative, or no scene fits the configuration.
        """
        if seed < 0:
            raise InputError(f"seed: {seed} is negative; use a whole number from 0")
        name = name or f"three-objects-{seed}"
        rng = np.random.default_rng(seed)
        for _ in range(self.config.attempts):
            scene = self._draw(rng, name)
            if scene and self._both_hide(scene) and self._checks.is_at_rest(scene):
                return scene
        raise InputError(f"{name}: no scene fits in {self.config.attempts} attempts; try another seed")

    def _draw(self, rng: np.random.Generator, name: str) -> Scenario | None:
        """Two cylinders in line with camera and target; None if they do not fit between it and the front edge."""
        radius = rng.uniform(*self.config.radius, 2)
        height = rng.uniform(*self.config.height, 2)
        share = np.sort(rng.uniform(0.0, 1.0, 2))
        eye, end = np.array(self._camera.position[:2]), np.array(self.config.target)
        length = float(np.linalg.norm(end - eye))
        along = (end - eye) / length
        # Range of a centre's distance from the camera without regard to the other cylinder.
        first = (self._shelf.front - eye[0]) / along[0]
        distance = first + share * (length - first)
        gaps = np.diff([*distance, length]) - radius - [radius[1], self._target.half_size[0]]
        places = eye + distance[:, None] * along
        before = places[:, 0] - radius - self._shelf.front
        if min(gaps.min(), before.min()) < self.config.gap:
            return None
        bodies = [self._cylinder(r, h / 2, place) for r, h, place in zip(radius, height, places, strict=True)]
        radius, _, half = self._target.half_size
        return Scenario(name, tuple(bodies), self._cylinder(radius, half, end))

    def _cylinder(self, radius: float, half_height: float, place: Float[np.ndarray, " 2"]) -> Body:
        radius, half_height = round(float(radius), 4), round(float(half_height), 4)
        x, y, z = (round(float(v), 6) for v in (*place, self._shelf.board + half_height))
        return Body("cylinder", (radius, radius, half_height), (x, y, z), UPRIGHT)

    def _both_hide(self, scene: Scenario) -> bool:
        """Whether each object alone hides the target."""
        return all(self._checks.is_hidden(dataclasses.replace(scene, objects=(body,))) for body in scene.objects)
