"""The paper's tables from rows: rates, steps and paired differences with 95% intervals, beside the paper's figures."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from rich.console import Group
from rich.table import Table

from mechsearch_jax.benchmarks.paper.paper_tables import BOTH, Figures, PaperTable, paper_figures
from mechsearch_jax.benchmarks.running.evaluate import Job
from mechsearch_jax.benchmarks.statistics.intervals import RESAMPLES, SEED, share_interval
from mechsearch_jax.benchmarks.statistics.rates import says, scene_of, step_of
from mechsearch_jax.benchmarks.store.rows import Row
from mechsearch_jax.runtime.files import PathLike, check_writable, replacing

# What cells differ in, and in the words of tables. Differences are told against the first value of each.
FACTORS = {
    "method": "method",
    "recognition": "recognition",
    "actions": "actions",
    "preset": "preset",
    "protocol": "protocol",
}
# What the paper calls the goals, and what rows do.
GOALS = {"find": "found", "grasp": "graspable"}
Interval = tuple[float, float]


class Setting(NamedTuple):
    """What episodes of a cell run with; fields as `FACTORS`."""

    method: str
    recognition: str
    actions: tuple[str, ...]
    preset: str
    protocol: str


class Mean(NamedTuple):
    """A mean with its 95% interval, of so many; None and (None, None) of none."""

    value: float | None
    interval: tuple[float | None, float | None]
    count: int


_UNKNOWN = Mean(None, (None, None), 0)


@dataclasses.dataclass(frozen=True)
class Cell:
    """A cell of a table.

    Attributes:
      setting: what its episodes ran with.
      objects: number of surrounding objects; None for all.
      episodes: how many there are.
      errors: how many of them could not be run to their end; they count as failures.
      find, grasp: share of the episodes in which the target was found, and found and graspable, with the interval of
        `share_interval`; no value of what rows of an earlier version do not say.
      find_steps, grasp_steps: number of actions until then, of the episodes that got there; bootstrapped over scenes.
      paper: what the paper says; None where nothing.
    """

    setting: Setting
    objects: int | None
    episodes: int
    errors: int
    find: Mean
    grasp: Mean
    find_steps: Mean
    grasp_steps: Mean
    paper: Figures | None


@dataclasses.dataclass(frozen=True)
class Difference:
    """How two settings differ that are the same but for one factor, over the same scenes and seeds.

    Attributes:
      factor: one of `FACTORS`.
      setting: the one; `base` is the value of the factor in the other.
      objects: number of surrounding objects; None for all.
      pairs: how many episodes both have.
      find, grasp: how much larger the shares are.
      find_steps, grasp_steps: how many actions more it took, where both got there. All are bootstrapped over scenes.
    """

    factor: str
    setting: Setting
    base: Any
    objects: int | None
    pairs: int
    find: Mean
    grasp: Mean
    find_steps: Mean
    grasp_steps: Mean


def bootstrap(total: Float[np.ndarray, " n"], count: Float[np.ndarray, " n"]) -> Mean:
    """A mean over clusters, and its 95% interval from resampling whole clusters (percentiles; the same every time).

    Args:
      total, count: of each cluster, the sum of its values and their number.
    """
    n = int(count.sum())
    if n == 0:
        return _UNKNOWN
    rng = np.random.default_rng(SEED)
    drawn = rng.multinomial(len(total), np.full(len(total), 1.0 / len(total)), size=RESAMPLES)
    totals, counts = drawn @ total, drawn @ count
    low, high = np.percentile(totals[counts > 0] / counts[counts > 0], [2.5, 97.5])
    return Mean(float(total.sum() / n), (float(low), float(high)), n)


def _by_scene(values: Sequence[tuple[str, float]]) -> Mean:
    """The mean of values that belong to scenes, bootstrapped over these."""
    scenes: dict[str, list[float]] = {}
    for scene, value in values:
        scenes.setdefault(scene, []).append(value)
    sums = np.array([sum(own) for own in scenes.values()])
    return bootstrap(sums, np.array([len(own) for own in scenes.values()], float))


def _cell(setting: Setting, objects: int | None, rows: Sequence[Row], paper: Figures | None) -> Cell:
    n, told = len(rows), {}
    for goal, said in GOALS.items():
        known = all(says(row, said) for row in rows)
        reached = [step_of(row, said) is not None for row in rows]
        steps = [(row.scenario, float(s)) for row in rows if (s := step_of(row, said)) is not None]
        share = Mean(sum(reached) / n, share_interval(reached, list(map(scene_of, rows))), n)
        told[goal] = share if known else _UNKNOWN
        told[f"{goal}_steps"] = _by_scene(steps) if known else _UNKNOWN
    return Cell(setting, objects, n, sum(row.is_error for row in rows), **told, paper=paper)


class Results(NamedTuple):
    """The rows of an experiment by what they ran with."""

    table: PaperTable
    rows: Mapping[Setting, Sequence[Row]]

    def _counts(self) -> list[int | None]:
        counts = sorted({row.objects for rows in self.rows.values() for row in rows})
        return [*counts, None] if len(counts) > 1 else [*counts]

    def cells(self) -> list[Cell]:
        """All cells of which there are rows."""
        found = []
        for setting, rows in self.rows.items():
            for count in self._counts():
                own = [row for row in rows if count in (None, row.objects)]
                paper = None
                if count is not None:
                    paper = paper_figures(self.table, setting.recognition, setting.method, setting.actions, count)
                found += [_cell(setting, count, own, paper)] if own else []
        return found

    def differences(self) -> list[Difference]:
        """How settings differ from those that have the first value of one factor, and all else in common."""
        return [
            _difference(factor, setting, base, count, pairs)
            for factor, setting, base in self._pairs()
            for count in self._counts()
            if (pairs := _paired(self.rows[setting], self.rows[base], count))
        ]

    def _pairs(self) -> Iterator[tuple[str, Setting, Setting]]:
        for factor in FACTORS:
            values = list(dict.fromkeys(getattr(setting, factor) for setting in self.rows))
            for setting in self.rows:
                base = setting._replace(**{factor: values[0]})
                if base != setting and base in self.rows:
                    yield factor, setting, base


def _paired(rows: Sequence[Row], base: Sequence[Row], objects: int | None) -> list[tuple[Row, Row]]:
    """The same episodes in both."""

    def named(row: Row) -> tuple[str, str | None, int]:
        return row.scenario, row.content_hash, row.seed

    known = {named(row): row for row in base}
    return [(row, known[named(row)]) for row in rows if named(row) in known and objects in (None, row.objects)]


def _difference(
    factor: str, setting: Setting, base: Setting, objects: int | None, pairs: Sequence[tuple[Row, Row]]
) -> Difference:
    told = {}
    for goal, said in GOALS.items():
        if not all(says(row, said) for pair in pairs for row in pair):
            told |= {goal: _UNKNOWN, f"{goal}_steps": _UNKNOWN}
            continue
        steps = [(row.scenario, step_of(row, said), step_of(other, said)) for row, other in pairs]
        told[goal] = _by_scene([(scene, float(a is not None) - float(b is not None)) for scene, a, b in steps])
        told[f"{goal}_steps"] = _by_scene(
            [(scene, float(a - b)) for scene, a, b in steps if a is not None and b is not None]
        )
    return Difference(factor, setting, getattr(base, factor), objects, len(pairs), **told)


def results_of(table: PaperTable, jobs: Mapping[Setting, Sequence[Job]], rows: Mapping[str, Row]) -> Results:
    """The rows of the jobs that have one.

    Args:
      table: the experiment.
      jobs: its episodes.
      rows: by `Job.key`.
    """
    found = {setting: [rows[job.key] for job in own if job.key in rows] for setting, own in jobs.items()}
    return Results(table, {setting: own for setting, own in found.items() if own})


def _told(mean: Mean, form: str) -> str:
    if mean.value is None:
        return "-"
    return f"{form.format(mean.value)} ({' to '.join(form.format(bound) for bound in mean.interval)})"


def _actions(setting: Setting) -> str:
    return "both" if setting.actions == BOTH else "+".join(setting.actions)


def _objects(count: int | None) -> str:
    return "all" if count is None else str(count)


COLUMNS = (
    *("recognition", "method", "actions", "objects", "episodes", "find", "paper", "grasp", "paper"),
    *("steps to find", "paper", "steps to grasp", "paper"),
)


def _line(cell: Cell) -> list[str]:
    paper = cell.paper or Figures(None, None, None, None)
    told = [cell.setting.recognition, cell.setting.method, _actions(cell.setting), _objects(cell.objects)]
    told.append(f"{cell.episodes}" + (f", {cell.errors} errors" if cell.errors else ""))
    for name in Figures._fields:
        figure = getattr(paper, name)
        told += [_told(getattr(cell, name), "{:.2f}" if "steps" in name else "{:.3f}"), f"{figure or '-'}"]
    return told


def _parts(cells: Sequence[Cell]) -> dict[tuple[str, str], list[Cell]]:
    """Cells by preset and protocol."""
    parts: dict[tuple[str, str], list[Cell]] = {}
    for cell in cells:
        parts.setdefault((cell.setting.preset, cell.setting.protocol), []).append(cell)
    return parts


def screen(results: Results) -> Group:
    """The tables as they are printed, ours and the paper's figures without intervals: one for each preset, protocol and
    set of actions."""
    parts: dict[tuple[str, str, str], list[Cell]] = {}
    for cell in results.cells():
        parts.setdefault((cell.setting.preset, cell.setting.protocol, _actions(cell.setting)), []).append(cell)
    tables = []
    for (preset, protocol, actions), cells in parts.items():
        only = "" if len(results.table.actions) == 1 else f", actions {actions}"
        title = f"\n{results.table.name}, preset {preset}, protocol {protocol}{only}: here/in the paper"
        table = Table(
            box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold", title=title, title_justify="left"
        )
        table.add_column("", no_wrap=True)
        for name in ("objects", "runs", "find", "grasp", "to find", "to grasp"):
            table.add_column(name, justify="right", no_wrap=True)
        for cell in cells:
            name = f"{cell.setting.recognition} {cell.setting.method}"
            table.add_row(name, _objects(cell.objects), str(cell.episodes), *_beside(cell))
        tables.append(table)
    return Group(*tables)


def _beside(cell: Cell) -> list[str]:
    """Ours and the paper's figures."""

    def told(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f}"

    paper = cell.paper or Figures(None, None, None, None)
    return [f"{told(getattr(cell, name).value)}/{told(getattr(paper, name))}" for name in Figures._fields]


