"""Measures how long the stages of a step take, and how long this process waits for JAX to compile."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType

import jax.monitoring

# Prefix of JAX's events for tracing, lowering and compiling, and for reading compiled programs from disk.
EVENTS = "/jax/core/compile/"


class CompileClock:
    """Wall time that JAX has spent on compiling, tracing included, since the clock was started.

    Nested spans, such as tracing one function while tracing another, count once.

    Attributes:
      seconds: so far [s].
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._spans: list[tuple[float, float]] = []

    def __enter__(self) -> CompileClock:
        jax.monitoring.register_event_duration_secs_listener(self._took)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        jax.monitoring.unregister_event_duration_listener(self._took)

    def _took(self, event: str, duration_secs: float, **details: str | int) -> None:
        """Add a span that ends now."""
        if not event.startswith(EVENTS):
            return
        end = time.perf_counter()
        start = end - duration_secs
        while self._spans and self._spans[-1][1] > start:
            inside = self._spans.pop()
            self.seconds -= inside[1] - inside[0]
            start = min(start, inside[0])
        self._spans.append((start, end))
        self.seconds += end - start


class StageClock:
    """Wall time of the stages of a step, shared equally by the slots that took part.

    Time that JAX spent on compiling meanwhile is kept separately as "compile".
    """

    def __init__(self, slots: int, busy: Callable[[str, int], None], compiling: CompileClock) -> None:
        self._timings: list[dict[str, float]] = [{} for _ in range(slots)]
        self._busy = busy
        self._compiling = compiling

    @contextmanager
    def __call__(self, stage: str, rows: Sequence[int]) -> Iterator[None]:
        if rows:
            self._busy(stage, len(rows))
        start, before = time.perf_counter(), self._compiling.seconds
        yield
        took, compiled = time.perf_counter() - start, self._compiling.seconds - before
        for row in rows:
            timings = self._timings[row]
            timings[stage] = round(timings.get(stage, 0.0) + max(took - compiled, 0.0) / len(rows), 6)
            if compiled:
                timings["compile"] = round(timings.get("compile", 0.0) + compiled / len(rows), 6)

    def timings(self, row: int) -> dict[str, float]:
        """The timings of a slot since they were last read."""
        timings, self._timings[row] = self._timings[row], {}
        return timings
