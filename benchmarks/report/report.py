"""What results say: rates with confidence intervals, paired differences, and failure reasons."""

from __future__ import annotations

import collections
import dataclasses
import re
from collections.abc import Sequence

from mechsearch_jax.benchmarks.report.films import Film
from mechsearch_jax.benchmarks.report.report_figures import curve_rates
from mechsearch_jax.benchmarks.statistics.actions_until import RestrictedMeans, restricted_means
from mechsearch_jax.benchmarks.statistics.paired import PAIRED, VariantDifferences, paired
from mechsearch_jax.benchmarks.statistics.rates import Events, Rates, summarise, summarise_events
from mechsearch_jax.benchmarks.statistics.variants import Key, canonical, label_variants, natural
from mechsearch_jax.benchmarks.store.rows import EpisodeRow, identity
from mechsearch_jax.benchmarks.store.shards import result_tables
from mechsearch_jax.envs.scenes.scene_sets import CHOSEN_ON, is_chosen_on
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike

# Which action it was is no reason of its own.
_WHICH_ACTION = re.compile(r" at action \d+$")


def read_tables(paths: Sequence[PathLike]) -> list[EpisodeRow]:
    """The rows of several results of `evaluate`: folders, folders of them, and Parquet files.

    Raises:
      InputError: one holds no such results, an episode is in two tables, or there is none at all.
    """
    rows: list[EpisodeRow] = []
    origin: dict[tuple, PathLike] = {}
    for path in paths:
        for table, members in result_tables(path):
            for row in members:
                if (other := origin.setdefault(identity(row), table)) is not table:
                    raise InputError(
                        f"{table}: holds scenario {row.scenario!r}, seed {row.seed}, with the same options as {other}; "
                        "report them one by one"
                    )
            rows += members
    if not rows:
        raise InputError("report: there are no episodes in these tables")
    return rows


def changed_scenarios(rows: Sequence[EpisodeRow]) -> list[str]:
    """Names under which rows hold more than one content: their files were changed in between."""
    contents: dict[str, set[str]] = {}
    for row in rows:
        contents.setdefault(row.scenario, set()).add(row.content_hash)
    return sorted(name for name, hashes in contents.items() if len(hashes) > 1)


def changed_scenarios_remark(rows: Sequence[EpisodeRow]) -> str:
    """A sentence that names scenarios that changed between rows; empty if there are none."""
    names = changed_scenarios(rows)
    if not names:
        return ""
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f"Scenarios whose content is not the same in all rows count as several: {', '.join(names[:5])}{more}."


def chosen_scenes_remark(rows: Sequence[EpisodeRow]) -> str:
    """A sentence that says how many episodes are on scenes that settings were chosen on; empty if none is."""
    count = sum(is_chosen_on(row.scenario) for row in rows)
    if not count:
        return ""
    which = "All" if count == len(rows) else f"{count} of the {len(rows)}"
    return f"{which} episodes are on scenes that settings were chosen on ({CHOSEN_ON}): on others rates may be lower."


@dataclasses.dataclass(frozen=True)
class Failures:
    """How often episodes ended for a reason.

    Attributes:
      method: with the options that differ, as `label_variants` has it.
      reason: why there was no retrieval.
      episodes: how many ended so.
      share: of the method's episodes.
    """

    method: str
    reason: str
    episodes: int
    share: float


def failure_reason(row: EpisodeRow) -> str:
    """Why an episode ended without a retrieval, whichever action it was."""
    return _WHICH_ACTION.sub("", row.failure or "unknown")


def failures(rows: Sequence[EpisodeRow]) -> list[Failures]:
    """Why episodes ended without a retrieval, the most frequent reason first."""
    groups: dict[str, list[EpisodeRow]] = {}
    for row, label in zip(rows, label_variants(rows), strict=True):
        groups.setdefault(label, []).append(row)
    table = []
    for method in sorted(groups, key=natural):
        group = groups[method]
        reasons = collections.Counter(failure_reason(row) for row in group if not row.retrieved)
        table += [Failures(method, reason, n, n / len(group)) for reason, n in reasons.most_common()]
    return table


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """What a report holds beside what every report does.

    Attributes:
      rows: columns by which rates are grouped, instead of the variant and the number of objects.
      curve: one column or two: rates over the first, with a line for each value of the second.
      baseline: a variant, as `Key.named` takes it, that all others are compared with.
      paired: columns that make two episodes a pair.
    """

    rows: Sequence[str] = ()
    curve: Sequence[str] = ()
    baseline: str | None = None
    paired: Sequence[str] = PAIRED


@dataclasses.dataclass(frozen=True)
class Report:
    """What rows say.

    Attributes:
      episodes: the rows.
      key: of their variants.
      rates: by the columns of the options, by default the variant and the number of objects.
      variants: by variant and number of objects.
      restricted: restricted mean numbers of actions, grouped as `rates` are.
      events: by variant and number of objects.
      reasons: why episodes failed.
      curve_columns, curve: rates over a column; empty without that option.
      baseline, differences: paired differences from that variant, its label; None and empty without that option.
      films: pictures of single episodes.
      drawn: the files of all single episodes that are drawn; see `scene_map.drawn_files`.
    """

    episodes: Sequence[EpisodeRow]
    key: Key
    rates: Sequence[Rates]
    variants: Sequence[Rates]
    restricted: Sequence[RestrictedMeans]
    events: Sequence[Events]
    reasons: Sequence[Failures]
    curve_columns: Sequence[str]
    curve: Sequence[Rates]
    baseline: str | None
    differences: VariantDifferences
    films: Sequence[Film] = ()
    drawn: frozenset[str] = frozenset()

    @classmethod
    def of(cls, rows: Sequence[EpisodeRow], options: ReportOptions | None = None) -> Report:
        """The report of at least one row.

        Raises:
          InputError: there is no such column or variant, or nothing to compare the baseline with.
        """
        options, key = options or ReportOptions(), Key.of(rows)
        baseline = None if options.baseline is None else key.named(options.baseline)
        by_variant = summarise(rows)
        return cls(
            episodes=rows,
            key=key,
            rates=summarise(rows, options.rows) if options.rows else by_variant,
            variants=by_variant,
            restricted=restricted_means(rows, options.rows) if options.rows else restricted_means(rows),
            events=summarise_events(rows),
            reasons=failures(rows),
            curve_columns=[canonical(name) for name in options.curve],
            curve=curve_rates(rows, options.curve) if options.curve else [],
            baseline=baseline,
            differences={} if baseline is None else paired(rows, baseline, options.paired),
        )
