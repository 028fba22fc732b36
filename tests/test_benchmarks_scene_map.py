"""Reports by scene and variant: names by preset, which scenes are hard, what a map of both shows, and failures."""

import csv
import dataclasses
import re

import pytest
from stored_rows import USUAL, row_of

from mechsearch_jax.benchmarks.report.films import FOLDER
from mechsearch_jax.benchmarks.report.report import Report
from mechsearch_jax.benchmarks.report.report_files import write_report
from mechsearch_jax.benchmarks.report.scene_map import COLOURS, SOMETIMES, WORDS, drawn_files, scene_map
from mechsearch_jax.benchmarks.statistics.by_scene import ENDS, by_scene, end_of
from mechsearch_jax.benchmarks.statistics.preset_names import LONGEST_NAME, named_once, preset_name
from mechsearch_jax.benchmarks.statistics.variants import Key
from mechsearch_jax.benchmarks.store.rows import episode_key
from mechsearch_jax.commands import main as cli
from mechsearch_jax.envs.world.mismatch import Mismatch
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.runtime.errors import InputError

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


def test_what_is_no_preset_long_or_not_unique_is_numbered():
    options = USUAL.options()
    assert preset_name({"gamma": 0.5}, str) is None
    long = preset_name({**options, "mismatch.unusual": "x" * LONGEST_NAME}, str)
    once = preset_name(options, str)
    assert named_once({"a": long, "b": once, "c": None}) == {"b": once}
    assert named_once({"a": once, "b": once}) == {}
    with pytest.raises(InputError, match='variant "gamma 3" is unknown: '):
        Key.of(rows_of()).named("gamma 3")


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


def test_the_map_links_what_is_drawn():
    rows = [*rows_of(), row_of("set-4-000", MASKS, seed=1)]
    key = Key.of(rows)
    lost = next(row for row in rows if row.recognition == "masks" and row.scenario == "set-4-000" and not row.retrieved)
    files = frozenset({f"{episode_key(lost)}.png", f"{episode_key(rows[1])}.html", f"{episode_key(rows[1])}.png"})
    *_, matrix = scene_map(rows, key, files)
    cells = {
        (name.split()[0], column): mark
        for name, marks in matrix.lines
        for column, mark in zip(matrix.columns, marks, strict=True)
    }
    assert matrix.lines[0][0] == "set-4-000 (4): 0.50"
    assert cells["set-4-000", "standard, masks"] == (
        SOMETIMES,
        "1/2",
        COLOURS[SOMETIMES],
        f"{FOLDER}/{episode_key(lost)}.png",
    )
    assert cells["set-4-001", "standard"].file == f"{FOLDER}/{episode_key(rows[1])}.html"
    assert (cells["set-4-001", "standard"].text, cells["set-8-000", "paper"].kind) == ("3", "found")
    assert cells["set-8-000", "standard"].file == ""
    *_, partly = scene_map(rows[1:], key)
    assert [mark for name, marks in partly.lines for mark in marks].count(None) == 1


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


def test_the_command_compares_with_a_variant_by_its_name(tmp_path, capsys, monkeypatch):
    from mechsearch_jax.benchmarks.store.rows import write_rows

    write_rows(rows_of(), tmp_path / "rows.parquet")
    cli.parse(["report", str(tmp_path / "rows.parquet"), "--baseline", "paper", "--out", str(tmp_path / "out")])()
    assert "points more than paper" in capsys.readouterr().out
    assert (tmp_path / "out" / "scenes.csv").is_file()
