"""Marks of the objects in the way of a target."""

from __future__ import annotations

from collections.abc import Collection

from matplotlib import patches
from matplotlib.axes import Axes
from matplotlib.patheffects import Normal, Stroke

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.viz import drawing

MARK = drawing.WARNING


def mark_from_above(axes: Axes, scene: Superquadrics, blockers: Collection[int]) -> None:
    """Mark the objects in the way in a picture from above."""
    outlines = drawing.outlines(scene)
    for outline in (outlines[index] for index in blockers):
        if outline is not None:
            style = {"facecolor": (*drawing.rgb(MARK), 0.3), "edgecolor": MARK, "lw": 2.2, "zorder": 4}
            patch = axes.add_patch(patches.Polygon(outline[:, ::-1], closed=True, **style))
            # Yellow alone is hard to see on the bright board.
            patch.set_path_effects([Stroke(linewidth=4.0, foreground=drawing.INK), Normal()])
