"""Pictures of looks at real scenes in which something is wrong, with that in words."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mechsearch_jax.benchmarks.real.figures import Look, pulled_down
from mechsearch_jax.benchmarks.real.scenes import LabelledScene
from mechsearch_jax.benchmarks.real.scores import MATCHED
from mechsearch_jax.observation import Observation
from mechsearch_jax.viz import drawing
from mechsearch_jax.workspace.camera import Camera

# Of a picture at most so many lines of words.
LINES = 12


def wrong(look: Look) -> Iterator[str]:
    """What is wrong in a look, and whether a search would stop, a line each."""
    for thing in look.things:
        if thing.iou < MATCHED:
            best = "no body is" if thing.body is None else f"body {thing.body} is most, IoU {thing.iou:.2f}"
            yield f"thing {thing.number}{', which is split,' if thing.split else ''} is not matched: {best}"
        elif thing.split:
            yield f"thing {thing.number} is split: another body shows it beside body {thing.body}"
        if pulled_down(thing):
            yield f"thing {thing.number} stands on another, but body {thing.body} reaches below it"
    for body in look.bodies:
        if body.thing is None or body.merges:
            kind = "shows several things" if body.merges else "is a phantom" if body.phantom else "fits no thing"
            yield f"body {body.slot} {kind}, at a confidence of {body.confidence:.2f}"
    yield f"a search would stop: {look.doubt}" if look.doubt else "a search would go on"


def save_picture(look: Look, scene: LabelledScene, camera: Camera, observation: Observation, path: Path) -> None:
    """Draw the colour image and the depth image with the outlines of labels and bodies, and what is `wrong` below.

    Raises:
      InputError: the file cannot be written.
    """
    figure = Figure(figsize=(13.0, 6.8), layout="constrained")
    known = np.where(scene.depth > 0, scene.depth, np.nan)
    near, far = np.nanmin(known[scene.mask >= 0]) - 0.1, np.nanmax(known[scene.mask >= 0]) + 0.2
    bodies = drawing.outlines_in_view(observation.objects, camera)
    for axes, image in zip(figure.subplots(1, 2), (scene.colour, None), strict=True):
        axes.imshow(known if image is None else image, cmap="gray", vmin=near, vmax=far)
        for number in np.unique(scene.mask[scene.mask >= 0]).tolist():
            shown = scene.mask == number
            axes.contour(shown, levels=[0.5], colors=[drawing.GRASPABLE], linewidths=1.6)
            row, column = np.median(np.argwhere(shown), axis=0)
            axes.text(column, row, number, color=drawing.GRASPABLE, fontsize=12, weight="bold")
        for slot, outline in enumerate(bodies):
            if outline is not None:
                axes.plot(*np.concatenate([outline, outline[:1]]).T, color=drawing.TARGET, lw=1.4, linestyle="--")
                axes.text(*outline[np.argmin(outline[:, 1])], slot, color=drawing.TARGET, fontsize=12, va="bottom")
        axes.set(xlim=(0, camera.width), ylim=(camera.height, 0), xticks=[], yticks=[])
    figure.suptitle(f"{look.scene} from {look.images}: labelled things (green), recognised bodies (red, dashed)")
    words = list(wrong(look))
    figure.supxlabel("\n".join(words if len(words) <= LINES else [*words[: LINES - 1], "and more"]), fontsize=9)
    drawing.save_figure(figure, path)
