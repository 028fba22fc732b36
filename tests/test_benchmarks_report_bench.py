"""Timed reports: the rows are those of a sweep, and the command that is timed reports all of them."""

import collections
import json

import pytest

from mechsearch_jax.benchmarks.report import report_bench
from mechsearch_jax.benchmarks.report.report import read_tables
from mechsearch_jax.benchmarks.statistics.variants import Key
from mechsearch_jax.benchmarks.store.rows import identity, write_rows


def test_drawn_rows_are_those_of_a_sweep(tmp_path):
    rows = report_bench.drawn_rows(4 * 96 * 4)
    key = Key.of(rows)
    assert len(key.short) == 96
    assert key.named(report_bench.REPORTS["with paired differences"][1])
    assert len({identity(row) for row in rows}) == len(rows)
    assert set(collections.Counter((row.scenario, row.configuration) for row in rows).values()) == {report_bench.SEEDS}
    write_rows(rows, tmp_path / "rows.parquet")
    assert read_tables([tmp_path / "rows.parquet"]) == rows
    assert rows == report_bench.drawn_rows(len(rows), 0) != report_bench.drawn_rows(len(rows), 1)


@pytest.mark.slow
def test_the_command_reports_all_rows():
    begun = []
    value = json.loads(json.dumps(report_bench.bench_report(800, begun.append)))
    assert (value["rows"], value["variants"]) == (800, 96)
    assert [run["what"] for run in value["runs"]] == list(report_bench.REPORTS) == begun[1:]
    assert all(run["seconds"] > 0.5 and run["memory"] > 50 and run["bytes"] > 10_000 for run in value["runs"])
    assert report_bench.timings_table(value).row_count == 2
