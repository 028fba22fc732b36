"""Rigid transforms against NumPy in float64."""

import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mechsearch_jax.geometry import transforms


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
