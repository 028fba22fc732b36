"""What a report says, as blocks of a page."""

from __future__ import annotations

import collections
from collections.abc import Hashable, Sequence

from mechsearch_jax.benchmarks.report.pages import Block, Heading, Paragraph, Picture, Table
from mechsearch_jax.benchmarks.report.report import Report, reason_of, told_of_changes, told_of_choices, told_of_unknown
from mechsearch_jax.benchmarks.statistics.paired import Difference, by_variant
from mechsearch_jax.benchmarks.statistics.rates import EVENTS, GOALS, Events, Rates
from mechsearch_jax.benchmarks.statistics.variants import MOST_IN_FULL, VARIANT, Key

# The shares in `Rates` that a report lists, in its words.
SHARES = {
    "found": "found",
    "graspable": "graspable",
    "paper_graspable": "with the paper's grasps",
    "retrieved": "retrieved",
}


def blocks(report: Report) -> list[Block]:
    """The page of a report."""
    remarks = [told(report.episodes) for told in (told_of_changes, told_of_choices, told_of_unknown)]
    return [
        Heading("Results", 1),
        Paragraph(
            f"{len(report.episodes)} episodes of {len(report.key.short)} variant"
            f"{'' if len(report.key.short) == 1 else 's'}"
            f"{f', all of them {report.key.common}' if report.key.common else ''}. "
            "Shares with Wilson's 95% confidence interval, for as many independent episodes as those of the same "
            "scenes are worth. Actions until then are means over the episodes that got there, with a 95% interval from "
            "drawing scenes again; actions in all are the mean number per episode, attempts to take the target out "
            "among them; times are means per action. An episode that ended in an error of the program "
            "counts as a failure. *Graspable*: found, and a grasp exists that touches nothing. *With the paper's "
            "grasps*: graspable with those alone before the episode ended, of the episodes that say so."
        ),
        *(Paragraph(text) for text in remarks if text),
        *_key(report.key),
        *_rates(report),
        *([Picture("rates.png", "Rates of all variants, the best first")] if len(report.key.short) > 1 else []),
        *_curve(report),
        *_differences(report),
        *_reasons(report),
        Heading("What happened on the way"),
        *_events(report),
        Heading("Success over the number of actions"),
        Picture("success.png", "Success over the number of actions"),
        *_films(report),
    ]


def _key(key: Key) -> list[Block]:
    if not key.numbered:
        return []
    lines = [(short, *key.options[label].values()) for label, short in key.short.items()]
    return [Heading("Key"), Table(("label", *next(iter(key.options.values()))), lines)]


def _many(report: Report) -> bool:
    return len(report.key.short) > MOST_IN_FULL


def said(value: Hashable, key: Key) -> str:
    """A value of a column in a table."""
    if value is None:
        return "all"
    return f"{value:g}" if isinstance(value, float) else key.short.get(str(value), str(value))


def _share(value: float | None, interval: tuple[float, float]) -> str:
    return "-" if value is None else f"{value:.2f} ({interval[0]:.2f} to {interval[1]:.2f})"


def _steps(value: float | None, interval: tuple[float, float] | None) -> str:
    if value is None:
        return "-"
    return f"{value:.1f}" if interval is None else f"{value:.1f} ({interval[0]:.1f} to {interval[1]:.1f})"


def _rates_table(rates: Sequence[Rates], key: Key, spelt: bool = False) -> Table:
    """A line for each group; where `spelt`, with what a variant's options are that differ."""
    columns = list(rates[0].group)
    options = list(next(iter(key.options.values()))) if spelt else []
    header = (
        *options,
        *(column.replace("_", " ") for column in columns),
        *("episodes", "errors", *SHARES.values()),
        *(f"actions until {goal}" for goal in GOALS),
        *("actions in all", "planning [s]", "simulation [s]"),
    )
    lines = [
        (
            *(key.options[str(one.method)][name] for name in options),
            *(said(one.group[column], key) for column in columns),
            *(str(one.episodes), str(one.errors)),
            *(_share(getattr(one, goal), getattr(one, f"{goal}_interval")) for goal in SHARES),
            *(_steps(getattr(one, f"{goal}_steps"), getattr(one, f"{goal}_steps_interval")) for goal in GOALS),
            *(f"{value:.2f}" for value in (one.steps, one.planning_seconds, one.simulation_seconds)),
        )
        for one in rates
    ]
    return Table(header, lines, texts=len(columns) + len(options))


