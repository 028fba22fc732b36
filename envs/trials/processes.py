"""Trials in processes of their own, for batches beside a GPU.

What a trial needs of Python keeps threads waiting for each other long before sixteen cores are busy.
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Future
from pathlib import Path
from typing import Any

import jax
import loky
import numpy as np
from jaxtyping import Array, Bool, Int

from mechsearch_jax.actions import Action
from mechsearch_jax.envs.trials.native import Cell, NativeTrials
from mechsearch_jax.planner import Problem
from mechsearch_jax.planner.trials import TrialResult, TrialScenes
from mechsearch_jax.runtime.compiled import keep_in, kept_in
from mechsearch_jax.runtime.cores import cores, share_of_cores
from mechsearch_jax.session.preparing import Program

# Settings of JAX that say what it keeps on disk.
CACHE = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
# Results of a scene's actions that are still to come.
Pending = Future[Int[np.ndarray, " k"]]


class ProcessTrials:
    """The `Trials` of `NativeTrials`, each scene's in one of several processes.

    They say the same, one action of a scene after the other. Where a process dies all scenes are tried once more, each
    alone; of one in which it dies again, it is not known what becomes of its actions. The processes begin when they
    are prepared or first needed, and end with `close`, or with this process.

    Attributes:
      trials: what each process does.
      processes: how many.
    """

    def __init__(self, trials: NativeTrials | None = None, processes: int | None = None) -> None:
        """Args:
        trials: the default if left out; its threads do not count.
        processes: one for each of `runtime.cores.cores` if left out.
        """
        self.trials = dataclasses.replace(trials or NativeTrials(), threads=1)
        self.processes = processes or cores()
        self._pool: loky.ProcessPoolExecutor | None = None

    def __call__(
        self, problem: Problem, scenes: TrialScenes, actions: Action, wanted: Bool[Array | np.ndarray, "r k"]
    ) -> Int[np.ndarray, "r k"]:
        """See `trials.Trials`."""
        cell = _cell(problem)
        scenes, actions, wanted = jax.device_get((scenes, actions, wanted))
        results = np.full(wanted.shape, TrialResult.UNKNOWN, np.int32)

        def begin(row: int) -> Pending:
            one = jax.tree.map(lambda a: a[row : row + 1], (scenes, actions, wanted))
            return self._workers().submit(_row, self.trials, cell, *one)

        rows = np.flatnonzero(wanted.any(axis=1)).tolist()
        try:
            pending = {row: begin(row) for row in rows}
            for row, future in pending.items():
                results[row] = future.result()
        except BrokenExecutor:
            self.close()
            for row in rows:
                results[row] = self._alone(functools.partial(begin, row), wanted.shape[1])
        return results

    def programs(self, problem: Problem) -> list[Program]:
        """The processes, each with what it computes; see `many_slots.PreparesTrials`."""
        cell = _cell(problem)

        def begin() -> Callable[[], None]:
            workers = self._workers()
            first = workers.submit(_prepare, self.trials, cell)

            def finish() -> None:
                first.result()
                # What the first has compiled, the others read from disk.
                for other in [workers.submit(_prepare, self.trials, cell) for _ in range(self.processes)]:
                    other.result()

            return finish

        return [Program("trials", lambda: self._pool is not None, begin)]

    def close(self) -> None:
        """End the processes; they begin anew where they are needed again."""
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(kill_workers=True)

    def _workers(self) -> loky.ProcessPoolExecutor:
        if self._pool is None:
            alone = {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": "", "OPENBLAS_NUM_THREADS": "1"}
            self._pool = loky.ProcessPoolExecutor(
                self.processes,
                initializer=_keep,
                initargs=(kept_in(), {name: getattr(jax.config, name) for name in CACHE}),
                env=alone | share_of_cores(self.processes),
            )
        return self._pool

    def _alone(self, begin: Callable[[], Pending], count: int) -> Int[np.ndarray, " k"]:
        """The results of a scene's actions, while no other scene is tried."""
        try:
            return begin().result()
        except BrokenExecutor as error:
            self.close()
            warnings.warn(
                f"a process died as it tried {count} actions ({type(error).__name__}); their results are not known",
                stacklevel=4,
            )
            return np.full(count, TrialResult.UNKNOWN, np.int32)


def _cell(problem: Problem) -> Cell:
    return Cell(problem.target, jax.device_get(problem.shelf), problem.gripper)


def _keep(executables: Path | None, cache: Mapping[str, Any]) -> None:
    """Keep on disk in a new process what is compiled, where the first one does."""
    if executables is not None:
        keep_in(executables)
    for name, value in cache.items():
        jax.config.update(name, value)


def _prepare(trials: NativeTrials, cell: Cell) -> None:
    """Make a process ready: compile, or read from disk, what its trials compute with JAX."""
    for each in trials.cell_programs(cell):
        finish = each.begin()
        if finish is not None:
            finish()


def _row(
    trials: NativeTrials, cell: Cell, scenes: TrialScenes, actions: Action, wanted: Bool[np.ndarray, "1 k"]
) -> Int[np.ndarray, " k"]:
    """What becomes of the actions of a scene."""
    return trials.in_cell(cell, scenes, actions, wanted)[0]
