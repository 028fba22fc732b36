"""`mechsearch bench real`: recognition on labelled real depth images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from mechsearch_jax.commands.options import ConfigFile
from mechsearch_jax.images.labels import CAPACITY, check_capacity
from mechsearch_jax.runtime.errors import InputError

Folder = Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
Out = Annotated[Path | None, tyro.conf.arg(metavar="DIR")]


def bench_real(folder: Folder, /, *, shelf: ConfigFile = None, capacity: int = CAPACITY, out: Out = None) -> None:
    """Measure recognition on labelled real depth images, from depth and colour and with the true masks: matched, split
    and merged things, phantoms, distances from surfaces, how bodies stand, confidence, doubt and time.

    Args:
      folder: BOP scenes, or .npz files with depth, mask and camera; searched with all folders in it.
      shelf: file whose table [shelf] says where the faces are; without it things stand on a table.
      capacity: how many objects recognition can hold, 1 to 16.
      out: folder for results.json and a picture of each failure; what a killed run left there is gone on with.

    Raises:
      InputError: the folder holds no labelled scene, the capacity is impossible, a file is broken or
        cannot be written.
    """
    from rich.console import Console
    from rich.progress import track

    from mechsearch_jax.benchmarks.real import figures, looks
    from mechsearch_jax.benchmarks.real.scenes import find_scenes
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.problem.settings import load_settings
    from mechsearch_jax.runtime.files import check_writable

    check_capacity(capacity, "--capacity")
    scenes = find_scenes(folder)
    faces = None if shelf is None else load_settings(shelf).workcell.shelf
    if out is not None:
        check_writable(out)
    keep_compilations()
    console = Console(highlight=False)
    at_each = list(
        track(looks.looks_at(scenes, faces, out, capacity=capacity), "looking", len(scenes), console=console)
    )
    made = [look for of_scene in at_each for look in of_scene]
    if not made:
        raise InputError(f"{folder}: none of its {len(scenes)} images has labels")
    of_looks = figures.figures(made)
    for images, groups in of_looks.items():
        console.print(figures.table(images, groups), "")
    if unlabelled := sum(not of_scene for of_scene in at_each):
        console.print(f"{unlabelled} images have no labels and are left out")
    if out is not None:
        looks.save_results(made, of_looks, out / "results.json")
        console.print(str(out), soft_wrap=True, markup=False)


COMMANDS = {"real": bench_real}
