"""Episodes in the workers of a Ray cluster: on the machines that it has, or on this one.

A worker is an actor that Ray places: it has a share of a machine's CPUs and runs one episode after the other, as a
process of `processes` does, or it has a GPU and runs batches, as `batches` does. It is sent chunks of jobs, their
scenarios with them, and yields rows as episodes end. What a worker had not brought to its end when it died is run
again: Ray's own retries would run the whole chunk again.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

from mechsearch_jax.benchmarks.running.cluster_workers import Kind, Place, Worker
from mechsearch_jax.benchmarks.running.evaluate import Job, present_code
from mechsearch_jax.benchmarks.store.rows import EpisodeRow, episode_key
from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.runtime.errors import InputError

# Starts a Ray of its own on this machine.
LOCAL = "local"
# Finds the Ray that runs on this machine.
AUTO = "auto"
# So many workers that die of the same jobs, or while they start, say that it is not by chance.
MOST_DEATHS = 3
# How long a cluster's machine may take to answer [s].
PATIENCE = 10.0
# How often it is looked whether a worker has taken too long [s].
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
            # Ray would report its use to its makers.
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


class _Chunk(NamedTuple):
    """Jobs that are sent to a worker together.

    Attributes:
      jobs: none where a worker starts.
      begun: whether they have been begun before.
      deaths: how many workers died of them.
    """

    jobs: tuple[Job, ...]
    begun: bool = False
    deaths: int = 0


@dataclass
class _Busy:
    """A worker that is at a chunk, or starts.

    Attributes:
      actor: the worker, as Ray knows it.
      chunk: what it was sent.
      left: the jobs that have no row yet, by their keys.
      since: when it was sent the chunk, or gave rows last; as `time.monotonic` has it.
    """

    actor: Any
    chunk: _Chunk
    left: dict[str, Job]
    since: float


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
        self, jobs: Sequence[Job], ended: Callable[[Sequence[EpisodeRow]], None], begin: Callable[[Job], bool]
    ) -> None:
        """Run all jobs; see `evaluate.Runner`.

        Raises:
          InputError: there is no cluster, its machines have no room, or no worker can be started.
          Exception: whatever a batch failed with that is no episode's fault; see `batches.Batches`.
        """
        place = self.kind.place(join(self.address))
        run = _Run(self.kind, place, self.kind.chunks(jobs, place.workers), ended, begin)
        try:
            complaint = run.until_over()
        finally:
            run.stop()
        if complaint:
            raise InputError(f"Ray at {self.address}: no worker can be started ({complaint})")


class _Run:
    """The workers of a run, and what is still to be sent to them."""

    def __init__(
        self,
        kind: Kind,
        place: Place,
        chunks: Sequence[Sequence[Job]],
        ended: Callable[[Sequence[EpisodeRow]], None],
        begin: Callable[[Job], bool],
    ) -> None:
        self._ray = import_ray()
        self._kind, self._place, self._ended, self._begin = kind, place, ended, begin
        self._todo = deque(_Chunk(tuple(chunk)) for chunk in chunks)
        self._idle: list[Any] = []
        # By the stream that their rows come in.
        self._busy: dict[Any, _Busy] = {}
        # Why a worker could not be started, last.
        self._complaint = ""

    def until_over(self) -> str:
        """Run all chunks; why some are left, where no worker can be started for them.

        Raises:
          Exception: what a worker failed with, if it is no episode's fault.
        """
        for _ in range(min(self._place.workers, len(self._todo))):
            self._start(_Chunk(()))
        while self._todo or any(worker.chunk.jobs for worker in self._busy.values()):
            while self._idle and (chunk := self._next()):
                self._send(self._idle.pop(), chunk)
            if not self._busy:
                break
            streams, _ = self._ray.wait(list(self._busy), num_returns=1, timeout=LOOK_EVERY)
            for stream in streams:
                self._receive(stream, self._busy.pop(stream))
            self._end_what_hangs()
        return self._complaint if self._todo else ""

    def stop(self) -> None:
        """End all workers, whatever they are doing."""
        for actor in (*self._idle, *(worker.actor for worker in self._busy.values())):
            self._ray.kill(actor)

    def _start(self, chunk: _Chunk) -> None:
        """Start a worker; the chunk is an empty one, and is over when the worker is up."""
        # What this process can import, a user's policy among it, its workers can, where they have the same folders.
        importable = os.pathsep.join(os.path.abspath(folder) for folder in sys.path)
        environment = {**self._place.environment, "PYTHONPATH": importable}
        options = {**self._place.resources, "runtime_env": {"env_vars": environment}}
        self._send(self._ray.remote(Worker).options(**options).remote(self._kind, present_code()), chunk)

    def _send(self, actor: Any, chunk: _Chunk) -> None:
        stream = actor.run.options(num_returns="streaming").remote(chunk.jobs)
        self._busy[stream] = _Busy(actor, chunk, {job.key: job for job in chunk.jobs}, time.monotonic())

    def _next(self) -> _Chunk | None:
        """The next chunk, without the jobs that are not to be run; None where there is none."""
        while self._todo:
            chunk = self._todo.popleft()
            if not chunk.begun:
                chunk = _Chunk(tuple(filter(self._begin, chunk.jobs)), begun=True)
            if chunk.jobs:
                return chunk
        return None

    def _receive(self, stream: Any, worker: _Busy) -> None:
        """Take what a worker gave: rows, that it is done, or that it died.

        Raises:
          Exception: what it failed with, if it is no episode's fault.
        """
        errors = self._ray.exceptions
        try:
            rows: Sequence[EpisodeRow] = self._ray.get(next(stream))
        except StopIteration:
            self._idle.append(worker.actor)
            return
        except errors.RayTaskError as error:
            self._idle.append(worker.actor)
            raise error.cause if isinstance(error.cause, InputError) else error from None
        except errors.RayError as error:
            self._bury(worker, _one_line(error))
            return
        self._busy[stream] = worker
        worker.since = time.monotonic()
        for row in rows:
            worker.left.pop(episode_key(row), None)
        self._ended(rows)

    def _bury(self, worker: _Busy, reason: str) -> None:
        """Start another worker for one that died, and put back what it had not brought to its end."""
        chunk, left = worker.chunk, tuple(worker.left.values())
        deaths = chunk.deaths + 1 if len(left) == len(chunk.jobs) else 1
        if not chunk.jobs and deaths == MOST_DEATHS:
            self._complaint = reason
            return
        self._start(_Chunk((), deaths=0 if chunk.jobs else deaths))
        if left and deaths == MOST_DEATHS:
            self._ended([job.failed(f"{deaths} workers died of it, the last one so: {reason}") for job in left])
            return
        half = (len(left) + 1) // 2
        self._todo.extendleft(_Chunk(part, True, deaths) for part in (left[half:], left[:half]) if part)

    def _end_what_hangs(self) -> None:
        """Kill workers that take too long, and start others."""
        limit = self._kind.time_limit
        now = time.monotonic()
        for stream, worker in list(self._busy.items()):
            if limit is not None and worker.left and now - worker.since > limit:
                del self._busy[stream]
                self._ray.kill(worker.actor)
                self._start(_Chunk(()))
                reason = f"it took longer than {limit:g} s, and its worker was killed"
                self._ended([job.failed(reason) for job in worker.left.values()])


def _one_line(error: BaseException) -> str:
    """The last line of a message, without colours: in those of Ray it says why."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
    lines = [" ".join(line.split()) for line in plain.splitlines() if line.strip()]
    return (lines or [type(error).__name__])[-1][:300]
