"""Rigid transforms, and points that are spread far from each other."""

import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.spatial.distance import cdist

from mechsearch_jax.geometry import transforms
from mechsearch_jax.geometry.spreading import farthest_points


def random_transforms(seed, *shape):
    rng = np.random.default_rng(seed)
    q = np.linalg.qr(rng.normal(size=(*shape, 3, 3)))[0]
    q *= np.sign(np.linalg.det(q))[..., None, None]
    T = np.zeros((*shape, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = q, rng.normal(size=(*shape, 3)), 1.0
    return T


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6))
def test_composition_inverse_and_points_agree_with_matrices(seed):
    a, b = random_transforms(seed, 4), random_transforms(seed + 1, 4)
    points = np.random.default_rng(seed).normal(size=(4, 3))
    np.testing.assert_allclose(transforms.compose(jnp.float32(a), jnp.float32(b)), a @ b, atol=3e-6)
    np.testing.assert_allclose(transforms.inverse(jnp.float32(a)), np.linalg.inv(a), atol=3e-6)
    moved = np.einsum("kij,kj->ki", a[:, :3, :3], points) + a[:, :3, 3]
    np.testing.assert_allclose(transforms.transform(jnp.float32(a), jnp.float32(points)), moved, atol=3e-6)


def test_leading_axes_broadcast_whatever_their_number():
    T, points = jnp.float32(random_transforms(0)), jnp.ones((5, 7, 3))
    assert transforms.transform(T, points).shape == (5, 7, 3)
    assert transforms.compose(T, jnp.broadcast_to(T, (2, 3, 4, 4))).shape == (2, 3, 4, 4)


def test_backing_off_moves_against_the_approach():
    T = jnp.float32(random_transforms(3))
    back = transforms.back_off(T, jnp.float32(0.3))
    np.testing.assert_allclose(transforms.transform(back, jnp.float32([0.0, 0.0, 0.3])), T[:3, 3], atol=1e-6)


def test_an_upright_pose_keeps_z_up():
    T = transforms.upright_pose(jnp.float32([0.5, 0.1, 0.7]), 0.45)
    np.testing.assert_allclose(T[:3, 2], [0, 0, 1])
    np.testing.assert_allclose(T[:3, 3], [0.5, 0.1, 0.45])
    np.testing.assert_allclose(jnp.arctan2(T[1, 0], T[0, 0]), 0.7, rtol=1e-6)


# Few different numbers, so that distances are often equal.
POINTS = arrays.arrays(
    np.float64, st.tuples(st.integers(1, 30), st.integers(1, 4)), elements=st.integers(-3, 3).map(lambda i: i / 4)
)


@given(points=POINTS, count=st.integers(1, 30), first=st.integers(0, 29))
def test_each_point_is_the_farthest_from_all_before(points, count, first):
    """Against all distances; whoever gives them may use the same array each time."""
    first, apart = first % len(points), cdist(points, points, "sqeuclidean")
    room = np.empty(len(points))

    def distance(i):
        room[:] = apart[i]
        return room

    chosen = farthest_points(count, first, distance)
    expected = [first]
    while len(expected) < count:
        expected.append(int(np.argmax(apart[expected].min(axis=0))))
    assert chosen.tolist() == expected
