"""What an episode comes to, by its row."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from mechsearch_jax.benchmarks.store.rows import EpisodeRow


def _drop_free(row: EpisodeRow) -> bool | None:
    return None if row.objects_fallen is None and not row.is_error else row.objects_fallen == 0


# What an episode reaches, by what stored runs call it; None where a row does not say. An error reaches nothing.
OUTCOMES: Mapping[str, Callable[[EpisodeRow], bool | None]] = {
    "found": lambda row: row.found_step is not None,
    "graspable": lambda row: row.graspable_step is not None,
    "paper_graspable": lambda row: row.paper_graspable,
    "retrieved": lambda row: row.retrieved,
    "drop_free": _drop_free,
}
# The same in the words of pages.
WORDS: Mapping[str, str] = {
    "found": "found",
    "graspable": "graspable",
    "paper_graspable": "with the paper's grasps",
    "retrieved": "retrieved",
    "drop_free": "drop-free",
}
# The shares that variants are compared by.
COMPARED = ("found", "graspable", "retrieved", "drop_free")
