"""The map of a report's scenes and variants: what became of each, which are hard, and a link to what is drawn of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mechsearch_jax.benchmarks.pages.pages import Block, Heading, Mark, Matrix, Paragraph
from mechsearch_jax.benchmarks.report.films import FOLDER
from mechsearch_jax.benchmarks.statistics.by_scene import ENDS, SceneResults, by_scene, end_of
from mechsearch_jax.benchmarks.statistics.variants import Key
from mechsearch_jax.benchmarks.store.rows import EpisodeRow, episode_key
from mechsearch_jax.runtime.files import PathLike

# Of several seeds, where some retrieved the target and others did not.
SOMETIMES = "sometimes"
COLOURS = {
    "retrieved": "#2a9d78",
    SOMETIMES: "#9fd3bf",
    "graspable": "#f2c14e",
    "found": "#ee9b3a",
    "hidden": "#b8434e",
    "error": "#75828e",
}
WORDS = {**ENDS, SOMETIMES: "retrieved with some seeds"}


def drawn_files(out: PathLike) -> frozenset[str]:
    """What is drawn of single episodes in the folder of a report: pages and pictures, by their names."""
    return frozenset(file.name for file in (Path(out) / FOLDER).glob("*.*"))


def scene_map(rows: Sequence[EpisodeRow], key: Key, drawn: frozenset[str] = frozenset()) -> list[Block]:
    """The map of scenes and variants.

    Args:
      rows: of the report.
      key: of their variants.
      drawn: the files of single episodes; see `drawn_files`.
    """
    scenes = by_scene(rows)
    labels = list(key.short)
    lines = [(_of_scene(scene), [_mark(scene, label, drawn) for label in labels]) for scene in scenes]
    marks = [mark for _, cells in lines for mark in cells if mark is not None]
    used = {mark.kind for mark in marks}
    legend = [(COLOURS[kind], WORDS[kind]) for kind in COLOURS if kind in used]
    several = any(len(each) > 1 for scene in scenes for each in scene.rows.values())
    seeds = "with how many of its seeds it was retrieved, or, of one seed, " if several else ""
    counted = f"{seeds}the number of actions where it was retrieved"
    links = " A cell with a frame opens the page of that episode." if any(mark.file for mark in marks) else ""
    return [
        Heading("Scenes and variants"),
        Paragraph(
            f"{len(scenes)} scenes, by their number of objects (in brackets), the hardest first: behind it the share "
            f"of episodes in which the target was retrieved, the mean over the variants. A cell says {counted}.{links}"
        ),
        Matrix(
            tuple(key.short[label] for label in labels),
            tuple((name, tuple(cells)) for name, cells in lines),
            tuple(legend),
            instead="Scenes by difficulty: see scenes.csv.",
        ),
    ]


def _of_scene(scene: SceneResults) -> str:
    return f"{scene.scenario} ({scene.objects}): {scene.retrieved:.2f}"


def _mark(scene: SceneResults, label: str, drawn: frozenset[str]) -> Mark | None:
    """The cell of a scene and a variant; None if there is no episode."""
    rows = scene.rows.get(label, ())
    if not rows:
        return None
    won = sum(row.retrieved for row in rows)
    kind = SOMETIMES if 0 < won < len(rows) else min((end_of(row) for row in rows), key=list(ENDS).index)
    text = f"{won}/{len(rows)}" if len(rows) > 1 else str(rows[0].steps) if won else ""
    # Of several seeds that is opened which was lost.
    files = [_drawn(row, drawn) for row in sorted(rows, key=lambda row: row.retrieved)]
    return Mark(kind, text, COLOURS[kind], next((file for file in files if file), ""))


def _drawn(row: EpisodeRow, drawn: frozenset[str]) -> str:
    """The page of an episode, or else its filmstrip; empty if neither is there."""
    names = (f"{episode_key(row)}.{ending}" for ending in ("html", "png"))
    return next((f"{FOLDER}/{name}" for name in names if name in drawn), "")


def scene_records(rows: Sequence[EpisodeRow], key: Key) -> list[dict[str, object]]:
    """A line for each scene: its difficulty, and of each variant how many episodes retrieved the target."""
    return [
        {
            "scenario": scene.scenario,
            "objects": scene.objects,
            "episodes": len(scene.every),
            "found": sum(row.found_step is not None for row in scene.every) / len(scene.every),
            "retrieved": scene.retrieved,
            **{
                short: None if label not in scene.rows else sum(row.retrieved for row in scene.rows[label])
                for label, short in key.short.items()
            },
        }
        for scene in by_scene(rows)
    ]
