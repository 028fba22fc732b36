"""Many scenarios, methods and seeds, one episode after the other in several worker processes.

The table is written anew after every episode, so that a run that was killed goes on where it stopped. Workers are
separate programs with one thread each: on a machine with few cores this is faster than sharing all threads, and a
worker that dies takes one episode with it, not the run.
"""

from __future__ import annotations

import dataclasses
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from mechsearch_jax.errors import InputError
from mechsearch_jax.files import PathLike
from mechsearch_jax.planner import PlannerConfig
from mechsearch_jax.results import Row, configuration, identity, read_rows, write_rows
from mechsearch_jax.scenario import Scenario, load_scenario

SINGLE_THREAD = {
    "PJRT_NPROC": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}
RECOGNITION = "oracle"
SIMULATOR = "NativeSimulator"


@dataclasses.dataclass(frozen=True)
class Job:
    """One episode to run.

    Attributes:
      path: file of the scenario.
      scenario: what is in it.
      config: the planner's options.
      seed: of the episode.
    """

    path: str
    scenario: Scenario
    config: PlannerConfig
    seed: int

    def failed(self, reason: str) -> Row:
        """The row of an episode that could not be run to its end."""
        return Row(
            scenario=self.scenario.name,
            objects=len(self.scenario.objects),
            target=self.scenario.target.shape,
            method=self.config.method,
            recognition=RECOGNITION,
            gamma=self.config.gamma,
            horizon=self.config.horizon,
            sequences=self.config.sequences,
            actions=self.config.actions,
            seed=self.seed,
            found_step=None,
            graspable_step=None,
            retrieved=False,
            steps=0,
            failure=f"error: {reason}",
            planning_seconds=0.0,
            simulation_seconds=0.0,
            configuration=self.configuration,
        )

    @property
    def configuration(self) -> str:
        """As in the row of the episode."""
        options = {**dataclasses.asdict(self.config), "recognition": RECOGNITION, "simulator": SIMULATOR}
        return configuration(options)


def make_jobs(files: Sequence[PathLike], configs: Sequence[PlannerConfig], seeds: Sequence[int]) -> list[Job]:
    """All combinations of scenario files, configurations and seeds.

    Raises:
      InputError: a file is not a scenario, or two of them have the same name.
    """
    jobs: list[Job] = []
    names: dict[str, str] = {}
    for file in files:
        path = str(Path(file).resolve())
        scenario = load_scenario(file)
        if scenario.name in names:
            raise InputError(
                f"{file}: has the name {scenario.name!r} as {names[scenario.name]} has; rename one of them"
            )
        names[scenario.name] = str(file)
        jobs += [Job(path, scenario, config, seed) for config in configs for seed in seeds]
    return jobs


def evaluate(
    jobs: Sequence[Job],
    out: PathLike,
    workers: int,
    ended: Callable[[Row, Sequence[Row]], None] = lambda row, rows: None,
    command: Sequence[str] | None = None,
) -> list[Row]:
    """Run the jobs that the table at `out` does not hold yet, and add each as its episode ends.

    Args:
      jobs: what is wanted.
      out: the Parquet file; rows that it holds already are kept, and stand for a job only if every option was the
        same. (Files of version 0.1.0 do not hold every option: their rows are kept, but run again.)
      workers: number of processes.
      ended: called after every episode with its row and with all rows.
      command: starts a worker; only tests have another one.

    Returns:
      The rows of all jobs, in the order of the jobs.

    Raises:
      InputError: the table is there, but not one of episodes, or it cannot be written.
    """
    rows = read_rows(out) if Path(out).exists() else []
    done = {identity(row) for row in rows}
    missing = [job for job in jobs if identity(job.failed("")) not in done]
    write_rows(rows, out)

    todo: queue.SimpleQueue[Job] = queue.SimpleQueue()
    for job in missing:
        todo.put(job)
    results: queue.SimpleQueue[Row] = queue.SimpleQueue()
    crew = [_Crew(todo, results, command or WORKER) for _ in range(min(workers, len(missing)))]
    try:
        for member in crew:
            member.start()
        for _ in missing:
            row = results.get()
            rows.append(row)
            write_rows(rows, out)
            ended(row, rows)
    finally:
        for member in crew:
            member.stop()
    by_identity = {identity(row): row for row in rows}
    return [by_identity[identity(job.failed(""))] for job in jobs]


WORKER = (sys.executable, "-m", "mechsearch_jax.benchmarks.worker")


class _Crew(threading.Thread):
    """Feeds one worker process with jobs, and starts another one if it dies."""

    def __init__(self, todo: queue.SimpleQueue[Job], results: queue.SimpleQueue[Row], command: Sequence[str]):
        super().__init__(daemon=True)
        self._todo = todo
        self._results = results
        self._command = command
        self._process: subprocess.Popen[str] | None = None
        self._complaints = tempfile.TemporaryFile()  # noqa: SIM115  (lives as long as the workers)
        self._stopped = False

    def run(self) -> None:
        while not self._stopped:
            try:
                job = self._todo.get_nowait()
            except queue.Empty:
                return
            self._results.put(self._run(job))

    def stop(self) -> None:
        """End the worker, whatever it is doing."""
        self._stopped = True
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def _run(self, job: Job) -> Row:
        process = self._process
        if process is None or process.poll() is not None:
            process = self._process = self._start()
        assert process.stdin is not None
        assert process.stdout is not None
        question = {"path": job.path, "config": dataclasses.asdict(job.config), "seed": job.seed}
        try:
            process.stdin.write(json.dumps(question) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            return job.failed(f"the worker process ended with status {process.wait()}{self._last_words()}")
        answer = json.loads(line)
        if "row" not in answer:
            return job.failed(answer["error"])
        row = Row(**answer["row"])
        if identity(row) != identity(job.failed("")):
            return job.failed("the worker ran the episode with other options than those asked for")
        return row

    def _start(self) -> subprocess.Popen[str]:
        self._complaints.seek(0)
        self._complaints.truncate()
        # In a session of its own, an interrupt from the keyboard reaches only the parent, which then ends the worker.
        return subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complaints,
            text=True,
            env={**os.environ, **SINGLE_THREAD},
            start_new_session=True,
        )

    def _last_words(self) -> str:
        """The last line that a dead worker wrote to standard error."""
        self._complaints.seek(0)
        lines = self._complaints.read().decode(errors="replace").split("\n")
        return next((f": {line.strip()[:300]}" for line in reversed(lines) if line.strip()), "")
