"""Episodes in the workers of a Ray cluster: on the machines that it has, or on this one.

A worker has a share of a machine's CPUs and runs one episode after the other, as a process of `processes` does, or it
has a GPU and runs batches, as `batches` does. It is sent chunks of jobs, their scenarios with them, and sends rows back
as episodes end. What a worker had not brought to its end when it died is run again, by whichever worker is free.
"""

from __future__ import annotations

import logging
import os
import queue
import re
import socket
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

from mechsearch_jax.benchmarks.running.cluster_workers import Host, Kind, Place
from mechsearch_jax.benchmarks.running.evaluate import Job, present_code
from mechsearch_jax.benchmarks.store.rows import Row, episode_key
from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.runtime.errors import InputError

# Starts a Ray of its own on this machine.
LOCAL = "local"
# Finds the Ray that runs on this machine.
AUTO = "auto"
# So many workers that die of the same jobs, or while they start, say that it is not by chance.
MOST_DEATHS = 3
# How long a cluster's machine may take to answer, and a worker's thread here to end [s].
PATIENCE = 10.0
# How often it is looked whether what waits for a worker still has to [s].
LOOK_EVERY = 0.5
# Rows are small, and what nobody needs is taken from this machine's memory [bytes].
OBJECT_STORE = 100_000_000


