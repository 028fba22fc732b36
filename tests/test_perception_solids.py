"""Closed forms of boxes and cylinders, against the package's other ways of computing the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.perception.doubt import Thing
from mechsearch_jax.perception.overlaps import depth_in_each_other
from mechsearch_jax.perception.solids import entries, penetrations, surface_distance
from mechsearch_jax.workspace.render import object_depth
from mechsearch_jax.workspace.scenario import rotation_matrix

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
