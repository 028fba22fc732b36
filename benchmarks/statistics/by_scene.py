"""How scenes fared: which are hard, and what became of each under each variant."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Mapping, Sequence

from mechsearch_jax.benchmarks.statistics.variants import label_variants, natural
from mechsearch_jax.benchmarks.store.rows import EpisodeRow

# How far an episode came, from the best end to the worst, in words.
ENDS: Mapping[str, str] = {
    "retrieved": "retrieved",
    "graspable": "graspable, but not retrieved",
    "found": "found, but no grasp of it was ever free",
    "hidden": "never found",
    "error": "an error of the program",
}


def end_of(row: EpisodeRow) -> str:
    """How far an episode came; one of `ENDS`."""
    if row.is_error:
        return "error"
    if row.retrieved:
        return "retrieved"
    if row.graspable_step is not None:
        return "graspable"
    return "hidden" if row.found_step is None else "found"


@dataclasses.dataclass(frozen=True)
class SceneResults:
    """The episodes of one scene.

    Attributes:
      scenario: its name.
      objects: number of surrounding objects.
      rows: its episodes by the label of their variant, at least one in all, those of a variant by their seeds.
    """

    scenario: str
    objects: int
    rows: Mapping[str, Sequence[EpisodeRow]]

    @property
    def every(self) -> list[EpisodeRow]:
        """All its episodes."""
        return [row for rows in self.rows.values() for row in rows]

    @property
    def retrieved(self) -> float:
        """The share that the target was retrieved in, the mean over variants, whose seeds are averaged first."""
        shares = [sum(row.retrieved for row in rows) / len(rows) for rows in self.rows.values()]
        return sum(shares) / len(shares)


def by_scene(rows: Sequence[EpisodeRow]) -> list[SceneResults]:
    """The scenes of rows, by their number of objects, and of each number the hardest first."""
    scenes: dict[tuple[int, str, str | None], dict[str, list[EpisodeRow]]] = {}
    for row, label in zip(rows, label_variants(rows), strict=True):
        scene = scenes.setdefault((row.objects, row.scenario, row.content_hash), {})
        scene.setdefault(label, []).append(row)
    seeds = operator.attrgetter("seed")
    results = [
        SceneResults(name, objects, {label: sorted(each, key=seeds) for label, each in of_variants.items()})
        for (objects, name, _), of_variants in scenes.items()
    ]
    return sorted(results, key=lambda scene: (scene.objects, scene.retrieved, natural(scene.scenario)))
