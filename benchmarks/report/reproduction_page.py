"""Writes docs/reproduction.md, the paper's tables and findings in this simulator, from the stored runs:
`python -m mechsearch_jax.benchmarks.report.reproduction_page` in a checkout.

The page is the template `reproduction_page.md.jinja` beside this file; every figure is computed from the rows of
`benchmarks/results/runs`, or is one of the paper's.
"""

from __future__ import annotations

import argparse
import collections
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from mechsearch_jax.benchmarks.paper.findings import FINDINGS, HOLDS, MARGIN, Finding, Verdict, verdicts
from mechsearch_jax.benchmarks.paper.paper_tables import TABLES, Figures
from mechsearch_jax.benchmarks.paper.reproduce import (
    FACTORS,
    NOT_IN_THE_PAPER,
    Mean,
    Results,
    Setting,
    actions_text,
    mean_change,
    objects_text,
    paired_rows,
)
from mechsearch_jax.benchmarks.paper.stored_tables import results_of_runs, runs_of
from mechsearch_jax.benchmarks.report.results_page import table
from mechsearch_jax.benchmarks.report.store_run import OUTCOMES, rates_of, takes_out
from mechsearch_jax.benchmarks.statistics.rates import scene_of, step_of
from mechsearch_jax.benchmarks.store.rows import Row
from mechsearch_jax.benchmarks.store.runs import RUNS, StoredRun, stored_runs
from mechsearch_jax.envs.scenes.scene_sets import CHOSEN_ON, is_chosen_on
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing

TEMPLATE = Path(__file__).with_name("reproduction_page.md.jinja")
# Rates that stand beside each other, by their names in `OUTCOMES`.
SHARES = {"found": "found", "graspable": "graspable", "retrieved": "retrieved", "drop_free": "drop-free"}
# Scenes by the share of their episodes in which they were solved: the largest share of each column.
DIFFICULTY = {"none": 0.0, "to 1/4": 0.25, "to 1/2": 0.5, "to 3/4": 0.75, "below all": 1.0 - 1e-9, "all": 1.0}


def _share(rate: Mapping[str, Any] | None) -> str:
    return "-" if rate is None else f"{rate['rate']:.3f} ({rate['interval'][0]:.3f} to {rate['interval'][1]:.3f})"


def _change(mean: Mean, form: str = "{:+.3f}") -> str:
    if mean.value is None:
        return "-"
    low, high = mean.interval
    return form.format(mean.value) + (
        "" if low is None or high is None else f" ({form.format(low)} to {form.format(high)})"
    )


def _paper(value: float | None) -> str:
    return NOT_IN_THE_PAPER if value is None else f"{value:g}"


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
    parts: dict[str, dict[Setting, Sequence[Row]]] = {}
    for setting, rows in results.rows.items():
        parts.setdefault(setting.part, {})[setting] = rows
    return {part: Results(results.table, rows) for part, rows in parts.items()}


def cells_table(results: Results) -> str:
    """Our cells beside the paper's figures."""
    header = ["recognition", "method", "actions", "objects", "episodes", "found", "paper", "graspable", "paper"]
    header += ["with the paper's grasps", "retrieved", "drop-free", "actions to find", "paper", "to grasp", "paper"]
    lines = []
    for setting, rows in results.rows.items():
        for count in results.counts():
            own = [row for row in rows if count in (None, row.objects)]
            if own:
                paper = results.paper(setting, count) or Figures(None, None, None, None)
                lines.append(_cell_line(setting, objects_text(count), own, paper))
    return table(header, lines)


def _cell_line(setting: Setting, objects: str, rows: Sequence[Row], paper: Figures) -> list[object]:
    rates, errors = rates_of(rows), sum(row.is_error for row in rows)
    return [
        *(setting.recognition, setting.method, actions_text(setting), objects),
        f"{len(rows)}" + (f", {errors} errors" if errors else ""),
        *(_share(rates["found"]), _paper(paper.find), _share(rates["graspable"]), _paper(paper.grasp)),
        *(_share(rates[name]) for name in ("paper_graspable", "retrieved", "drop_free")),
        *(_mean_steps(rows, "found"), _paper(paper.find_steps)),
        *(_mean_steps(rows, "graspable"), _paper(paper.grasp_steps)),
    ]


def _mean_steps(rows: Sequence[Row], goal: str) -> str:
    steps = [step for row in rows if (step := step_of(row, goal)) is not None]
    return f"{sum(steps) / len(steps):.2f}" if steps else "-"


