"""Pictures of the worst answers of `lab recognition`, beside the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from mechsearch_jax.benchmarks.lab.parts.images import Shown
from mechsearch_jax.benchmarks.lab.parts.recognition import RecognitionBench, RecognitionRow
from mechsearch_jax.envs.world.world import true_superquadrics
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.perception.scores import sharpened
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.viz import drawing
from mechsearch_jax.workspace.camera import Camera

STYLES = {"true": (drawing.GRASPABLE, "solid"), "recognised": (drawing.TARGET, (0, (4, 1.6)))}


def worst(rows: Sequence[RecognitionRow], method: str, count: int) -> list[RecognitionRow]:
    """The `count` answers of a method with the least intersection over union, the worst first.

    Raises:
      InputError: there are none, or the count is below 1.
    """
    ranked = sorted((row for row in rows if row.method == method), key=lambda row: row.iou)
    if not ranked or count < 1:
        raise InputError(f"lab recognition: there are no {count} answers of {method} to draw; measure it, count from 1")
    return ranked[:count]


def worst_figure(benches: Sequence[RecognitionBench], rows: Sequence[RecognitionRow]) -> Figure:
    """Answers beside the truth: for each a part of the depth image, and the segment's points from above.

    Args:
      benches: of which the rows are results.
      rows: one panel each.
    """
    places = {(scene.source, scene.name): (bench, i) for bench in benches for i, scene in enumerate(bench.scenes)}
    columns = min(4, len(rows))
    lines = -(-len(rows) // columns)
    figure = Figure(figsize=(3.4 * columns, 4.9 * lines + 0.7), layout="constrained")
    grid = figure.subfigures(lines, columns, squeeze=False)
    for row, panel in zip(rows, grid.reshape(-1), strict=False):
        bench, i = places[row.source, row.scene]
        image, answers, _ = bench.answers(i, row.noise)
        truth = sharpened(true_superquadrics(bench.scenes[i].world))
        both = {"true": truth, "recognised": answers[row.method]}
        drawn = {name: _slot(scene, row.object) for name, scene in both.items()}
        if row.outcome != "answered":
            del drawn["recognised"]
        _draw_panel(panel, row, image.shown, bench.view.camera, drawn)
    marks = figure.axes[1].get_legend_handles_labels()
    figure.legend(*marks, loc="outside lower center", ncols=len(marks[0]), frameon=False, fontsize=9)
    return figure


def _slot(scene: Superquadrics, index: int) -> Superquadrics:
    return jax.tree.map(lambda a: np.asarray(a)[index : index + 1], scene)


def _draw_panel(
    panel: Any, row: RecognitionRow, shown: Shown, camera: Camera, drawn: Mapping[str, Superquadrics]
) -> None:
    """The camera's view and the view from above, for one object."""
    depth, mask = np.asarray(shown.depth), np.asarray(shown.labels) == row.object
    panel.suptitle(
        f"{row.scene}, object {row.object} ({row.shape})\n{row.noise}, {row.visible:.0%} visible: IoU {row.iou:.2f}",
        fontsize=8.5, color=drawing.INK,
    )  # fmt: skip
    view, above = panel.subplots(2, 1, height_ratios=(1.25, 1.0))
    in_view = {name: drawing.outlines_in_view(shape, camera)[0] for name, shape in drawn.items()}
    outlines_above = {name: drawing.outlines(shape)[0] for name, shape in drawn.items()}
    from_above = {name: 1e3 * outline[:, ::-1] for name, outline in outlines_above.items() if outline is not None}

    rows, columns = np.nonzero(mask)
    corners = np.concatenate([np.stack([columns, rows], axis=1), *(o for o in in_view.values() if o is not None)])
    low, high = corners.min(axis=0) - 6, corners.max(axis=0) + 6
    middle, half = (low + high) / 2, max(*(high - low)) / 2
    near = np.where(np.isfinite(depth), depth, np.nan)
    part = near[mask] if mask.any() else near
    view.imshow(near, cmap="gray", vmin=np.nanmin(part) - 0.15, vmax=np.nanmax(part) + 0.15, interpolation="nearest")
    tint = np.zeros((*mask.shape, 4))
    tint[mask] = (*drawing.rgb(drawing.ACTION), 0.35)
    view.imshow(tint, interpolation="nearest")
    view.set_xlim(middle[0] - half, middle[0] + half)
    view.set_ylim(middle[1] + half, middle[1] - half)

    points = 1e3 * np.asarray(shown.points)[mask][:, :2]
    above.scatter(points[:, 1], points[:, 0], s=1.5, color=drawing.ACTION, linewidths=0, label="the object's points")
    for axes, outlines in ((view, in_view), (above, from_above)):
        for name, outline in outlines.items():
            if outline is not None:
                colour, dashes = STYLES[name]
                axes.plot(*np.concatenate([outline, outline[:1]]).T, color=colour, lw=1.6, linestyle=dashes, label=name)
    # From above as the robot sees the shelf: +y to the left.
    above.set_aspect("equal", adjustable="datalim")
    above.invert_xaxis()
    above.tick_params(labelsize=6.5, colors=drawing.MUTED)
    above.set_xlabel("y [mm]", fontsize=7, color=drawing.MUTED)
    above.set_ylabel("x [mm]", fontsize=7, color=drawing.MUTED)
    view.set_xticks([])
    view.set_yticks([])
