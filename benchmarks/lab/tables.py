"""What the measurements of the lab say, on the screen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.console import Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from mechsearch_jax.benchmarks.lab.ceiling import solvability
from mechsearch_jax.benchmarks.lab.parts import push, scenes, segmentation
from mechsearch_jax.benchmarks.lab.parts.agreement import Agreement, Measures
from mechsearch_jax.benchmarks.lab.parts.recognition import SHARES, MeasuredRecognition
from mechsearch_jax.benchmarks.report.console_tables import plain_table


def sensors_table(columns: Mapping[str, Mapping[str, float]]) -> Table:
    """What depth images are like: a row for each figure, a column for each sensor and view, or folder."""
    table = plain_table("depth images")
    table.add_column("")
    for name in columns:
        table.add_column(name, justify="right")
    for name in dict.fromkeys(name for column in columns.values() for name in column):
        table.add_row(escape(name), *(f"{column[name]:.2f}" if name in column else "-" for column in columns.values()))
    return table


def agreement_table(agreement: Agreement) -> Table:
    """How well two simulators agree: a column for each kind of action."""
    summary = agreement.summary()
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("", style="cyan", justify="right", no_wrap=True)
    for name in summary:
        table.add_column(name, justify="right", no_wrap=True)

    def add(title: str, text: Callable[[Measures], str]) -> None:
        table.add_row(title, *(text(row) for row in summary.values()))

    def length(name: str, scale: float = 1e3) -> Callable[[Measures], str]:
        return lambda row: f"{scale * row[f'{name}_median']:.2f}, {scale * row[f'{name}_p90']:.2f}"

    add("actions", lambda row: f"{row['actions']:.0f}")
    add("same final poses", lambda row: f"{row['agreeing']:.3f}")
    add("native with itself, nudged", lambda row: f"{row['native_agreeing_with_itself']:.3f}")
    add("same failure", lambda row: f"{row['same_failure']:.3f}")
    add("worlds with overflow", lambda row: f"{row['overflowed']:.0f}")
    add("difference in mm: median, 90%", length("position_difference"))
    add("difference in degrees", length("rotation_difference", 1.0))
    add("native with itself in mm", length("nudged_position_difference"))
    add("native displacement in mm", length("native_moved"))
    add("batch displacement in mm", length("batch_moved"))
    add("same distribution, p", lambda row: f"{row['displacement_p_value']:.2f}")
    seconds = f"native {agreement.native_seconds:.1f} s, batch {agreement.batch_seconds:.1f} s"
    table.caption = f"{seconds}; {agreement.versions['device']}"
    return table


def recognition_tables(measured: MeasuredRecognition) -> Group:
    """How well each method recognises: a table for every source of scenes and noise, with a row for every method."""
    lines = {(line["source"], line["noise"], line["method"], line["visible"]): line for line in measured.summary()}
    tables: dict[tuple[str, str], Table] = {}
    for source, noise, method in dict.fromkeys(key[:3] for key in lines):
        if (source, noise) not in tables:
            tables[source, noise] = _recognition_table(f"{source} scenes, {noise}")
        line, *parts = (lines[source, noise, method, name] for name in ("all", *(name for name, *_ in SHARES)))
        centre, wrong = line["centre_median_mm"], line["wrong_class"]
        gain = f"{line['gain_mean']:+.3f} ±{line['gain_standard_error']:.3f}" if "gain_mean" in line else ""
        tables[source, noise].add_row(
            method,
            str(line["objects"]),
            *(f"{part['iou_mean']:.3f}" if part["objects"] else "-" for part in (line, *parts)),
            "-" if centre is None else f"{centre:.2f}",
            "-" if wrong is None else f"{wrong:.3f}",
            str(line["unanswered"] + line["not_finite"]),
            gain,
        )
    explanation = (
        "IoU: mean, of all and by visible share. mm: median error of the centre. wrong: share of the wrong class. "
        "lost: no answer, or one that is not finite; their IoU is 0. gain: of mean IoU over the method it begins with."
    )
    return Group(*tables.values(), Text(explanation, style="dim"))


def _recognition_table(title: str) -> Table:
    table = plain_table(title)
    table.add_column("method", no_wrap=True, min_width=15)
    for name in ("objects", "IoU", "<30%", "30-60%", "≥60%", "mm", "wrong", "lost", "gain"):
        table.add_column(name, justify="right", no_wrap=True)
    return table


def recognition_times_table(measured: MeasuredRecognition) -> Table:
    """How long each method takes for an object, and on what."""
    table = plain_table()
    table.add_column("method", no_wrap=True)
    for name in ("median of an object", "10% to 90%", "compile"):
        table.add_column(name, justify="right", no_wrap=True)
    for name, time in measured.times.items():
        value = time.value()
        median, low, high = (1e3 * value[f"{key}_seconds"] for key in ("median", "p10", "p90"))
        row = (f"{median:.1f} ms", f"{low:.1f} to {high:.1f} ms", f"{value['compile_seconds']:.1f} s")
        table.add_row(name, *row)
    packages = ", ".join(f"{k} {v}" for k, v in measured.versions.items() if k != "device")
    table.caption = (
        f"all objects of a scene at once, with the method it begins with; {measured.versions['device']}; {packages}"
    )
    return table


def segmentation_tables(measured: segmentation.MeasuredSegments) -> Group:
    """How well objects are told apart: a table for every source of scenes and noise, by number of objects."""
    tables: dict[tuple[str, str], Table] = {}
    for line in measured.summary():
        key = line["source"], line["noise"]
        if key not in tables:
            tables[key] = plain_table(f"{key[0]} scenes, {key[1]}")
            for name in ("objects", "scenes", "counted", "IoU", "missed", "visible", "IoU of all visible"):
                tables[key].add_column(name, justify="right", no_wrap=True)
        mean = line["iou_mean"]
        tables[key].add_row(
            "all" if line["objects"] is None else str(line["objects"]),
            str(line["scenes"]),
            str(line["counted"]),
            "-" if mean is None else f"{mean:.3f}",
            str(line["missed"]),
            str(line["visible"]),
            f"{line['iou_mean_visible']:.3f}",
            style="bold" if line["objects"] is None else None,
        )
    value = measured.value()
    explanation = (
        "IoU: mean over the objects of at least 100 pixels. missed: those below 0.5. visible: with a pixel or more. "
        f"{1e3 * value['median_seconds']:.0f} ms an image, compiled in {value['compile_seconds']:.0f} s; "
        f"{measured.versions['device']}."
    )
    return Group(*tables.values(), Text(explanation, style="dim"))


def push_scores_tables(measured: push.MeasuredPushes) -> Group:
    """How well pushes are predicted: a row for every model, and for the best by distance and by number of objects."""
    everything = {name: groups["all"] for name, groups in measured.scores.items()}
    title = f"{measured.settings['pushes']} pushes in scenes that no training has seen"
    tables = [_push_scores_table(title, "model", everything)]
    groups = measured.scores[measured.best]
    for what, ending in (("distance", " cm"), ("objects", " objects")):
        chosen = {name.removesuffix(" objects"): line for name, line in groups.items() if _is_plain(name, ending)}
        if chosen:
            tables.append(_push_scores_table(f"{measured.best}, by {what}", what, chosen))
    explanation = (
        "failed: how many pushes a simulation could not carry out; they count as predicted to move nothing. "
        "pushed: mean errors of the pushed object's place and, if it is a box, of its turn. other: of the place of "
        "others that moved. still: share of what stays that is predicted to stay within 1 mm. topple AP: average "
        "precision of what falls over or off the board. All else leaves that out: toppled says how many objects, and "
        "how many of them were pushed themselves. distance: within 2.5 cm. "
        f"{measured.versions['device']}."
    )
    return Group(*tables, Text(explanation, style="dim"))


def _is_plain(group: str, ending: str) -> bool:
    """Whether a group is of one kind only, not of distance and objects both."""
    return group.endswith(ending) and "," not in group


def _push_scores_table(title: str, first: str, lines: Mapping[str, Mapping[str, Any]]) -> Table:
    table = plain_table(title)
    table.add_column(first, no_wrap=True, min_width=12)
    for name in ("pushes", "failed", "toppled", "pushed mm", "pushed deg", "other mm", "still", "topple AP"):
        table.add_column(name, justify="right", no_wrap=True)
    digits = {"pushed_mm": 2, "pushed_deg": 2, "other_mm": 2, "still": 3, "topple_ap": 3}
    for name, line in lines.items():
        cells = ("-" if line[key] is None else f"{line[key]:.{n}f}" for key, n in digits.items())
        toppled = f"{line['toppled']} ({line['pushed_toppled']})"
        table.add_row(name, str(line["pushes"]), str(line["failed"]), toppled, *cells)
    return table


def scenes_table(rows: Sequence[scenes.SceneRow]) -> Group:
    """What scenes are like: a row for each source and number of objects."""
    table = plain_table("scenes at their start")
    table.add_column("source", no_wrap=True)
    for name in ("objects", "scenes", "f", "lost", "hidden", "≤100", ">100", "seen", "visible", "of each"):
        table.add_column(name, justify="right", no_wrap=True)
    counts = ("truth_ruled_out", "target_hidden", "target_below_threshold", "target_found")
    for line in scenes.summary(rows):
        error = line["possible_standard_error"]
        table.add_row(
            line["source"],
            str(line["objects"]),
            str(line["scenes"]),
            f"{line['possible_mean']:.0f}" + ("" if error is None else f" ±{error:.0f}"),
            *(str(line[name]) for name in counts),
            f"{line['target_share_mean']:.3f}",
            f"{line['visible_mean']:.2f}",
            f"{line['objects_share_mean']:.2f}",
        )
    explanation = (
        "f: mean number of poses where the target can be, with its standard error. lost: scenes where f rules out the "
        "pose that is nearest to the target's. hidden, ≤100, >100: scenes by the target's pixels. seen: share of the "
        "target's pixels. visible: objects that show at least 100 pixels. of each: share of an object's that is seen."
    )
    beside_exact = [
        f"{line['source']}, {line['objects']} objects: f is {line['possible_over_exact_cells']:.2f} times what brute "
        f"force finds, and lacks {100 * line['exact_missed_share']:.1f}% of that"
        for line in scenes.summary(rows)
        if "exact_scenes" in line
    ]
    return Group(table, Text(explanation, style="dim"), *map(Text, beside_exact))


def ceiling_table(rows: Sequence[solvability.CeilingRow]) -> Group:
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
