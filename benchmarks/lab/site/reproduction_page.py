"""Writes docs/reproduction.md, the paper's tables and findings in this simulator, from the stored runs:
`python -m mechsearch_jax.benchmarks.lab.site.reproduction_page` in a checkout.

The page is the template `reproduction_page.md.jinja` beside this file; every figure is computed from the rows of
`benchmarks/results/runs`, or is one of the paper's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from mechsearch_jax.benchmarks.lab.site.findings import FINDINGS, HOLDS, MARGIN, Finding, Verdict, goal_of, verdicts
from mechsearch_jax.benchmarks.lab.site.results_page import table
from mechsearch_jax.benchmarks.lab.site.rewriting import rewrite
from mechsearch_jax.benchmarks.lab.site.store_run import rates_of
from mechsearch_jax.benchmarks.lab.site.stored_tables import results_of_runs, runs_of
from mechsearch_jax.benchmarks.paper.paper_tables import METHODS, TABLES
from mechsearch_jax.benchmarks.paper.reproduce import (
    NOT_IN_THE_PAPER,
    Mean,
    Results,
    Setting,
    actions_text,
    objects_text,
    origin_of,
)
from mechsearch_jax.benchmarks.statistics.intervals import with_interval
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.benchmarks.store.runs import RUNS, StoredRun, stored_runs
from mechsearch_jax.envs.scenes.scene_sets import CHOSEN_ON, is_chosen_on
from mechsearch_jax.runtime.files import PathLike

TEMPLATE = Path(__file__).with_name("reproduction_page.md.jinja")


def _share(rate: Mapping[str, Any] | None) -> str:
    return "-" if rate is None else with_interval(rate["rate"], rate["interval"], "{:.2f}")


def _rate(rate: Mapping[str, Any] | None) -> str:
    return "-" if rate is None else f"{rate['rate']:.2f}"


def _table(header: Sequence[str], lines: Sequence[Sequence[object]], constant: Sequence[str] = ()) -> str:
    """The table, without columns that say nothing, and without those of these names that say one thing throughout."""
    columns = [[str(line[i]) for line in lines] for i in range(len(header))]
    kept = [
        i
        for i, (name, cells) in enumerate(zip(header, columns, strict=True))
        if set(cells) != {"-"} and not (name in constant and len(set(cells)) == 1)
    ]
    return table([header[i] for i in kept], [[line[i] for i in kept] for line in lines])


def _paper(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def runs_table(runs: Sequence[StoredRun], tables: Mapping[str, Results]) -> str:
    """What was run, how, where and by what code, and how much of it is in the tables."""
    shown = {id(row) for results in tables.values() for rows in results.rows.values() for row in rows}
    lines = []
    for run in runs:
        first = run.lines[0]
        file = f"[{run.name}](../{RUNS}/{run.name}.jsonl)"
        errors = sum(row.is_error for row in run.rows)
        origin = (first.get("commit") or "-", first["code"], ", ".join(first["devices"]), first.get("started") or "-")
        seeds = ", ".join(map(str, sorted({row.seed for row in run.rows})))
        command = "; ".join(f"`{part.strip()}`" for part in str(first["command"]).split(";"))
        counts = (f"{len(run.rows):,}", f"{sum(id(row) in shown for row in run.rows):,}", errors)
        lines.append([file, command, *origin, seeds, *counts, first.get("note") or "-"])
    header = (
        "run",
        "command",
        "commit",
        "code",
        "device",
        "started",
        "seeds",
        "episodes",
        "shown",
        "errors",
        "remarks",
    )
    return table(header, lines)


def scenes_table(tables: Mapping[str, Results]) -> str:
    """How many scenes of each table settings were chosen on."""
    lines = []
    for name, results in tables.items():
        scenes = {row.scenario for rows in results.rows.values() for row in rows}
        chosen = sum(map(is_chosen_on, scenes))
        lines.append([name.replace("table", "Table "), len(scenes), chosen, len(scenes) - chosen])
    return table(["table", "scenes", "settings were chosen on", "nothing was chosen on"], lines)


def parts_of(results: Results) -> dict[str, Results]:
    """The rows of a table by what the cells of a part have in common."""
    parts: dict[str, dict[Setting, Sequence[EpisodeRow]]] = {}
    for setting, rows in results.rows.items():
        parts.setdefault(setting.part, {})[setting] = rows
    return {part: Results(results.table, rows) for part, rows in parts.items()}


def source(results: Results, runs: Sequence[StoredRun]) -> str:
    """The files that have the rows of a part, and the simulators that they ran in."""
    shown = {id(row) for rows in results.rows.values() for row in rows}
    files = [f"[{run.name}](../{RUNS}/{run.name}.jsonl)" for run in runs if any(id(row) in shown for row in run.rows)]
    simulators = sorted({str(origin_of(rows[0])[1]) for rows in results.rows.values()})
    return f"Rows: {', '.join(files)}; {', '.join(simulators)}."


_CELL = ("recognition", "method", "actions", "objects")


def _cell(setting: Setting, objects: int | None) -> tuple[str, ...]:
    """What a cell is, under `_CELL`."""
    return setting.recognition, setting.method, actions_text(setting), objects_text(objects)


def _grasp(setting: Setting, rows: Sequence[EpisodeRow], value: float | None) -> str:
    """A figure of the paper's grasps, "-" beside cells whose graspable is not the paper's."""
    return _paper(value) if goal_of("grasp", setting, rows[0]) == "graspable" else "-"


def cells_table(results: Results) -> str:
    """Our shares and mean numbers of actions beside the paper's, where it has any."""
    lines = []
    for cell in results.cells():
        if cell.paper is None:
            continue
        setting, paper = cell.setting, cell.paper
        own = [row for row in results.rows[setting] if row.objects == cell.objects]
        rates, goal = rates_of(own), goal_of("grasp", setting, own[0])
        shares = {name: (_share if name == goal else _rate)(rates[name]) for name in ("graspable", "retrieved")}
        errors = sum(row.is_error for row in own)
        lines.append(
            [
                *_cell(setting, cell.objects),
                f"{len(own)}" + (f", {errors} errors" if errors else ""),
                *(_rate(rates["found"]), _paper(paper.find)),
                *(shares["graspable"], _grasp(setting, own, paper.grasp)),
                shares["retrieved"],
                *(_steps(cell.find_steps), _paper(paper.find_steps)),
                *(_steps(cell.grasp_steps), _grasp(setting, own, paper.grasp_steps)),
            ]
        )
    header = (*_CELL, "episodes", "found", "paper", "graspable", "paper", "retrieved")
    return _table([*header, "actions to find", "paper", "to grasp", "paper"], lines, ["actions", "episodes"])


