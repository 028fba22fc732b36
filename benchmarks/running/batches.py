"""Episodes many at a time in this process: what makes a GPU worth having."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence

import jax

from mechsearch_jax.benchmarks.running.evaluate import Job, in_a_line, present_code
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.envs.episode.closed_loop import Listeners, RunSettings, Start
from mechsearch_jax.envs.episode.episodes import run_episodes, target_of
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.episode.records import Episode
from mechsearch_jax.envs.simulators.named import EngineName, new_simulator
from mechsearch_jax.envs.simulators.simulator import Simulator
from mechsearch_jax.envs.trials.named import named_trials
from mechsearch_jax.envs.trials.native import NativeTrials
from mechsearch_jax.envs.trials.processes import ProcessTrials
from mechsearch_jax.planner.trials import Trials
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.target import Target

# More worlds at once are no faster per world, but every round takes longer.
MOST_WORLDS = 1024
# Without a GPU a batch only shares the overhead.
MOST_WORLDS_ON_CPU = 16
# Of the device's memory; the planner and what comes and goes have the rest.
SHARE_OF_WORLDS = 0.4
# So many episodes that fail alone, one after the other, say that it is not they that are bad.
MOST_FAILURES = 8
# How many slots look or decide in one computation.
AT_ONCE, AT_ONCE_ON_CPU = 64, 4


@dataclasses.dataclass(frozen=True)
class _Means:
    """What the episodes of a batch are run with.

    Attributes:
      target: of their scenes.
      method: of one of them; the others differ from it in numbers alone.
      simulator: executes their actions.
      worlds: how many run at the same time.
      trials: what tries actions out.
    """

    target: Target
    method: Method
    simulator: Simulator
    worlds: int
    trials: Trials | None


@dataclasses.dataclass(frozen=True)
class Batches:
    """Runs jobs in lockstep, in the simulator that they name.

    Attributes:
      worlds: how many at the same time; as many as fit the device's memory, within reason, if None.
      busy: called with every stage and how many episodes are in it.
      compiling: called with what is being compiled, where anything is.
      again: called with a line that says what failed when episodes are run again, which takes as long as before.
    """

    worlds: int | None = None
    busy: Callable[[str, int], None] = lambda stage, episodes: None
    compiling: Callable[[str], None] = lambda text: None
    again: Callable[[str], None] = lambda text: None

    def __call__(
        self, jobs: Sequence[Job], ended: Callable[[Sequence[EpisodeRow]], None], begin: Callable[[Job], bool]
    ) -> None:
        """Run all jobs; see `evaluate.Runner`.

        Where the device's memory does not suffice, it goes on with half as many worlds. Where anything else fails, the
        episodes that were running are run again in halves, and so on: only those that fail alone become rows with the
        reason.

        Raises:
          Exception: whatever failed, if it did before an episode had begun, or if `MOST_FAILURES` of them fail alone
            and none ends between them; if none has ended before them either, they get no rows. Or the memory does
            not suffice for a single world.
        """
        failures = _Failures(ended)
        with contextlib.ExitStack() as stack:
            trying = functools.cache(functools.partial(_trials, stack))
            self._run_groups(jobs, begin, failures, trying)
        failures.hand_on()

    def _run_groups(
        self,
        jobs: Sequence[Job],
        begin: Callable[[Job], bool],
        failures: _Failures,
        trying: Callable[[str], Trials | None],
    ) -> None:
        # What is compiled for one group serves the next.
        simulators: dict[tuple[EngineName, Workcell], Simulator] = {}
        for target, group in groups(jobs):
            method = group[0].method
            scene = method.engine, method.workcell
            simulator = simulators.get(scene) or new_simulator(*scene)
            simulators[scene] = simulator
            worlds = min(self.worlds or fitting_worlds(simulator), len(group))
            # Those that take longest come first, so that none of them begins when all others are over.
            longest_first = sorted(group, key=lambda job: -len(job.scenario.objects))
            batches = [_Batch(begin, [], [(job, False) for job in longest_first])]
            while batches:
                batch = batches.pop()
                try:
                    trials = trying(method.config.trials)
                    self._run(batch, failures.ended, _Means(target, method, simulator, worlds, trials))
                except InputError:
                    raise
                except Exception as error:
                    simulators[scene] = simulator = new_simulator(*scene)
                    if isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" in str(error):
                        if worlds == 1:
                            raise
                        worlds //= 2
                        self.again(f"the device's memory does not suffice; going on with {worlds} at the same time")
                        batches += batch.again()
                    elif not batch.running:
                        raise
                    elif len(batch.running) == 1:
                        batches += batch.rest()
                        failures.add(batch.running[0], error)
                    else:
                        count = len(batch.running)
                        self.again(f"{count} episodes are run again in halves, because of {in_a_line(error)}")
                        batches += batch.halves()

    def _run(self, batch: _Batch, ended: Callable[[Sequence[EpisodeRow]], None], means: _Means) -> None:
        code, method, target = present_code(), means.method, means.target
        policy_of, options_of = functools.cache(Method.policy), functools.cache(Method.options)

        def start(job: Job) -> Start:
            policy, max_steps = policy_of(job.method), job.method.config.max_steps
            return Start(job.scenario, job.seed, policy, max_steps, options_of(job.method), job.method.mismatch)

        def take(episodes: Sequence[tuple[int, Episode]]) -> None:
            if counted := batch.take(episodes):
                ended([EpisodeRow.of_episode(episode, code) for episode in counted])

        run_episodes(
            map(start, batch.jobs(means.worlds)),
            method.workcell.problem(target, method.config.problem),
            policy_of(method),
            means.simulator,
            means.worlds,
            Listeners(take, self.busy, self.compiling),
            RunSettings(
                recogniser=method.recogniser(target),
                trials=means.trials,
                at_once=AT_ONCE_ON_CPU if jax.default_backend() == "cpu" else AT_ONCE,
            ),
        )


def _trials(stack: contextlib.ExitStack, name: str) -> Trials | None:
    """What tries actions out, as `named_trials`, in processes of its own beside a GPU; ended with the stack."""
    trials = named_trials(name)
    if jax.default_backend() == "cpu" or not isinstance(trials, NativeTrials):
        return trials
    apart = ProcessTrials(trials)
    stack.callback(apart.close)
    return apart


class _Batch:
    """Jobs that are run together: which of them have been begun, and which have ended."""

    def __init__(
        self, begin: Callable[[Job], bool], again: Sequence[Job], todo: Iterable[tuple[Job, bool]] = ()
    ) -> None:
        """Args:
        begin: see `evaluate.Runner`.
        again: jobs that were running when something failed, to be run first.
        todo: others, and whether they have been begun before.
        """
        self._begin, self._fill = begin, bool(again)
        self._todo = deque([*((job, True) for job in again), *todo])
        self._begun: list[Job] = []
        self._over: set[int] = set()

    def jobs(self, worlds: int) -> Iterator[Job]:
        """The jobs, as their episodes are begun.

        Where jobs are run again and are fewer than the worlds, they come several times, since another number of worlds
        would have to be compiled; what the copies come to does not count.
        """
        while self._todo:
            job, begun = self._todo.popleft()
            if begun or self._begin(job):
                self._begun.append(job)
                yield job
        for place in range(worlds - len(self._begun) if self._fill else 0):
            yield self._begun[place % len(self._begun)]

    def take(self, episodes: Sequence[tuple[int, Episode]]) -> list[Episode]:
        """Take note of episodes that ended, by their places; those that count."""
        counted = {place: episode for place, episode in episodes if place < len(self._begun)}
        self._over |= counted.keys()
        return list(counted.values())

    @property
    def running(self) -> list[Job]:
        """The jobs that were begun and have not ended."""
        return [job for place, job in enumerate(self._begun) if place not in self._over]

    def again(self) -> list[_Batch]:
        """What has not ended, once more."""
        return [_Batch(self._begin, self.running, self._todo)]

    def rest(self) -> list[_Batch]:
        """What has not been begun."""
        return [_Batch(self._begin, [], self._todo)] if self._todo else []

    def halves(self) -> list[_Batch]:
        """What was running in two parts, of which the last is to be run first; before them what comes after them."""
        running, half = self.running, (len(self.running) + 1) // 2
        return [*self.rest(), *(_Batch(self._begin, part) for part in (running[half:], running[:half]))]


class _Failures:
    """Episodes that failed alone, until it is known whether it is they that are bad, or everything."""

    def __init__(self, ended: Callable[[Sequence[EpisodeRow]], None]) -> None:
        self._ended = ended
        self._any_ended = False
        self._waiting: list[EpisodeRow] = []

    def ended(self, rows: Sequence[EpisodeRow]) -> None:
        """Hand on the rows of episodes that ended, after those of the ones that failed."""
        self._any_ended = True
        self.hand_on()
        self._ended(rows)

    def add(self, job: Job, error: Exception) -> None:
        """Take note of an episode that failed alone.

        Raises:
          Exception: the error, if too many have failed one after the other.
        """
        self._waiting.append(job.failed_by(error))
        if len(self._waiting) == MOST_FAILURES:
            if self._any_ended:
                self.hand_on()
            raise error

    def hand_on(self) -> None:
        """Make rows of those that failed."""
        rows, self._waiting = self._waiting, []
        if rows:
            self._ended(rows)


def groups(jobs: Sequence[Job]) -> list[tuple[Target, list[Job]]]:
    """The jobs by what is compiled for them, with their target."""
    compile_key = functools.cache(Method.compile_key)
    groups: dict[tuple[Target, Hashable], list[Job]] = {}
    for job in jobs:
        key = target_of(job.scenario, job.method.workcell.target), compile_key(job.method)
        groups.setdefault(key, []).append(job)
    return [(target, group) for (target, _), group in groups.items()]


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
