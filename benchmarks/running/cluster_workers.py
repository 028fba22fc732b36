"""What the workers of a cluster are: one episode after the other on CPUs, or batches on a GPU.

What is here runs in the workers, or says where they are and what they are sent; `cluster` starts and feeds them.
"""

from __future__ import annotations

import math
import queue
import socket
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import jax

from mechsearch_jax.benchmarks.running.batches import MOST_WORLDS, Batches, groups
from mechsearch_jax.benchmarks.running.evaluate import Job, Runner, present_code
from mechsearch_jax.benchmarks.running.processes import ENVIRONMENT, TIME_LIMIT
from mechsearch_jax.benchmarks.running.sequential import SequentialRunner
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.problem.cache import keep_compilations
from mechsearch_jax.runtime.cores import VARIABLE
from mechsearch_jax.runtime.errors import InputError

# Episodes that a world gets of a chunk: the more, the smaller the part of the time in which worlds have nothing left.
MOST_IN_BATCHES = 4


class Place(NamedTuple):
    """Where the workers are.

    Attributes:
      workers: how many there are.
      resources: what each needs of its machine, as Ray's options name it.
      environment: variables of each.
    """

    workers: int
    resources: Mapping[str, float]
    environment: Mapping[str, str]


class Kind(Protocol):
    """A kind of workers; sent to each of them."""

    @property
    def time_limit(self) -> float | None:
        """Seconds without a row after which a worker's chunk is taken to hang; None for never."""
        ...

    def place(self, machines: Sequence[Mapping[str, float]]) -> Place:
        """Where to put workers on machines, as `join` returns them.

        Raises:
          InputError: they have no room.
        """
        ...

    def chunks(self, jobs: Sequence[Job], workers: int) -> list[Sequence[Job]]:
        """All jobs, in the chunks that are sent to workers, the first first."""
        ...

    def runner(self) -> Runner:
        """What runs a worker's chunks; made in the worker, once."""
        ...


@dataclass(frozen=True)
class OnCpus:
    """Workers that run one episode after the other, each on its share of a machine's CPUs, in the native simulator.

    Attributes:
      workers: how many; one for each CPU of the cluster if None.
      time_limit: as `processes.Processes` has it.
    """

    workers: int | None = None
    time_limit: float | None = TIME_LIMIT

    def place(self, machines: Sequence[Mapping[str, float]]) -> Place:
        """As large a share for each worker as leaves room for all of them."""
        cpus = [int(machine.get("CPU", 0)) for machine in machines]
        workers = self.workers or max(sum(cpus), 1)
        fitting = (n for n in range(max(cpus, default=0), 0, -1) if sum(count // n for count in cpus) >= workers)
        share = next(fitting, None)
        if share is None:
            raise InputError(f"the Ray cluster has {sum(cpus)} CPUs, too few for {workers} workers; ask for fewer")
        return Place(workers, {"num_cpus": share}, {**ENVIRONMENT, VARIABLE: str(share)})

    def chunks(self, jobs: Sequence[Job], workers: int) -> list[Sequence[Job]]:
        """Each job alone."""
        return [(job,) for job in jobs]

    def runner(self) -> Runner:
        """See `Kind`."""
        return SequentialRunner()


@dataclass(frozen=True)
class OnGpus:
    """Workers that run batches, one a GPU, in the simulator that the jobs name.

    Attributes:
      worlds: as `batches.Batches` has it.
    """

    worlds: int | None = None

    @property
    def time_limit(self) -> float | None:
        """None: what takes long in a batch cannot be told apart."""
        return None

    def place(self, machines: Sequence[Mapping[str, float]]) -> Place:
        """All GPUs that there are, each with its share of its machine's CPUs."""
        fitting = [machine for machine in machines if machine.get("GPU", 0) >= 1]
        if not fitting:
            raise InputError("the Ray cluster has no GPU for batches; run one episode after the other (--workers)")
        share = int(min(machine.get("CPU", 0) // machine["GPU"] for machine in fitting))
        return Place(
            sum(int(machine["GPU"]) for machine in fitting),
            {"num_gpus": 1, "num_cpus": min(share, 1)},
            {VARIABLE: str(max(share, 1))},
        )

    def chunks(self, jobs: Sequence[Job], workers: int) -> list[Sequence[Job]]:
        """What shares a compilation is in one chunk, and chunks of a compilation are alike: other numbers of worlds
        would have to be compiled."""
        chunks: list[Sequence[Job]] = []
        for _, group in groups(jobs):
            size = min(math.ceil(len(group) / workers), MOST_IN_BATCHES * (self.worlds or MOST_WORLDS))
            count = math.ceil(len(group) / size)
            # What takes longest, and what is over soon, is shared evenly.
            even = sorted(group, key=lambda job: len(job.scenario.objects))
            chunks += [even[i::count] for i in range(count)]
        return chunks

    def runner(self) -> Runner:
        """See `Kind`.

        Raises:
          InputError: JAX finds no GPU.
        """
        if jax.default_backend() == "cpu":
            raise InputError("JAX finds no GPU there; install it with: pip install 'mechsearch-jax[gpu]'")
        return Batches(self.worlds)


class Worker:
    """What lives in a worker process."""

    def __init__(self, kind: Kind, code: str) -> None:
        """Args:
          kind: of the worker.
          code: that it must have, `present_code` of who starts it.

        Raises:
          InputError: it has other code.
        """
        if present_code() != code:
            raise InputError(f"{socket.gethostname()} has {present_code()}, this machine {code}")
        keep_compilations()
        self._runner = kind.runner()

    def run(self, jobs: Sequence[Job]) -> Iterator[Sequence[EpisodeRow]]:
        """Run jobs that have been begun; their rows, as they end.

        Raises:
          Exception: whatever the runner failed with.
        """
        ended: queue.SimpleQueue[Sequence[EpisodeRow] | BaseException | None] = queue.SimpleQueue()

        def work() -> None:
            try:
                self._runner(jobs, ended.put, lambda job: True)
                ended.put(None)
            except BaseException as error:
                ended.put(error)

        threading.Thread(target=work, daemon=True).start()
        while (rows := ended.get()) is not None:
            if isinstance(rows, BaseException):
                raise rows
            yield rows
