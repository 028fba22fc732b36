"""Named sets of scenes from fixed seeds: those of the paper's experiments, and others for development
(docs/method.md, "Scene sets").

A scene depends on its own seed alone, and is generated on demand. `scene_sets.json` records the content hash of every
scene, so that a machine or a version that generates a different one is noticed.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing
from mechsearch_jax.workspace.scenario import HASH_DIGITS, Scenario, load_scenario, save_scenario
from mechsearch_jax.workspace.shelf import Shelf

RECORD = Path(__file__).with_name("scene_sets.json")
# A process for each so many scenes: it takes as long to start as a hundred of them.
EACH = 100


@dataclasses.dataclass(frozen=True)
class Block:
    """Scenes of one kind; their names are the block's and a number, such as "c2-4-017".

    Attributes:
      name: of the block.
      scenes: number of scenes.
      objects: number of surrounding objects.
      target: shape of the target.
      first_seed: of scene 0; the others follow.
      layout: "clutter" as `ScenarioGenerator` makes it, or "line" as `LineGenerator` does.
      shelf: one of `SHELVES`.
      things: what objects are drawn from: "paper", its eleven boxes and cylinders, or "household".
    """

    name: str
    scenes: int
    objects: int
    target: str
    first_seed: int
    layout: Literal["clutter", "line"] = "clutter"
    shelf: str = "usual"
    things: Literal["paper", "household"] = "paper"

    def scene_name(self, index: int) -> str:
        """The name of a scene."""
        return f"{self.name}-{index:03d}"


class SceneSet(NamedTuple):
    """A named set of scenes.

    Attributes:
      name: as used by commands.
      about: a few words; empty for a part of another set.
      blocks: of the set.
    """

    name: str
    about: str
    blocks: tuple[Block, ...]

    @property
    def scenes(self) -> int:
        """Number of scenes."""
        return sum(block.scenes for block in self.blocks)


def _blocks(
    name: str, scenes: int, counts: Sequence[int], first_seed: int, target: str = "cylinder", **more: Any
) -> tuple[Block, ...]:
    """One block for each number of objects, all from the same seeds: the generator mixes that number into the seed."""
    return tuple(Block(f"{name}-{count}", scenes, count, target, first_seed, **more) for count in counts)


# By name; those of benchmarks/lab/parts/views.
SHELVES: Mapping[str, Shelf] = {
    "usual": Shelf(),
    "low": Shelf(front=0.374, back=0.748, board=0.3045, ceiling=0.673, spawn_x=(0.41, 0.69)),
    "narrow": Shelf(board=0.4545, ceiling=0.803, right=-0.2, left=0.4, spawn_y=(-0.1, 0.3)),
    "wide": Shelf(back=0.864, right=-0.35, left=0.55, spawn_x=(0.45, 0.8), spawn_y=(-0.25, 0.45)),
}


# Seeds below 1000 are reserved for examples, tests and timings. No two experiments share a seed.
_EXPERIMENTS = (
    SceneSet("c2", "the paper's C.2", _blocks("c2", 180, (2, 4, 6, 8), 10_000)),
    SceneSet("d1", "the paper's D.1", (Block("d1", 200, 2, "cylinder", 20_000, "line"),)),
    SceneSet("d2", "the paper's D.2", _blocks("d2", 75, (4, 8), 30_000)),
    SceneSet("d3", "the paper's D.3", _blocks("d3", 40, (4, 8), 40_000, "box")),
    SceneSet("development", "for development", _blocks("development", 50, (2, 4, 6, 8), 50_000)),
    SceneSet("development-box", "for development", _blocks("development-box", 20, (4, 8), 60_000, "box")),
    # What was looked at is no longer unseen: a change that is reported later has sets of its own.
    SceneSet("report", "to report with, once", _blocks("report", 100, (2, 4, 6, 8), 250_000)),
    *(
        SceneSet(f"shelf-{shelf}", about, _blocks(f"shelf-{shelf}", 50, (2, 4, 6, 8), first_seed, shelf=shelf))
        for shelf, about, first_seed in (
            ("low", "a lower, closer shelf", 140_000),
            ("narrow", "a narrower shelf", 150_000),
            ("wide", "a wider, deeper shelf", 160_000),
        )
    ),
    SceneSet("household", "household things", _blocks("household", 200, (4, 8), 170_000, things="household")),
    SceneSet(
        "household-box", "household things", _blocks("household-box", 50, (4, 8), 180_000, "box", things="household")
    ),
    SceneSet(
        "report-household",
        "household things, to report with, once",
        _blocks("report-household", 200, (4, 8), 260_000, things="household"),
    ),
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


# The scenes that settings of the package were chosen on, in words: rates on them are biased.
CHOSEN_ON = "the published ones, the sets `development*`, and numbers 000 to 089 of `c2`"
_CHOSEN_ON = re.compile(r"published-\d-\d\d|development(?:-box)?-\d-\d{3}|c2-\d-0[0-8]\d")


def is_chosen_on(scenario: str) -> bool:
    """Whether settings were chosen on the scene of this name; see `CHOSEN_ON`."""
    return _CHOSEN_ON.fullmatch(scenario) is not None


def find_set(name: str) -> SceneSet:
    """The set of a name.

    Raises:
      InputError: there is no such set.
    """
    if name not in SETS:
        raise InputError(f"{name}: there is no such scene set; there are {', '.join(SETS)}")
    return SETS[name]


def find_scene(name: str) -> tuple[Block, int] | None:
    """The block and index of the scene of a name; None if no set has such a scene."""
    match = re.fullmatch(r"(.+)-(\d{3})", name)
    block = _BLOCKS.get(match[1]) if match else None
    return (block, int(match[2])) if match and block and int(match[2]) < block.scenes else None


@functools.cache
def _generate(layout: str, target: str, shelf: str, things: str) -> Callable[[int, int, str], Scenario]:
    """A function that generates a scene from its seed, its number of objects and its name."""
    # Imported here because it takes long, and nothing is generated if all files exist.
    from mechsearch_jax.envs.scenes.generator import GeneratorConfig, ScenarioGenerator
    from mechsearch_jax.envs.scenes.household import draw_body
    from mechsearch_jax.envs.scenes.three_objects import LineGenerator
    from mechsearch_jax.workspace.detector import FOUND_PIXELS
    from mechsearch_jax.workspace.target import Target

    config = GeneratorConfig(visible=FOUND_PIXELS, anywhere=True)
    match layout:
        case "clutter":
            draw = draw_body if things == "household" else None
            return ScenarioGenerator(Target.of(target), SHELVES[shelf], config=config, draw=draw).generate
        case "line":
            line = LineGenerator(checks=config)
            return lambda seed, objects, name: line.generate(seed, name)
    raise InputError(f'layout "{layout}" is unknown; use clutter or line')


def make_scene(block: Block, index: int) -> Scenario:
    """Generate a scene of a block; on the same machine always the same.

    Args:
      block: of a set.
      index: of the scene, from 0.

    Raises:
      InputError: there is no such scene.
    """
    if not 0 <= index < block.scenes:
        raise InputError(f"{block.name}: there is no scene {index}; there are {block.scenes}, counted from 0")
    generate = _generate(block.layout, block.target, block.shelf, block.things)
    return generate(block.first_seed + index, block.objects, block.scene_name(index))


@functools.cache
def recorded() -> Mapping[str, Sequence[str]]:
    """The recorded content hashes of all scenes, by block, in order."""
    return json.loads(RECORD.read_text(encoding="utf-8"))


def digest(scene_set: SceneSet) -> str:
    """Twelve hexadecimal digits: a hash of the recorded content of all scenes of a set, in order."""
    hashes = [content for block in scene_set.blocks for content in recorded()[block.name]]
    return hashlib.sha256(" ".join(hashes).encode()).hexdigest()[:HASH_DIGITS]


def is_recorded(block: Block, index: int, scenario: Scenario) -> bool:
    """Whether a scenario has the recorded content of a scene."""
    return scenario.content_hash == recorded()[block.name][index]


class SceneFiles(NamedTuple):
    """Files of scenes.

    Attributes:
      files: of all requested scenes, in order.
      strange: names of generated scenes whose content differs from the record.
    """

    files: list[Path]
    strange: list[str]


def scene_files(
    scenes: Iterable[tuple[Block, int]],
    folder: PathLike | None = None,
    progress: Callable[[Sequence[Any]], Iterable[Any]] = iter,
) -> SceneFiles:
    """Files of scenes; missing ones, and ones whose content differs from the record, are generated.

    Args:
      scenes: of any blocks.
      folder: for the files; if None the cache's, or a temporary one of this process if there is no cache.
      progress: wraps the iteration over the scenes that have to be generated.

    Raises:
      InputError: a file cannot be written.
    """
    place = Path(folder) if folder is not None else _kept_scenes()
    wanted = [(block, index, place / f"{block.scene_name(index)}.json") for block, index in scenes]
    strange, missing = [], [entry for entry in wanted if not holds(entry[2], *entry[:2])]
    made = _made([entry[:2] for entry in missing])
    for (block, index, file), scene in zip(progress(missing), made, strict=True):
        save_scenario(scene, file)
        if not is_recorded(block, index, scene):
            strange.append(scene.name)
    return SceneFiles([file for *_, file in wanted], strange)


def _made(scenes: Sequence[tuple[Block, int]]) -> Iterator[Scenario]:
    """The scenes, in order; many of them in several processes."""
    processes = min(cores(), len(scenes) // EACH)
    if processes < 2:
        yield from (make_scene(*scene) for scene in scenes)
        return
    # Imported here because it takes long.
    from mechsearch_jax.runtime.workers import workers

    pool = workers(processes)
    try:
        yield from pool.map(make_scene, *zip(*scenes, strict=True), chunksize=4)
    finally:
        pool.shutdown(kill_workers=True)


def set_scenes(scene_set: SceneSet) -> list[tuple[Block, int]]:
    """All scenes of a set, in order, for `scene_files`."""
    return [(block, index) for block in scene_set.blocks for index in range(block.scenes)]


def holds(file: PathLike, block: Block, index: int) -> bool:
    """Whether a file holds the recorded content of a scene, under its name."""
    try:
        scenario = load_scenario(file)
    except InputError:
        return False
    return scenario.name == block.scene_name(index) and is_recorded(block, index, scenario)


def _kept_scenes() -> Path:
    # Imports the planner, which callers that only need names do not.
    from mechsearch_jax.runtime.kept_arrays import cache_folder

    folder = cache_folder()
    return folder / "scenes" if folder is not None else Path(_temporary_folder().name)


@functools.cache
def _temporary_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="mechsearch-scenes-")


def record(progress: Callable[[Sequence[Any]], Iterable[Any]] = iter, path: PathLike = RECORD) -> None:
    """Generate all scenes and record their content hashes: only after a change that is meant to change them.

    Args:
      progress: wraps the iteration over all scenes.
      path: of the record.

    Raises:
      InputError: the file cannot be written.
    """
    hashes: dict[str, list[str]] = {name: [] for name in _BLOCKS}
    for block, index in progress([scene for whole in _EXPERIMENTS for scene in set_scenes(whole)]):
        hashes[block.name].append(make_scene(block, index).content_hash)
    lines = ",\n".join(f" {json.dumps(name)}: {json.dumps(content)}" for name, content in hashes.items())
    with replacing(path) as file:
        file.write(f"{{\n{lines}\n}}\n".encode())
