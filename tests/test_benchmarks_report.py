"""Reports: the numbers are those of the rows, in every file, by variant and by scene."""

import csv
import dataclasses
import io
import json
import re

import pytest
from matplotlib import image
from rich.console import Console
from stored_rows import USUAL, row_of

from mechsearch_jax.benchmarks.report import report, report_bench
from mechsearch_jax.benchmarks.report.episode_tables import events_summary_table, summary_table
from mechsearch_jax.benchmarks.report.films import FOLDER
from mechsearch_jax.benchmarks.report.report import Report
from mechsearch_jax.benchmarks.report.report_figures import success_figure
from mechsearch_jax.benchmarks.report.report_files import FILES, write_report
from mechsearch_jax.benchmarks.report.scene_map import COLOURS, SOMETIMES, WORDS, drawn_files
from mechsearch_jax.benchmarks.statistics.by_scene import ENDS, by_scene, end_of
from mechsearch_jax.benchmarks.statistics.intervals import wilson
from mechsearch_jax.benchmarks.statistics.preset_names import preset_name
from mechsearch_jax.benchmarks.statistics.rates import summarise, summarise_events
from mechsearch_jax.benchmarks.statistics.variants import Key
from mechsearch_jax.benchmarks.store.rows import EVENTS, EpisodeRow, episode_key, write_rows
from mechsearch_jax.envs.world.mismatch import Mismatch
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.runtime.errors import InputError

WON = EpisodeRow("a", 2, "cylinder", "search-for-grasp", "oracle", 0.9, 3, 30, "both", 0, 1, 2, True, 3, None, 1.5, 0.6)
LOST = dataclasses.replace(
    WON, scenario="b", graspable_step=None, retrieved=False, steps=10, failure="found, but not graspable"
)
BROKEN = LOST.__class__(
    "c", 8, "cylinder", "search-for-grasp", "oracle", 0.9, 3, 30, "both", 0,
    None, None, False, 0, "error: a | b\nc", 0.0, 0.0,
)  # fmt: skip
OTHER = dataclasses.replace(WON, policy="search-and-grasp")
ROWS = [WON, LOST, BROKEN, OTHER]


def page_of(folder):
    """The Markdown page of a report, in which one space is between cells."""
    return re.sub(" +", " ", (folder / "report.md").read_text())


def test_a_report_holds_what_the_rows_say(tmp_path):
    write_report(ROWS, tmp_path / "new")
    assert {path.name for path in (tmp_path / "new").iterdir()} == set(FILES)
    with open(tmp_path / "new" / "rates.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [(line["method"], line["objects"], line["episodes"], line["errors"]) for line in lines] == [
        ("search-and-grasp", "2", "1", "0"),
        ("search-and-grasp", "all", "1", "0"),
        ("search-for-grasp", "2", "2", "0"),
        ("search-for-grasp", "8", "1", "1"),
        ("search-for-grasp", "all", "3", "1"),
    ]
    low, high = wilson(1, 3)
    assert (float(lines[-1]["retrieved"]), float(lines[-1]["retrieved_low"])) == pytest.approx((1 / 3, low))
    value = json.loads((tmp_path / "new" / "rates.json").read_text())
    assert value["rates"][-1]["retrieved_high"] == pytest.approx(high)
    assert value["failures"][0]["reason"] == "found, but not graspable"
    text = page_of(tmp_path / "new")
    assert f"| search-for-grasp | all | 3 | 1 | 0.67 (0.21 to 0.94) | 0.33 ({low:.2f} to {high:.2f}) |" in text
    assert "| error: a \\| b c | 1 | 0.25 |" in text
    assert "| search-for-grasp | 0.67 |" in text
    assert "](success.png)" in text
    assert image.imread(tmp_path / "new" / "success.png").std() > 0.01


def test_the_actions_of_errors_do_not_count(tmp_path):
    """Of the two other episodes one took 3 actions, and the other 10."""
    summary = {(rates.method, rates.objects): rates for rates in summarise(ROWS)}
    assert summary["search-for-grasp", None].steps == 6.5
    assert summary["search-for-grasp", 8].steps is None
    write_report(ROWS, tmp_path)
    text = page_of(tmp_path)
    assert re.search(r"\| search-for-grasp \| all \| 3 \| 1 \|.*\| 6\.50 \|", text)
    assert re.search(r"\| search-for-grasp \| 8 \| 1 \| 1 \|.*\| - \| 0\.00 \|", text)
    assert json.loads((tmp_path / "rates.json").read_text())["rates"][3]["steps"] is None
    screen = Console(file=io.StringIO(), width=100)
    screen.print(summary_table(summarise(ROWS), Key.of(ROWS)))
    assert [line.split()[-3] for line in screen.file.getvalue().splitlines()[-2:]] == ["-", "6.5"]


