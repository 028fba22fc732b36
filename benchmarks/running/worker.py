"""One worker process of `evaluate`: reads jobs from its input, one JSON line each, and answers with one line each.

It is started as `python -m mechsearch_jax.benchmarks.running.worker` and ends when its input does, such as when what
started it was killed.
"""

from __future__ import annotations

import functools
import json
import os
import queue
import sys
import threading
from collections.abc import Iterable, Iterator
from typing import TextIO

from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.benchmarks.store.rows import Row
from mechsearch_jax.envs.camera.recognisers import recogniser
from mechsearch_jax.envs.episode.episodes import run_episode, target_of
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.problem.cache import keep_compilations
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.workspace.scenario import Scenario, load_scenario


class Worker:
    """Runs episodes, and keeps what does not change between them."""

    def __init__(self) -> None:
        self._simulator = functools.cache(_simulator)
        self._problem = functools.cache(Workcell.problem)
        self._policy = functools.cache(Method.policy)

    def run(self, path: str, method: Method, seed: int) -> Row:
        """Run one episode of a scenario file.

        Raises:
          InputError: the file is no scenario, or the method cannot be used.
        """
        return self.run_scenario(load_scenario(path, method.workcell.shelf), method, seed)

    def run_scenario(self, scenario: Scenario, method: Method, seed: int) -> Row:
        """Run one episode of a scenario.

        Raises:
          InputError: the method cannot be used.
        """
        workcell = method.workcell
        target = target_of(scenario, workcell.target)
        episode = run_episode(
            seed,
            scenario,
            self._problem(workcell, target, method.problem_config),
            self._policy(method),
            self._simulator(workcell),
            recogniser(method.recognition, target),
            method.config.max_steps,
            method.options(),
            protocol=method.terms,
            trials=method.trials(),
        )
        return Row.of_episode(episode, present_code())


def _simulator(workcell: Workcell) -> NativeSimulator:
    return NativeSimulator(shelf=workcell.shelf, camera=workcell.camera)


def until_closed(stream: TextIO) -> Iterator[str]:
    """The lines of a stream, read ahead. When it ends the process does, whatever it is doing: nobody waits for it."""
    waiting: queue.SimpleQueue[str] = queue.SimpleQueue()

    def read() -> None:
        for line in stream:
            waiting.put(line)
        os._exit(0)

    threading.Thread(target=read, daemon=True).start()
    while True:
        yield waiting.get()


def serve(jobs: Iterable[str], answers: TextIO) -> None:
    """Answer every job with its row, or with the reason why there is none."""
    worker = Worker()
    for line in jobs:
        job = json.loads(line)
        try:
            row = worker.run(job["path"], Method.from_json(job["method"]), job["seed"])
            answer = {"row": vars(row)}
        except Exception as error:  # Whatever fails in one episode must not end the run.
            answer = {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"[:500]}
        print(json.dumps(answer), file=answers, flush=True)


def main() -> None:
    """Serve on the standard streams. What libraries print goes to standard error, so that answers stay clean."""
    # Before anybody changes it: what is imported from here on is taken for it.
    present_code()
    keep_compilations()
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    serve(until_closed(sys.stdin), answers)


if __name__ == "__main__":
    main()
