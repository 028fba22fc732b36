"""A figure of the objects in the way of a target: scenes in which the objects hit by its best grasps are marked."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib import patches
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal, Stroke

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.viz import drawing
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

MARK = drawing.WARNING
_WIDTH, _GAP, _TITLE, _LINE = 4.6, 0.16, 0.34, 0.2
# Letters in a line of text, for each inch of the figure's width.
_LETTERS = 13


@dataclasses.dataclass(frozen=True)
class Moment:
    """A scene at one moment.

    Attributes:
      title: of its picture.
      image: the camera's view.
      owner: index of the object at each pixel; other numbers for none.
      scene: the true objects.
      target_pose: x, y [m] and yaw [rad] of the target.
      blockers: indices of the objects in the way.
    """

    title: str
    image: UInt8[np.ndarray, "h w 3"]
    owner: Int[np.ndarray, "h w"]
    scene: Superquadrics
    target_pose: Float[np.ndarray, " 3"]
    blockers: Collection[int]


def blockers_figure(
    moments: Sequence[Moment], camera: Camera, shelf: Shelf, target: Target, heading: str, text: str
) -> Figure:
    """Draw moments side by side, each in the camera's view and from above, with objects in the way in yellow.

    Args:
      moments: at least one.
      camera, shelf, target: of the problem.
      heading: one line at the top.
      text: why the target cannot be taken out, at the bottom.
    """
    room = drawing.height_of([moment.scene for moment in moments], shelf)
    left, right, top, bottom = drawing.view_window(camera, shelf, room)
    view_height = _WIDTH * (bottom - top) / (right - left)
    map_height = _WIDTH * drawing.map_share(shelf)
    width = len(moments) * (_WIDTH + _GAP) + _GAP
    lines = textwrap.wrap(text, int(_LETTERS * width))
    low = _GAP + _LINE * len(lines) + 0.1
    height = low + map_height + 0.08 + view_height + _TITLE + 0.5
    figure = Figure(figsize=(width, height), facecolor=drawing.PAPER)
    figure.text(_GAP / width, 1 - 0.28 / height, heading, fontsize=13, color=drawing.INK, weight="bold", va="center")
    for i, moment in enumerate(moments):
        x = _GAP + i * (_WIDTH + _GAP)
        upper = low + map_height + 0.08
        middle = (upper + view_height + _TITLE / 2) / height
        figure.text(x / width, middle, moment.title, fontsize=10, color=drawing.INK, va="center")
        view = figure.add_axes((x / width, upper / height, _WIDTH / width, view_height / height))
        above = figure.add_axes((x / width, low / height, _WIDTH / width, map_height / height))
        _draw(view, above, moment, camera, shelf, target, room)
    for i, line in enumerate(lines):
        y = (low - 0.1 - _LINE * (i + 0.5)) / height
        figure.text(_GAP / width, y, line, fontsize=9, color=drawing.INK, va="center")
    return figure


def _draw(view: Axes, above: Axes, moment: Moment, camera: Camera, shelf: Shelf, target: Target, room: float) -> None:
    draw_seen_blockers(view, moment, camera, shelf, room)
    drawing.draw_shelf(above, shelf)
    drawing.draw_objects(above, moment.scene)
    drawing.draw_target(above, moment.target_pose, target, certain=True)
    mark_from_above(above, moment.scene, moment.blockers)


def draw_seen_blockers(axes: Axes, moment: Moment, camera: Camera, shelf: Shelf, room: float) -> None:
    """Draw the camera's view at a moment, with the objects in the way marked.

    Args:
      axes: empty.
      moment: what is drawn.
      camera, shelf: of the problem.
      room: height of the shown part above the board [m].
    """
    drawing.draw_view(axes, moment.image, camera, shelf, room)
    drawing.draw_numbers_in_view(axes, moment.owner, moment.scene.capacity)
    seen = drawing.outlines_in_view(moment.scene, camera)
    _mark(axes, [seen[index] for index in moment.blockers])


def mark_from_above(axes: Axes, scene: Superquadrics, blockers: Collection[int]) -> None:
    """Mark the objects in the way in a picture from above."""
    outlines = [drawing.outlines(scene)[index] for index in blockers]
    _mark(axes, [None if outline is None else outline[:, ::-1] for outline in outlines])


def _mark(axes: Axes, outlines: Sequence[Float[np.ndarray, "corners 2"] | None]) -> None:
    for outline in outlines:
        if outline is not None:
            style = {"facecolor": (*drawing.rgb(MARK), 0.3), "edgecolor": MARK, "lw": 2.2, "zorder": 4}
            patch = axes.add_patch(patches.Polygon(outline, closed=True, **style))
            # Yellow alone is hard to see on the bright board.
            patch.set_path_effects([Stroke(linewidth=4.0, foreground=drawing.INK), Normal()])
