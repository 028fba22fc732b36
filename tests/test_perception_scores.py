"""Intersection over union against closed forms of boxes and cylinders."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import gamma

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.perception import scores
from mechsearch_jax.shapes import shape_of

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
