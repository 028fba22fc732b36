"""Compilations are timed apart from what they hold up."""

import time

import jax
import jax.numpy as jnp
import pytest

from mechsearch_jax.envs.episode import compile_clock
from mechsearch_jax.envs.episode.compile_clock import EVENTS, CompileClock


def tell(seconds, event=f"{EVENTS}backend_compile_duration"):
    jax.monitoring.record_event_duration_secs(event, seconds)


def test_what_jax_compiles_is_counted_while_the_clock_runs():
    @jax.jit
    def never_seen(x):
        return jnp.sin(x) * 3.5 + jnp.cos(x)

    with CompileClock() as clock:
        start = time.perf_counter()
        never_seen(jnp.arange(7.0)).block_until_ready()
        took = time.perf_counter() - start
        assert 0.0 < clock.seconds <= took
        before = clock.seconds
        never_seen(jnp.arange(7.0)).block_until_ready()
        assert clock.seconds == before
    tell(1.0)
    assert clock.seconds == before


def test_what_is_compiled_inside_of_something_else_counts_once(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    with CompileClock() as clock:
        for at, seconds in ((100.0, 2.0), (101.0, 0.5), (104.0, 6.0)):
            now[0] = at
            tell(seconds)
        assert clock.seconds == pytest.approx(6.0)
        now[0] = 110.0
        tell(1.0)
        tell(50.0, "/jax/something/else")
        assert clock.seconds == pytest.approx(7.0)


def test_a_stage_is_timed_without_what_was_compiled_in_it(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    with CompileClock() as compiling:
        clock = compile_clock.StageClock(2, lambda stage, slots: None, compiling)
        for stage, rows, compiled, other in (("plan", [0, 1], 8.0, 2.0), ("judge", [1], 0.0, 3.0)):
            with clock(stage, rows):
                now[0] += compiled
                if compiled:
                    tell(compiled)
                now[0] += other
    assert clock.timings(0) == {"plan": 1.0, "compile": 4.0}
    assert clock.timings(1) == {"plan": 1.0, "compile": 4.0, "judge": 3.0}
