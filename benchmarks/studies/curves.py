"""The picture of curves: the share of episodes that reached a goal within so many actions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from scipy.optimize import isotonic_regression

from mechsearch_jax.viz.drawing import INK, MUTED

# Told apart without colour vision too (Okabe and Ito), the first and the last ones by their strokes as well.
STYLES = (
    {"color": "#0072b2", "linewidth": 2.4, "zorder": 3},
    {"color": "#d55e00"},
    {"color": "#009e73"},
    {"color": "#cc79a7"},
    {"color": "#e69f00"},
    {"color": "#56b4e9", "linestyle": "--"},
    {"color": "#8c6d31", "linestyle": "--"},
    {"color": MUTED, "linestyle": ":", "linewidth": 2.0},
    {"color": INK, "linestyle": "-.", "linewidth": 1.6},
)
# Of the axis: what a label takes, and where the highest one may be.
LINE_HEIGHT, HIGHEST = 0.056, 1.02


def curves_figure(curves: Mapping[str, Sequence[float]], order: Sequence[str], goal: str) -> Figure:
    """Curves with their labels at their ends.

    Args:
      curves: the share after 0, 1, ... actions, by label.
      order: all labels that there may be, at most as many as `STYLES`: a label has the style of its place.
      goal: name of the axis.
    """
    figure = Figure(figsize=(7.6, 4.4), layout=ConstrainedLayoutEngine(w_pad=0.1))
    axes = figure.subplots()
    styles = dict(zip(order, STYLES, strict=False))
    last = max(len(curve) for curve in curves.values()) - 1
    # Where two end alike, the label of the larger area is the higher one.
    ends = [curve[-1] + 1e-6 * sum(curve) for curve in curves.values()]
    for label, place in zip(curves, spread(ends, LINE_HEIGHT, HIGHEST), strict=True):
        curve, style = curves[label], {"linewidth": 1.4, **styles[label]}
        axes.plot(range(len(curve)), curve, marker="o", markersize=3, label=label, **style)
        axes.annotate(
            f"{label} {curve[-1]:.2f}",
            (len(curve) - 1, curve[-1]),
            (1.04, place),
            textcoords=axes.get_yaxis_transform(),
            arrowprops={"arrowstyle": "-", "color": style["color"], "linewidth": 0.6, "relpos": (0.0, 0.5)},
            annotation_clip=False,
            color=style["color"],
            fontsize=8.5,
            va="center",
        )
    axes.set(xlim=(-0.1, last + 0.1), ylim=(0.0, 1.03))
    axes.set_xticks(range(last + 1))
    axes.set_xlabel("actions", fontsize=9, color=INK)
    axes.set_ylabel(goal, fontsize=9, color=INK)
    axes.grid(color=MUTED, alpha=0.2)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK, labelsize=8)
    return figure


def spread(values: Sequence[float], least: float, highest: float) -> list[float]:
    """Places for labels, as near to values as may be in least squares, in the same order.

    Isotonic regression by SciPy, of what is left of each value when the distances below it are taken off.

    Args:
      values: where the labels would be.
      least: distance from one to the next.
      highest: where none is above.
    """
    order = np.argsort(values, kind="stable")
    steps = least * np.arange(len(values))
    left = isotonic_regression(np.asarray(values, float)[order] - steps).x
    places = np.empty(len(values))
    places[order] = np.minimum(left, highest - least * (len(values) - 1)) + steps
    return places.tolist()
