"""Episodes one after the other in this process: what every worker on a CPU does."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

from mechsearch_jax.benchmarks.running.evaluate import Job, present_code
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.envs.episode.closed_loop import RunSettings, Start
from mechsearch_jax.envs.episode.episodes import run_episode, target_of
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.workspace.target import Target


class SequentialRunner:
    """A `Runner` of one episode at a time, in the native simulator; keeps what episodes have in common."""

    def __init__(self) -> None:
        self._simulator = functools.cache(_simulator)
        self._problem = functools.cache(Workcell.problem)
        self._policy = functools.cache(Method.policy)

    def __call__(
        self, jobs: Sequence[Job], ended: Callable[[Sequence[EpisodeRow]], None], begin: Callable[[Job], bool]
    ) -> None:
        """Run all jobs; see `evaluate.Runner`."""
        for job in jobs:
            if begin(job):
                ended([self.row(job)])

    def row(self, job: Job) -> EpisodeRow:
        """The row of a job, with the reason where its episode fails."""
        try:
            return self.run(job)
        except Exception as error:  # Whatever fails in one episode must not end the run.
            return job.failed_by(error)

    def run(self, job: Job) -> EpisodeRow:
        """Run one episode.

        Raises:
          InputError: the method cannot be used.
        """
        method, scenario = job.method, job.scenario
        workcell = method.workcell
        target = target_of(scenario, workcell.target)
        episode = run_episode(
            Start(scenario, job.seed, mismatch=method.mismatch),
            self._problem(workcell, target, method.config.problem),
            self._policy(method),
            self._simulator(workcell),
            run_settings(method, target),
        )
        return EpisodeRow.of_episode(episode, present_code())


def run_settings(method: Method, target: Target) -> RunSettings:
    """How an episode of a method is run, alone and for rows.

    Raises:
      InputError: its recogniser lacks weights, or trials cannot be made.
    """
    return RunSettings(
        recogniser=method.recogniser(target),
        max_steps=method.config.max_steps,
        options=method.options(),
        trials=method.trials(),
    )


def _simulator(workcell: Workcell) -> NativeSimulator:
    return NativeSimulator(shelf=workcell.shelf, camera=workcell.camera)
