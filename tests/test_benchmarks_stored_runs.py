"""Stored runs: folders become one small file of rows and one of lines, and what does not belong together is refused."""

import dataclasses
import sys

import pytest
from stored_rows import row_of

from mechsearch_jax.benchmarks.lab.site import store_run
from mechsearch_jax.benchmarks.lab.site.store_run import run_of
from mechsearch_jax.benchmarks.statistics.intervals import wilson
from mechsearch_jax.benchmarks.statistics.preset_names import settings_of
from mechsearch_jax.benchmarks.store.rows import episode_key
from mechsearch_jax.benchmarks.store.runs import merged, stored_runs
from mechsearch_jax.benchmarks.store.shards import ShardWriter
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.runtime.errors import InputError


def write(folder, rows, writer="me"):
    with ShardWriter(folder, writer) as shards:
        shards.append(rows)
    return folder


def test_a_run_is_read_back_and_says_what_came_of_it(tmp_path, monkeypatch, capsys):
    rows = [row_of("c2-4-001"), row_of("c2-4-100", found_step=None, graspable_step=None, retrieved=False, steps=10)]
    paper = Method("search-and-grasp", PRESETS["paper"](gamma=0.5), "masks")
    rows.append(row_of("c2-4-100", paper, objects_fallen=1, paper_graspable=None))
    folders = [write(tmp_path / name, part) for name, part in (("a", rows[:2]), ("b", rows[1:]))]
    arguments = [*map(str, folders), "--name", "two", "--command", "mechsearch evaluate c2", "--commit", "abc"]
    monkeypatch.setattr(sys, "argv", ["store_run", *arguments, "--out", str(tmp_path / "runs")])
    store_run.main()
    assert "two.parquet: 0.0" in capsys.readouterr().out
    (run,) = stored_runs(tmp_path / "runs")
    rounded = {episode_key(row): dataclasses.replace(row, planning_seconds=1.23, compile_seconds=0.12) for row in rows}
    assert {episode_key(row): row for row in run.rows} == rounded
    one, other = sorted(run.lines, key=lambda line: line["preset"] == "paper")
    assert (one["run"], one["commit"], one["code"], one["command"]) == ("two", "abc", "this code", arguments[5])
    assert (one["scene_set"], one["objects"], one["seeds"], one["devices"]) == ("c2", 4, [0], ["cuda: H100"])
    assert (one["preset"], one["settings"], one["episodes"], one["errors"]) == ("standard", {}, 2, 0)
    assert (one["scenes"], one["scenes_chosen_on"]) == (2, 1)
    interval = [round(bound, 4) for bound in wilson(1, 2)]
    assert one["retrieved"] == one["found"] == {"rate": 0.5, "interval": interval}
    assert (one["drop_free"]["rate"], one["actions"]) == (1.0, 6.5)
    assert one["on_scenes_not_chosen_on"]["episodes"] == 1
    assert one["on_scenes_not_chosen_on"]["retrieved"]["rate"] == 0.0
    assert other["settings"] == {"policy": "search-and-grasp", "recognition": "masks", "gamma": 0.5}
    assert other["drop_free"]["rate"] == 0.0
    assert other["paper_graspable"] is None


def test_an_error_reaches_nothing():
    nothing = {"found_step": None, "graspable_step": None, "retrieved": False, "objects_fallen": None}
    failed = row_of("c2-4-100", failure="error: no", steps=0, **nothing)
    (line,) = run_of("x", [failed, row_of("c2-4-101")]).lines
    assert (line["errors"], line["actions"]) == (1, 3.0)
    assert {line[name]["rate"] for name in ("found", "graspable", "retrieved", "drop_free")} == {0.5}
    assert run_of("x", [failed]).lines[0]["actions"] is None


def test_parts_of_other_code_and_those_that_disagree_are_refused(tmp_path):
    one = write(tmp_path / "one", [row_of("c2-4-001")])
    other = write(tmp_path / "other", [row_of("c2-4-002", code="other code")])
    with pytest.raises(InputError, match=r"run by other code, those of .*one by this code; store them as two runs"):
        merged([one, other])
    changed = write(tmp_path / "changed", [row_of("c2-4-001", steps=5, planning_seconds=9.0)])
    with pytest.raises(InputError, match="'c2-4-001', seed 0, has another steps than the same episode in"):
        merged([one, changed])
    (empty := tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no results in this folder"):
        merged([empty])


def test_what_agrees_counts_once_and_an_error_gives_way(tmp_path):
    good, failed = row_of("c2-4-001"), row_of("c2-4-001", failure="error: no", retrieved=False)
    again = dataclasses.replace(good, planning_seconds=7.0, device="cuda: H200")
    folders = [write(tmp_path / str(i), [row]) for i, row in enumerate((failed, good, again, failed))]
    assert merged(folders) == [good]


def test_every_preset_is_its_own_settings():
    for name, preset in PRESETS.items():
        options = {**Method(config=preset()).options(), "simulator": "MjxSimulator", "target": "box"}
        assert settings_of(options) == (name, {})
        assert settings_of({**options, "gamma": 0.5}) == (name, {"gamma": 0.5})
    later = Method().options()
    del later["move_target"]
    assert settings_of(later) == ("standard", {})
