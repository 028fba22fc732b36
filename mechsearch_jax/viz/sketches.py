"""Actions in pictures: the hand, an arrow along the motion, and the predicted poses of everything that moves.

All kinds of action are drawn alike, from above and in the camera's image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib import patches
from matplotlib.axes import Axes
from matplotlib.path import Path

from mechsearch_jax.actions.kind import Sketch
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.robot.gripper import RobotPart, fingers, hand_parts
from mechsearch_jax.robot.kinematics import FINGER_TIPS
from mechsearch_jax.viz import drawing
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Smaller motions are not shown [m, and in the rotation matrix].
STAYS = 5e-3
# Shorter arrows are left out [m].
SHORTEST = 0.01

Flat = Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points 2"]]


def from_above(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 2"]:
    """World points in the axes of the picture from above: y across, x upwards."""
    return points[:, 1::-1]


def in_view(camera: Camera) -> Flat:
    """World points as columns and rows of the camera's image."""
    return lambda points: drawing.pixels(camera, points)


def moved(before: Superquadrics, after: Superquadrics) -> Superquadrics:
    """The objects that an action moves, after it; others are absent."""
    fields = [
        (np.asarray(a, float), np.asarray(b, float))
        for a, b in ((before.position, after.position), (before.rotation, after.rotation))
    ]
    differs = [np.abs(b - a).reshape(len(a), -1).max(axis=1) > STAYS for a, b in fields]
    return after.replace(valid=np.asarray(after.valid) & (differs[0] | differs[1]))


def draw_action(
    axes: Axes, flat: Flat, sketch: Sketch, before: Superquadrics, after: Superquadrics, shelf: Shelf
) -> None:
    """Draw an action: its hands, everything that it moves at the predicted poses, and its arrow.

    Args:
      axes: with the shelf.
      flat: maps world points to the axes.
      sketch: of the action.
      before, after: the objects before it, and predicted after it.
      shelf: the arrow ends at most a little in front of it.
    """
    for points in drawing.surfaces(moved(before, after)):
        if points is not None:
            _ghost(axes, flat(points), drawing.ACTION)
    for i, T in enumerate(sketch.hands if sketch.hands is not None else ()):
        for points in hand_points(T, sketch.opening):
            _hand(axes, flat(points), first=i == 0)
    path = shown_path(sketch, shelf)
    if path is not None and np.linalg.norm(path[-1] - path[0]) > SHORTEST:
        _arrow(axes, flat(path))


def draw_taken_target(
    axes: Axes, flat: Flat, sketch: Sketch, pose: Float[np.ndarray, " 3"], target: Target, shelf: Shelf
) -> None:
    """Draw the target at the end of an action that takes it along; nothing for other actions."""
    path = shown_path(sketch, shelf)
    if sketch.takes_target and path is not None:
        _ghost(axes, flat(drawing.target_points(np.array([*path[-1, :2], pose[2]]), target, shelf)), drawing.TARGET)


def shown_path(sketch: Sketch, shelf: Shelf) -> Float[np.ndarray, "points 3"] | None:
    """The part of an action's path that is drawn, at most to a little in front of the shelf."""
    if sketch.path is None:
        return None
    outside = np.flatnonzero(sketch.path[:, 0] < shelf.front - 0.55 * drawing.ROBOT_STRIP)
    return sketch.path[: max(2, int(outside[0]))] if len(outside) else sketch.path


def hand_points(T: Float[np.ndarray, "4 4"], opening: float) -> list[Float[np.ndarray, "points 3"]]:
    """Points whose hulls are the hand and its fingers, in the world [m].

    Args:
      T: pose of the gripper.
      opening: distance between the fingers [m].
    """
    T_world_hand = np.array(T, float)
    T_world_hand[:3, 3] -= FINGER_TIPS * T_world_hand[:3, 2]
    return points_of_hand(T_world_hand, opening)


def points_of_hand(T: Float[np.ndarray, "4 4"], opening: float) -> list[Float[np.ndarray, "points 3"]]:
    """`hand_points` from the pose of the hand."""
    both = fingers(opening)
    half = len(both) // 2
    return [_corners(T, parts) for parts in (both[:half], both[half:], hand_parts())]


def _corners(T: np.ndarray, parts: Sequence[RobotPart]) -> np.ndarray:
    """Corners of boxes given in a frame with the pose `T`."""
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(8, 3)
    poses = [T @ part.T_frame_primitive for part in parts]
    return np.concatenate([(signs * part.size) @ P[:3, :3].T + P[:3, 3] for part, P in zip(parts, poses, strict=True)])


def _ghost(axes: Axes, points: np.ndarray, colour: str) -> None:
    outline = drawing.hull(points)
    axes.add_patch(
        patches.Polygon(
            outline, closed=True, facecolor=(*drawing.rgb(colour), 0.14), edgecolor=colour, lw=1.4,
            linestyle=(0, (3, 1.6)), zorder=6,
        )
    )  # fmt: skip


def _hand(axes: Axes, points: np.ndarray, first: bool) -> None:
    """Draw the hand, paler if it is not the first pose."""
    axes.add_patch(
        patches.Polygon(
            drawing.hull(points), closed=True, facecolor=(*drawing.rgb(drawing.HAND), 0.22 if first else 0.05),
            edgecolor=(*drawing.rgb(drawing.HAND), 0.85 if first else 0.4), lw=0.8, zorder=5.5,
        )
    )  # fmt: skip


def _arrow(axes: Axes, points: Float[np.ndarray, "points 2"]) -> None:
    codes = [Path.MOVETO, *[Path.LINETO] * (len(points) - 1)]
    arrow = patches.FancyArrowPatch(
        path=Path(points, codes), arrowstyle="-|>", mutation_scale=11, color=drawing.ACTION, linewidth=2.0, fill=False,
        joinstyle="miter", zorder=8, clip_on=False, shrinkA=0, shrinkB=0,
    )  # fmt: skip
    arrow.set_path_effects(drawing.halo(2.0))
    axes.add_patch(arrow)
