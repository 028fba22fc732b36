"""The paper's tables from rows: rates, steps and paired differences with 95% intervals, beside the paper's figures."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Group
from rich.table import Table

from mechsearch_jax.benchmarks.paper.paper_tables import BOTH, Figures, PaperTable, paper_figures
from mechsearch_jax.benchmarks.running.evaluate import Job
from mechsearch_jax.benchmarks.statistics.intervals import Interval, with_interval
from mechsearch_jax.benchmarks.statistics.paired import reached_change, same_episodes, steps_change
from mechsearch_jax.benchmarks.statistics.rates import Rates, summarise
from mechsearch_jax.benchmarks.store.rows import EpisodeRow, options_of
from mechsearch_jax.runtime.files import PathLike, check_writable, replacing

# What cells differ in. Differences are from the first value of each.
FACTORS = ("method", "recognition", "actions", "preset", "grasps")
# Grasps that take the target out: any that is tried out first, or only those that touch nothing, the paper's; and the
# option that says so.
ANY, COLLISION_FREE, CONTACT = "any", "collision-free", "retrieval_contact"
# In place of a figure.
NOT_IN_THE_PAPER = "not in the paper"
# What the paper calls the goals, and what rows do.
GOALS = {"find": "found", "grasp": "graspable"}


class Setting(NamedTuple):
    """What episodes of a cell run with; fields as `FACTORS`."""

    method: str
    recognition: str
    actions: tuple[str, ...]
    preset: str
    grasps: str = ANY

    @property
    def part(self) -> str:
        """What the cells of one part of a table have in common."""
        grasps = "" if self.grasps == ANY else f", {self.grasps} grasps"
        return f"preset {self.preset}{grasps}"


class Mean(NamedTuple):
    """A mean with its 95% interval, of so many values; None where it is not known."""

    value: float | None
    interval: Interval | tuple[None, None]
    count: int

    @classmethod
    def of(cls, value: float | None, interval: Interval | None, count: int) -> Mean:
        """The mean; without an interval where there is no value."""
        return cls(value, (None, None) if value is None or interval is None else interval, count)


@dataclasses.dataclass(frozen=True)
class Cell:
    """A cell of a table.

    Attributes:
      setting: what its episodes ran with.
      objects: number of surrounding objects; None for all.
      episodes: how many there are.
      errors: how many of them could not be run to their end; they count as failures.
      find, grasp: share of the episodes in which the target was found, and found and graspable.
      find_steps, grasp_steps: number of actions until then, of the episodes that got there.
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
      setting: of the first; `base` is the value of the factor in the other.
      objects: number of surrounding objects; None for all.
      pairs: how many episodes both have.
      find, grasp: how much larger the shares are: see `PairedDifference`.
      find_steps, grasp_steps: how many actions more it took, where both got there.
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


def _cell(setting: Setting, objects: int | None, rates: Rates, paper: Figures | None) -> Cell:
    means = {}
    for name, goal in GOALS.items():
        share, steps = getattr(rates, goal), getattr(rates, f"{goal}_steps")
        means[name] = Mean.of(share, getattr(rates, f"{goal}_interval"), rates.episodes)
        reached = round(share * rates.episodes)
        means[f"{name}_steps"] = Mean.of(steps, getattr(rates, f"{goal}_steps_interval"), reached)
    return Cell(setting, objects, rates.episodes, rates.errors, **means, paper=paper)


def origin_of(row: EpisodeRow) -> tuple[str | None, str | None]:
    """The code and the simulator that an episode ran with."""
    return row.code, options_of(row).get("simulator")


def ran_alike(rows: Sequence[EpisodeRow], base: Sequence[EpisodeRow]) -> bool:
    """Whether two settings differ in nothing but themselves: not in the code or the simulator, too."""
    return origin_of(rows[0]) == origin_of(base[0])


