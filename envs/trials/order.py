"""The order in which several threads run trials in many scenes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from mechsearch_jax.planner.trials import TrialResult

# Threads for each row: the more trials run, the longer each waits for Python's lock, and the first mostly decides.
# One alone takes 75 ms on an H200's host, beside three others 109, beside seven 135.
THREADS = 2
# Tries a column of a row; returns None if `needed` turns False meanwhile.
Attempt = Callable[[int, int, Callable[[], bool]], TrialResult | None]


class Once:
    """What is computed once for each key, by the thread that asks first; others wait for it."""

    def __init__(self) -> None:
        self._lock, self._made = threading.Lock(), dict[Any, Future[Any]]()

    def begun(self, key: Any) -> Future[Any] | None:
        """What a thread computes, or has computed, for a key; None if none has asked."""
        return self._made.get(key)

    def __call__(self, key: Any, make: Callable[[], Any]) -> Any:
        """What `make` returns, or what it raises."""
        with self._lock:
            first = key not in self._made
            future = self._made.setdefault(key, Future())
        if first:
            try:
                future.set_result(make())
            except BaseException as error:
                future.set_exception(error)
        return future.result()


class _Row:
    """The state of a row's trials.

    Attributes:
      left: columns that no thread has begun, in order.
      begun: number of columns that were begun.
      first: the first column that has succeeded so far; the number of columns if none has.
    """

    def __init__(self, wanted: Bool[np.ndarray, " k"]):
        self.left = np.flatnonzero(wanted).tolist()
        self.begun = 0
        self.first = len(wanted)


def in_order(wanted: Bool[np.ndarray, "n k"], threads: int, attempt: Attempt) -> Int[np.ndarray, "n k"]:
    """The results of the wanted trials of each row, as `TrialResult`, up to the row's first success.

    Threads take the first column of every row, then the next column of rows without a success, and so on. An idle
    thread also starts trials that may turn out not to be needed, and stops them when they do. Results of a row up to
    its first success therefore do not depend on the number of threads; those after it mean nothing.

    Args:
      wanted: the trials to run, the best column first.
      threads: largest number of trials that run at the same time; at most `THREADS` for each row.
      attempt: runs a trial; called in a thread.
    """
    results = np.full(wanted.shape, TrialResult.UNKNOWN, np.int32)
    rows = {int(r): _Row(wanted[r]) for r in np.flatnonzero(wanted.any(axis=1))}
    lock = threading.Lock()

    def next_trial() -> tuple[int, int] | None:
        with lock:
            open_rows = [(row.begun, r) for r, row in rows.items() if row.left and row.left[0] < row.first]
            if not open_rows:
                return None
            _, r = min(open_rows)
            rows[r].begun += 1
            return r, rows[r].left.pop(0)

    def work() -> None:
        while (trial := next_trial()) is not None:
            r, i = trial
            row = rows[r]
            result = attempt(r, i, lambda row=row, i=i: i < row.first)
            if result is None:
                continue
            results[r, i] = result
            if result is TrialResult.SUCCEEDED:
                with lock:
                    row.first = min(row.first, i)

    count = min(threads, THREADS * len(rows), int(wanted.sum()))
    if count == 1:
        work()
    elif count > 1:
        with ThreadPoolExecutor(count) as pool:
            for done in [pool.submit(work) for _ in range(count)]:
                done.result()
    return results
