"""Compile programs before they are needed, in parallel.

Lowering holds Python's lock, so programs are lowered one at a time, the longest first. Each is then compiled, or read
from disk, in a thread of its own.
"""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np

from mechsearch_jax.actions import KINDS, no_action
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Policy, Problem, initial_belief, update_belief
from mechsearch_jax.planner.policies import PlanningPolicy
from mechsearch_jax.robot.motion import MotionConfig
from mechsearch_jax.runtime.cores import cores

# Slots for objects in an observation.
SLOTS = 8


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
      function: a `runtime.compiled.Kept`, or an object with its `begin` and `is_ready`.
      *args: of the call; arrays may be given as shapes.
    """
    return Program(name, lambda: function.is_ready(*args), lambda: function.begin(*args))


def first_decision(problem: Problem, policy: Policy, motion: MotionConfig) -> list[Program]:
    """The programs of the first decision and action that take long to compile, the longest first."""
    shapes = jax.eval_shape(lambda: Observation(empty(SLOTS), jax.numpy.array(False), jax.numpy.zeros(3)).judged())
    seen: Observation = jax.tree.map(lambda s: jax.device_put(np.zeros(s.shape, s.dtype)), shapes)
    belief = initial_belief(problem)
    programs = []
    if isinstance(policy, PlanningPolicy):
        programs.append(program("plan", policy, jax.random.key(0), problem, belief, seen))
    programs.append(program("belief", update_belief, problem, belief, seen, seen, no_action()))
    return [*programs, *motions(motion)]


def motions(config: MotionConfig) -> list[Program]:
    """The reference motion of each kind of action, unbatched, as a simulator on the host calls it."""
    return [program(f"motion of {kind.name}", reference_motion, kind, no_action(), config) for kind in KINDS.values()]


@contextlib.contextmanager
def prepared(programs: Sequence[Program], report: Callable[[str], None]) -> Iterator[None]:
    """Prepare programs in threads, one per core, while the block runs; a call of one of them waits until it is ready.

    An error in a program is raised when it is called. If the block raises, programs that have not begun are left out.

    Args:
      programs: the longest first.
      report: called with a progress message at the beginning, if there is anything to compile, and after each program.
    """
    missing = [program.name for program in programs if not program.is_ready()]
    count, lock, ended = len(missing), threading.Lock(), threading.Event()
    # A lowered program must be compiled at once, since a call waits for it: lower only where a core is free.
    free_cores = threading.Semaphore(max(cores(), 2))

    def report_progress() -> None:
        left = f": {', '.join(dict.fromkeys(missing))}" if missing else ""
        report(f"compiling{left}; {count - len(missing)} of {count} done")

    def on_compiled(name: str, future: Future[None]) -> None:
        free_cores.release()
        with lock:
            if name in missing and future.exception() is None:
                missing.remove(name)
                report_progress()

    def lower_all() -> None:
        for program in programs:
            free_cores.acquire()
            finish = None
            if not ended.is_set():
                with contextlib.suppress(Exception):
                    finish = program.begin()
            if finish is None:
                free_cores.release()
            else:
                threads.submit(finish).add_done_callback(functools.partial(on_compiled, program.name))

    if missing:
        report_progress()
    with ThreadPoolExecutor(len(programs) + 1) as threads:
        lowering = threads.submit(lower_all)
        try:
            yield
        except BaseException:
            ended.set()
            raise
        lowering.result()


def prepare(programs: Sequence[Program], report: Callable[[str], None]) -> None:
    """Prepare programs and wait for all of them; see `prepared`."""
    with prepared(programs, report):
        pass
