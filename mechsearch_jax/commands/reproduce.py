"""`mechsearch reproduce`: the paper's experiments, beside the paper's figures."""

from __future__ import annotations

import dataclasses
import itertools
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from mechsearch_jax.commands.options import EpisodeOptions, PaperMethod, at_least_one, files_of, with_planner_options
from mechsearch_jax.commands.runs import USUAL_RUN, RunOptions, print_estimate, run_jobs
from mechsearch_jax.runtime.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from mechsearch_jax.benchmarks.paper.paper_tables import PaperTable
    from mechsearch_jax.benchmarks.paper.reproduce import Setting
    from mechsearch_jax.benchmarks.running.evaluate import Job, PlannedJob
    from mechsearch_jax.envs.episode.method import Method
    from mechsearch_jax.envs.scenes.scene_sets import Block
    from mechsearch_jax.envs.simulators.named import EngineName

TableName = Literal["table1", "table3", "table4", "table5"]
Recognition = Literal["oracle", "masks", "full", "informed"]


def _several(metavar: str) -> Any:
    return tyro.conf.arg(metavar=f"{metavar} ...", help_behavior_hint="")


@dataclasses.dataclass(frozen=True)
class Cells:
    """The cells of a table that are run, on what and in what; what is empty stands for the default.

    Attributes:
      method: one of them; both by default.
      recognition: what the planner sees: true shapes, a noisy depth image with true masks (the paper's R), or the image
        alone, these three by default; or true shapes and the hidden target.
      preset: where the planner's settings come from, one or more; paper and standard by default.
      retrieval_contact: whether the target may be taken out with a grasp that brushes something, where it is tried out
        first; only False is the paper's grasp. True by default; both for either.
      objects: only the scenes with so many.
      scenes: only the first so many of each number of objects, for a quick look.
      seed: one or more.
      simulator: as evaluate has it.
    """

    method: Annotated[tuple[PaperMethod, ...], _several("{search-and-grasp,search-for-grasp}")] = ()
    recognition: Annotated[tuple[Recognition, ...], _several("{oracle,masks,full,informed}")] = ()
    preset: Annotated[tuple[str, ...], _several("NAME")] = ()
    retrieval_contact: Annotated[tuple[bool, ...], _several("{True,False}")] = ()
    objects: Annotated[tuple[int, ...], _several("N")] = ()
    scenes: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    seed: tuple[int, ...] = (0,)
    simulator: Literal["auto", "native", "mjx"] = "auto"

    @property
    def seeds(self) -> list[int]:
        """The seeds, each once."""
        return list(dict.fromkeys(self.seed))

    def scene_list(self, table: PaperTable) -> list[tuple[Block, int]]:
        """The scenes of a table.

        Raises:
          InputError: it has none with so many objects, or none are to be run.
        """
        from mechsearch_jax.benchmarks.paper.paper_tables import table_scenes

        at_least_one("reproduce", scenes=self.scenes)
        return table_scenes(table, self.objects, self.scenes)

    def settings(self, table: PaperTable) -> list[Setting]:
        """The settings of a table's cells.

        Raises:
          InputError: a preset is unknown, or this version lacks an option.
        """
        from mechsearch_jax.benchmarks.paper.paper_tables import METHODS
        from mechsearch_jax.benchmarks.paper.reproduce import ANY, COLLISION_FREE, CONTACT, Setting
        from mechsearch_jax.planner import OPTIONS, PRESETS

        unknown = [name for name in self.preset if name not in PRESETS]
        if unknown:
            raise InputError(f"reproduce: preset {unknown[0]} is unknown; use {', '.join(PRESETS)}")
        if not all(self.retrieval_contact) and CONTACT not in {option.name for option in OPTIONS}:
            raise InputError("reproduce: --retrieval-contact False: this version has no such option; leave it out")
        grasps = [ANY if contact else COLLISION_FREE for contact in self.retrieval_contact or (True,)]
        product = itertools.product(
            self.preset or ("paper", "standard"),
            grasps,
            self.recognition or ("oracle", "masks", "full"),
            self.method or METHODS,
            table.actions,
        )
        return [Setting(m, r, actions, p, g) for p, g, r, m, actions in dict.fromkeys(product)]


# The default.
ALL_CELLS = Cells()


