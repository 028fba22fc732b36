"""What the viewer shows of each step of a recording: pictures, meshes and values."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np

from mechsearch_jax.envs.recording.pictures import recorded_frame
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.recording.shown_decisions import Ghost, ShownDecision, shown_decision
from mechsearch_jax.envs.recording.step_pictures import Painter, Picture, colour_of
from mechsearch_jax.envs.recording.step_values import Ending, StepValues, confidence, environment, step_values
from mechsearch_jax.viz import drawing, web
from mechsearch_jax.viz.blockers import MARK
from mechsearch_jax.viz.filmstrip import Frame

# How far the mark of an object in the way stands off its surface [m].
OFF = 0.004
# Colours of the panel's words.
COLOURS = {"good": drawing.GRASPABLE, "poor": "#9a5b12", "bad": drawing.TARGET, "idle": drawing.WALL}
_TEMPLATE = Path(__file__).with_name("panel.html.jinja")


@dataclasses.dataclass(frozen=True, eq=False)
class ShownStep:
    """What is shown of a step.

    Attributes:
      values: what the recording holds of it.
      why: the reason of the decision, in one line.
      recorded: the step.
      decision: meshes, and what the camera saw.
      above: the shelf from above with f and g.
      perceived: the outlines of the recognised shapes by how sure they are; None where the true shapes were given.
      recognised: the recognised shapes.
      blocked: the marks of the objects that the best grasps of a found target hit.
    """

    values: StepValues
    why: str
    recorded: RecordedStep
    decision: ShownDecision
    above: Picture
    perceived: Picture | None
    recognised: list[Ghost]
    blocked: list[Ghost]

    @property
    def title(self) -> str:
        """The step's number and what is done."""
        return f"{self.values.number}. {self.values.heading}"

    def text(self, examined: str = "") -> str:
        """What was believed and decided, as HTML; `examined` is the candidate whose prediction is shown."""
        return str(_panel().step(self.values, self.why, examined))

    @property
    def evidence(self) -> str:
        """Candidates, trials and what perception saw, as HTML."""
        return str(_panel().evidence(self.values))


def shown_steps(recording: Recording) -> list[ShownStep]:
    """What is shown of each step; the camera's images are ray-cast again."""
    painter = Painter(recording)
    frames = (recorded_frame(step, recording.camera, recording.shelf) for step in recording.steps)
    return [shown_step(recording, i, frame, painter) for i, frame in enumerate(frames)]


def shown_step(
    recording: Recording,
    i: int,
    frame: Frame,
    painter: Painter,
    values: StepValues | None = None,
    why: str | None = None,
) -> ShownStep:
    """What is shown of a step.

    Args:
      recording: of the episode.
      i: index of the step.
      frame: its picture.
      painter: of the recording.
      values: of the step; those of the recording if left out.
      why: the reason of the decision; that of the frame's caption if left out.
    """
    step, sure = recording.steps[i], confidence(recording.steps[i])
    values = step_values(recording, i) if values is None else values
    return ShownStep(
        values=values,
        # Before that, a caption says what the belief's values say.
        why=frame.caption.partition(" · ")[2] if why is None else why,
        recorded=step,
        decision=shown_decision(step, frame, recording, painter.room),
        above=painter.believed(step, frame, values.blocked),
        perceived=painter.recognised(step, frame, sure) if values.shapes else None,
        recognised=[(name, mesh, colour_of(float(sure[int(name)])), 0.45) for name, mesh in _meshes(step)],
        blocked=[(name, mesh, MARK, 0.5) for name, mesh in _meshes(step, OFF) if int(name) in values.blocked],
    )


def _meshes(step: RecordedStep, off: float = 0.0) -> list[tuple[str, web.Mesh]]:
    """The recognised shapes by their numbers, larger by a margin [m]."""
    larger = step.scene.replace(size=np.asarray(step.scene.size) + off)
    return [(str(i), mesh) for i, mesh in enumerate(web.meshes_of(larger)) if mesh is not None]


def card(end: Ending) -> str:
    """How an episode ended, as HTML."""
    return str(_panel().card(end))


def title(heading: str) -> str:
    """A heading, as HTML."""
    return str(_panel().title(heading))


def legend() -> str:
    """What the colours of the map mean, as HTML."""
    return str(_panel().legend(drawing.bands(), "Where the target can be, and what a grasp there would meet:"))


@functools.cache
def _panel() -> Any:
    """The macros of the panel."""
    templates = environment(_TEMPLATE.parent)
    templates.globals |= {**COLOURS, "nothing": "Nothing was compared, and there were no trials."}
    return templates.get_template(_TEMPLATE.name).module
