"""The picture of f and g for one scene."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mechsearch_jax.camera import Camera
from mechsearch_jax.results import Maps
from mechsearch_jax.shelf import Shelf
from mechsearch_jax.target import Target
from mechsearch_jax.viz import drawing

_WIDTH, _GAP = 4.6, 0.2


def maps_figure(
    maps: Maps,
    image: UInt8[np.ndarray, "h w 3"],
    owner: Int[np.ndarray, "h w"],
    target_pose: Float[np.ndarray, " 3"],
    camera: Camera,
    shelf: Shelf,
    target: Target,
    heading: str,
) -> Figure:
    """Draw the camera's view, f, g, and g where f allows the target, each of the last three from above.

    Args:
      maps: f and g and the objects.
      image: the camera's view.
      owner: index of the object that each pixel shows; anything else where there is none.
      target_pose: x, y [m] and yaw [rad] of the true target, drawn dashed.
      camera, shelf, target: of the problem.
      heading: one line above everything.

    Returns:
      The figure; nothing is kept anywhere else.
    """
    left, right, top, bottom = drawing.view_window(camera, shelf)
    map_height = _WIDTH * (shelf.back - shelf.front + 0.087) / (shelf.left - shelf.right + 0.024)
    view_height = 2 * map_height + 0.4
    view_width = view_height * (right - left) / (bottom - top)
    width = view_width + 2 * _WIDTH + 4 * _GAP
    height = view_height + 1.5
    figure = Figure(figsize=(width, height), facecolor=drawing.PAPER)
    figure.text(_GAP / width, 1 - 0.3 / height, heading, fontsize=13, color=drawing.INK, weight="bold", va="center")

    def panel(x: float, y: float, w: float, h: float, title: str) -> Axes:
        figure.text(x / width, (y + h + 0.14) / height, title, fontsize=10, color=drawing.INK, va="center")
        return figure.add_axes((x / width, y / height, w / width, h / height))

    low = 0.6
    capacity = maps.scene.capacity
    everywhere = np.ones_like(maps.existence)
    view = panel(_GAP, low, view_width, view_height, "What the camera sees")
    drawing.draw_view(view, image, camera, shelf)
    drawing.draw_numbers_in_view(view, owner, capacity)

    first, second = 2 * _GAP + view_width, 3 * _GAP + view_width + _WIDTH
    upper = low + map_height + 0.4
    possible = int(maps.existence.sum())
    both = int((maps.existence & (maps.graspability == 1)).sum())
    where_f = drawing.map_image(maps.existence, np.ones_like(maps.graspability), target, capacity)
    where_f[..., :3] = drawing.rgb(drawing.ACTION)
    everywhere_g = drawing.map_image(everywhere, maps.graspability, target, capacity)
    where_both = drawing.map_image(maps.existence, maps.graspability, target, capacity)
    panels = (
        (first, upper, f"f: the target can be at {possible} of {len(maps.poses)} poses", where_f),
        (first, low, "g: what a grasp would meet at every pose", everywhere_g),
        (second, upper, f"f and g: {both} of these {possible} poses are graspable", where_both),
    )
    for x, y, title, picture in panels:
        axes = panel(x, y, _WIDTH, map_height, title)
        drawing.draw_shelf(axes, shelf)
        drawing.draw_map(axes, picture, shelf, target)
        drawing.draw_objects(axes, maps.scene)
        drawing.draw_target(axes, target_pose, target, certain=False)
    _draw_counts(panel(second, low, _WIDTH, map_height, "How many objects are in the way, where f = 1"), maps)
    drawing.draw_legend(figure, capacity, 0.3 / height)
    return figure


def _draw_counts(axes: Axes, maps: Maps) -> None:
    """Number of possible poses by colour of the map."""
    bands = drawing.bands(maps.scene.capacity)
    g = maps.graspability[maps.existence]
    counts = [int(((g >= band.low) & (g <= band.high)).sum()) for band in bands]
    colours = [drawing.rgb(band.colour) for band in bands]
    bars = axes.barh(range(len(bands)), counts, color=colours, height=0.62)
    axes.bar_label(bars, padding=4, fontsize=8.5, color=drawing.INK)
    labels = ["none", "1", "2", "3", "more", "out of reach"]
    axes.set_yticks(range(len(bands)), labels, fontsize=8.5, color=drawing.INK)
    axes.invert_yaxis()
    axes.set_xticks([])
    axes.set_xlim(0, max(*counts, 1) * 1.15)
    axes.tick_params(length=0)
    for side in ("top", "right", "bottom"):
        axes.spines[side].set_visible(False)
    axes.spines["left"].set_color(drawing.WALL)
    box = axes.get_position()
    axes.set_position((box.x0 + 0.2 * box.width, box.y0 + 0.12 * box.height, 0.78 * box.width, 0.82 * box.height))
