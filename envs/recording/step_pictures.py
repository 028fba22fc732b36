"""Pictures of a recorded step: what the camera saw, the shelf from above with f and g, and the recognised shapes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib import patches
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mechsearch_jax.envs.camera.snapshot import Snapshot
from mechsearch_jax.envs.recording.pictures import colour_image
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.recording.step_values import last_world, trouble
from mechsearch_jax.viz import drawing
from mechsearch_jax.viz.blockers import mark_from_above
from mechsearch_jax.viz.filmstrip import Frame, draw_believed, draw_seen

# Width of a picture [inches], and dots per inch.
WIDTH, DPI = 3.6, 190
# Confidence from which a shape is sure, and below which it is doubtful.
SURE, DOUBTFUL = 0.8, 0.5

Picture = UInt8[np.ndarray, "h w 3"]


class Painter:
    """Draws the pictures of one recording at one scale.

    Attributes:
      room: height of what is shown above the board [m].
    """

    def __init__(self, recording: Recording):
        """Args:
        recording: of the episode.
        """
        self._recording = recording
        scenes = [scene for step in recording.steps for scene in (step.scene, step.after)]
        self.room = drawing.height_of(scenes, recording.shelf)

    def seen(self, step: RecordedStep, frame: Frame) -> Picture:
        """What the camera saw at a step, with the action; `frame` is the step's."""
        cell = self._recording
        shown = self._where_it_stands(step, frame)
        return self._view(lambda axes: draw_seen(axes, shown, cell.camera, cell.shelf, cell.target, self.room))

    def believed(self, step: RecordedStep, frame: Frame, blockers: Collection[int] = ()) -> Picture:
        """f and g from above, the recognised objects, the target's true pose, and the action.

        Args:
          step: of the recording.
          frame: its picture.
          blockers: the objects that are marked as in the way.
        """
        shelf, target = self._recording.shelf, self._recording.target
        shown = self._where_it_stands(step, frame)

        def draw(axes: Axes) -> None:
            draw_believed(axes, shown, shelf, target)
            drawing.draw_objects(axes, shown.scene)
            mark_from_above(axes, shown.scene, blockers)
            if shown.target_pose is not None:
                drawing.draw_target(axes, shown.target_pose, target, shown.found)

        return _drawn(drawing.map_share(shelf), draw)

    def recognised(self, step: RecordedStep, frame: Frame, confidence: Float[np.ndarray, " n"]) -> Picture:
        """The outlines of the recognised shapes over what the camera saw, coloured by how sure recognition is."""

        def draw(axes: Axes) -> None:
            drawing.draw_view(axes, frame.image, self._recording.camera, self._recording.shelf, self.room)
            for i, outline in enumerate(drawing.outlines_in_view(step.scene, self._recording.camera)):
                if outline is None:
                    continue
                sure = float(confidence[i])
                style = {"facecolor": "none", "edgecolor": colour_of(sure), "linewidth": 1.6}
                axes.add_patch(patches.Polygon(outline, closed=True, **style))
                x, y = outline.mean(axis=0)
                text = drawing.number(axes, (float(x), float(y)), i)
                # More would cover what it is about; at the upper edge it stands clear of the number of what is before.
                if sure < SURE:
                    text.set(text=f"{i}: {100 * sure:.0f} %", y=float(outline[:, 1].min()))

        return self._view(draw)

    def end(self) -> Picture:
        """What the camera would see after the last action."""
        cell = self._recording
        world = jax.tree.map(jnp.asarray, last_world(cell.steps[-1]))
        image = Snapshot(cell.camera, cell.shelf, world).image

        def draw(axes: Axes) -> None:
            drawing.draw_view(axes, colour_image(image), cell.camera, cell.shelf, self.room)
            drawing.draw_numbers_in_view(axes, np.asarray(image.segmentation), cell.steps[-1].scene.capacity)

        return self._view(draw)

    def _where_it_stands(self, step: RecordedStep, frame: Frame) -> Frame:
        """The frame without the target's pose where it no longer stands there, or nobody knows where it is."""
        known = np.isfinite(step.target_pose).all() and trouble(self._recording, step) is None
        return frame if known else dataclasses.replace(frame, target_pose=None)

    def _view(self, draw: Callable[[Axes], None]) -> Picture:
        left, right, top, bottom = drawing.view_window(self._recording.camera, self._recording.shelf, self.room)
        return _drawn((bottom - top) / (right - left), draw)


def colour_of(sure: float) -> str:
    """The colour of a recognised shape by how sure recognition is; blue where nothing says so."""
    return drawing.TARGET if sure < DOUBTFUL else drawing.WARNING if sure < SURE else drawing.ACTION


def _drawn(share: float, draw: Callable[[Axes], None]) -> Picture:
    """A picture whose height is a share of its width."""
    figure = Figure(figsize=(WIDTH, WIDTH * share), dpi=DPI, facecolor=drawing.PAPER)
    canvas = FigureCanvasAgg(figure)
    draw(figure.add_axes((0.0, 0.0, 1.0, 1.0)))
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])
