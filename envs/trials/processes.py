"""Trials in separate processes, for batches beside a GPU.

Threads would not use sixteen cores: the Python part of a trial holds the interpreter lock.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future

import jax
import loky
import numpy as np
from jaxtyping import Array, Bool, Int

from mechsearch_jax.actions import Action
from mechsearch_jax.envs.trials.native import NativeTrials, TrialSetup
from mechsearch_jax.planner import Problem
from mechsearch_jax.planner.trials import TrialResult, TrialScenes
from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.runtime.workers import workers
from mechsearch_jax.session.preparing import Program


class ProcessTrials:
    """The `Trials` of `NativeTrials`, each scene's in one of several processes, with the same results.

    A scene's actions are tried in sequence. If a process dies, every scene is tried again, alone; if it dies again, the
    results of that scene are UNKNOWN. The processes start when they are prepared or first needed, and end with `close`
    or with this process.

    Attributes:
      trials: run by each process.
      processes: number of processes.
    """

    def __init__(self, trials: NativeTrials | None = None, processes: int | None = None) -> None:
        """Args:
        trials: the default if None; its number of threads is ignored.
        processes: `runtime.cores.cores` if None.
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

        def begin(row: int) -> Future[Int[np.ndarray, " k"]]:
            single = jax.tree.map(lambda a: a[row : row + 1], (scenes, actions, wanted))
            return self._workers().submit(_row, self.trials, cell, *single)

        rows: list[int] = np.flatnonzero(wanted.any(axis=1)).tolist()
        try:
            tried = [future.result() for future in [begin(row) for row in rows]]
        except BrokenExecutor:
            self.close()
            tried = [self._alone(begin, row) for row in rows]
        for row, result in zip(rows, tried, strict=True):
            results[row] = TrialResult.UNKNOWN if result is None else result
        return results

    def programs(self, problem: Problem) -> list[Program]:
        """A program that starts the processes and prepares each; see `many_slots.PreparesTrials`."""
        cell = _cell(problem)

        def begin() -> Callable[[], None]:
            workers = self._workers()
            first = workers.submit(_prepare, self.trials, cell)

            def finish() -> None:
                first.result()
                # The others read from disk what the first has compiled.
                for future in [workers.submit(_prepare, self.trials, cell) for _ in range(self.processes)]:
                    future.result()

            return finish

        return [Program("trials", lambda: self._pool is not None, begin)]

    def close(self) -> None:
        """End the processes; they start again when needed."""
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(kill_workers=True)

    def _workers(self) -> loky.ProcessPoolExecutor:
        if self._pool is None:
            self._pool = workers(self.processes)
        return self._pool

    def _alone(self, begin: Callable[[int], Future[Int[np.ndarray, " k"]]], row: int) -> Int[np.ndarray, " k"] | None:
        """The results of a row while no other is worked on; None, with a warning, if its process dies again."""
        try:
            return begin(row).result()
        except BrokenExecutor as error:
            self.close()
            warnings.warn(
                f"a process died as it tried actions ({type(error).__name__}); what comes of them is not known",
                stacklevel=3,
            )
            return None


def _cell(problem: Problem) -> TrialSetup:
    return TrialSetup(problem.target, jax.device_get(problem.shelf), problem.gripper)


def _prepare(trials: NativeTrials, cell: TrialSetup) -> None:
    """Compile, or read from disk, the JAX programs of a process's trials."""
    for program in trials.cell_programs(cell):
        finish = program.begin()
        if finish is not None:
            finish()


def _row(
    trials: NativeTrials, cell: TrialSetup, scenes: TrialScenes, actions: Action, wanted: Bool[np.ndarray, "1 k"]
) -> Int[np.ndarray, " k"]:
    """The results of the actions of a single scene."""
    return trials.in_cell(cell, scenes, actions, wanted)[0]
