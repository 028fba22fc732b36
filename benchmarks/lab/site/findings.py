"""The paper's findings (Kim et al., CoRL 2023, 5.1 and D.1 to D.3), and whether they hold here by rows of its tables.

A finding says that a difference is above 0, below 0, or that there is none. The first two hold, or do not, where the
95% interval of the difference lies on one side of 0. That there is none holds where the interval contains 0 and lies
within `MARGIN`, and does not hold where it does not contain 0. Anything else is not decided.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from mechsearch_jax.benchmarks.paper.paper_tables import BOTH, METHODS, PICK_AND_PLACE, PUSH, TABLES, paper_figures
from mechsearch_jax.benchmarks.paper.reproduce import ANY, Results, Setting, ran_alike
from mechsearch_jax.benchmarks.statistics.intervals import Interval, share_interval
from mechsearch_jax.benchmarks.statistics.paired import reached_change, same_episodes, steps_change
from mechsearch_jax.benchmarks.statistics.rates import scene_of, step_of
from mechsearch_jax.benchmarks.store.rows import EpisodeRow, options_of

Rule = Literal["more", "fewer", "no difference"]
Quantity = Literal["find", "grasp", "find_steps", "grasp_steps"]
HOLDS, FAILS, OPEN = "holds", "does not hold", "not decided"
# A share that is less than this away from another counts as the same.
MARGIN = 0.05


class Change(NamedTuple):
    """A difference.

    Attributes:
      value, interval: the difference and its 95% interval.
      count: over how many pairs of episodes; between tables, how many episodes of the finding's own one.
      methods: that they are of.
    """

    value: float
    interval: Interval
    count: int
    methods: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Finding:
    """What the paper says of a factor.

    Attributes:
      text: the finding in words.
      source: where the paper says it.
      rule: of the difference of `value` from `base`.
      quantity: in which they differ: a share, or the number of actions until then.
      table: whose rows decide it.
      factor, value, base: what differs. For a finding between tables, the factor is "table".
      recognitions: with which it is looked at, each by itself; empty where that is the factor.
      objects: the scenes with so many; all of them if empty.
    """

    text: str
    source: str
    rule: Rule
    quantity: Quantity
    table: str
    factor: str
    value: Any
    base: Any
    recognitions: tuple[str, ...] = ("masks",)
    objects: tuple[int, ...] = ()

    @property
    def commands(self) -> list[str]:
        """What gives the rows that decide it."""
        seen = self.recognitions if self.factor != "recognition" else (self.base, self.value)
        tables = [self.table, *([self.base] if self.factor == "table" else [])]
        return [f"mechsearch reproduce {table} --recognition {' '.join(seen)} --out FOLDER" for table in tables]


_AND, _FOR = METHODS


def _method(text: str, source: str, rule: Rule, quantity: Quantity, table: str, *objects: int) -> Finding:
    """Of search-for-grasp against search-and-grasp; of the toy scene the paper has R alone."""
    seen = ("oracle", "masks") if table == "table1" else ("masks",)
    return Finding(text, source, rule, quantity, table, "method", _FOR, _AND, seen, objects)


def _seen(recognition: str, name: str, quantity: Quantity) -> Finding:
    text = f"Between `{recognition}` and true shapes there is no difference in {name}"
    # In the paper's simulation segments are always true.
    source = "5.1" if recognition == "masks" else "5.1, there with true segments"
    return Finding(text, source, "no difference", quantity, "table1", "recognition", recognition, "oracle", ())


def _kinds(
    text: str, rule: Rule, quantity: Quantity, actions: tuple[str, ...], base: tuple[str, ...] = BOTH
) -> Finding:
    return Finding(text, "D.2", rule, quantity, "table4", "actions", actions, base)


def _boxes(text: str, rule: Rule, count: int) -> Finding:
    return Finding(text, "D.3", rule, "grasp", "table5", "table", "table5", "table1", objects=(count,))


FINDINGS = (
    _method("With 6 and 8 objects, search-for-grasp finds more often", "5.1", "more", "find", "table1", 6, 8),
    _method("With 6 and 8 objects, search-for-grasp grasps more often", "5.1", "more", "grasp", "table1", 6, 8),
    _method("With 2 and 4 objects, both methods find as often", "5.1", "no difference", "find", "table1", 2, 4),
    _method("With 2 and 4 objects, both methods grasp as often", "5.1", "no difference", "grasp", "table1", 2, 4),
    _seen("masks", "finding", "find"),
    _seen("masks", "grasping", "grasp"),
    _seen("full", "finding", "find"),
    _seen("full", "grasping", "grasp"),
    _method("In the toy scene, search-for-grasp needs fewer actions to grasp", "D.1", "fewer", "grasp_steps", "table3"),
    _method("In the toy scene, it needs more actions to find", "D.1", "more", "find_steps", "table3"),
    _kinds("Pick-and-place alone finds less often than both kinds of action", "fewer", "find", PICK_AND_PLACE),
    _kinds("Pick-and-place alone grasps less often than both kinds of action", "fewer", "grasp", PICK_AND_PLACE),
    _kinds("Pushing alone finds less often than both kinds of action", "fewer", "find", PUSH),
    _kinds("Pushing alone grasps less often than both kinds of action", "fewer", "grasp", PUSH),
    _kinds("Pushing alone finds more often than pick-and-place alone", "more", "find", PUSH, PICK_AND_PLACE),
    _kinds(
        "Pushing alone takes more actions to find than pick-and-place alone", "more", "find_steps", PUSH, PICK_AND_PLACE
    ),
    _boxes("With 4 objects, boxes are grasped less often than cylinders", "fewer", 4),
    _boxes("With 8 objects, boxes are grasped as often as cylinders", "no difference", 8),
)


class Verdict(NamedTuple):
    """Whether a finding holds.

    Attributes:
      part: preset and grasps.
      recognition: what the planner sees.
      goal: what counts as the paper's goal; see `goal_of`.
      change: here.
      paper: the same difference of the paper's figures, averaged over its cells; None where it has none.
      verdict: `HOLDS`, `FAILS` or `OPEN`.
    """

    part: str
    recognition: str
    goal: str
    change: Change
    paper: float | None
    verdict: str


def goal_of(quantity: Quantity, setting: Setting, row: EpisodeRow) -> str:
    """What counts as the paper's goal, of `rates.GOALS`.

    With trials the target is often taken out with a grasp that brushes something, before it is graspable; so it counts
    there that it was taken out, unless only grasps that touch nothing are used.
    """
    if quantity.startswith("find"):
        return "found"
    trials = options_of(row).get("trials", "none") != "none"
    return "retrieved" if trials and setting.grasps == ANY else "graspable"


def verdicts(finding: Finding, tables: Mapping[str, Results]) -> list[Verdict]:
    """Whether a finding holds, for every preset and kind of grasps of which there are rows.

    Args:
      finding: of the paper.
      tables: rows by the names of the tables.
    """
    changes = _between_tables(finding, tables) if finding.factor == "table" else _within(finding, tables)
    return [
        Verdict(part, seen, goal, change, _of_paper(finding, seen), _verdict(finding.rule, change.interval))
        for part, seen, goal, change in changes
    ]


def _verdict(rule: Rule, interval: Interval) -> str:
    low, high = interval
    match rule:
        case "more":
            return HOLDS if low > 0 else FAILS if high < 0 else OPEN
        case "fewer":
            return HOLDS if high < 0 else FAILS if low > 0 else OPEN
    if low > 0 or high < 0:
        return FAILS
    return HOLDS if max(-low, high) <= MARGIN else OPEN


_Changes = Iterator[tuple[str, str, str, Change]]


def _within(finding: Finding, tables: Mapping[str, Results]) -> _Changes:
    """The paired differences of a finding within a table, all methods and numbers of objects together."""
    rows = tables[finding.table].rows if finding.table in tables else {}
    pairs: dict[tuple[str, str, str], list[tuple[EpisodeRow, EpisodeRow]]] = {}
    for setting, own in rows.items():
        base = setting._replace(**{finding.factor: finding.base})
        if getattr(setting, finding.factor) != finding.value or base not in rows or not ran_alike(own, rows[base]):
            continue
        if finding.recognitions and setting.recognition not in finding.recognitions:
            continue
        key = setting.part, setting.recognition, goal_of(finding.quantity, setting, own[0])
        pairs.setdefault(key, []).extend(same_episodes(_with(own, finding.objects), rows[base]))
    for key, each in pairs.items():
        change = (steps_change if finding.quantity.endswith("steps") else reached_change)(each, key[2])
        if change.mean is not None and change.interval is not None:
            yield *key, Change(change.mean, change.interval, change.pairs, _methods_of(row for row, _ in each))


def _between_tables(finding: Finding, tables: Mapping[str, Results]) -> _Changes:
    """The differences of shares of scenes that have nothing in common, by Newcombe's method 10 (1998)."""
    sides: list[dict[tuple[str, str, str], list[EpisodeRow]]] = []
    for name in (finding.value, finding.base):
        side: dict[tuple[str, str, str], list[EpisodeRow]] = {}
        for setting, own in (tables[name].rows if name in tables else {}).items():
            if setting.recognition in finding.recognitions:
                key = setting.part, setting.recognition, goal_of(finding.quantity, setting, own[0])
                side.setdefault(key, []).extend(_with(own, finding.objects))
        sides.append({key: own for key, own in side.items() if own})
    for key in sides[0]:
        if key in sides[1]:
            (p, low, high), (q, lowest, highest) = (_share(side[key], key[2]) for side in sides)
            interval = p - q - math.hypot(p - low, highest - q), p - q + math.hypot(high - p, q - lowest)
            yield *key, Change(p - q, interval, len(sides[0][key]), _methods_of(sides[0][key]))


