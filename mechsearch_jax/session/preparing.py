"""Compile programs before they are needed, in parallel.

Lowering holds Python's lock, so programs are lowered one at a time, the longest first. Each is then compiled, or read
from disk, in a thread of its own.
"""

from __future__ import annotations

import contextlib
import functools
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np

from mechsearch_jax.actions import KINDS, no_action
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.belief.belief import Belief
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.images.labels import CAPACITY
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Policy, Problem, initial_belief, update_belief
from mechsearch_jax.planner.policies import PlanningPolicy
from mechsearch_jax.robot.motion import MotionConfig
from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.runtime.own_settings import in_own_settings


class Program(NamedTuple):
    """A function that is compiled as a whole for certain arguments.

    Attributes:
      name: for progress messages.
      is_ready: whether it is compiled already.
      begin: lowers it and returns a function that compiles it or reads it from disk, for any thread; None if there is
        nothing to do.
    """

    name: str
    is_ready: Callable[[], bool]
    begin: Callable[[], Callable[[], None] | None]


def program(name: str, function: Any, *args: Any) -> Program:
    """The program of a call.

    Args:
      name: for progress messages.
      function: a `runtime.compiled.CachedJit`, or an object with its `begin` and `is_ready`.
      *args: of the call; arrays may be given as shapes.
    """
    return Program(name, lambda: function.is_ready(*args), lambda: function.begin(*args))


def nothing_seen(parts: int | None = None, capacity: int = CAPACITY) -> Observation:
    """An observation of nothing, with the shapes of all others.

    Args:
      parts: room for parts of each body where bodies have parts, such as `geometry.bodies.PARTS`; None where they have
        none.
      capacity: number of slots for objects.
    """
    shapes = jax.eval_shape(
        lambda: Observation(empty(capacity, parts), jax.numpy.array(False), jax.numpy.zeros(3)).judged()
    )
    return jax.tree.map(lambda s: jax.device_put(np.zeros(s.shape, s.dtype)), shapes)


def plan(policy: PlanningPolicy, key: jax.Array, problem: Problem, belief: Belief, seen: Observation) -> list[Program]:
    """The programs of a plan, the longest first; see `decision`."""
    return [program("plan", function, *args) for function, args in policy.programs(key, problem, belief, seen)]


def decision(problem: Problem, policy: Policy, seen: Observation | None = None) -> list[Program]:
    """The programs of the first decision that take long to compile, the longest first.

    Args:
      problem, policy: of the search.
      seen: an observation with the shapes of all others; `nothing_seen()` if None.
    """
    initial, seen = initial_belief(problem), seen or nothing_seen()
    belief = program("belief", update_belief, problem, initial, seen, seen, no_action())
    if not isinstance(policy, PlanningPolicy):
        return [belief]
    # The belief is needed first, and compiles beside the longest part of the plan.
    longest, *rest = plan(policy, jax.random.key(0), problem, initial, seen)
    return [longest, belief, *rest]


def first_decision(
    problem: Problem, policy: Policy, motion: MotionConfig, seen: Observation | None = None
) -> list[Program]:
    """The programs of the first decision and action that take long to compile, the longest first; see `decision`."""
    return [*decision(problem, policy, seen), *motions(motion)]


def retrieval(problem: Problem, policy: Policy, seen: Observation | None = None) -> list[Program]:
    """The programs of a decision about a found target that take long to compile; see `decision`."""
    if not isinstance(policy, PlanningPolicy):
        return []
    belief, seen = initial_belief(problem), seen or nothing_seen()
    found = belief.replace(found=jax.numpy.array(True))
    grasp = program("grasp", policy.grasps, problem.target_grasps, seen.objects, belief.found_pose)
    return [grasp, *plan(policy, jax.random.key(0), problem, found, seen)]


def motions(config: MotionConfig) -> list[Program]:
    """The reference motion of each kind of action, unbatched, as a simulator on the host calls it."""
    return [program(f"motion of {kind.name}", reference_motion, kind, no_action(), config) for kind in KINDS.values()]


class Preparing:
    """Prepares programs in threads, one per core, while its block runs; a call of one of them waits until it is ready.

    An error in a program is raised when it is called. If the block raises, programs that have not begun are left out.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        """Args:
        report: called with a progress message when programs are added of which some have to be compiled, and after
          each of these.
        """
        self._report = report
        # Names of what has to be compiled, how many there were, and how many needed programs are not ready.
        self._missing: list[str] = []
        self._count = self._awaited = 0
        self._changed = threading.Condition()
        self._raised = self._over = False
        self._queue: queue.SimpleQueue[tuple[Program, bool] | None] = queue.SimpleQueue()
        # A lowered program must be compiled at once, since a call waits for it: lower only where a core is free.
        self._free_cores = threading.Semaphore(max(cores(), 2))
        self._threads = ThreadPoolExecutor(max(cores(), 2))

    def add(self, programs: Sequence[Program], optional: bool = False) -> None:
        """Prepare programs after those that were added before.

        Args:
          programs: the longest first.
          optional: nothing is reported of them; those that have not begun when the block ends are left out, and it does
            not wait for those that have.
        """
        if not optional:
            missing = [program.name for program in programs if not program.is_ready()]
            with self._changed:
                self._missing += missing
                self._count += len(missing)
                self._awaited += len(programs)
                if missing:
                    self._report_progress()
        for program in programs:
            self._queue.put((program, optional))

    def __enter__(self) -> Preparing:
        threading.Thread(target=self._lower_all).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *details: object) -> None:
        self._over, self._raised = True, kind is not None
        self._queue.put(None)
        with self._changed:
            self._changed.wait_for(lambda: self._awaited == 0)

    @in_own_settings
    def _lower_all(self) -> None:
        while (item := self._queue.get()) is not None:
            program, optional = item
            self._free_cores.acquire()
            finish = None
            if not (self._raised or (optional and self._over)):
                with contextlib.suppress(Exception):
                    finish = program.begin()
            ended = functools.partial(self._ended, None if optional else program.name)
            try:
                compiled = None if finish is None else self._threads.submit(finish)
            except RuntimeError:
                # The interpreter ends meanwhile.
                compiled = None
            if compiled is None:
                ended(None)
            else:
                compiled.add_done_callback(ended)
        # Not before: whatever has been lowered has to be compiled, for a call of it would wait for ever.
        self._threads.shutdown(wait=False)

    def _ended(self, name: str | None, compiled: Future[None] | None) -> None:
        """Note that a program is ready, was not compiled (None) or failed; the name of an optional one is None."""
        self._free_cores.release()
        with self._changed:
            if name is None:
                return
            if name in self._missing and compiled is not None and compiled.exception() is None:
                self._missing.remove(name)
                self._report_progress()
            self._awaited -= 1
            self._changed.notify()

    def _report_progress(self) -> None:
        left = f": {', '.join(dict.fromkeys(self._missing))}" if self._missing else ""
        self._report(f"compiling{left}; {self._count - len(self._missing)} of {self._count} done")


@contextlib.contextmanager
def prepared(programs: Sequence[Program], report: Callable[[str], None]) -> Iterator[None]:
    """Prepare programs while the block runs; see `Preparing`.

    Args:
      programs: the longest first.
      report: see `Preparing`.
    """
    with Preparing(report) as preparing:
        preparing.add(programs)
        yield


def prepare(programs: Sequence[Program], report: Callable[[str], None]) -> None:
    """Prepare programs and wait for all of them; see `prepared`."""
    with prepared(programs, report):
        pass
