"""What a first decision needs is prepared while other things begin, and who waits is told for what."""

import threading

import pytest

from mechsearch_jax.envs.preparing import Program, first_decision, prepare, prepared
from mechsearch_jax.planner import search_for_grasp


def program(name, ready=False, prepare=lambda: None):
    return Program(name, lambda: ready, lambda: prepare)


def test_what_is_compiled_is_named_with_how_many_are_left():
    lines = []
    with prepared([program("a"), program("b", ready=True), program("c")], lines.append):
        pass
    assert lines[0] == "compiling: a, c; 0 of 2 done"
    assert lines[1] in ("compiling: a; 1 of 2 done", "compiling: c; 1 of 2 done")
    assert lines[2:] == ["compiling; 2 of 2 done"]


def test_programs_are_lowered_in_order_and_compiled_at_the_same_time():
    order, both = [], threading.Barrier(2, timeout=60)

    def begin(name):
        order.append(name)
        return both.wait

    prepare([Program(name, lambda: False, lambda name=name: begin(name)) for name in ("a", "b")], lambda line: None)
    assert order == ["a", "b"]
    assert not both.broken


def test_nothing_is_said_where_everything_is_there():
    lines, prepared_ones = [], []
    with prepared([program("a", True, lambda: prepared_ones.append("a"))], lines.append):
        pass
    assert lines == []
    assert prepared_ones == ["a"]


def test_the_block_runs_meanwhile():
    met = threading.Event()
    with prepared([program("a", prepare=lambda: met.wait(60))], lambda line: None):
        met.set()


def test_what_is_wrong_is_said_by_who_calls_it():
    def fail():
        raise ValueError("cannot be compiled")

    lines = []
    with prepared([program("a", prepare=fail)], lines.append):
        pass
    assert lines == ["compiling: a; 0 of 1 done"]


def test_an_error_in_the_block_is_the_blocks_own():
    with pytest.raises(KeyError), prepared([program("a")], lambda line: None):
        raise KeyError("b")


def test_a_policy_of_a_users_own_is_compiled_when_it_is_called(problem):
    names = [program.name for program in first_decision(problem, lambda *_: None)]
    assert names == ["the belief"]
    assert [program.name for program in first_decision(problem, search_for_grasp())] == ["the plan", "the belief"]
