"""In which order what is to be tried in many scenes is tried, by several threads."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Bool, Int

from mechsearch_jax.planner.trials import TrialResult

Scene = TypeVar("Scene")
# Tries column i of row r in its scene; None where `needed` says meanwhile that nobody wants to know any more.
Attempt = Callable[[Scene, int, int, Callable[[], bool]], TrialResult | None]


class _Row(Generic[Scene]):
    """What is left to be tried in a scene.

    Attributes:
      left: the columns that no thread has begun, in their order.
      begun: how many were.
      first: the first column that is known to succeed; as many as there are where none is.
      lock: held by who makes the scene.
      scene: one, once it is made.
    """

    def __init__(self, wanted: Bool[np.ndarray, " k"]):
        self.left = np.flatnonzero(wanted).tolist()
        self.begun = 0
        self.first = len(wanted)
        self.lock = threading.Lock()
        self.scene: list[Scene] = []


def in_order(
    wanted: Bool[np.ndarray, "n k"],
    threads: int,
    make: Callable[[int], Scene],
    attempt: Attempt[Scene],
) -> Int[np.ndarray, "n k"]:
    """What becomes of what is wanted in each row, as `TrialResult`, up to the first that succeeds.

    The best of every row comes first, then the next of those rows where nothing has succeeded yet. A free thread also
    tries what may turn out not to be needed; it stops when it does. So what is said of a row up to its first success
    never depends on the threads, and what comes after it means nothing.

    Args:
      wanted: what is to be tried, the best first.
      threads: how many trials run at the same time.
      make: the scene of a row; called once, in a thread.
      attempt: tries; called in a thread.
    """
    results = np.full(wanted.shape, TrialResult.UNKNOWN, np.int32)
    rows: dict[int, _Row[Scene]] = {int(r): _Row(wanted[r]) for r in np.flatnonzero(wanted.any(axis=1))}
    lock = threading.Lock()

    def next_one() -> tuple[int, int] | None:
        with lock:
            open_rows = [(row.begun, r) for r, row in rows.items() if row.left and row.left[0] < row.first]
            if not open_rows:
                return None
            _, r = min(open_rows)
            rows[r].begun += 1
            return r, rows[r].left.pop(0)

    def work() -> None:
        while (one := next_one()) is not None:
            r, i = one
            row = rows[r]
            with row.lock:
                if not row.scene:
                    row.scene.append(make(r))
            result = attempt(row.scene[0], r, i, lambda row=row, i=i: i < row.first)
            if result is None:
                continue
            results[r, i] = result
            if result is TrialResult.SUCCEEDED:
                with lock:
                    row.first = min(row.first, i)

    count = min(threads, int(wanted.sum()))
    if count == 1:
        work()
    elif count > 1:
        with ThreadPoolExecutor(count) as pool:
            for done in [pool.submit(work) for _ in range(count)]:
                done.result()
    return results
