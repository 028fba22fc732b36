"""Random scenes against float64 geometry, and the clouds and noise that sensors make of them."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.envs.camera.sensors import SENSORS
from mechsearch_jax.envs.scenes.generator import outline, separation
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.images.cloud import above_board, cloud_of, resample, shelf_view
from mechsearch_jax.images.labels import FREE, MISSING, OTHER
from mechsearch_jax.images.noise import RandomDirection, TimeOfFlight, no_noise
from mechsearch_jax.shapes.primitives import CYLINDER
from mechsearch_jax.train import scenes
from mechsearch_jax.workspace.camera import Camera, back_project
from mechsearch_jax.workspace.scenario import Body
from mechsearch_jax.workspace.shelf import Shelf

SHELF = Shelf()
VIEW = shelf_view(stride=4)
CLEAN = scenes.SceneConfig(noises=(no_noise,), lying=0.2, leaning=0.1, touching=0.4)
COUNT = 24


@functools.cache
def clean():
    """Scenes and what a perfect sensor sees of them."""

    @jax.jit
    def make(key):
        world = scenes.random_world(key, CLEAN, SHELF)
        return world, scenes.capture(key, world, CLEAN, SHELF, VIEW)

    return jax.tree.map(np.asarray, jax.vmap(make)(jax.random.split(jax.random.key(0), COUNT)))


def signed_gap(world, scene, slot, points):
    """How far points are from the surface of a body, in float64: negative inside, and 0 on the surface."""
    rotation = world.rotation[scene, slot].astype(float)
    local = np.abs((points.astype(float) - world.position[scene, slot]) @ rotation)
    half = world.half_size[scene, slot]
    if world.kind[scene, slot] == CYLINDER:
        return np.maximum(np.hypot(local[:, 0], local[:, 1]) - half[0], local[:, 2] - half[2])
    return np.max(local - half, axis=1)


@pytest.mark.slow
def test_labelled_points_lie_on_the_surface_of_their_object():
    world, seen = clean()
    checked = 0
    for scene in range(COUNT):
        for slot in range(TARGET):
            points = seen.points[scene][seen.labels[scene] == slot]
            checked += len(points)
            if len(points):
                assert world.valid[scene, slot]
                assert np.abs(signed_gap(world, scene, slot, points)).max() < 2e-5
    assert checked > 5000


def test_other_pixels_show_no_object():
    world, seen = clean()
    for scene in range(COUNT):
        points = seen.points[scene][seen.labels[scene] == FREE]
        for slot in np.flatnonzero(world.valid[scene, :TARGET]):
            # All but the lowest 4 mm of an object are distinguished from the shelf.
            above = points[points[:, 2] > SHELF.board + 5e-3]
            assert (signed_gap(world, scene, slot, above) > -2e-5).all()
        assert np.isnan(seen.points[scene][seen.labels[scene] == MISSING]).all()
        assert not (seen.labels[scene] == OTHER).any()


def test_bodies_rest_on_the_board_and_do_not_overlap():
    world, _ = clean()
    touching = 0
    for scene in range(COUNT):
        slots = np.flatnonzero(world.valid[scene])
        outlines = []
        for slot in slots:
            turn = world.rotation[scene, slot].astype(float)
            half = world.half_size[scene, slot].astype(float)
            down = np.abs(turn[2])
            if world.kind[scene, slot] == CYLINDER:
                extent = down[2] * half[2] + np.sqrt(max(1 - down[2] ** 2, 0)) * half[0]
            else:
                extent = down @ half
            assert world.position[scene, slot, 2] - extent == pytest.approx(SHELF.board, abs=1e-5)
            assert np.abs(turn @ turn.T - np.eye(3)).max() < 1e-5
            outlines.append((slot, footprint(world, scene, slot)))
        for i, (a, first) in enumerate(outlines):
            low, high = first.min(axis=0), first.max(axis=0)
            assert (low > (SHELF.front - 2e-3, SHELF.right)).all()
            assert (high < (SHELF.back + 2e-3, SHELF.left)).all()
            for b, second in outlines[i + 1 :]:
                apart = separation(first, second)
                # The polygon around a disc is wider than the disc by up to 0.9%.
                assert apart > -1e-3, (scene, a, b)
                touching += apart < 1e-3
    assert touching >= 5


def footprint(world, scene, slot):
    w, x, y, z = quaternion(world.rotation[scene, slot].astype(float))
    shape = "cylinder" if world.kind[scene, slot] == CYLINDER else "box"
    half = tuple(float(h) for h in world.half_size[scene, slot])
    return outline(Body(shape, half, tuple(float(p) for p in world.position[scene, slot]), (w, x, y, z)))


def quaternion(rotation):
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)


@pytest.mark.slow
def test_scenes_are_as_configured():
    config = dataclasses.replace(CLEAN, objects=(3, 3), known=1.0, lying=0.0, leaning=0.0, target=0.0)
    draw = jax.jit(jax.vmap(lambda k: scenes.random_world(k, config, SHELF)))
    worlds = draw(jax.random.split(jax.random.key(4), 8))
    assert not worlds.valid[:, 3:].any()
    assert worlds.valid[:, :3].mean() > 0.9
    assert jax.vmap(scenes.in_catalogue)(worlds)[:, :3].all()
    assert not jax.vmap(scenes.in_catalogue)(jax.tree.map(lambda a: a * 1.01, worlds))[:, :3].any()
    assert np.allclose(worlds.rotation[..., 2, 2], 1.0)


def test_the_cloud_is_the_image_without_the_shelf():
    _, seen = clean()
    points = jnp.asarray(seen.points[0])
    cloud = cloud_of(jnp.where(above_board(SHELF, points)[..., None], points, jnp.nan))
    labels = seen.labels[0].reshape(-1)
    assert (np.asarray(cloud.valid) == (labels >= 0)).all()
    sample = resample(jax.random.key(0), cloud)
    assert sample.points.shape == (2048, 3)
    assert sample.valid.all()
    assert (labels[sample.pixel] >= 0).all()
    assert np.array_equal(sample.points, seen.points[0].reshape(-1, 3)[sample.pixel])
    empty = resample(jax.random.key(0), cloud.replace(valid=jnp.zeros_like(cloud.valid)))
    assert not empty.valid.any()


def flat_wall(tilt=0.0, camera=None):
    """Depth of a plane 0.8 m in front of the camera, turned about the image's columns."""
    camera = camera or dataclasses.replace(Camera(), width=160, height=120, cx=80.0, cy=60.0)
    across = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    depth = 0.8 / (1.0 - np.tan(tilt) * across)
    return camera, jnp.broadcast_to(jnp.asarray(depth, jnp.float32), (camera.height, camera.width))


