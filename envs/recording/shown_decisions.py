"""What the viewer's page shows of each decision of a recording: pictures, meshes and texts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from mechsearch_jax.actions import kind_of
from mechsearch_jax.actions.kind import Sketch
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.viz import drawing, sketches, web
from mechsearch_jax.viz.filmstrip import Frame

# Colours of the best and of the worst sampled action.
BEST, WORST = drawing.GRASPABLE, drawing.BLOCKED[-1]

# Name, mesh, colour and opacity.
Ghost = tuple[str, web.Mesh, str, float]


class ShownSample(NamedTuple):
    """A sampled action.

    Attributes:
      text: the action in words, with its value and cost.
      arrow: from start to end of the motion; None if nothing moves.
      colour: red, green and blue, 0 to 1, by its value.
    """

    text: str
    arrow: web.Mesh | None
    colour: tuple[float, ...]


class ShownDecision(NamedTuple):
    """What is shown of a decision.

    Attributes:
      view: the camera's image.
      cells: f and g.
      ghosts: the predicted effect of the action, and the hand.
      path: of the action [m]; None if nothing moves.
      samples: the candidates of the decision, best first.
    """

    view: UInt8[np.ndarray, "h w 3"]
    cells: web.Cells
    ghosts: list[Ghost]
    path: Float[np.ndarray, "points 3"] | None
    samples: list[ShownSample]


def shown_decision(step: RecordedStep, frame: Frame, recording: Recording, room: float) -> ShownDecision:
    """What is shown of the decision of a step.

    Args:
      step: of the recording.
      frame: its picture.
      recording: of the episode.
      room: see `drawing.height_of`.
    """
    camera, shelf, target = recording.camera, recording.shelf, recording.target
    return ShownDecision(
        view=web.seen_picture(frame, camera, shelf, target, room),
        cells=web.map_cells(frame, shelf, target),
        ghosts=predicted(step.scene, step.after, frame.sketch),
        path=sketches.shown_path(frame.sketch, shelf),
        samples=_samples(step),
    )


def predicted(scene: Superquadrics, after: Superquadrics, sketch: Sketch) -> list[Ghost]:
    """Moved objects at their predicted ends, and the hand at start and end of an action."""
    ghosts = _present(web.meshes_of(sketches.moved(scene, after)))
    hands = sketch.hands if sketch.hands is not None else ()
    return [
        *((f"ghost{i}", mesh, drawing.ACTION, 0.4) for i, mesh in ghosts),
        *(
            (f"hand{i}", web.hand_mesh(T, sketch.opening), drawing.HAND, 0.15 if i else 0.35)
            for i, T in enumerate(hands)
        ),
    ]


def _samples(step: RecordedStep) -> list[ShownSample]:
    """The candidates of a decision, coloured by value from `BEST` to `WORST`."""
    sampled = step.sampled
    worst = float(np.ptp(sampled.value)) if len(sampled) else 0.0
    best, last = drawing.rgb(BEST), drawing.rgb(WORST)
    result = []
    for k in range(len(sampled)):
        path = sampled_sketch(step, k).path
        share = float(sampled.value[k] - sampled.value.min()) / max(worst, 1e-9)
        words = kind_of(int(sampled.action.kind[k])).describe(sampled.single(k), step.scene.capacity)
        text = f"{k + 1}. {words}: value {sampled.value[k]:.1f}, cost {sampled.cost[k]:.0f}"
        colour = tuple(((1 - share) * best + share * last).tolist())
        result.append(ShownSample(text, None if path is None else web.arrow_mesh(path[0], path[-1]), colour))
    return result


def sampled_sketch(step: RecordedStep, k: int) -> Sketch:
    """The sketch of a sampled action."""
    action = step.sampled.single(k)
    return kind_of(int(action.kind)).sketch(step.scene, step.sampled.after(k, step.scene), action)


def _present(meshes: list[web.Mesh | None]) -> list[tuple[int, web.Mesh]]:
    return [(i, mesh) for i, mesh in enumerate(meshes) if mesh is not None]
