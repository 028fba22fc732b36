"""Actions until a goal: what is counted by hand, what SciPy says of the same times, and the share of a gap."""

import dataclasses

import numpy as np
import pytest
import scipy.stats
from stored_rows import row_of

from mechsearch_jax.benchmarks.report import report_bench
from mechsearch_jax.benchmarks.statistics.actions_until import (
    budget_of,
    horizon_of,
    reached,
    restricted_means,
    restricted_steps,
)
from mechsearch_jax.benchmarks.statistics.paired import paired
from mechsearch_jax.benchmarks.statistics.rates import GOALS
from mechsearch_jax.benchmarks.statistics.variants import label_variants
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.planner import PRESETS

LOST = {"retrieved": False, "graspable_step": None, "steps": 10, "failure": "found, but not graspable"}
# On four scenes: retrieved after 3 actions; found, and its budget spent; tipped at the first action; an error.
ROWS = [
    row_of("c2-2-000"),
    row_of("c2-2-001", **{**LOST, "found_step": 4}),
    row_of("c2-8-000", **{**LOST, "found_step": None, "steps": 1, "failure": "the target fell over at action 1"}),
    row_of("c2-8-001", **{**LOST, "found_step": None, "steps": 0, "failure": "error: x"}),
]
TWENTY = Method(config=PRESETS["standard"](max_steps=20))


def test_an_episode_that_fails_never_gets_there_however_early_it_ends():
    assert [restricted_steps(row, "found", 10) for row in ROWS] == [1, 4, 10, 10]
    assert [restricted_steps(row, "graspable", 10) for row in ROWS] == [2, 10, 10, 10]
    assert [restricted_steps(row, "retrieved", 10) for row in ROWS] == [3, 11, 11, 11]


def test_the_retrieval_is_an_action_after_those_of_the_budget():
    last = row_of("c2-2-002", found_step=10, graspable_step=10, steps=11)
    never = dataclasses.replace(last, retrieved=False, failure="the arm was held up")
    assert horizon_of("found", 10) == horizon_of("graspable", 10) == 10
    assert [restricted_steps(row, "retrieved", 10) for row in (last, never)] == [11, 11]
    assert reached([last, never], "retrieved", 11) == [0] * 11 + [1]
    assert reached([last, never], "found", 10) == [0] * 10 + [2]


def test_means_are_counted_by_hand():
    everything = restricted_means(ROWS, ["objects"])[-1]
    assert (everything.episodes, everything.budget, everything.objects) == (4, 10, None)
    assert (everything.found, everything.graspable, everything.retrieved) == (25 / 4, 32 / 4, 36 / 4)
    two, eight = restricted_means(ROWS, ["objects"])[:2]
    assert (two.found, two.retrieved, eight.found, eight.retrieved) == (2.5, 7.0, 10.0, 11.0)
    # With two scenes all draws are those of one, of both, or of the other.
    assert (two.found_interval, eight.found_interval) == ((1.0, 4.0), (10.0, 10.0))


def test_episodes_with_another_budget_are_counted_up_to_the_smaller_one():
    late = row_of("c2-2-003", TWENTY, found_step=13, graspable_step=None, steps=15)
    assert (budget_of([late]), budget_of([late, *ROWS]), budget_of(ROWS)) == (20, 10, 10)
    assert [restricted_steps(late, goal, 20) for goal in GOALS] == [13, 20, 15]
    assert [restricted_steps(late, goal, 10) for goal in GOALS] == [10, 10, 11]
    early = dataclasses.replace(ROWS[0], configuration="{}")
    assert budget_of([early, late]) == 10


def test_the_mean_is_the_area_above_the_curve_as_scipy_draws_it():
    """Failures and the spent budget are censored at the horizon, not where they happened."""
    rows = [row for row in report_bench.drawn_rows(96 * 4 * 40) if row.gamma == 0.9 and row.horizon == 3]
    assert 0.1 < np.mean([not row.retrieved for row in rows]) < 0.9
    mean = restricted_means(rows, ["target"])[0]
    for goal in GOALS:
        horizon = horizon_of(goal, 10)
        steps = [restricted_steps(row, goal, 10) for row in rows]
        counts = reached(rows, goal, horizon)
        never = len(rows) - counts[-1]
        data = scipy.stats.CensoredData(
            uncensored=[step for step in steps if step < horizon],
            right=[float(horizon)] * (never + counts[-1] - counts[-2]),
        )
        curve = scipy.stats.ecdf(data).sf
        area = float(np.sum(curve.evaluate(np.arange(horizon, dtype=float))))
        assert getattr(mean, goal) == pytest.approx(area, abs=1e-12)
        assert getattr(mean, goal) == pytest.approx(sum(1 - count / len(rows) for count in counts[:-1]), abs=1e-12)
        # Kaplan and Meier's estimate, with failures censored where they happened, would be lower.
        ended = [min(row.steps, horizon) for row in rows]
        failed = scipy.stats.CensoredData(
            uncensored=[step for step in steps if step < horizon],
            right=[float(end) for step, end in zip(steps, ended, strict=True) if step == horizon],
        )
        assert float(np.sum(scipy.stats.ecdf(failed).sf.evaluate(np.arange(horizon, dtype=float)))) <= area + 1e-12


def times(name, steps, policy="greedy"):
    """Rows that are found after so many actions, on a scene each; never where that is None."""
    method = Method(policy)
    return [
        row_of(f"c2-2-{i:03d}", method, found_step=step, **(LOST if step is None else {}))
        for i, step in enumerate(steps)
    ]


def test_differences_count_pairs_that_never_got_there():
    other = times("p", [2, None, 3], "random")
    base = times("s", [1, 4, None])
    label = label_variants([*base, *other])[0]
    ((_, goals),) = paired([*base, *other], label).items()
    assert (goals["found_steps"].pairs, goals["found_steps"].mean) == (1, 1.0)
    assert (goals["found_restricted_steps"].pairs, goals["found_restricted_steps"].mean) == (3, (1 + 6 - 7) / 3)
