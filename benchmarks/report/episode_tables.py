"""Results of whole episodes on the screen: rates by variant, and what a suite lost."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

from rich.console import Console, Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from mechsearch_jax.benchmarks.guard import guard
from mechsearch_jax.benchmarks.report.console_tables import plain_table
from mechsearch_jax.benchmarks.statistics.actions_until import RestrictedMeans, horizon_of
from mechsearch_jax.benchmarks.statistics.paired import VariantDifferences
from mechsearch_jax.benchmarks.statistics.rates import EVENTS, GOALS, Events, Rates, summarise
from mechsearch_jax.benchmarks.statistics.variants import LONGEST, MOST_IN_FULL, VARIANT, Key
from mechsearch_jax.benchmarks.store.rows import EpisodeRow


def print_rates(console: Console, rows: Sequence[EpisodeRow]) -> None:
    """Print the rates of rows by variant and number of objects, with what the labels stand for."""
    print_summary(console, summarise(rows), Key.of(rows))


def print_summary(console: Console, summary: Sequence[Rates], key: Key) -> None:
    """Print rates, and what the labels of variants stand for."""
    console.print(summary_table(summary, key))
    console.print("plan, act: seconds per action", style="dim")
    if key.numbered:
        console.print()
        for label, short in key.short.items():
            console.print(f"{short}  {label}", soft_wrap=True, markup=False)
    elif key.common:
        console.print(f"all {key.common}", style="dim", soft_wrap=True, markup=False)


def summary_table(summary: Sequence[Rates], key: Key) -> Table:
    """Rates of success by group, and mean times per action.

    "paper's" is the share that is graspable with the paper's grasps alone, of the episodes that say so.
    """
    table = plain_table()
    for name in summary[0].group:
        _add_group_column(table, name, key)
    for name in ("runs", "found", "graspable", "paper's", "retrieved", "actions", "plan", "act"):
        table.add_column(name, justify="right", overflow="fold")
    for rates in _shown(summary, key):
        shares = rates.found, rates.graspable, rates.paper_graspable, rates.retrieved
        table.add_row(
            *_group(rates.group, key),
            str(rates.episodes),
            *("-" if share is None else f"{share:.2f}" for share in shares),
            "-" if rates.steps is None else f"{rates.steps:.1f}",
            f"{rates.planning_seconds:.2f}",
            f"{rates.simulation_seconds:.2f}",
            style="bold" if None in rates.group.values() else None,
        )
    return table


def _add_group_column(table: Table, name: str, key: Key) -> None:
    """A column that says what a group has in common; other columns are folded before short labels of variants are."""
    text = name in (VARIANT, "scenario", "policy")
    header = {"objects": "objs"}.get(name, name.replace("_", " "))
    whole = name == VARIANT and max(map(len, key.short.values())) <= LONGEST
    table.add_column(header, justify="left" if text else "right", no_wrap=whole, overflow="fold")


def _group(group: Mapping[str, Hashable], key: Key) -> list[str]:
    """What a group has in common, as cells without markup."""
    return [escape(key.text(value)) for value in group.values()]


def _shown(summary: Sequence[Any], key: Key) -> Sequence[Any]:
    """What is printed: all, or where there are many variants, what is over all numbers of objects."""
    if len(key.short) <= MOST_IN_FULL or list(summary[0].group) != [VARIANT, "objects"]:
        return summary
    return [each for each in summary if each.objects is None]


def restricted_table(means: Sequence[RestrictedMeans], key: Key) -> Table:
    """Restricted mean numbers of actions of at least one group."""
    budget, retrieval = (horizon_of(goal, means[0].budget) for goal in ("found", "retrieved"))
    table = plain_table(f"actions until then, never counted as {budget}, or {retrieval} for retrieved")
    for name in means[0].group:
        _add_group_column(table, name, key)
    for name in ("runs", *GOALS):
        table.add_column(name, justify="right", overflow="fold")
    for group in _shown(means, key):
        values = [getattr(group, goal) for goal in GOALS]
        table.add_row(
            *_group(group.group, key),
            str(group.episodes),
            *("-" if value is None else f"{value:.1f}" for value in values),
            style="bold" if None in group.group.values() else None,
        )
    return table


def differences_table(differences: VariantDifferences, key: Key, baseline: str) -> Table:
    """How variants differ from one of them over pairs of episodes, in percentage points, each ± a standard error."""
    table = plain_table(f"points more than {key.short[baseline]}, same episodes")
    table.add_column("variant", overflow="fold")
    for name in ("pairs", *GOALS):
        table.add_column(name, justify="right", overflow="fold")
    for label, goals in differences.items():
        cells = []
        for goal in GOALS:
            change = goals[goal]
            error = "" if change.standard_error is None else f" ± {100 * change.standard_error:.1f}"
            cells.append("-" if change.mean is None else f"{100 * change.mean:+.1f}{error}")
        table.add_row(escape(key.short[label]), str(goals["found"].pairs), *cells)
    return table


def events_summary_table(summary: Sequence[Events], key: Key) -> Table:
    """What happened on the way, of at least one group."""
    table = plain_table()
    for name in summary[0].group:
        _add_group_column(table, name, key)
    for name in ("runs", *EVENTS.values()):
        table.add_column(name, justify="right", overflow="fold")
    for events in _shown(summary, key):
        table.add_row(
            *_group(events.group, key),
            str(events.episodes),
            *events.texts(),
            style="bold" if events.objects is None else None,
        )
    return table


def guard_table(comparisons: Sequence[guard.Comparison], code: str) -> Group:
    """How a suite did against its reference: a row for each measure."""
    pairs = comparisons[0].pairs
    table = plain_table(f"{pairs} episodes against {code}")
    for name in ("", "before", "now", "gains", "losses", "p", "verdict"):
        table.add_column(name, justify="right", overflow="fold")
    for comparison in comparisons:
        verdict = "lost" if comparison.lost else "no significant loss"
        counts = (comparison.before, comparison.now, comparison.gains, comparison.losses)
        cells = (comparison.measure, *map(str, counts), f"{comparison.p_value:.3f}", verdict)
        table.add_row(*cells, style="bold" if comparison.lost else None)
    alone, beside = (100 * guard.detectable(pairs, flips) for flips in (0.0, guard.FLIPS))
    levels = ", ".join(f"{comparison.alpha:g} ({comparison.measure})" for comparison in comparisons)
    explanation = (
        f"actions: up to the retrieval, or {guard.NOT_RETRIEVED} without one; a gain is fewer. p: one-sided sign test, "
        f"significant up to {levels}, so that a false alarm has a chance of {guard.ALPHA:g} at most. Noticed with a "
        f"chance of {guard.POWER:g}: a loss of {alone:.1f} points of a rate where nothing else changes, of "
        f"{beside:.1f} where {100 * guard.FLIPS:.0f}% of the episodes end otherwise by chance, as with another seed."
    )
    left_out = [name for name in guard.MEASURES if name not in {comparison.measure for comparison in comparisons}]
    why = (
        f"{' and '.join(left_out)}: not compared, since in the reference a retrieval counts as graspable, too; write a "
        "new one with --write"
    )
    return Group(table, *([Text(why)] if left_out else []), Text(explanation, style="dim"))
