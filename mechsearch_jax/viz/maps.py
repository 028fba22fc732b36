"""The figure of f and g for one scene."""

from __future__ import annotations

import dataclasses
import zipfile

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing
from mechsearch_jax.viz import drawing
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

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
    """Draw the camera's view, and from above f, g, and g where f allows the target.

    Args:
      maps: f and g and the objects.
      image: the camera's view.
      owner: index of the object at each pixel; other numbers for none.
      target_pose: x, y [m] and yaw [rad] of the true target, drawn dashed.
      camera, shelf, target: of the problem.
      heading: one line at the top.

    Returns:
      The figure, which pyplot does not know.
    """
    left, right, top, bottom = drawing.view_window(camera, shelf)
    map_height = _WIDTH * drawing.map_share(shelf)
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
    everywhere = np.ones_like(maps.existence)
    view = panel(_GAP, low, view_width, view_height, "What the camera sees")
    drawing.draw_view(view, image, camera, shelf)
    drawing.draw_numbers_in_view(view, owner, maps.scene.capacity)

    first, second = 2 * _GAP + view_width, 3 * _GAP + view_width + _WIDTH
    upper = low + map_height + 0.4
    possible = int(maps.existence.sum())
    both = int((maps.existence & (maps.graspability == 1)).sum())
    where_f = drawing.map_image(maps.existence, np.ones_like(maps.graspability), target)
    where_f[..., :3] = drawing.rgb(drawing.ACTION)
    everywhere_g = drawing.map_image(everywhere, maps.graspability, target)
    where_both = drawing.map_image(maps.existence, maps.graspability, target)
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
    drawing.draw_legend(figure, 0.3 / height)
    return figure


def _draw_counts(axes: Axes, maps: Maps) -> None:
    """Number of possible poses by colour of the map."""
    bands = drawing.bands()
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


@dataclasses.dataclass(frozen=True)
class Maps:
    """f and g over all candidate poses, and the objects from which they were computed.

    Attributes:
      poses: x, y [m] and yaw [rad] of the candidate poses.
      existence: where the target can be.
      graspability: 1 where it could be grasped, else 1 minus the number of objects in the way.
      scene: the objects, as NumPy arrays.
    """

    poses: Float[np.ndarray, "x 3"]
    existence: Bool[np.ndarray, " x"]
    graspability: Int[np.ndarray, " x"]
    scene: Superquadrics


# Of objects, and of their parts, if there are any, after `_OF_PARTS`.
_SCENE_FIELDS, _OF_PARTS = ("size", "exponents", "position", "rotation", "valid"), "parts "


def save_maps(maps: Maps, path: PathLike) -> None:
    """Write maps as a compressed npz file (docs/method.md, "Files").

    Raises:
      InputError: the file cannot be written.
    """
    arrays = {"poses": maps.poses, "existence": maps.existence, "graspability": maps.graspability}
    scene = {name: np.asarray(getattr(maps.scene, name)) for name in _SCENE_FIELDS}
    if maps.scene.parts is not None:
        scene |= {_OF_PARTS + name: np.asarray(getattr(maps.scene.parts, name)) for name in _SCENE_FIELDS}
    with replacing(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays, **scene)


def load_maps(path: PathLike) -> Maps:
    """Read a file of `save_maps`.

    Raises:
      InputError: the file cannot be read or holds something else.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            scene = Superquadrics(*(file[name] for name in _SCENE_FIELDS))
            if _OF_PARTS + "size" in file:
                scene = scene.replace(parts=Superquadrics(*(file[_OF_PARTS + name] for name in _SCENE_FIELDS)))
            return Maps(file["poses"], file["existence"], file["graspability"], scene)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (KeyError, ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: holds no maps ({error})") from error
