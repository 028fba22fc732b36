"""A search in the browser: the robot acts, and every decision is shown with the belief.

The server sends still geometry once, a decision's when its step begins, and only poses of what moves.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mechsearch_jax.envs.recording.playback import Playback, playback
from mechsearch_jax.envs.recording.recording import Recording
from mechsearch_jax.envs.recording.shown_decisions import predicted, sampled_sketch
from mechsearch_jax.envs.recording.step_pictures import Picture
from mechsearch_jax.envs.recording.step_values import Ending, ending
from mechsearch_jax.envs.viewer.shown import ShownStep, card, legend, shown_steps, title
from mechsearch_jax.envs.viewer.stage import LAYERS, VISIBLE, Pose, Stage
from mechsearch_jax.envs.world.world import World
from mechsearch_jax.viz import sketches
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

if TYPE_CHECKING:
    import viser

# The entry of the list of sampled actions that stands for the decision itself.
CHOSEN: str = "the one that was chosen"
# Quality of the panel's pictures.
QUALITY = 88
_NO_PICTURE = np.full((2, 2, 3), 255, np.uint8)


class Viewer:
    """The page of a search.

    Attributes:
      count: number of moments.
      row: index of the moment that is shown.
      playing: whether time advances.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        heading: str,
        camera: Camera,
        shelf: Shelf,
        fps: int,
        *,
        steps: Sequence[ShownStep] = (),
        played: Playback | None = None,
        visible: Collection[str] = VISIBLE,
    ):
        """Args:
        server: shows the page; must not be shared.
        heading: at the top.
        camera, shelf: of the problem.
        fps: moments in a second.
        steps: that are shown; more may be added.
        played: how all moved meanwhile; none before the first step.
        visible: the layers that are shown at first.
        """
        self._server, self._shelf, self._fps = server, shelf, fps
        self.count, self.row, self.playing = 0, 0, False
        self._lock, self._step = threading.RLock(), -1
        self._examined: Any = None
        self._steps: list[ShownStep] = []
        self._nodes: list[list[Any]] = []
        self._played: Playback | None = None
        self._moving: dict[str, tuple[Any, Pose]] = {}
        self._stage = Stage(server, camera, shelf, visible)
        self._panel(heading, played, visible)
        if played is not None:
            self.add(steps, played)
            self.show(0)

    @classmethod
    def of(cls, recording: Recording, server: viser.ViserServer, fps: int, speed: float = 1.0) -> Viewer:
        """The page of a recorded episode.

        Args:
          recording: of the episode.
          server: shows the page; must not be shared.
          fps: moments in a second.
          speed: as a multiple of real time.
        """
        played, steps = playback(recording, fps, speed), shown_steps(recording)
        viewer = cls(server, recording.heading, recording.camera, recording.shelf, fps, steps=steps, played=played)
        viewer.add_bodies(recording.steps[0].world)
        viewer.end(ending(recording))
        return viewer

    def add(self, steps: Sequence[ShownStep], played: Playback) -> None:
        """Show further steps.

        Args:
          steps: in their order.
          played: how all moved at these steps, whose indices and times go on after those that are there.
        """
        with self._lock, self._server.atomic():
            for step in steps:
                self._nodes.append(self._stage.decision(len(self._steps), step, self.examine))
                self._steps.append(step)
            whole = played if self._played is None else Playback(*map(_joined, self._played, played))
            self._played, self.count = whole, len(whole.time)
            self._moving |= self._stage.robot_poses(whole)
            self._slider.max = max(float(whole.time[-1]), self._slider.step)
            self._choice.options = tuple(step.title for step in self._steps)

    def add_bodies(self, world: World) -> None:
        """Show the true bodies of a world, which move as what is played has it."""
        played = self._played
        assert played is not None
        with self._lock, self._server.atomic():
            self._moving |= self._stage.bodies(world, played)
            self.show(self.row)

    def end(self, how: Ending) -> None:
        """Say how the search ended, or where it is."""
        self._card.content = card(how)

    def show(self, row: int) -> None:
        """Show a moment.

        Args:
          row: its index, clipped to the first and last.
        """
        if self._played is None:
            return
        with self._lock, self._server.atomic():
            self.row = min(max(row, 0), self.count - 1)
            for node, pose in self._moving.values():
                # Those that did not change are not sent.
                node.position, node.wxyz = pose.position[self.row], pose.wxyz[self.row]
            step = self.step_at(self.row)
            if step != self._step:
                self._decide(step)
            self._stage.place_numbers(self._played, self.row, self._steps[step].recorded.world)
            self._slider.value = round(float(self._played.time[self.row]), 2)

    @property
    def text(self) -> str:
        """The text of the present decision."""
        return self._text.content

    @property
    def ended(self) -> str:
        """How the search ended."""
        return self._card.content

    @property
    def evidence(self) -> str:
        """What lies behind the present decision."""
        return self._evidence.content

    @property
    def pictures(self) -> dict[str, Picture]:
        """The pictures of the present decision: "above", and "seen"."""
        return {"above": self._above.image, "seen": self._seen.image}

    def step_at(self, row: int) -> int:
        """Index of the step that a moment belongs to."""
        return -1 if self._played is None else int(self._played.step[row])

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

    def _panel(self, heading: str, played: Playback | None, visible: Collection[str]) -> None:
        gui = self._server.gui
        gui.configure_theme(control_width="large", show_share_button=False, show_logo=False)
        gui.main_panel.dock_right()
        gui.add_html(title(heading))
        self._card = gui.add_html("")
        marks = () if played is None else _marks(played)
        self._slider = gui.add_slider("time [s]", 0.0, 1.0, 0.01, 0.0, marks=marks)
        self._button = gui.add_button("play")
        self._choice = gui.add_dropdown("decision", _no_steps())
        self._text = gui.add_html("")
        self._above = gui.add_image(_NO_PICTURE, label="f and g from above", jpeg_quality=QUALITY)
        gui.add_html(legend())
        self._seen = gui.add_image(_NO_PICTURE, label="what the camera saw", jpeg_quality=QUALITY)
        self._sample = gui.add_dropdown("action", (CHOSEN,), visible=False)
        with gui.add_folder("what was compared, trials, and what was recognised"):
            self._evidence = gui.add_html("")
            self._perceived = gui.add_image(
                _NO_PICTURE, label="recognised shapes; yellow: less than 80 % sure, red: less than 50 %",
                jpeg_quality=QUALITY, visible=False,
            )  # fmt: skip
        with gui.add_folder("layers"):
            for name, label in LAYERS.items():
                # Nobody knows the true shapes of a search that runs.
                if name == "true" and played is None:
                    continue
                self._switch(name, gui.add_checkbox(label, name in visible))
        # The server's own changes call back, too, without a client.
        self._slider.on_update(lambda event: event.client and self._seek(self._row_at(self._slider.value)))
        self._choice.on_update(lambda event: event.client and self._seek(self._begins(self._choice.value)))
        self._sample.on_update(lambda event: event.client and self.examine(self._index(self._sample.value)))
        self._button.on_click(lambda event: self.play(not self.playing))

    def _row_at(self, time: float) -> int:
        """The moment next to a time [s]."""
        return 0 if self._played is None else int(np.abs(self._played.time - time).argmin())

    def _begins(self, title: str) -> int:
        """The first moment of a step by its title."""
        titles = [step.title for step in self._steps]
        if self._played is None or title not in titles:
            return 0
        return int(np.argmax(self._played.step == titles.index(title)))

    def _seek(self, row: int) -> None:
        self.play(False)
        self.show(row)

    def _switch(self, name: str, box: Any) -> None:
        def switched(event: object) -> None:
            self._stage.layers[name].visible = box.value

        box.on_update(switched)

    def _decide(self, step: int) -> None:
        """Show a step's geometry, pictures and words instead of the previous step's."""
        if self._step >= 0:
            for node in self._nodes[self._step]:
                node.visible = False
        self._step, shown = step, self._steps[step]
        for node in self._nodes[step]:
            node.visible = True
        self._above.image, self._seen.image = shown.above, shown.decision.view
        self._perceived.visible = shown.perceived is not None
        if shown.perceived is not None:
            self._perceived.image = shown.perceived
        self._evidence.content = shown.evidence
        self._choice.value = shown.title
        self._sample.options = (CHOSEN, *(sample.text for sample in shown.decision.samples))
        self._sample.visible = bool(shown.decision.samples)
        self.examine(None)

    def examine(self, k: int | None) -> None:
        """Show the predicted effect of a sampled action of the present decision.

        Args:
          k: its index; None for the chosen action.
        """
        with self._lock, self._server.atomic():
            shown = self._steps[self._step]
            step = shown.recorded
            if self._examined is not None:
                self._examined.remove()
                self._examined = None
            if k is not None:
                sketch = sampled_sketch(step, k)
                ghosts = predicted(step.scene, step.sampled.after(k, step.scene), sketch)
                self._examined = self._stage.prediction("examined", ghosts, sketches.shown_path(sketch, self._shelf))
                self._examined.visible = True
            self._nodes[self._step][-1].visible = k is None
            label = CHOSEN if k is None else shown.decision.samples[k].text
            self._sample.value = label
            self._text.content = shown.text("" if k is None else label)

    def _index(self, text: str) -> int | None:
        """Index of the sampled action of the present decision with a text; None if there is none."""
        samples = self._steps[self._step].decision.samples if self._steps else []
        return next((k for k, sample in enumerate(samples) if sample.text == text), None)


def _no_steps() -> tuple[str, ...]:
    return ("",)


def _joined(before: np.ndarray, more: np.ndarray) -> np.ndarray:
    return np.concatenate([before, more])


def _marks(played: Playback) -> tuple[tuple[float, str], ...]:
    """The numbers of the steps on the time line, where each begins."""
    steps, rows = np.unique(played.step, return_index=True)
    return tuple((float(played.time[row]), str(step + 1)) for step, row in zip(steps, rows, strict=True))