def _steps(mean: Mean) -> str:
    return "-" if mean.value is None else f"{mean.value:.2f}"


def findings(tables: Mapping[str, Results]) -> list[dict[str, Any]]:
    """The paper's findings in order, with a line for each preset and recognition of which there are rows."""
    return [
        {
            "text": finding.text,
            "source": finding.source,
            "commands": finding.commands,
            "lines": [_verdict_line(finding, verdict) for verdict in verdicts(finding, tables)],
        }
        for finding in FINDINGS
    ]


def _verdict_line(finding: Finding, verdict: Verdict) -> str:
    form = "{:+z.2f} actions" if finding.quantity.endswith("steps") else "{:+z.3f}"
    low, high = (form.split(" ")[0].format(bound) for bound in verdict.change.interval)
    paper = NOT_IN_THE_PAPER if verdict.paper is None else f"{form.split(' ')[0].format(verdict.paper)} in the paper"
    bold = f"**{verdict.verdict}**" if verdict.verdict == HOLDS else f"*{verdict.verdict}*"
    count = "pairs" if finding.factor != "table" else "episodes with boxes"
    methods = verdict.change.methods
    only = f", {methods[0]} alone" if finding.factor != "method" and len(methods) < len(METHODS) else ""
    return (
        f"{verdict.part}, `{verdict.recognition}`{only}: {bold}, {verdict.goal} {form.format(verdict.change.value)} "
        f"({low} to {high}), {verdict.change.count} {count}; {paper}"
    )


def page(folder: PathLike) -> str:
    """The page in Markdown, from the folder of stored runs.

    Raises:
      InputError: a file of it cannot be read.
    """
    runs = stored_runs(folder)
    names = dict.fromkeys(run.name for paper_table in TABLES.values() for run in runs_of(paper_table, runs))
    tables = {name: results for name, each in TABLES.items() if (results := results_of_runs(each, runs)).rows}
    environment = jinja2.Environment(
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, undefined=jinja2.StrictUndefined
    )
    environment.globals |= {function.__name__: function for function in (parts_of, source, cells_table, scenes_table)}
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    return template.render(
        stored=runs,
        runs=runs_table([run for run in runs if run.name in names], tables) if names else "",
        tables=tables,
        all_tables=TABLES,
        findings=findings(tables),
        chosen_on=CHOSEN_ON,
        margin=f"{MARGIN:.2f}",
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Rewrite the page."""
    rewrite(page, "runs", str(RUNS), "docs/reproduction.md", arguments)


if __name__ == "__main__":
    main()
