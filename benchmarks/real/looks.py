"""Recognition on labelled real depth images: from depth and colour, and with the true masks."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from mechsearch_jax.benchmarks.real.figures import FIGURES, Figures, Images, Look
from mechsearch_jax.benchmarks.real.pictures import save_picture
from mechsearch_jax.benchmarks.real.scenes import LabelledScene
from mechsearch_jax.benchmarks.real.scores import Body, Thing, scored
from mechsearch_jax.calibration.limits import CalibrationLimits
from mechsearch_jax.images.colour import TargetColour
from mechsearch_jax.images.labels import CAPACITY
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.doubt import DoubtConfig, recognition_doubt
from mechsearch_jax.perception.recogniser import Recogniser, Setting
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import read_text, save_json
from mechsearch_jax.runtime.versions import source_digest, versions
from mechsearch_jax.session import faults
from mechsearch_jax.session.images import converted
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# The target's colour, which no thing has: all that there is are objects.
ABSENT = (0.8, 0.1, 0.7)
# What is known of each scene, from which a killed run goes on [at most so many bytes].
ROWS, LARGEST = "rows.jsonl", 2**30


class Cell(NamedTuple):
    """What a recogniser is made for."""

    camera: Camera
    shelf: Shelf
    target: Target


# Makes what is called as a `Recogniser` is.
Maker = Callable[[Setting], Callable[..., Observation]]


def recogniser(cell: Setting, capacity: int = CAPACITY) -> Recogniser:
    """The package's recogniser, of a target that is nowhere."""
    return Recogniser(cell, detector=TargetColour.lit(ABSENT), capacity=capacity)


def program() -> str:
    """A digest of the source that looks and their scores come of."""
    return source_digest((".py", ".npz", ".json"), ("mechsearch_jax", "mechsearch_jax.benchmarks.real"))


def looks_at(
    scenes: Mapping[str, Callable[[], LabelledScene | None]],
    shelf: Shelf | None = None,
    out: Path | None = None,
    make: Maker | None = None,
    capacity: int = CAPACITY,
) -> Iterator[list[Look]]:
    """The looks at each scene, one from depth and colour and one with the true masks; none if it has no labels.

    Args:
      scenes: as `find_scenes` returns them.
      shelf: of all of them; by default the table before the camera.
      out: folder for what is known of each scene, which is not looked at again by the same program, and for pictures.
      make: makes recognisers; by default `recogniser`, of the capacity.
      capacity: how many objects they can hold.

    Raises:
      InputError: a file is wrong, or cannot be read or written.
    """
    make = make or functools.partial(recogniser, capacity=capacity)
    version, path = f"{program()} {shelf} {capacity}", None if out is None else out / ROWS
    kept = {} if path is None or not path.exists() else _kept(path, version)
    for name, read in scenes.items():
        if name in kept:
            yield kept[name]
            continue
        scene = read()
        looks = [] if scene is None else list(_looks(name, scene, shelf, make, capacity, out))
        if path is not None:
            row = {"program": version, "scene": name, "looks": list(map(dataclasses.asdict, looks))}
            with open(path, "a", encoding="utf-8") as file:
                # A killed run may have left half a line.
                file.write("\n" + json.dumps(row, allow_nan=False))
        yield looks


def _kept(path: Path, version: str) -> dict[str, list[Look]]:
    kept = {}
    for line in read_text(path, LARGEST).splitlines():
        with contextlib.suppress(ValueError):
            row = json.loads(line)
            if row["program"] == version:
                kept[row["scene"]] = list(map(_look, row["looks"]))
    return kept


def _look(row: dict[str, Any]) -> Look:
    parts = {"things": [Thing(**thing) for thing in row["things"]], "bodies": [Body(**body) for body in row["bodies"]]}
    return Look(**{**row, **parts})


def _looks(
    name: str, scene: LabelledScene, shelf: Shelf | None, make: Maker, capacity: int, out: Path | None
) -> Iterator[Look]:
    cell = Cell(*scene.workspace(shelf), Target.cylinder())
    recognise = make(cell)
    numbers, pixels = np.unique(scene.mask[scene.mask >= 0], return_counts=True)
    # Of more things than slots the smallest are left out.
    slots = {number: i for i, number in enumerate(numbers[np.argsort(-pixels)][:capacity].tolist())}
    mask = np.full(scene.mask.shape, -1, np.int32)
    for number, slot in slots.items():
        mask[scene.mask == number] = slot
    given: dict[Images, tuple[Any, ...]] = {
        "depth and colour": (scene.depth, scene.colour),
        "true masks": (scene.depth, None, mask, -1),
    }
    for images, arrays in given.items():
        start = time.perf_counter()
        jax.block_until_ready(recognise(jax.random.key(0), *arrays))
        between = time.perf_counter()
        observation = jax.block_until_ready(recognise(jax.random.key(0), *arrays))
        first, second = between - start, time.perf_counter() - between
        scores = scored(scene, cell.camera, cell.shelf, observation, slots if len(arrays) > 2 else None)
        times = {"seconds": second, "compile_seconds": max(first - second, 0.0)}
        doubt, warnings = _said(cell, recognise, observation, *arrays)
        look = Look(name, scene.category, images, len(numbers), *scores, **times, doubt=doubt, warnings=warnings)
        if out is not None and not look.right:
            save_picture(look, scene, cell.camera, observation, out / f"{name} from {images}.png".replace("/", " "))
        yield look


def _said(cell: Cell, recognise: Any, observation: Observation, *arrays: Any) -> tuple[str | None, list[str]]:
    """Why a `Searcher` would not move after a look, if it would not, and its warnings."""
    said = list(faults.view_warnings(cell, recognise))
    images = converted(*arrays, *[None] * (4 - len(arrays)))
    try:
        look, of_images = faults.check_image(cell, CalibrationLimits(), images, recognise)
    except InputError as error:
        return f"refused: {error}", said
    said += [*of_images, *faults.recognition_warnings(cell, look, observation, recognise)]
    return recognition_doubt(cell, observation, images.depth).reason(DoubtConfig()), said


def save_results(looks: Sequence[Look], of_looks: Figures, path: Path) -> None:
    """Write looks, their figures and what each is as JSON.

    Raises:
      InputError: the file cannot be written.
    """
    values = {
        images: {group: {name: value._asdict() for name, value in of.items()} for group, of in groups.items()}
        for images, groups in of_looks.items()
    }
    about = {name: figure.about for name, figure in FIGURES.items()}
    made_by = {"program": program(), "versions": versions()}
    save_json({"figures": values, "about": about, **made_by, "looks": list(map(dataclasses.asdict, looks))}, path)
