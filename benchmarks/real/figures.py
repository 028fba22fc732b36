"""The figures of recognition on real depth images: what each of them is stands in `FIGURES`, and nowhere else."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from rich.table import Table

from mechsearch_jax.benchmarks.real.scores import MATCHED, WELL, Body, Thing
from mechsearch_jax.benchmarks.report.console_tables import plain_table
from mechsearch_jax.benchmarks.statistics.intervals import SEED, with_interval

Images = Literal["depth and colour", "true masks"]
# Scenes with more things are told apart: more than the slots that recognition has by default.
FEW = 8
# Of the bootstrap.
RESAMPLES = 500


@dataclasses.dataclass(frozen=True)
class Look:
    """What came of one look.

    Attributes:
      scene, category: its name, and what kind of scene it is.
      images: what was given beside the depth image.
      labels: number of labelled things, also of those that do not count.
      things, bodies: see `scores.scored`.
      seconds, compile_seconds: of a look, and by how much the first one was longer.
      doubt: why a `Searcher` would not move, or refuse the images; None if it would move.
      warnings: what it would say.
    """

    scene: str
    category: str
    images: Images
    labels: int
    things: Sequence[Thing]
    bodies: Sequence[Body]
    seconds: float
    compile_seconds: float
    doubt: str | None
    warnings: Sequence[str]

    @property
    def right(self) -> bool:
        """Whether all things are matched, and all bodies."""
        return all(t.iou >= MATCHED for t in self.things) and all(body.thing is not None for body in self.bodies)

    def fitted(self, value: Callable[[Any], Any], among: Callable[[Thing], bool] = lambda _: True) -> list[Any]:
        """A value of each matched thing among some."""
        return [value(thing) for thing in self.things if thing.median is not None and among(thing)]


def stands(thing: Thing) -> bool:
    """Whether a thing's points reach down to the board."""
    return thing.low < 0.015


def raised(thing: Thing) -> bool:
    """Whether a thing stands on another: its points end 3 cm or more above the board, and its foot is in sight."""
    return thing.low > 0.03 and thing.foot


def pulled_down(thing: Thing) -> bool:
    """Whether a raised thing's body ends 2 cm or more below its points."""
    return raised(thing) and thing.bottom is not None and thing.bottom < thing.low - 0.02


def _right(look: Look, body: Body) -> bool:
    things = {thing.number: thing for thing in look.things}
    own = None if body.thing is None else things[body.thing]
    return own is not None and own.iou >= WELL and own.median is not None and own.median < 0.005


class Figure(NamedTuple):
    """A figure: what it is, its values of a look, the statistic over the values of all looks, and how it is printed."""

    about: str
    of: Callable[[Look], Sequence[float]]
    statistic: Callable[[np.ndarray], Any] = np.mean
    form: str = "{:.2f}"


