"""One worker process of `evaluate`: reads jobs from its input, one JSON line each, and answers with one line each.

It is started as `python -m mechsearch_jax.benchmarks.worker` and ends when its input does.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from typing import Any, TextIO

from mechsearch_jax.benchmarks.rows import Row
from mechsearch_jax.cache import keep_compilations, kept_problem
from mechsearch_jax.envs.episode import row as row_of
from mechsearch_jax.envs.episode import run_episode, target_of
from mechsearch_jax.envs.recognisers import RecognitionName, recogniser
from mechsearch_jax.envs.simulator import NativeSimulator
from mechsearch_jax.planner import PlannerConfig, Problem
from mechsearch_jax.workspace.scenario import load_scenario
from mechsearch_jax.workspace.target import Target


class Worker:
    """Runs episodes, and keeps what does not change between them."""

    def __init__(self) -> None:
        self._problems: dict[Target, Problem] = {}
        self._simulator = NativeSimulator()

    def run(self, path: str, config: PlannerConfig, seed: int, recognition: RecognitionName) -> Row:
        """Run one episode of a scenario file."""
        scenario = load_scenario(path)
        target = target_of(scenario)
        if target not in self._problems:
            self._problems[target] = kept_problem(target)
        eyes = recogniser(recognition, target)
        episode = run_episode(seed, scenario, self._problems[target], config, self._simulator, eyes, recognition)
        return row_of(episode)


def parse_config(value: dict[str, Any]) -> PlannerConfig:
    """A configuration that went through JSON."""
    return PlannerConfig(**{**value, "push_distances": tuple(value["push_distances"])})


def serve(jobs: TextIO, answers: TextIO) -> None:
    """Answer every job with its row, or with the reason why there is none."""
    worker = Worker()
    for line in jobs:
        job = json.loads(line)
        try:
            answer = {
                "row": dataclasses.asdict(
                    worker.run(job["path"], parse_config(job["config"]), job["seed"], job["recognition"])
                )
            }
        except Exception as error:  # Whatever fails in one episode must not end the run.
            answer = {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"[:500]}
        print(json.dumps(answer), file=answers, flush=True)


def main() -> None:
    """Serve on the standard streams. What libraries print goes to standard error, so that answers stay clean."""
    keep_compilations()
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    serve(sys.stdin, answers)


if __name__ == "__main__":
    main()
