"""Writes docs/results.md: `python -m mechsearch_jax.benchmarks.lab.site.results_page` in a checkout.

The page is the template `results_page.md` beside this file. A field of the template is a value of a stored result,
`{simulate-h200[steps_per_second]}` of `benchmarks/results/simulate-h200.json`, or one that is computed here.
"""

from __future__ import annotations

import collections
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mechsearch_jax.benchmarks.lab.site.rewriting import rewrite
from mechsearch_jax.benchmarks.lab.site.store_run import OUTCOMES
from mechsearch_jax.benchmarks.statistics.intervals import share_interval
from mechsearch_jax.benchmarks.statistics.paired import change_of, same_episodes
from mechsearch_jax.benchmarks.statistics.preset_names import Settings, settings_of
from mechsearch_jax.benchmarks.store.rows import EpisodeRow, options_of
from mechsearch_jax.benchmarks.store.runs import StoredRun, load_run
from mechsearch_jax.runtime.files import PathLike

Episode = Mapping[str, Any]
COUNTS = (2, 4, 6, 8)
TEMPLATE = Path(__file__).with_name("results_page.md")
# Runs of the default: true shapes and images, other worlds, household things, and what the other worlds are compared
# with. Fields of the page have their names.
RUNS = ("report-h200", "report-i-worlds-h200", "report-household-bases-h200", "report-i-h200")
# What of a simulated world differs from what the planner assumes, by its name on the page.
WORLDS: Mapping[str, Mapping[str, float]] = {
    "friction and mass of each body half to twice": {"mismatch.friction_spread": 2.0, "mismatch.mass_spread": 2.0},
    "shapes up to 5% off": {"mismatch.size_spread": 1.05},
}
RATES = ("objects", "episodes", "found", "graspable", "with the paper's grasps", "retrieved", "actions")


class Stored(dict[str, Any]):
    """The stored results of a folder by the names of their files without `.json`, read when they are asked for.

    A timing also has `ms`: the median, the fastest and the slowest of its calls [ms].
    """

    def __init__(self, folder: PathLike) -> None:
        super().__init__()
        self.folder = Path(folder)

    def __missing__(self, name: str) -> Any:
        self[name] = json.loads((self.folder / f"{name}.json").read_bytes(), object_hook=_with_milliseconds)
        return self[name]


def _with_milliseconds(value: dict[str, Any]) -> dict[str, Any]:
    if "median_seconds" not in value or "seconds" not in value:
        return value
    seconds = {"median": value["median_seconds"], "fastest": min(value["seconds"]), "slowest": max(value["seconds"])}
    return value | {"ms": {name: 1000 * each for name, each in seconds.items()}}


