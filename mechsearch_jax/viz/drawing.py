"""Parts of figures: the shelf from above, the camera's view, and actions in both.

Pictures from above are oriented as for the robot: the shelf's open front at the bottom, +y to the left.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from matplotlib import patches
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal, Stroke
from matplotlib.text import Text
from scipy.spatial import ConvexHull

from mechsearch_jax.geometry.bodies import world_parts
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.grasping.graspability import INFEASIBLE
from mechsearch_jax.runtime.files import PathLike, replacing
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

INK = "#22303c"
MUTED = "#75828e"
PAPER = "#ffffff"
BOARD = "#f3f1ec"
WALL = "#a9a294"
OBJECT = "#5b6b7a"
ACTION = "#1b5fc1"
TARGET = "#d1344b"
GRASPABLE = "#2a9d78"
# The more objects are in the way, the darker. Also who sees no red or no green tells them apart, and from `TARGET`.
BLOCKED = ("#d3b5e5", "#ad7fd0", "#7f4fa8", "#4c2a6b")
NO_GRASP = "#c4bfb4"
# What is in the way, and what is doubtful.
WARNING = "#f2b100"
HAND = INK

# Margins of pictures from above: in front of the shelf, and beside and behind it [m].
ROBOT_STRIP, RIM = 0.1, 0.012
# Least height of the camera's view above the board, and margin above the objects [m].
LOWEST, ROOM = 0.15, 0.03
# Font size within pictures.
LETTER = 8.5


@dataclasses.dataclass(frozen=True)
class Band:
    """A colour of the map, its label, and its values of g, from `low` to `high`."""

    colour: str
    label: str
    low: int
    high: int


def bands() -> tuple[Band, ...]:
    """The colours of g, from the best to the worst value."""
    # Maps and recordings of earlier versions have `INFEASIBLE` minus one object.
    worst = 2 - INFEASIBLE
    return (
        Band(GRASPABLE, "graspable", 1, 1),
        Band(BLOCKED[0], "1 object in the way", 0, 0),
        Band(BLOCKED[1], "2 objects", -1, -1),
        Band(BLOCKED[2], "3 objects", -2, -2),
        Band(BLOCKED[3], "more", worst + 1, -3),
        Band(NO_GRASP, "out of reach", -(10**6), worst),
    )


def rgb(colour: str) -> np.ndarray:
    """Red, green and blue of "#rrggbb", 0 to 1."""
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255


def surfaces(scene: Superquadrics, grid: tuple[int, int] = (33, 97)) -> list[Float[np.ndarray, "points 3"] | None]:
    """Points of each object's surface [m], those of a body's parts one after the other; None for absent objects.

    Args:
      scene: the objects.
      grid: number of points from pole to pole, and around, where the last equals the first.
    """
    if scene.parts is not None:
        of_parts, p = surfaces(world_parts(scene), grid), scene.parts.capacity
        bodies = [[points for points in of_parts[i : i + p] if points is not None] for i in range(0, len(of_parts), p)]
        return [np.concatenate(parts) if parts else None for parts in bodies]
    elevation = np.linspace(-np.pi / 2, np.pi / 2, grid[0])[:, None]
    azimuth = np.linspace(-np.pi, np.pi, grid[1])[None, :]

    def power(base: np.ndarray, exponent: float) -> np.ndarray:
        return np.sign(base) * np.abs(base) ** exponent

    result: list[np.ndarray | None] = []
    fields = (scene.size, scene.exponents, scene.position, scene.rotation, scene.valid)
    for size, (e1, e2), position, rotation, valid in zip(*(np.asarray(f, float) for f in fields), strict=True):
        if not valid:
            result.append(None)
            continue
        across = power(np.cos(elevation), e1)
        surface = [
            across * power(np.cos(azimuth), e2),
            across * power(np.sin(azimuth), e2),
            power(np.sin(elevation), e1) + 0 * azimuth,
        ]
        result.append((np.stack(surface, axis=-1).reshape(-1, 3) * size) @ rotation.T + position)
    return result


def hull(points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "corners 2"]:
    """Corners of the convex hull, counter-clockwise."""
    return points[ConvexHull(points).vertices]


def outlines(scene: Superquadrics) -> list[Float[np.ndarray, "corners 2"] | None]:
    """Each object's outline from above in x and y [m], counter-clockwise; None for absent objects."""
    return [None if points is None else hull(points[:, :2]) for points in surfaces(scene)]


