"""Results on the screen: timings, scores, and the progress of many episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.console import Console, Group
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from mechsearch_jax.benchmarks.calibration import offsets
from mechsearch_jax.benchmarks.parts import push, scenes, segmentation
from mechsearch_jax.benchmarks.parts.agreement import Agreement, Measures
from mechsearch_jax.benchmarks.parts.bench import Timing
from mechsearch_jax.benchmarks.parts.recognition import SHARES, Measured
from mechsearch_jax.benchmarks.reach import reach
from mechsearch_jax.benchmarks.running.evaluate import Tally
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.envs.scenes import scene_sets


def plain_table(title: str | None = None) -> Table:
    """A table without lines, beneath its title."""
    return Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold", title=title, title_justify="left")


def detection_table(figures: Mapping[str, Any]) -> Table:
    """What is detected under every condition, as `detection.detection_figures` returns it, and in all."""
    table = plain_table("detection of the target")
    for name in (
        "target",
        "exposure",
        "noise /255",
        "red too strong",
        "hue gap",
        "missed",
        "false",
        "precision",
        "recall",
    ):
        table.add_column(name, justify="left" if name == "target" else "right")
    for line in figures["conditions"]:
        light = (line["exposure"], line["noise"], line["white_balance"], line["hue_gap"])
        table.add_row(line["target"], *(f"{number:g}" for number in light), *_detected(line))
    table.add_row("all", *[""] * 4, *_detected(figures["all"]), style="bold")
    return table


def _detected(line: Mapping[str, Any]) -> list[str]:
    shares = ("-" if line[name] is None else f"{line[name]:.3f}" for name in ("precision", "recall"))
    return [f"{line['missed']}/{line['in_sight']}", f"{line['false']}/{line['out_of_sight']}", *shares]


def timing_table(timing: Timing) -> Table:
    """One timing, and what it was measured on."""
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(style="cyan", justify="right")
    table.add_column()
    fastest, slowest = timing.spread
    table.add_row("subject", timing.subject)
    table.add_row("objects", str(timing.objects))
    for name, size in timing.shapes.items():
        table.add_row(name.replace("_", " "), str(size))
    table.add_row("compile", f"{timing.compile_seconds:.2f} s")
    table.add_row("median", f"{1e3 * timing.median:.1f} ms")
    table.add_row("spread", f"{1e3 * fastest:.1f} to {1e3 * slowest:.1f} ms in {len(timing.seconds)} calls")
    if timing.rate is not None:
        table.add_row("rate", f"{timing.rate:,.0f} {timing.unit}/s")
        table.add_row("for each", f"{1e3 / timing.rate:,.3g} ms")
    table.add_row("device", timing.versions["device"])
    table.add_row("versions", ", ".join(f"{k} {v}" for k, v in timing.versions.items() if k != "device"))
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


def recognition_tables(measured: Measured) -> Group:
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


def recognition_times_table(measured: Measured) -> Table:
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


def segmentation_tables(measured: segmentation.Measured) -> Group:
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


def calibration_table(measured: offsets.Measured) -> Group:
    """How well the camera's offsets are found: a table for every sensor and use of the pixels."""
    tables, lines = [], []
    for part in measured.summary():
        table = plain_table(f"{part['noise']}, {part['use']}")
        for name in ("", "determined", "median error", "95th percentile", "largest", "stated standard error"):
            table.add_column(name, justify="right", no_wrap=True)
        for name, errors in part["errors"].items():
            count, *figures = errors.values()
            table.add_row(name, str(count), *("-" if figure is None else f"{figure:.3f}" for figure in figures))
        tables.append(table)
        lines.append(
            f"{part['noise']}, {part['use']}: {part['with an offset']} with an offset, of {part['without an offset']} "
            f"without one {part['false warnings']} are warned of; {1e3 * part['median_seconds']:.0f} ms."
        )
    return Group(*tables, Text("\n".join(lines), style="dim"))


