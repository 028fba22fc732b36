"""What the workers of a cluster are: one episode after the other on CPUs, or batches on a GPU.

What is here runs in the workers, or says where they are and what they are sent; `cluster` starts and feeds them.
"""

from __future__ import annotations

import math
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import jax

from mechsearch_jax.benchmarks.running.batches import MOST_WORLDS, Batches, groups
from mechsearch_jax.benchmarks.running.evaluate import Job, Runner, present_code
from mechsearch_jax.benchmarks.running.processes import ENVIRONMENT, TIME_LIMIT
from mechsearch_jax.benchmarks.running.worker import Worker
from mechsearch_jax.benchmarks.store.rows import Row
from mechsearch_jax.problem.cache import keep_compilations
from mechsearch_jax.runtime.cores import VARIABLE
from mechsearch_jax.runtime.errors import InputError

# A worker's episodes take seconds: longer chunks would only end at different times.
MOST_IN_TURN = 4
# In worlds: the longer a chunk, the smaller the part of it in which worlds have nothing left to do.
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
        """Seconds after which the first of a worker's jobs that has no row is taken to hang; None for never."""
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
        found = [int(machine.get("CPU", 0)) for machine in machines]
        workers = self.workers or max(sum(found), 1)
        fitting = (n for n in range(max(found, default=0), 0, -1) if sum(one // n for one in found) >= workers)
        share = next(fitting, None)
        if share is None:
            raise InputError(f"the Ray cluster has {sum(found)} CPUs, too few for {workers} workers; ask for fewer")
        return Place(workers, {"num_cpus": share}, {**ENVIRONMENT, VARIABLE: str(share)})

    def chunks(self, jobs: Sequence[Job], workers: int) -> list[Sequence[Job]]:
        """In the order of the jobs; the last ones are small, so that all workers end at the same time."""
        found: list[Sequence[Job]] = []
        begin = 0
        while begin < len(jobs):
            size = min(MOST_IN_TURN, math.ceil((len(jobs) - begin) / (2 * workers)))
            found.append(jobs[begin : begin + size])
            begin += size
        return found

    def runner(self) -> Runner:
        """See `Kind`."""
        return InTurn()


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
        found = [machine for machine in machines if machine.get("GPU", 0) >= 1]
        if not found:
            raise InputError("the Ray cluster has no GPU for batches; run one episode after the other (--workers)")
        share = int(min(machine.get("CPU", 0) // machine["GPU"] for machine in found))
        return Place(
            sum(int(machine["GPU"]) for machine in found),
            {"num_gpus": 1, "num_cpus": min(share, 1)},
            {VARIABLE: str(max(share, 1))},
        )

    def chunks(self, jobs: Sequence[Job], workers: int) -> list[Sequence[Job]]:
        """What shares a compilation is in one chunk, and chunks of a compilation are alike: other numbers of worlds
        would have to be compiled."""
        found: list[Sequence[Job]] = []
        for _, group in groups(jobs):
            size = min(math.ceil(len(group) / workers), MOST_IN_BATCHES * (self.worlds or MOST_WORLDS))
            count = math.ceil(len(group) / size)
            # What takes longest, and what is over soon, is shared evenly.
            even = sorted(group, key=lambda job: len(job.scenario.objects))
            found += [even[i::count] for i in range(count)]
        return found

    def runner(self) -> Runner:
        """See `Kind`.

        Raises:
          InputError: JAX finds no GPU.
        """
        if jax.default_backend() == "cpu":
            raise InputError("JAX finds no GPU there; install it with: pip install 'mechsearch-jax[gpu]'")
        return Batches(self.worlds)


class InTurn:
    """Runs jobs one after the other in this process; what does not change between them is kept."""

    def __init__(self) -> None:
        self._worker = Worker()

    def __call__(
        self, jobs: Sequence[Job], ended: Callable[[Sequence[Row]], None], begin: Callable[[Job], bool]
    ) -> None:
        """Run all jobs; see `evaluate.Runner`."""
        for job in jobs:
            if begin(job):
                ended([self._row(job)])

    def _row(self, job: Job) -> Row:
        try:
            return self._worker.run_scenario(job.scenario, job.method, job.seed)
        except Exception as error:  # Whatever fails in one episode must not end the run.
            return job.failed_by(error)


class Host:
    """What lives in a worker: runs a chunk in a thread, so that rows can be asked for meanwhile."""

    def __init__(self, kind: Kind) -> None:
        # Before anybody changes it: what is imported from here on is taken for it.
        present_code()
        keep_compilations()
        self._runner = kind.runner()
        self._ended: queue.SimpleQueue[Sequence[Row] | BaseException | None] = queue.SimpleQueue()

    def started(self) -> None:
        """Answered once it can run jobs."""

    def begin(self, jobs: Sequence[Job]) -> None:
        """Run jobs, of which `more` tells."""
        threading.Thread(target=self._run, args=(jobs,), daemon=True).start()

    def more(self) -> Sequence[Row] | None:
        """Wait for rows; None after the last.

        Raises:
          Exception: whatever the runner failed with.
        """
        result = self._ended.get()
        if isinstance(result, BaseException):
            raise result
        return result

    def _run(self, jobs: Sequence[Job]) -> None:
        try:
            self._runner(jobs, self._ended.put, lambda job: True)
            self._ended.put(None)
        except BaseException as error:
            self._ended.put(error)