def _rates(report: Report) -> list[Block]:
    table = _rates_table(report.rates, report.key)
    if not (_many(report) and list(report.rates[0].group) == [VARIANT, "objects"]):
        return [Heading("Rates"), table]
    everything = [rates for rates in report.rates if rates.objects is None]
    whole = _rates_table(everything, report.key, spelt=report.key.numbered)
    instead = "By number of objects too: see rates.csv."
    folded = Table(table.header, table.lines, table.texts, True, "by number of objects", instead)
    return [Heading("Rates"), whole, folded]


def _curve(report: Report) -> list[Block]:
    if not report.curve:
        return []
    over = " and ".join(name.replace("_", " ") for name in report.curve_columns)
    return [
        Heading(f"Rates over {over}"),
        Picture("curve.png", f"Rates over {over}"),
        _rates_table(report.curve, report.key),
    ]


def _differences(report: Report) -> list[Block]:
    if not report.differences or report.baseline is None:
        return []
    short = report.key.short

    def cell(one: Difference, scale: float, digits: int) -> str:
        if one.difference is None:
            return "-"
        error = "" if one.standard_error is None else f" ± {scale * one.standard_error:.{digits}f}"
        return f"{scale * one.difference:+.{digits}f}{error}"

    lines = [
        (
            *(short[label], str(goals["found"].pairs)),
            *(cell(goals[goal], 100.0, 1) for goal in GOALS),
            f"{goals['retrieved'].gains}, {goals['retrieved'].losses}",
            *(cell(goals[f"{goal}_steps"], 1.0, 2) for goal in GOALS),
        )
        for label, goals in by_variant(report.differences).items()
    ]
    header = (
        *("variant", "pairs", *(f"{goal} [points]" for goal in GOALS), "more, less often retrieved"),
        *(f"actions until {goal}" for goal in GOALS),
    )
    return [
        Heading(f"Paired differences from {short[report.baseline]}"),
        Paragraph(
            f"Each variant less {report.baseline}, over the pairs of episodes that both have, ± one standard error; a "
            "scene's pairs are averaged first. Shares in percentage points; actions over the pairs in which both got "
            "there."
        ),
        Table(header, lines),
    ]


def _reasons(report: Report) -> list[Block]:
    heading = Heading("Why episodes failed")
    if not report.reasons:
        return [heading, Paragraph("None did.")]
    each = [(report.key.short[f.method], f.reason, str(f.episodes), f"{f.share:.2f}") for f in report.reasons]
    table = Table(("method", "reason", "episodes", "share"), each, texts=2)
    if len(report.key.short) == 1:
        return [heading, table]
    counts = collections.Counter(reason_of(row) for row in report.episodes if not row.retrieved)
    total = len(report.episodes)
    lines = [(reason, str(n), f"{n / total:.2f}") for reason, n in counts.most_common()]
    if not _many(report):
        return [heading, Table(("reason", "episodes", "share"), lines), table]
    instead = "By variant: see failures.csv."
    return [
        heading,
        Table(("reason", "episodes", "share"), lines),
        Table(table.header, table.lines, table.texts, True, "by variant", instead),
    ]


def _events(report: Report) -> list[Block]:
    """What happened on the way."""
    if not report.events:
        return [Paragraph("These episodes do not say: an earlier version ran them, or they ended in errors.")]
    told = Paragraph(
        "Shares of the episodes that say so; *of all looks* is the share of the steps before the target was found at "
        "which f ruled out its true pose."
    )

    def line(events: Events) -> tuple[str, ...]:
        named = (said(value, report.key) for value in events.group.values())
        return (*named, str(events.episodes), *(f"{getattr(events, name):.3f}" for name in EVENTS))

    header = (VARIANT, "objects", "episodes", *EVENTS.values())
    lines = [line(events) for events in report.events]
    if not _many(report):
        return [told, Table(header, lines, texts=2)]
    whole = [line(events) for events in report.events if events.group["objects"] is None]
    instead = "By number of objects too: see events.csv."
    return [told, Table(header, whole, texts=2), Table(header, lines, 2, True, "by number of objects", instead)]


def _films(report: Report) -> list[Block]:
    if not report.films:
        return []
    found: list[Block] = [Heading("Single episodes")]
    for why, films in _by_why(report).items():
        found.append(Heading(why, 3))
        found += films
    return found


def _by_why(report: Report) -> dict[str, list[Block]]:
    groups: dict[str, list[Block]] = {}
    for film in report.films:
        label = report.key.short[film.method]
        shown = Picture(film.file, f"{label}, seed {film.seed}: {film.caption}") if film.drawn else None
        groups.setdefault(film.why, []).append(shown or Paragraph(f"{label}, seed {film.seed}: {film.caption}"))
    return groups
