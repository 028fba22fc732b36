"""Trials in several processes say what trials in this one say, and a process that dies takes no other scene with it."""

import dataclasses
import os
import signal

import numpy as np
import pytest
from test_envs_trials import EDGE, FIRM, LOOSE, MODEL, look, pushes, stack

from mechsearch_jax.envs.trials.native import NativeTrials
from mechsearch_jax.envs.trials.processes import ProcessTrials
from mechsearch_jax.planner.trials import TrialResult, scenes_of


@pytest.fixture(scope="module")
def rows(problem):
    """Three scenes, the first without the target, and what is to be tried in two of them."""
    over, away, aside = pushes()
    scenes = scenes_of(*stack(look(problem, EDGE, found=False), look(problem, LOOSE), look(problem, FIRM)))
    actions = stack(stack(over, away, aside), stack(aside, over, away), stack(over, over, over))
    return scenes, actions, np.array([[True, True, True], [True, False, True], [False, False, False]])


def until_success(results):
    """What is said of each row up to its first success, after which nothing counts."""
    firsts = [[*row, TrialResult.SUCCEEDED].index(TrialResult.SUCCEEDED) for row in results.tolist()]
    return [row[: first + 1].tolist() for row, first in zip(results, firsts, strict=True)]


@pytest.mark.slow
def test_processes_say_what_this_one_says_also_after_one_of_them_died(problem, rows):
    expected = MODEL(problem, *rows)
    assert TrialResult.HARMFUL in expected
    trials = ProcessTrials(processes=2)
    try:
        (begun,) = trials.programs(problem)
        assert not begun.is_ready()
        begun.begin()()
        assert begun.is_ready()
        for dies in (False, True):
            if dies:
                os.kill(next(iter(trials._pool._processes)), signal.SIGKILL)
            results = trials(problem, *rows)
            assert until_success(results) == until_success(expected)
            assert results[2].tolist() == [TrialResult.UNKNOWN] * 3
    finally:
        trials.close()


@pytest.mark.slow
def test_of_a_scene_that_ends_its_process_nothing_is_known(problem, rows):
    @dataclasses.dataclass(frozen=True)
    class Deadly(NativeTrials):
        def in_cell(self, cell, scenes, actions, wanted):
            if scenes.found[0]:
                os._exit(1)
            return NativeTrials.in_cell(self, cell, scenes, actions, wanted)

    expected = MODEL(problem, *rows)
    trials = ProcessTrials(Deadly(), processes=2)
    try:
        with pytest.warns(UserWarning, match="a process died as it tried actions"):
            results = trials(problem, *rows)
    finally:
        trials.close()
    assert until_success(results[:1]) == until_success(expected[:1])
    assert results[1].tolist() == [TrialResult.UNKNOWN] * 3


def test_nothing_begins_where_nothing_is_to_be_tried(problem, rows):
    scenes, actions, wanted = rows
    trials = ProcessTrials(processes=2)
    assert (trials(problem, scenes, actions, wanted & False) == TrialResult.UNKNOWN).all()
    assert trials._pool is None
    trials.close()
