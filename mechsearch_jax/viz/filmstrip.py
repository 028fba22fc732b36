"""The filmstrip: an episode in one picture, step by step."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from matplotlib.figure import Figure

from mechsearch_jax.actions.sketch import Sketch
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.viz import drawing
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

_WIDTH = 4.6
_CAPTION, _GAP, _LEGEND = 0.52, 0.16, 0.55
# Width of a letter of the heading, in units of the size of its type.
_LETTER = 0.6


@dataclasses.dataclass(frozen=True)
class Frame:
    """One step of an episode, ready to be drawn.

    Attributes:
      title: what the robot did.
      caption: why, in one short line.
      image: the camera's view.
      owner: index of the object that each pixel shows; anything else where there is none.
      scene: the objects as the planner knew them.
      existence: f at the candidate poses.
      graspability: g at the candidate poses.
      target_pose: x, y [m] and yaw [rad] of the true target; None where nobody knows it.
      found: whether the robot knows that pose.
      after: the objects as the planner expects them after the action.
      sketch: what there is to show of the action.
    """

    title: str
    caption: str
    image: UInt8[np.ndarray, "h w 3"]
    owner: Int[np.ndarray, "h w"]
    scene: Superquadrics
    existence: Bool[np.ndarray, " x"]
    graspability: Int[np.ndarray, " x"]
    target_pose: Float[np.ndarray, " 3"] | None
    found: bool
    after: Superquadrics
    sketch: Sketch


def filmstrip(
    frames: Sequence[Frame], camera: Camera, shelf: Shelf, target: Target, heading: str, columns: int = 4
) -> Figure:
    """Draw an episode: per step the camera's view and the shelf from above, with f and g as colours and the action.

    Args:
      frames: the steps, at least one.
      camera, shelf, target: of the problem.
      heading: one line above everything.
      columns: at most so many steps side by side; lines are filled evenly.

    Returns:
      The figure; nothing is kept anywhere else.
    """
    lines = math.ceil(len(frames) / columns)
    columns = math.ceil(len(frames) / lines)
    left, right, top, bottom = drawing.view_window(camera, shelf)
    view_height = _WIDTH * (bottom - top) / (right - left)
    map_height = _WIDTH * (shelf.back - shelf.front + 0.087) / (shelf.left - shelf.right + 0.024)
    cell = _CAPTION + view_height + 0.08 + map_height + _GAP
    width = columns * _WIDTH + (columns + 1) * _GAP
    height = 0.5 + lines * cell + _LEGEND
    figure = Figure(figsize=(max(width, 9.6), height), facecolor=drawing.PAPER)
    width, offset = figure.get_figwidth(), (figure.get_figwidth() - width) / 2
    figure.text(
        _GAP / width + offset / width,
        1 - 0.3 / height,
        heading,
        fontsize=min(13.0, 72.0 * (width - offset - 2 * _GAP) / (_LETTER * max(len(heading), 1))),
        color=drawing.INK,
        weight="bold",
        va="center",
    )

    for i, frame in enumerate(frames):
        x = offset + _GAP + (i % columns) * (_WIDTH + _GAP)
        y = height - 0.5 - (i // columns) * cell
        figure.text(
            x / width, (y - 0.16) / height, frame.title, fontsize=10.5, color=drawing.INK, weight="bold", va="center"
        )
        figure.text(x / width, (y - 0.37) / height, frame.caption, fontsize=8.5, color=drawing.MUTED, va="center")
        y -= _CAPTION + view_height
        view = figure.add_axes((x / width, y / height, _WIDTH / width, view_height / height))
        y -= 0.08 + map_height
        above = figure.add_axes((x / width, y / height, _WIDTH / width, map_height / height))
        _draw(view, above, frame, camera, shelf, target)
    drawing.draw_legend(figure, frames[0].scene.capacity, 0.5 * _LEGEND / height)
    return figure


def _draw(view, above, frame: Frame, camera: Camera, shelf: Shelf, target: Target) -> None:
    drawing.draw_view(view, frame.image, camera, shelf)
    drawing.draw_numbers_in_view(view, frame.owner, frame.scene.capacity)
    drawing.draw_shelf(above, shelf)
    image = drawing.map_image(frame.existence, frame.graspability, target, frame.scene.capacity)
    drawing.draw_map(above, image, shelf, target)
    drawing.draw_objects(above, frame.scene)
    if frame.target_pose is not None:
        drawing.draw_target(above, frame.target_pose, target, frame.found)
    drawing.draw_sketch_in_view(view, frame.sketch, camera)
    drawing.draw_sketch(above, frame.sketch, frame.after)
