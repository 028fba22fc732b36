"""The page of the paper's experiments: it is what the stored runs say, and findings hold by their rules alone."""

from pathlib import Path

import pytest
from stored_rows import row_of

from mechsearch_jax.benchmarks.lab.site import reproduction_page
from mechsearch_jax.benchmarks.lab.site.findings import (
    FAILS,
    FINDINGS,
    HOLDS,
    OPEN,
    _verdict,
    verdicts,
)
from mechsearch_jax.benchmarks.lab.site.store_run import run_of
from mechsearch_jax.benchmarks.lab.site.stored_tables import results_of_runs
from mechsearch_jax.benchmarks.paper.paper_tables import METHODS, PICK_AND_PLACE, PUSH, TABLES
from mechsearch_jax.benchmarks.store.runs import write_run
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.planner import PRESETS

ROOT = Path(__file__).parents[1]


def rows_of(table, scenes, reach, recognitions=("masks",), preset="paper", **fields):
    """Rows of all methods and actions on scenes of each block, by their numbers or so many of the first.

    `reach` says after how many actions the target was found and graspable.
    """
    paper_table = TABLES[table]
    for policy in METHODS:
        for recognition in recognitions:
            for actions in paper_table.actions:
                method = Method(policy, PRESETS[preset](actions=actions), recognition)
                for objects, block in paper_table.blocks.items():
                    for number in range(scenes) if isinstance(scenes, int) else scenes:
                        found_step, graspable_step = reach(policy, recognition, actions, objects, number)
                        usual = {
                            "found_step": found_step,
                            "graspable_step": graspable_step,
                            "retrieved": graspable_step is not None,
                        }
                        name = f"{block}-{number:03d}"
                        yield row_of(name, method, objects=objects, content_hash=name.rjust(12, "0"), **usual | fields)


def stored(folder, table, rows, name=None, **origin):
    origin = {"command": f"mechsearch reproduce {table}", "commit": None, "note": None, "started": None} | origin
    run = run_of(name or table, list(rows), **origin)
    write_run(run, folder)
    return run


def finding(text):
    (one,) = (each for each in FINDINGS if text in each.text)
    return one


@pytest.mark.slow
@pytest.mark.always
def test_the_page_is_what_the_stored_runs_say():
    written = (ROOT / "docs/reproduction.md").read_text(encoding="utf-8")
    expected = reproduction_page.page(ROOT / "benchmarks/results/runs")
    assert written == expected, f"run `python -m {reproduction_page.__name__}`"


def test_without_runs_every_finding_says_what_to_run(tmp_path):
    page = reproduction_page.page(tmp_path / "none")
    assert "Nothing of it is stored." in page
    assert page.count("There are no rows that decide it: `mechsearch reproduce table") == len(FINDINGS)
    assert "`mechsearch reproduce table4 --recognition masks --out FOLDER`" in page


@pytest.mark.parametrize(
    ("rule", "interval", "verdict"),
    [
        ("more", (0.01, 0.2), HOLDS),
        ("more", (-0.2, -0.01), FAILS),
        ("more", (-0.01, 0.2), OPEN),
        ("fewer", (-0.2, -0.01), HOLDS),
        ("fewer", (0.01, 0.2), FAILS),
        ("fewer", (-0.2, 0.01), OPEN),
        ("no difference", (-0.02, 0.04), HOLDS),
        ("no difference", (-0.02, 0.06), OPEN),
        ("no difference", (0.001, 0.01), FAILS),
        ("no difference", (-0.01, -0.001), FAILS),
    ],
)
def test_a_finding_holds_by_its_interval(rule, interval, verdict):
    assert _verdict(rule, interval) == verdict


def test_findings_are_of_the_rows_that_they_name():
    def reach(policy, recognition, actions, objects, number):
        # Search-for-grasp alone grasps every fourth scene with 6 and 8 objects; it grasps the rest as the other does.
        late = objects > 4 and number % 4 == 0 and policy == METHODS[0]
        return 1, None if late or number % 5 == 1 else 2

    rows = rows_of("table1", 20, reach, ("oracle", "masks", "full"))
    tables = {"table1": results_of_runs(TABLES["table1"], [run_of("x", list(rows), command="reproduce table1")])}
    many = verdicts(finding("With 6 and 8 objects, search-for-grasp grasps"), tables)
    assert [(one.recognition, one.verdict, one.change.value, one.change.count) for one in many] == [
        (seen, HOLDS, pytest.approx(0.2), 40) for seen in ("oracle", "masks")
    ]
    # (0.672 - 0.656 + 0.656 - 0.606) / 2 of its R.
    assert many[1].paper == pytest.approx(0.033)
    (few,) = {
        (one.verdict, one.change.value) for one in verdicts(finding("With 2 and 4 objects, both methods grasp"), tables)
    }
    assert few == (HOLDS, 0.0)
    for seen in ("masks", "full"):
        (one,) = verdicts(finding(f"Between `{seen}` and true shapes there is no difference in grasping"), tables)
        assert (one.verdict, one.change.count) == (HOLDS, 160)
    assert not verdicts(finding("Pushing alone finds more"), tables)
    assert not verdicts(finding("With 4 objects, boxes"), tables)


def test_one_kind_of_action_is_compared_with_both():
    def reach(policy, recognition, actions, objects, number):
        is_found = actions != PICK_AND_PLACE or number % 2
        is_graspable = is_found and (actions != PUSH or number % 4)
        return (1 if is_found else None), (2 if is_graspable else None)

    run = run_of("x", list(rows_of("table4", 20, reach)), command="mechsearch reproduce table4")
    tables = {"table4": results_of_runs(TABLES["table4"], [run])}
    expected = {"Pick-and-place alone finds": -0.5, "Pushing alone grasps": -0.25, "Pushing alone finds more": 0.5}
    for text, value in expected.items():
        (one,) = verdicts(finding(text), tables)
        assert (one.verdict, one.change.value, one.change.count) == (HOLDS, pytest.approx(value), 80)
    # Pushes: 0.907 and 0.813, 0.92 and 0.773; pick-and-places: 0.76 and 0.627, 0.76 and 0.693.
    assert one.paper == pytest.approx((0.907 + 0.813 + 0.92 + 0.773 - 0.76 - 0.627 - 0.76 - 0.693) / 4)


def test_the_newest_run_of_a_cell_counts():
    old, new = (
        [*rows_of("table3", 3, lambda *_, step=step: (step, step), code=code)]
        for step, code in ((5, "old"), (3, "new"))
    )
    head = {"command": "mechsearch reproduce table3"}
    runs = [run_of("a", old, **head, started="2026-11-25"), run_of("b", new[:3], **head, started="2026-11-26")]
    results = results_of_runs(TABLES["table3"], [*runs, run_of("c", old, command="mechsearch evaluate d1")])
    assert {setting.method: rows[0].code for setting, rows in results.rows.items()} == dict(
        zip(METHODS, ("new", "old"), strict=True)
    )
    # What ran with different code is not compared.
    assert not results.differences()
