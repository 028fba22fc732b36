"""What whole episodes can come to."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mechsearch_jax.benchmarks.lab import PROGRAM
from mechsearch_jax.commands.options import SomeScenarios, at_least_one, find_scenarios
from mechsearch_jax.runtime.errors import InputError, check_once

if TYPE_CHECKING:
    from mechsearch_jax.envs.known_target.search import Node
    from mechsearch_jax.workspace.scenario import Scenario

Results = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FOLDER|FILE ...")]


def _command() -> str:
    """What was typed."""
    return shlex.join([*PROGRAM.split(), *sys.argv[1:]])


def _scenes(command: str, names: Sequence[str]) -> list[Scenario]:
    """The scenes that files, folders and names stand for, for a command.

    Raises:
      InputError: there is nothing for one of them, or two have the same name.
    """
    from mechsearch_jax.workspace.scenario import load_scenario

    scenes = list(map(load_scenario, find_scenarios(names)))
    check_once(f"lab {command}: two scenes", (scene.name for scene in scenes))
    return scenes


def bench_ceiling(
    scenarios: SomeScenarios,
    /,
    *,
    out: Path,
    results: Results = (),
    rounds: int = 40,
    seed: int = 0,
) -> None:
    """Tell what share of scenes can be solved at all; those that no episode solved are searched with everything known.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets.
      out: folder for a file for every scene that is searched, and ceiling.json. Scenes that have a file of the same
        code and options are not searched again.
      results: of `evaluate` (folders, .parquet) and stored ones (.json); what was retrieved in any is solvable.
      rounds: of each search, at most.
      seed: of the searches.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.lab.ceiling import solvability
    from mechsearch_jax.benchmarks.lab.screen import as_text
    from mechsearch_jax.envs.known_target.search import KnownSearchConfig
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.runtime.files import check_writable

    at_least_one("lab ceiling", rounds=rounds)
    scenes = _scenes("ceiling", scenarios)
    outcomes = solvability.read_outcomes(results)
    check_writable(out)
    keep_compilations()
    ceiling = solvability.Ceiling(out, KnownSearchConfig(rounds=rounds, seed=seed))
    console = Console(highlight=False)
    rows: list[solvability.CeilingRow] = []
    with console.status("searching") as status:
        for scene in scenes:

            def on_round(number: int, best: Node, scene=scene) -> None:
                line = f"{len(rows)}/{len(scenes)} {scene.name}: round {number}, {solvability.nearest(best)}"
                status.update(line)
                if not console.is_terminal:
                    console.print(line, soft_wrap=True)

            rows.append(ceiling.row(scene, outcomes, on_round))
    solvability.save_ceiling(rows, ceiling.settings, _command(), out / "ceiling.json")
    print(as_text(solvability.summary(rows)))
    print(as_text({"scene": row.scenario, "reason": row.reason} for row in rows if not row.solvable))


def bench_cell(
    config: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE.toml")],
    /,
    *,
    out: Path,
    scenarios: SomeScenarios = (),
    objects: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = (2, 4, 6),
    searches: int = 20,
    seed: int = 0,
    colours: Annotated[tuple[tuple[float, float, float], ...], tyro.conf.arg(metavar="R G B ...")] = (),
    colour_noise: Annotated[tuple[float, ...], tyro.conf.arg(metavar="SHARE ...")] = (4 / 255,),
    depth_noise: float = 0.001,
) -> None:
    """Search from images in a simulated cell, through a Searcher alone; status 1 where a search ended with an error.

    Args:
      config: what the cell is like: camera, shelf, target, base and planner.
      out: folder for a row of every search, pictures of those that were lost, and cell.json. Searches that have a
        row of the same code and configuration are not run again.
      scenarios: scenes to search in, all with the seed, instead of random ones.
      objects: numbers of objects, taken in turn.
      searches: how many, each of a scene of its own.
      seed: of the first scene; the others follow.
      colours: red, green and blue of the target in 0 to 1, of several targets in turn; the file's if not given.
      colour_noise: standard deviations of every channel, as shares of full brightness, in turn.
      depth_noise: standard deviation of the depth [m].
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.lab.parts import cell_searches as cell
    from mechsearch_jax.benchmarks.lab.screen import as_text
    from mechsearch_jax.runtime.files import check_writable

    at_least_one("lab cell", searches=searches, objects=min(objects, default=0))
    if not colour_noise:
        raise InputError("lab cell: --colour-noise is without a number; leave it out, or give one, as 0.016")
    conditions = cell.Conditions(objects, colours, colour_noise, depth_noise)
    check_writable(out)
    if scenarios:
        starts = [(scene.name, seed, scene) for scene in _scenes("cell", scenarios)]
    else:
        starts = cell.random_scenes(config, conditions, range(seed, seed + searches))
    console = Console(highlight=False)
    with console.status("preparing") as status:

        def progress(done: int, what: str) -> None:
            line = f"{done}/{len(starts)} {what}"
            status.update(line)
            if not console.is_terminal:
                console.print(line, soft_wrap=True)

        rows = cell.run_cell(config, out, conditions, starts, progress)
    cell.save_rows(rows, config, conditions, _command(), out / "cell.json")
    print(as_text([cell.summary(rows)]))
    console.print(str(out / "cell.json"), soft_wrap=True)
    if any(row.error for row in rows):
        raise SystemExit(1)


COMMANDS = {"ceiling": bench_ceiling, "cell": bench_cell}
