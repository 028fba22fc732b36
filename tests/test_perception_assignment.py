"""The assignment problem against SciPy's solver."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from mechsearch_jax.perception.assignment import assign
from mechsearch_jax.runtime.errors import InputError

ASSIGN = jax.jit(assign)


def least(cost):
    return cost[linear_sum_assignment(cost)].sum()


def given_by(cost, columns):
    assert sorted(columns) == list(range(len(cost)))
    return cost[np.arange(len(cost)), columns].sum()


@pytest.mark.parametrize("size", [1, 2, 5, 9, 10])
def test_the_sum_is_scipys(size):
    rng = np.random.default_rng(size)
    drawn = rng.normal(size=(40, size, size))
    # Small whole numbers are equal often, as are large ones to which little is added.
    drawn[10:20] = rng.integers(-1, 2, (10, size, size))
    drawn[20:30] = 1e6 + rng.integers(0, 3, (10, size, size))
    drawn[30:] *= 10.0 ** rng.uniform(-6, 6, (10, 1, 1))
    costs = drawn.astype(np.float32)
    assigned = jax.jit(jax.vmap(assign))(costs)
    for cost, columns in zip(costs.astype(float), np.asarray(assigned), strict=True):
        assert given_by(cost, columns) == pytest.approx(least(cost), rel=1e-6, abs=1e-5 * np.abs(cost).max())
    for cost, columns in zip(costs[10:30].astype(float), np.asarray(assigned)[10:30], strict=True):
        assert given_by(cost, columns) == least(cost)


@pytest.mark.parametrize("value", [0.0, 1e30, -3e38])
def test_equal_costs_however_large_still_give_each_column_once(value):
    assert sorted(np.asarray(ASSIGN(jnp.full((9, 9), value)))) == list(range(9))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_rows_and_columns_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    cost = rng.normal(size=(9, 9)).astype(np.float32)
    rows, columns = rng.permutation(9), rng.permutation(9)
    turned = np.asarray(ASSIGN(cost[rows][:, columns]))
    assert np.array_equal(columns[turned], np.asarray(ASSIGN(cost))[rows])


def test_eager_jit_and_vmap_agree():
    costs = np.random.default_rng(1).integers(0, 4, (6, 9, 9)).astype(np.float32)
    together = np.asarray(jax.vmap(assign)(jnp.asarray(costs)))
    for cost, columns in zip(costs, together, strict=True):
        assert np.array_equal(assign(jnp.asarray(cost)), columns)
        assert np.array_equal(ASSIGN(cost), columns)


@pytest.mark.parametrize("size", [0, 11])
def test_sizes_that_it_is_not_for_are_refused(size):
    with pytest.raises(InputError, match="rows"):
        assign(jnp.zeros((size, size)))
