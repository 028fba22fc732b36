"""What a first decision needs is prepared while other things begin, and who waits is told for what."""

import threading

import pytest

from mechsearch_jax.envs.warm_up import Program, first_decision, prepared
from mechsearch_jax.planner import search_for_grasp


def program(name, ready=False, prepare=lambda: None):
    return Program(name, lambda: ready, prepare)


def test_what_is_compiled_is_named_with_how_many_are_left():
    lines = []
    with prepared([program("a"), program("b", ready=True), program("c")], lines.append):
        pass
    assert lines[0] == "compiling a and c, once: 2 left"
    assert sorted(line.partition(":")[0] for line in lines[1:]) == ["compiled a", "compiled c"]
    assert lines[-1].endswith(": 0 left")


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
    assert lines == ["compiling a, once: 1 left"]


def test_an_error_in_the_block_is_the_blocks_own():
    with pytest.raises(KeyError), prepared([program("a")], lambda line: None):
        raise KeyError("b")


def test_a_policy_of_a_users_own_is_compiled_when_it_is_called(problem):
    names = [program.name for program in first_decision(problem, lambda *_: None)]
    assert names == ["the belief"]
    assert [program.name for program in first_decision(problem, search_for_grasp())] == ["the plan", "the belief"]
    # Nothing is kept in this process, so that there is nothing to wait for.
    assert all(program.is_ready() for program in first_decision(problem, search_for_grasp()))
