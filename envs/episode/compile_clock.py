"""How long this process waits for JAX to compile."""

from __future__ import annotations

import time
from types import TracebackType

import jax.monitoring

# What JAX tells of tracing, lowering and compiling, or of reading what was compiled before.
EVENTS = "/jax/core/compile/"


class CompileClock:
    """Wall time that JAX has spent on compiling, from tracing on, since the clock was started.

    What happens inside of something else, as one function is traced while another is, counts once.

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
        """Take note of a span that ends now."""
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