def differences_table(results: Results) -> str:
    """Paired differences of everything from the first value of its factor, over all numbers of objects."""
    lines = []
    for factor, setting, base in results.pairs():
        pairs = paired_rows(results.rows[setting], results.rows[base])
        if not pairs:
            continue
        against = actions_text(base) if factor == "actions" else getattr(base, factor)
        values = [actions_text(setting) if name == "actions" else getattr(setting, name) for name in FACTORS]
        changes = []
        for name in SHARES:
            reached = [(scene_of(a), OUTCOMES[name](a), OUTCOMES[name](b)) for a, b in pairs]
            both = [(scene, a - b) for scene, a, b in reached if a is not None and b is not None]
            changes.append(_change(mean_change(both)))
        for goal in ("found", "graspable"):
            steps = [(scene_of(a), step_of(a, goal), step_of(b, goal)) for a, b in pairs]
            both = [(scene, a - b) for scene, a, b in steps if a is not None and b is not None]
            changes.append(_change(mean_change(both), "{:+.2f}"))
        lines.append([factor, against, *values, len(pairs), *changes])
    header = ["of", "against", *FACTORS, "pairs", *SHARES.values(), "actions to find", "to grasp"]
    return table(header, lines)


def unchosen_table(results: Results) -> str:
    """The rates on those scenes alone that nothing was chosen on; empty where that is all or none of them."""
    lines = []
    for setting, rows in results.rows.items():
        new = [row for row in rows if not is_chosen_on(row.scenario)]
        if new and len(new) < len(rows):
            rates = rates_of(new)
            values = [actions_text(setting) if name == "actions" else getattr(setting, name) for name in FACTORS]
            lines.append([*values, len(new), *(_share(rates[name]) for name in SHARES)])
    return table([*FACTORS, "episodes", *SHARES.values()], lines) if lines else ""


def difficulty_table(tables: Mapping[str, Results]) -> str:
    """How many scenes are how hard: in which share of their episodes they were solved."""
    groups: dict[tuple[str, str, int], dict[Any, list[bool]]] = {}
    for name, results in tables.items():
        for setting, rows in results.rows.items():
            for row in rows:
                scenes = groups.setdefault((name, setting.part, row.objects), {})
                solved = row.retrieved if takes_out(row) else row.graspable_step is not None
                scenes.setdefault(scene_of(row), []).append(solved)
    lines = []
    for (name, part, objects), scenes in groups.items():
        counts = collections.Counter(_column(sum(ends) / len(ends)) for ends in scenes.values())
        episodes = sorted({len(ends) for ends in scenes.values()})
        each = f"{episodes[0]}" if len(episodes) == 1 else f"{episodes[0]} to {episodes[-1]}"
        place = (name.replace("table", "Table "), part, objects, len(scenes), each)
        lines.append([*place, *(counts[column] for column in DIFFICULTY)])
    return table(["table", "of", "objects", "scenes", "episodes of each", *DIFFICULTY], lines)


def _column(share: float) -> str:
    return next(column for column, largest in DIFFICULTY.items() if share <= largest)


def findings(tables: Mapping[str, Results]) -> list[dict[str, Any]]:
    """The paper's findings in order, with a line for each preset, protocol and recognition of which there are rows."""
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
    form = "{:+.2f} actions" if finding.quantity.endswith("steps") else "{:+.3f}"
    low, high = (form.split(" ")[0].format(bound) for bound in verdict.change.interval)
    paper = NOT_IN_THE_PAPER if verdict.paper is None else f"{form.split(' ')[0].format(verdict.paper)} in the paper"
    bold = f"**{verdict.verdict}**" if verdict.verdict == HOLDS else f"*{verdict.verdict}*"
    count = "pairs" if finding.factor != "table" else "episodes with boxes"
    return (
        f"{verdict.part}, `{verdict.recognition}`: {bold}, {verdict.goal} {form.format(verdict.change.value)} "
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
    environment.globals |= {
        function.__name__: function
        for function in (parts_of, cells_table, differences_table, unchosen_table, difficulty_table, scenes_table)
    }
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    return template.render(
        runs=runs_table([run for run in runs if run.name in names], tables) if names else "",
        tables=tables,
        all_tables=TABLES,
        findings=findings(tables),
        chosen_on=CHOSEN_ON,
        margin=f"{MARGIN:.2f}",
    )


def main(arguments: Iterable[str] | None = None) -> None:
    """Rewrite the page."""
    parser = argparse.ArgumentParser(description="Write docs/reproduction.md from the stored runs.")
    parser.add_argument("--runs", default=str(RUNS), help="folder of the stored runs")
    parser.add_argument("--out", default="docs/reproduction.md", help="the page")
    parsed = parser.parse_args(None if arguments is None else list(arguments))
    try:
        text = page(parsed.runs)
        with replacing(parsed.out) as file:
            file.write(text.encode())
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