KNOWN = {
    **dict.fromkeys(EVENTS, 0),
    **{"looks": 4, "truth_lost_step": None, "fallen_step": None, "truth_ruled_out_step": None},
}


@pytest.mark.parametrize("table", [summary_table, events_summary_table])
def test_a_narrow_screen_drops_no_column(table):
    rows = [dataclasses.replace(WON, **KNOWN), dataclasses.replace(LOST, objects=8, **KNOWN)]
    summary = summarise(rows) if table is summary_table else summarise_events(rows)
    screen = Console(file=io.StringIO(), width=80)
    screen.print(table(summary, Key({"search-for-grasp": "standard, full-parts, size spread 1.05"})))
    text = screen.file.getvalue()
    lines = [line.split()[1:3] for line in text.splitlines() if line.startswith("standard")]
    assert (lines, "…" in text) == ([["2", "1"], ["8", "1"], ["all", "2"]], False)


def test_configurations_do_not_mix():
    rows = [WON, dataclasses.replace(WON, gamma=0.5, retrieved=False, failure="not found")]
    assert [(r.method, r.retrieved) for r in summarise(rows) if r.objects is None] == [
        ("search-for-grasp, gamma 0.5", 0.0),
        ("search-for-grasp, gamma 0.9", 1.0),
    ]
    assert [line.get_text() for line in success_figure(rows).legends[0].get_texts()] == [
        "gamma 0.5", "gamma 0.9",
    ]  # fmt: skip


def test_an_episode_counts_once(tmp_path):
    for name in ("a", "b"):
        write_rows([WON], tmp_path / f"{name}.parquet")
    with pytest.raises(InputError, match=r"b\.parquet: holds scenario 'a', seed 0.*one by one"):
        report.read_tables([tmp_path / "a.parquet", tmp_path / "b.parquet"])
    write_rows([], tmp_path / "none.parquet")
    with pytest.raises(InputError, match="no episodes"):
        report.read_tables([tmp_path / "none.parquet"])


def test_scenarios_that_changed_between_rows_are_named(tmp_path):
    same, other, unknown = (dataclasses.replace(WON, seed=i, content_hash=h) for i, h in enumerate(("1", "2", None)))
    assert report.changed_scenarios([same, dataclasses.replace(same, seed=5), LOST]) == []
    for rows in ([same, other, LOST], [same, unknown, LOST]):
        assert report.changed_scenarios(rows) == ["a"]
        write_report(rows, tmp_path)
        assert "not the same in all rows count as several: a." in page_of(tmp_path)
    many = [dataclasses.replace(row, scenario=f"s{i}") for i in range(7) for row in (same, other)]
    assert report.changed_scenarios_remark(many).endswith("s0, s1, s2, s3, s4 and 2 more.")
    assert report.changed_scenarios_remark([same]) == ""


@pytest.mark.slow
def test_the_command_reports_all_rows():
    begun = []
    value = json.loads(json.dumps(report_bench.bench_report(800, begun.append)))
    assert (value["rows"], value["variants"]) == (800, 96)
    assert [run["what"] for run in value["runs"]] == list(report_bench.REPORTS) == begun[1:]
    assert all(run["seconds"] > 0.5 and run["memory"] > 50 and run["bytes"] > 10_000 for run in value["runs"])
    assert report_bench.timings_table(value).row_count == 2


QUIET = {"truth_lost": 0, "restarts": 0, "held_up": 0, "unsettled": 0}
NEVER = {"found_step": None, "graspable_step": None, "retrieved": False, "steps": 10, "failure": "not found"}
BLOCKED = {**NEVER, "found_step": 3, "failure": "found, but not graspable"}
MASKS = dataclasses.replace(USUAL, recognition="masks")
PAPER = dataclasses.replace(USUAL, config=PRESETS["paper"]())
METHODS = (USUAL, MASKS, PAPER)


def rows_of():
    """Three variants: the first scene is hard for two of them, the second easy, the third hard for all."""
    rows = []
    for method in METHODS:
        rows.append(row_of("set-4-000", method, **QUIET, **({} if method is USUAL else NEVER)))
        rows.append(row_of("set-4-001", method, **QUIET))
        rows.append(row_of("set-8-000", method, **QUIET, **(BLOCKED if method is PAPER else NEVER)))
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