def test_the_papers_noise_has_its_deviation_in_every_direction():
    camera, depth = flat_wall()
    points = RandomDirection(0.001)(jax.random.key(0), camera, depth)
    error = np.asarray(points - back_project(camera, depth), float).reshape(-1, 3)
    length = np.linalg.norm(error, axis=1)
    # A distance is a half-normal variable, and each component of a random direction has the variance 1/3.
    assert length.mean() == pytest.approx(0.001 * np.sqrt(2 / np.pi), rel=0.02)
    assert np.sqrt((length**2).mean()) == pytest.approx(0.001, rel=0.02)
    assert np.allclose(np.cov(error.T), np.eye(3) * 1e-6 / 3, atol=2e-8)


@pytest.mark.slow
def test_scenes_are_taken_by_any_sensor_and_its_card_says_which():
    config = scenes.SceneConfig(objects=(2, 3), noises=(no_noise, SENSORS["active-stereo"]))
    coarse = shelf_view(stride=8)
    world = scenes.random_world(jax.random.key(0), config)
    many = jax.jit(jax.vmap(lambda key: scenes.capture(key, world, config, view=coarse)))
    seen = many(jax.random.split(jax.random.key(1), 8))
    by, lost = np.asarray(seen.sensor), np.isnan(np.asarray(seen.points)[..., 0]).mean(axis=(1, 2))
    assert set(by) == {0, 1}
    assert lost[by == 1].min() > lost[by == 0].max() + 0.01
    assert scenes.origin(config)["noises"] == ["no_noise", "active-stereo"]
    usual = scenes.origin(scenes.SceneConfig())["noises"]
    assert usual == ["no_noise", repr(RandomDirection()), repr(TimeOfFlight())]


def test_surface_points_are_spread_by_area():
    half = np.array([0.02, 0.03, 0.05])
    box = np.asarray(scenes.surface_points(jax.random.key(0), jnp.int32(0), jnp.asarray(half, jnp.float32), 20000))
    scaled = np.abs(box) / half
    assert np.allclose(scaled.max(axis=1), 1.0, atol=1e-5)
    on = [(scaled[:, i] > 1 - 1e-5).mean() for i in range(3)]
    areas = np.array([half[1] * half[2], half[0] * half[2], half[0] * half[1]])
    assert np.allclose(on, areas / areas.sum(), atol=0.02)

    can_size = jnp.array([0.03, 0.03, 0.05])
    can = np.asarray(scenes.surface_points(jax.random.key(1), jnp.int32(CYLINDER), can_size, 20000))
    radius = np.hypot(can[:, 0], can[:, 1])
    lid = np.abs(np.abs(can[:, 2]) - 0.05) < 1e-6
    assert np.allclose(radius[~lid], 0.03, atol=1e-6)
    assert lid.mean() == pytest.approx(0.03 / (0.03 + 2 * 0.05), abs=0.02)
    assert (radius[lid] < 0.0212).mean() == pytest.approx(0.5, abs=0.03)
