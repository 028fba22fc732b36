"""Draws the pictures of the docs: `python -m mechsearch_jax.benchmarks.lab.site.pictures` in a checkout.

Each search of `SEARCHES` runs first, as a user would run it. `searches.json` beside the pictures keeps which scene it
was, by which decisions, and how it ended, so that a test can tell whether a picture shows what a search does today.
"""

from __future__ import annotations

import argparse
import itertools
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import jax
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Polygon

import mechsearch_jax as ms
from mechsearch_jax.actions import kind_of
from mechsearch_jax.benchmarks.lab.site import gallery, set_pictures
from mechsearch_jax.envs.recording.film import Film
from mechsearch_jax.envs.recording.pictures import recorded_frame
from mechsearch_jax.envs.recording.recording import NAME, RecordedStep, Recording, load_recording
from mechsearch_jax.envs.scenes import household_pictures
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import replacing
from mechsearch_jax.runtime.versions import DECISION_VERSION
from mechsearch_jax.viz import drawing, sketches
from mechsearch_jax.viz.filmstrip import draw_believed
from mechsearch_jax.viz.maps import Maps, maps_figure
from mechsearch_jax.viz.movie import save_movie
from mechsearch_jax.workspace.scenario import load_scenario

OUT = Path("docs")
# What the searches of the pictures were, beside those of the method.
RECORD = Path("pictures/searches.json")
# The arguments of `mechsearch search` of each search.
SEARCHES: Mapping[str, tuple[str, ...]] = {
    "first-light": ("first-light",),
    "crowded-shelf": ("crowded-shelf",),
    "planner": ("development-6-017",),
    "random": ("development-6-017", "--policy", "random"),
}
# What is written above the two films of the animation, by their search.
FILMS: Mapping[str, str] = {"planner": "search-for-grasp", "random": "random actions, the same scene"}
# Of the films: width [pixels], pictures in a second, how many times as fast as it was, and height of a title [inches].
WIDTH, FPS, SPEED, TITLE = 720, 8, 5.0, 0.3
# Steps of the search that are shown, at most, and the width of one [inch].
STEPS, _WIDTH = 6, 3.6

Picture = UInt8[np.ndarray, "h w 3"]


def search(name: str, recordings: Path) -> Path:
    """The folder of a search, which runs unless its recording is there.

    Raises:
      InputError: the search fails.
    """
    folder = recordings / name
    if not (folder / NAME).is_file():
        gallery.mechsearch("search", *SEARCHES[name], "--out", str(folder), "--record")
    return folder


def record_of(folder: Path) -> dict[str, Any]:
    """What `RECORD` keeps of a search."""
    scene = load_scenario(folder / "scenario.json").content_hash
    return {"scene": scene, "decisions": DECISION_VERSION, "ended": load_recording(folder / NAME).heading}


class Pictures(Protocol):
    """A film: its size and its pictures."""

    size: tuple[int, int]

    def __iter__(self) -> Iterator[Picture]: ...


def both(films: Sequence[Pictures], titles: Sequence[str]) -> Iterator[Picture]:
    """Pictures of films one above the other; one that has ended stands still."""
    last: list[Picture] = []
    strips = [title_strip(title, film.size[0]) for title, film in zip(titles, films, strict=True)]
    for pictures in itertools.zip_longest(*films):
        last = [new if new is not None else last[i] for i, new in enumerate(pictures)]
        yield np.concatenate([part for strip, picture in zip(strips, last, strict=True) for part in (strip, picture)])


def title_strip(text: str, width: int) -> Picture:
    """A line of text as a picture, of an even height."""
    dots = width / 8.0
    height = round(TITLE * dots / 2) * 2
    figure = Figure(figsize=(8.0, height / dots), dpi=dots, facecolor=drawing.PAPER)
    canvas = FigureCanvasAgg(figure)
    figure.text(0.01, 0.45, text, fontsize=13, weight="bold", color=drawing.ACTION, va="center")
    canvas.draw()
    return np.array(canvas.buffer_rgba())[:height, :width, :3]


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


# Of the search of `crowded-shelf`, in docs/pictures.
METHOD: Mapping[str, Callable[[Recording], Figure]] = {
    "recognition": lambda recording: recognition(),
    "maps": maps,
    "sampled": sampled,
    "steps": steps,
}


def draw_searches(out: Path, recordings: Path) -> None:
    """Draw the animation, the filmstrip of the first example and the pictures of the method, and keep `RECORD`.

    Raises:
      InputError: a search fails, or a file cannot be written.
    """
    folders = {name: search(name, recordings) for name in SEARCHES}
    (out / RECORD).parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(folders["first-light"] / "filmstrip.png", out / "filmstrip.png")
    recording = load_recording(folders["crowded-shelf"] / NAME)
    for name, draw in METHOD.items():
        with replacing(out / RECORD.parent / f"{name}.png") as file:
            draw(recording).savefig(file, format="png", dpi=110)
    films = [Film(load_recording(folders[name] / NAME), WIDTH, FPS, SPEED) for name in FILMS]
    save_movie(both(films, list(FILMS.values())), out / "search.webp", FPS)
    with replacing(out / RECORD) as file:
        file.write(
            (json.dumps({name: record_of(folder) for name, folder in folders.items()}, indent=1) + "\n").encode()
        )


def draw_scenes(out: Path, recordings: Path) -> None:
    """Draw the household catalogue and what the pages of scene sets name."""
    household_pictures.draw(out / "household-things.png")
    set_pictures.main([])


def draw_gallery(out: Path, recordings: Path) -> None:
    """Write the gallery's pages."""
    gallery.main(["--out", str(out / "gallery"), "--recordings", str(recordings)])


PARTS: Mapping[str, Callable[[Path, Path], None]] = {
    "searches": draw_searches,
    "gallery": draw_gallery,
    "scenes": draw_scenes,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw all pictures, or some."""
    parser = argparse.ArgumentParser(description="At the root of a checkout: search anew, and draw the docs' pictures.")
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all of them without")
    parser.add_argument("--recordings", type=Path, help="keep the recordings here, and use those that are there")
    given = parser.parse_args(arguments)
    if unknown := [part for part in given.parts if part not in PARTS]:
        parser.error(f"{unknown[0]}: is no part; there are {', '.join(PARTS)}")
    try:
        with tempfile.TemporaryDirectory() as fresh:
            for part in given.parts or PARTS:
                PARTS[part](OUT, (given.recordings or Path(fresh)) / part)
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