# Things are labelled ones of at least 200 measured pixels in the workspace. A body is matched with the thing of its
# mask, or one to one by the intersection over union of the thing's measured pixels and those that show the body.
FIGURES: Mapping[str, Figure] = {
    "matched": Figure("share of things with a body of IoU 0.5", lambda look: [t.iou >= MATCHED for t in look.things]),
    "matched well": Figure("share with a body of IoU 0.75", lambda look: [t.iou >= WELL for t in look.things]),
    "split": Figure(
        "things a scene that two bodies show a fifth of, mostly it", lambda look: [sum(t.split for t in look.things)]
    ),
    "merging": Figure(
        "bodies a scene that show two fifths of two things each", lambda look: [sum(b.merges for b in look.bodies)]
    ),
    "phantoms": Figure(
        "bodies a scene that are seen mostly where no thing is", lambda look: [sum(b.phantom for b in look.bodies)]
    ),
    "distance, mm": Figure(
        "of a matched thing's points from its body's surface: of each the median, of these the median",
        lambda look: look.fitted(lambda t: 1e3 * t.median), np.median, "{:.1f}",
    ),
    "90th percentile, mm": Figure(
        "the same, of each the 90th percentile", lambda look: look.fitted(lambda t: 1e3 * t.p90), np.median, "{:.1f}"
    ),
    "rays through, %": Figure(
        "of the measured rays to a matched thing's body, those that end more than 1 cm behind its front; the mean",
        lambda look: look.fitted(lambda t: 100 * t.passed), form="{:.1f}",
    ),
    "upright": Figure(
        "share of bodies within 5 degrees of the vertical, of things on the board whose points (80%) lie on an upright "
        "box or cylinder: instead of a true pose",
        lambda look: look.fitted(lambda t: t.tilt < 5.0, lambda t: stands(t) and t.on_upright > 0.8),
    ),
    "stand": Figure(
        "share of bodies that end within 1 cm of the board, of things whose points reach down to it (1.5 cm)",
        lambda look: look.fitted(lambda t: abs(t.bottom) < 0.01, stands),
    ),
    "stand raised": Figure(
        "share of bodies that end within 1 cm of the lowest points of things that stand on others (3 cm above the "
        "board, and no foot hidden)",
        lambda look: look.fitted(lambda t: abs(t.bottom - t.low) < 0.01, raised),
    ),
    "pulled down": Figure(
        "share of bodies that end 2 cm or more below these", lambda look: look.fitted(pulled_down, raised)
    ),
    "sure and right": Figure(
        "of bodies at a confidence of 0.9, those with an IoU of 0.75 and a distance below 5 mm: instead of a true pose",
        lambda look: [_right(look, body) for body in look.bodies if body.confidence >= 0.9],
    ),
    "stopped, wrong": Figure(
        "share of scenes with an unmatched thing or body that a `Searcher` refuses, or does not act on",
        lambda look: [] if look.right else [look.doubt is not None],
    ),
    "stopped, right": Figure("the same of others", lambda look: [look.doubt is not None] if look.right else []),
    "warnings": Figure("of a `Searcher` a scene", lambda look: [len(look.warnings)]),
    "look, s": Figure("the median, all compiled", lambda look: [look.seconds], np.median),
    "compiling, s": Figure("of all looks", lambda look: [look.compile_seconds], np.sum, "{:.0f}"),
}  # fmt: skip


class Value(NamedTuple):
    """A figure's value, None without any; its 95% interval, None below two scenes; and of how many values it is."""

    value: float | None
    interval: tuple[float, float] | None
    values: int


def value_of(figure: Figure, looks: Sequence[Look]) -> Value:
    """A figure of looks, with the percentile bootstrap that draws whole scenes."""
    values = [figure.of(look) for look in looks]
    every, scene = np.concatenate([[], *values]), np.repeat(range(len(values)), list(map(len, values)))
    if not len(every):
        return Value(None, None, 0)
    interval = None
    if len(set(scene)) > 1 and figure.statistic is not np.sum:
        draws = np.random.default_rng(SEED).multinomial(len(values), [1 / len(values)] * len(values), RESAMPLES)
        drawn = [figure.statistic(np.repeat(every, times)) for times in draws[:, scene] if times.any()]
        low, high = np.percentile(drawn, (2.5, 97.5)).tolist()
        interval = low, high
    return Value(float(figure.statistic(every)), interval, len(every))


def groups_of(looks: Sequence[Look]) -> dict[str, list[Look]]:
    """All looks; those at scenes of few things, if others have more; and those of each category, if there are some."""
    few, kinds = [look for look in looks if look.labels <= FEW], sorted({look.category for look in looks})
    groups = {"all": list(looks)} | ({f"at most {FEW}": few} if 0 < len(few) < len(looks) else {})
    return groups | {kind: [look for look in looks if look.category == kind] for kind in kinds if len(kinds) > 1}


# By what images were given, by group, by name.
Figures = Mapping[str, Mapping[str, Mapping[str, Value]]]


def figures(looks: Sequence[Look]) -> Figures:
    """Every figure of looks."""
    given = dict.fromkeys(look.images for look in looks)
    return {
        images: {
            group: {name: value_of(figure, chosen) for name, figure in FIGURES.items()}
            for group, chosen in groups_of([look for look in looks if look.images == images]).items()
        }
        for images in given
    }


def table(images: str, groups: Mapping[str, Mapping[str, Value]]) -> Table:
    """The figures of what images were given: a column for each group, the first with intervals."""
    printed = plain_table(f"from {images}; 95% intervals resample scenes")
    for name in ("", *groups):
        printed.add_column(name, justify="right" if name else "left")
    for name, figure in FIGURES.items():
        values = [(of[name].value, of[name].interval if group == "all" else None) for group, of in groups.items()]
        printed.add_row(name, *[with_interval(*value, figure.form) for value in values])
    return printed
