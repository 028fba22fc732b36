"""A recorded episode in the browser: the robot acts, and every decision is shown with the belief.

The server sends still geometry once, a decision's when its step begins, and only poses of what moves.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.recording.film import LOOKS_AT, STANDS, shelf_solids, slot_colour
from mechsearch_jax.envs.recording.playback import playback
from mechsearch_jax.envs.recording.recording import Recording
from mechsearch_jax.envs.recording.shown_decisions import (
    Ghost,
    ShownDecision,
    predicted,
    sampled_sketch,
    shown_decisions,
)
from mechsearch_jax.robot.arm_clearance import link_poses
from mechsearch_jax.shapes import in_order
from mechsearch_jax.viz import drawing, sketches, web
from mechsearch_jax.viz.panda import panda_pieces
from mechsearch_jax.viz.raycast import Solid
from mechsearch_jax.workspace.camera import Camera

if TYPE_CHECKING:
    import viser

# Scales the distance of the film's bystander, since a browser's window shows more.
NEARER = 0.8
# Length of an arrow's head, and radius of its shaft [m].
HEAD, SHAFT = 0.03, 0.004
# Intensities of the lights.
AMBIENT_LIGHT, LIGHT_ABOVE = 1.4, 1.6
# Layers that can be hidden: label, and whether shown at first.
LAYERS = {
    "robot": ("robot", True),
    "true": ("true shapes", True),
    "recognised": ("recognised", False),
    "map": ("f and g", True),
    "action": ("prediction", True),
    "sampled": ("samples", True),
    "camera": ("camera", False),
}
# The entry of the list of sampled actions that stands for the decision itself.
CHOSEN: str = "the one that was chosen"
LEGEND = "Where the target can be, and what a grasp there would meet: "


class Pose(NamedTuple):
    """Poses of a node, one for each row.

    Attributes:
      position: [m], shape (rows, 3).
      wxyz: unit quaternions, shape (rows, 4).
    """

    position: Float[np.ndarray, "rows 3"]
    wxyz: Float[np.ndarray, "rows 4"]

    @classmethod
    def of(cls, position: Float[np.ndarray, "rows 3"], rotation: Float[np.ndarray, "rows 3 3"]) -> Pose:
        return cls(position, Rotation.from_matrix(rotation).as_quat(scalar_first=True))


class Viewer:
    """The page of an episode.

    Attributes:
      count: number of moments.
      row: index of the moment that is shown.
      playing: whether time advances.
    """

    def __init__(self, recording: Recording, server: viser.ViserServer, fps: int, speed: float = 1.0):
        """Args:
        recording: of the episode.
        server: shows the page; must not be shared.
        fps: moments in a second.
        speed: as a multiple of real time.
        """
        self._recording, self._server, self._fps = recording, server, fps
        self._played = playback(recording, fps, speed)
        self.count, self.row, self.playing = len(self._played.time), 0, False
        self._lock, self._step = threading.RLock(), -1
        self._examined: Any = None
        self._decisions = shown_decisions(recording)
        self._still()
        self._nodes = [self._decision(i, decision) for i, decision in enumerate(self._decisions)]
        self._moving = {**self._robot(), **self._bodies()}
        self._panel()
        self.show(0)

    def show(self, row: int) -> None:
        """Show a moment.

        Args:
          row: its index, clipped to the first and last.
        """
        with self._lock, self._server.atomic():
            self.row = min(max(row, 0), self.count - 1)
            for node, pose in self._moving.values():
                # Those that did not change are not sent.
                node.position, node.wxyz = pose.position[self.row], pose.wxyz[self.row]
            step = self.step_at(self.row)
            if step != self._step:
                self._decide(step)
            self._slider.value = round(float(self._played.time[self.row]), 2)

    @property
    def text(self) -> str:
        """The text of the present decision."""
        return self._text.content

    def step_at(self, row: int) -> int:
        """Index of the step that a moment belongs to."""
        return int(self._played.step[row])

    def play(self, on: bool) -> None:
        """Start or pause; starting at the end restarts from the beginning."""
        with self._lock:
            if on and self.row == self.count - 1:
                self.show(0)
            self.playing = on
            self._button.label = "pause" if on else "play"

    def run(self, going: Callable[[], bool] = lambda: True) -> None:
        """Advance time whenever `playing` is on.

        Args:
          going: called at every moment; the loop ends when it returns False.
        """
        due = time.monotonic()
        while going():
            if self.playing:
                self.show(self.row + 1)
                if self.row == self.count - 1:
                    self.play(False)
            # A moment that comes late delays those after it.
            due = max(due + 1 / self._fps, time.monotonic())
            time.sleep(max(due - time.monotonic(), 0.0))

    def _still(self) -> None:
        scene, shelf = self._server.scene, self._recording.shelf
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        # The usual lights are so bright that colours fade.
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(None)
        scene.add_light_ambient("/lights/everywhere", intensity=AMBIENT_LIGHT)
        scene.add_light_directional("/lights/above", intensity=LIGHT_ABOVE, position=(-0.6, 0.8, 1.5))
        edge = np.array([shelf.front, (shelf.left + shelf.right) / 2, shelf.board])
        self._server.initial_camera.position = edge + NEARER * STANDS
        self._server.initial_camera.look_at = edge + LOOKS_AT
        self._layers = {name: scene.add_frame(f"/{name}", show_axes=False, visible=LAYERS[name][1]) for name in LAYERS}
        for name, board in shelf_solids(shelf).items():
            self._mesh(f"/shelf/{name}", web.mesh_of([board]), board.colour)
        _frustum(scene, self._recording.camera)

    def _robot(self) -> dict[str, tuple[Any, Pose]]:
        """The robot's nodes with poses: links, hand, and fingers, which move along the hand's second axis."""
        poses, half = link_poses(self._played.q), self._played.opening[:, None] / 2
        hand = poses[:, 7]
        shift = hand[:, :3, 1] * half
        moved = [(poses[:, i, :3, 3], poses[:, i, :3, :3]) for i in range(8)]
        moved += [(hand[:, :3, 3] + side * shift, hand[:, :3, :3]) for side in (1, -1)]
        *pieces, foot = panda_pieces()
        self._mesh("/robot/foot", web.mesh_of(foot), foot[0].colour)
        names = [*(f"/robot/link{i}" for i in range(1, 8)), "/robot/hand", "/robot/left", "/robot/right"]
        return {
            name: (self._mesh(name, web.mesh_of(solids), solids[0].colour), Pose.of(*pose))
            for name, solids, pose in zip(names, pieces, moved, strict=True)
        }

    def _bodies(self) -> dict[str, tuple[Any, Pose]]:
        world, played = self._recording.steps[0].world, self._played
        nodes: dict[str, tuple[Any, Pose]] = {}
        for i in np.flatnonzero(world.valid).tolist():
            shape, half = in_order()[int(world.kind[i])], np.asarray(world.half_size[i])
            mesh = web.mesh_of([Solid(shape, half, np.eye(3), np.zeros(3), slot_colour(i))])
            name = f"/true/{'target' if i == len(world.valid) - 1 else i}"
            pose = Pose.of(played.position[:, i], played.rotation[:, i])
            nodes[name] = self._mesh(name, mesh, slot_colour(i)), pose
        return nodes

    def _panel(self) -> None:
        gui, recording, played = self._server.gui, self._recording, self._played
        gui.configure_theme(control_width="large", show_share_button=False, show_logo=False)
        gui.main_panel.dock_right()
        gui.add_markdown(f"**{recording.heading}**")
        self._titles = [f"{i + 1}. {step.title.split(maxsplit=1)[-1]}" for i, step in enumerate(recording.steps)]
        begins = [int(np.argmax(played.step == i)) for i in range(len(recording.steps))]
        last, apart = float(played.time[-1]), float(played.time[1] - played.time[0]) if self.count > 1 else 0.1
        marks = tuple((float(played.time[row]), str(i + 1)) for i, row in enumerate(begins))
        self._slider = gui.add_slider("time [s]", 0.0, max(last, apart), 0.01, 0.0, marks=marks)
        self._button = gui.add_button("play")
        self._choice = gui.add_dropdown("decision", self._titles)
        self._text = gui.add_markdown("")
        self._sample = gui.add_dropdown("action", (CHOSEN,), visible=False)
        self._views = [
            gui.add_image(decision.view, label="what the camera saw", visible=False) for decision in self._decisions
        ]
        for name, (label, shown) in LAYERS.items():
            self._switch(name, gui.add_checkbox(label, shown))
        bands = drawing.bands()
        colours = ", ".join(f'<b style="color:{band.colour}">{band.label}</b>' for band in bands)
        gui.add_html(f'<div style="font-size:small;padding:0 1em">{LEGEND}{colours}</div>')
        # The server's own changes call back, too, without a client.
        self._slider.on_update(lambda event: event.client and self._seek(round(self._slider.value / apart)))
        self._choice.on_update(
            lambda event: event.client and self._seek(begins[self._titles.index(self._choice.value)])
        )
        self._sample.on_update(lambda event: event.client and self.examine(self._index(self._sample.value)))
        self._button.on_click(lambda event: self.play(not self.playing))

    def _seek(self, row: int) -> None:
        self.play(False)
        self.show(row)

    def _switch(self, name: str, box: Any) -> None:
        def switched(event: object) -> None:
            self._layers[name].visible = box.value

        box.on_update(switched)

    def _decision(self, i: int, decision: ShownDecision) -> list[Any]:
        """Send the geometry of a step, hidden, so that little is left to be sent when the step begins."""
        scene = self._server.scene
        frames = [
            scene.add_frame(f"/{name}/{i}", show_axes=False, visible=False) for name in ("recognised", "map", "sampled")
        ]
        for ghost in decision.recognised:
            self._ghost(f"/recognised/{i}", *ghost)
        if len(decision.cells.position):
            _map(scene, f"/map/{i}/cells", decision.cells)
        for k, sample in enumerate(decision.samples):
            if sample.arrow is not None:
                node = self._mesh(f"/sampled/{i}/{k}", sample.arrow, sample.colour, 0.9)
                node.on_click(lambda event, k=k: self.examine(k))
        return [*frames, self._prediction(str(i), decision.ghosts, decision.path)]

    def _prediction(self, name: str, ghosts: list[Ghost], path: Float[np.ndarray, "points 3"] | None) -> Any:
        """Send the predicted effect of an action, hidden."""
        frame = self._server.scene.add_frame(f"/action/{name}", show_axes=False, visible=False)
        for ghost in ghosts:
            self._ghost(f"/action/{name}", *ghost)
        if path is not None:
            _arrow(self._server.scene, f"/action/{name}", path)
        return frame

    def _decide(self, step: int) -> None:
        """Show a step's geometry instead of the previous step's."""
        if self._step >= 0:
            for node in (*self._nodes[self._step], self._views[self._step]):
                node.visible = False
        self._step, decision = step, self._decisions[step]
        for node in (*self._nodes[step], self._views[step]):
            node.visible = True
        self._choice.value = self._titles[step]
        self._sample.options = (CHOSEN, *(sample.text for sample in decision.samples))
        self._sample.visible = bool(decision.samples)
        self.examine(None)

    def examine(self, k: int | None) -> None:
        """Show the predicted effect of a sampled action of the present decision.

        Args:
          k: its index; None for the chosen action.
        """
        with self._lock, self._server.atomic():
            step, decision = self._recording.steps[self._step], self._decisions[self._step]
            if self._examined is not None:
                self._examined.remove()
                self._examined = None
            if k is not None:
                sketch = sampled_sketch(step, k)
                ghosts = predicted(step.scene, step.sampled.after(k, step.scene), sketch)
                self._examined = self._prediction(
                    "examined", ghosts, sketches.shown_path(sketch, self._recording.shelf)
                )
                self._examined.visible = True
            self._nodes[self._step][-1].visible = k is None
            label = CHOSEN if k is None else decision.samples[k].text
            self._sample.value = label
            self._text.content = decision.text if k is None else f"{decision.text}\n\nPredicted of {label}"

    def _index(self, text: str) -> int | None:
        """Index of the sampled action of the present decision with a text; None if there is none."""
        samples = self._decisions[self._step].samples
        return next((k for k, sample in enumerate(samples) if sample.text == text), None)

    def _ghost(self, parent: str, name: str, mesh: web.Mesh, colour: str, opacity: float) -> Any:
        return self._mesh(f"{parent}/{name}", mesh, tuple(drawing.rgb(colour)), opacity)

    def _mesh(self, name: str, mesh: web.Mesh, colour: tuple[float, ...], opacity: float | None = None) -> Any:
        red, green, blue = (round(255 * c) for c in colour)
        return self._server.scene.add_mesh_simple(
            name, mesh.vertices, mesh.faces, color=(red, green, blue), opacity=opacity, flat_shading=opacity is None,
            cast_shadow=opacity is None, side="double",
        )  # fmt: skip


def _map(scene: Any, name: str, cells: web.Cells) -> None:
    """f and g on the board."""
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(cells.position), 1))
    scene.add_batched_meshes_simple(
        name, *cells.mesh, level, cells.position, batched_colors=cells.colour,
        batched_opacities=cells.opacity, side="double", cast_shadow=False, receive_shadow=False,
    )  # fmt: skip


def _arrow(scene: Any, parent: str, path: Float[np.ndarray, "points 3"]) -> None:
    """A line along a path with an arrow at its end; nothing for a path that is too short to be seen."""
    back = np.linalg.norm(path - path[-1], axis=1)
    if back[0] <= sketches.SHORTEST:
        return
    # The head begins where the path comes near its end for the last time.
    first = int(np.flatnonzero(back >= min(HEAD, back.max()))[-1])
    tail = path[[first, -1]]
    colour = tuple(round(255 * c) for c in drawing.rgb(drawing.ACTION))
    style = {"shaft_radius": SHAFT, "head_radius": 3 * SHAFT, "head_length": min(HEAD, 0.8 * float(back[first]))}
    scene.add_arrows(f"{parent}/arrow", tail[None], colour, **style)
    if first > 0:
        points = np.stack([path[:first], path[1 : first + 1]], axis=1)
        scene.add_line_segments(f"{parent}/path", points, colour, thickness=2 * SHAFT)


def _frustum(scene: Any, camera: Camera) -> None:
    """The frustum of the camera that looks at the shelf."""
    wxyz = Rotation.from_matrix(np.array(camera.rotation)).as_quat(scalar_first=True)
    angle = 2 * float(np.arctan(camera.height / 2 / camera.fy))
    scene.add_camera_frustum(
        "/camera/frustum", angle, camera.width / camera.height, scale=0.12, wxyz=wxyz, position=camera.position
    )