def import_ray() -> ModuleType:
    """The library.

    Raises:
      InputError: it is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise InputError(
            f"a cluster needs the library ray ({error}); install it with: pip install 'mechsearch-jax[ray]'"
        ) from None
    return ray


def join(address: str = LOCAL) -> list[Mapping[str, float]]:
    """Join a Ray cluster, unless this process is in one already; it stays in it until it ends.

    Args:
      address: "HOST:PORT" of its first machine; or `AUTO`, or `LOCAL`.

    Returns:
      What each of its machines has: "CPU", and "GPU" where there are any.

    Raises:
      InputError: Ray is not installed, or there is no cluster at the address.
    """
    ray = import_ray()
    if not ray.is_initialized():
        _check(address)
        options: dict[str, Any] = {"address": address}
        if address == LOCAL:
            # Nothing is told to anybody who was not asked for.
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            options |= {"num_cpus": cores(), "object_store_memory": OBJECT_STORE, "include_dashboard": False}
        try:
            ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(
                f'Ray at {address}: {_one_line(error).rstrip(".")}; how to start it: docs/gpu.md, "Several machines"'
            ) from error
    return [node["Resources"] for node in ray.nodes() if node["Alive"]]


def _check(address: str) -> None:
    """Refuse an address where nobody answers: Ray would wait for minutes, and then end the process."""
    if address in (LOCAL, AUTO):
        return
    host, _, port = address.rpartition(":")
    if not re.fullmatch(r"[\w.-]+|\[[\da-fA-F:.]+\]", host) or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputError(f"Ray at {address}: is not HOST:PORT; give it as ray start tells it")
    try:
        socket.create_connection((host.strip("[]"), int(port)), PATIENCE).close()
    except OSError as error:
        raise InputError(
            f"Ray at {address}: cannot be reached ({error.strerror or error}); is it running there (ray start --head)?"
        ) from None


@dataclass(frozen=True)
class RayCluster:
    """Runs jobs in the workers of a Ray cluster, whose machines have this version of the package.

    Rows are those of a run on this machine, as far as the simulator repeats itself. A chunk whose worker died is run
    again in halves, without what had ended; after `MOST_DEATHS` workers that died of it without a row, its jobs get
    rows with the reason.

    Attributes:
      kind: of the workers.
      address: of the cluster; see `join`.
    """

    kind: Kind
    address: str = LOCAL

    def __call__(
        self, jobs: Sequence[Job], ended: Callable[[Sequence[Row]], None], begin: Callable[[Job], bool]
    ) -> None:
        """Run all jobs; see `evaluate.Runner`.

        Raises:
          InputError: there is no cluster, its machines have no room, or no worker can be started.
          Exception: whatever a batch failed with that is no episode's fault; see `batches.Batches`.
        """
        place = self.kind.place(join(self.address))
        chunks = self.kind.chunks(jobs, place.workers)
        results: queue.SimpleQueue[_Result] = queue.SimpleQueue()
        todo = _Todo(_Chunk(tuple(chunk)) for chunk in chunks)
        feeders = [_Feeder(self.kind, place, todo, results, begin) for _ in range(min(place.workers, len(chunks)))]
        try:
            for feeder in feeders:
                feeder.start()
            left, useless = len(jobs), 0
            while left:
                result = results.get()
                if isinstance(result, _CannotStart):
                    useless += 1
                    if useless == len(feeders):
                        raise InputError(f"Ray at {self.address}: no worker can be started ({result})")
                    continue
                if isinstance(result, BaseException):
                    raise result
                left -= len(result)
                rows = [row for row in result if row is not None]
                if rows:
                    ended(rows)
        finally:
            todo.close()
            for feeder in feeders:
                feeder.stop()
            for feeder in feeders:
                feeder.join(PATIENCE)


class _CannotStart(Exception):
    """A worker could not be started, several times."""


# Of jobs that are over: their rows, None for one that was not to be run.
_Result = Sequence[Row | None] | BaseException


class _Chunk(NamedTuple):
    """Jobs that are sent to a worker together.

    Attributes:
      jobs: one or more.
      begun: whether they have been begun before.
      deaths: how many workers died of them.
    """

    jobs: tuple[Job, ...]
    begun: bool = False
    deaths: int = 0


class _Todo:
    """The chunks that nobody runs, and how many somebody runs, of which some may come back."""

    def __init__(self, chunks: Iterable[_Chunk]) -> None:
        self._chunks, self._running, self._closed = deque(chunks), 0, False
        self._changed = threading.Condition()

    def wait(self) -> bool:
        """Wait for a chunk. False where none will come."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._chunks or not self._running)
            return bool(self._chunks) and not self._closed

    def take(self) -> _Chunk | None:
        """A chunk to run, for which `over` has to be called; None if somebody else was faster."""
        with self._changed:
            if not self._chunks:
                return None
            self._running += 1
            return self._chunks.popleft()

    def over(self, again: Sequence[_Chunk]) -> None:
        """Take note that a chunk is over, but for those that are to be run again."""
        with self._changed:
            self._running -= 1
            self._chunks.extendleft(reversed(again))
            self._changed.notify_all()

    def close(self) -> None:
        """There is nothing more to do."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class _Feeder(threading.Thread):
    """Feeds one worker with chunks, and starts another one if it dies."""

    def __init__(
        self,
        kind: Kind,
        place: Place,
        todo: _Todo,
        results: queue.SimpleQueue[_Result],
        begin: Callable[[Job], bool],
    ) -> None:
        """Args:
        kind: of the worker.
        place: where it is.
        todo: where chunks are taken from.
        results: where what becomes of jobs is put, or an error that ends the run.
        begin: see `evaluate.Runner`.
        """
        super().__init__(daemon=True)
        self._ray = import_ray()
        self._kind, self._place, self._todo, self._results, self._begin = kind, place, todo, results, begin
        self._host: Any = None
        self._stopped = False
        self._starting = threading.Lock()

    def run(self) -> None:
        try:
            # A chunk is taken when a worker is there: on a busy cluster another one may be long before.
            while self._todo.wait() and self._has_host():
                chunk = self._todo.take()
                if chunk is not None:
                    self._todo.over(self._run(self._begun(chunk)))
        except BaseException as error:
            if not self._stopped:
                self._results.put(error)

    def stop(self) -> None:
        """End the worker, whatever it is doing."""
        with self._starting:
            self._stopped = True
            self._end()

    def _end(self) -> None:
        host, self._host = self._host, None
        if host is not None:
            self._ray.kill(host)

    def _has_host(self) -> bool:
        """Start a worker, if there is none, and wait until it is up. False if this was stopped.

        Raises:
          _CannotStart: it died `MOST_DEATHS` times while it started.
        """
        deaths = 0
        while self._host is None:
            with self._starting:
                if self._stopped:
                    return False
                self._host = host = self._start()
            try:
                # One that is killed while it starts may not say so for long.
                up = host.started.remote()
                while not self._stopped and not self._ray.wait([up], timeout=LOOK_EVERY)[0]:
                    pass
                if not self._stopped:
                    self._ray.get(up)
            except self._ray.exceptions.RayError as error:
                self._host = None
                deaths += 1
                if deaths == MOST_DEATHS and not self._stopped:
                    raise _CannotStart(_one_line(error)) from error
        return not self._stopped

    def _start(self) -> Any:
        # What this process can import, a user's policy among it, its workers can, where they have the same folders.
        importable = os.pathsep.join(os.path.abspath(folder) for folder in sys.path)
        environment = {**self._place.environment, "PYTHONPATH": importable}
        options = {**self._place.resources, "runtime_env": {"env_vars": environment}}
        return self._ray.remote(Host).options(**options).remote(self._kind)

    def _begun(self, chunk: _Chunk) -> _Chunk:
        """A chunk without the jobs that are not to be run."""
        if chunk.begun:
            return chunk
        jobs = tuple(job for job in chunk.jobs if self._begin(job))
        if len(jobs) < len(chunk.jobs):
            self._results.put([None] * (len(chunk.jobs) - len(jobs)))
        return _Chunk(jobs, begun=True)

    def _run(self, chunk: _Chunk) -> Sequence[_Chunk]:
        """Run a chunk; what is to be run again.

        Raises:
          Exception: what its worker failed with, if it is no episode's fault.
        """
        waiting = {job.key: job for job in chunk.jobs}
        if not waiting:
            return []
        errors = self._ray.exceptions
        try:
            self._feed(waiting)
        except errors.GetTimeoutError:
            self._end()
            key, job = next(iter(waiting.items()))
            del waiting[key]
            limit = self._kind.time_limit
            self._results.put([job.failed(f"it took longer than {limit:g} s, and its worker was killed")])
            return [_Chunk(tuple(waiting.values()), begun=True)] if waiting else []
        except errors.RayTaskError as error:
            raise error.cause if isinstance(error.cause, InputError) else error from None
        except errors.RayError as error:
            self._end()
            return self._died(tuple(waiting.values()), chunk, _one_line(error))
        return []

    def _feed(self, waiting: dict[str, Job]) -> None:
        """Have jobs run by the worker, and drop each when it has a row."""
        host, get = self._host, self._ray.get
        get(host.begin.remote(list(waiting.values())))
        strange = "the worker gave no row of it"
        while (rows := get(host.more.remote(), timeout=self._kind.time_limit)) is not None:
            told: list[Row] = []
            for row in rows:
                if row.code != present_code():
                    strange = f"the worker ran other code: {row.code}"
                elif episode_key(row) in waiting:
                    told.append(row)
            self._put(waiting, told)
        self._put(waiting, [job.failed(strange) for job in waiting.values()])

    def _put(self, waiting: dict[str, Job], rows: Sequence[Row]) -> None:
        # Those are over that are told of, and no others: it may be stopped in between.
        for row in rows:
            del waiting[episode_key(row)]
        self._results.put(rows)

    def _died(self, jobs: tuple[Job, ...], chunk: _Chunk, reason: str) -> Sequence[_Chunk]:
        """What of a chunk is to be run again after its worker died; there are rows of the others."""
        deaths = 1 + (chunk.deaths if len(jobs) == len(chunk.jobs) else 0)
        if deaths == MOST_DEATHS:
            self._results.put([job.failed(f"{deaths} workers died of it, the last one so: {reason}") for job in jobs])
            return []
        half = (len(jobs) + 1) // 2
        return [_Chunk(part, True, deaths) for part in (jobs[:half], jobs[half:]) if part]


def _one_line(error: BaseException) -> str:
    """The last line of a message, without colours: in those of Ray it says why."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
    lines = [" ".join(line.split()) for line in plain.splitlines() if line.strip()]
    return (lines or [type(error).__name__])[-1][:300]
