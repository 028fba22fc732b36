"""The yardstick for search: its figures are those of the rows, whatever is stored, and its curves can be read."""

import dataclasses
import re
import sys

import numpy as np
import pytest
from matplotlib.text import Text
from stored_rows import row_of

from mechsearch_jax.benchmarks.report.store_run import run_of
from mechsearch_jax.benchmarks.statistics.intervals import mean_interval
from mechsearch_jax.benchmarks.store.runs import write_run
from mechsearch_jax.benchmarks.studies import page as studies_page
from mechsearch_jax.benchmarks.studies import yardstick_page
from mechsearch_jax.benchmarks.studies.curves import HIGHEST, LINE_HEIGHT, STYLES, curves_figure, spread
from mechsearch_jax.benchmarks.studies.declared import STUDIES
from mechsearch_jax.benchmarks.studies.shown import shown_study
from mechsearch_jax.benchmarks.studies.yardstick import YARDSTICK, measure

STUDY = STUDIES[YARDSTICK.study]
VARIANTS = {variant.label: variant for variant in STUDY.variants}
NEVER = {"found_step": None, "graspable_step": None, "retrieved": False, "steps": 10, "failure": "not found"}
# Actions until found on the scenes report-a-2-000, -8-000, -2-001, ...; it takes two more until retrieved.
FOUND = {
    "search-for-grasp": [1, 3, 2, 6],
    "greedy": [1, 2, 4, None],
    "random": [4, 8, 6, None],
    "informed": [0, 0, 0, 0],
}


def rows_of(label, steps):
    method = VARIANTS[label].method()
    scenes = [f"report-a-{2 if i % 2 == 0 else 8}-{i // 2:03d}" for i in range(len(steps))]
    reached = [{"found_step": step, "graspable_step": step, "steps": 0 if step is None else step + 2} for step in steps]
    fields = [NEVER if step is None else each for step, each in zip(steps, reached, strict=True)]
    return [row_of(scene, method, looks=None, **each) for scene, each in zip(scenes, fields, strict=True)]


def shown_of(actions):
    rows = [row for label, steps in actions.items() for row in rows_of(label, steps)]
    return shown_study(STUDY, [run_of("user-run", rows, command="x")])


def text_of(measured):
    return re.sub(" +", " ", yardstick_page.page(measured))


def test_what_is_measured_against_is_declared():
    labels = [variant.label for variant in STUDY.variants]
    assert {YARDSTICK.worse, YARDSTICK.better} <= set(YARDSTICK.drawn) <= set(labels)
    assert STUDY.baseline.label == YARDSTICK.drawn[0]
    assert len(YARDSTICK.drawn) <= len(STYLES)


def test_the_figures_are_those_of_the_rows():
    measured = measure(shown_of(FOUND))
    assert (measured.budget, list(measured.objects)) == (10, [2, 8])
    greedy = measured.actions["found", "greedy", None]
    assert (greedy.episodes, greedy.share, greedy.mean) == (4, 0.75, 17 / 4)
    assert greedy.interval == mean_interval([1, 2, 4, 10], range(4))
    assert (greedy.change.mean, greedy.change.pairs) == (5 / 4, 4)
    assert greedy.gap.share == (28 - 17) / 28
    few, many = (measured.actions["found", "greedy", objects] for objects in (2, 8))
    assert (few.mean, many.mean, few.gap.share, many.gap.share) == (2.5, 6.0, 5 / 10, 6 / 18)
    retrieved = measured.actions["retrieved", "greedy", None]
    assert retrieved.mean == (3 + 4 + 6 + 11) / 4
    # Random takes 6, 10, 8 actions and never gets there; informed takes 2.
    assert retrieved.gap.share == (35 - 24) / (35 - 8)
    assert measured.actions["found", "search-for-grasp", None].change is None
    assert [measured.actions["found", label, None].gap for label in ("random", "informed")] == [None, None]
    assert measured.curve("found", "greedy") == [0.0, 0.25, 0.5, 0.5, *[0.75] * 7]
    assert len(measured.curve("retrieved", "greedy")) == 12


def test_the_area_above_a_curve_is_the_mean():
    measured = measure(shown_of(FOUND))
    for (goal, label, objects), each in measured.actions.items():
        if objects is None:
            assert sum(1 - share for share in measured.curve(goal, label)[:-1]) == pytest.approx(each.mean, abs=1e-12)


def test_only_the_scenes_and_seeds_of_the_first_variant_count():
    more = measure(shown_of({**FOUND, "greedy": [*FOUND["greedy"], 9, 9]}))
    assert more.actions == measure(shown_of(FOUND)).actions


