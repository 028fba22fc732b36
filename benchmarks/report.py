"""What results say: tables with confidence intervals, failure reasons, and success over the number of actions."""

from __future__ import annotations

import collections
import csv
import dataclasses
import io
import itertools
import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from mechsearch_jax.benchmarks.rates import EVENTS, Events, Rates, summarise, summarise_events, wilson
from mechsearch_jax.benchmarks.rows import Row, identity, label_variants
from mechsearch_jax.benchmarks.shards import result_tables
from mechsearch_jax.errors import InputError
from mechsearch_jax.files import PathLike, check_writable, replacing
from mechsearch_jax.viz.drawing import INK, MUTED, save_figure

# What a report consists of.
FILES = ("report.md", "rates.csv", "rates.json", "failures.csv", "events.csv", "success.png")
# Which action it was is no reason of its own.
_WHICH_ACTION = re.compile(r" at action \d+$")
GOALS = {"found": "found", "graspable": "found and graspable", "retrieved": "retrieved"}
# The shares in `Rates` that a report lists, in its words.
SHARES = {
    "found": "found",
    "graspable": "graspable",
    "paper_graspable": "with the paper's grasps",
    "retrieved": "retrieved",
}
# Told apart without colour vision too (Okabe and Ito).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")


def read_tables(paths: Sequence[PathLike]) -> list[Row]:
    """The rows of several results of `evaluate`: folders, folders of them, and Parquet files.

    Raises:
      InputError: one holds no such results, an episode is in two tables, or there is none at all.
    """
    rows: list[Row] = []
    origin: dict[tuple, PathLike] = {}
    for path in paths:
        for table, found in result_tables(path):
            for row in found:
                if (other := origin.setdefault(identity(row), table)) is not table:
                    raise InputError(
                        f"{table}: holds scenario {row.scenario!r}, seed {row.seed}, with the same options as {other}; "
                        "report them one by one"
                    )
            rows += found
    if not rows:
        raise InputError("report: there are no episodes in these tables")
    return rows


def step_of(row: Row, goal: str) -> int | None:
    """Number of actions after which an episode reached "found", "graspable" or "retrieved"; None if it never did."""
    if goal == "retrieved":
        return row.steps if row.retrieved else None
    return row.found_step if goal == "found" else row.graspable_step


def reached(rows: Sequence[Row], goal: str, actions: int) -> list[int]:
    """How many episodes had reached a goal after 0, 1, ..., `actions` actions."""
    after = collections.Counter(step_of(row, goal) for row in rows)
    return list(itertools.accumulate(after[k] for k in range(actions + 1)))


def changed_scenarios(rows: Sequence[Row]) -> list[str]:
    """Names under which rows hold more than one content, or one and an unknown: their files were changed in between."""
    contents: dict[str, set[str | None]] = {}
    for row in rows:
        contents.setdefault(row.scenario, set()).add(row.content_hash)
    return sorted(name for name, hashes in contents.items() if len(hashes) > 1)


def told_of_changes(rows: Sequence[Row]) -> str:
    """A sentence that names scenarios that changed between rows; empty if there are none."""
    names = changed_scenarios(rows)
    if not names:
        return ""
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    named = f"{', '.join(names[:5])}{more}"
    return f"Scenarios whose content is not the same, or not known, in all rows count as several: {named}."


@dataclasses.dataclass(frozen=True)
class Failures:
    """How often episodes ended for a reason.

    Attributes:
      method: with the options that differ, as in `Rates`.
      reason: why there was no retrieval.
      episodes: how many ended so.
      share: of the method's episodes.
    """

    method: str
    reason: str
    episodes: int
    share: float


def failures(rows: Sequence[Row]) -> list[Failures]:
    """Why episodes ended without a retrieval, the most frequent reason first."""
    groups: dict[str, list[Row]] = {}
    for row, label in zip(rows, label_variants(rows), strict=True):
        groups.setdefault(label, []).append(row)
    result = []
    for method, group in sorted(groups.items()):
        told = [row.failure or "unknown" for row in group if not row.retrieved]
        reasons = collections.Counter(_WHICH_ACTION.sub("", reason) for reason in told)
        result += [Failures(method, reason, n, n / len(group)) for reason, n in reasons.most_common()]
    return result


def _share(value: float | None, interval: tuple[float, float]) -> str:
    return "-" if value is None else f"{value:.2f} ({interval[0]:.2f} to {interval[1]:.2f})"


def _objects(rates: Rates | Events) -> str:
    return "all" if rates.objects is None else str(rates.objects)


def _row(cells: Sequence[str]) -> str:
    # A bar would end the cell.
    return "| " + " | ".join(" ".join(cell.replace("|", "\\|").split()) for cell in cells) + " |"


def markdown(
    rows: Sequence[Row], summary: Sequence[Rates], reasons: Sequence[Failures], events: Sequence[Events]
) -> str:
    """The report as text, of the rows and what `summarise`, `failures` and `summarise_events` make of them."""
    names = ("method", "objects", "episodes", "errors", *SHARES.values(), "actions", "planning [s]", "simulation [s]")
    lines = [
        "# Results",
        "",
        f"{len(rows)} episodes. Shares with Wilson's 95% confidence interval; actions are the mean number per episode, "
        "attempts to take the target out among them; times are means per action. An episode that ended in an error of "
        "the program counts as a failure. *With the paper's grasps*: graspable with those alone before the episode "
        "ended, of the episodes that say so.",
        "",
        *([told_of_changes(rows), ""] if changed_scenarios(rows) else []),
        _row(names),
        _row(["---"] * len(names)),
    ]
    for rates in summary:
        cells = [rates.method, _objects(rates), str(rates.episodes), str(rates.errors)]
        cells += [_share(getattr(rates, goal), getattr(rates, f"{goal}_interval")) for goal in SHARES]
        cells += [f"{v:.2f}" for v in (rates.steps, rates.planning_seconds, rates.simulation_seconds)]
        lines.append(_row(cells))
    lines += ["", "## Why episodes failed", ""]
    if reasons:
        lines += [_row(("method", "reason", "episodes", "share")), _row(["---"] * 4)]
        lines += [_row((f.method, f.reason, str(f.episodes), f"{f.share:.2f}")) for f in reasons]
    else:
        lines.append("None did.")
    lines += ["", "## What happened on the way", "", *_events(events)]
    lines += ["", "## Success over the number of actions", "", "![Success over the number of actions](success.png)", ""]
    return "\n".join(lines)


