"""Superquadrics: the gauge against the paper's formula in float64, invariances, edges, and gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mechsearch_jax.geometry import superquadric, transforms
from mechsearch_jax.geometry.footprints import footprints
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import shape_of

sizes = st.tuples(*[st.floats(0.01, 0.2)] * 3)
exponents = st.tuples(*[st.floats(0.1, 1.9)] * 2)
seeds = st.integers(0, 2**31 - 1)


def reference_implicit(size, exponents, points):
    """Equation 5 as it is printed, in float64."""
    e1, e2 = exponents
    x, y, z = np.abs(np.asarray(points, np.float64) / np.asarray(size, np.float64)).T
    return (x ** (2 / e2) + y ** (2 / e2)) ** (e2 / e1) + z ** (2 / e1)


def points_near(size, seed, count=64):
    return np.random.default_rng(seed).uniform(-1.6, 1.6, (count, 3)) * np.asarray(size)


@settings(deadline=None, max_examples=40)
@given(sizes, exponents, seeds)
def test_the_gauge_is_the_papers_function_to_the_power_of_half_e1(size, exponents, seed):
    points = points_near(size, seed)
    expected = reference_implicit(size, exponents, points) ** (exponents[0] / 2)
    got = superquadric.gauge(jnp.float32(size), jnp.float32(exponents), jnp.float32(points))
    np.testing.assert_allclose(got, expected, rtol=2e-4, atol=1e-5)


@settings(deadline=None, max_examples=25)
@given(sizes, exponents, seeds, st.floats(0.1, 10.0))
def test_scaling_the_object_and_the_point_together_changes_nothing(size, exponents, seed, scale):
    points, e = jnp.float32(points_near(size, seed)), jnp.float32(exponents)
    a = superquadric.gauge(jnp.float32(size), e, points)
    b = superquadric.gauge(jnp.float32(size) * scale, e, points * scale)
    np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)


@settings(deadline=None, max_examples=25)
@given(exponents, seeds, st.floats(0.1, 3.0))
def test_the_gauge_is_homogeneous_of_degree_one(exponents, seed, scale):
    size, e = jnp.float32([0.1, 0.06, 0.03]), jnp.float32(exponents)
    points = jnp.float32(points_near(size, seed))
    np.testing.assert_allclose(
        superquadric.gauge(size, e, points * scale), scale * superquadric.gauge(size, e, points), rtol=1e-3, atol=1e-6
    )


def test_a_sphere_measures_distances():
    size, e = jnp.full(3, 0.1), jnp.ones(2)
    points = jnp.float32(np.random.default_rng(0).normal(size=(100, 3)) * 0.2)
    norm = np.linalg.norm(points, axis=-1)
    np.testing.assert_allclose(superquadric.gauge(size, e, points), norm / 0.1, rtol=1e-5)
    np.testing.assert_allclose(superquadric.radial_distance(size, e, points), np.abs(norm - 0.1), atol=1e-6)


@pytest.mark.parametrize("function", [superquadric.gauge, superquadric.radial_distance])
@pytest.mark.parametrize("point", [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.2), (0.1, 0.1, 0), (5.0, -3.0, 2.0)])
@pytest.mark.parametrize("e", [(0.1, 0.1), (0.2, 1.0), (1.0, 1.0), (1.9, 1.9)])
def test_values_and_gradients_are_finite_on_the_axes_and_far_away(function, point, e):
    arguments = jnp.float32([0.1, 0.05, 0.2]), jnp.float32(e), jnp.float32(point)
    value, gradients = jax.value_and_grad(function, argnums=(0, 1, 2))(*arguments)
    assert np.isfinite(value)
    assert all(np.all(np.isfinite(g)) for g in gradients)


@settings(deadline=None, max_examples=20)
@given(sizes, exponents)
def test_sampled_points_lie_on_the_surface(size, exponents):
    size, e = jnp.float32(size), jnp.float32(exponents)
    points = superquadric.sample_surface(size, e, 128)
    np.testing.assert_allclose(superquadric.gauge(size, e, points), 1.0, atol=1e-4)


def test_samples_leave_no_gap_on_a_box():
    size = jnp.float32([0.05, 0.03, 0.08])
    points = np.asarray(superquadric.sample_surface(size, jnp.float32(shape_of("box").exponents), 512))
    dense = np.asarray(superquadric.sample_surface(size, jnp.float32(shape_of("box").exponents), 4096))
    nearest = np.min(np.linalg.norm(dense[:, None] - points[None], axis=-1), axis=1)
    assert nearest.max() < 0.013


@settings(deadline=None, max_examples=20)
@given(seeds)
def test_moving_the_scene_and_the_points_together_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, 5)
    points = jnp.float32(rng.uniform(-0.3, 0.3, (20, 3)))
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    T = transforms.make(jnp.float32(q * np.sign(np.linalg.det(q))), jnp.float32(rng.normal(size=3)))
    moved = scene.replace(
        position=transforms.transform(T, scene.position), rotation=transforms.matmul(T[:3, :3], scene.rotation)
    )
    before = superquadric.to_object_frame(scene, points)
    after = superquadric.to_object_frame(moved, transforms.transform(T, points))
    np.testing.assert_allclose(before, after, atol=5e-6)


def random_scene(rng, count):
    rotations = np.stack([np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(count)])
    rotations *= np.sign(np.linalg.det(rotations))[:, None, None]
    return superquadric.Superquadrics(
        size=jnp.float32(rng.uniform(0.01, 0.1, (count, 3))),
        exponents=jnp.float32(rng.uniform(0.2, 1.0, (count, 2))),
        position=jnp.float32(rng.uniform(-0.3, 0.3, (count, 3))),
        rotation=jnp.float32(rotations),
        valid=jnp.ones(count, bool),
    )


def test_eager_jit_and_vmap_agree():
    rng = np.random.default_rng(1)
    size, e, points = (
        jnp.float32(rng.uniform(0.02, 0.1, (7, 3))),
        jnp.float32(rng.uniform(0.2, 1.5, (7, 2))),
        jnp.float32(rng.uniform(-0.2, 0.2, (7, 3))),
    )
    for function in (superquadric.gauge, superquadric.radial_distance):
        eager = function(size, e, points)
        np.testing.assert_allclose(jax.jit(function)(size, e, points), eager, rtol=2e-5)
        np.testing.assert_allclose(jax.vmap(function)(size, e, points), eager, rtol=2e-5)


def test_edges_are_as_rounded_as_in_plans():
    scene = random_scene(np.random.default_rng(4), 3)
    exponents = jnp.float32([[0.03, 0.03], [0.03, 1.0], [0.5, 0.3]])
    rounded = superquadric.standard_edges(scene.replace(exponents=exponents))
    np.testing.assert_array_equal(rounded.exponents, np.float32([[0.2, 0.2], [0.2, 1.0], [0.5, 0.3]]))
    for name in ("size", "position", "rotation", "valid"):
        np.testing.assert_array_equal(getattr(rounded, name), getattr(scene, name))


def test_padding_keeps_the_objects_and_refuses_too_many():
    scene = random_scene(np.random.default_rng(2), 3)
    padded = superquadric.pad(scene, 5)
    assert padded.capacity == 5
    assert padded.valid.tolist() == [True, True, True, False, False]
    np.testing.assert_array_equal(padded.size[:3], scene.size)
    with pytest.raises(InputError, match="3 objects do not fit a capacity of 2"):
        superquadric.pad(scene, 2)


def four(e2, size=(0.04, 0.04, 0.06), rotation=((0.0, -1.0, 0.0), (0.8, 0.0, -0.6), (0.6, 0.0, 0.8))):
    """Four of the same superquadric, tilted, in a world."""
    one = superquadric.Superquadrics(
        jnp.float32(size), jnp.float32([0.3, e2]), jnp.float32([0.5, 0.1, 0.4]), jnp.float32(rotation), jnp.array(True)
    )
    return jax.tree.map(lambda a: jnp.stack([a] * 4), one)


@pytest.mark.parametrize("e2", [1.45, 1.7, 1.9, 2.0])
def test_a_box_described_as_turned_by_an_eighth_is_described_as_a_box(e2):
    scene = four(e2)
    boxes = superquadric.as_boxes(scene)
    assert np.all(boxes.exponents[:, 1] <= superquadric.ROUND_EXPONENT)
    # It is one thing: its faces and edges are where they were.
    directions = jnp.float32([[1, 0, 0], [1, 1, 0], [0, 1, 0], [-1, 1, 0], [0, 0, 1], [3, 1, 0]])
    points = scene.position[:1] + 0.05 * transforms.rotate(scene.rotation[:1], directions)

    def gauge(s):
        return superquadric.gauge(s.size[None], s.exponents[None], superquadric.to_object_frame(s, points))

    before, after = gauge(scene), gauge(boxes)
    np.testing.assert_allclose(after[:5], before[:5], rtol=0.08)
    np.testing.assert_allclose(after[5], before[5], rtol=0.1)
    np.testing.assert_allclose(
        boxes.rotation @ jnp.swapaxes(boxes.rotation, 1, 2), np.tile(np.eye(3), (4, 1, 1)), atol=1e-6
    )
    again = superquadric.as_boxes(boxes)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(boxes), strict=True))


def test_the_square_block_of_another_fit_is_the_same_block():
    half, turn = 0.03, 0.5**0.5
    yaw = ((turn, -turn, 0.0), (turn, turn, 0.0), (0.0, 0.0, 1.0))
    box = superquadric.as_boxes(four(1.9, (half * 2**0.5, half * 2**0.5, 0.06), yaw))
    np.testing.assert_allclose(box.size[0], (half, half, 0.06), atol=0.0012)
    np.testing.assert_allclose(np.abs(box.rotation[0]), np.eye(3)[[1, 0, 2]], atol=1e-6)
    assert not np.any(footprints(box).round)
    assert np.all(footprints(four(1.0, rotation=yaw)).round)


BLOCK, SLAB = (0.04, 0.04, 0.06), (0.05, 0.03, 0.06)


@pytest.mark.parametrize(("e2", "size"), [(0.1, BLOCK), (1.0, BLOCK), (1.4, BLOCK), (1.9, SLAB)])
def test_all_else_is_as_it_was_to_the_bit(e2, size):
    scene = four(e2, size)
    same = superquadric.as_boxes(scene)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(same), jax.tree.leaves(scene), strict=True))


def test_the_parts_of_a_body_are_described_as_boxes():
    whole = four(1.0)
    parts = jax.tree.map(lambda a: jnp.stack([a] * 2), four(1.9))
    parts = jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), parts)
    body = superquadric.as_boxes(whole.replace(parts=parts))
    assert np.all(body.parts.exponents[..., 1] < 0.5)
    np.testing.assert_array_equal(body.size, whole.size)
