"""The film of a recorded episode: a bystander's view of the robot beside the planner's maps."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, UInt8

from mechsearch_jax.envs.camera.simulated_camera import AMBIENT, BACKGROUND_COLOUR, LIGHT, SHELF
from mechsearch_jax.envs.recording.body_solids import body_points, body_solids, moved, slot_colour
from mechsearch_jax.envs.recording.pictures import recorded_frame
from mechsearch_jax.envs.recording.playback import Playback, playback
from mechsearch_jax.envs.recording.recording import Recording
from mechsearch_jax.envs.world.model import shelf_boxes
from mechsearch_jax.envs.world.world import BODIES
from mechsearch_jax.robot.arm_clearance import link_poses
from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.viz import drawing, sketches
from mechsearch_jax.viz.film import Layout, Moving, Page
from mechsearch_jax.viz.panda import panda_solids
from mechsearch_jax.viz.raycast import Eye, VisibleSolid
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

# The bystander's position, at the left, and the point he looks at, from the middle of the opening's lower edge [m].
STANDS, LOOKS_AT = np.array([-0.56, 1.25, 0.85]), np.array([-0.09, -0.04, 0.03])
# Boards between him and the objects, which are not drawn.
LEFT_OUT = ("ceiling", "left")
# Width of his view, in units of its distance.
VIEW_ANGLE = 1.02


class Film:
    """The pictures of an episode, in order.

    Attributes:
      count: number of pictures.
      size: their width and height in pixels.
    """

    def __init__(self, recording: Recording, width: int, fps: int, speed: float = 1.0):
        """Args:
        recording: of the episode.
        width: of the pictures, in pixels.
        fps: pictures in a second.
        speed: as a multiple of real time.
        """
        self._recording = recording
        self._played = playback(recording, fps, speed)
        self._room = drawing.height_of(
            [s for step in recording.steps for s in (step.scene, step.after)], recording.shelf
        )
        self._layout = Layout.of(width, recording.camera, recording.shelf, self._room)
        self.size, self.count = self._layout.size, len(self._played.time)

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        recording, played = self._recording, self._played
        *_, width, height = self._layout.beside
        eye = Eye(bystander(recording.shelf, width, height), LIGHT, AMBIENT, BACKGROUND_COLOUR)
        empty = eye.picture(list(shelf_solids(recording.shelf).values()))
        poses = link_poses(played.q)
        shown = [body_solids(step.world) for step in recording.steps]

        def beside(row: int) -> UInt8[np.ndarray, "h w 3"]:
            bodies = [
                moved(solid, played.rotation[row, i], played.position[row, i])
                for i, own in shown[int(played.step[row])].items()
                for solid in own
            ]
            solids = [*bodies, *panda_solids(poses[row], float(played.opening[row]))]
            return eye.picture(solids, empty).pixels

        picture = empty.pixels
        with ThreadPoolExecutor(cores()) as pool:
            for index, rows in itertools.groupby(range(self.count), lambda row: int(played.step[row])):
                step = recording.steps[index]
                frame = recorded_frame(step, recording.camera, recording.shelf)
                page = Page(frame, recording.camera, recording.shelf, recording.target, self._room, self._layout)
                points = body_points(step.world)
                # Small lots, so that pictures do not pile up where drawing is slower.
                for lot in _in_lots(rows, 2 * cores()):
                    # Of a robot that stands still the same picture is shown again.
                    drawn = pool.map(beside, [row for row in lot if not played.is_still(row)])
                    for row in lot:
                        picture = picture if played.is_still(row) else next(drawn)
                        yield page.image(picture, _moving(points, played, row, poses[row]))


def bystander(shelf: Shelf, width: int, height: int) -> Camera:
    """The film's camera: at the robot's left, above the shelf."""
    edge = np.array([shelf.front, (shelf.left + shelf.right) / 2, shelf.board])
    position, forward = edge + STANDS, LOOKS_AT - STANDS
    distance = float(np.linalg.norm(forward))
    forward = forward / distance
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    focal = width / VIEW_ANGLE
    rows = tuple((float(a), float(b), float(c)) for a, b, c in rotation)
    x, y, z = (float(p) for p in position)
    return Camera(width, height, focal, focal, width / 2, height / 2, rows, (x, y, z))


def _in_lots(rows: Iterator[int], size: int) -> Iterator[list[int]]:
    while lot := list(itertools.islice(rows, size)):
        yield lot


def shelf_solids(shelf: Shelf) -> dict[str, VisibleSolid]:
    """The shelf's boards by name, without those in `LEFT_OUT`."""
    boxes = {name: box for name, box in shelf_boxes(shelf).items() if name not in LEFT_OUT}
    board, colour = shape_of("box"), slot_colour(SHELF)
    return {
        name: VisibleSolid(board, (high - low) / 2, np.eye(3), (low + high) / 2, colour)
        for name, (low, high) in boxes.items()
    }


def _moving(
    points: Mapping[int, Float[np.ndarray, "points 3"]], played: Playback, row: int, poses: Float[np.ndarray, "8 4 4"]
) -> Moving:
    """The hand and the bodies at a moment, from points around the bodies by slot, in the bodies' frames."""
    bodies = [
        points[i] @ played.rotation[row, i].T + played.position[row, i] if i in points else None for i in range(BODIES)
    ]
    return Moving(bodies, sketches.points_of_hand(poses[7], float(played.opening[row])), float(played.time[row]))
