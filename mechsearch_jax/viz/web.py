"""Parts of the web page of an episode: meshes of the bodies, pictures of observations and beliefs.

Viser, which sends them to the browser, is an optional dependency.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterable
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, UInt8, UInt32
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.viz import drawing, sketches
from mechsearch_jax.viz.filmstrip import Frame, draw_seen
from mechsearch_jax.viz.raycast import VisibleSolid
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Number of points of a recognised shape from pole to pole and around; few suffice for its round edges.
GRID = (17, 33)
# Radius of the shaft of a sampled action's arrow [m].
SHAFT = 0.0025
# Width of the camera's view [pixels].
VIEW_WIDTH = 720
# Share of a cell's width that is coloured, and its height above the board, which would show through [m].
FILLED, LIFT = 0.88, 1.5e-3


def import_viser() -> ModuleType:
    """Import the optional library.

    Raises:
      InputError: it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise InputError(
            f"view needs the library viser ({error}); install it with: pip install 'mechsearch-jax[viewer]'"
        ) from error
    # A browser opens connections ahead of need and drops them unused, which is no error of forty lines.
    logging.getLogger("websockets.server").addFilter(_no_dropped_connection)
    return viser


def _no_dropped_connection(record: logging.LogRecord) -> bool:
    return not (record.exc_info and isinstance(getattr(record.exc_info[1], "__cause__", None), EOFError))


class Mesh(NamedTuple):
    """A surface of triangles.

    Attributes:
      vertices: [m], shape (points, 3).
      faces: indices of vertices, shape (triangles, 3).
    """

    vertices: Float[np.ndarray, "points 3"]
    faces: UInt32[np.ndarray, "triangles 3"]


def mesh_of(solids: Iterable[VisibleSolid]) -> Mesh:
    """One mesh of several solids, in the frame of their poses."""
    parts = []
    for solid in solids:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = solid.rotation, solid.position
        parts.append(solid.surface.mesh([float(h) for h in solid.half_size]).apply_transform(T))
    return _joined(parts)


def meshes_of(scene: Superquadrics) -> list[Mesh | None]:
    """The surface of each object in the world; None for absent objects."""
    return [points if points is None else _surface_mesh(points) for points in _points(scene)]


def _surface_mesh(points: Float[np.ndarray, "points 3"]) -> Mesh:
    """The mesh of an object of one or more parts from the points of `drawing.surfaces`."""
    rows, columns = GRID
    first = np.arange(0, len(points), rows * columns, dtype=np.uint32)
    return Mesh(points.astype(np.float32), (_faces()[None] + first[:, None, None]).reshape(-1, 3))


def hand_mesh(T: Float[np.ndarray, "4 4"], opening: float) -> Mesh:
    """The hand and its fingers in the world.

    Args:
      T: pose of the gripper.
      opening: distance between the fingers [m].
    """
    return _joined([trimesh.convex.convex_hull(points) for points in sketches.hand_points(T, opening)])


def arrow_mesh(start: Float[np.ndarray, " 3"], end: Float[np.ndarray, " 3"]) -> Mesh | None:
    """A straight arrow in the world; None if it is too short. Unlike a line, it can be clicked."""
    way = np.asarray(end, float) - start
    length = float(np.linalg.norm(way))
    if length <= sketches.SHORTEST:
        return None
    head = min(6 * SHAFT, length / 2)
    shaft = trimesh.creation.cylinder(radius=SHAFT, height=length - head, sections=8)
    shaft.apply_translation([0.0, 0.0, (length - head) / 2])
    cone = trimesh.creation.cone(radius=2.5 * SHAFT, height=head, sections=12)
    cone.apply_translation([0.0, 0.0, length - head])
    T = np.array(trimesh.geometry.align_vectors(np.array([0.0, 0.0, 1.0]), way / length))
    T[:3, 3] = start
    return _joined([part.apply_transform(T) for part in (shaft, cone)])


def seen_picture(frame: Frame, camera: Camera, shelf: Shelf, target: Target, room: float) -> UInt8[np.ndarray, "h w 3"]:
    """The camera's view at a step, cut to the shelf, with the objects' numbers and the action.

    Args:
      frame: the step.
      camera, shelf, target: of the problem.
      room: see `drawing.height_of`.
    """
    left, right, top, bottom = drawing.view_window(camera, shelf, room)
    figure = Figure(figsize=(5.0, 5.0 * (bottom - top) / (right - left)), dpi=VIEW_WIDTH / 5.0)
    canvas = FigureCanvasAgg(figure)
    draw_seen(figure.add_axes((0.0, 0.0, 1.0, 1.0)), frame, camera, shelf, target, room)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


class Cells(NamedTuple):
    """f and g as coloured cells on the board: the candidate positions where the target can be.

    Attributes:
      mesh: one cell about the origin, level.
      position: of their centres in the world [m], shape (cells, 3).
      colour: red, green and blue, 0 to 255, shape (cells, 3).
      opacity: 0 to 1, shape (cells,).
    """

    mesh: Mesh
    position: Float[np.ndarray, "cells 3"]
    colour: UInt8[np.ndarray, "cells 3"]
    opacity: Float[np.ndarray, " cells"]


def map_cells(frame: Frame, shelf: Shelf, target: Target) -> Cells:
    """f and g at a step in the colours of the filmstrip."""
    image = drawing.map_image(frame.existence, frame.graspability, target)
    shown = image[..., 3] > 0
    rows, columns = target.grid
    level = target.candidate_poses(shelf).reshape(rows, columns, target.yaws, 3)[shown][:, 0, :2]
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * np.array(target.cell(shelf)[:2]) * FILLED / 2
    mesh = Mesh(np.column_stack([corners, np.zeros(4)]).astype(np.float32), np.array([(0, 1, 2), (0, 2, 3)], np.uint32))
    position = np.column_stack([level, np.full(len(level), shelf.board + LIFT)])
    colour = np.round(255 * image[shown]).astype(np.uint8)[:, :3]
    return Cells(mesh, position.astype(np.float32), colour, image[shown][:, 3].astype(np.float32))


def _joined(parts: list[Any]) -> Mesh:
    whole: Any = trimesh.util.concatenate(parts)
    return Mesh(np.asarray(whole.vertices, np.float32), np.asarray(whole.faces, np.uint32))


def _points(scene: Superquadrics) -> list[Float[np.ndarray, "points 3"] | None]:
    return drawing.surfaces(scene, GRID)


@functools.cache
def _faces() -> UInt32[np.ndarray, "triangles 3"]:
    """Two triangles for each cell of the grid, counter-clockwise from outside."""
    rows, columns = GRID
    index = np.arange(rows * columns).reshape(GRID)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))]).astype(np.uint32)
