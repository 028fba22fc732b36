"""The filmstrip: all steps of an episode in one figure."""

from __future__ import annotations

import dataclasses
import math
import textwrap
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mechsearch_jax.actions.kind import Sketch
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.viz import drawing, sketches
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Width of the figure [inches]: all text is legible at 100 dots per inch.
WIDTH = 10.0
_HEADING, _GAP, _BETWEEN, _LEGEND = 0.42, 0.14, 0.06, 0.8
# Distance of lines of text, in units of the font size, which is at least this in a heading [pt].
_LEADING, _SMALLEST = 1.4, 9.5
# Width of a letter, in units of the font size.
_LETTER, _BOLD_LETTER = 0.54, 0.575


@dataclasses.dataclass(frozen=True)
class Frame:
    """One step of an episode, ready to be drawn.

    Attributes:
      title: what the robot did.
      caption: why, in one short line.
      image: the camera's view.
      owner: index of the object at each pixel; other numbers for none.
      scene: the objects that the planner used.
      existence: f at the candidate poses.
      graspability: g at the candidate poses.
      target_pose: x, y [m] and yaw [rad] of the true target; None if unknown.
      found: whether the robot knows that pose.
      after: the objects that the planner predicts after the action.
      sketch: of the action.
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
    frames: Sequence[Frame], camera: Camera, shelf: Shelf, target: Target, heading: str, columns: int = 3
) -> Figure:
    """Draw an episode: per step the camera's view and the shelf from above, with f and g as colours and the action.

    Args:
      frames: the steps, at least one; a single step has its two pictures side by side.
      camera, shelf, target: of the problem.
      heading: at the top, in larger letters if it is one line that fits.
      columns: largest number of steps side by side; lines are filled evenly.

    Returns:
      The figure, `WIDTH` wide, which pyplot does not know.
    """
    lines = math.ceil(len(frames) / columns)
    columns = math.ceil(len(frames) / lines)
    scenes = [scene for frame in frames for scene in (frame.scene, frame.after)]
    room = drawing.height_of(scenes, shelf)
    width = (WIDTH - (columns + 1) * _GAP) / columns
    lines_of = [_lines(frame, width) for frame in frames]
    caption = _BETWEEN + max(sum(_LEADING * size / 72 for _, size, *_ in texts) for texts in lines_of)
    layout = _layout(columns, width, caption, drawing.view_window(camera, shelf, room), drawing.map_share(shelf))
    across = 72.0 * (WIDTH - 2 * _GAP) / _BOLD_LETTER
    size = min(13.0, across / max(len(heading), 1))
    if size < _SMALLEST or "\n" in heading:
        size = _SMALLEST
        wrapped = textwrap.TextWrapper(int(0.95 * across / size), subsequent_indent="    ")
        heading = "\n".join(wrapped.fill(line) for line in heading.splitlines())
    more = heading.count("\n") * _LEADING * size / 72
    height = _HEADING + more + lines * layout.height + _LEGEND
    figure = Figure(figsize=(WIDTH, height), facecolor=drawing.PAPER)
    figure.text(
        _GAP / WIDTH,
        1 - (0.22 + more / 2) / height,
        heading,
        fontsize=size,
        color=drawing.INK,
        weight="bold",
        va="center",
        linespacing=_LEADING,
    )
    for i, frame in enumerate(frames):
        x = _GAP + (i % columns) * (layout.width + _GAP)
        y = height - _HEADING - more - (i // columns) * layout.height
        _write(figure, x, y, lines_of[i])
        view, above = (
            figure.add_axes(((x + a) / WIDTH, (y - b) / height, w / WIDTH, h / height))
            for a, b, w, h in (layout.view, layout.above)
        )
        _draw(view, above, frame, camera, shelf, target, room)
    drawing.draw_legend(figure, 0.62 * _LEGEND / height)
    drawing.draw_action_legend(figure, 0.17 * _LEGEND / height)
    return figure


class _Layout(NamedTuple):
    """Layout of the pictures of a step [inches].

    Attributes:
      width, height: of the step.
      view, above: left side of each picture from the step's left side, its lower side downwards from the step's upper
        side, its width and its height.
    """

    width: float
    height: float
    view: tuple[float, float, float, float]
    above: tuple[float, float, float, float]


def _layout(columns: int, width: float, caption: float, window: tuple[int, int, int, int], map_share: float) -> _Layout:
    """The pictures above each other, or, for a single step, side by side with equal heights."""
    left, right, top, bottom = window
    share = (bottom - top) / (right - left)
    if columns > 1:
        view, above = width * share, width * map_share
        lower = caption + view + _BETWEEN + above
        return _Layout(width, lower + _GAP, (0.0, caption + view, width, view), (0.0, lower, width, above))
    high = (width - _GAP) / (1 / share + 1 / map_share)
    lower, across = caption + high, high / share
    return _Layout(width, lower + _GAP, (0.0, lower, across, high), (across + _GAP, lower, high / map_share, high))


def _lines(frame: Frame, width: float) -> list[tuple[str, float, str, str]]:
    """Lines of a step's title and caption, each with its font size, weight and colour."""
    texts = (
        (frame.title, 9.5, "bold", drawing.INK, _BOLD_LETTER),
        (frame.caption, drawing.LETTER, "normal", drawing.MUTED, _LETTER),
    )
    return [
        (line, size, weight, colour)
        for text, size, weight, colour, letter in texts
        for line in textwrap.wrap(text, int(72 * width / (letter * size)))
    ]


def _write(figure: Figure, x: float, y: float, lines: Sequence[tuple[str, float, str, str]]) -> None:
    for text, size, weight, colour in lines:
        y -= _LEADING * size / 72
        figure.text(x / WIDTH, y / figure.get_figheight(), text, fontsize=size, color=colour, weight=weight)


def _draw(view: Axes, above: Axes, frame: Frame, camera: Camera, shelf: Shelf, target: Target, room: float) -> None:
    draw_seen(view, frame, camera, shelf, target, room)
    draw_believed(above, frame, shelf, target)
    drawing.draw_objects(above, frame.scene)
    if frame.target_pose is not None:
        drawing.draw_target(above, frame.target_pose, target, frame.found)


def draw_seen(axes: Axes, frame: Frame, camera: Camera, shelf: Shelf, target: Target, room: float) -> None:
    """Draw the camera's view at a step, and the action.

    Args:
      axes: empty.
      frame: the step.
      camera, shelf, target: of the problem.
      room: height of the shown part above the board [m].
    """
    drawing.draw_view(axes, frame.image, camera, shelf, room)
    drawing.draw_numbers_in_view(axes, frame.owner, frame.scene.capacity)
    if frame.target_pose is not None and not frame.found:
        drawing.draw_hidden_target_in_view(axes, frame.target_pose, target, camera, shelf)
    _act(axes, sketches.in_view(camera), frame, shelf, target)


def draw_believed(axes: Axes, frame: Frame, shelf: Shelf, target: Target) -> None:
    """Draw the empty shelf from above with f and g at a step, and the action; `axes` must be empty."""
    drawing.draw_shelf(axes, shelf)
    image = drawing.map_image(frame.existence, frame.graspability, target)
    drawing.draw_map(axes, image, shelf, target)
    _act(axes, sketches.from_above, frame, shelf, target)


def _act(axes: Axes, flat: sketches.Flat, frame: Frame, shelf: Shelf, target: Target) -> None:
    sketches.draw_action(axes, flat, frame.sketch, frame.scene, frame.after, shelf)
    if frame.target_pose is not None:
        sketches.draw_taken_target(axes, flat, frame.sketch, frame.target_pose, target, shelf)
