"""Masked evaluation against plain `vmap`, and collision tests against equation 5 in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mechsearch_jax.geometry import collision, masked, transforms
from mechsearch_jax.geometry.collision import Pair
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.workspace.shelf import Shelf, hits_shelf, spheres_hit_shelf


def function(shared, row, i):
    return shared * row["a"][i], {"b": row["b"][...] + i}


@pytest.fixture(params=["cpu", "gpu"])
def platform(request, monkeypatch):
    """What is traced is meant for one or the other, wherever it runs."""
    monkeypatch.setattr(masked, "on_cpu", lambda: request.param == "cpu")
    monkeypatch.setattr(masked, "GPU_BLOCKS", 2)


def test_a_default_device_says_what_is_traced_for(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not masked.on_cpu()
    for device in ("cpu", jax.devices("cpu")[0]):
        with jax.default_device(device):
            assert masked.on_cpu()


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("block", [1, 4, 64])
def test_masked_entries_are_those_of_vmap_and_the_others_zero(block):
    mask = jnp.arange(23) % 3 == 0
    row = {"a": jnp.arange(23.0), "b": jnp.int32(5)}
    got = masked_vmap(function, mask, jnp.float32(2.0), row, block=block)
    expected = jax.vmap(function, in_axes=(None, None, 0))(jnp.float32(2.0), row, jnp.arange(23))
    np.testing.assert_array_equal(got[0], jnp.where(mask, expected[0], 0))
    np.testing.assert_array_equal(got[1]["b"], jnp.where(mask, expected[1]["b"], 0))


def test_a_batch_is_what_its_rows_are_alone():
    masks = jax.random.bernoulli(jax.random.key(0), 0.3, (6, 40))
    rows = {"a": jax.random.normal(jax.random.key(1), (6, 40)), "b": jnp.arange(6)}

    def run(mask, row):
        return masked_vmap(function, mask, jnp.float32(3.0), row)

    together = jax.jit(jax.vmap(run))(masks, rows)
    for i in range(6):
        alone = run(masks[i], {"a": rows["a"][i], "b": rows["b"][i]})
        np.testing.assert_array_equal(together[0][i], alone[0])
        np.testing.assert_array_equal(together[1]["b"][i], alone[1]["b"])


@pytest.mark.parametrize("most", [10, 160, 200])
def test_a_batch_with_too_many_indices_runs_in_pieces(monkeypatch, most):
    masks = jax.random.bernoulli(jax.random.key(0), 0.5, (3, 4, 40))
    a, b = jax.random.normal(jax.random.key(1), (3, 4, 40)), jnp.arange(4)
    run = lambda m, a, b: masked_vmap(function, m, jnp.float32(1.0), {"a": a, "b": b})  # noqa: E731
    batched = jax.vmap(jax.vmap(run), in_axes=(0, 0, None))
    whole = batched(masks, a, b)
    monkeypatch.setattr(masked, "LARGEST_INDEX", most)
    jax.tree.map(np.testing.assert_array_equal, batched(masks, a, b), whole)


def test_batches_nest_and_shared_values_may_be_batched_too():
    masks = jax.random.bernoulli(jax.random.key(0), 0.5, (2, 3, 10))
    rows = {"a": jax.random.normal(jax.random.key(1), (2, 3, 10)), "b": jnp.zeros((2, 3), jnp.int32)}
    scale = jnp.array([1.0, 10.0])
    run = lambda s, m, r: masked_vmap(function, m, s, r)[0]  # noqa: E731
    got = jax.vmap(jax.vmap(run, in_axes=(None, 0, 0)))(scale, masks, rows)
    np.testing.assert_allclose(got, jnp.where(masks, rows["a"] * scale[:, None, None], 0.0))


def test_rows_may_vary_along_some_axes_of_a_batch_only():
    masks = jnp.ones((2, 3, 10), bool)
    outer, inner = jax.random.normal(jax.random.key(0), (2, 10)), jnp.arange(3)
    run = lambda m, a, b: masked_vmap(function, m, jnp.float32(1.0), {"a": a, "b": b})  # noqa: E731
    got = jax.jit(jax.vmap(jax.vmap(run, in_axes=(0, None, 0)), in_axes=(0, 0, None)))(masks, outer, inner)
    np.testing.assert_array_equal(got[0], jnp.broadcast_to(outer[:, None], (2, 3, 10)))
    np.testing.assert_array_equal(
        got[1]["b"], jnp.broadcast_to(inner[None, :, None] + jnp.arange(10)[None, None], (2, 3, 10))
    )


def test_nothing_is_evaluated_for_an_empty_mask():
    poison = lambda shared, row, i: jnp.where(i >= 0, jnp.nan, 0.0)  # noqa: E731
    assert not np.any(np.isnan(masked_vmap(poison, jnp.zeros(9, bool), None, jnp.zeros(1))))


def test_one_bad_entry_does_not_touch_the_others():
    row = {"a": jnp.where(jnp.arange(8) == 3, jnp.nan, 1.0), "b": jnp.int32(0)}
    got = masked_vmap(function, jnp.ones(8, bool), jnp.float32(1.0), row)[0]
    assert np.isnan(got).tolist() == [i == 3 for i in range(8)]


def reference_inside(size, exponents, T_object_cloud, cloud):
    x, y, z = np.abs((cloud @ T_object_cloud[:3, :3].T + T_object_cloud[:3, 3]) / size).T
    e1, e2 = exponents
    return np.min((x ** (2 / e2) + y ** (2 / e2)) ** (e2 / e1) + z ** (2 / e1))


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10**6), st.booleans())
def test_any_inside_is_the_minimum_of_equation_5(seed, on_cpu):
    rng = np.random.default_rng(seed)
    n, points = 24, 96
    cloud = np.float32(rng.uniform(-0.1, 0.1, (points, 3)))
    T = np.tile(np.eye(4, dtype=np.float32), (n, 1, 1))
    q = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    T[:, :3, :3] = q * np.sign(np.linalg.det(q))[:, None, None]
    T[:, :3, 3] = rng.uniform(-0.15, 0.15, (n, 3))
    size = np.float32(rng.uniform(0.01, 0.08, (n, 3)))
    exponents = np.float32(np.stack([rng.choice([0.2, 0.7, 1.0, 1.8], n), rng.choice([0.2, 1.0, 1.5, 1.9], n)], -1))
    mask = rng.random(n) < 0.8

    def pair(cloud, row, i):
        return Pair(cloud, *(a[i] for a in row))

    row = tuple(map(jnp.asarray, (T, size, exponents)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(masked, "on_cpu", lambda: on_cpu)
        got = collision.any_inside(jnp.asarray(mask), pair, jnp.asarray(cloud.T), row, block=8)
    least = np.array([reference_inside(*a, cloud.astype(np.float64)) for a in zip(size, exponents, T, strict=True)])
    decided = np.abs(least - 1) > 1e-3
    np.testing.assert_array_equal(np.asarray(got)[decided], (mask & (least < 1))[decided])


@pytest.mark.parametrize(
    ("point", "hit"),
    [
        ((0.6, 0.1, 0.5), False),
        ((0.3, 0.1, 0.1), False),
        ((0.6, 0.1, 0.40), True),
        ((0.6, 0.1, 0.77), True),
        ((0.79, 0.1, 0.5), True),
        ((0.6, 0.4835 - 0.005, 0.5), True),
        ((0.6, -0.2835 + 0.005, 0.5), True),
        ((0.6, -0.2835 + 0.012, 0.5), False),
    ],
)
def test_the_shelf_is_what_surrounds_its_free_box(point, hit):
    assert bool(hits_shelf(Shelf(), jnp.float32(point))) == hit


def test_a_sphere_touches_the_board_a_radius_above_it():
    shelf = Shelf()
    radius = jnp.array([0.05])

    def hits(x, y, z):
        return bool(spheres_hit_shelf(shelf, jnp.float32([[x, y, z]]), radius)[0])

    assert hits(0.6, 0.1, shelf.board + 0.04)
    assert not hits(0.6, 0.1, shelf.board + 0.06)
    # In front of the board's edge, and diagonally in front of and above it.
    assert hits(shelf.front - 0.04, 0.1, shelf.board - 0.1)
    assert not hits(shelf.front - 0.06, 0.1, shelf.board - 0.1)
    assert not hits(shelf.front - 0.04, 0.1, shelf.board + 0.04)


def test_moving_pair_and_world_together_changes_nothing():
    rng = np.random.default_rng(0)
    cloud = jnp.float32(rng.uniform(-0.05, 0.05, (50, 3)))
    T = transforms.upright_pose(jnp.float32([0.04, 0.02, 0.3]), 0.01)
    world = transforms.upright_pose(jnp.float32([1.0, -2.0, 1.1]), 0.4)
    size, e = jnp.float32([0.03, 0.02, 0.05]), jnp.float32([0.2, 1.0])

    def hit(T_world_object, T_world_cloud):
        relative = transforms.compose(transforms.inverse(T_world_object), T_world_cloud)
        return bool(
            collision.any_inside(jnp.ones(1, bool), lambda c, r, i: Pair(c, r[...], size, e), cloud.T, relative)[0]
        )

    assert hit(jnp.eye(4), T) == hit(world, transforms.compose(world, T))
