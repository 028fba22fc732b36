"""Reports by scene and variant: names by preset, which scenes are hard, what a map of both shows, and failures."""

import csv
import dataclasses
import re

from stored_rows import USUAL, row_of

from mechsearch_jax.benchmarks.report.films import FOLDER
from mechsearch_jax.benchmarks.report.report import Report
from mechsearch_jax.benchmarks.report.report_files import write_report
from mechsearch_jax.benchmarks.report.scene_map import COLOURS, SOMETIMES, WORDS, drawn_files
from mechsearch_jax.benchmarks.statistics.by_scene import ENDS, by_scene, end_of
from mechsearch_jax.benchmarks.statistics.preset_names import preset_name
from mechsearch_jax.benchmarks.statistics.variants import Key
from mechsearch_jax.benchmarks.store.rows import episode_key
from mechsearch_jax.envs.world.mismatch import Mismatch
from mechsearch_jax.planner import PRESETS

EVENTS = {"truth_lost": 0, "restarts": 0, "held_up": 0, "unsettled": 0}
NEVER = {"found_step": None, "graspable_step": None, "retrieved": False, "steps": 10, "failure": "not found"}
BLOCKED = {**NEVER, "found_step": 3, "failure": "found, but not graspable"}
MASKS = dataclasses.replace(USUAL, recognition="masks")
PAPER = dataclasses.replace(USUAL, config=PRESETS["paper"]())
METHODS = (USUAL, MASKS, PAPER)


def rows_of():
    """Three variants: the first scene is hard for two of them, the second easy, the third hard for all."""
    rows = []
    for method in METHODS:
        rows.append(row_of("set-4-000", method, **EVENTS, **({} if method is USUAL else NEVER)))
        rows.append(row_of("set-4-001", method, **EVENTS))
        rows.append(row_of("set-8-000", method, **EVENTS, **(BLOCKED if method is PAPER else NEVER)))
    return rows


def test_variants_are_called_by_their_presets_and_what_deviates():
    key = Key.of(rows_of())
    assert sorted(key.short.values()) == ["paper", "standard", "standard, masks"]
    assert key.numbered
    assert [key.short[key.named(text)] for text in ("paper", "standard", "standard, masks", "masks")] == [
        *("paper", "standard"), *["standard, masks"] * 2,
    ]  # fmt: skip
    changed = dataclasses.replace(
        USUAL,
        name="random",
        config=PRESETS["paper"](gamma=0.5),
        mismatch=Mismatch(friction=0.5),
    )
    name = preset_name(changed.options(), str)
    assert name.preset == "paper"
    assert set(name.deviations.split(", ")) == {"gamma 0.5", "random", "friction 0.5"}


def test_scenes_are_ranked_by_how_hard_they_are_and_seeds_are_averaged_first():
    again = row_of("set-4-000", MASKS, seed=1)
    scenes = by_scene([*rows_of(), again])
    assert [(scene.scenario, round(scene.retrieved, 3)) for scene in scenes] == [
        *(("set-4-000", 0.5), ("set-4-001", 1.0), ("set-8-000", 0.0)),
    ]  # fmt: skip
    assert len(scenes[0].every) == 4
    assert {end_of(row) for row in rows_of()} == {"retrieved", "found", "hidden"}
    assert end_of(row_of("set-4-000", **{**NEVER, "failure": "error: out of memory"})) == "error"
    assert end_of(row_of("set-4-000", retrieved=False, failure="retrieval: missed")) == "graspable"
    assert set(ENDS) | {SOMETIMES} == set(COLOURS) == set(WORDS)


def test_a_report_holds_the_map_and_failures_by_variant(tmp_path):
    rows = rows_of()
    (tmp_path / FOLDER).mkdir()
    drawn = f"{episode_key(rows[0])}.html"
    (tmp_path / FOLDER / drawn).write_text("a page")
    report = dataclasses.replace(Report.of(rows), drawn=drawn_files(tmp_path))
    write_report(report, tmp_path)
    text, page = ((tmp_path / name).read_text(encoding="utf-8") for name in ("report.md", "report.html"))
    assert f'<td class=retrieved><a href="{FOLDER}/{drawn}">3</a></td>' in page
    assert "Scenes by difficulty: see scenes.csv." in text
    assert re.search(r"\| variant +\| +lost \| +not found \| +found, but not graspable \|", text)
    assert re.search(r"\| paper +\| +0\.67 \| +0\.33 \| +0\.33 \|", text)
    assert re.search(r"\| standard, masks +\| standard +\| masks +\|", text)
    with open(tmp_path / "scenes.csv", newline="") as file:
        first, *_, last = csv.DictReader(file)
    assert (first["scenario"], first["standard"], first["paper"]) == ("set-4-000", "1", "0")
    assert (last["scenario"], float(last["retrieved"])) == ("set-8-000", 0.0)
    assert "see scenes.csv" in (tmp_path / "report.tex").read_text()
