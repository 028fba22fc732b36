"""`mechsearch report`: what results of `evaluate` and `sweep` say."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mechsearch_jax.commands.options import find_scenario, find_scenarios
from mechsearch_jax.runtime.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from mechsearch_jax.benchmarks.report.films import Draw
    from mechsearch_jax.benchmarks.report.report import Report
    from mechsearch_jax.benchmarks.store.rows import EpisodeRow


def _columns(texts: Sequence[str]) -> tuple[str, ...]:
    """Names of columns, which may stand one after the other or have commas between them."""
    return tuple(name for text in texts for name in text.split(",") if name)


def report(
    results: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER|FILE ...")],
    /,
    *,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None,
    rows: Annotated[tuple[str, ...], tyro.conf.arg(metavar="COLUMN ...")] = (),
    curve: Annotated[tuple[str, ...], tyro.conf.arg(metavar="COLUMN [COLUMN]")] = (),
    baseline: Annotated[str | None, tyro.conf.arg(metavar="VARIANT")] = None,
    paired: Annotated[tuple[str, ...], tyro.conf.arg(metavar="COLUMN ...")] = (),
    films: bool = False,
    scenes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SCENARIO|FOLDER|SET ...")] = (),
) -> None:
    """Print rates by variant and number of objects from results of evaluate or sweep, and write them with plots.

    It also says how many actions it took until found, graspable and retrieved, where an episode that never got there
    counts as its budget, and what happened on the way: the truth ruled out, objects fallen, the arm held up, bodies
    never at rest.
    Columns are those of the results: fields of rows, options, and "method" for the variant.

    Args:
      results: folders of evaluate, folders of those, and Parquet files of rows.
      out: folder for report.html, which holds everything, report.md, report.tex, CSV and JSON files and pictures; only
        prints if not given.
      rows: columns to group rates by, instead of method and objects; also over all values of the last one.
      curve: rates over this column; of two, with a line for each value of the second.
      baseline: a variant by its label, or what tells it from others, as gamma=0.5; adds paired differences from it.
      paired: what two episodes of a pair have in common; scenario and seed if not given.
      films: draw three typical episodes, three lost and the slowest, by running them again.
      scenes: where the scenarios of these are, if they are neither shipped nor in a scene set.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.report import films as single
    from mechsearch_jax.benchmarks.report.report import Report, ReportOptions, changed_scenarios_remark, read_tables
    from mechsearch_jax.benchmarks.report.scene_map import drawn_files
    from mechsearch_jax.benchmarks.statistics.paired import PAIRED

    if films and out is None:
        raise InputError("report: --films are drawn into a folder; give --out")
    if paired and baseline is None:
        raise InputError("report: --paired says what is compared with a baseline; give --baseline")
    episodes = read_tables(results)
    options = ReportOptions(_columns(rows), _columns(curve), baseline, _columns(paired) or PAIRED)
    results_report = Report.of(episodes, options)
    console = Console(highlight=False)
    if out is not None:
        from mechsearch_jax.benchmarks.report.report_files import write_report

        with Console(stderr=True).status("writing") as status:
            draw = _drawer(scenes, status.update) if films else None
            shown = single.films(episodes, out, draw)
            results_report = dataclasses.replace(results_report, films=shown, drawn=drawn_files(out))
            write_report(results_report, out, lambda file: status.update(f"writing {file}"))
    _print(console, results_report, bool(rows))
    if remark := changed_scenarios_remark(episodes):
        print(f"report: {remark}", file=sys.stderr)
    if out is not None:
        console.print(f"{out / 'report.html'}\n{out / 'report.md'}", soft_wrap=True, markup=False)


def _print(console: Console, report: Report, columns_chosen: bool) -> None:
    """Print rates, restricted means of actions, the curve, differences and, unless columns were chosen, events."""
    from mechsearch_jax.benchmarks.report.episode_tables import (
        differences_table,
        events_summary_table,
        print_summary,
        restricted_table,
    )

    print_summary(console, report.rates, report.key)
    console.print()
    console.print(restricted_table(report.restricted, report.key))
    if report.curve:
        console.print()
        print_summary(console, report.curve, dataclasses.replace(report.key, common=""))
    if report.differences:
        console.print()
        console.print(differences_table(report.differences, report.key, str(report.baseline)))
    if report.events and not columns_chosen:
        console.print()
        console.print(events_summary_table(report.events, report.key))


def _drawer(scenes: Sequence[str], status: Callable[[str], None]) -> Draw:
    """A function that draws an episode's filmstrip; its scenario is one of `scenes`, shipped, or of a scene set."""
    from mechsearch_jax.benchmarks.report.films import replay
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.workspace.scenario import Scenario, load_scenario

    keep_compilations()
    by_name: dict[str, Scenario] = {}
    for file in find_scenarios(scenes) if scenes else ():
        scenario = load_scenario(file)
        by_name[scenario.name] = scenario

    def draw(row: EpisodeRow, file: Path) -> str:
        status(f"running {row.scenario} again, seed {row.seed}")
        return replay(row, by_name.get(row.scenario) or load_scenario(find_scenario(row.scenario)), file)

    return draw
