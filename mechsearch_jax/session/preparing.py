"""Programs that are compiled before they are needed, all at the same time.

A program is lowered first, which needs Python and so happens to one after the other, the longest first; it is compiled,
or read from disk, in a thread of its own meanwhile. What takes its time elsewhere, such as the kernels of a simulator,
begins with the first of them.
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
from mechsearch_jax.planner.policies import Search
from mechsearch_jax.robot.motion import MotionConfig
from mechsearch_jax.runtime.cores import cores

# Objects that an observation has room for.
SLOTS = 8


class Program(NamedTuple):
    """Something that is compiled as a whole.

    Attributes:
      name: of what it computes.
      is_ready: whether it was compiled before.
      begin: lowers it, and gives what compiles or reads it, to be called in any thread; None where nothing is left.
    """

    name: str
    is_ready: Callable[[], bool]
    begin: Callable[[], Callable[[], None] | None]


def program(name: str, function: Any, *args: Any) -> Program:
    """The program that a call needs.

    Args:
      name: of what it computes.
      function: a `runtime.compiled.Kept`, or what has its `begin` and `is_ready`.
      *args: of the call; for what is data, shapes will do.
    """
    return Program(name, lambda: function.is_ready(*args), lambda: function.begin(*args))


def first_decision(problem: Problem, policy: Policy, motion: MotionConfig) -> list[Program]:
    """What takes long to compile of a first look, a first decision and a first action; that which takes longest first.

    Args:
      problem, policy: of the episode.
      motion: how actions are executed.
    """
    # Only shapes and types count.
    shapes = jax.eval_shape(lambda: Observation(empty(SLOTS), jax.numpy.array(False), jax.numpy.zeros(3)))
    seen: Observation = jax.tree.map(lambda s: jax.device_put(np.zeros(s.shape, s.dtype)), shapes)
    belief = initial_belief(problem)
    found = []
    if isinstance(policy, Search):
        found.append(program("plan", policy, jax.random.key(0), problem, belief, seen))
    found.append(program("belief", update_belief, problem, belief, seen, seen, no_action()))
    return [*found, *motions(motion)]


def motions(config: MotionConfig) -> list[Program]:
    """The motions of all kinds of action, one at a time, as a simulator on the host makes them."""
    return [program(f"motion of {kind.name}", reference_motion, kind, no_action(), config) for kind in KINDS.values()]


@contextlib.contextmanager
def prepared(programs: Sequence[Program], report: Callable[[str], None]) -> Iterator[None]:
    """Prepare programs in threads while the block runs; who calls one before it is ready waits for it.

    As many are compiled at the same time as there are cores. What is wrong with a program is said by who calls it.
    Where the block raises, what has not begun is left out.

    Args:
      programs: the longest first.
      report: is given a line when programs have to be compiled, and whenever one was: which are left, and how many are
        done.
    """
    missing = [program.name for program in programs if not program.is_ready()]
    count, lock, ended = len(missing), threading.Lock(), threading.Event()
    # What is lowered is compiled at once: a call would wait for it in vain where it never was.
    free = threading.Semaphore(max(cores(), 2))

    def say() -> None:
        left = f": {', '.join(dict.fromkeys(missing))}" if missing else ""
        report(f"compiling{left}; {count - len(missing)} of {count} done")

    def over(name: str, future: Future[None]) -> None:
        free.release()
        with lock:
            if name in missing and future.exception() is None:
                missing.remove(name)
                say()

    def lower() -> None:
        for each in programs:
            free.acquire()
            work = None
            if not ended.is_set():
                with contextlib.suppress(Exception):
                    work = each.begin()
            if work is None:
                free.release()
            else:
                threads.submit(work).add_done_callback(functools.partial(over, each.name))

    if missing:
        say()
    with ThreadPoolExecutor(len(programs) + 1) as threads:
        lowering = threads.submit(lower)
        try:
            yield
        except BaseException:
            ended.set()
            raise
        lowering.result()


def prepare(programs: Sequence[Program], report: Callable[[str], None]) -> None:
    """Prepare programs, and wait for all of them; see `prepared`."""
    with prepared(programs, report):
        pass
