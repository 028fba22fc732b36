"""The paper's tables: figures as they are printed there, rates and intervals of rows, differences over the same scenes,
and the command that runs the cells and draws the table."""

import dataclasses
import json
import re

import pytest
from rich.console import Console

from mechsearch_jax.benchmarks.paper.paper_tables import (
    BOTH,
    METHODS,
    PUSH,
    TABLES,
    Figures,
    paper_figures,
    table_scenes,
)
from mechsearch_jax.benchmarks.paper.reproduce import (
    Mean,
    Results,
    Setting,
    markdown,
    screen,
)
from mechsearch_jax.benchmarks.running import evaluate as evaluation
from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.benchmarks.statistics.intervals import mean_interval, wilson
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.benchmarks.store.shards import ShardWriter
from mechsearch_jax.commands import main as cli
from mechsearch_jax.commands import reproduce as command
from mechsearch_jax.envs.scenes.scene_sets import SETS
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Body, Scenario, save_scenario

TARGET = Body("cylinder", (0.02, 0.02, 0.05), (0.62, 0.07, 0.4545), (1.0, 0.0, 0.0, 0.0))
ROW = EpisodeRow(
    "a", 2, "cylinder", METHODS[1], "oracle", 0.9, 3, 30, "push+pick-and-place", 0, 1, 2, True, 3, None, 1.5, 0.6
)
FOR = Setting(METHODS[1], "masks", BOTH, "paper")
AND = FOR._replace(method=METHODS[0])


def row(scene, found, grasped, objects=2, **changes):
    """An episode that found the target, and could grasp it, after so many actions."""
    return dataclasses.replace(
        ROW, scenario=scene, objects=objects, found_step=found, graspable_step=grasped, **changes
    )


def results(rows, table="table1"):
    return Results(TABLES[table], rows)


@pytest.mark.parametrize("table", TABLES.values(), ids=list(TABLES))
def test_the_papers_shares_are_of_so_many_scenes_and_its_steps_in_order(table):
    assert {cell.objects for cell in table.figures} == set(table.blocks)
    assert {cell.actions for cell in table.figures} == set(table.actions)
    assert {cell.method for cell in table.figures} == set(METHODS)
    for cell, shown in table.figures.items():
        scenes = SETS[table.blocks[cell.objects]].scenes
        for share in (shown.find, shown.grasp):
            assert share is None or abs(share * scenes - round(share * scenes)) <= 0.0005 * scenes + 1e-9, cell
        assert shown.find is None or shown.find >= shown.grasp
        assert 1 < shown.find_steps < shown.grasp_steps < 10


def test_the_papers_letters():
    table = TABLES["table1"]
    assert paper_figures(table, "oracle", METHODS[1], BOTH, 8) == Figures(0.889, 0.578, 2.831, 4.125)
    expected = Figures(0.894, 0.656, 2.901, 3.975)
    assert [paper_figures(table, seen, METHODS[1], BOTH, 8) for seen in ("masks", "full")] == [expected] * 2
    assert paper_figures(table, "masks", METHODS[1], PUSH, 8) is None
    assert paper_figures(TABLES["table3"], "oracle", METHODS[1], BOTH, 2) is None
    assert paper_figures(table, "informed", METHODS[1], BOTH, 8) is None


def test_the_scenes_of_a_table():
    assert [len(table_scenes(table)) for table in TABLES.values()] == [720, 200, 150, 80]
    few = table_scenes(TABLES["table5"], (8,), 3)
    assert [(block.name, index) for block, index in few] == [("d3-8", 0), ("d3-8", 1), ("d3-8", 2)]
    with pytest.raises(InputError, match="table3 has no scenes with 4 objects; there are those with 2"):
        table_scenes(TABLES["table3"], (4,))


def test_cells_are_what_the_rows_say():
    rows = [row("a", 1, 2), row("b", 3, None), row("c", None, None), row("d", 2, 4, 4), row("e", 0, 0, 4)]
    rows[2] = dataclasses.replace(rows[2], failure="error: no")
    two, four, every = results({FOR: rows}).cells()
    assert (two.objects, two.episodes, two.errors) == (2, 3, 1)
    assert two.find == Mean(2 / 3, wilson(2, 3), 3)
    assert two.grasp == Mean(1 / 3, wilson(1, 3), 3)
    assert two.find_steps == Mean(2.0, mean_interval([1, 3], "ab"), 2)
    # One scene says nothing of how scenes differ.
    assert two.grasp_steps == Mean(2.0, (None, None), 1)
    assert two.paper == Figures(0.972, 0.922, 1.331, 1.651)
    assert four.paper == Figures(0.933, 0.756, 2.196, 2.765)
    assert (every.objects, every.episodes, every.paper) == (None, 5, None)
    assert every.find_steps.value == 1.5


def test_differences_are_over_the_same_episodes():
    base = [row("a", 1, 3), row("b", 2, None), row("c", None, None), row("d", 1, 2), row("a", 2, 3, seed=1)]
    now = [row("a", 2, 2), row("b", 2, 4), row("c", 3, None), row("x", 1, 1), row("a", 1, 1, seed=1)]
    shown = results({AND: base, FOR: now}).differences()
    (one,) = shown
    assert (one.factor, one.setting, one.base, one.pairs) == ("method", FOR, METHODS[0], 4)
    # Scene a counts once with both of its seeds; b was graspable now alone, c found now alone.
    for goal in (one.find, one.grasp):
        assert (goal.value, goal.interval, goal.count) == (pytest.approx(1 / 3), mean_interval([0, 0, 1], "abc"), 4)
    # Of both seeds of a, and of b to find alone.
    assert (one.find_steps.value, one.find_steps.count) == (pytest.approx(((1 - 1) / 2 + 0) / 2), 3)
    assert one.grasp_steps == Mean(pytest.approx((-1 - 2) / 2), (None, None), 2)


