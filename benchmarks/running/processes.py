"""Episodes one after the other in several worker processes.

Workers are programs of their own with one thread each, and their share of the cores for pushes that they simulate: on a
machine with few cores and no GPU this is faster than sharing all threads, and a worker that dies, or hangs and is
killed, takes one episode with it, not the run. Pebble keeps the workers, in processes that loky starts: with an
environment of their own, and without the main module. Each is a pool of its own: the workers of a pool share a lock,
which one that is killed at the wrong moment would leave held for ever.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import loky.backend
import pebble

from mechsearch_jax.benchmarks.running.evaluate import Job, present_code
from mechsearch_jax.benchmarks.running.sequential import SequentialRunner
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.problem.cache import keep_compilations
from mechsearch_jax.runtime.cores import VARIABLE, share_of_cores
from mechsearch_jax.runtime.errors import InputError

# An episode takes seconds, the first of a worker minutes for compilations [s].
TIME_LIMIT = 3600.0
# Several processes cannot share a GPU's memory, of which the first takes most.
ENVIRONMENT = {
    "PJRT_NPROC": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
}
# So many workers in a row that end before they take a job say that none can be started.
MOST_DEATHS = 3
# How often a worker looks whether its parent is still there [s].
LOOK_EVERY = 1.0


def run_job(job: Job) -> EpisodeRow:
    """The row of a job, run in this process."""
    return _in_turn().row(job)


@functools.cache
def _in_turn() -> SequentialRunner:
    return SequentialRunner()


@dataclass(frozen=True)
class Processes:
    """Runs jobs on the CPU, in the native simulator.

    Attributes:
      workers: number of processes.
      time_limit: seconds after which an episode, with its compilations, is taken to hang; its worker is killed and
        replaced.
      run: what a worker does with a job; a function of a module.
      cores: of each worker; its share of this process's cores if None.
    """

    workers: int
    time_limit: float = TIME_LIMIT
    run: Callable[[Job], EpisodeRow] = run_job
    cores: int | None = None

    def __call__(
        self, jobs: Sequence[Job], ended: Callable[[Sequence[EpisodeRow]], None], begin: Callable[[Job], bool]
    ) -> None:
        """Run all jobs; see `evaluate.Runner`.

        Raises:
          InputError: no worker can be started.
        """
        count = min(self.workers, len(jobs))
        todo, again, deaths = filter(begin, jobs), list[Job](), 0
        with tempfile.TemporaryDirectory() as outputs, contextlib.ExitStack() as stack:
            share = share_of_cores(count) if self.cores is None else {VARIABLE: str(self.cores)}
            context = _context({**ENVIRONMENT, **share})

            def new_worker() -> pebble.ProcessPool:
                worker = pebble.ProcessPool(1, initializer=_begin, initargs=(outputs, os.getpid()), context=context)
                stack.callback(_end, worker)
                return worker

            idle = [new_worker() for _ in range(count)]
            running: dict[Future[EpisodeRow], tuple[pebble.ProcessPool, Job]] = {}
            while True:
                while idle and (job := again.pop() if again else next(todo, None)):
                    worker = idle.pop()
                    # A worker may have died since its last job.
                    worker = worker if worker.active else new_worker()
                    running[worker.schedule(self.run, (job,), timeout=self.time_limit)] = worker, job
                if not running:
                    return
                rows = []
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    worker, job = running.pop(future)
                    if isinstance(future.exception(), BrokenProcessPool):
                        deaths += 1
                        again.append(job)
                        idle.append(new_worker())
                    else:
                        deaths = 0
                        idle.append(worker)
                        rows.append(self._row(job, future, Path(outputs)))
                if rows:
                    ended(rows)
                if deaths >= MOST_DEATHS:
                    raise InputError(f"worker processes end while they start{_newest_line(Path(outputs))}")

    def _row(self, job: Job, future: Future[EpisodeRow], outputs: Path) -> EpisodeRow:
        """The row of a job that is over."""
        try:
            return future.result()
        except TimeoutError:
            return job.failed(f"it took longer than {self.time_limit:g} s, and its worker was killed")
        except pebble.ProcessExpired as error:
            reason = _last_line(outputs / str(error.pid))
            return job.failed(f"the worker process ended with status {error.exitcode}{reason}")
        except (Exception, SystemExit) as error:
            return job.failed_by(error)


def _end(worker: pebble.ProcessPool) -> None:
    worker.stop()
    worker.join()


def _context(environment: Mapping[str, str]) -> Any:
    """Starts processes with these variables, which no other process gets."""
    context: Any = copy.copy(loky.backend.get_context("loky"))
    context.Process = functools.partial(context.Process, env=dict(environment))
    return context


def _begin(outputs: str, parent: int) -> None:
    """Make this process a worker: what it prints goes into a file, and it ends with its parent whatever it is doing."""
    # A signal that Python handles waits until the library that computes returns.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    output = os.open(Path(outputs) / str(os.getpid()), os.O_WRONLY | os.O_CREAT)
    os.dup2(output, 1)
    os.dup2(output, 2)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    # Before anybody changes it: what is imported from here on is taken for it.
    present_code()
    keep_compilations()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_EVERY)
    os._exit(1)


def _last_line(output: Path) -> str:
    """The last line that a worker printed, after a colon; empty where there is none."""
    try:
        lines = output.read_text(errors="replace").split("\n")
    except OSError:
        return ""
    return next((f": {line.strip()[:300]}" for line in reversed(lines) if line.strip()), "")


def _newest_line(outputs: Path) -> str:
    """The last line of the worker that was the last to print anything; empty where none did."""
    files = sorted(outputs.iterdir(), key=lambda file: file.stat().st_mtime, reverse=True)
    return next((line for file in files if (line := _last_line(file))), "")
