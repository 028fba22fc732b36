"""Results of whole episodes on the screen: what share of scenes can be solved, and what a suite lost."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Group
from rich.text import Text

from mechsearch_jax.benchmarks import guard, solvability
from mechsearch_jax.benchmarks.tables import plain_table


def ceiling_table(rows: Sequence[solvability.Row]) -> Group:
    """What share of scenes can be solved: a row for each number of objects; and below it why the others were not."""
    table = plain_table("scenes that can be solved at all")
    for name in ("objects", "scenes", "in an episode", "by the search", "solvable", "95% interval"):
        table.add_column(name, justify="right", no_wrap=True)
    for line in solvability.summary(rows):
        low, high = line["solvable_interval"]
        table.add_row(
            "all" if line["objects"] is None else str(line["objects"]),
            str(line["scenes"]),
            str(line["solved_in_an_episode"]),
            str(line["solved_by_the_search"]),
            f"{line['solvable']:.2f}",
            f"{low:.2f} to {high:.2f}",
            style="bold" if line["objects"] is None else None,
        )
    reasons = [Text(f"{row.scenario}: {row.reason}") for row in rows if not row.solvable]
    return Group(table, *reasons)


def guard_table(comparisons: Sequence[guard.Comparison], code: str) -> Group:
    """How a suite did against its reference: a row for each measure."""
    pairs = comparisons[0].pairs
    table = plain_table(f"{pairs} episodes against {code}")
    for name in ("", "before", "now", "gains", "losses", "p", "verdict"):
        table.add_column(name, justify="right", no_wrap=True)
    for one in comparisons:
        verdict = "lost" if one.lost else "no significant loss"
        counts = (one.before, one.now, one.gains, one.losses)
        table.add_row(one.measure, *map(str, counts), f"{one.p_value:.3f}", verdict, style="bold" if one.lost else None)
    alone, beside = (100 * guard.detectable(pairs, flips) for flips in (0.0, guard.FLIPS))
    explanation = (
        f"p: one-sided sign test, significant up to {comparisons[0].alpha:g}, so that a false alarm has a chance of "
        f"{guard.ALPHA:g} at most. Noticed with a chance of {guard.POWER:g}: a loss of {alone:.1f} points where "
        f"nothing else changes, of {beside:.1f} where {100 * guard.FLIPS:.0f}% of the episodes end otherwise by "
        "chance, as with another seed."
    )
    return Group(table, Text(explanation, style="dim"))
