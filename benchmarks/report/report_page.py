"""What a report says, as blocks of a page."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Sequence

from mechsearch_jax.benchmarks.pages.pages import Block, Heading, Link, Paragraph, Picture, Table
from mechsearch_jax.benchmarks.report.report import (
    Report,
    changed_scenarios_remark,
    chosen_scenes_remark,
    failure_reason,
)
from mechsearch_jax.benchmarks.report.scene_map import scene_map
from mechsearch_jax.benchmarks.statistics.actions_until import RestrictedMeans, horizon_of
from mechsearch_jax.benchmarks.statistics.intervals import Interval
from mechsearch_jax.benchmarks.statistics.paired import RESTRICTED, STEPS, PairedDifference
from mechsearch_jax.benchmarks.statistics.rates import EVENTS, GOALS, Events, Rates
from mechsearch_jax.benchmarks.statistics.variants import MOST_IN_FULL, VARIANT, Key

# The shares in `Rates` that a report lists, in its words.
SHARES = {
    "found": "found",
    "graspable": "graspable",
    "paper_graspable": "with the paper's grasps",
    "retrieved": "retrieved",
}


# Reasons of failure that have a column of their own, and the heading of the column of all others.
MOST_REASONS = 6
OTHER = "another reason"


def blocks(report: Report) -> list[Block]:
    """The page of a report."""
    remarks = [remark(report.episodes) for remark in (changed_scenarios_remark, chosen_scenes_remark)]
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
            "counts as a failure, and not in means of actions. *Graspable*: found, and a grasp exists that touches "
            "nothing. *With the paper's grasps*: graspable with those alone before the episode ended, of the episodes "
            "that say so."
        ),
        *(Paragraph(text) for text in remarks if text),
        *_key(report.key),
        *_rates(report),
        *([Picture("rates.png", "Rates of all variants, the best first")] if len(report.key.short) > 1 else []),
        *_curve(report),
        *_differences(report),
        *_reasons(report),
        *scene_map(report.episodes, report.key, report.drawn),
        Heading("What happened on the way"),
        *_events(report),
        *_actions(report),
        *_films(report),
    ]


def _key(key: Key) -> list[Block]:
    if not key.numbered:
        return []
    named = [(short, *key.presets[label]) for label, short in key.short.items() if label in key.presets]
    others = [(short, *key.options[label].values()) for label, short in key.short.items() if label not in key.presets]
    parts: list[Block] = [Heading("Key")]
    if named:
        parts.append(Table.of(("variant", "preset", "what differs from it"), named, texts=3))
    if others:
        header = ("label", *next(iter(key.options.values())))
        parts.append(Table.of(header, others, texts=len(header)))
    return parts


def _many(report: Report) -> bool:
    return len(report.key.short) > MOST_IN_FULL


def _cell(value: float | None, interval: Interval | None, digits: int) -> str:
    if value is None:
        return "-"
    bounds = "" if interval is None else f" ({interval[0]:.{digits}f} to {interval[1]:.{digits}f})"
    return f"{value:.{digits}f}{bounds}"


def _rates_table(rates: Sequence[Rates], key: Key, options: Sequence[str] = ()) -> Table:
    """A line for each group, which begins with what these options of its variant are."""
    columns = list(rates[0].group)
    header = (
        *options,
        *(column.replace("_", " ") for column in columns),
        *("episodes", "errors", *SHARES.values()),
        *(f"actions until {goal}" for goal in GOALS),
        *("actions in all", "planning [s]", "simulation [s]"),
    )
    lines = [
        (
            *(key.options[str(group.method)][name] for name in options),
            *(key.text(group.group[column]) for column in columns),
            *(group.episodes, group.errors),
            *(_cell(getattr(group, goal), getattr(group, f"{goal}_interval"), 2) for goal in SHARES),
            *(_cell(getattr(group, f"{goal}_steps"), getattr(group, f"{goal}_steps_interval"), 1) for goal in GOALS),
            "-" if group.steps is None else f"{group.steps:.2f}",
            *(f"{value:.2f}" for value in (group.planning_seconds, group.simulation_seconds)),
        )
        for group in rates
    ]
    return Table.of(header, lines, texts=len(options) + len(columns))


def _rates(report: Report) -> list[Block]:
    table = _rates_table(report.rates, report.key)
    if not (_many(report) and list(report.rates[0].group) == [VARIANT, "objects"]):
        return [Heading("Rates"), table]
    options = list(next(iter(report.key.options.values()))) if report.key.numbered else []
    whole = _rates_table([rates for rates in report.rates if rates.objects is None], report.key, options)
    instead = "By number of objects too: see rates.csv."
    return [Heading("Rates"), whole, dataclasses.replace(table, folded="by number of objects", instead=instead)]


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

    def cell(change: PairedDifference, scale: float, digits: int) -> str:
        if change.mean is None:
            return "-"
        error = "" if change.standard_error is None else f" ± {scale * change.standard_error:.{digits}f}"
        return f"{scale * change.mean:+.{digits}f}{error}"

    lines = [
        (
            *(short[label], goals["found"].pairs),
            *(cell(goals[goal], 100.0, 1) for goal in GOALS),
            f"{goals['retrieved'].gains}, {goals['retrieved'].losses}",
            *(cell(goals[f"{goal}{ending}"], 1.0, 2) for ending in (STEPS, RESTRICTED) for goal in GOALS),
        )
        for label, goals in report.differences.items()
    ]
    header = (
        *("variant", "pairs", *(f"{goal} [points]" for goal in GOALS), "more, less often retrieved"),
        *(f"actions until {goal}" for goal in GOALS),
        *(f"until {goal}, never counted" for goal in GOALS),
    )
    return [
        Heading(f"Paired differences from {short[report.baseline]}"),
        Paragraph(
            f"Each variant less {report.baseline}, over the pairs of episodes that both have, ± one standard error; a "
            "scene's pairs are averaged first. Shares in percentage points; actions over the pairs in which both got "
            "there, and then over all pairs, where never counts as below (restricted means)."
        ),
        Table.of(header, lines),
    ]


def _reasons(report: Report) -> list[Block]:
    heading = Heading("Why episodes failed")
    if not report.reasons:
        return [heading, Paragraph("None did.")]
    lines = [(report.key.short[f.method], f.reason, f.episodes, f"{f.share:.2f}") for f in report.reasons]
    if len(report.key.short) == 1:
        return [heading, Table.of(("method", "reason", "episodes", "share"), lines, texts=2)]
    counts = collections.Counter(failure_reason(row) for row in report.episodes if not row.retrieved)
    shares = [(reason, n, f"{n / len(report.episodes):.2f}") for reason, n in counts.most_common()]
    explanation = Paragraph(
        "Of each variant the share of its episodes that ended for a reason, the most frequent ones."
    )
    return [
        heading,
        Table.of(("reason", "episodes", "share"), shares),
        explanation,
        _failures_by_variant(report, counts),
    ]


def _failures_by_variant(report: Report, counts: collections.Counter[str]) -> Table:
    """A line for each variant, a column for each of the most frequent reasons, and one for all others."""
    reasons = [reason for reason, _ in counts.most_common(MOST_REASONS)]
    shares: dict[str, dict[str, float]] = {label: {} for label in report.key.short}
    for failure in report.reasons:
        column = failure.reason if failure.reason in reasons else OTHER
        shares[failure.method][column] = shares[failure.method].get(column, 0.0) + failure.share
    columns = [*reasons, *([OTHER] if len(counts) > len(reasons) else [])]
    lines = [
        (short, f"{sum(shares[label].values()):.2f}", *(f"{shares[label].get(column, 0.0):.2f}" for column in columns))
        for label, short in report.key.short.items()
    ]
    return Table.of(("variant", "lost", *columns), lines)


def _events(report: Report) -> list[Block]:
    """What happened on the way."""
    if not report.events:
        return [Paragraph("These episodes do not say: they ended in errors.")]
    explanation = Paragraph(
        "Shares of the episodes that say so; *of all looks* is the share of the steps before the target was found at "
        "which f ruled out its true pose; *around it, too* is the share of the episodes in which it also ruled out the "
        "cells of the grid around it."
    )

    def table(events: Sequence[Events]) -> Table:
        lines = [
            (
                *map(report.key.text, group.group.values()),
                group.episodes,
                *group.texts(),
            )
            for group in events
        ]
        return Table.of((VARIANT, "objects", "episodes", *EVENTS.values()), lines, texts=2)

    everything = table(report.events)
    if not _many(report):
        return [explanation, everything]
    instead = "By number of objects too: see events.csv."
    return [
        explanation,
        table([events for events in report.events if events.objects is None]),
        dataclasses.replace(everything, folded="by number of objects", instead=instead),
    ]


def _actions(report: Report) -> list[Block]:
    """Success over the number of actions, and the restricted means that are the areas above its curves."""
    budget, retrieval = (horizon_of(goal, report.restricted[0].budget) for goal in ("found", "retrieved"))

    def table(means: Sequence[RestrictedMeans]) -> Table:
        columns = [column.replace("_", " ") for column in means[0].group]
        lines = [
            (
                *map(report.key.text, group.group.values()),
                group.episodes,
                *(_cell(getattr(group, goal), getattr(group, f"{goal}_interval"), 2) for goal in GOALS),
            )
            for group in means
        ]
        return Table.of((*columns, "episodes", *(f"until {goal}" for goal in GOALS)), lines, texts=len(columns))

    everything = [table(report.restricted)]
    if _many(report) and list(report.restricted[0].group) == [VARIANT, "objects"]:
        whole = table([group for group in report.restricted if group.objects is None])
        folded = dataclasses.replace(
            everything[0], folded="by number of objects", instead="By number of objects too: see actions.csv."
        )
        everything = [whole, folded]
    return [
        Heading("Success over the number of actions"),
        Picture("success.png", "Success over the number of actions"),
        Paragraph(
            f"Restricted mean numbers of actions until then, over all episodes: one that never gets there counts as "
            f"{budget}, and until *retrieved*, where the retrieval is an action too, as {retrieval}, whether it failed "
            "before or its actions were used up. They are the areas above the curves, with a 95% interval from drawing "
            "scenes again. An episode whose target is retrieved by a grasp that touches something, without having been "
            "*graspable*, is never graspable."
        ),
        *everything,
    ]


def _films(report: Report) -> list[Block]:
    if not report.films:
        return []
    groups: dict[str, list[Block]] = {}
    for film in report.films:
        caption = f"{report.key.short[film.method]}, seed {film.seed}: {film.caption}"
        block = Picture(film.file, caption) if film.drawn else Paragraph(caption)
        groups.setdefault(film.why, []).append(block)
        if film.has_page:
            groups[film.why].append(Link(f"Every step of {film.row.scenario}", film.page))
    parts = [[Heading(why, 3), *films] for why, films in groups.items()]
    return [Heading("Single episodes"), *(block for part in parts for block in part)]
