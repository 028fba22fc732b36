"""`python -m mechsearch_jax.benchmarks.lab study`: declared ablations, baselines, robustness."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from mechsearch_jax.commands.options import EpisodeOptions, at_least_one, files_of
from mechsearch_jax.commands.runs import USUAL_RUN, RunOptions, print_estimate, run_jobs

if TYPE_CHECKING:
    from rich.console import Console

    from mechsearch_jax.benchmarks.lab.studies.studies import Study
    from mechsearch_jax.benchmarks.running.evaluate import Job, PlannedJob
    from mechsearch_jax.benchmarks.store.rows import EpisodeRow
    from mechsearch_jax.envs.episode.method import Method
    from mechsearch_jax.envs.scenes.scene_sets import Block
    from mechsearch_jax.envs.simulators.named import EngineName


def study(
    names: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="NAME|all ...")],
    /,
    *,
    out: Path,
    scenes: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    seed: tuple[int, ...] = (0,),
    simulator: Literal["auto", "native", "mjx"] = "auto",
    run: Annotated[RunOptions, tyro.conf.arg(name="")] = USUAL_RUN,
) -> None:
    """Run declared studies: which variants are compared, on which scenes, is in benchmarks/lab/studies/declared.py.

    The rows are those of evaluate, in the same kind of folder: killed and started again, it goes on where it stopped,
    and what several studies have in common is run once. Each study is then printed, as far as its rows are there.

    Args:
      names: of studies: gamma, horizon, sequences, actions, baselines, friction, mass, friction-and-mass,
        calibration, sensor, cameras, shelf-low, shelf-narrow, shelf-wide, physics; or all.
      out: folder for the results, one row for each episode.
      scenes: only the first so many of each number of objects, for a quick look.
      seed: one or more.
      simulator: as evaluate has it; a variant that needs one runs in that.
      run: how the episodes are run.
    """
    from mechsearch_jax.benchmarks.lab.studies.declared import STUDIES
    from mechsearch_jax.benchmarks.lab.studies.studies import find_studies

    at_least_one("study", scenes=scenes)
    chosen = find_studies(names, STUDIES)
    engine = run.engine("study", EpisodeOptions(simulator=simulator))
    seeds = list(dict.fromkeys(seed))
    if run.dry_run:
        for each in chosen:
            print(f"{each.name}: {each.question} {len(each.variants)} variants on {each.scenes}")
        print_estimate("study", _planned(chosen, scenes, seeds, engine), out, run, simulator)
        return
    jobs = _jobs(chosen, scenes, seeds, engine)

    def show(console: Console, rows: Sequence[EpisodeRow]) -> None:
        from mechsearch_jax.benchmarks.lab.studies.comparison import screen

        for each in chosen:
            console.print(screen(each, rows))

    run_jobs("study", jobs, out, run, simulator, show)


def _scenes(
    studies: Sequence[Study], scenes: int | None, engine: EngineName
) -> Iterator[tuple[Method, list[tuple[Block, int]]]]:
    """The method of every variant with its scenes, of each number of objects only the first so many.

    Raises:
      InputError: a variant cannot be used.
    """
    for study in studies:
        for variant in study.variants:
            listed = [(block, i) for block, i in study.scene_list(variant) if scenes is None or i < scenes]
            yield variant.method(engine), listed


def _planned(
    studies: Sequence[Study], scenes: int | None, seeds: Sequence[int], engine: EngineName
) -> list[PlannedJob]:
    """The episodes of studies, each once, of scenes that are not made.

    Raises:
      InputError: a variant cannot be used.
    """
    from mechsearch_jax.benchmarks.running.evaluate import SceneOutline, planned_jobs

    jobs: dict[str, PlannedJob] = {}
    for method, listed in _scenes(studies, scenes, engine):
        method.check()
        outlines = [SceneOutline.of_block(*scene) for scene in listed]
        jobs |= {job.key: job for job in planned_jobs(outlines, [method], seeds) if job.key not in jobs}
    return list(jobs.values())


def _jobs(studies: Sequence[Study], scenes: int | None, seeds: Sequence[int], engine: EngineName) -> list[Job]:
    """The episodes of studies, each once.

    Raises:
      InputError: a variant cannot be used.
    """
    from mechsearch_jax.benchmarks.running.evaluate import make_jobs

    jobs: dict[str, Job] = {}
    for method, listed in _scenes(studies, scenes, engine):
        jobs |= {job.key: job for job in make_jobs(files_of(listed), [method], seeds) if job.key not in jobs}
    return list(jobs.values())
