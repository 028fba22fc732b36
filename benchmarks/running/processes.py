"""Episodes one after the other in several worker processes.

Workers are separate programs with one thread each, and their share of the cores for pushes that they simulate: on a
machine with few cores and no GPU this is faster than sharing all threads, and a worker that dies, or hangs and is
killed, takes one episode with it, not the run.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence

from mechsearch_jax.benchmarks.running.evaluate import Job, present_code
from mechsearch_jax.benchmarks.store.rows import Row, identity
from mechsearch_jax.runtime.cores import share_of_cores

WORKER = (sys.executable, "-m", "mechsearch_jax.benchmarks.running.worker")
# An episode takes seconds, the first of a worker minutes for compilations [s].
TIME_LIMIT = 3600.0
# Several processes cannot share a GPU's memory, of which the first takes most.
ENVIRONMENT = {
    "PJRT_NPROC": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
}


@dataclasses.dataclass(frozen=True)
class Processes:
    """Runs jobs on the CPU, in the native simulator.

    Attributes:
      workers: number of processes.
      time_limit: seconds after which an episode, with its compilations, is taken to hang; its worker is killed and
        replaced.
      command: starts a worker; only tests have another one.
    """

    workers: int
    time_limit: float = TIME_LIMIT
    command: Sequence[str] = WORKER

    def __call__(
        self, jobs: Sequence[Job], ended: Callable[[Sequence[Row]], None], begin: Callable[[Job], bool]
    ) -> None:
        """Run all jobs; see `evaluate.Runner`."""
        todo: queue.SimpleQueue[Job] = queue.SimpleQueue()
        for job in jobs:
            todo.put(job)
        results: queue.SimpleQueue[Row | Exception | None] = queue.SimpleQueue()
        count = min(self.workers, len(jobs))
        feeders = [_Feeder(self, todo, results, begin, share_of_cores(count)) for _ in range(count)]
        try:
            for feeder in feeders:
                feeder.start()
            for _ in jobs:
                result = results.get()
                if isinstance(result, Exception):
                    raise result
                if result is not None:
                    ended([result])
        finally:
            for feeder in feeders:
                feeder.stop()


class _Feeder(threading.Thread):
    """Feeds one worker process with jobs, and starts another one if it dies."""

    def __init__(
        self,
        pool: Processes,
        todo: queue.SimpleQueue[Job],
        results: queue.SimpleQueue[Row | Exception | None],
        begin: Callable[[Job], bool],
        environment: Mapping[str, str],
    ):
        """Args:
        pool: that it is of.
        todo: where it takes jobs from.
        results: where it puts a row for each; None for one that is not to be run, an error of the parent instead.
        begin: see `evaluate.Runner`.
        environment: variables of the worker, beside `ENVIRONMENT`.
        """
        super().__init__(daemon=True)
        self._pool, self._todo, self._results, self._begin = pool, todo, results, begin
        # What this process can import, a user's policy among it, its workers can.
        importable = os.pathsep.join(folder for folder in sys.path if folder)
        self._environment = {**ENVIRONMENT, **environment, "PYTHONPATH": importable}
        self._process: subprocess.Popen[str] | None = None
        self._complaints = tempfile.TemporaryFile()  # noqa: SIM115  (lives as long as the workers)
        self._stopped = False

    def run(self) -> None:
        while not self._stopped:
            try:
                job = self._todo.get_nowait()
            except queue.Empty:
                return
            # Were nothing put for a job, it would be waited for for ever.
            try:
                begun = self._begin(job)
            except Exception as error:
                self._results.put(error)
                return
            self._results.put(self._row(job) if begun else None)

    def _row(self, job: Job) -> Row:
        """The row of a job, whatever becomes of it."""
        try:
            return self._run(job)
        except Exception as error:
            return job.failed_by(error)

    def stop(self) -> None:
        """End the worker, whatever it is doing."""
        self._stopped = True
        if self._process is not None:
            _kill(self._process)

    def _run(self, job: Job) -> Row:
        process = self._process
        if process is None or process.poll() is not None:
            process = self._process = self._start()
        assert process.stdin is not None
        assert process.stdout is not None
        question = {"path": job.path, "method": job.method.to_json(), "seed": job.seed}
        hangs = threading.Event()

        def end_it() -> None:
            hangs.set()
            _kill(process)

        limit = threading.Timer(self._pool.time_limit, end_it)
        limit.start()
        try:
            process.stdin.write(json.dumps(question) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        finally:
            limit.cancel()
            limit.join()
        if hangs.is_set():
            self._process = None
            return job.failed(f"it took longer than {self._pool.time_limit:g} s, and its worker was killed")
        if not line:
            return job.failed(f"the worker process ended with status {process.wait()}{self._last_words()}")
        answer = json.loads(line)
        if "row" not in answer:
            return job.failed(answer["error"])
        row = Row(**answer["row"])
        if row.code != present_code():
            return job.failed(f"the worker ran other code: {row.code}")
        if identity(row) != identity(job.failed("")):
            return job.failed("the worker ran another episode than was asked for: other options, or a changed file")
        return row

    def _start(self) -> subprocess.Popen[str]:
        self._complaints.seek(0)
        self._complaints.truncate()
        # In a session of its own, an interrupt from the keyboard reaches only the parent, which then ends the worker.
        return subprocess.Popen(
            self._pool.command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complaints,
            text=True,
            env={**os.environ, **self._environment},
            start_new_session=True,
        )

    def _last_words(self) -> str:
        """The last line that a dead worker wrote to standard error."""
        self._complaints.seek(0)
        lines = self._complaints.read().decode(errors="replace").split("\n")
        return next((f": {line.strip()[:300]}" for line in reversed(lines) if line.strip()), "")


def _kill(process: subprocess.Popen[str]) -> None:
    """End a worker and what it started, which may hold its streams open; it leads a process group of its own."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
