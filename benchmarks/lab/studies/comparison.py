"""What a study's rows say: rates of its variants, paired differences from the first, and one sentence."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

from rich.table import Table

from mechsearch_jax.benchmarks.lab.studies.studies import Study, Variant
from mechsearch_jax.benchmarks.statistics.intervals import with_interval
from mechsearch_jax.benchmarks.statistics.paired import PairedDifference, change_of, same_episodes
from mechsearch_jax.benchmarks.statistics.rates import actions_of
from mechsearch_jax.benchmarks.store.rows import EpisodeRow


def _drop_free(row: EpisodeRow) -> bool | None:
    return None if row.objects_fallen is None and not row.is_error else row.objects_fallen == 0


# What an episode reaches, by what stored runs call it; None where a row does not say. An error reaches nothing.
OUTCOMES: Mapping[str, Callable[[EpisodeRow], bool | None]] = {
    "found": lambda row: row.found_step is not None,
    "graspable": lambda row: row.graspable_step is not None,
    "paper_graspable": lambda row: row.paper_graspable,
    "retrieved": lambda row: row.retrieved,
    "drop_free": _drop_free,
}
# The same in the words of pages.
WORDS: Mapping[str, str] = {
    "found": "found",
    "graspable": "graspable",
    "paper_graspable": "with the paper's grasps",
    "retrieved": "retrieved",
    "drop_free": "drop-free",
}
# The shares that variants are compared by.
COMPARED = ("found", "graspable", "retrieved", "drop_free")


# What is compared, by the words of tables: a number for each episode, or None where its row does not say.
SHARES = tuple(WORDS[name] for name in COMPARED)
MEASURES: Mapping[str, Callable[[EpisodeRow], float | None]] = {
    **{WORDS[name]: OUTCOMES[name] for name in COMPARED},
    "actions": actions_of,
}


@dataclasses.dataclass(frozen=True)
class Comparison:
    """A variant beside the first of its study.

    Attributes:
      variant: the method.
      episodes: how many.
      errors: how many of the episodes could not be run to their end; they count as failures.
      means: of each of `MEASURES` over episodes; None where no row says it.
      changes: how much more than the first variant, over the scenes and seeds that both have; empty for the first.
    """

    variant: Variant
    episodes: int
    errors: int
    means: Mapping[str, float | None]
    changes: Mapping[str, PairedDifference]


def compare(study: Study, rows: Sequence[EpisodeRow]) -> list[Comparison]:
    """The variants of which there are rows, of any studies, in the order of the study."""
    groups = study.rows_of(rows)
    base = groups.get(study.baseline.label, [])
    return [
        _comparison(variant, groups[variant.label], base if variant is not study.baseline else [])
        for variant in study.variants
        if variant.label in groups
    ]


def _comparison(variant: Variant, rows: Sequence[EpisodeRow], base: Sequence[EpisodeRow]) -> Comparison:
    means = {}
    pairs = same_episodes(rows, base)
    for name, measure in MEASURES.items():
        values = [value for row in rows if (value := measure(row)) is not None]
        means[name] = sum(values) / len(values) if values else None
    return Comparison(
        variant,
        len(rows),
        sum(row.is_error for row in rows),
        means,
        {name: change_of(pairs, measure) for name, measure in MEASURES.items()} if pairs else {},
    )


def verdict(change: PairedDifference) -> int:
    """1 where a change is certainly above 0, -1 where it is below, 0 where its 95% interval holds 0."""
    if change.interval is None:
        return 0
    low, high = change.interval
    return int(low > 0) - int(high < 0)


def points(change: PairedDifference) -> str:
    """A change of a share in percentage points, with its interval."""
    if change.mean is None:
        return "-"
    return with_interval(100 * change.mean, change.interval and [100 * bound for bound in change.interval], "{:+.1f}")


def sentence(study: Study, comparisons: Sequence[Comparison]) -> str:
    """What the study says of `retrieved`, in words."""
    others = [each for each in comparisons if each.changes]
    if not others:
        there = bool(comparisons) and comparisons[0].variant is study.baseline
        return f"There are no rows of {'another variant' if there else study.baseline.label} yet."
    by_verdict: dict[int, list[str]] = {1: [], -1: [], 0: []}
    for each in others:
        change = each.changes["retrieved"]
        shown = f"{each.variant.label} {points(change)}"
        by_verdict[verdict(change)].append(shown if verdict(change) else each.variant.label)
    parts = []
    if by_verdict[-1]:
        parts.append(f"fewer are retrieved with {listed(by_verdict[-1])}")
    if by_verdict[1]:
        parts.append(f"more are retrieved with {listed(by_verdict[1])}")
    if by_verdict[0]:
        parts.append(f"no difference is certain with {listed(by_verdict[0])}")
    text = "; ".join(parts)
    return f"Against {study.baseline.label}, in points of retrieved: {text}."


def listed(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def screen(study: Study, rows: Sequence[EpisodeRow]) -> Table:
    """The study as it is printed."""
    comparisons = compare(study, rows)
    title = f"\n{study.name}: {study.question}\n{sentence(study, comparisons)}"
    table = Table(
        box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold", title=title, title_justify="left"
    )
    for name in ("", "episodes", "found", "graspable", "retrieved", "actions", "change of retrieved"):
        table.add_column(name, justify="right" if name else "left")
    for each in comparisons:
        shares = [with_interval(each.means[name], None, "{:.2f}") for name in ("found", "graspable", "retrieved")]
        actions = with_interval(each.means["actions"], None, "{:.1f}")
        change = points(each.changes["retrieved"]) if each.changes else ""
        table.add_row(each.variant.label, str(each.episodes), *shares, actions, change)
    return table