def outlines_in_view(scene: Superquadrics, camera: Camera) -> list[Float[np.ndarray, "corners 2"] | None]:
    """Each object's outline in the camera's image as columns and rows; None for absent objects."""
    return [None if points is None else hull(pixels(camera, points)) for points in surfaces(scene)]


def map_image(
    shown: Bool[np.ndarray, " x"],
    graspability: Int[np.ndarray, " x"],
    target: Target,
) -> Float[np.ndarray, "rows columns 4"]:
    """Colours of the candidate positions as an image: rows along x, columns along y, transparent where not `shown`.

    Of several yaw angles at a position, the best graspability among the shown ones counts; the fewer angles are shown,
    the paler the colour.
    """
    rows, columns = target.grid
    shown, g = (a.reshape(rows, columns, target.yaws) for a in (shown, graspability))
    best = np.max(np.where(shown, g, -(10**6)), axis=-1)
    image = np.zeros((rows, columns, 4))
    for band in bands():
        image[(best >= band.low) & (best <= band.high), :3] = rgb(band.colour)
    share = np.mean(shown, axis=-1)
    image[..., 3] = np.where(share > 0, 0.35 + 0.6 * share, 0.0)
    return image


def draw_shelf(axes: Axes, shelf: Shelf) -> None:
    """Draw the empty shelf from above, and set the limits and style of the axes."""
    front, back, right, left = shelf.front, shelf.back, shelf.right, shelf.left
    axes.add_patch(
        patches.Rectangle((right, front), left - right, back - front, facecolor=BOARD, linewidth=0, zorder=0)
    )
    corners = ((left, front), (left, back), (right, back), (right, front), (left, front))
    # As few strokes as there are styles, so that walls join at corners.
    for is_wall, width, dashes in ((True, 3.5, "-"), (False, 1.0, (0, (4, 3)))):
        line = list[tuple[float, float]]()
        for face, ends in zip(("left", "back", "right", "front"), itertools.pairwise(corners), strict=True):
            line += ends if (face in shelf.faces) == is_wall else [(math.nan, math.nan)]
        across, along = np.transpose(line)
        axes.plot(across, along, color=WALL, solid_joinstyle="miter", linewidth=width, linestyle=dashes)
    axes.text(
        left - 0.01, front - 0.75 * ROBOT_STRIP, "robot's side", color=MUTED, fontsize=LETTER, ha="left", va="center"
    )
    axes.set_xlim(left + RIM, right - RIM)
    axes.set_ylim(front - ROBOT_STRIP, back + RIM)
    axes.set_aspect("equal")
    axes.axis("off")


def draw_map(axes: Axes, image: Float[np.ndarray, "rows columns 4"], shelf: Shelf, target: Target) -> None:
    """Draw an image of `map_image`, each candidate position as a cell of its grid."""
    dx, dy, _ = target.cell(shelf)
    poses = target.candidate_poses(shelf)
    low, high = poses[:, :2].min(axis=0), poses[:, :2].max(axis=0)
    extent = (low[1] - dy / 2, high[1] + dy / 2, low[0] - dx / 2, high[0] + dx / 2)
    limits = axes.get_xlim(), axes.get_ylim()
    axes.imshow(image, extent=extent, origin="lower", interpolation="nearest", zorder=1, aspect="auto")
    axes.set_xlim(limits[0])
    axes.set_ylim(limits[1])
    axes.set_aspect("equal")


def draw_objects(axes: Axes, scene: Superquadrics) -> None:
    """Draw the objects as outlines with their numbers."""
    for i, outline in enumerate(outlines(scene)):
        if outline is None:
            continue
        axes.add_patch(
            patches.Polygon(
                outline[:, ::-1], closed=True, facecolor=(*rgb(OBJECT), 0.22), edgecolor=OBJECT, lw=1.3, zorder=3
            )
        )
        x, y, _ = np.asarray(scene.position)[i].tolist()
        number(axes, (y, x), i)


def number(axes: Axes, place: tuple[float, float], index: int, animated: bool = False) -> Text:
    """Draw the number of an object, legible on any background."""
    text = axes.text(
        *place, str(index), color=INK, fontsize=LETTER, ha="center", va="center", zorder=10, animated=animated
    )
    text.set_path_effects([Stroke(linewidth=2.2, foreground=PAPER, alpha=0.75), Normal()])
    return text


