"""Classical recovery of superquadrics from full and partial clouds."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mechsearch_jax.benchmarks.lab.parts import ems
from mechsearch_jax.geometry.superquadric import Superquadrics, sample_surface
from mechsearch_jax.perception import scores
from mechsearch_jax.runtime.errors import InputError

SHAPES = {
    "box": ((0.03, 0.05, 0.08), (0.2, 0.2)),
    "cylinder": ((0.034, 0.034, 0.08), (0.2, 1.0)),
    "ellipsoid": ((0.03, 0.05, 0.08), (1.0, 1.0)),
}


def cloud(name, seed, partial=False, noise=0.0, outliers=0):
    """Points of a superquadric somewhere, and itself; a partial cloud has the points that face one viewpoint."""
    rng = np.random.default_rng(seed)
    size, exponents = SHAPES[name]
    local = np.array(sample_surface(jnp.array(size), jnp.array(exponents), 4000), float)
    rotation, position = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1, 1, 3)
    if partial:
        local = local[local @ np.array([0.6, 0.5, 0.45]) / np.linalg.norm(local, axis=1) > 0.25]
    local = local[rng.permutation(len(local))[:250]]
    points = local @ rotation.T + position + rng.normal(0, noise, local.shape)
    strays = position + rng.uniform(-0.15, 0.15, (outliers, 3))
    truth = Superquadrics(
        *(jnp.asarray(np.float32(a))[None] for a in (size, exponents, position, rotation)), valid=jnp.ones(1, bool)
    )
    return np.concatenate([points, strays]), truth


def iou(points, truth):
    scene = ems.recover_scene(points, np.zeros(len(points), int), 1)
    return float(scores.intersection_over_union(scene, truth)[0])


def test_jacobian_is_that_of_finite_differences():
    rng = np.random.default_rng(5)
    rotation = Rotation.random(random_state=rng).as_matrix()
    shape = ems.Recovered(np.array([0.6, 0.9, 1.2]), np.array([0.4, 0.8]), rng.normal(size=3), rotation, 0.0, 0)
    points = rng.normal(size=(40, 3)) + shape.position

    def moved(x):
        turned = rotation @ Rotation.from_rotvec(x[8:]).as_matrix()
        return ems.Recovered(
            shape.size * np.exp(x[:3]), shape.exponents + x[3:5], shape.position + x[5:8], turned, 0.0, 0
        )

    steps = 1e-5 * np.eye(11)
    expected = [(ems._radial(moved(s), points) - ems._radial(moved(-s), points)) / 2e-5 for s in steps]
    np.testing.assert_allclose(ems._radial_jacobian(shape, points), np.transpose(expected), atol=2e-4)


@pytest.mark.parametrize("name", SHAPES)
def test_outliers_and_noise_do_little_harm(name):
    assert iou(*cloud(name, 0, noise=0.001, outliers=30)) > 0.97


@pytest.mark.parametrize("name", SHAPES)
def test_clouds_seen_from_one_side_are_recovered(name):
    assert iou(*cloud(name, 0, partial=True)) > 0.97


def test_slots_without_points_are_absent():
    points, _ = cloud("cylinder", 1)
    labels = np.full(len(points), 2)
    labels[:5] = 0
    scene = ems.recover_scene(points, labels, 4)
    np.testing.assert_array_equal(scene.valid, [False, False, True, False])
    with pytest.raises(InputError, match="at least 11"):
        ems.recover(points[:5])
