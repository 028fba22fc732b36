"""The files of a report: tables as CSV and JSON, pictures, and the page that holds them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas
from matplotlib.figure import Figure

from mechsearch_jax.benchmarks.pages.pages import as_html, as_latex, as_markdown
from mechsearch_jax.benchmarks.report.report import Failures, Report
from mechsearch_jax.benchmarks.report.report_figures import curve_figure, rates_figure, success_figure
from mechsearch_jax.benchmarks.report.report_page import blocks
from mechsearch_jax.benchmarks.report.scene_map import scene_records
from mechsearch_jax.benchmarks.statistics.actions_until import RestrictedMeans
from mechsearch_jax.benchmarks.statistics.rates import Events, Rates
from mechsearch_jax.benchmarks.statistics.variants import VARIANT, label_variants
from mechsearch_jax.benchmarks.store.rows import EpisodeRow, options_of
from mechsearch_jax.runtime.files import PathLike, check_writable, replacing
from mechsearch_jax.viz.drawing import save_figure

# What every report consists of, and what one has with more options; the folder `films.FOLDER` holds pictures.
FILES = (
    *("report.md", "report.tex", "report.html", "rates.csv", "rates.json", "actions.csv", "failures.csv", "events.csv"),
    *("key.csv", "scenes.csv", "success.png", "rates.png"),
)
OPTIONAL_FILES = ("curve.csv", "curve.png", "paired.csv")
DIFFERENCE_COLUMNS = ("method", "goal", "pairs", "scenes", "difference", "standard_error", "gains", "losses")


def _record(group: Rates | RestrictedMeans | Events) -> dict[str, Any]:
    """Rates, means or events with one value a column."""
    record: dict[str, Any] = {name: "all" if value is None else value for name, value in group.group.items()}
    for field in dataclasses.fields(group):
        value = getattr(group, field.name)
        if field.name.endswith("_interval"):
            goal, (low, high) = field.name.removesuffix("_interval"), value or (None, None)
            record |= {f"{goal}_low": low, f"{goal}_high": high}
        elif field.name != "group":
            record[field.name] = value
    return record


def _columns(kind: type, group: Sequence[str]) -> list[str]:
    """The columns of a table of rates, means or events."""
    names: list[str] = []
    for field in dataclasses.fields(kind):
        goal = field.name.removesuffix("_interval")
        names += [f"{goal}_low", f"{goal}_high"] if goal != field.name else [field.name]
    return [*group, *(name for name in names if name != "group")]


def _difference_records(report: Report) -> list[dict[str, Any]]:
    lines = [
        (label, goal, each.pairs, each.scenes, each.mean, each.standard_error, each.gains, each.losses)
        for label, goals in report.differences.items()
        for goal, each in goals.items()
    ]
    return [dict(zip(DIFFERENCE_COLUMNS, line, strict=True)) for line in lines]


def _key_records(report: Report) -> list[dict[str, Any]]:
    """For each variant its labels, and every option."""
    options: dict[str, dict[str, Any]] = {}
    for label, row in zip(label_variants(report.episodes), report.episodes, strict=True):
        if label not in options:
            options[label] = {
                name: " ".join(map(str, value)) if isinstance(value, list) else value
                for name, value in options_of(row).items()
            }
    return [{"label": short, VARIANT: label, **options[label]} for label, short in report.key.short.items()]


def _csv(records: Sequence[Mapping[str, Any]], columns: list[str] | None = None) -> str:
    """Records as CSV, whole numbers as such and floats with all their digits."""
    frame = pandas.DataFrame(records, columns=columns, dtype=object)
    return frame.to_csv(index=False, lineterminator="\n")


def _tables(report: Report) -> dict[str, str]:
    """The files that hold figures, by their names."""
    rates, events, curve = ([_record(each) for each in part] for part in (report.rates, report.events, report.curve))
    restricted = list(map(_record, report.restricted))
    reasons = [dataclasses.asdict(each) for each in report.reasons]
    differences = _difference_records(report)
    value = {
        "rates": rates,
        "actions": restricted,
        "failures": reasons,
        "events": events,
        "key": dict(report.key.short),
    }
    value |= {"curve": curve} if curve else {}
    value |= {"baseline": report.baseline, "paired": differences} if differences else {}
    files = {
        "rates.csv": _csv(rates, _columns(Rates, list(report.rates[0].group))),
        "rates.json": json.dumps(value, indent=1, allow_nan=False) + "\n",
        "actions.csv": _csv(restricted, _columns(RestrictedMeans, list(report.restricted[0].group))),
        "failures.csv": _csv(reasons, [field.name for field in dataclasses.fields(Failures)]),
        "events.csv": _csv(events, _columns(Events, list(report.variants[0].group))),
        "key.csv": _csv(_key_records(report)),
        "scenes.csv": _csv(scene_records(report.episodes, report.key)),
    }
    if curve:
        files["curve.csv"] = _csv(curve, _columns(Rates, list(report.curve[0].group)))
    if differences:
        files["paired.csv"] = _csv(differences, list(DIFFERENCE_COLUMNS))
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


def write_report(
    rows: Sequence[EpisodeRow] | Report, out: PathLike, progress: Callable[[str], None] = lambda file: None
) -> None:
    """Write a report, the files `FILES` and those of `OPTIONAL_FILES` that it has, into a folder.

    Args:
      rows: at least one; or what they say.
      out: the folder; files of these names are replaced or removed.
      progress: called with the name of each file that is begun.

    Raises:
      InputError: the folder cannot be written to.
    """
    check_writable(out)
    folder = Path(out)
    report = rows if isinstance(rows, Report) else Report.of(rows)
    images: dict[str, bytes] = {}
    for name, draw in _pictures(report).items():
        progress(name)
        save_figure(draw(), folder / name)
        images[name] = (folder / name).read_bytes()
    images |= {film.file: (folder / film.file).read_bytes() for film in report.films if film.drawn}
    page = blocks(report)
    texts = _tables(report)
    texts |= {"report.md": as_markdown(page), "report.tex": as_latex(page)}
    texts["report.html"] = as_html(page, "Results", images)
    for name, text in texts.items():
        progress(name)
        with replacing(folder / name) as file:
            file.write(text.encode())
    for name in OPTIONAL_FILES:
        if name not in texts and name not in images:
            (folder / name).unlink(missing_ok=True)