def draw_target(axes: Axes, pose: Float[np.ndarray, " 3"], target: Target, certain: bool) -> None:
    """Draw the target from above: filled if `certain`, an open outline if the robot does not know its pose."""
    x, y, yaw = (float(v) for v in pose)
    style = {"edgecolor": TARGET, "linewidth": 1.6, "zorder": 5, "facecolor": TARGET if certain else "none"}
    if not certain:
        style["linestyle"] = (0, (2, 1.5))
    if target.solid.round:
        outline = patches.Circle((y, x), target.solid.radius, **style)
    else:
        c, s = np.cos(yaw), np.sin(yaw)
        corners = target.solid.rim() @ np.array([[c, s], [-s, c]]) + (x, y)
        outline = patches.Polygon(corners[:, ::-1], closed=True, **style)
    outline.set_path_effects(halo(1.6))
    axes.add_patch(outline)


def target_points(pose: Float[np.ndarray, " 3"], target: Target, shelf: Shelf) -> Float[np.ndarray, "points 3"]:
    """Points whose hull is the target, upright on the shelf's board at a pose x, y [m] and yaw [rad]; [m]."""
    x, y, yaw = (float(v) for v in pose)
    c, s = np.cos(yaw), np.sin(yaw)
    level = target.solid.rim() @ np.array([[c, s], [-s, c]]) + (x, y)
    ends = (shelf.board, shelf.board + target.tall)
    return np.concatenate([np.column_stack([level, np.full(len(level), z)]) for z in ends])


def draw_hidden_target_in_view(
    axes: Axes, pose: Float[np.ndarray, " 3"], target: Target, camera: Camera, shelf: Shelf
) -> None:
    """Draw the target whose pose the robot does not know as an open outline."""
    outline = hull(pixels(camera, target_points(pose, target, shelf)))
    hidden = patches.Polygon(
        outline, closed=True, facecolor="none", edgecolor=TARGET, linewidth=1.3, linestyle=(0, (2, 1.5)), zorder=5
    )
    hidden.set_path_effects(halo(1.3))
    axes.add_patch(hidden)


def halo(width: float) -> list:
    return [Stroke(linewidth=width + 2.6, foreground=PAPER), Normal()]


def pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(column, row) of world points, as by `camera.project` but without compilation for each number of points."""
    offset = np.asarray(points, np.float32) - np.array(camera.position, np.float32)
    x, y, z = np.moveaxis(offset @ np.array(camera.rotation, np.float32), -1, 0)
    safe = np.maximum(z, np.float32(1e-6))
    column, row = camera.fx * x / safe + camera.cx - 0.5, camera.fy * y / safe + camera.cy - 0.5
    return np.stack([column, row], axis=-1)


def view_window(camera: Camera, shelf: Shelf, height: float | None = None) -> tuple[int, int, int, int]:
    """The part of the camera's image that shows the shelf: first and last column, first and last row.

    Args:
      camera, shelf: of the problem.
      height: of the shown part above its board [m]; up to the upper board if None.
    """
    top = shelf.ceiling if height is None else min(shelf.board + height, shelf.ceiling)
    corners = np.array(
        [
            (x, y, z)
            for x in (shelf.front, shelf.back)
            for y in (shelf.right, shelf.left)
            for z in (shelf.board - shelf.thickness, top)
        ]
    )
    corner = pixels(camera, corners)
    low = np.clip(np.floor(corner.min(axis=0)) - 10, 0, None)
    high = np.clip(np.ceil(corner.max(axis=0)) + 10, None, (camera.width, camera.height))
    return int(low[0]), int(high[0]), int(low[1]), int(high[1])


def height_of(scenes: Iterable[Superquadrics], shelf: Shelf) -> float:
    """Height above the board that shows all objects of several scenes, with a margin [m]."""
    tops = [points[:, 2].max() for scene in scenes for points in surfaces(scene) if points is not None]
    return max(LOWEST, *(top - shelf.board + ROOM for top in tops)) if tops else LOWEST


def map_share(shelf: Shelf) -> float:
    """Height of the picture from above, relative to its width."""
    return (shelf.back - shelf.front + ROBOT_STRIP + RIM) / (shelf.left - shelf.right + 2 * RIM)


def draw_view(
    axes: Axes, image: UInt8[np.ndarray, "h w 3"], camera: Camera, shelf: Shelf, height: float | None = None
) -> None:
    """Draw the camera's image, cut to the shelf: see `view_window`."""
    left, right, top, bottom = view_window(camera, shelf, height)
    axes.imshow(image[top:bottom, left:right], extent=(left, right, bottom, top), interpolation="antialiased")
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color(WALL)
    _name_front_in_view(axes, camera, shelf)


