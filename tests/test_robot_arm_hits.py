"""Links 2 to 5 of the arm against objects."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.geometry.superquadric import Superquadrics, gauge
from mechsearch_jax.robot import arm_hits as module
from mechsearch_jax.robot.gripper import arm_points
from mechsearch_jax.robot.kinematics import HOME

BOX, CYLINDER = (0.2, 0.2), (0.2, 1.0)


def away(half, points, round_):
    """Exact distance of points from a box or an upright cylinder, in float64 [m]."""
    if round_:
        sides = np.stack([np.hypot(points[:, 0], points[:, 1]) - half[0], np.abs(points[:, 2]) - half[2]], axis=-1)
    else:
        sides = np.abs(points) - half
    return np.linalg.norm(np.maximum(sides, 0.0), axis=-1)


@pytest.mark.parametrize("exponents", [BOX, CYLINDER])
@pytest.mark.parametrize("radius", [0.034, 0.057, 0.074])
def test_a_grown_object_holds_what_is_nearer_than_the_radius(exponents, radius):
    """Up to 8 mm at its edges, where the superquadric itself is as much rounder than the box."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        half = rng.uniform([0.012, 0.012, 0.03], [0.078, 0.05, 0.11])
        half[1] = half[0] if exponents == CYLINDER else half[1]
        size, rounder = module.grown(jnp.float32(half), jnp.float32(exponents), jnp.float32(radius))
        points = rng.uniform(-1.6, 1.6, (4000, 3)) * (half + radius)
        inside = np.asarray(gauge(size[None], rounder[None], jnp.float32(points))) < 1.0
        exact = away(half, points, exponents == CYLINDER)
        assert inside[exact < radius - 0.008].all()
        assert not inside[exact > radius + 0.008].any()


def scene_at(position):
    return Superquadrics(
        size=jnp.asarray(np.full((3, 3), 0.03, np.float32)),
        exponents=jnp.asarray(np.full((3, 2), 0.2, np.float32)),
        position=jnp.asarray(np.float32([position, [0.6, 0.3, 0.44], position])),
        rotation=jnp.asarray(np.tile(np.eye(3, dtype=np.float32), (3, 1, 1))),
        valid=jnp.asarray([True, True, False]),
    )


def test_an_object_in_a_link_is_hit_and_an_absent_one_never():
    home = np.float32(HOME)
    points, _ = jax.jit(arm_points, static_argnums=1)(home, 5)
    path = np.stack([home + np.float32([1.5, 0, 0, 0, 0, 0, 0]), home])
    scene = scene_at(np.asarray(points)[-1])
    each = ((False, False, False), (True, False, False))
    np.testing.assert_array_equal(jax.jit(module.arm_hits)(path, scene), each)
    scenes = jax.tree.map(lambda a: np.stack([a, a]), scene)
    both = jax.jit(jax.vmap(module.arm_hits))(path[:, None], scenes)
    np.testing.assert_array_equal(both[:, 0], each)
