"""What results say: rates with confidence intervals, paired differences, failure reasons, and pictures of all that."""

from __future__ import annotations

import collections
import csv
import dataclasses
import io
import json
import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from matplotlib.figure import Figure

from mechsearch_jax.benchmarks.report.films import Film
from mechsearch_jax.benchmarks.report.pages import as_html, as_latex, as_markdown
from mechsearch_jax.benchmarks.report.report_figures import curve_figure, curve_rates, rates_figure, success_figure
from mechsearch_jax.benchmarks.statistics.paired import PAIRED, Difference, paired
from mechsearch_jax.benchmarks.statistics.rates import Events, Rates, summarise, summarise_events
from mechsearch_jax.benchmarks.statistics.variants import VARIANT, Key, canonical, label_variants, natural
from mechsearch_jax.benchmarks.store.rows import Row, identity, options_of
from mechsearch_jax.benchmarks.store.shards import result_tables
from mechsearch_jax.envs.scenes.scene_sets import CHOSEN_ON, is_chosen_on
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, check_writable, replacing
from mechsearch_jax.viz.drawing import save_figure

# What every report consists of, and what one has that was asked for more; the folder `films.FOLDER` holds pictures.
FILES = (
    *("report.md", "report.tex", "report.html", "rates.csv", "rates.json", "failures.csv", "events.csv", "key.csv"),
    *("success.png", "rates.png"),
)
ASKED_FILES = ("curve.csv", "curve.png", "paired.csv")
# Which action it was is no reason of its own.
_WHICH_ACTION = re.compile(r" at action \d+$")


def read_tables(paths: Sequence[PathLike]) -> list[Row]:
    """The rows of several results of `evaluate`: folders, folders of them, and Parquet files.

    Raises:
      InputError: one holds no such results, an episode is in two tables, or there is none at all.
    """
    rows: list[Row] = []
    origin: dict[tuple, PathLike] = {}
    for path in paths:
        for table, found in result_tables(path):
            for row in found:
                if (other := origin.setdefault(identity(row), table)) is not table:
                    raise InputError(
                        f"{table}: holds scenario {row.scenario!r}, seed {row.seed}, with the same options as {other}; "
                        "report them one by one"
                    )
            rows += found
    if not rows:
        raise InputError("report: there are no episodes in these tables")
    return rows


def changed_scenarios(rows: Sequence[Row]) -> list[str]:
    """Names under which rows hold more than one content, or one and an unknown: their files were changed in between."""
    contents: dict[str, set[str | None]] = {}
    for row in rows:
        contents.setdefault(row.scenario, set()).add(row.content_hash)
    return sorted(name for name, hashes in contents.items() if len(hashes) > 1)


def told_of_changes(rows: Sequence[Row]) -> str:
    """A sentence that names scenarios that changed between rows; empty if there are none."""
    names = changed_scenarios(rows)
    if not names:
        return ""
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    named = f"{', '.join(names[:5])}{more}"
    return f"Scenarios whose content is not the same, or not known, in all rows count as several: {named}."


def told_of_choices(rows: Sequence[Row]) -> str:
    """A sentence that says how many episodes are on scenes that settings were chosen on; empty if none is."""
    count = sum(is_chosen_on(row.scenario) for row in rows)
    if not count:
        return ""
    which = "All" if count == len(rows) else f"{count} of the {len(rows)}"
    return f"{which} episodes are on scenes that settings were chosen on ({CHOSEN_ON}): on others rates may be lower."


def told_of_unknown(rows: Sequence[Row]) -> str:
    """A sentence that says of how many episodes it is not known whether the target was graspable; empty if of none."""
    count = sum(not row.graspable_known for row in rows)
    if not count:
        return ""
    return (
        f"An earlier version ran {count} of the episodes, in which a retrieval counted as *graspable*, too: whether a "
        'grasp was free is not known of them, and no share that they belong to is told ("-").'
    )


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


def reason_of(row: Row) -> str:
    """Why an episode ended without a retrieval, whichever action it was."""
    return _WHICH_ACTION.sub("", row.failure or "unknown")


def failures(rows: Sequence[Row]) -> list[Failures]:
    """Why episodes ended without a retrieval, the most frequent reason first."""
    groups: dict[str, list[Row]] = {}
    for row, label in zip(rows, label_variants(rows), strict=True):
        groups.setdefault(label, []).append(row)
    result = []
    for method in sorted(groups, key=natural):
        group = groups[method]
        reasons = collections.Counter(reason_of(row) for row in group if not row.retrieved)
        result += [Failures(method, reason, n, n / len(group)) for reason, n in reasons.most_common()]
    return result


@dataclasses.dataclass(frozen=True)
class Asked:
    """What a report is to say beside what every report does.

    Attributes:
      rows: columns that rates are told by, instead of the variant and the number of objects.
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
      rates: by the columns that were asked for, by default the variant and the number of objects.
      variants: by variant and number of objects.
      events: likewise.
      reasons: why episodes failed.
      curve_columns, curve: rates over a column; empty if not asked for.
      baseline, differences: paired differences from that variant, its label; None and empty if not asked for.
      films: pictures of single episodes.
    """

    episodes: Sequence[Row]
    key: Key
    rates: Sequence[Rates]
    variants: Sequence[Rates]
    events: Sequence[Events]
    reasons: Sequence[Failures]
    curve_columns: Sequence[str]
    curve: Sequence[Rates]
    baseline: str | None
    differences: Sequence[Difference]
    films: Sequence[Film] = ()

    @classmethod
    def of(cls, rows: Sequence[Row], asked: Asked | None = None) -> Report:
        """The report of at least one row.

        Raises:
          InputError: there is no such column or variant, or nothing to compare the baseline with.
        """
        asked, key = asked or Asked(), Key.of(rows)
        baseline = None if asked.baseline is None else key.named(asked.baseline)
        by_variant = summarise(rows)
        return cls(
            episodes=rows,
            key=key,
            rates=summarise(rows, asked.rows) if asked.rows else by_variant,
            variants=by_variant,
            events=summarise_events(rows),
            reasons=failures(rows),
            curve_columns=[canonical(name) for name in asked.curve],
            curve=curve_rates(rows, asked.curve) if asked.curve else [],
            baseline=baseline,
            differences=[] if baseline is None else paired(rows, baseline, asked.paired),
        )