class Results(NamedTuple):
    """The rows of an experiment by what they ran with; those of a setting have their code and simulator in common."""

    table: PaperTable
    rows: Mapping[Setting, Sequence[EpisodeRow]]

    def counts(self) -> list[int | None]:
        """The numbers of objects in the rows, and None for all of them if there are several."""
        counts = sorted({row.objects for rows in self.rows.values() for row in rows})
        return [*counts, None] if len(counts) > 1 else [*counts]

    def cells(self) -> list[Cell]:
        """All cells of which there are rows."""
        cells = []
        for setting, rows in self.rows.items():
            rates = {group.group["objects"]: group for group in summarise(rows, ["objects"])}
            for count in self.counts():
                cells += [_cell(setting, count, rates[count], self.paper(setting, count))] if count in rates else []
        return cells

    def paper(self, setting: Setting, objects: int | None) -> Figures | None:
        """What the paper says of a cell; None where nothing, as of all numbers of objects together."""
        if objects is None:
            return None
        return paper_figures(self.table, setting.recognition, setting.method, setting.actions, objects)

    def differences(self) -> list[Difference]:
        """How settings differ from those that have the first value of one factor, and all else in common."""
        return [
            _difference(factor, setting, base, count, pairs)
            for factor, setting, base in self.pairs()
            for count in self.counts()
            if (pairs := same_episodes(self.rows[setting], self.rows[base], count))
        ]

    def pairs(self) -> Iterator[tuple[str, Setting, Setting]]:
        """Each factor, with a setting and the one that has the factor's first value and all else in common."""
        for factor in FACTORS:
            values = list(dict.fromkeys(getattr(setting, factor) for setting in self.rows))
            for setting in self.rows:
                base = setting._replace(**{factor: values[0]})
                if base != setting and base in self.rows and ran_alike(self.rows[setting], self.rows[base]):
                    yield factor, setting, base


def _difference(
    factor: str, setting: Setting, base: Setting, objects: int | None, pairs: Sequence[tuple[EpisodeRow, EpisodeRow]]
) -> Difference:
    means = {}
    for name, goal in GOALS.items():
        for field, change in ((name, reached_change(pairs, goal)), (f"{name}_steps", steps_change(pairs, goal))):
            means[field] = Mean.of(change.mean, change.interval, change.pairs)
    return Difference(factor, setting, getattr(base, factor), objects, len(pairs), **means)


def results_of(table: PaperTable, jobs: Mapping[Setting, Sequence[Job]], rows: Mapping[str, EpisodeRow]) -> Results:
    """The rows of the jobs that have one.

    Args:
      table: the experiment.
      jobs: its episodes.
      rows: by `Job.key`.
    """
    ended = {setting: [rows[job.key] for job in own if job.key in rows] for setting, own in jobs.items()}
    return Results(table, {setting: own for setting, own in ended.items() if own})


def actions_text(setting: Setting) -> str:
    """The allowed actions in a table."""
    return "both" if setting.actions == BOTH else "+".join(setting.actions)


def objects_text(count: int | None) -> str:
    """The number of objects in a table."""
    return "all" if count is None else str(count)


CELL_COLUMNS = (
    *("recognition", "method", "actions", "objects", "episodes", "found", "paper", "graspable", "paper"),
    *("actions to find", "paper", "to grasp", "paper"),
)
DIFFERENCE_COLUMNS = (
    *("factor", "base", *FACTORS, "objects", "pairs"),
    *("found", "graspable", "actions to find", "to grasp"),
)


def _cell_line(cell: Cell) -> list[str]:
    paper = cell.paper or Figures(None, None, None, None)
    line = [cell.setting.recognition, cell.setting.method, actions_text(cell.setting), objects_text(cell.objects)]
    line.append(f"{cell.episodes}" + (f", {cell.errors} errors" if cell.errors else ""))
    for name in Figures._fields:
        form = "{:.2f}" if "steps" in name else "{:.3f}"
        mean = getattr(cell, name)
        line += [with_interval(mean.value, mean.interval, form), f"{getattr(paper, name) or NOT_IN_THE_PAPER}"]
    return line