def test_settings_are_compared_in_one_thing_at_a_time():
    settings = [
        FOR._replace(method=m, recognition=r, preset=p) for m in METHODS for r in ("oracle", "masks") for p in "st"
    ]
    shown = results({setting: [row("a", 1, 2)] for setting in settings}).differences()
    assert len(shown) == 3 * 4
    for one in shown:
        other = one.setting._replace(**{one.factor: one.base})
        assert sum(a != b for a, b in zip(one.setting, other, strict=True)) == 1


def test_the_page_has_a_table_for_each_preset():
    rows = [row("a", 1, 2), row("b", None, None)]
    shown = results({FOR: rows, AND: rows, FOR._replace(preset="standard"): rows})
    page = re.sub(" +", " ", markdown(shown, "mechsearch reproduce table1"))
    assert re.findall(r"^## (.*)$", page, re.MULTILINE) == [
        "Preset paper",
        "Preset standard",
        "Paired differences",
    ]
    low, high = wilson(1, 2)
    assert f"| masks | search-for-grasp | both | 2 | 2 | 0.500 ({low:.3f} to {high:.3f}) | 0.972 |" in page
    for table in re.findall(r"(?:^\|.*\|$\n?)+", page, re.MULTILINE):
        assert len({line.count("|") for line in table.splitlines()}) == 1
    console = Console(record=True, width=80)
    console.print(screen(shown))
    printed = console.export_text()
    assert re.search(
        "^masks search-for-grasp +2 +2 +0.50/0.97 +0.50/0.92 +1.00/1.33 +2.00/1.65 *$", printed, re.MULTILINE
    )
    assert "…" not in printed


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs the command on scenes that hold nothing, with episodes that end at once."""
    monkeypatch.chdir(tmp_path)
    ran = []

    def files_of(scenes):
        for block, index in scenes:
            save_scenario(Scenario(block.scene_name(index), (), TARGET), f"scenes/{block.scene_name(index)}.json")
        return [tmp_path / "scenes" / f"{block.scene_name(index)}.json" for block, index in scenes]

    def evaluate(jobs, out, runner, ended, waiting, retry_errors):
        rows = [dataclasses.replace(job.failed("no"), found_step=1, code=present_code()) for job in jobs]
        ran.append(jobs)
        with ShardWriter(out, f"test{len(ran)}") as writer:
            writer.append(rows)
        return rows

    monkeypatch.setattr(command, "files_of", files_of)
    monkeypatch.setattr(evaluation, "evaluate", evaluate)

    def run(*arguments):
        cli.parse(["reproduce", *arguments, "--workers", "1", "--out", "rows"])()
        return ran[-1] if ran else [], capsys.readouterr()

    return run


def test_the_command_runs_every_cell_and_draws_what_came_of_it(run, tmp_path):
    jobs, printed = run("table4", "--scenes", "2", "--recognition", "masks", "--preset", "paper")
    shown = {(job.method.name, job.method.config.problem.actions.actions) for job in jobs}
    assert shown == {(name, actions) for name in METHODS for actions in TABLES["table4"].actions}
    assert len(jobs) == len({job.key for job in jobs}) == 2 * 2 * 6
    assert {job.method.recognition for job in jobs} == {"masks"}
    assert "table4, preset paper" in printed.out
    value = json.loads((tmp_path / "rows" / "table4.json").read_text())
    assert value["table"] == "table4"
    cell = next(cell for cell in value["cells"] if cell["setting"]["actions"] == list(PUSH))
    assert (cell["episodes"], cell["find"]["value"], cell["grasp"]["value"]) == (4, 1.0, 0.0)
    assert cell["errors"] == 4
    assert re.search(r"\| masks +\| search-for-grasp +\| push +\|", (tmp_path / "rows" / "table4.md").read_text())


def test_by_default_all_that_the_paper_compares_is_run(run):
    jobs, _ = run("table3", "--scenes", "1")
    assert len(jobs) == 2 * 3 * 2
    assert len({job.method.config for job in jobs}) == 2


def test_parts_of_several_machines_make_one_table(run, tmp_path):
    common = ("table1", "--scenes", "3", "--recognition", "oracle", "--preset", "paper", "--method", METHODS[1])
    first, _ = run(*common, "--shard", "1/2")
    second, _ = run(*common, "--shard", "2/2")
    assert len(first) + len(second) == 12
    value = json.loads((tmp_path / "rows" / "table1.json").read_text())
    assert [cell["episodes"] for cell in value["cells"]] == [12]


def test_a_dry_run_says_what_it_would_be(run, tmp_path):
    jobs, printed = run("table1", "--scenes", "2", "--objects", "2", "8", "--preset", "standard", "--dry-run")
    assert not jobs
    assert not (tmp_path / "rows").exists()
    assert "4 episodes: search-for-grasp, masks, push+pick-and-place, standard, any" in printed.out
    assert "6 variants, 24 episodes, 0 of them there already, 24 left" in printed.out
    assert re.search(r"^  standard, full, with trials, native simulator: 8 x [\d.]+ s, 2 x ", printed.out, re.M)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--preset", "pape"), "preset pape is unknown; use standard, paper"),
        (("--scenes", "0"), "--scenes 0 must be at least 1"),
        (("--objects", "3"), "table1 has no scenes with 3 objects"),
        (("--shard", "3/2"), "--shard 3/2 is not K/N"),
    ],
)
def test_what_cannot_be_reproduced_is_refused(run, arguments, message):
    with pytest.raises(InputError, match=message):
        run("table1", *arguments)
