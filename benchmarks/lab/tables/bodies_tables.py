"""Tables of `python -m mechsearch_jax.benchmarks.lab bodies`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from mechsearch_jax.benchmarks.report.console_tables import plain_table
from mechsearch_jax.benchmarks.statistics.intervals import with_interval

if TYPE_CHECKING:
    from mechsearch_jax.benchmarks.lab.looks import bodies

COLUMNS = ("objects", "IoU", "collisions right", "wrongly hit", "wrongly clear", "parts")


def bodies_tables(measured: bodies.MeasuredBodies) -> Group:
    """How well recognised bodies describe the true ones, by description and by thing."""
    whole = _table("95% intervals resample scenes", "described by", "of")
    for line in measured.summary():
        whole.add_row(line["description"], line["group"], *_cells(line, intervals=True))
    things = _table("things, those that are mostly seen", "thing", "described by")
    for line in measured.things():
        things.add_row(line["thing"], line["description"], *_cells(line, intervals=False))
    seconds = measured.value()["seconds"]
    times = ", ".join(f"{name}: {1e3 * spent:.0f} ms a look" for name, spent in seconds.items())
    explanation = (
        f"mostly seen: {100 * measured.settings['mostly']:.0f}% of the pixels that it would show alone. Collisions: of "
        f"the open gripper's cloud at random poses near the object. {times}; {measured.versions['device']}."
    )
    return Group(whole, things, Text(explanation, style="dim"))


def _table(title: str, *first: str) -> Table:
    table = plain_table(title)
    for name in (*first, *COLUMNS):
        table.add_column(name, justify="left" if name in first else "right")
    return table


def _cells(line: Mapping[str, Any], intervals: bool) -> list[str]:
    means = [with_interval(line[name], line[f"{name}_interval"] if intervals else None) for name in ("iou", "right")]
    shares = (f"{line[name]:.4f}" for name in ("false_hits", "missed_hits"))
    return [str(line["objects"]), *means, *shares, f"{line['parts']:.2f}"]