def push_scores_tables(measured: push.Measured) -> Group:
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


def scenes_table(rows: Sequence[scenes.Row]) -> Group:
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


def reach_table(rows: Sequence[reach.Row]) -> Group:
    """Where a target alone on the shelf can be grasped: a row for each band across it."""
    table = plain_table("grasps of a target alone on the shelf, from its right wall to its left one")
    for name in ("y [m]", "poses", "graspable", "hand", "reached", "feasible", "approaches"):
        table.add_column(name, justify="right", no_wrap=True)
    for line in reach.bands(rows):
        low, high = line["y"]
        counts = (f"{line[name]:.1f}" for name in ("hand", "reached", "feasible", "approaches"))
        table.add_row(f"{low:.3f} to {high:.3f}", str(line["poses"]), f"{line['graspable']:.2f}", *counts)
    explanation = (
        "graspable: share of the poses with a feasible grasp. The rest are means over poses. hand: grasps at which "
        "gripper and target clear the shelf. reached: of these, those that the arm can follow. feasible: of these, "
        "those at which its links clear the shelf. approaches: different directions among the feasible ones."
    )
    return Group(table, Text(explanation, style="dim"))


def scene_sets_table() -> Table:
    """The named sets of scenes, with a digest of what each holds."""
    table = plain_table()
    table.add_column("set", no_wrap=True)
    table.add_column("scenes", justify="right", no_wrap=True)
    for name in ("objects", "target", "digest"):
        table.add_column(name, no_wrap=True)
    table.add_column("what")
    for scene_set in scene_sets.SETS.values():
        objects = ", ".join(str(block.objects) for block in scene_set.blocks)
        first, digest = scene_set.blocks[0], scene_sets.digest(scene_set)
        table.add_row(scene_set.name, str(scene_set.scenes), objects, first.target, digest, scene_set.about)
    return table


class EpisodeProgress:
    """A progress bar over episodes with the time left and the rates so far; one line per episode where no bar fits."""

    def __init__(self, console: Console, total: int):
        self._console = console
        self._waited = False
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[stage]}"),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("episodes", total=total, stage="")

    def __enter__(self) -> EpisodeProgress:
        self._bar.start()
        return self

    def __exit__(self, *details: object) -> None:
        self._bar.stop()

    def busy(self, stage: str, episodes: int) -> None:
        """Say what a batch is at."""
        self._bar.update(self._task, stage=f"{stage} ({episodes})")

    def compiling(self, text: str) -> None:
        """Say what is being compiled before a batch begins."""
        if not self._console.is_terminal:
            self._console.print(text, soft_wrap=True)
        self._bar.update(self._task, stage=text)

    def again(self, text: str) -> None:
        """Say what failed, and that episodes are run again."""
        self._console.print(text, soft_wrap=True, markup=False)

    def waiting(self, episodes: int) -> None:
        """Say that other processes run what is left."""
        if not self._console.is_terminal and not self._waited:
            self._console.print(f"waiting for {episodes} episodes that other processes run", soft_wrap=True)
        self._waited = True
        self._bar.update(self._task, stage=f"other processes run the rest ({episodes})")

    def ended(self, row: EpisodeRow, tally: Tally) -> None:
        """Take note of one more episode, of this process or another, and of what is known of all that are wanted."""
        counts = {"found": tally.found, "graspable": tally.graspable, "retrieved": tally.retrieved}
        rates = "  ".join(f"{name} {count / tally.ended:.2f}" for name, count in counts.items())
        errors = f"  errors {tally.errors}" if tally.errors else ""
        self._bar.update(self._task, completed=tally.ended, total=tally.wanted, description=rates + errors)
        if not self._console.is_terminal:
            outcome = "retrieved" if row.retrieved else row.failure
            count = f"{tally.ended}/{tally.wanted}"
            self._console.print(
                f"{count} {row.scenario}: {outcome}, {row.steps} actions  ({rates}{errors})", soft_wrap=True
            )
