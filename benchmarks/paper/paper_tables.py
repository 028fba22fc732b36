"""The experiments behind the paper's tables, and the figures in them (Kim et al., CoRL 2023, 5.1 and D.1 to D.3)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from mechsearch_jax.envs.scenes.scene_sets import Block, find_set
from mechsearch_jax.runtime.errors import InputError

TableName = Literal["table1", "table3", "table4", "table5"]
BOTH, PICK_AND_PLACE, PUSH = ("push", "pick-and-place"), ("pick-and-place",), ("push",)
METHODS = ("search-and-grasp", "search-for-grasp")
# What the paper's letters stand for here: it has one R, with true masks in simulation; see docs/method.md, "Verdicts".
LETTERS: Mapping[str, str] = {"oracle": "O", "masks": "R", "full": "R"}


class Figures(NamedTuple):
    """What the paper says of a cell; None where it says nothing.

    Attributes:
      find, grasp: shares of the scenes.
      find_steps, grasp_steps: mean number of actions.
    """

    find: float | None
    grasp: float | None
    find_steps: float | None
    grasp_steps: float | None


class PaperCell(NamedTuple):
    """What figures of the paper are of: O or R, the method, the allowed actions, and the number of objects."""

    letter: str
    method: str
    actions: tuple[str, ...]
    objects: int


@dataclasses.dataclass(frozen=True)
class PaperTable:
    """An experiment.

    Attributes:
      name: what commands call it.
      about: what it is, in a few words.
      blocks: the parts of scene sets that it runs on, by the number of objects.
      actions: the sets of actions that it compares.
      figures: what the paper says.
    """

    name: TableName
    about: str
    blocks: Mapping[int, str]
    actions: tuple[tuple[str, ...], ...]
    figures: Mapping[PaperCell, Figures]


def _figures(
    objects: tuple[int, ...],
    lines: Mapping[tuple[str, str, tuple[str, ...]], tuple[tuple[float | None, ...], tuple[float | None, ...]]],
) -> dict[PaperCell, Figures]:
    """Figures from lines as the paper prints them: shares, then steps, find and grasp in turn by number of objects."""
    figures = {}
    for (letter, method, actions), (shares, steps) in lines.items():
        for i, count in enumerate(objects):
            pair = slice(2 * i, 2 * i + 2)
            figures[PaperCell(letter, method, actions, count)] = Figures(*shares[pair], *steps[pair])
    return figures


_AND, _FOR = METHODS
_TABLES = (
    PaperTable(
        "table1",
        "180 scenes each with 2, 4, 6 and 8 objects",
        {2: "c2-2", 4: "c2-4", 6: "c2-6", 8: "c2-8"},
        (BOTH,),
        _figures(
            (2, 4, 6, 8),
            {
                ("O", _AND, BOTH): (
                    (0.978, 0.939, 0.939, 0.761, 0.878, 0.622, 0.844, 0.528),
                    (1.392, 1.562, 2.178, 2.635, 2.589, 3.473, 2.664, 3.947),
                ),
                ("O", _FOR, BOTH): (
                    (0.983, 0.928, 0.933, 0.794, 0.9, 0.678, 0.889, 0.578),
                    (1.407, 1.647, 2.077, 2.769, 2.377, 3.574, 2.831, 4.125),
                ),
                ("R", _AND, BOTH): (
                    (0.983, 0.928, 0.928, 0.789, 0.889, 0.656, 0.878, 0.606),
                    (1.362, 1.611, 2.222, 2.739, 2.581, 3.432, 2.981, 3.78),
                ),
                ("R", _FOR, BOTH): (
                    (0.972, 0.922, 0.933, 0.756, 0.922, 0.672, 0.894, 0.656),
                    (1.331, 1.651, 2.196, 2.765, 2.301, 3.281, 2.901, 3.975),
                ),
            },
        ),
    ),
    PaperTable(
        "table3",
        "200 scenes with two large cylinders, one behind the other",
        {2: "d1"},
        (BOTH,),
        _figures(
            (2,),
            {
                ("R", _AND, BOTH): ((None, 0.985), (2.065, 2.919)),
                ("R", _FOR, BOTH): ((None, 0.995), (2.255, 2.497)),
            },
        ),
    ),
    PaperTable(
        "table4",
        "75 scenes each with 4 and 8 objects; pushes or pick-and-places alone",
        {4: "d2-4", 8: "d2-8"},
        (BOTH, PICK_AND_PLACE, PUSH),
        _figures(
            (4, 8),
            {
                ("R", _AND, BOTH): ((0.973, 0.787, 0.893, 0.613), (2.164, 2.559, 3.269, 3.957)),
                ("R", _AND, PICK_AND_PLACE): ((0.76, 0.627, 0.627, 0.48), (1.404, 1.596, 2.255, 3.361)),
                ("R", _AND, PUSH): ((0.907, 0.573, 0.813, 0.507), (2.559, 3.628, 3.098, 4.763)),
                ("R", _FOR, BOTH): ((0.96, 0.813, 0.92, 0.6), (2.139, 2.77, 3.101, 3.889)),
                ("R", _FOR, PICK_AND_PLACE): ((0.76, 0.627, 0.693, 0.467), (1.386, 1.617, 2.327, 3.543)),
                ("R", _FOR, PUSH): ((0.92, 0.613, 0.773, 0.56), (2.609, 3.826, 3.034, 4.5)),
            },
        ),
    ),
    PaperTable(
        "table5",
        "40 scenes each with 4 and 8 objects; the target is a box",
        {4: "d3-4", 8: "d3-8"},
        (BOTH,),
        _figures(
            (4, 8),
            {
                ("R", _AND, BOTH): ((0.925, 0.775, 0.825, 0.525), (1.568, 3.323, 2.394, 4.81)),
                ("R", _FOR, BOTH): ((0.95, 0.7, 0.85, 0.6), (1.652, 3.286, 2.412, 5.167)),
            },
        ),
    ),
)
TABLES: Mapping[str, PaperTable] = {table.name: table for table in _TABLES}


def paper_figures(
    table: PaperTable, recognition: str, method: str, actions: tuple[str, ...], objects: int
) -> Figures | None:
    """What the paper says of a cell; None where it has none."""
    if recognition not in LETTERS:
        return None
    return table.figures.get(PaperCell(LETTERS[recognition], method, actions, objects))


def table_scenes(table: PaperTable, objects: Sequence[int] = (), scenes: int | None = None) -> list[tuple[Block, int]]:
    """The scenes of an experiment, for `scene_sets.scene_files`.

    Args:
      table: the experiment.
      objects: numbers of objects; all that it has if empty.
      scenes: the first so many of each number; all if None.

    Raises:
      InputError: it has no scenes with so many objects.
    """
    for count in objects:
        if count not in table.blocks:
            there = ", ".join(map(str, table.blocks))
            raise InputError(
                f"reproduce: {table.name} has no scenes with {count} objects; there are those with {there}"
            )
    chosen = dict.fromkeys(objects or table.blocks)
    blocks = [block for count in chosen for block in find_set(table.blocks[count]).blocks]
    return [(block, index) for block in blocks for index in range(block.scenes)[:scenes]]
