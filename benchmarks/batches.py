"""Episodes many at a time in this process: what makes a GPU worth having."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import get_args

import jax

from mechsearch_jax.benchmarks.evaluate import Job
from mechsearch_jax.benchmarks.rows import Row
from mechsearch_jax.envs.episodes import Start, run_episodes, target_of
from mechsearch_jax.envs.method import EngineName, Method
from mechsearch_jax.envs.recognisers import recogniser
from mechsearch_jax.envs.records import Episode
from mechsearch_jax.envs.simulator import Simulator
from mechsearch_jax.errors import InputError
from mechsearch_jax.planner.workcell import Workcell
from mechsearch_jax.workspace.target import Target

# More worlds at once are no faster per world, but every round takes longer.
MOST_WORLDS = 1024
# Without a GPU a batch only shares the overhead.
MOST_WORLDS_ON_CPU = 16
# Of the device's memory; the planner and what comes and goes have the rest.
SHARE_OF_WORLDS = 0.4
# How many slots look or decide in one computation.
AT_ONCE, AT_ONCE_ON_CPU = 64, 4


def new_simulator(engine: EngineName, workcell: Workcell) -> Simulator:
    """A simulator of a workcell by an engine; MJX takes long to import and is not always installed.

    Raises:
      InputError: it is unknown, or cannot be imported.
    """
    if engine not in get_args(EngineName):
        raise InputError(f'simulator "{engine}" is unknown; use {" or ".join(get_args(EngineName))}')
    if engine == "NativeSimulator":
        from mechsearch_jax.envs.native import NativeSimulator

        return NativeSimulator(shelf=workcell.shelf, camera=workcell.camera)
    from mechsearch_jax.envs.mjx_simulator import MjxSimulator

    return MjxSimulator(workcell.shelf, workcell.camera)


@dataclasses.dataclass(frozen=True)
class Batches:
    """Runs jobs in lockstep, in the simulator that they name.

    Attributes:
      worlds: how many at the same time; as many as fit the device's memory, within reason, if None.
      busy: told of every stage and how many episodes are in it.
    """

    worlds: int | None = None
    busy: Callable[[str, int], None] = lambda stage, episodes: None

    def __call__(self, jobs: Sequence[Job], ended: Callable[[Sequence[Row]], None]) -> None:
        """Run all jobs; see `evaluate.Runner`.

        Where the device's memory does not suffice, it goes on with half as many worlds. Where anything else fails, the
        episodes that were running become rows with the reason.

        Raises:
          Exception: whatever failed, if no episode has ended since the start or the last failure, or if the memory
            does not suffice for a single world.
        """
        for (target, method), group in _groups(jobs):
            simulator = new_simulator(method.engine, method.workcell)
            worlds = self.worlds or fitting_worlds(simulator)
            # Those that take longest come first, so that none of them begins when all others are over.
            todo = sorted(group, key=lambda job: -len(job.scenario.objects))
            while todo:
                attempt = _Attempt(todo, ended)
                try:
                    self._run(attempt, target, method, simulator, worlds)
                except jax.errors.JaxRuntimeError as error:
                    used = min(worlds, len(todo))
                    if "RESOURCE_EXHAUSTED" not in str(error):
                        attempt.fail(error)
                    elif used == 1:
                        raise
                    else:
                        worlds = used // 2
                    simulator = new_simulator(method.engine, method.workcell)
                except InputError:
                    raise
                except Exception as error:
                    attempt.fail(error)
                    simulator = new_simulator(method.engine, method.workcell)
                todo = attempt.left

    def _run(self, attempt: _Attempt, target: Target, method: Method, simulator: Simulator, worlds: int) -> None:
        run_episodes(
            attempt.starts(),
            method.workcell.problem(target, method.config.problem),
            method.policy(),
            simulator,
            worlds,
            attempt.take,
            recogniser=recogniser(method.recognition, target),
            max_steps=method.config.max_steps,
            options=method.options(),
            at_once=AT_ONCE_ON_CPU if jax.default_backend() == "cpu" else AT_ONCE,
            busy=self.busy,
        )


class _Attempt:
    """Which of the jobs have been begun, and which have ended."""

    def __init__(self, jobs: Sequence[Job], ended: Callable[[Sequence[Row]], None]) -> None:
        self._jobs = jobs
        self._ended = ended
        self._begun = 0
        self._over: set[int] = set()

    def starts(self) -> Iterator[Start]:
        """The jobs as episodes to begin."""
        for job in self._jobs:
            self._begun += 1
            yield Start(job.scenario, job.seed)

    def take(self, episodes: Sequence[tuple[int, Episode]]) -> None:
        """Hand on the rows of episodes that ended."""
        self._over |= {place for place, _ in episodes}
        self._ended([Row.of_episode(episode) for _, episode in episodes])

    def fail(self, error: Exception) -> None:
        """Make a row of every episode that was running when an error came.

        Raises:
          Exception: the error, if no episode has ended before it.
        """
        if not self._over:
            raise error
        running = [place for place in range(self._begun) if place not in self._over]
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"[:500]
        self._over |= set(running)
        self._ended([self._jobs[place].failed(reason) for place in running])

    @property
    def left(self) -> list[Job]:
        """The jobs that have not ended."""
        return [job for place, job in enumerate(self._jobs) if place not in self._over]


def _groups(jobs: Sequence[Job]) -> list[tuple[tuple[Target, Method], list[Job]]]:
    """The jobs by what is compiled for them."""
    groups: dict[tuple[Target, Method], list[Job]] = {}
    for job in jobs:
        groups.setdefault((target_of(job.scenario, job.method.workcell.target), job.method), []).append(job)
    return list(groups.items())


def fitting_worlds(simulator: Simulator) -> int:
    """How many worlds fit the memory of the device."""
    if jax.default_backend() == "cpu":
        return MOST_WORLDS_ON_CPU
    # The native simulator's worlds are not on the device.
    bytes_per_world = getattr(simulator, "bytes_per_world", None)
    stats = jax.local_devices()[0].memory_stats() or {}
    if bytes_per_world is None or "bytes_limit" not in stats:
        return MOST_WORLDS
    room = SHARE_OF_WORLDS * stats["bytes_limit"]
    return max(min(int(room // bytes_per_world()), MOST_WORLDS), 1)