def _methods_of(rows: Iterable[EpisodeRow]) -> tuple[str, ...]:
    return tuple(sorted({row.policy for row in rows}))


def _share(rows: Sequence[EpisodeRow], goal: str) -> tuple[float, float, float]:
    reached = [step_of(row, goal) is not None for row in rows]
    return sum(reached) / len(rows), *share_interval(reached, list(map(scene_of, rows)))


def _with(rows: Sequence[EpisodeRow], objects: Sequence[int]) -> list[EpisodeRow]:
    return [row for row in rows if not objects or row.objects in objects]


def _of_paper(finding: Finding, recognition: str) -> float | None:
    """The difference of the paper's figures, averaged over methods and numbers of objects."""
    differences = []
    for method in METHODS if finding.factor != "method" else METHODS[:1]:
        for count in finding.objects or TABLES[finding.table].blocks:
            cell = {"table": finding.table, "recognition": recognition, "method": method, "actions": BOTH}
            values = [
                _figure(finding.quantity, count, **cell | {finding.factor: side})
                for side in (finding.value, finding.base)
            ]
            differences += [values[0] - values[1]] if values[0] is not None and values[1] is not None else []
    return sum(differences) / len(differences) if differences else None


def _figure(quantity: Quantity, objects: int, table: str, **cell: Any) -> float | None:
    figures = paper_figures(TABLES[table], **cell, objects=objects)
    return getattr(figures, quantity) if figures else None
