"""Many scenarios, methods and seeds: what is wanted, what is there already, and what becomes of the rest.

A list of jobs, a runner and a folder: `processes.Processes` runs one after the other in several worker processes,
`batches.Batches` many at a time in this one, `cluster.RayCluster` does either on the machines of a cluster. Rows are on
disk as soon as their episodes have ended, so that a run that was killed goes on where it stopped. `shards` keeps them,
`claims` divides the work among those who share a folder.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence, Sized
from pathlib import Path
from typing import Any, Protocol, TypeVar

from mechsearch_jax.benchmarks.store.claims import Claims
from mechsearch_jax.benchmarks.store.rows import EpisodeRow, episode_key
from mechsearch_jax.benchmarks.store.shards import CLOSED_ENDING, Results, ShardWriter
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.scenes.scene_sets import Block, recorded
from mechsearch_jax.runtime.errors import InputError, check_once
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.runtime.versions import source_digest
from mechsearch_jax.workspace.scenario import Scenario, load_scenario
from mechsearch_jax.workspace.target import Target


@dataclasses.dataclass(frozen=True)
class SceneOutline:
    """What is known of a scene without making it.

    Attributes:
      name: of the scene.
      content_hash: of what it holds; see `Scenario.content_hash`.
      objects: as many as there are.
      target: shape and size of its target.
    """

    name: str
    content_hash: str
    objects: Sized
    target: Target

    @classmethod
    def of_block(cls, block: Block, index: int) -> SceneOutline:
        """The outline of a scene of a set, from the record of scene sets."""
        return cls(
            block.scene_name(index), recorded()[block.name][index], range(block.objects), Target.of(block.target)
        )

    @classmethod
    def of_scenario(cls, scenario: Scenario) -> SceneOutline:
        """The outline of a scenario."""
        return cls(scenario.name, scenario.content_hash, scenario.objects, Target.of_body(scenario.target))


@dataclasses.dataclass(frozen=True)
class PlannedJob:
    """An episode that is to be run; see `evaluate.Job`.

    Attributes:
      scene: that it is run on.
      method: everything else that decides about it, but for the seed.
      seed: of the episode.
    """

    scene: SceneOutline
    method: Method
    seed: int

    @functools.cached_property
    def key(self) -> str:
        """The `episode_key` of its row."""
        options = {"target": self.scene.target.shape, "simulator": self.method.engine, "seed": self.seed}
        return episode_key(EpisodeRow.failed(self.scene, {**_options(self.method), **options}, ""))

    @property
    def target(self) -> Target:
        """The planner's description of its target."""
        return self.method.workcell.target.like(self.scene.target)


def planned_jobs(scenes: Iterable[SceneOutline], methods: Sequence[Method], seeds: Sequence[int]) -> list[PlannedJob]:
    """All combinations of scenes, methods and seeds.

    Raises:
      InputError: two scenes have the same name.
    """
    scenes = list(scenes)
    check_once("two scenes", (scene.name for scene in scenes))
    return [PlannedJob(scene, method, seed) for scene, method, seed in itertools.product(scenes, methods, seeds)]


# How often a process that has nothing to do looks at what the others do [s].
LOOK_EVERY = 1.0


@dataclasses.dataclass(frozen=True)
class Job:
    """One episode to run.

    Attributes:
      path: file of the scenario.
      scenario: what is in it.
      method: everything else that decides about it, but for the seed.
      seed: of the episode.
    """

    path: str
    scenario: Scenario
    method: Method
    seed: int

    @property
    def options(self) -> dict[str, Any]:
        """As in `Episode.config`."""
        episode = {"target": self.scenario.target.shape, "simulator": self.method.engine, "seed": self.seed}
        return {**_options(self.method), **episode}

    @functools.cached_property
    def key(self) -> str:
        """The `episode_key` of its row."""
        return episode_key(self.failed(""))

    def failed(self, reason: str) -> EpisodeRow:
        """The row of an episode that could not be run to its end."""
        return EpisodeRow.failed(self.scenario, self.options, reason, present_code())

    def failed_by(self, error: BaseException) -> EpisodeRow:
        """The same, where an exception says why."""
        return self.failed(in_a_line(error))


