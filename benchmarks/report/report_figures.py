"""The pictures of a report: success over the number of actions, rates of all variants, rates over a column."""

from __future__ import annotations

import collections
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from mechsearch_jax.benchmarks.statistics.actions_until import reached
from mechsearch_jax.benchmarks.statistics.intervals import share_interval
from mechsearch_jax.benchmarks.statistics.rates import GOALS, Rates, scene_of, step_of, summarise
from mechsearch_jax.benchmarks.statistics.variants import Key, canonical, label_variants, natural
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.viz.drawing import INK, MUTED

# Told apart without colour vision too (Okabe and Ito).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
# More curves than colours cannot be told apart: the best and the worst are drawn in colour, the others in grey.
BEST, WORST = 3, 1
# So many curves can still be told apart by a scale of colours.
MOST_CURVES = 20
# Inches that a variant takes on an axis, and what a picture of them is at least and at most wide.
EACH, NARROWEST, WIDEST = 0.13, 6.0, 14.0


def _plain(axes: Axes) -> None:
    axes.grid(color=MUTED, alpha=0.2)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK, labelsize=8)


def _curve(axes: Axes, rows: Sequence[EpisodeRow], goal: str, actions: int, colour: str, label: str) -> None:
    counts = reached(rows, goal, actions)
    x, after, scenes = np.arange(actions + 1), [step_of(row, goal) for row in rows], list(map(scene_of, rows))
    low, high = np.array(
        [share_interval([step is not None and step <= k for step in after], scenes) for k in x.tolist()]
    ).T
    axes.fill_between(x, low, high, color=colour, alpha=0.12, linewidth=0)
    axes.plot(x, np.array(counts) / len(rows), color=colour, marker="o", markersize=3, label=label)


def shown_variants(rows: Sequence[EpisodeRow], key: Key, baseline: str | None = None) -> dict[str, str]:
    """Variants that are drawn in colour, with their label in the legend: all, or if they are too many, the baseline,
    the best and the worst."""
    if len(key.short) <= len(COLOURS):
        return dict(key.short)
    won, all_of = collections.Counter(), collections.Counter()
    for label, row in zip(label_variants(rows), rows, strict=True):
        all_of[label] += 1
        won[label] += row.retrieved
    ranked = sorted(key.short, key=lambda label: -won[label] / all_of[label])
    named = {label: f"{key.short[label]}, {place} of {len(ranked)}" for place, label in enumerate(ranked, start=1)}
    chosen = [*([baseline] if baseline else []), *ranked[:BEST], *ranked[-WORST:]]
    return {label: named[label] for label in dict.fromkeys(chosen)}


def success_figure(rows: Sequence[EpisodeRow], baseline: str | None = None) -> Figure:
    """Share of episodes that reached each goal over the number of actions: a column for each number of objects.

    Where these are several, a last column has all of them together.
    """
    key = Key.of(rows)
    groups: dict[tuple[str, int], list[EpisodeRow]] = {}
    for row, label in zip(rows, label_variants(rows), strict=True):
        groups.setdefault((label, row.objects), []).append(row)
    shown, objects = shown_variants(rows, key, baseline), sorted({objects for _, objects in groups})
    columns: list[int | None] = [*objects, None] if objects[1:] else [*objects]
    actions = max(max(row.steps for row in rows), 1)
    size = (2.6 * len(columns) + 1.2, 2.2 * len(GOALS) + 0.9 + 0.2 * len(shown))
    figure = Figure(figsize=(max(size[0], NARROWEST), size[1]), layout="constrained")
    grid = figure.subplots(len(GOALS), len(columns), sharex=True, sharey=True, squeeze=False)
    for i, (goal, title) in enumerate(GOALS.items()):
        for j, count in enumerate(columns):
            axes: Axes = grid[i][j]
            # Not found out anew for every one of a hundred curves.
            axes.set(xlim=(-0.05 * actions, 1.05 * actions), ylim=(-0.03, 1.03))
            curves = _curves(groups, count)
            for label in key.short:
                if label not in shown and (group := curves.get(label)):
                    share = np.array(reached(group, goal, actions)) / len(group)
                    axes.plot(range(actions + 1), share, color=MUTED, alpha=0.25, linewidth=0.7)
            for colour, (label, short) in zip(COLOURS, shown.items(), strict=False):
                if group := curves.get(label):
                    _curve(axes, group, goal, actions, colour, short)
            _plain(axes)
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            if i == 0:
                axes.set_title(
                    "all" if count is None else f"{count} object{'' if count == 1 else 's'}", fontsize=10, color=INK
                )
            if i == len(GOALS) - 1:
                axes.set_xlabel("actions", fontsize=9, color=INK)
            if j == 0:
                axes.set_ylabel(f"share {title}", fontsize=9, color=INK)
    _legend(figure, grid, list(shown.values()))
    return figure


def _curves(groups: Mapping[tuple[str, int], Sequence[EpisodeRow]], objects: int | None) -> dict[str, list[EpisodeRow]]:
    """The rows of each variant with so many objects, by its label; all rows if None."""
    curves: dict[str, list[EpisodeRow]] = {}
    for (label, count), rows in groups.items():
        if objects in (None, count):
            curves.setdefault(label, []).extend(rows)
    return curves


