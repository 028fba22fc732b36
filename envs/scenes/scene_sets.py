"""Named sets of scenes from fixed seeds: those of the paper's experiments, and others for development
(docs/method.md, "Scene sets").

A scene depends on its own seed alone, and is made when it is asked for. What every scene holds is on record in
`scene_sets.json`, so that a machine or a version that makes another one is noticed.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import re
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing
from mechsearch_jax.workspace.scenario import HASH_DIGITS, Scenario, load_scenario, save_scenario

RECORD = Path(__file__).with_name("scene_sets.json")


@dataclasses.dataclass(frozen=True)
class Block:
    """Scenes that are made alike; their names are those of the block and a number, as "c2-4-017".

    Attributes:
      name: of the block.
      scenes: how many.
      objects: number of surrounding objects.
      target: shape of the target.
      first_seed: of scene 0; the others follow.
      layout: "clutter" as `ScenarioGenerator` makes it, or "line" as `LineGenerator` does.
    """

    name: str
    scenes: int
    objects: int
    target: str
    first_seed: int
    layout: Literal["clutter", "line"] = "clutter"

    def scene_name(self, index: int) -> str:
        """What a scene is called."""
        return f"{self.name}-{index:03d}"

    @property
    def scene_names(self) -> list[str]:
        """What all scenes are called, in order."""
        return [self.scene_name(index) for index in range(self.scenes)]


class SceneSet(NamedTuple):
    """Scenes with a name.

    Attributes:
      name: what commands call them.
      about: what they are, in a few words; empty for a part of another set.
      blocks: what they consist of.
    """

    name: str
    about: str
    blocks: tuple[Block, ...]

    @property
    def scenes(self) -> int:
        """How many."""
        return sum(block.scenes for block in self.blocks)


def _blocks(
    name: str, scenes: int, counts: Sequence[int], first_seed: int, target: str = "cylinder"
) -> tuple[Block, ...]:
    """One block for each number of objects, all from the same seeds: the number of objects is part of a seed."""
    return tuple(Block(f"{name}-{count}", scenes, count, target, first_seed) for count in counts)


# Seeds below 1000 are for everybody: examples, tests, timings. No two experiments share one.
_EXPERIMENTS = (
    SceneSet("c2", "the paper's C.2", _blocks("c2", 180, (2, 4, 6, 8), 10_000)),
    SceneSet("d1", "the paper's D.1", (Block("d1", 200, 2, "cylinder", 20_000, "line"),)),
    SceneSet("d2", "the paper's D.2", _blocks("d2", 75, (4, 8), 30_000)),
    SceneSet("d3", "the paper's D.3", _blocks("d3", 40, (4, 8), 40_000, "box")),
    SceneSet("development", "for development", _blocks("development", 50, (2, 4, 6, 8), 50_000)),
    SceneSet("development-box", "for development", _blocks("development-box", 20, (4, 8), 60_000, "box")),
)


def _with_parts() -> dict[str, SceneSet]:
    sets: dict[str, SceneSet] = {}
    for whole in _EXPERIMENTS:
        sets[whole.name] = whole
        for block in whole.blocks:
            sets.setdefault(block.name, SceneSet(block.name, "", (block,)))
    return sets


SETS: Mapping[str, SceneSet] = _with_parts()
_BLOCKS: Mapping[str, Block] = {block.name: block for whole in _EXPERIMENTS for block in whole.blocks}


# The scenes that settings of the package were chosen on, in words: rates on them are not those on new scenes.
CHOSEN_ON = "the published ones, the sets `development*`, and numbers 000 to 089 of `c2`"
_CHOSEN_ON = re.compile(r"published-\d-\d\d|development(?:-box)?-\d-\d{3}|c2-\d-0[0-8]\d")


def is_chosen_on(scenario: str) -> bool:
    """Whether a scenario has the name of a scene that settings were chosen on: see `CHOSEN_ON`."""
    return _CHOSEN_ON.fullmatch(scenario) is not None


def find_set(name: str) -> SceneSet:
    """The set of a name.

    Raises:
      InputError: there is none.
    """
    if name not in SETS:
        raise InputError(f"{name}: there is no such scene set; there are {', '.join(SETS)}")
    return SETS[name]


def find_scene(name: str) -> tuple[Block, int] | None:
    """The block and the number of a scene of some set; None if no set has one of that name."""
    match = re.fullmatch(r"(.+)-(\d{3})", name)
    block = _BLOCKS.get(match[1]) if match else None
    return (block, int(match[2])) if match and block and int(match[2]) < block.scenes else None


@functools.cache
def _generate(layout: str, target: str) -> Callable[[int, int, str], Scenario]:
    """What makes a scene from its seed, its number of objects and its name."""
    # They take long to import and to make, and nothing is made where all files are there.
    from mechsearch_jax.envs.scenes.generator import GeneratorConfig, ScenarioGenerator
    from mechsearch_jax.envs.scenes.three_objects import LineGenerator
    from mechsearch_jax.workspace.detector import FOUND_PIXELS
    from mechsearch_jax.workspace.target import Target

    config = GeneratorConfig(visible=FOUND_PIXELS, anywhere=True)
    if layout == "line":
        line = LineGenerator(checks=config)
        return lambda seed, objects, name: line.generate(seed, name)
    return ScenarioGenerator(Target.of(target), config=config).generate


def make_scene(block: Block, index: int) -> Scenario:
    """Generate a scene of a block; the same on the same machine, whichever others are made.

    Args:
      block: of a set.
      index: of the scene, from 0.

    Raises:
      InputError: there is no such scene.
    """
    if not 0 <= index < block.scenes:
        raise InputError(f"{block.name}: there is no scene {index}; there are {block.scenes}, counted from 0")
    generate = _generate(block.layout, block.target)
    return generate(block.first_seed + index, block.objects, block.scene_name(index))


@functools.cache
def recorded() -> Mapping[str, Sequence[str]]:
    """The content hashes of all scenes on record, by block, in order."""
    return json.loads(RECORD.read_text(encoding="utf-8"))


def digest(scene_set: SceneSet) -> str:
    """Twelve hexadecimal digits that stand for the recorded content of all scenes of a set, in order."""
    hashes = [content for block in scene_set.blocks for content in recorded()[block.name]]
    return hashlib.sha256(" ".join(hashes).encode()).hexdigest()[:HASH_DIGITS]


def is_recorded(block: Block, index: int, scenario: Scenario) -> bool:
    """Whether a scenario holds what is on record for a scene."""
    return scenario.content_hash == recorded()[block.name][index]


class SceneFiles(NamedTuple):
    """Where scenes are.

    Attributes:
      files: of all that were asked for, in order.
      strange: names of those that are not what is on record.
    """

    files: list[Path]
    strange: list[str]


def scene_files(
    scenes: Iterable[tuple[Block, int]],
    folder: PathLike | None = None,
    progress: Callable[[Sequence[Any]], Iterable[Any]] = iter,
) -> SceneFiles:
    """Files of scenes; those that are not there are made, and so are those that do not hold what is on record.

    Args:
      scenes: of any blocks.
      folder: for the files; the cache's if None, or one that is gone when the process ends if there is no cache.
      progress: is given the scenes that have to be made, and passes them on one by one.

    Raises:
      InputError: a file cannot be written.
    """
    place = Path(folder) if folder is not None else _kept_scenes()
    wanted = [(block, index, place / f"{block.scene_name(index)}.json") for block, index in scenes]
    strange = []
    for block, index, file in progress([one for one in wanted if not holds(one[2], *one[:2])]):
        scene = make_scene(block, index)
        save_scenario(scene, file)
        if not is_recorded(block, index, scene):
            strange.append(scene.name)
    return SceneFiles([file for *_, file in wanted], strange)


def set_scenes(scene_set: SceneSet) -> list[tuple[Block, int]]:
    """All scenes of a set, in order, for `scene_files`."""
    return [(block, index) for block in scene_set.blocks for index in range(block.scenes)]


def holds(file: PathLike, block: Block, index: int) -> bool:
    """Whether a file holds what is on record for a scene, under its name."""
    try:
        scenario = load_scenario(file)
    except InputError:
        return False
    return scenario.name == block.scene_name(index) and is_recorded(block, index, scenario)


def _kept_scenes() -> Path:
    # Brings the planner along, which who only asks for names can do without.
    from mechsearch_jax.problem.cache import cache_folder

    folder = cache_folder()
    return folder / "scenes" if folder is not None else Path(_temporary_folder().name)


@functools.cache
def _temporary_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="mechsearch-scenes-")


def record(progress: Callable[[Sequence[Any]], Iterable[Any]] = iter, path: PathLike = RECORD) -> None:
    """Make all scenes and put on record what they hold: only after a change that is meant to change them.

    Args:
      progress: is given all blocks and numbers, and passes them on one by one.
      path: of the record.

    Raises:
      InputError: the file cannot be written.
    """
    hashes: dict[str, list[str]] = {name: [] for name in _BLOCKS}
    for block, index in progress([one for whole in _EXPERIMENTS for one in set_scenes(whole)]):
        hashes[block.name].append(make_scene(block, index).content_hash)
    lines = ",\n".join(f" {json.dumps(name)}: {json.dumps(content)}" for name, content in hashes.items())
    with replacing(path) as file:
        file.write(f"{{\n{lines}\n}}\n".encode())
