"""The ray-caster of films: against the simulated camera, and capsules against their own definition."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.camera import simulated_camera as seen_by
from mechsearch_jax.envs.world.model import shelf_boxes
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.shapes import Capsule, in_order, shape_of
from mechsearch_jax.viz.panda import GREY
from mechsearch_jax.viz.raycast import EDGE, RAYS, Eye, VisibleSolid
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf

CAMERA = Camera().scaled(16)
TURNED = tuple(Rotation.from_rotvec((0.3, -0.5, 0.8)).as_quat(scalar_first=True))
SCENE = Scenario(
    "scene",
    (
        Body("box", (0.054, 0.025, 0.054), (0.55, 0.1, 0.47), TURNED),
        Body("cylinder", (0.034, 0.034, 0.107), (0.6, 0.25, 0.52), TURNED),
    ),
    Body("cylinder", (0.02, 0.02, 0.05), (0.7, 0.0, 0.4545), (1.0, 0.0, 0.0, 0.0)),
)
BOARD = shape_of("box")


def eye(camera=CAMERA):
    return Eye(camera, seen_by.LIGHT, seen_by.AMBIENT, seen_by.BACKGROUND_COLOUR)


def solids(world):
    for low, high in shelf_boxes(Shelf()).values():
        yield VisibleSolid(BOARD, (high - low) / 2, np.eye(3), (low + high) / 2, tuple(map(float, seen_by.PALETTE[-1])))
    for i in np.flatnonzero(world.valid):
        fields = (np.asarray(a[i]) for a in (world.half_size, world.rotation, world.position))
        yield VisibleSolid(in_order()[int(world.kind[i])], *fields, tuple(map(float, seen_by.PALETTE[i])))


def test_it_sees_what_the_simulated_camera_sees():
    world = from_scenario(SCENE)
    picture = eye().picture(solids(world))
    expected = seen_by.observe(Camera().scaled(16 // RAYS), world)

    def ray_by_ray(values):
        return np.concatenate([np.asarray(values)[i::RAYS, j::RAYS] for i in range(RAYS) for j in range(RAYS)])

    np.testing.assert_allclose(np.concatenate(picture.depth), ray_by_ray(expected.depth), atol=1e-5)
    # The camera takes the boards' normals from where they are, at edges it may take the other face's.
    differs = np.abs(np.concatenate(picture.colour) / 255 - ray_by_ray(expected.colour)).max(axis=-1) > 4e-3
    assert not differs[ray_by_ray(expected.segmentation) != seen_by.SHELF].any()
    assert differs.mean() < 0.05


def test_one_ray_is_enough_where_there_is_no_edge():
    world = from_scenario(SCENE)
    *boards, one, two, target = solids(world)
    there = eye(Camera().scaled(4))
    exact = there.picture([*boards, one, two, target]).pixels.astype(int)
    empty = there.picture(boards)
    off = np.abs(there.pixels([one, two, target], empty) - exact).max(axis=-1)
    assert (np.abs(empty.pixels - exact).max(axis=-1) > 20).mean() > 0.01
    # A corner can be between the first rays of four pixels.
    assert off.max() < 64
    assert (off > EDGE).mean() < 2e-4


@pytest.mark.parametrize("distance", [-0.5, 0.0, 4.0])
def test_what_is_behind_around_or_far_from_the_camera_does_no_harm(distance):
    forward = np.array(CAMERA.rotation)[:, 2]
    ball = VisibleSolid(Capsule(), np.full(3, 0.05), np.eye(3), np.array(CAMERA.position) + distance * forward, GREY)
    picture = eye().picture([ball])
    assert (picture.colour.min() < 255) == (distance > 0.0)
    assert np.isinf(picture.depth).all() == (distance <= 0.0)


def outside(point, radius, half):
    """Distance to a capsule, by its definition."""
    nearest = np.clip(point[..., 2], -half, half)
    return np.linalg.norm(point - np.stack([0 * nearest, 0 * nearest, nearest], axis=-1), axis=-1) - radius


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), radius=st.floats(0.02, 0.3), half=st.floats(0.0, 0.5))
def test_rays_meet_a_capsule_where_they_first_come_to_its_surface(seed, radius, half):
    rng = np.random.default_rng(seed)
    start = rng.normal(size=(100, 3))
    start *= 2.0 / np.linalg.norm(start, axis=1, keepdims=True)
    way = rng.uniform(-0.8, 0.8, (100, 3)) - start
    size = np.array([radius, radius, half + radius])
    with np.errstate(all="ignore"):
        met = Capsule().cut(list(start.T), list(way.T), size, np)
    shares = np.linspace(0.0, 2.0, 801)[:, None]
    distance = outside(start + shares[..., None] * way, radius, half)
    missed = np.isinf(met)
    assert distance[:, missed].min(initial=1.0) > -1e-6
    assert (distance[:, ~missed] > 0.0)[shares < met[~missed] - 1e-3].all()
    points = start[~missed] + met[~missed, None] * way[~missed]
    np.testing.assert_allclose(outside(points, radius, half), 0.0, atol=1e-7)
    normals = Capsule().normal(points, np.broadcast_to(size, points.shape), np)
    assert (np.sum(normals * way[~missed], axis=1) <= 1e-6).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), radius, atol=1e-6)
