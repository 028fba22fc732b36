"""Draws the pictures of docs/pictures.md: `python -m mechsearch_jax.benchmarks.lab.site.method_pictures` in a checkout.

They show one search of a shipped scene, which runs first, and what recognition makes of the shipped images.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Polygon

import mechsearch_jax as ms
from mechsearch_jax.actions import kind_of
from mechsearch_jax.envs.recording.pictures import recorded_frame
from mechsearch_jax.envs.recording.recording import NAME, RecordedStep, Recording, load_recording
from mechsearch_jax.runtime.files import replacing
from mechsearch_jax.viz import drawing, sketches
from mechsearch_jax.viz.filmstrip import draw_believed
from mechsearch_jax.viz.maps import Maps, maps_figure
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

SCENE = "crowded-shelf"
OUT = Path("docs/pictures")
# Key of the PNG's text with the content hash of the scene.
SHOWS = "scene"
# Steps of the search that are shown, at most, and the width of one [inch].
STEPS, _WIDTH = 6, 3.6


def search(folder: Path) -> Recording:
    """Search the scene, as a user would, and read the recording."""
    program = (sys.executable, "-m", "mechsearch_jax.commands.main")
    subprocess.run([*program, "search", SCENE, "--out", str(folder), "--record"], check=True)
    return load_recording(folder / NAME)


def maps(recording: Recording) -> Figure:
    """f, g and both before the first action."""
    step = recording.steps[0]
    frame = recorded_frame(step, recording.camera, recording.shelf)
    target, shelf = recording.target, recording.shelf
    shown = Maps(target.candidate_poses(shelf), step.existence, step.graspability, step.scene)
    heading = "Before the first action"
    return maps_figure(shown, frame.image, frame.owner, step.target_pose, recording.camera, shelf, target, heading)


def recognition() -> Figure:
    """The shipped depth image, and the shapes that are recognised in it over the colour image."""
    images = ms.example_images()
    assert images.colour is not None
    problem = ms.build_problem(target=ms.Target.cylinder(), camera=images.camera)
    seen = ms.Recogniser(problem)(jax.random.key(0), images.depth, images.colour)
    scene = jax.tree.map(np.asarray, seen.objects)
    left, right, top, bottom = drawing.view_window(images.camera, problem.shelf)
    figure = Figure(figsize=(10.0, 5.0 * (bottom - top) / (right - left) + 0.4), layout="constrained")
    depth, colour = figure.subplots(1, 2)
    window = np.where(images.depth > 0, images.depth, np.nan)[top:bottom, left:right]
    depth.imshow(window, extent=(left, right, bottom, top), cmap="viridis_r")
    colour.imshow(images.colour[top:bottom, left:right], extent=(left, right, bottom, top))
    for index, outline in enumerate(drawing.outlines_in_view(scene, images.camera)):
        if outline is not None:
            colour.add_patch(Polygon(outline, closed=True, facecolor="none", edgecolor=drawing.ACTION, linewidth=1.6))
            x, y = outline.mean(axis=0)
            drawing.number(colour, (float(x), float(y)), index)
    for axes, title in ((depth, "The depth image"), (colour, "Recognised shapes, over the colour image")):
        axes.set_title(title, fontsize=10, color=drawing.INK)
        axes.set_xticks([])
        axes.set_yticks([])
    return figure


def sampled(recording: Recording) -> Figure:
    """The first actions of the sampled sequences of the first decision, coloured by what the sequences are worth."""
    step, shelf = recording.steps[0], recording.shelf
    figure = Figure(figsize=(7.0, 5.4), layout="constrained")
    axes = figure.subplots()
    drawing.draw_shelf(axes, shelf)
    image = drawing.map_image(step.existence, step.graspability, recording.target)
    image[..., 3] *= 0.35
    drawing.draw_map(axes, image, shelf, recording.target)
    drawing.draw_objects(axes, step.scene)
    values = step.sampled.value
    colours = LinearSegmentedColormap.from_list("values", [drawing.GRASPABLE, drawing.BLOCKED[0], drawing.BLOCKED[-1]])
    scale = ScalarMappable(Normalize(float(values.min()), float(values.max())), colours)
    for k in reversed(range(len(step.sampled))):
        _arrow(axes, _path(step, k, recording), list(map(float, scale.to_rgba(values[k]))), 1.4 if k else 3.2)
    bar = figure.colorbar(scale, ax=axes, orientation="horizontal", shrink=0.6, aspect=30)
    bar.set_label("value of the sequence that begins with the action (equation 2); less is better", fontsize=8.5)
    axes.set_title(f"{len(values)} sampled first actions; the best is bold", fontsize=10, color=drawing.INK)
    return figure


def _path(step: RecordedStep, k: int, recording: Recording) -> Float[np.ndarray, "points 3"] | None:
    action, after = step.sampled.single(k), step.sampled.after(k, step.scene)
    sketch = kind_of(int(action.kind)).sketch(step.scene, after, action)
    return sketches.shown_path(sketch, recording.shelf)


def _arrow(axes: Axes, path: Float[np.ndarray, "points 3"] | None, colour: list[float], width: float) -> None:
    if path is not None and np.linalg.norm(path[-1] - path[0]) > sketches.SHORTEST:
        start, end = sketches.from_above(path[[0, -1]])
        style = {"arrowstyle": "-|>", "color": colour, "linewidth": width, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", xy=tuple(end), xytext=tuple(start), arrowprops=style, zorder=8)


def steps(recording: Recording) -> Figure:
    """f and g from step to step, with each action and where objects are expected to go; of the first `STEPS` steps."""
    shown = recording.steps[:STEPS]
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    height = rows * (_WIDTH * drawing.map_share(recording.shelf) + 0.55) + 0.5
    above_legend = ConstrainedLayoutEngine(rect=(0, 0.5 / height, 1, 1 - 0.5 / height))
    figure = Figure(figsize=(_WIDTH * columns, height), layout=above_legend)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(shown) :]:
        axes.axis("off")
    for axes, step in zip(panels, shown, strict=False):
        frame = recorded_frame(step, recording.camera, recording.shelf)
        draw_believed(axes, frame, recording.shelf, recording.target)
        drawing.draw_objects(axes, step.scene)
        drawing.draw_target(axes, step.target_pose, recording.target, step.found)
        axes.set_title(f"{step.title}\n{step.caption.split(' · ')[0]}", fontsize=8.5, color=drawing.INK, loc="left")
    if len(shown) < len(recording.steps):
        heading = f"The first {len(shown)} of {len(recording.steps)} steps"
        figure.suptitle(heading, fontsize=10, color=drawing.INK)
    drawing.draw_legend(figure, 0.22 / height)
    return figure


PICTURES: dict[str, Callable[[Recording], Figure]] = {
    "recognition": lambda recording: recognition(),
    "maps": maps,
    "sampled": sampled,
    "steps": steps,
}


def main() -> None:
    """Draw all pictures."""
    parser = argparse.ArgumentParser(description=f"Draw the pictures of {OUT}.")
    parser.add_argument("--out", default=OUT, type=Path, help="folder of the pictures")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        recording = search(Path(folder))
    if len(recording.steps) > STEPS:
        print(f"steps.png shows the first {STEPS} of {len(recording.steps)} steps, and says so")
    shows = load_scenario(example_scenarios()[SCENE]).content_hash
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, draw in PICTURES.items():
        with replacing(arguments.out / f"{name}.png") as file:
            draw(recording).savefig(file, format="png", dpi=110, metadata={SHOWS: shows})


if __name__ == "__main__":
    main()
