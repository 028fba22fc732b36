"""The share of scenes that can be solved at all.

A scene that any episode has solved is solvable. Only the others are searched with full knowledge
(`envs.known_target.search`). Each search writes its result to a file, so that a killed run can be continued.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.benchmarks.statistics.intervals import wilson
from mechsearch_jax.benchmarks.store.json_rows import save_rows
from mechsearch_jax.benchmarks.store.shards import result_tables
from mechsearch_jax.envs.episode.episodes import target_of
from mechsearch_jax.envs.known_target.judgement import InFullView
from mechsearch_jax.envs.known_target.search import KnownSearchConfig, KnownSearchResult, Node, known_search
from mechsearch_jax.envs.pushing.push_models import push_models
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.planner import PRESETS, Config, planning_policy
from mechsearch_jax.problem.cache import cached_problem
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, read_json, save_json
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.workspace.scenario import Scenario

# Sampled from each world of a round.
SEQUENCES = 64


@dataclasses.dataclass(frozen=True)
class CeilingRow:
    """The solvability of one scene.

    Attributes:
      scenario, content_hash: of the scene.
      objects: number of objects around the target.
      episodes: number of given episodes of this scene.
      retrieved: number of these that retrieved the target.
      solvable: whether an episode or the search retrieved the target.
      actions: number of actions that the search needed, the retrieval included; None if it failed or did not run.
      rounds, simulated: number of the search's rounds and executed actions; None if it did not run.
      seconds: wall time of the search [s].
      path: the search's actions, each with the fields of an `ActionRecord`.
      reason: how near a search that failed came; None if the scene is solvable.
    """

    scenario: str
    content_hash: str
    objects: int
    episodes: int
    retrieved: int
    solvable: bool
    actions: int | None = None
    rounds: int | None = None
    simulated: int | None = None
    seconds: float | None = None
    path: list[dict[str, Any]] | None = None
    reason: str | None = None


@dataclasses.dataclass(frozen=True)
class Outcomes:
    """Numbers of episodes and retrievals of scenes.

    Attributes:
      by_content: by the content hash of the scene.
      by_name: by its name, for episodes without a content hash.
    """

    by_content: Mapping[str, tuple[int, int]]
    by_name: Mapping[str, tuple[int, int]]

    def of(self, scenario: Scenario) -> tuple[int, int]:
        """The numbers of episodes and retrievals of a scene."""
        pairs = (self.by_content.get(scenario.content_hash, (0, 0)), self.by_name.get(scenario.name, (0, 0)))
        episodes, retrieved = (sum(counts) for counts in zip(*pairs, strict=True))
        return episodes, retrieved


def read_outcomes(files: Sequence[PathLike]) -> Outcomes:
    """The outcomes in results of `mechsearch evaluate` (folders, Parquet files) and in stored ones (JSON).

    Raises:
      InputError: a file cannot be read, or there are no episodes in it.
    """
    by_content: dict[str, tuple[int, int]] = {}
    by_name: dict[str, tuple[int, int]] = {}
    for file in files:
        episodes = list(_evaluated(file) if Path(file).is_dir() or Path(file).suffix == ".parquet" else _stored(file))
        if not episodes:
            raise InputError(f"{file}: there are no episodes in it")
        for name, content, retrieved in episodes:
            counts, key = (by_name, name) if content is None else (by_content, content)
            before = counts.get(key, (0, 0))
            counts[key] = before[0] + 1, before[1] + retrieved
    return Outcomes(by_content, by_name)


def _evaluated(path: PathLike) -> Iterator[tuple[str, str | None, bool]]:
    """Scene name, content hash and retrieval of every episode."""
    return ((row.scenario, row.content_hash, row.retrieved) for _, rows in result_tables(path) for row in rows)


def _stored(file: PathLike) -> Iterator[tuple[str, str | None, bool]]:
    """As `_evaluated`, of a stored result: its "runs" have "episodes", each an object, or a list by "columns"."""
    value = read_json(file)
    runs = value.get("runs") if isinstance(value, dict) else None
    try:
        for run in runs or ():
            names = run.get("columns", value.get("columns", ()))
            for entry in run["episodes"]:
                episode = entry if isinstance(entry, dict) else dict(zip(names, entry, strict=True))
                yield episode["scenario"], episode.get("content_hash"), bool(episode["retrieved"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file}: is no stored result with episodes ({error})") from error


class Ceiling:
    """Searches scenes with full knowledge, and stores the results.

    Attributes:
      settings: all settings that determine a search's result, beside its scene.
    """

    def __init__(self, folder: PathLike, config: KnownSearchConfig) -> None:
        """Args:
        folder: for a file of every searched scene.
        config: the budget of a search.
        """
        self._folder, self._config = Path(folder), config
        self._planner: Config = PRESETS["standard"](sequences=SEQUENCES, max_steps=config.max_steps)
        self._simulator = NativeSimulator()
        self._problem = functools.cache(cached_problem)
        first, later = push_models(self._planner.push_model)
        self._policy = planning_policy(
            self._planner.planner, objective=InFullView(), push_model=first, later_push_model=later
        )
        self.settings: dict[str, Any] = {**dataclasses.asdict(config), "planner": self._planner.options()}

    def row(
        self, scenario: Scenario, outcomes: Outcomes, on_round: Callable[[int, Node], None] = lambda round, best: None
    ) -> CeilingRow:
        """The solvability of a scene; searched if no episode solved it and no stored result matches.

        Args:
          scenario: the scene.
          outcomes: of episodes.
          on_round: see `known_search`.

        Raises:
          InputError: the file cannot be written.
        """
        episodes, retrieved = outcomes.of(scenario)
        row = CeilingRow(
            scenario.name, scenario.content_hash, len(scenario.objects), episodes, retrieved, retrieved > 0
        )
        return row if row.solvable else self._searched(row, scenario, on_round)

    def _searched(self, row: CeilingRow, scenario: Scenario, on_round: Callable[[int, Node], None]) -> CeilingRow:
        file = self._folder / f"{scenario.name}.json"
        identity = {"content_hash": row.content_hash, "code": present_code(), "settings": self.settings}
        columns = _stored_columns(file, identity)
        if columns is None:
            begin = time.perf_counter()
            problem = self._problem(target_of(scenario), self._planner.problem)
            result = known_search(scenario, problem, self._policy, self._simulator, self._config, on_round)
            columns = columns_of(result) | {"seconds": round(time.perf_counter() - begin, 1)}
            save_json({**identity, "versions": versions(), "found": columns}, file)
        return dataclasses.replace(row, **columns, solvable=columns["actions"] is not None)


def columns_of(result: KnownSearchResult) -> dict[str, Any]:
    """The columns of a `CeilingRow` that a search fills."""
    return {
        "actions": None if result.actions is None else len(result.actions),
        "rounds": result.rounds,
        "simulated": result.simulated,
        "path": None if result.actions is None else [dataclasses.asdict(action) for action in result.actions],
        "reason": None if result.actions is not None else nearest(result.best),
    }


def nearest(best: Node) -> str:
    """How near to being solved the best world of a search is."""
    hit = "no grasp" if best.judgement.least is None else f"{best.judgement.least} in the way"
    return f"{hit} after {len(best.actions)} actions"


def _stored_columns(file: Path, identity: Mapping[str, Any]) -> dict[str, Any] | None:
    """The columns in a file of the same scene, code and settings; None without such a file."""
    try:
        value = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    wanted = json.loads(json.dumps(identity))
    if not isinstance(value, dict) or {name: value.get(name) for name in wanted} != wanted:
        return None
    return value.get("found")


def summary(rows: Sequence[CeilingRow]) -> list[dict[str, Any]]:
    """Solvable scenes by number of objects, and of all (None), with Wilson intervals."""
    counts: list[int | None] = [*sorted({row.objects for row in rows}), None]
    lines = []
    for objects in counts:
        group = [row for row in rows if objects is None or row.objects == objects]
        solvable = sum(row.solvable for row in group)
        lines.append(
            {
                "objects": objects,
                "scenes": len(group),
                "solved_in_an_episode": sum(row.retrieved > 0 for row in group),
                "solved_by_the_search": sum(row.actions is not None for row in group),
                "solvable": solvable / len(group),
                "solvable_interval": wilson(solvable, len(group)),
            }
        )
    return lines


def save_ceiling(rows: Sequence[CeilingRow], settings: Mapping[str, Any], command: str, path: PathLike) -> None:
    """Write the shares and all rows as JSON.

    Args:
      rows: at least one.
      settings: of the searches.
      command: of the run.
      path: of the file.

    Raises:
      InputError: the file cannot be written.
    """
    head = {"command": command, "code": present_code(), "versions": versions(), "settings": dict(settings)}
    save_rows({**head, "summary": summary(rows)}, rows, path)
