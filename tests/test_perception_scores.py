"""How well shapes are recognised: overlaps, and distances of solids."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation
from scipy.special import gamma

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.perception import scores
from mechsearch_jax.perception.assignment import assign
from mechsearch_jax.perception.doubt import Thing
from mechsearch_jax.perception.overlaps import depth_in_each_other
from mechsearch_jax.perception.solids import entries, penetrations, surface_distance
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.render import object_depth
from mechsearch_jax.workspace.scenario import rotation_matrix

BOX, CYLINDER = shape_of("box").exponents, shape_of("cylinder").exponents


def bodies(size, exponents, position, rotation):
    size = np.float32(size)
    n = len(size)
    return Superquadrics(
        size=jnp.asarray(size),
        exponents=jnp.broadcast_to(jnp.asarray(exponents, jnp.float32), (n, 2)),
        position=jnp.asarray(np.float32(position)),
        rotation=jnp.asarray(np.float32(rotation)),
        valid=jnp.ones(n, bool),
    )


def random_poses(rng, n):
    return rng.uniform(-1, 1, (n, 3)), Rotation.random(n, random_state=rng).as_matrix()


@pytest.mark.parametrize("seed", range(2))
def test_boxes_that_are_moved_along_their_axes_have_the_iou_of_the_closed_form(seed):
    rng = np.random.default_rng(seed)
    n = 200
    size, other = rng.uniform(0.02, 0.1, (n, 3)), rng.uniform(0.02, 0.1, (n, 3))
    position, rotation = random_poses(rng, n)
    shift = rng.uniform(-0.05, 0.05, (n, 3))
    a = scores.sharpened(bodies(size, BOX, position, rotation))
    b = scores.sharpened(bodies(other, BOX, position + np.einsum("nij,nj->ni", rotation, shift), rotation))
    overlap = np.minimum(size, shift + other) - np.maximum(-size, shift - other)
    shared = np.prod(np.maximum(overlap, 0.0), axis=1)
    exact = shared / (8 * size.prod(axis=1) + 8 * other.prod(axis=1) - shared)
    error = np.abs(scores.intersection_over_union(a, b) - exact)
    assert error.max() < 0.01
    assert error.mean() < 0.003


def test_cylinders_that_are_moved_sideways_have_the_iou_of_two_lenses():
    rng = np.random.default_rng(2)
    n = 200
    radius, half = rng.uniform(0.02, 0.06, n), rng.uniform(0.03, 0.1, n)
    distance, lift = rng.uniform(0.0, 1.9, n) * radius, rng.uniform(0.0, 1.0, n) * half
    position, rotation = random_poses(rng, n)
    azimuth = rng.uniform(0, 2 * np.pi, n)
    shift = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), lift], axis=1)
    size = np.stack([radius, radius, half], axis=1)
    a = scores.sharpened(bodies(size, CYLINDER, position, rotation))
    b = scores.sharpened(bodies(size, CYLINDER, position + np.einsum("nij,nj->ni", rotation, shift), rotation))
    lens = 2 * radius**2 * np.arccos(distance / 2 / radius) - distance / 2 * np.sqrt(4 * radius**2 - distance**2)
    shared = lens * (2 * half - lift)
    exact = shared / (2 * np.pi * radius**2 * 2 * half - shared)
    error = np.abs(scores.intersection_over_union(a, b) - exact)
    assert error.max() < 0.01
    assert error.mean() < 0.003


def test_rounded_edges_cap_a_perfect_fit():
    """The caps of exponents of 0.2 against true boxes and cylinders."""
    size = [[0.05, 0.03, 0.08], [0.03, 0.03, 0.06]]
    rounded = bodies(size, BOX, np.zeros((2, 3)), np.broadcast_to(np.eye(3), (2, 3, 3)))
    rounded = rounded.replace(exponents=jnp.array([BOX, CYLINDER]))
    caps = scores.intersection_over_union(rounded, scores.sharpened(rounded))
    np.testing.assert_allclose(caps, [0.955, 0.968], atol=0.006)
    np.testing.assert_allclose(scores.intersection_over_union(rounded, rounded), 1.0, atol=0.01)


@pytest.mark.parametrize(("e1", "e2"), [(0.01, 0.01), (0.01, 1.0), (0.2, 0.2), (0.2, 1.0), (1.0, 1.0), (1.5, 0.7)])
def test_volume_is_the_textbook_formula(e1, e2):
    def beta(x, y):
        return gamma(x) * gamma(y) / gamma(x + y)

    a = np.array([0.03, 0.05, 0.08])
    exact = 2 * a.prod() * e1 * e2 * beta(e1 / 2 + 1, e1) * beta(e2 / 2, e2 / 2)
    computed = scores.volume(jnp.asarray(a, jnp.float32), jnp.array([e1, e2]))
    np.testing.assert_allclose(computed, exact, rtol=1e-4)


def test_empty_slots_and_batches():
    rng = np.random.default_rng(3)
    position, rotation = random_poses(rng, 6)
    a = bodies(rng.uniform(0.02, 0.1, (6, 3)), BOX, position, rotation)
    b = a.replace(position=a.position + 0.01, valid=a.valid.at[2].set(False))
    value = scores.intersection_over_union(a, b)
    assert value[2] == 0.0
    assert jnp.all((value > 0.1) == b.valid)
    assert jnp.isinf(scores.centre_error(a, b)[2])
    np.testing.assert_allclose(scores.centre_error(a, b)[:2], 0.01 * 3**0.5, rtol=1e-4)
    stack = jax.tree.map(lambda x: jnp.stack([x, x]), (a, b))
    np.testing.assert_allclose(scores.intersection_over_union(*stack)[1], value, atol=1e-6)
    np.testing.assert_allclose(jax.vmap(scores.intersection_over_union)(*stack)[0], value, atol=1e-6)
    np.testing.assert_allclose(scores.intersection_over_union(b, a), value, atol=1e-6)


COUNT = 6


@pytest.fixture(scope="module")
def objects():
    """Boxes and cylinders, in all directions, near each other."""
    rng = np.random.default_rng(3)
    is_round = np.arange(COUNT) % 2 == 1
    size = rng.uniform(0.02, 0.08, (COUNT, 3))
    size[is_round, 1] = size[is_round, 0]
    exponents = np.where(is_round[:, None], [0.01, 1.0], [0.01, 0.01])
    rotation = rotation_matrix(rng.normal(size=(COUNT, 4)))
    place = np.array([0.6, 0.0, 0.9]) + rng.uniform(-0.1, 0.1, (COUNT, 3))
    return Superquadrics(*(jnp.float32(a) for a in (size, exponents, place, rotation)), jnp.ones(COUNT, bool))


def things(objects):
    rows = zip(*(np.asarray(a, float) for a in (objects.size, objects.rotation, objects.position)), strict=True)
    return [Thing("", size, i % 2 == 1, rotation, place) for i, (size, rotation, place) in enumerate(rows)]


def test_distances_are_those_of_the_check_of_recognition(objects):
    points = np.float32([0.6, 0.0, 0.9]) + np.random.default_rng(1).uniform(-0.2, 0.2, (500, 3)).astype(np.float32)
    signed = np.asarray(surface_distance(objects, jnp.asarray(points)))
    expected = [thing.gap(points) for thing in things(objects)]
    np.testing.assert_allclose(np.abs(signed), expected, atol=1e-5)
    assert (signed < 0).any()
    assert (signed > 0).any()


def test_rays_enter_where_the_renderer_sees_the_surface(objects):
    rng = np.random.default_rng(2)
    origin, enters = np.float32([-0.4, 0.1, 1.2]), jax.jit(entries, static_argnums=3)
    ends = np.float32([0.6, 0.0, 0.9]) + rng.uniform(-0.15, 0.15, (800, 3)).astype(np.float32)
    directions = ends - origin
    enter = np.asarray(enters(objects, origin, directions))
    seen = np.asarray(jax.jit(jax.vmap(object_depth, (0, None, None)))(objects, origin, directions))
    both = np.isfinite(enter) & np.isfinite(seen)
    assert both.sum() > 300
    # The renderer's edges are a little round.
    assert (np.isfinite(enter) == np.isfinite(seen)).mean() > 0.98
    assert np.quantile(np.abs(enter - seen)[both], 0.95) < 1e-3
    absent = objects.replace(valid=jnp.zeros(COUNT, bool))
    assert not np.isfinite(enters(absent, origin, directions)).any()
    smaller = np.isfinite(enters(objects, origin, directions, 0.01))
    assert smaller.sum() < np.isfinite(enter).sum()
    assert (np.isfinite(enter) | ~smaller).all()


def test_penetrations_are_those_of_the_warning(objects):
    depth = np.asarray(penetrations(objects))
    for i, a in enumerate(things(objects)):
        for j, b in enumerate(things(objects)):
            if i == j:
                assert depth[i, j] == -np.inf
            elif np.isfinite(exact := depth_in_each_other(a, b)):
                # With fewer directions the bound is a little larger.
                assert exact - 1e-4 <= depth[i, j] <= exact + 0.01


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
