"""Draws the pictures of docs/scene-sets, of the scenes that its pages name: what the camera sees, and from above.

`python -m mechsearch_jax.benchmarks.lab.site.set_pictures` at the root of a checkout.

A picture holds the content hashes of its scenes as text of the PNG, so that a test can tell whether it shows what the
sets hold today.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, true_target_pose
from mechsearch_jax.envs.episode.episodes import target_of
from mechsearch_jax.envs.recording.pictures import colour_image
from mechsearch_jax.envs.scenes.scene_sets import SHELVES, Block, find_scene, scene_files
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.runtime.files import PathLike, replacing
from mechsearch_jax.viz import drawing
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Scenario, load_scenario
from mechsearch_jax.workspace.shelf import Shelf

OUT = Path("docs/scene-sets")
# Key of the PNG's text with the content hashes.
HASHES = "scenes"
_WIDTH = 3.0


def shown_on(page: str) -> list[tuple[Block, int]]:
    """The scenes of a page's picture, as block and index, by the page's text; none where there is no picture."""
    names = re.search(r"From left to right:\n(.*)\.$", page, re.MULTILINE)
    scenes = map(find_scene, re.findall(r"`(.+?)`", names[1] if names else ""))
    return [scene for scene in scenes if scene is not None]


def draw(scenes: Sequence[tuple[Block, int]], path: PathLike) -> None:
    """Draw scenes of one set beside each other.

    Args:
      scenes: of `shown_on`.
      path: of the PNG.

    Raises:
      InputError: the file cannot be written.
    """
    shelf = SHELVES[scenes[0][0].shelf]
    loaded = [load_scenario(file, shelf) for file in scene_files(scenes).files]
    figure = scenes_figure(loaded, shelf)
    hashes = " ".join(scene.content_hash for scene in loaded)
    with replacing(path) as file:
        figure.savefig(file, format="png", dpi=110, metadata={HASHES: hashes})


def scenes_figure(scenes: Sequence[Scenario], shelf: Shelf) -> Figure:
    """The figure of scenes on a shelf, which pyplot does not know."""
    camera = Camera()
    left, right, top, bottom = drawing.view_window(camera, shelf)
    heights = [(bottom - top) / (right - left), drawing.map_share(shelf)]
    figure = Figure(
        figsize=(_WIDTH * len(scenes), _WIDTH * sum(heights) + 0.3), layout="constrained", facecolor=drawing.PAPER
    )
    rows = figure.subplots(2, len(scenes), squeeze=False, height_ratios=heights)
    for scene, view, above in zip(scenes, *rows, strict=True):
        _draw_scene(view, above, scene, camera, shelf)
    return figure


def _draw_scene(view: Axes, above: Axes, scene: Scenario, camera: Camera, shelf: Shelf) -> None:
    snapshot = Snapshot(camera, shelf, jax.tree.map(jnp.asarray, from_scenario(scene)))
    pose, target = np.asarray(true_target_pose(snapshot.world)), target_of(scene)
    objects = jax.tree.map(np.asarray, objects_on_the_board(snapshot))
    view.set_title(scene.name, fontsize=10, color=drawing.INK)
    drawing.draw_view(view, colour_image(snapshot.image), camera, shelf)
    drawing.draw_numbers_in_view(view, np.asarray(snapshot.image.segmentation), len(scene.objects))
    drawing.draw_hidden_target_in_view(view, pose, target, camera, shelf)
    drawing.draw_shelf(above, shelf)
    drawing.draw_objects(above, objects)
    drawing.draw_target(above, pose, target, certain=False)


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw the pictures of all pages anew."""
    argparse.ArgumentParser(description=f"Draw the pictures of {OUT}.").parse_args(arguments)
    for page in sorted(OUT.glob("*.md")):
        if scenes := shown_on(page.read_text(encoding="utf-8")):
            draw(scenes, page.with_suffix(".png"))


if __name__ == "__main__":
    main()
