"""What the pages of scene sets say in words: what a set is, what it is for, and what is shown of it."""

from __future__ import annotations

import dataclasses

# Said once, on the page that lists all sets.
CLUTTER = (
    "Objects are drawn evenly among eleven boxes and cylinders and dropped onto the board, where they come to rest. "
    "The target stands anywhere in the rectangle that the candidate positions span, the board less 50 mm on each side, "
    "at a place where it shows at most 100 pixels and could be grasped if nothing stood around it. A scene follows "
    "from its seed and its number of objects alone."
)
_AS_MOST = "[As most sets are](index.md#how-they-are-made), from the seeds below."


@dataclasses.dataclass(frozen=True)
class About:
    """The words of a page.

    Attributes:
      title: of the page, after its name.
      what: a paragraph on what the set is and what it is for.
      made: a paragraph on how it is made.
      shown: numbers of objects and numbers of the scenes in the picture, in order; none where there is no picture.
      config: file that gives the shelf, from the root of the repository; empty for the usual one.
      paper: what of the paper it corresponds to; empty for nothing.
      sets: names of the sets that the page is about, where it is not named after its only one.
    """

    title: str
    what: str
    made: str = _AS_MOST
    shown: tuple[tuple[int, int], ...] = ()
    config: str = ""
    paper: str = ""
    sets: tuple[str, ...] = ()


_EACH = tuple((objects, 0) for objects in (2, 4, 6, 8))
_SHELF = (
    "A robustness set: what becomes of the method on {}, which no network was trained on. It goes with the shelf's "
    "configuration file."
)

ABOUT: dict[str, About] = {
    "c2": About(
        "the main experiment",
        "The scenes of the main comparison: how often the target is found, graspable and retrieved among 2, 4, 6 and "
        "8 objects. Numbers 000 to 089 of each part were used to choose settings; 090 to 179 were not, and rates are "
        "reported on them.",
        shown=_EACH,
        paper="C.2, Table 1",
    ),
    "d1": About(
        "one behind the other",
        "A problem with a known answer. Two large cylinders stand in line between the camera and the target, and "
        "each hides it by itself: both have to be moved, so that no search takes fewer than two actions before the "
        "target is in sight.",
        "The target stands at x 0.70 m, y 0.05 m. The cylinders have radii of 26 to 36 mm and heights of 0.12 to "
        "0.21 m, and stand 5 mm or more apart. Scenes differ in these sizes and places.",
        shown=tuple((2, number) for number in range(4)),
        paper="D.1, Table 3",
    ),
    "d2": About(
        "pushes or pick-and-places alone",
        "The scenes on which kinds of action are compared: with pushes alone, with pick-and-places alone, with both.",
        shown=((4, 0), (4, 1), (8, 0), (8, 1)),
        paper="D.2, Table 4",
    ),
    "d3": About(
        "a box as the target",
        "The target is a box, whose yaw matters: it has six times as many candidate poses, and must be approached "
        "square to a face.",
        shown=((4, 0), (4, 1), (8, 0), (8, 1)),
        paper="D.3, Table 5",
    ),
    "development": About(
        "for trying things",
        "Made as [`c2`](c2.md) is, for trying things and choosing settings: look at these scenes as often as you like. "
        "The guard and ablations run on them. Rates here are biased towards what was chosen.",
        shown=_EACH,
    ),
    "development-box": About(
        "for trying things with boxes",
        "Made as [`d3`](d3.md) is, for trying things and choosing settings where the target is a box.",
        shown=((4, 0), (4, 1), (8, 0), (8, 1)),
    ),
    "report": About(
        "to report with",
        "Nine sets, each to report one larger change with, made as [`c2`](c2.md) is from seeds that no other set has. "
        "Each is used once, because scenes that were looked at are no longer unseen; so no picture of them is shown. "
        "All nine are used. `report-i` reports what the default comes to, and what it comes to where friction and "
        "shapes are not known.",
        sets=tuple(f"report-{letter}" for letter in "abcdefghi"),
    ),
    **{
        f"shelf-{name}": About(
            f"{words}",
            _SHELF.format(words),
            shown=_EACH,
            config=f"benchmarks/lab/parts/views/shelf-{name}.toml",
        )
        for name, words in (
            ("low", "a lower and closer shelf"),
            ("narrow", "a higher and narrower shelf"),
            ("wide", "a deeper and wider shelf"),
        )
    },
    "household": About(
        "household things",
        "What the method does among mugs, bottles, bowls, books and fruit: 35 things, each of up to four boxes, "
        "cylinders, ellipsoids, capsules and frustums. "
        "![The catalogue: every thing as it stands, at its usual size](../household-things.png)",
        "Objects are drawn evenly among the things, at a size drawn evenly from each thing's range, and dropped as "
        "they stand; the rest is [as in most sets](index.md#how-they-are-made). The things are declared in "
        "[household.toml](../../envs/scenes/household.toml).",
        shown=((4, 0), (4, 1), (8, 0), (8, 1)),
    ),
    "household-box": About(
        "household things, and a box as the target",
        "As [`household`](household.md), with a target whose yaw matters.",
        "As [`household`](household.md) is, from the seeds below.",
        shown=((4, 0), (4, 1), (8, 0), (8, 1)),
    ),
    "report-household": About(
        "household things, to report with",
        "As [`household`](household.md), from seeds that no other set has. How things are recognised was tried and "
        "chosen on `household`; here is what that comes to, so no picture of these scenes is shown.",
        "As [`household`](household.md) is, from the seeds below.",
    ),
    "published": About(
        "of the method's authors",
        "The scenes that the method's authors published with their code: 200, of which 100 were used here, 25 each "
        "with 2, 4, 6 and 8 objects. Settings were chosen on them. Their repository names no licence: so they are no "
        "named set, no picture of them is shown, and who has a copy [imports it](../method.md#the-published-scenes).",
        "By the authors, in PyBullet. In three of the 100 used the target shows more than 100 pixels at the start.",
    ),
}


def sets_of(name: str) -> tuple[str, ...]:
    """The names of the sets that a page is about."""
    return ABOUT[name].sets or (name,)
