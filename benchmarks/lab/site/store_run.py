"""Stores a run: `python -m mechsearch_jax.benchmarks.lab.site.store_run FOLDER ... --name NAME --command "..."`.

Of results folders it makes `NAME.parquet`, with all rows, and `NAME.jsonl`, with a line for each variant, scene set and
number of objects: what ran, where, on which scenes, and the rates with their 95% intervals.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from mechsearch_jax.benchmarks.paper.paper_tables import TABLES
from mechsearch_jax.benchmarks.statistics.intervals import share_interval
from mechsearch_jax.benchmarks.statistics.preset_names import settings_of
from mechsearch_jax.benchmarks.statistics.rates import mean_actions, scene_of
from mechsearch_jax.benchmarks.store.rows import EpisodeRow, options_of
from mechsearch_jax.benchmarks.store.runs import RUNS, StoredRun, merged, started, variant_of, write_run
from mechsearch_jax.envs.scenes.scene_sets import SETS, find_scene, is_chosen_on
from mechsearch_jax.runtime.errors import InputError

# What an episode reaches, by what stored runs call it; None where a row does not say. An error reaches nothing.
OUTCOMES: Mapping[str, Callable[[EpisodeRow], bool | None]] = {
    "found": lambda row: row.found_step is not None,
    "graspable": lambda row: row.graspable_step is not None,
    "paper_graspable": lambda row: row.paper_graspable,
    "retrieved": lambda row: row.retrieved,
    "drop_free": lambda row: None if row.objects_fallen is None and not row.is_error else row.objects_fallen == 0,
}


def rates_of(rows: Sequence[EpisodeRow]) -> dict[str, Any]:
    """For each of `OUTCOMES` its share and 95% interval, by scene, or None; and `mean_actions`."""
    rates: dict[str, Any] = {}
    for name, outcome in OUTCOMES.items():
        ends = [(reached, scene_of(row)) for row in rows if (reached := outcome(row)) is not None]
        reached, scenes = [end for end, _ in ends], [scene for _, scene in ends]
        bounds = share_interval(reached, scenes)
        rates[name] = (
            {"rate": round(sum(reached) / len(reached), 4), "interval": [round(bound, 4) for bound in bounds]}
            if ends
            else None
        )
    actions = mean_actions(rows)
    return {**rates, "actions": None if actions is None else round(actions, 3)}


def scene_set_of(scenario: str) -> str:
    """The name of the scene set that a scene is of; of a scene of no set, its name without numbers at the end."""
    scene = find_scene(scenario)
    if scene is None:
        return re.sub(r"(-\d+)+$", "", scenario)
    return next(name for name, scene_set in SETS.items() if scene[0] in scene_set.blocks)


def line_of(rows: Sequence[EpisodeRow], scene_set: str) -> dict[str, Any]:
    """What comes of the rows of a variant on the scenes of a set with the same number of objects."""
    settings, unchosen = settings_of(options_of(rows[0])), [row for row in rows if not is_chosen_on(row.scenario)]
    chosen_on = {row.scenario for row in rows} - {row.scenario for row in unchosen}
    return {
        "variant": variant_of(rows[0]),
        "preset": settings.preset,
        "settings": dict(settings.differing),
        "simulator": options_of(rows[0]).get("simulator"),
        "scene_set": scene_set,
        "objects": rows[0].objects,
        "scenes": len(set(map(scene_of, rows))),
        "scenes_chosen_on": len(chosen_on),
        "seeds": sorted({row.seed for row in rows}),
        "episodes": len(rows),
        "errors": sum(row.is_error for row in rows),
        **rates_of(rows),
        "on_scenes_not_chosen_on": {"episodes": len(unchosen), **rates_of(unchosen)} if unchosen else None,
    }


def run_of(name: str, rows: Sequence[EpisodeRow], **origin: Any) -> StoredRun:
    """The run of rows.

    Args:
      name: of the run.
      rows: of the same code.
      **origin: what every line says beside the run's name, code and devices, such as its command.
    """
    groups: dict[tuple[str, str, int], list[EpisodeRow]] = {}
    for row in rows:
        groups.setdefault((scene_set_of(row.scenario), variant_of(row), row.objects), []).append(row)
    devices = sorted({row.device for row in rows if row.device})
    head = {"run": name, **origin, "code": rows[0].code, "devices": devices}
    lines = [{**head, **line_of(group, scene_set)} for (scene_set, *_), group in sorted(groups.items())]
    return StoredRun(name, tuple(rows), tuple(lines))


def main() -> None:
    """Store a run."""
    parser = argparse.ArgumentParser(description="Store a run: its rows, and what comes of them.")
    parser.add_argument("folders", nargs="+", metavar="FOLDER", help="results folders, the parts of one run")
    parser.add_argument("--name", required=True, help="of the two files")
    parser.add_argument("--command", required=True, help="what was typed; several commands with ; between")
    parser.add_argument("--commit", help="of the code that ran it")
    parser.add_argument("--note", help="what else is to be said of it, such as what ran beside it")
    parser.add_argument(
        "--table",
        choices=list(TABLES),
        help="of the paper, whose episodes these are too, where the command does not name it",
    )
    parser.add_argument("--out", default=RUNS, help=f"folder of the stored runs (default: {RUNS})")
    arguments = parser.parse_args()
    try:
        rows = merged(arguments.folders)
        origin = {"commit": arguments.commit, "command": arguments.command, "note": arguments.note}
        origin |= {"table": arguments.table} if arguments.table else {}
        run = run_of(arguments.name, rows, **origin, started=started(arguments.folders))
        files = write_run(run, arguments.out)
    except InputError as error:
        sys.exit(f"store_run: {error}")
    for file in files:
        print(f"{file}: {file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
