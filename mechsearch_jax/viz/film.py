"""Images of an animated step of an episode: a bystander's view beside the shelf from above.

The static parts are drawn once per step, by the functions of the filmstrip, and the moving parts over them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib import patches
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mechsearch_jax.viz import drawing, sketches
from mechsearch_jax.viz.filmstrip import Frame, draw_believed, draw_seen
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Of the picture [inches].
WIDTH = 8.0
# Bodies that are less far from where they were drawn are not drawn again [m].
STILL = 1e-5
_GAP, _LEFT, _HEADER, _FOOTER, _BETWEEN = 0.08, 4.8, 0.56, 0.44, 0.05


class Moving(NamedTuple):
    """The moving parts at one moment.

    Attributes:
      bodies: points of each body, whose hull it is, the target last [m]; None for absent bodies.
      hand: points of the fingers and the hand, whose hulls they are [m].
      time: since the beginning [s].
    """

    bodies: Sequence[Float[np.ndarray, "points 3"] | None]
    hand: Sequence[Float[np.ndarray, "points 3"]]
    time: float


@dataclasses.dataclass(frozen=True)
class Layout:
    """Layout of an image: left, bottom, width and height of each part in pixels, from the lower left corner.

    Attributes:
      size: width and height of the whole image; both even.
      beside: the bystander's view.
      above: the shelf from above.
      view: the camera's view.
    """

    size: tuple[int, int]
    beside: tuple[int, int, int, int]
    above: tuple[int, int, int, int]
    view: tuple[int, int, int, int]

    @classmethod
    def of(cls, width: int, camera: Camera, shelf: Shelf, room: float) -> Layout:
        """The layout of images `width` pixels wide that show `room` m above the board."""
        left, right, top, bottom = drawing.view_window(camera, shelf, room)
        column = WIDTH - _LEFT - 3 * _GAP
        view, above = column * (bottom - top) / (right - left), column * drawing.map_share(shelf)
        high = view + _BETWEEN + above
        dots = width / WIDTH

        def part(x: float, y: float, w: float, h: float) -> tuple[int, int, int, int]:
            return round(x * dots), round(y * dots), round(w * dots), round(h * dots)

        size = (width // 2 * 2, round((_HEADER + high + _FOOTER) * dots / 2) * 2)
        across = 2 * _GAP + _LEFT
        return cls(
            size,
            part(_GAP, _FOOTER, _LEFT, high),
            part(across, _FOOTER + view + _BETWEEN, column, above),
            part(across, _FOOTER, column, view),
        )


class Page:
    """The images of one step."""

    def __init__(self, frame: Frame, camera: Camera, shelf: Shelf, target: Target, room: float, layout: Layout):
        """Args:
        frame: the step.
        camera, shelf, target: of the problem.
        room: see `drawing.height_of`.
        layout: of the images.
        """
        width, height = layout.size
        self._layout = layout
        self._figure = Figure(figsize=(WIDTH, height * WIDTH / width), dpi=width / WIDTH, facecolor=drawing.PAPER)
        self._canvas = FigureCanvasAgg(self._figure)
        view, self._above = (
            self._figure.add_axes((x / width, y / height, w / width, h / height))
            for x, y, w, h in (layout.view, layout.above)
        )
        # The hand is drawn as a moving part.
        frame = dataclasses.replace(frame, sketch=dataclasses.replace(frame.sketch, hands=None))
        draw_seen(view, frame, camera, shelf, target, room)
        draw_believed(self._above, frame, shelf, target)
        view.text(
            0.985, 0.03, "what the camera saw", transform=view.transAxes, color=drawing.MUTED, fontsize=7.5,
            ha="right", va="bottom", zorder=9,
        )  # fmt: skip
        self._write(frame)
        self._movers = _Movers(self._above, frame)
        self._clock = self._text(width - _GAP * width / WIDTH, 0.2, "", 8.5, drawing.MUTED, ha="right", animated=True)
        self._canvas.draw()
        self._pixels = np.asarray(self._canvas.buffer_rgba())[..., :3]
        self._empty, self._image = self._canvas.copy_from_bbox(self._figure.bbox), self._pixels.copy()
        self._bodies: Sequence[Float[np.ndarray, "points 3"] | None] | None = None

    def image(self, beside: UInt8[np.ndarray, "h w 3"], moving: Moving) -> UInt8[np.ndarray, "rows columns 3"]:
        """The whole image at one moment.

        Args:
          beside: the bystander's view, of the layout's size.
          moving: the moving parts.
        """
        if self._bodies is None or _far(self._bodies, moving.bodies):
            self._draw(self._empty, self._movers.bodies(moving.bodies))
            self._background = self._canvas.copy_from_bbox(self._figure.bbox)
            self._bodies = moving.bodies
        self._clock.set_text(f"{moving.time:.1f} s")
        self._draw(self._background, [*self._movers.hand(moving.hand), self._clock])
        image = self._image.copy()
        x, y, w, h = self._layout.beside
        top = len(image) - y - h
        # Whatever moves is to the right of the bystander's view.
        image[:, x + w :] = self._pixels[:, x + w :]
        image[top : top + h, x : x + w] = beside
        return image

    def _draw(self, background: Any, artists: Iterable[Artist]) -> None:
        self._canvas.restore_region(background)
        for artist in artists:
            self._figure.draw_artist(artist)

    def _write(self, frame: Frame) -> None:
        left, size = _GAP * self._layout.size[0] / WIDTH, 72.0 * (WIDTH - 1.0)
        self._text(left, 0.2, frame.title, min(12.0, size / (0.62 * len(frame.title))), drawing.INK, weight="bold")
        self._text(left, 0.42, frame.caption, min(9.0, size / (0.56 * len(frame.caption))), drawing.MUTED)
        drawing.draw_legend(self._figure, 0.5 * _FOOTER / self._figure.get_figheight(), 7.2)

    def _text(self, x: float, down: float, text: str, size: float, colour: str, **style):
        """Text at pixel `x` and `down` inches from the top."""
        width, height = self._layout.size
        y = 1 - down * width / WIDTH / height
        return self._figure.text(x / width, y, text, fontsize=size, color=colour, va="center", **style)


class _Movers:
    """The artists of the moving parts in the picture from above."""

    def __init__(self, axes: Axes, frame: Frame):
        self._bodies: list[tuple[patches.Polygon, Artist | None]] = []
        self._axes, self._frame = axes, frame
        self._hand = [self._polygon(drawing.HAND, 0.3, 0.8) for _ in range(3)]

    def _polygon(self, colour: str, filled: float, width: float, **style) -> patches.Polygon:
        polygon = patches.Polygon(
            np.zeros((3, 2)), closed=True, facecolor=(*drawing.rgb(colour), filled), edgecolor=colour, lw=width,
            animated=True, **style,
        )  # fmt: skip
        self._axes.add_patch(polygon)
        return polygon

    def bodies(self, bodies: Sequence[Float[np.ndarray, "points 3"] | None]) -> list[Artist]:
        """The artists of the bodies, from back to front."""
        *objects, target = bodies
        while len(self._bodies) < len(objects):
            number = drawing.number(self._axes, (0.0, 0.0), len(self._bodies), animated=True)
            self._bodies.append((self._polygon(drawing.OBJECT, 0.22, 1.3), number))
        if len(self._bodies) == len(objects):
            style = {} if self._frame.found else {"linestyle": (0, (2, 1.5))}
            filled = 1.0 if self._frame.found else 0.0
            self._bodies.append((self._polygon(drawing.TARGET, filled, 1.6, **style), None))
        shown: list[Artist] = []
        for (polygon, number), points in zip(self._bodies, (*objects, target), strict=True):
            if points is None:
                continue
            outline = drawing.hull(sketches.from_above(points))
            polygon.set_xy(outline)
            shown.append(polygon)
            if number is not None:
                number.set_position((outline.min(axis=0) + outline.max(axis=0)) / 2)  # pyright: ignore
                shown.append(number)
        return shown

    def hand(self, hand: Sequence[Float[np.ndarray, "points 3"]]) -> list[Artist]:
        """The artists of the fingers and the hand."""
        for polygon, points in zip(self._hand, hand, strict=True):
            polygon.set_xy(drawing.hull(sketches.from_above(points)))
        return list[Artist](self._hand)


def _far(
    before: Sequence[Float[np.ndarray, "points 3"] | None], after: Sequence[Float[np.ndarray, "points 3"] | None]
) -> bool:
    """Whether a body is elsewhere, of the same ones."""
    return any(b is not None and np.abs(b - a).max() > STILL for a, b in zip(before, after, strict=True))