def _difference_line(difference: Difference) -> list[str]:
    base = difference.setting._replace(**{difference.factor: difference.base})
    against = actions_text(base) if difference.factor == "actions" else str(difference.base)
    setting = difference.setting
    line = [difference.factor, against, setting.method, setting.recognition, actions_text(setting), *setting[3:]]
    means = [(getattr(difference, goal), "{:+.3f}") for goal in GOALS]
    means += [(getattr(difference, f"{goal}_steps"), "{:+.2f}") for goal in GOALS]
    changes = [with_interval(mean.value, mean.interval, form) for mean, form in means]
    return [*line, objects_text(difference.objects), str(difference.pairs), *changes]


def screen(results: Results) -> Group:
    """The tables as they are printed, ours and the paper's figures without intervals: one for each preset and set of
    actions."""
    parts: dict[tuple[str, str], list[Cell]] = {}
    for cell in results.cells():
        parts.setdefault((cell.setting.part, actions_text(cell.setting)), []).append(cell)
    tables = []
    for (part, actions), cells in parts.items():
        only = "" if len(results.table.actions) == 1 else f", actions {actions}"
        title = f"\n{results.table.name}, {part}{only}: here/in the paper (none: {NOT_IN_THE_PAPER})"
        table = Table(
            box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold", title=title, title_justify="left"
        )
        table.add_column("", no_wrap=True)
        for name in ("objects", "episodes", "found", "graspable", "to find", "to grasp"):
            table.add_column(name, justify="right", no_wrap=True)
        for cell in cells:
            name = f"{cell.setting.recognition} {cell.setting.method}"
            table.add_row(name, objects_text(cell.objects), str(cell.episodes), *_beside(cell))
        tables.append(table)
    return Group(*tables)


def _beside(cell: Cell) -> list[str]:
    """Ours and the paper's figures."""

    def text(value: float | None, otherwise: str) -> str:
        return otherwise if value is None else f"{value:.2f}"

    paper = cell.paper or Figures(None, None, None, None)
    return [f"{text(getattr(cell, name).value, '-')}/{text(getattr(paper, name), 'none')}" for name in Figures._fields]


def markdown(results: Results, command: str) -> str:
    """All of it as a page."""
    from mechsearch_jax.benchmarks.pages import pages

    page: list[pages.Block] = [
        pages.Heading(f"Table {results.table.name.removeprefix('table')} of the paper, in this simulator", 1),
        pages.Paragraph(
            f"{results.table.about}. The paper's figures are of scenes of its own, in PyBullet. `{command}`"
        ),
        pages.Paragraph(
            "Shares of all episodes, with Wilson's 95% interval for as many independent episodes as those of the same "
            "scenes are worth; numbers of actions are means over the episodes that got there, with a 95% interval from "
            "resampling scenes (-: none got there). The paper's R stands beside `masks`, its setting, "
            "and `full`."
        ),
    ]
    parts: dict[str, list[Cell]] = {}
    for cell in results.cells():
        parts.setdefault(cell.setting.part, []).append(cell)
    for part, cells in parts.items():
        lines = list(map(_cell_line, cells))
        page += [pages.Heading(part.capitalize()), pages.Table.of(CELL_COLUMNS, lines, texts=3)]
    lines = list(map(_difference_line, results.differences()))
    page += [
        pages.Heading("Paired differences"),
        pages.Paragraph(
            "Over the same scenes and seeds, a scene's seeds averaged first, with 95% intervals from resampling "
            "scenes; numbers of actions where both got there. Of the same code and simulator alone."
        ),
        pages.Table.of(DIFFERENCE_COLUMNS, lines, texts=8),
    ]
    return pages.as_markdown(page)


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
        "differences": [_flat(difference) for difference in results.differences()],
    }
    texts = {"md": markdown(results, command), "json": json.dumps(value, indent=1, allow_nan=False) + "\n"}
    files = [Path(out) / f"{results.table.name}.{ending}" for ending in texts]
    for path, text in zip(files, texts.values(), strict=True):
        with replacing(path) as file:
            file.write(text.encode())
    return files


def _flat(record: Cell | Difference) -> dict[str, Any]:
    """As JSON has it: tuples with names are objects."""

    def plain(value: Any) -> Any:
        return {name: plain(part) for name, part in value._asdict().items()} if hasattr(value, "_asdict") else value

    return {field.name: plain(getattr(record, field.name)) for field in dataclasses.fields(record)}