def _name_front_in_view(axes: Axes, camera: Camera, shelf: Shelf) -> None:
    """Label the robot's side along the board's front edge, if that is in the picture."""
    y = np.linspace(shelf.left, shelf.right, 201)
    edge = np.column_stack([np.full_like(y, shelf.front), y, np.full_like(y, shelf.board - shelf.thickness)])
    edge = pixels(camera, edge)
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    inside = (edge[:, 0] > left) & (edge[:, 0] < right) & (edge[:, 1] > top) & (edge[:, 1] < bottom)
    seen = edge[inside]
    if len(seen) < 20:
        return
    at, along = seen[len(seen) // 2], seen[-1] - seen[0]
    along = along if along[0] >= 0 else -along
    axes.text(
        float(at[0]), float(at[1]), "robot's side", color=MUTED, fontsize=LETTER, ha="center", va="top",
        rotation=float(np.degrees(np.arctan2(-along[1], along[0]))), rotation_mode="anchor", zorder=4,
    )  # fmt: skip


def draw_numbers_in_view(axes: Axes, owner: Int[np.ndarray, "h w"], count: int) -> None:
    """Draw the numbers of the objects into the camera's image, each in the middle of its pixels.

    Args:
      axes: with the image.
      owner: index of the object at each pixel; other numbers for none.
      count: number of objects.
    """
    for i in range(count):
        rows, columns = np.nonzero(owner == i)
        if len(rows) > 200:
            number(axes, (float(np.median(columns)), float(np.median(rows))), i)


def draw_legend(figure: Figure, y: float, size: float = LETTER) -> None:
    """Draw the legend of the map's colours, in one line at the height `y` of the figure (0 to 1), in a font size."""
    marks = [patches.Patch(facecolor=(*rgb(b.colour), 0.95), label=b.label) for b in bands()]
    marks.append(patches.Patch(facecolor=TARGET, label="target, found"))
    marks.append(patches.Patch(facecolor="none", edgecolor=TARGET, linestyle=(0, (2, 1.5)), label="target, hidden"))
    title = "Where the target can be, and what a grasp there would meet"
    legend = figure.legend(handles=marks, **_legend_style(len(marks), y, size), title=title, title_fontsize=size)
    legend.get_title().set_color(MUTED)


def draw_action_legend(figure: Figure, y: float) -> None:
    """Draw the legend of actions, in one line at the height `y` of the figure (0 to 1)."""
    ghost = {"facecolor": (*rgb(ACTION), 0.14), "edgecolor": ACTION, "linestyle": (0, (3, 1.6))}
    marks = [
        patches.Patch(facecolor=(*rgb(HAND), 0.22), edgecolor=HAND, label="the hand as it begins"),
        patches.Patch(facecolor=(*rgb(HAND), 0.05), edgecolor=(*rgb(HAND), 0.4), label="as it ends"),
        patches.Patch(**ghost, label="where objects are expected to go"),
    ]
    figure.legend(handles=marks, **_legend_style(len(marks), y, LETTER))


def _legend_style(columns: int, y: float, size: float) -> dict[str, Any]:
    return {
        "loc": "center", "bbox_to_anchor": (0.5, y), "ncols": columns, "frameon": False, "fontsize": size,
        "handlelength": 1.1, "handleheight": 1.1, "columnspacing": 1.3, "labelcolor": INK, "borderpad": 0,
    }  # fmt: skip


def save_figure(figure: Figure, path: PathLike, dpi: int = 110) -> None:
    """Write a figure as PNG.

    Raises:
      InputError: the file cannot be written.
    """
    with replacing(path) as file:
        figure.savefig(file, format="png", dpi=dpi, facecolor=PAPER)
