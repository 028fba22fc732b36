"""`mechsearch report`: what results of `evaluate` say."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro


def report(
    tables: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE ...")],
    /,
    *,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None,
) -> None:
    """Print rates by method and number of objects from results of `evaluate`, and write them with plots.

    Args:
      tables: Parquet files.
      out: folder for report.md, rates.csv, rates.json, failures.csv and success.png; only prints if not given.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.report import read_tables, told_of_changes, write_report
    from mechsearch_jax.benchmarks.tables import rates_table

    rows = read_tables(tables)
    if out is not None:
        write_report(rows, out)
    console = Console(highlight=False)
    console.print(rates_table(rows))
    if told_of_changes(rows):
        print(f"report: {told_of_changes(rows)}", file=sys.stderr)
    if out is not None:
        console.print(str(out / "report.md"), soft_wrap=True)