def _methods(settings: Sequence[Setting], simulator: str, engine: EngineName) -> dict[Setting, Method]:
    """The method of every setting.

    Raises:
      InputError: a setting cannot be used.
    """
    from mechsearch_jax.benchmarks.paper.reproduce import COLLISION_FREE, CONTACT

    options: Any = with_planner_options()

    def method_of(setting: Setting) -> Method:
        point = options(
            preset=setting.preset,
            recognition=setting.recognition,
            actions=setting.actions,
            simulator=simulator,
            **({CONTACT: False} if setting.grasps == COLLISION_FREE else {}),
        )
        return point.methods([setting.method], engine)[0]

    return {setting: method_of(setting) for setting in settings}


def _jobs(
    methods: Mapping[Setting, Method], scenarios: Sequence[Path], seeds: Sequence[int]
) -> dict[Setting, list[Job]]:
    """The episodes of every setting.

    Raises:
      InputError: a scenario cannot be used.
    """
    from mechsearch_jax.benchmarks.running.evaluate import make_jobs

    jobs = make_jobs(scenarios, list(methods.values()), seeds)
    by_method: dict[Method, list[Job]] = {}
    for job in jobs:
        by_method.setdefault(job.method, []).append(job)
    return {setting: by_method[method] for setting, method in methods.items()}


def _planned(
    methods: Mapping[Setting, Method], scenes: Sequence[tuple[Block, int]], seeds: Sequence[int]
) -> list[PlannedJob]:
    """The episodes of all settings, of scenes that are not made."""
    from mechsearch_jax.benchmarks.running.evaluate import SceneOutline, planned_jobs

    outlines = [SceneOutline.of_block(*scene) for scene in scenes]
    return planned_jobs(outlines, list(methods.values()), seeds)


def reproduce(
    table: Annotated[TableName, tyro.conf.Positional, tyro.conf.arg(metavar="table1|table3|table4|table5")],
    /,
    *,
    out: Path,
    cells: Annotated[Cells, tyro.conf.arg(name="")] = ALL_CELLS,
    run: Annotated[RunOptions, tyro.conf.arg(name="")] = USUAL_RUN,
) -> None:
    """Run an experiment of the paper in our simulator, and set what comes of it beside the paper's figures.

    The rows are those of evaluate, in the same kind of folder: killed and started again, it goes on where it stopped.
    The table is drawn from all that is in the folder by then, this machine's part or another's.

    Args:
      table: table1 is the main experiment, table3 two cylinders in a line, table4 one kind of action alone, table5 a
        box as the target.
      out: folder for the results, and for NAME.md and NAME.json.
      cells: what of it is run.
      run: how the episodes are run.
    """
    from mechsearch_jax.benchmarks.paper.paper_tables import TABLES

    chosen = TABLES[table]
    simulator, seeds = cells.simulator, cells.seeds
    engine = run.engine("reproduce", EpisodeOptions(simulator=simulator))
    scene_list, settings = cells.scene_list(chosen), cells.settings(chosen)
    methods = _methods(settings, simulator, engine)
    if run.dry_run:
        _print_settings(chosen, settings, len(scene_list), len(seeds))
        print_estimate("reproduce", _planned(methods, scene_list, seeds), out, run, simulator)
        return
    jobs = _jobs(methods, files_of(scene_list), seeds)
    all_jobs = [job for jobs_of_setting in jobs.values() for job in jobs_of_setting]
    run_jobs("reproduce", all_jobs, out, run, simulator, lambda console, _: _draw(console, chosen, jobs, out))


def _print_settings(table: PaperTable, settings: Sequence[Setting], scenes: int, seeds: int) -> None:
    """Print a line for each setting."""
    print(f"{table.name}: {table.about}; {scenes} scenes")
    for setting in settings:
        print(f"{scenes * seeds} episodes: {', '.join(map(_named, setting))}")


def _named(value: str | tuple[str, ...]) -> str:
    return value if isinstance(value, str) else "+".join(value)


def _draw(console: Console, table: PaperTable, jobs: Mapping[Setting, Sequence[Job]], out: Path) -> None:
    """Print and write the table from the folder's results."""
    from mechsearch_jax.benchmarks.paper.reproduce import results_of, screen, write_table
    from mechsearch_jax.benchmarks.store.shards import Results

    folder = Results(out)
    folder.refresh()
    results = results_of(table, jobs, folder.rows)
    page, _ = write_table(results, out, shlex.join(["mechsearch", *sys.argv[1:]]))
    console.print(screen(results))
    console.print(str(page), soft_wrap=True, markup=False)