def in_a_line(error: BaseException) -> str:
    """An exception's kind and text, in one line of 500 characters at most."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:500]


@functools.lru_cache(maxsize=4096)
def _options(method: Method) -> Mapping[str, Any]:
    """The same for thousands of jobs."""
    return method.options()


def make_jobs(
    files: Sequence[PathLike],
    methods: Sequence[Method],
    seeds: Sequence[int],
) -> list[Job]:
    """All combinations of scenario files, methods and seeds.

    Raises:
      InputError: a file is not a scenario, two of them have the same name, or a method cannot be used.
    """
    for method in methods:
        method.check()
    jobs: list[Job] = []
    names: dict[str, str] = {}
    # All methods of a run are of the same shelf.
    shelf = methods[0].workcell.shelf if methods else None
    for file in files:
        path = str(Path(file).resolve())
        scenario = load_scenario(file, shelf)
        if scenario.name in names:
            raise InputError(
                f"{file}: has the name {scenario.name!r} as {names[scenario.name]} has; rename one of them"
            )
        names[scenario.name] = str(file)
        jobs += [Job(path, scenario, method, seed) for method in methods for seed in seeds]
    return jobs


AnyJob = TypeVar("AnyJob", Job, PlannedJob)


def shard_of(jobs: Sequence[AnyJob], shard: int, shards: int) -> list[AnyJob]:
    """The jobs of one of several machines: each job is in one shard, and shards differ in size by one job at most.

    Which job is in which depends on nothing but the jobs, and not on their order. Jobs that differ in one thing alone,
    as the seed, are spread at random.

    Raises:
      InputError: there is no such shard.
    """
    if not 1 <= shard <= shards:
        raise InputError(f"shard {shard}/{shards}: give K/N with K from 1 to N")
    of_shard = set(sorted({job.key for job in jobs})[shard - 1 :: shards])
    return [job for job in jobs if job.key in of_shard]


@functools.cache
def present_code() -> str:
    """The code that decides about an episode: the package's version, and a digest of planner, perception (with its
    weights) and environment.

    The version alone would not tell a checkout from the next commit. The command line and pictures decide nothing.
    """
    digest = source_digest((".py", ".npz"), ("mechsearch_jax", "mechsearch_jax.envs"))
    return f"mechsearch-jax {importlib.metadata.version('mechsearch-jax')} ({digest[:12]})"


@dataclasses.dataclass(frozen=True)
class Tally:
    """What has become of the episodes that are wanted.

    Attributes:
      wanted: how many there are.
      ended, found, graspable, retrieved, errors: how many of them are over, and so on.
    """

    wanted: int
    ended: int = 0
    found: int = 0
    graspable: int = 0
    retrieved: int = 0
    errors: int = 0

    def plus(self, row: EpisodeRow) -> Tally:
        """With one more episode."""
        return dataclasses.replace(
            self,
            ended=self.ended + 1,
            found=self.found + (row.found_step is not None),
            graspable=self.graspable + (row.graspable_step is not None),
            retrieved=self.retrieved + row.retrieved,
            errors=self.errors + row.is_error,
        )


class Runner(Protocol):
    """Runs episodes in whatever order it likes."""

    def __call__(
        self, jobs: Sequence[Job], ended: Callable[[Sequence[EpisodeRow]], None], begin: Callable[[Job], bool]
    ) -> None:
        """Run all jobs that are still to be run.

        Args:
          jobs: what is wanted.
          ended: called with every one's row once, with several at a time if they ended together; in one thread.
          begin: called with every job once, right before it is begun, says whether it is to be run: another process may
            have.
        """
        ...


def evaluate(
    jobs: Sequence[Job],
    out: PathLike,
    runner: Runner,
    ended: Callable[[EpisodeRow, Tally], None] = lambda row, tally: None,
    waiting: Callable[[int], None] = lambda episodes: None,
    retry_errors: bool = False,
) -> list[EpisodeRow]:
    """Run the jobs of which the folder at `out` holds no row yet, and add each as its episode ends.

    Any number of processes may do so at the same time, in the same folder and for the same jobs: each episode is run by
    one of them. One that has nothing left to run waits for what the others run, and runs it if they are gone.

    Args:
      jobs: what is wanted.
      out: the folder, of which `shards` tells; a row in it stands for a job only if every option and what the scenario
        holds are the same. All of its episodes were run by the same code.
      runner: runs the episodes.
      ended: called for every row that is new, other processes' among them, with what is known by then.
      waiting: called while there is nothing to do but to wait for so many episodes that others run.
      retry_errors: whether jobs whose row is an error are run again, once.

    Returns:
      The rows of all jobs, in the order of the jobs.

    Raises:
      InputError: `out` is no folder, it holds rows of other code, or it cannot be read or written.
    """
    if Path(out).suffix == CLOSED_ENDING or Path(out).is_file():
        raise InputError(f"{out}: results are kept in a folder, not in a file; give the name of a folder")
    with Claims(out) as claims, ShardWriter(out, claims.owner) as writer:
        claims.close_what_is_left()
        work = _Work(jobs, Results(out), claims, writer, ended, retry_errors)
        while left := work.left():
            if free := claims.free(job.key for job in left):
                runner([job for job in left if job.key in free], work.take, work.begin)
                work.check()
            else:
                waiting(len(left))
                time.sleep(LOOK_EVERY)
            work.look()
        claims.close_what_is_left()
        return work.rows


def check_code(results: Results, fresh: Sequence[str]) -> None:
    """Refuse rows of other code than the present one.

    Args:
      results: of a folder.
      fresh: the keys of the rows that are to be looked at.

    Raises:
      InputError: other code ran one of them.
    """
    code = present_code()
    for key in fresh:
        if (row := results.rows[key]).code != code:
            raise InputError(
                f"{results.folder}: its episodes were run by {row.code}, this is {code}; give another folder, "
                "or delete this one to run all of them again"
            )


class _Work:
    """The jobs of this process, and what has become of them."""

    def __init__(
        self,
        jobs: Sequence[Job],
        results: Results,
        claims: Claims,
        writer: ShardWriter,
        ended: Callable[[EpisodeRow, Tally], None],
        retry_errors: bool,
    ) -> None:
        """Args are as `evaluate` has them; `results` have not been read."""
        self._jobs, self._results, self._claims, self._writer = jobs, results, claims, writer
        self._ended = ended
        # Episodes of which rows were read that `ended` has not been called with.
        self._fresh: list[str] = []
        self._refresh()
        self._fresh.clear()
        # How many rows there must be of each episode before it is over.
        self._needed = dict.fromkeys((job.key for job in jobs), 1)
        if retry_errors:
            self._needed |= {
                key: results.attempts[key] + 1
                for key in self._needed
                if key in results.rows and results.rows[key].is_error
            }
        self._left = {job.key: job for job in jobs if not self._is_over(job.key)}
        self._tally = Tally(wanted=len(self._needed))
        for key in self._needed.keys() - self._left.keys():
            self._tally = self._tally.plus(results.rows[key])

    @property
    def rows(self) -> list[EpisodeRow]:
        """The rows of all jobs; all must have ended."""
        return [self._results.rows[job.key] for job in self._jobs]

    def left(self) -> list[Job]:
        """The jobs that are not over."""
        return list(self._left.values())

    def begin(self, job: Job) -> bool:
        """Whether a job is for this process to run."""
        if self._is_over(job.key) or not self._claims.take(job.key):
            return False
        # It may have ended elsewhere before it was taken.
        self._refresh()
        if self._is_over(job.key):
            self._claims.release(job.key)
            return False
        return True

    def take(self, rows: Sequence[EpisodeRow]) -> None:
        """Keep the rows of episodes that ended.

        Raises:
          InputError: a worker ran other code.
        """
        kept = [row for row in rows if row.code == present_code()]
        self._writer.append(kept)
        for row in kept:
            self._claims.release(episode_key(row))
        self.look()
        if foreign := next((row.code for row in rows if row.code != present_code()), None):
            raise InputError(f"a worker ran {foreign}, this is {present_code()}; start again, and leave the code alone")

    def check(self) -> None:
        """Fail where a runner is done, and lacks the row of an episode that it began.

        Raises:
          RuntimeError: it does; the row that it gave is of other options, perhaps.
        """
        lacking = [job.scenario.name for key, job in self._left.items() if key in self._claims.mine]
        if lacking:
            raise RuntimeError(f"evaluate: the episode of {lacking[0]} ended without a row of its own")

    def look(self) -> None:
        """Take note of all that has ended, elsewhere too."""
        self._refresh()
        over = [key for key in dict.fromkeys(self._fresh) if key in self._left and self._is_over(key)]
        self._fresh.clear()
        for key in over:
            del self._left[key]
        for row in [self._results.rows[key] for key in over]:
            self._tally = self._tally.plus(row)
            self._ended(row, self._tally)

    def _is_over(self, key: str) -> bool:
        return self._results.attempts.get(key, 0) >= self._needed[key]

    def _refresh(self) -> None:
        """Read what is new.

        Raises:
          InputError: other code ran some of it.
        """
        fresh = self._results.refresh()
        self._fresh += fresh
        check_code(self._results, fresh)
