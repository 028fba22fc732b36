"""The rows of the paper's tables in stored runs."""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from mechsearch_jax.benchmarks.paper.paper_tables import BOTH, METHODS, PaperTable
from mechsearch_jax.benchmarks.paper.reproduce import (
    ANY,
    COLLISION_FREE,
    CONTACT,
    FACTORS,
    Results,
    Setting,
    origin_of,
)
from mechsearch_jax.benchmarks.store.rows import OPTIONS, EpisodeRow, episode_key
from mechsearch_jax.benchmarks.store.runs import StoredRun, variant_of
from mechsearch_jax.envs.scenes.scene_sets import find_scene

# What cells are ordered by where the factor's values have no order of their own.
_RECOGNITIONS = ("oracle", "masks", "full")


def runs_of(table: PaperTable, runs: Sequence[StoredRun]) -> list[StoredRun]:
    """The runs of an experiment, by their commands or as they were stored, the newest first."""
    own = [run for run in runs if run.lines and _is_of(table, run.lines[0])]
    return sorted(own, key=lambda run: (str(run.lines[0].get("started") or ""), run.name), reverse=True)


def _is_of(table: PaperTable, line: Mapping[str, Any]) -> bool:
    return f"reproduce {table.name}" in str(line.get("command")) or line.get("table") == table.name


def setting_of(line: Mapping[str, Any]) -> Setting | None:
    """What a variant of a stored run's line is in a table; None where it is none of its cells."""
    usual = {"policy": METHODS[1], "recognition": "oracle", "actions": list(BOTH), CONTACT: True}
    values = {**usual, **line["settings"]}
    if values.keys() != usual.keys() or values["policy"] not in METHODS:
        return None
    grasps = COLLISION_FREE if values[CONTACT] is False else ANY
    actions = tuple(values["actions"])
    return Setting(values["policy"], values["recognition"], actions, line["preset"], grasps)


def results_of_runs(table: PaperTable, runs: Sequence[StoredRun]) -> Results:
    """The rows of an experiment in stored runs.

    Of every setting those of the newest run that has it, with its code and the simulator that most of them ran in.
    """
    rows: dict[Setting, dict[str, EpisodeRow]] = {}
    for run in runs_of(table, runs):
        fresh: dict[Setting, list[EpisodeRow]] = {}
        for setting, row in _rows_of(table, run):
            fresh.setdefault(setting, []).append(row)
        for setting, own in fresh.items():
            there = rows.get(setting, {})
            shown = (
                origin_of(next(iter(there.values()))) if there else Counter(map(origin_of, own)).most_common(1)[0][0]
            )
            rows[setting] = {episode_key(row): row for row in own if origin_of(row) == shown} | there
    return Results(table, {setting: list(rows[setting].values()) for setting in sorted(rows, key=_order)})


def _rows_of(table: PaperTable, run: StoredRun) -> list[tuple[Setting, EpisodeRow]]:
    settings = {line["variant"]: setting for line in run.lines if (setting := setting_of(line))}
    options, blocks = operator.attrgetter("configuration", *OPTIONS), set(table.blocks.values())
    variants: dict[Any, str] = {}
    pairs = []
    for row in run.rows:
        key = options(row)
        if key not in variants:
            variants[key] = variant_of(row)
        scene = find_scene(row.scenario)
        setting = settings.get(variants[key])
        if setting and scene and scene[0].name in blocks and setting.actions in table.actions:
            pairs.append((setting, row))
    return pairs


def _order(setting: Setting) -> tuple[Any, ...]:
    first = {"recognition": _RECOGNITIONS, "method": METHODS, "preset": ("paper", "standard")}

    def place(factor: str) -> tuple[int, str]:
        value, values = getattr(setting, factor), first.get(factor, ())
        return values.index(value) if value in values else len(values), "+".join(value) if factor == "actions" else ""

    more = (len(setting.actions) < len(BOTH), *(place(factor) for factor in FACTORS if factor not in ("grasps",)))
    return place("preset"), setting.grasps, place("recognition"), place("method"), more