def _markdown_table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    return ["| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *lines)]


def markdown(results: Results, command: str) -> str:
    """All of it as a page."""
    text = [
        f"# Table {results.table.name.removeprefix('table')} of the paper, in this simulator",
        "",
        f"{results.table.about}. The paper's figures are of scenes of its own, in PyBullet. `{command}`",
        "",
        "Shares of all episodes, with Wilson's 95% interval for as many independent episodes as those of the same",
        "scenes are worth; steps are the mean number of actions in the episodes that got there, with a 95% interval",
        "from resampling scenes. The paper's R stands beside `masks`, its own setting, and `full`.",
    ]
    for (preset, protocol), cells in _parts(results.cells()).items():
        text += ["", f"## Preset {preset}, protocol {protocol}", "", *_markdown_table(COLUMNS, list(map(_line, cells)))]
    text += ["", "## Paired differences", ""]
    text += [
        "Over the same scenes and seeds, with 95% intervals from resampling scenes; steps where both got there.",
        "",
    ]
    header = ["of", "against", *("method", "recognition", "actions", "preset", "protocol"), "objects", "pairs"]
    header += ["find", "grasp", "steps to find", "steps to grasp"]
    text += _markdown_table(header, list(map(_difference_line, results.differences())))
    return "\n".join(text) + "\n"


def _difference_line(told: Difference) -> list[str]:
    base = told.setting._replace(**{told.factor: told.base})
    name = _actions(base) if told.factor == "actions" else str(told.base)
    setting = [told.setting.method, told.setting.recognition, _actions(told.setting), *told.setting[3:]]
    shares = [_told(getattr(told, goal), "{:+.3f}") for goal in GOALS]
    steps = [_told(getattr(told, f"{goal}_steps"), "{:+.2f}") for goal in GOALS]
    return [FACTORS[told.factor], name, *setting, _objects(told.objects), str(told.pairs), *shares, *steps]


def write_table(results: Results, out: PathLike, command: str) -> list[Path]:
    """Write `NAME.md` and `NAME.json` into a folder; files of these names are replaced.

    Args:
      results: of an experiment.
      out: the folder.
      command: what was typed.

    Raises:
      InputError: the folder cannot be written to.
    """
    check_writable(out)
    rows = [row for own in results.rows.values() for row in own]
    value = {
        "table": results.table.name,
        "command": command,
        "code": sorted({row.code or "unknown" for row in rows}),
        "devices": sorted({row.device or "unknown" for row in rows}),
        "cells": [_flat(cell) for cell in results.cells()],
        "differences": [_flat(told) for told in results.differences()],
    }
    texts = {"md": markdown(results, command), "json": json.dumps(value, indent=1, allow_nan=False) + "\n"}
    files = [Path(out) / f"{results.table.name}.{ending}" for ending in texts]
    for path, text in zip(files, texts.values(), strict=True):
        with replacing(path) as file:
            file.write(text.encode())
    return files


def _flat(told: Cell | Difference) -> dict[str, Any]:
    """As JSON has it: tuples with names are objects."""

    def plain(value: Any) -> Any:
        return {name: plain(part) for name, part in value._asdict().items()} if hasattr(value, "_asdict") else value

    return {field.name: plain(getattr(told, field.name)) for field in dataclasses.fields(told)}
