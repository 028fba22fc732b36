"""What share of scenes can be solved at all.

A scene that any episode ever solved can be. Only for the rest there is a search with everything known
(`envs.known_target.search`). What it comes to is kept in one file a scene, so that a run that was killed goes on.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mechsearch_jax.benchmarks.ceiling import unsolved
from mechsearch_jax.benchmarks.parts.images import save_rows
from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.benchmarks.statistics.intervals import wilson
from mechsearch_jax.benchmarks.store.shards import result_tables
from mechsearch_jax.envs.episode.episodes import target_of
from mechsearch_jax.envs.known_target.judgement import InFullView
from mechsearch_jax.envs.known_target.search import Found, KnownSearchConfig, Node, known_search
from mechsearch_jax.envs.pushing.push_models import push_models
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.planner import PRESETS, Config, planning_policy
from mechsearch_jax.problem.cache import cached_problem
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, save_json
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.viz.drawing import save_figure
from mechsearch_jax.workspace.scenario import Scenario


@dataclasses.dataclass(frozen=True)
class Row:
    """What is known of one scene.

    Attributes:
      scenario, content_hash: its name, and what it holds.
      objects: how many surround the target.
      episodes: how many of the given episodes were of this scene.
      retrieved: how many of them took the target out.
      solvable: whether one of them did, or the search.
      actions: that the search needed, taking the target out among them; None where it did not, or was not needed.
      rounds, simulated: of the search, and the number of actions that it executed; None where it was not needed.
      seconds: wall time that it took [s].
      path: those actions, each with the fields of an `ActionRecord`.
      reason: why the scene is not known to be solvable; None where it is.
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
    """How often the target was taken out in episodes: for each scene their number and that of retrievals.

    Attributes:
      by_content: by the content hash of the scene.
      by_name: by its name, of episodes that do not say what their scene held.
    """

    by_content: Mapping[str, tuple[int, int]]
    by_name: Mapping[str, tuple[int, int]]

    def of(self, scenario: Scenario) -> tuple[int, int]:
        """The episodes and the retrievals of a scene."""
        known = (self.by_content.get(scenario.content_hash, (0, 0)), self.by_name.get(scenario.name, (0, 0)))
        episodes, retrieved = (sum(counts) for counts in zip(*known, strict=True))
        return episodes, retrieved


def read_outcomes(files: Sequence[PathLike]) -> Outcomes:
    """What results of `mechsearch evaluate` (folders, Parquet files) and stored ones (JSON) say of scenes.

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
    """Name and content hash of the scene, and whether the target was taken out, of every episode."""
    return ((row.scenario, row.content_hash, row.retrieved) for _, rows in result_tables(path) for row in rows)


def _stored(file: PathLike) -> Iterator[tuple[str, str | None, bool]]:
    """The same of a stored result: its "runs" have "episodes", each an object, or a list in the order of "columns"."""
    try:
        value = json.loads(Path(file).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise InputError(f"{file}: is not JSON ({' '.join(str(error).split())})") from error
    runs = value.get("runs") if isinstance(value, dict) else None
    try:
        for run in runs or ():
            names = run.get("columns", value.get("columns", ()))
            for one in run["episodes"]:
                episode = one if isinstance(one, dict) else dict(zip(names, one, strict=True))
                yield episode["scenario"], episode.get("content_hash"), bool(episode["retrieved"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file}: is no stored result with episodes ({error})") from error


class Ceiling:
    """Searches scenes with everything known, and keeps what it came to.

    Attributes:
      settings: everything that decides about a search, beside its scene.
    """

    def __init__(self, folder: PathLike, config: KnownSearchConfig, sequences: int) -> None:
        """Args:
        folder: for a file, and where it failed a picture, for every scene.
        config: how much is tried.
        sequences: sampled from each world of a round.
        """
        self._folder, self._config = Path(folder), config
        self._planner: Config = PRESETS["best"](sequences=sequences, max_steps=config.max_steps)
        self._simulator = NativeSimulator()
        self._problem = functools.cache(cached_problem)
        first, later = push_models(self._planner.push_model)
        self._policy = planning_policy(
            self._planner.planner, objective=InFullView(), push_model=first, later_push_model=later
        )
        self.settings: dict[str, Any] = {**dataclasses.asdict(config), "planner": self._planner.options()}

    def row(
        self, scenario: Scenario, outcomes: Outcomes, told: Callable[[int, Node], None] = lambda round, best: None
    ) -> Row:
        """What is known of a scene; it is searched if no episode solved it and its file does not say.

        Raises:
          InputError: its file or picture cannot be written.
        """
        episodes, retrieved = outcomes.of(scenario)
        row = Row(scenario.name, scenario.content_hash, len(scenario.objects), episodes, retrieved, retrieved > 0)
        return row if row.solvable else self._searched(row, scenario, told)

    def _searched(self, row: Row, scenario: Scenario, told: Callable[[int, Node], None]) -> Row:
        file = self._folder / f"{scenario.name}.json"
        same = {"content_hash": row.content_hash, "code": present_code(), "settings": self.settings}
        known = _kept(file, same)
        if known is None:
            begin = time.perf_counter()
            problem = self._problem(target_of(scenario), self._planner.problem)
            found = known_search(scenario, problem, self._policy, self._simulator, self._config, told)
            known = told_of(found) | {"seconds": round(time.perf_counter() - begin, 1)}
            if found.actions is None:
                figure = unsolved.picture(found, problem, scenario.name, str(known["reason"]))
                save_figure(figure, self._folder / f"{scenario.name}.png")
            save_json({**same, "versions": versions(), "found": known}, file)
        return dataclasses.replace(row, **known, solvable=known["actions"] is not None)


def told_of(found: Found) -> dict[str, Any]:
    """The columns of a row that a search fills."""
    return {
        "actions": None if found.actions is None else len(found.actions),
        "rounds": found.rounds,
        "simulated": found.simulated,
        "path": None if found.actions is None else [dataclasses.asdict(action) for action in found.actions],
        "reason": None if found.actions is not None else unsolved.reason(found),
    }


def _kept(file: Path, same: Mapping[str, Any]) -> dict[str, Any] | None:
    """What a file says of a search of the same scene by the same code with the same settings; None if nothing."""
    try:
        value = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    wanted = json.loads(json.dumps(same))
    if not isinstance(value, dict) or {name: value.get(name) for name in wanted} != wanted:
        return None
    return value.get("found")


def summary(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """How many scenes can be solved, by their number of objects, and, with None, of all; with Wilson's interval."""
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


def save_ceiling(rows: Sequence[Row], settings: Mapping[str, Any], command: str, path: PathLike) -> None:
    """Write the shares and all rows as JSON.

    Args:
      rows: at least one.
      settings: of the searches.
      command: that asked for them.
      path: of the file.

    Raises:
      InputError: the file cannot be written.
    """
    head = {"command": command, "code": present_code(), "versions": versions(), "settings": dict(settings)}
    save_rows({**head, "summary": summary(rows)}, rows, path)
