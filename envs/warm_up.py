"""What a first decision needs, read or compiled at the same time as everything else begins."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mechsearch_jax.actions import no_action
from mechsearch_jax.envs.world import TARGET
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Policy, Problem, initial_belief, update_belief
from mechsearch_jax.planner.policies import Search


class Program(NamedTuple):
    """Something that is compiled as a whole.

    Attributes:
      name: of what it computes.
      is_ready: whether it was compiled before.
      prepare: reads or compiles it.
    """

    name: str
    is_ready: Callable[[], bool]
    prepare: Callable[[], None]


def first_decision(problem: Problem, policy: Policy) -> list[Program]:
    """What takes long to compile of a first look and a first decision; that which takes longest first."""
    # Only shapes and types count.
    shapes = jax.eval_shape(lambda: Observation(empty(TARGET), jnp.array(False), jnp.zeros(3)))
    seen: Observation = jax.tree.map(lambda s: jax.device_put(np.zeros(s.shape, s.dtype)), shapes)
    belief = initial_belief(problem)
    found = []
    if isinstance(policy, Search):
        found.append(_program("the plan", policy, jax.random.key(0), problem, belief, seen))
    return [*found, _program("the belief", update_belief, problem, belief, seen, seen, no_action())]


def _program(name: str, function: Any, *args: Any) -> Program:
    return Program(name, functools.partial(function.is_ready, *args), functools.partial(function.prepare, *args))


@contextlib.contextmanager
def prepared(programs: Sequence[Program], told: Callable[[str], None]) -> Iterator[None]:
    """Prepare programs in threads while the block runs; who calls one before it is ready waits for it.

    What is wrong with a program is said by who calls it. Where the block raises, what has not begun is left out.

    Args:
      programs: the longest first.
      told: is given a line when programs have to be compiled, and whenever one was: which, and how many are left.
    """
    missing = [program.name for program in programs if not program.is_ready()]
    if missing:
        told(f"compiling {' and '.join(missing)}, once: {len(missing)} left")

    def ready(name: str, future: Future[None]) -> None:
        if name in missing and not future.cancelled() and future.exception() is None:
            missing.remove(name)
            told(f"compiled {name}: {len(missing)} left")

    with ThreadPoolExecutor(max(len(programs), 1)) as threads:
        try:
            for program in programs:
                threads.submit(program.prepare).add_done_callback(functools.partial(ready, program.name))
            yield
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            raise