def table(header: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    rows = ["| " + " | ".join(map(str, cells)) + " |" for cells in (header, *lines)]
    return "\n".join([rows[0], "|" + "---|" * len(header), *rows[1:]])


def with_objects(episodes: Iterable[Episode], count: int) -> list[Episode]:
    """The episodes whose scenes, `SET-OBJECTS-NUMBER`, have a number of objects."""
    return [episode for episode in episodes if episode["scenario"].split("-")[-2] == str(count)]


def reached(episodes: Sequence[Episode], key: str) -> list[bool]:
    """For each episode whether it got there; `key` is a step, None where never, or a flag."""
    return [episode[key] is not None and episode[key] is not False for episode in episodes]


def share(reached: Sequence[bool], digits: int = 2) -> str:
    """The share of what is true."""
    return f"{sum(reached) / len(reached):.{digits}f}"


def with_interval(episodes: Sequence[Episode], key: str) -> str:
    """A share of episodes with its 95% interval."""
    flags = reached(episodes, key)
    low, high = share_interval(flags, [episode["scenario"] for episode in episodes])
    return f"{share(flags)} ({low:.2f} to {high:.2f})"


def rate_cells(episodes: Sequence[Episode]) -> list[str]:
    """The cells under `RATES` without the number of objects."""
    return [
        str(len(episodes)),
        with_interval(episodes, "found_step"),
        with_interval(episodes, "graspable_step"),
        share(reached(episodes, "paper_graspable_step")),
        with_interval(episodes, "retrieved"),
        f"{sum(episode['steps'] for episode in episodes) / len(episodes):.1f}",
    ]


def rates(column: str, groups: Mapping[str, Sequence[Episode]]) -> str:
    """A table of rates by number of objects of groups of episodes, which `column` is the header of."""
    lines = [
        [label, count, *rate_cells(of_count)]
        for label, episodes in groups.items()
        for count in COUNTS
        if (of_count := with_objects(episodes, count))
    ]
    return table([column, *RATES], lines)


def mishaps(groups: Mapping[str, Sequence[Episode]]) -> str:
    """A table of what went wrong on the way in groups of episodes, and why episodes were lost."""
    lines = []
    for label, episodes in groups.items():
        lost = collections.Counter(each["failure"].split(" at action")[0] for each in episodes if each["failure"])
        reasons = "; ".join(f"{reason} {count}" for reason, count in lost.most_common())
        shares = [share([each[key] > 0 for each in episodes], 3) for key in ("objects_fallen", "held_up", "truth_lost")]
        lines.append([label, len(episodes), *shares, reasons])
    header = ["scenes", "episodes", "an object left the board", "the arm was held up", "f ruled out the true pose"]
    return table([*header, "lost: episodes by reason"], lines)


def pushes(stored: Stored) -> str:
    """The table of push models."""
    places = [("push-h200", name) for name in ("no motion", "quasi-static", "learned")]
    places += [("push-cpu", name) for name in ("learned", "physics", "nudged")]
    lines = []
    for file, name in places:
        line = stored[file]["models"][name]["all"]
        errors = f"{line['pushed_mm']:.1f} mm, {line['pushed_deg']:.1f}°", f"{line['other_mm']:.1f} mm"
        lines.append([name, f"{line['pushes']:,}", *errors, f"{line['still']:.3f}", f"{line['topple_ap']:.2f}"])
    header = ["model", "pushes", "pushed object", "others that moved", "stays, and is predicted to"]
    return table([*header, "falls over, average precision"], lines)


def perception(stored: Stored) -> str:
    """The table of recognition and segmentation, by scenes and noise."""
    lines = []
    for source, scenes in (("held-out", "held-out"), ("files", "published")):
        for noise, label in (("clean", "none"), ("gaussian", "1 mm"), ("time-of-flight", "time-of-flight")):
            shapes, segments = (
                [each for each in stored[file]["summary"] if (each["source"], each["noise"]) == (source, noise)]
                for file in ("recognition-cpu", "segmentation-cpu")
            )
            volumes = {each["method"]: each["iou_mean"] for each in shapes if each["visible"] == "all"}
            pixels = {each["objects"]: each["iou_mean"] for each in segments}
            cells = [volumes[name] for name in ("network", "network-refined", "ems-refined")]
            lines.append([scenes, label, *(f"{cell:.3f}" for cell in (*cells, pixels[None], pixels[8]))])
    header = ["scenes", "noise", "network", "network, refined", "EMS, refined"]
    return table([*header, "segments, 2 to 8 objects", "segments, 8 objects"], lines)


# What `tests/own_cell` counts, by its name on the page.
OWN_CELL: Mapping[str, str] = {
    "target dropped": "searches in which the held target was dropped",
    "motions without gain": "motions without expected gain",
    "refused by a controller": "files that a controller would refuse",
    "stopped by it": "motions stopped by the controller",
    "unannounced contacts": "motions with an unannounced contact above 5 N",
}


def own_cell(stored: Stored) -> str:
    """The table of searches in a cell that is not ours."""
    lines = []
    for searches in stored["own-cell-cpu"]["searches"].values():
        counts, (first, last) = searches["counts"], searches["layouts"]
        won = [row[2] for row in searches["rows"]]
        low, high = share_interval(won, [str(row[0]) for row in searches["rows"]])
        lines.append(
            [
                f"{searches['target']}, {searches['arm']}",
                f"{first} to {last}",
                f"{sum(won)} of {len(won)} ({low:.2f} to {high:.2f})",
                counts["motions without expected gain"]["of"],
                *(counts[name]["count"] for name in OWN_CELL.values()),
            ]
        )
    return table(["target, arm", "layouts", "retrieved", "motions", *OWN_CELL], lines)


# Figures of `bench real` on the page.
REAL = ("matched", "matched well", "split", "phantoms", "90th percentile, mm", "rays through, %", "stand raised")


def real_images(stored: Stored) -> str:
    """The table of what `bench real` measures on tables and a shelf."""

    def cell(figures: Mapping[str, Any], name: str) -> str:
        entry = figures.get(name, {})
        if entry.get("value") is None:
            return "–"
        low, high = entry["interval"]
        return f"{entry['value']:.2f} ({low:.2f} to {high:.2f})"

    lines = [
        [place, images, *(cell(groups["all"], name) for name in REAL)]
        for file, place in (("real-tables-cpu", "tables"), ("real-shelf-cpu", "a shelf"))
        for images, groups in stored[file]["figures"].items()
    ]
    return table(["images", "seen from", *REAL], lines)


def real_kinds(stored: Stored) -> str:
    """How many things of each kind of table are matched, from depth and colour."""
    groups = stored["real-tables-cpu"]["figures"]["depth and colour"]
    kinds = {kind: figures["matched"]["value"] for kind, figures in groups.items() if kind != "all"}
    return ", ".join(f"{kind} {value:.2f}" for kind, value in kinds.items())


def _with_settings(run: StoredRun, **differing: Any) -> list[EpisodeRow]:
    """The rows of the default with such settings."""
    wanted = Settings("standard", differing)
    return [row for row in run.rows if settings_of(options_of(row)) == wanted]


def _episodes(rows: Sequence[EpisodeRow]) -> list[Episode]:
    return [vars(row) for row in rows]


def _change(after: Sequence[EpisodeRow], before: Sequence[EpisodeRow]) -> dict[str, Any]:
    """How many points more are retrieved than in the same episodes of other rows, in words: `pairs`, `all` with its 95%
    interval, and `each` by number of objects."""
    pairs = same_episodes(after, before)
    change = change_of(pairs, OUTCOMES["retrieved"])
    assert change.mean is not None
    assert change.interval is not None
    low, high = (100 * bound for bound in change.interval)
    means = [change_of(same_episodes(after, before, count), OUTCOMES["retrieved"]).mean or 0.0 for count in COUNTS]
    return {
        "pairs": change.pairs,
        "all": f"{100 * change.mean:+.1f} ({low:+.1f} to {high:+.1f})",
        "each": ", ".join(f"{100 * mean:+.1f}" for mean in means),
    }


def default_rates(today: StoredRun, worlds: StoredRun, household: StoredRun, assumed: StoredRun) -> dict[str, Any]:
    """The fields of the template about what the default reaches."""
    true, full = _with_settings(today), _with_settings(today, recognition="full")
    other = {name: _with_settings(worlds, **differing) for name, differing in WORLDS.items()}
    things = {
        "true shapes": _with_settings(household),
        "`full-parts`": _with_settings(household, recognition="full-parts"),
    }
    changes = {name: _change(rows, _with_settings(assumed)) for name, rows in other.items()}
    return {
        "default_rates": rates("seen", {"true shapes": _episodes(true), "`full`": _episodes(full)}),
        "mishaps": mishaps(
            {
                "`report`, true shapes": _episodes(true),
                "`report`, `full`": _episodes(full),
                "`report-i`, friction and mass not as assumed": _episodes(next(iter(other.values()))),
                "`report-household`, `full-parts`": _episodes(things["`full-parts`"]),
            }
        ),
        "household_rates": rates("seen", {name: _episodes(rows) for name, rows in things.items()}),
        "loss": _change(full, true),
        "worlds": table(
            ["world", "pairs", "change of retrieved, points", "with 2, 4, 6, 8 objects"],
            [[name, change["pairs"], change["all"], change["each"]] for name, change in changes.items()],
        ),
    }


def computed(stored: Stored) -> dict[str, Any]:
    """The fields of the template that are no values of a file."""
    runs = [load_run(stored.folder / "runs", name) for name in RUNS]
    planned = stored["plan-batch-h200"]
    starts = stored["scenes-start-cpu"]["summary"]
    return {
        **{name.rpartition("-")[0].replace("-", "_"): run.lines[0] for name, run in zip(RUNS, runs, strict=True)},
        **default_rates(*runs),
        "pushes": pushes(stored),
        "perception": perception(stored),
        "real": real_images(stored),
        "real_kinds": real_kinds(stored),
        "at_once": planned["shapes"]["batch"] / planned["median_seconds"],
        "own_cell": own_cell(stored),
        "starts": sum(each["scenes"] for each in starts),
        "starts_ruled_out": sum(each["truth_ruled_out"] for each in starts),
        "in_sight": sum(
            each["target_found"] for each in stored["scenes-cpu"]["summary"] if each["source"] == "published"
        ),
    }


def page(folder: PathLike) -> str:
    """The page in Markdown, from the folder of stored results."""
    stored = Stored(folder)
    stored.update(computed(stored))
    return TEMPLATE.read_text(encoding="utf-8").format_map(stored)


def main(arguments: Sequence[str] | None = None) -> None:
    """Rewrite the page."""
    rewrite(page, "results", "benchmarks/results", "docs/results.md", arguments)


if __name__ == "__main__":
    main()
