"""The picture of a study: rates along its axis, changes of its variants, or success against planning time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, StrMethodFormatter

from mechsearch_jax.benchmarks.statistics.intervals import Interval
from mechsearch_jax.benchmarks.studies.comparison import Comparison
from mechsearch_jax.benchmarks.studies.studies import Study
from mechsearch_jax.viz.drawing import INK, MUTED

# Told apart without colour vision too (Okabe and Ito).
RETRIEVED, GRASPABLE = "#0072b2", "#d55e00"
COLOURS = {"retrieved": RETRIEVED, "graspable": GRASPABLE}


def picture(study: Study, comparisons: Sequence[Comparison]) -> Figure:
    """The picture of a study.

    Args:
      study: the question.
      comparisons: of `comparison.compare`; at least one.
    """
    if study.by_time:
        return _against_time(comparisons)
    if study.axis is None:
        return _changes(comparisons)
    return _along_axis(study, comparisons)


def _plain(axes: Axes) -> None:
    axes.grid(color=MUTED, alpha=0.2)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK, labelsize=8)


def _bars(means: Sequence[float | None], intervals: Sequence[Interval | None]) -> np.ndarray:
    """Lengths of error bars, shape (2, n); 0 where there is no interval, NaN where there is no mean."""
    bounds = [(mean, mean) if interval is None else interval for mean, interval in zip(means, intervals, strict=True)]
    low, high = np.array(bounds, float).T
    return np.maximum(np.stack([np.array(means, float) - low, high - np.array(means, float)]), 0.0)


def _along_axis(study: Study, comparisons: Sequence[Comparison]) -> Figure:
    figure = Figure(figsize=(4.6, 2.9), layout="constrained")
    axes = figure.subplots()
    by_value = {c.variant.value: c for c in comparisons if c.variant.value is not None}
    x = sorted(by_value)
    placed = [by_value[value] for value in x]
    for name, colour in COLOURS.items():
        means = [c.means[name] for c in placed]
        bars = _bars(means, [c.intervals[name] for c in placed])
        axes.errorbar(
            x,
            np.array(means, float),
            bars,
            color=colour,
            marker="o",
            markersize=4,
            capsize=2,
            linewidth=1.2,
            label=name,
        )
    if study.logarithmic:
        axes.set_xscale("log")
    axes.set_xticks(x, [f"{value:g}" for value in x], minor=False)
    axes.minorticks_off()
    axes.set_xlabel(study.axis or "", fontsize=9, color=INK)
    axes.set_ylabel("share of episodes", fontsize=9, color=INK)
    axes.legend(frameon=False, fontsize=8)
    _plain(axes)
    return figure


def _changes(comparisons: Sequence[Comparison]) -> Figure:
    others = [c for c in comparisons if c.changes]
    figure = Figure(figsize=(5.6, 1.1 + 0.27 * max(len(others), 1)), layout="constrained")
    axes = figure.subplots()
    axes.axvline(0.0, color=INK, linewidth=0.8)
    for offset, (name, colour) in zip((-0.13, 0.13), COLOURS.items(), strict=True):
        changes = [c.changes[name] for c in others]
        means = [math.nan if change.mean is None else 100 * change.mean for change in changes]
        intervals = [change.interval and (100 * change.interval[0], 100 * change.interval[1]) for change in changes]
        y = np.arange(len(others)) + offset
        bars = _bars(means, intervals) if others else None
        axes.errorbar(means, y, xerr=bars, fmt="o", color=colour, markersize=4, capsize=2, linewidth=1.2, label=name)
    axes.set_yticks(np.arange(len(others)), [c.variant.label for c in others])
    axes.set_ylim(max(len(others), 1) - 0.5, -0.5)
    axes.set_xlabel("change of the share of episodes, points", fontsize=9, color=INK)
    figure.legend(frameon=False, fontsize=8, ncols=2, loc="outside upper right")
    _plain(axes)
    return figure


def _against_time(comparisons: Sequence[Comparison]) -> Figure:
    figure = Figure(figsize=(7.4, 3.6), layout="constrained")
    axes = figure.subplots()
    for i, c in enumerate(comparisons, start=1):
        x, y = 1000 * max(c.decision_seconds, 1e-6), c.means["retrieved"]
        if y is None:
            continue
        axes.errorbar(x, y, _bars([y], [c.intervals["retrieved"]]), color=MUTED, capsize=2, linewidth=0.8, zorder=1)
        marker = f"${i}$"
        axes.plot(x, y, linestyle="", marker=marker, markersize=8, color=RETRIEVED, label=c.variant.label)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.minorticks_off()
    axes.set_xlabel("planning time of an action in a batch, ms", fontsize=9, color=INK)
    axes.set_ylabel("share retrieved", fontsize=9, color=INK)
    figure.legend(loc="outside right center", frameon=False, fontsize=8)
    _plain(axes)
    return figure
