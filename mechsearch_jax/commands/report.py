"""`mechsearch report`: what results of `evaluate` say."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro


def report(
    results: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER|FILE ...")],
    /,
    *,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None,
) -> None:
    """Print rates by method and number of objects from results of `evaluate`, and write them with plots.

    What happened on the way is told too: the truth ruled out, objects fallen, the arm held up, bodies never at rest.

    Args:
      results: folders of `evaluate`, folders of those, and Parquet files of earlier versions.
      out: folder for report.md, rates.csv, rates.json, failures.csv, events.csv and success.png; only prints if not
        given.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.report import read_tables, told_of_changes, write_report
    from mechsearch_jax.benchmarks.tables import events_table, rates_table

    rows = read_tables(results)
    if out is not None:
        write_report(rows, out)
    console = Console(highlight=False)
    console.print(rates_table(rows))
    if (events := events_table(rows)) is not None:
        console.print()
        console.print(events)
    if told_of_changes(rows):
        print(f"report: {told_of_changes(rows)}", file=sys.stderr)
    if out is not None:
        console.print(str(out / "report.md"), soft_wrap=True)
