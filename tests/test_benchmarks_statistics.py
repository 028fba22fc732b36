"""Intervals of rates, and actions until a goal: they hold what they say, counted by hand and as SciPy does."""

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
from mechsearch_jax.benchmarks.statistics.intervals import (
    mean_interval,
    mean_intervals,
    share_interval,
    wilson,
)
from mechsearch_jax.benchmarks.statistics.paired import PairedDifference, paired
from mechsearch_jax.benchmarks.statistics.rates import GOALS
from mechsearch_jax.benchmarks.statistics.variants import label_variants
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.planner import PRESETS

DRAWS = 2000


def coverage(interval, share, scenes, seeds, correlation):
    """How often an interval holds the share that episodes were drawn with; scenes differ by a beta distribution."""
    rng = np.random.default_rng(scenes * seeds)
    each = np.full((DRAWS, scenes), share)
    if correlation:
        a, b = (part * (1 - correlation) / correlation for part in (share, 1 - share))
        each = rng.beta(a, b, (DRAWS, scenes))
    reached = rng.random((DRAWS, scenes, seeds)) < each[..., None]
    names = np.repeat(np.arange(scenes), seeds).tolist()
    bounds = [interval(episodes, names) for episodes in reached.reshape(DRAWS, -1).tolist()]
    return np.mean([low <= share <= high for low, high in bounds])


@pytest.mark.parametrize("correlation", [0.0, 0.3])
@pytest.mark.parametrize(
    ("share", "scenes", "seeds"),
    [(0.5, 25, 4), (0.7, 25, 4), (0.85, 25, 2), (0.85, 100, 4), (0.9, 50, 8), (0.95, 100, 4)],
)
def test_an_interval_holds_the_true_share_as_often_as_it_says(share, scenes, seeds, correlation):
    # Of 2,000 draws a chance of 0.95 makes 0.94 to 0.96.
    assert 0.92 <= coverage(share_interval, share, scenes, seeds, correlation) <= 0.98


def test_where_each_scene_has_one_episode_it_is_wilsons():
    for successes in range(9):
        assert share_interval([i < successes for i in range(8)], range(8)) == wilson(successes, 8)
    assert share_interval([], []) == (0.0, 1.0)


@pytest.mark.parametrize("reached", [True, False])
def test_where_all_end_alike_each_scene_counts_once(reached):
    for scenes, seeds in ((25, 4), (6, 30), (1, 16)):
        names = [i for i in range(scenes) for _ in range(seeds)]
        expected = wilson(scenes if reached else 0, scenes)
        assert share_interval([reached] * len(names), names) == pytest.approx(expected)


def test_the_same_seeds_again_are_not_twice_as_much():
    once = [i % 4 > 0 for i in range(24)]
    assert share_interval(once * 8, list(range(24)) * 8) == pytest.approx(share_interval(once, range(24)))
    # Nor less, whatever the order.
    mixed = share_interval([True, True, False, True, True, False], ["a", "b", "a", "a", "b", "b"])
    assert mixed == share_interval([False, True, False, True, True, True], ["a", "b", "b", "a", "b", "a"])
    low, high = mixed
    assert low < wilson(4, 6)[0] < wilson(4, 6)[1] < high


def test_a_mean_is_of_scenes_drawn_again():
    steps = [1, 1, 2, 3, 3, 3, 5, 8, 2, 2]
    names = list(range(len(steps)))
    low, high = mean_interval(steps, names)
    expected = scipy.stats.bootstrap(
        (steps,), np.mean, n_resamples=20_000, method="percentile", rng=np.random.default_rng(1)
    ).confidence_interval
    assert (low, high) == pytest.approx((expected.low, expected.high), abs=0.12)
    # The same again with another seed is not twice as much.
    assert mean_interval(steps * 3, names * 3) == (low, high)
    assert mean_interval([4, 4], "ab") == (4.0, 4.0)
    assert mean_interval([4, 5], "aa") is mean_interval([], []) is None


def test_intervals_do_not_depend_on_the_order_of_episodes():
    rng = np.random.default_rng(0)
    scenes, values = rng.integers(0, 40, 300), rng.normal(size=300)
    reached = rng.random(300) < 0.7
    order = rng.permutation(300)
    for function, of in (
        (share_interval, reached),
        (mean_interval, values),
        (PairedDifference.of, values),
        (lambda values, scenes: PairedDifference.of(values, scenes).interval, values),
    ):
        assert function(of.tolist(), scenes.tolist()) == function(of[order].tolist(), scenes[order].tolist())


def test_a_mean_holds_the_true_one_as_often_as_it_says():
    """Of 40 scenes with 3 episodes each, whose means differ."""
    rng = np.random.default_rng(0)
    names = np.repeat(np.arange(40), 3).tolist()
    draws = rng.normal(size=(300, 40, 1)) + rng.normal(size=(300, 40, 3))
    bounds = [mean_interval(values, names) for values in draws.reshape(300, -1).tolist()]
    assert 0.9 <= np.mean([low <= 0.0 <= high for low, high in bounds]) <= 0.98


def test_a_paired_difference_is_of_scenes():
    change = PairedDifference.of([1, 1, 1, -1, 0], ["a", "a", "a", "b", "c"])
    assert change == PairedDifference((-1.0, 0.0, 1.0), 5, 3, 1)
    assert (change.scenes, change.mean, change.standard_error) == (3, 0.0, pytest.approx(1 / 3**0.5))
    assert change.interval == (-1.0, 1.0)
    alone = PairedDifference.of([2.0], ["a"])
    assert (alone.mean, alone.standard_error, alone.interval) == (2.0, None, None)
    assert PairedDifference.of([], []).mean is None


def test_many_intervals_at_once_are_those_of_each_alone(monkeypatch):
    """Of as many scenes and of others, in stacks of several and of one; whole numbers to the bit."""
    rng = np.random.default_rng(3)
    samples = [
        (rng.integers(0, 11, 2 * scenes).tolist(), [f"s{i}" for i in range(scenes)] * 2)
        for scenes in (7, 30, 7, 1, 7, 0)
    ]
    alone = [mean_interval(*sample) for sample in samples]
    assert mean_intervals(samples) == alone
    assert [interval is None for interval in alone] == [False, False, False, True, False, True]
    monkeypatch.setattr("mechsearch_jax.benchmarks.statistics.intervals.STACKED", 14)
    assert mean_intervals(samples) == alone
    assert mean_intervals([]) == []


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
    rows = [row for row in report_bench.drawn_rows(96 * 4 * 10) if row.gamma == 0.9 and row.horizon == 3]
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