def test_the_page_says_what_is_measured():
    text = text_of(measure(shown_of(FOUND)))
    assert "| variant | episodes | found | actions | change | closed gap |" in text
    assert re.search(r"\| greedy \| 4 \| 0\.75 \(.*?\) \| 4\.25 \(.*?\) \| \+1\.25 \(.*?\) \| 0\.39 \(", text)
    assert "counts as 10, the budget, and until *retrieved* as 11" in text
    assert text.count("| closed gap | 2 objects | 8 objects |") == 2
    # Neither end is placed between the ends.
    for table in text.split("| closed gap | 2 objects | 8 objects |")[1:]:
        assert re.findall(r"^\| ([a-z-]+) \|", table.partition("\n\n")[0], re.MULTILINE) == [
            "search-for-grasp",
            "greedy",
        ]
    assert "fewer actions with informed -3.00 (" in text
    assert "](yardstick/found.png)" in text
    assert "no rows of" not in text


def test_without_the_informed_planner_the_page_says_so():
    text = text_of(measure(shown_of({label: FOUND[label] for label in ("search-for-grasp", "greedy", "random")})))
    assert "There are no rows of informed yet, so it is not known." in text
    assert "| closed gap |" not in text
    assert "| variant | episodes | found | actions | change |" in text
    alone = text_of(measure(shown_of({"search-for-grasp": [1, 2]})))
    assert "There are no rows beside those of search-for-grasp." in alone
    assert "There are no rows of random and informed yet" in alone


def test_every_policy_has_a_curve_of_its_shares_with_a_label_that_can_be_read():
    rng = np.random.default_rng(0)
    actions = {label: rng.integers(0, 4 + i, 40).tolist() for i, label in enumerate(YARDSTICK.drawn)}
    actions["informed"] = [0] * 40
    measured = measure(shown_of(actions))
    figures = yardstick_page.pictures(measured)
    assert set(figures) == set(yardstick_page.PLACED)
    for goal, figure in figures.items():
        (axes,) = figure.axes
        curves = {line.get_label(): line for line in axes.get_lines() if not line.get_label().startswith("_")}
        assert list(curves) == list(YARDSTICK.drawn)
        for label, line in curves.items():
            assert line.get_ydata().tolist() == measured.curve(goal, label)
        looks = {(line.get_color(), line.get_linestyle()) for line in curves.values()}
        assert len(looks) == len(curves)
        texts = {text.get_text().rpartition(" ")[0]: text for text in axes.texts}
        assert set(texts) == set(curves)
        assert all(texts[label].get_color() == curves[label].get_color() for label in curves)
        figure.draw_without_rendering()
        boxes = [Text.get_window_extent(text) for text in axes.texts]
        assert all(box.x0 >= 0 and box.x1 <= figure.bbox.width and box.y1 <= figure.bbox.height for box in boxes)
        assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


def test_a_variant_has_its_colour_whatever_others_there_are():
    curves = {label: [0.0, 0.5] for label in ("random", "greedy")}
    lines = {line.get_label(): line for line in curves_figure(curves, YARDSTICK.drawn, "x").axes[0].get_lines()}
    assert lines["random"].get_color() == STYLES[YARDSTICK.drawn.index("random")]["color"]
    assert lines["greedy"].get_color() == STYLES[YARDSTICK.drawn.index("greedy")]["color"]


def test_labels_keep_their_distance_and_their_order():
    assert spread([0.2, 0.5, 0.9], 0.1, 1.0) == pytest.approx([0.2, 0.5, 0.9])
    assert spread([0.5, 0.5], 0.1, 1.0) == pytest.approx([0.45, 0.55])
    assert spread([0.98, 0.97, 0.5], 0.1, 1.0) == pytest.approx([1.0, 0.9, 0.5])
    places = spread([1.0] * len(STYLES), LINE_HEIGHT, HIGHEST)
    assert max(places) == pytest.approx(HIGHEST)
    assert np.diff(sorted(places)) == pytest.approx([LINE_HEIGHT] * (len(STYLES) - 1))


def test_one_command_writes_both_pages_and_their_pictures(tmp_path, monkeypatch):
    rows = [row for label, steps in FOUND.items() for row in rows_of(label, steps)]
    runs = tmp_path / "runs"
    runs.mkdir()
    write_run(dataclasses.replace(run_of("user-run", rows, command="x"), name="user-run"), runs)
    monkeypatch.setattr(sys, "argv", ["page", "--runs", str(runs), "--out", str(tmp_path / "docs" / "studies.md")])
    (tmp_path / "docs").mkdir()
    studies_page.main()
    written = {str(path.relative_to(tmp_path / "docs")) for path in (tmp_path / "docs").rglob("*.*")}
    assert written == {
        *("studies.md", "studies/baselines.png"),
        *("yardstick.md", "yardstick/found.png", "yardstick/retrieved.png"),
    }
    assert "[yardstick](yardstick.md)" in (tmp_path / "docs" / "studies.md").read_text()
