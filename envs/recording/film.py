"""The film of a recorded episode: a bystander's view of the robot beside the planner's maps."""

from __future__ import annotations

import collections
import itertools
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future

import loky
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
# Pictures that a process draws at once; the most processes, which keep up with the rest of the film; and pictures that
# take as long as a process takes to start.
LOT, MOST, EACH = 24, 4, 50


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
        poses = link_poses(played.q)
        # Of a robot that stands still the same picture is shown again.
        moves = [row for row in range(self.count) if not played.is_still(row)]
        pictures = self._beside(poses, moves)
        picture = np.empty(0)
        for index, rows in itertools.groupby(range(self.count), lambda row: int(played.step[row])):
            step = recording.steps[index]
            frame = recorded_frame(step, recording.camera, recording.shelf)
            page = Page(frame, recording.camera, recording.shelf, recording.target, self._room, self._layout)
            points = body_points(step.world)
            for row in rows:
                picture = picture if played.is_still(row) else next(pictures)
                yield page.image(picture, _moving(points, played, row, poses[row]))

    def _beside(
        self, poses: Float[np.ndarray, "rows 8 4 4"], rows: Sequence[int]
    ) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """The bystander's view of rows, in order; of many in several processes, a little ahead of who takes them."""
        played = self._played
        shown = [body_solids(step.world) for step in self._recording.steps]
        shelf = self._recording.shelf
        eye = Eye(bystander(shelf, *self._layout.beside[2:]), LIGHT, AMBIENT, BACKGROUND_COLOUR)
        empty = eye.picture(shelf_solids(shelf).values())

        def solids(row: int) -> list[VisibleSolid]:
            bodies = [
                moved(solid, played.rotation[row, i], played.position[row, i])
                for i, own in shown[int(played.step[row])].items()
                for solid in own
            ]
            return [*bodies, *panda_solids(poses[row], float(played.opening[row]))]

        lots = [rows[start : start + LOT] for start in range(0, len(rows), LOT)]
        processes = min(cores(), MOST, len(rows) // EACH)
        if processes < 2:
            for lot in lots:
                yield from eye.images(map(solids, lot), empty)
            return
        pool = loky.ProcessPoolExecutor(processes, env={"OPENBLAS_NUM_THREADS": "1"})
        begun: collections.deque[Future[list[UInt8[np.ndarray, "h w 3"]]]] = collections.deque()
        try:
            for lot in lots:
                begun.append(pool.submit(eye.images, [solids(row) for row in lot], empty))
                if len(begun) > 2 * processes:
                    yield from begun.popleft().result()
            for lot in begun:
                yield from lot.result()
        finally:
            pool.shutdown(kill_workers=True)


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
