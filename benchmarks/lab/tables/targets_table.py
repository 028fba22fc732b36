"""The table of `python -m mechsearch_jax.benchmarks.lab targets`."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Group
from rich.text import Text

from mechsearch_jax.benchmarks.lab.targets import graspable
from mechsearch_jax.benchmarks.report.console_tables import plain_table
from mechsearch_jax.benchmarks.statistics.intervals import with_interval


def targets_table(rows: Sequence[graspable.TargetRow]) -> Group:
    """Whether meshes are grasped wherever physics says that they can be: a line for each, and one for all."""
    table = plain_table("meshes alone on the board, at random poses")
    for name in ("mesh", "poses", "physics", "both", "planner alone", "why not"):
        table.add_column(name, justify="left" if name in ("mesh", "why not") else "right")
    every = graspable.summary(rows)
    for name, line in {**graspable.by_mesh(rows), "all": every}.items():
        counts = (str(line[key]) for key in ("poses", "physics", "both", "planner_alone"))
        table.add_row(name, *counts, ", ".join(f"{fault} ({count})" for fault, count in line["faults"].items()))
    explanation = (
        "physics: one of the random antipodal grasps takes the mesh out in a trial. both: so does one of the planner's,"
        " which else does not for the reason on the right. planner alone: only one of the planner's does. Where physics"
        f" does, the planner does in {with_interval(every['share'], every['interval'])} of poses; the interval accounts"
        " for meshes, whose poses are alike."
    )
    return Group(table, Text(explanation, style="dim"))