def _flat(value: Any) -> dict[str, Any]:
    """Rates or events with one value a column."""
    flat: dict[str, Any] = {name: "all" if part is None else part for name, part in value.group.items()}
    for field in dataclasses.fields(value):
        part = getattr(value, field.name)
        if field.name == "group":
            continue
        if field.name.endswith("_interval"):
            goal, (low, high) = field.name.removesuffix("_interval"), part or (None, None)
            flat |= {f"{goal}_low": low, f"{goal}_high": high}
        else:
            flat[field.name] = part
    return flat


def _csv(lines: Sequence[Mapping[str, Any]], names: Sequence[str]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def _names(kind: type, columns: Sequence[str]) -> list[str]:
    """The columns of a table of rates or events."""
    names: list[str] = []
    for field in dataclasses.fields(kind):
        goal = field.name.removesuffix("_interval")
        names += [f"{goal}_low", f"{goal}_high"] if goal != field.name else [field.name]
    return [*columns, *(name for name in names if name != "group")]


def _key_csv(report: Report) -> str:
    """A line for each variant: its labels, and every option."""
    known: dict[str, dict[str, Any]] = {}
    for label, row in zip(label_variants(report.episodes), report.episodes, strict=True):
        if label not in known:
            known[label] = {name: _cell(value) for name, value in options_of(row).items()}
    names = list(dict.fromkeys(name for options in known.values() for name in options))
    lines = [{"label": short, VARIANT: label, **known[label]} for label, short in report.key.short.items()]
    return _csv(lines, ["label", VARIANT, *names])


def _cell(value: Any) -> Hashable:
    return " ".join(map(str, value)) if isinstance(value, list) else value


def _texts(report: Report) -> dict[str, str]:
    """The files that hold figures, by their names."""
    flat, events = [_flat(rates) for rates in report.rates], [_flat(each) for each in report.events]
    reasons = [dataclasses.asdict(each) for each in report.reasons]
    curve = [_flat(each) for each in report.curve]
    differences = [dataclasses.asdict(each) for each in report.differences]
    value = {"rates": flat, "failures": reasons, "events": events, "key": dict(report.key.short)}
    value |= {"curve": curve} if curve else {}
    value |= {"baseline": report.baseline, "paired": differences} if differences else {}
    usual = list(report.variants[0].group)
    files = {
        "rates.csv": _csv(flat, _names(Rates, list(report.rates[0].group))),
        "rates.json": json.dumps(value, indent=1, allow_nan=False) + "\n",
        "failures.csv": _csv(reasons, [field.name for field in dataclasses.fields(Failures)]),
        "events.csv": _csv(events, _names(Events, usual)),
        "key.csv": _key_csv(report),
    }
    if curve:
        files["curve.csv"] = _csv(curve, _names(Rates, list(report.curve[0].group)))
    if differences:
        files["paired.csv"] = _csv(differences, [field.name for field in dataclasses.fields(Difference)])
    return files


def _pictures(report: Report) -> dict[str, Callable[[], Figure]]:
    """What draws the files that are pictures, by their names."""
    draws: dict[str, Callable[[], Figure]] = {
        "success.png": lambda: success_figure(report.episodes, report.baseline),
        "rates.png": lambda: rates_figure(report.variants, report.key),
    }
    if report.curve:
        draws["curve.png"] = lambda: curve_figure(report.curve, report.curve_columns, report.key.short)
    return draws


def write_report(rows: Sequence[Row] | Report, out: PathLike, told: Callable[[str], None] = lambda file: None) -> None:
    """Write a report, the files `FILES` and of `ASKED_FILES` what was asked for, into a folder.

    Args:
      rows: at least one; or what they say.
      out: the folder; files of these names are replaced or removed.
      told: of each file that is begun.

    Raises:
      InputError: the folder cannot be written to.
    """
    from mechsearch_jax.benchmarks.report.report_page import blocks

    check_writable(out)
    folder = Path(out)
    report = rows if isinstance(rows, Report) else Report.of(rows)
    images: dict[str, bytes] = {}
    for name, draw in _pictures(report).items():
        told(name)
        save_figure(draw(), folder / name)
        images[name] = (folder / name).read_bytes()
    for film in report.films:
        if film.drawn:
            images[film.file] = (folder / film.file).read_bytes()
    # The type checker takes what a folder beside the package holds for another module than the installed one.
    page = blocks(cast(Any, report))
    texts = _texts(report)
    texts |= {"report.md": as_markdown(page), "report.tex": as_latex(page)}
    texts["report.html"] = as_html(page, "Results", images)
    for name, text in texts.items():
        told(name)
        with replacing(folder / name) as file:
            file.write(text.encode())
    for name in ASKED_FILES:
        if name not in texts and name not in images:
            (folder / name).unlink(missing_ok=True)