def _events(summary: Sequence[Events]) -> list[str]:
    """What happened on the way, as lines of the report."""
    if not summary:
        return ["These episodes do not say: an earlier version ran them, or they ended in errors."]
    names = ("method", "objects", "episodes", *EVENTS.values())
    lines = [
        "Shares of the episodes that say so; *of all looks* is the share of the steps before the target was found at "
        "which f ruled out its true pose.",
        "",
        _row(names),
        _row(["---"] * len(names)),
    ]
    for events in summary:
        shares = [f"{getattr(events, name):.3f}" for name in EVENTS]
        lines.append(_row([events.method, _objects(events), str(events.episodes), *shares]))
    return lines


def _flat(rates: Rates | Events) -> dict[str, object]:
    """Rates or events with one value a column."""
    flat: dict[str, object] = {}
    for name, value in dataclasses.asdict(rates).items():
        if isinstance(value, tuple):
            goal = name.removesuffix("_interval")
            flat |= {f"{goal}_low": value[0], f"{goal}_high": value[1]}
        else:
            flat[name] = "all" if name == "objects" and value is None else value
    return flat


def _csv(lines: Sequence[dict[str, object]], names: Sequence[str]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def _curve(axes: Axes, rows: Sequence[Row], goal: str, actions: int, colour: str, label: str) -> None:
    counts = reached(rows, goal, actions)
    x = np.arange(actions + 1)
    low, high = np.array([wilson(n, len(rows)) for n in counts]).T
    axes.fill_between(x, low, high, color=colour, alpha=0.12, linewidth=0)
    axes.plot(x, np.array(counts) / len(rows), color=colour, marker="o", markersize=3, label=label)


def success_figure(rows: Sequence[Row]) -> Figure:
    """Share of episodes that reached each goal over the number of actions: a column for each number of objects."""
    groups: dict[tuple[str, int], list[Row]] = {}
    for row, label in zip(rows, label_variants(rows), strict=True):
        groups.setdefault((label, row.objects), []).append(row)
    variants, objects = (sorted(set(values)) for values in zip(*groups, strict=True))
    actions = max(max(row.steps for row in rows), 1)
    size = (2.6 * len(objects) + 1.2, 2.2 * len(GOALS) + 0.9 + 0.2 * len(variants))
    figure = Figure(figsize=(max(size[0], 5.0), size[1]), layout="constrained")
    grid = figure.subplots(len(GOALS), len(objects), sharex=True, sharey=True, squeeze=False)
    for i, (goal, title) in enumerate(GOALS.items()):
        for j, count in enumerate(objects):
            axes: Axes = grid[i][j]
            # Not found out anew for every one of a hundred curves.
            axes.set(xlim=(-0.05 * actions, 1.05 * actions), ylim=(-0.03, 1.03))
            for k, variant in enumerate(variants):
                if group := groups.get((variant, count)):
                    _curve(axes, group, goal, actions, COLOURS[k % len(COLOURS)], variant)
            axes.grid(color=MUTED, alpha=0.2)
            axes.spines[["top", "right"]].set_visible(False)
            axes.tick_params(colors=INK, labelsize=8)
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            if i == 0:
                axes.set_title(f"{count} object{'' if count == 1 else 's'}", fontsize=10, color=INK)
            if i == len(GOALS) - 1:
                axes.set_xlabel("actions", fontsize=9, color=INK)
            if j == 0:
                axes.set_ylabel(f"share {title}", fontsize=9, color=INK)
    handles = {line.get_label(): line for axes in grid.flat for line in axes.get_lines()}
    shown = [handles[variant] for variant in variants]
    figure.legend(shown, variants, loc="outside lower center", ncols=1, frameon=False, fontsize=8)
    return figure


def write_report(rows: Sequence[Row], out: PathLike) -> None:
    """Write a report, the files `FILES`, into a folder.

    Args:
      rows: at least one.
      out: the folder; files of these names are replaced.

    Raises:
      InputError: the folder cannot be written to.
    """
    check_writable(out)
    folder = Path(out)
    figure = success_figure(rows)
    summary, why, happened = summarise(rows), failures(rows), summarise_events(rows)
    flat, events = [_flat(rates) for rates in summary], [_flat(each) for each in happened]
    reasons = [dataclasses.asdict(f) for f in why]
    texts = (
        markdown(rows, summary, why, happened),
        _csv(flat, list(flat[0])),
        json.dumps({"rates": flat, "failures": reasons, "events": events}, indent=1, allow_nan=False) + "\n",
        _csv(reasons, [field.name for field in dataclasses.fields(Failures)]),
        _csv(events, [field.name for field in dataclasses.fields(Events)]),
    )
    *written, picture = (folder / name for name in FILES)
    for path, text in zip(written, texts, strict=True):
        with replacing(path) as file:
            file.write(text.encode())
    save_figure(figure, picture)