def _legend(figure: Figure, grid: Any, labels: Sequence[str], title: str = "") -> None:
    handles = {line.get_label(): line for axes in grid.flat for line in axes.get_lines()}
    columns = 1 if max(map(len, labels)) > 40 else min(len(labels), 4)
    shown = [handles[label] for label in labels]
    figure.legend(
        shown, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=8, title=title or None
    )


def rates_figure(summary: Sequence[Rates], key: Key) -> Figure:
    """The rates of every variant over all numbers of objects with their intervals, the best first.

    Args:
      summary: as `summarise` has it by variant and number of objects.
      key: of the variants.
    """
    ranked = sorted((rates for rates in summary if rates.objects is None), key=lambda rates: -rates.retrieved)
    x, few = np.arange(len(ranked)), len(ranked) <= len(COLOURS)
    # Few are best compared with each goal beside the next, many beneath it.
    shape = (1, len(GOALS)) if few else (len(GOALS), 1)
    width = float(np.clip(EACH * len(ranked) + 1.0, 1.5 * NARROWEST if few else NARROWEST, WIDEST))
    figure = Figure(figsize=(width, 3.2 if few else 2.0 * len(GOALS) + 0.8), layout="constrained")
    grid = figure.subplots(*shape, sharex=True, sharey=few, squeeze=False)
    for axes, colour, (goal, title) in zip(grid.flat, COLOURS, GOALS.items(), strict=False):
        share, low, high = _drawn(ranked, goal)
        axes.vlines(x, low, high, color=colour, alpha=0.45, linewidth=2)
        axes.plot(x, share, "o", color=colour, markersize=3.5)
        _plain(axes)
        axes.set_ylabel(f"share {title}", fontsize=9, color=INK)
    labels = [key.short[str(rates.method)] for rates in ranked]
    turned = {"rotation": 25, "ha": "right", "fontsize": 8} if few else {"rotation": 90, "fontsize": 6}
    for axes in grid[-1]:
        axes.set_xticks(x, labels, **turned)
        axes.set_xlim(-0.6, len(ranked) - 0.4)
    return figure


def _drawn(rates: Sequence[Rates], goal: str) -> np.ndarray:
    """Shares with their lower and upper bounds, shape (3, n)."""
    shares = [(getattr(group, goal), *getattr(group, f"{goal}_interval")) for group in rates]
    return np.array(shares).T


def curve_rates(rows: Sequence[EpisodeRow], columns: Sequence[str]) -> list[Rates]:
    """Rates over the first column, for each value of the second one, if there are two.

    Raises:
      InputError: there are not one or two columns, there is none of a name, or too many values of the second one.
    """
    names = [canonical(name) for name in columns]
    if not 1 <= len(names) <= 2:
        raise InputError(f"report: --curve {' '.join(columns)}: give one column, or a second one for a line each")
    points = [rates for rates in summarise(rows, names[::-1]) if rates.group[names[0]] is not None]
    lines = {rates.group[name] for rates in points for name in names[1:]}
    if len(lines) > MOST_CURVES:
        raise InputError(f"report: {names[1]} has {len(lines)} values; --curve draws at most {MOST_CURVES} lines")
    return points


def curve_figure(points: Sequence[Rates], columns: Sequence[str], short: Mapping[str, str]) -> Figure:
    """Rates over a column, with their intervals: a panel for each goal, a line for each value of the second column.

    Args:
      points: of `curve_rates`.
      columns: one or two.
      short: labels for values that have them.
    """
    first, *second = map(canonical, columns)
    values = sorted({rates.group[first] for rates in points}, key=natural)
    numeric = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    places = {value: float(str(value)) if numeric else float(i) for i, value in enumerate(values)}
    lines: dict[Hashable, list[Rates]] = {}
    for rates in points:
        lines.setdefault(rates.group[second[0]] if second else "all", []).append(rates)
    colours = COLOURS
    if len(lines) > len(COLOURS):
        scale = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.95, len(lines)))
        colours = tuple(to_hex(colour) for colour in scale)
    width = float(np.clip(0.35 * len(values), 3.4, 6.0))
    legend = 0.25 * -(-len(lines) // 4) + 0.3 if second else 0.0
    figure = Figure(figsize=(width * len(GOALS), 3.4 + legend), layout="constrained")
    grid = figure.subplots(1, len(GOALS), sharey=True, squeeze=False)
    for axes, (goal, title) in zip(grid.flat, GOALS.items(), strict=True):
        for colour, (line, members) in zip(colours, lines.items(), strict=False):
            x = [places[rates.group[first]] for rates in members]
            share, low, high = _drawn(members, goal)
            axes.fill_between(x, low, high, color=colour, alpha=0.12, linewidth=0)
            axes.plot(x, share, color=colour, marker="o", markersize=3, label=short.get(str(line), str(line)))
        _plain(axes)
        axes.set_title(title, fontsize=10, color=INK)
        axes.set_xlabel(first.replace("_", " "), fontsize=9, color=INK)
        if not numeric:
            ticks = [short.get(str(value), str(value)) for value in values]
            axes.set_xticks([places[value] for value in values], ticks, rotation=30 if len(ticks) > 3 else 0)
    grid[0][0].set_ylabel("share", fontsize=9, color=INK)
    if second:
        _legend(figure, grid, [short.get(str(line), str(line)) for line in lines], second[0].replace("_", " "))
    return figure
