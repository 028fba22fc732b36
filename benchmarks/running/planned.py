"""Episodes of a run that is only planned: of scenes of sets that were not made, as far as their record tells."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterable, Mapping, Sequence, Sized
from typing import Any

from mechsearch_jax.benchmarks.store.rows import EpisodeRow, episode_key
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.scenes.scene_sets import Block, recorded
from mechsearch_jax.runtime.errors import check_once
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.target import Target


@dataclasses.dataclass(frozen=True)
class SceneOutline:
    """What is known of a scene without making it.

    Attributes:
      name: of the scene.
      content_hash: of what it holds; see `Scenario.content_hash`.
      objects: as many as there are.
      target: shape and size of its target.
    """

    name: str
    content_hash: str
    objects: Sized
    target: Target

    @classmethod
    def of_block(cls, block: Block, index: int) -> SceneOutline:
        """The outline of a scene of a set, from the record of scene sets."""
        return cls(
            block.scene_name(index), recorded()[block.name][index], range(block.objects), Target.of(block.target)
        )

    @classmethod
    def of_scenario(cls, scenario: Scenario) -> SceneOutline:
        """The outline of a scenario."""
        return cls(scenario.name, scenario.content_hash, scenario.objects, Target.of_body(scenario.target))


@dataclasses.dataclass(frozen=True)
class PlannedJob:
    """An episode that is to be run; see `evaluate.Job`.

    Attributes:
      scene: that it is run on.
      method: everything else that decides about it, but for the seed.
      seed: of the episode.
    """

    scene: SceneOutline
    method: Method
    seed: int

    @functools.cached_property
    def key(self) -> str:
        """The `episode_key` of its row."""
        options = {"target": self.scene.target.shape, "simulator": self.method.engine, "seed": self.seed}
        return episode_key(EpisodeRow.failed(self.scene, {**_options(self.method), **options}, ""))

    @property
    def target(self) -> Target:
        """The planner's description of its target."""
        return self.method.workcell.target.like(self.scene.target)


@functools.lru_cache(maxsize=4096)
def _options(method: Method) -> Mapping[str, Any]:
    """The same for thousands of jobs."""
    return method.options()


def planned_jobs(scenes: Iterable[SceneOutline], methods: Sequence[Method], seeds: Sequence[int]) -> list[PlannedJob]:
    """All combinations of scenes, methods and seeds.

    Raises:
      InputError: two scenes have the same name.
    """
    scenes = list(scenes)
    check_once("two scenes", (scene.name for scene in scenes))
    return [PlannedJob(scene, method, seed) for scene, method, seed in itertools.product(scenes, methods, seeds)]
