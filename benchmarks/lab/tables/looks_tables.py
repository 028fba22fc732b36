"""Tables of `python -m mechsearch_jax.benchmarks.lab looks`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Group
from rich.table import Table
from rich.text import Text

from mechsearch_jax.benchmarks.report.console_tables import plain_table

if TYPE_CHECKING:
    from mechsearch_jax.benchmarks.lab.looks import looks


def looks_tables(measured: looks.MeasuredLooks) -> Group:
    """What comes of depth and colour images alone, for all segments and noises: by pixels, contact and number of
    objects, and how often objects are wrong by their stated confidence."""
    tables: list[Table] = []
    for line in measured.summary():
        if "looks" in line:
            title = (
                f"{line['segments']}, {line['noise']}: {line['looks']} looks, {line['phantoms']} phantoms; targets: "
                f"{line['targets_in_sight']} in sight, {line['targets_missed']} missed, {line['targets_false']} false"
            )
            tables.append(plain_table(title))
            for name in ("objects", "counted", "wrong", "missing", "off", "turned", "IoU", "kinds"):
                tables[-1].add_column(name, justify="left" if name in ("objects", "kinds") else "right")
        numbers = [str(line[name]) for name in ("objects", "wrong", "missing", "off", "turned")]
        kinds = ", ".join(f"{count} {kind}" for kind, count in line["kinds"].items())
        tables[-1].add_row(line["group"], *numbers, f"{line['iou_mean']:.3f}", kinds)
    stated = plain_table("stated confidence")
    for name in ("segments", "noise", "confidence", "recognised", "wrong", "expected"):
        stated.add_column(name, justify="left" if name in ("segments", "noise") else "right")
    for line in measured.reliability():
        within = f"{line['from']:.2f} to {line['to']:.2f}"
        counts = (str(line["objects"]), str(line["wrong"]), f"{line['expected_wrong']:.1f}")
        stated.add_row(line["segments"], line["noise"], within, *counts)
    value = measured.value()
    times = ", ".join(
        f"{kind}: {1e3 * value['seconds'][kind]['median']:.0f} ms a look (95th percentile "
        f"{1e3 * value['seconds'][kind]['95th percentile']:.0f}), compiled in {value['compile_seconds'][kind]:.0f} s"
        for kind in value["seconds"]
    )
    explanation = (
        "Visible objects of at least 100 pixels. off: more than 2 cm; turned: more than 15 degrees. Kinds: by the "
        f"segments. {times}; {measured.versions['device']}."
    )
    return Group(*tables, stated, Text(explanation, style="dim"))
