"""Simulated depth cameras as values: their noise, holes and edges against what their numbers say."""

import dataclasses
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stage import OPEN

from mechsearch_jax.envs.camera.recognisers import recogniser
from mechsearch_jax.envs.camera.sensing import sensing_of
from mechsearch_jax.envs.camera.sensors import EDGE, SENSORS, Sensor, Surfaces
from mechsearch_jax.envs.camera.snapshot import Snapshot
from mechsearch_jax.envs.episode.episodes import target_of
from mechsearch_jax.envs.world.mismatch import ASSUMED, Mismatch, SensorName
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.images.noise import RandomDirection, depth_of, no_noise
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

SIZE = (160, 200)
# The middle of the default camera's image, from which it looks straight along x.
CAMERA = dataclasses.replace(
    Camera(), width=SIZE[1], height=SIZE[0], cx=100.0, cy=80.0, rotation=((0, 0, 1), (-1, 0, 0), (0, -1, 0))
)
KEYS = jax.random.split(jax.random.key(0), 6)
MATT = Surfaces(jnp.zeros(SIZE), jnp.zeros(SIZE, bool), jnp.full(SIZE, jnp.inf))
one = jax.jit(lambda key, sensor, depth, surfaces: depth_of(CAMERA, sensor(key, CAMERA, depth, surfaces)))
many = jax.jit(jax.vmap(one, in_axes=(0, None, None, None)))


def wall(depth):
    return jnp.full(SIZE, depth)


def step():
    """Something nearer in the middle of a wall."""
    return jnp.full(SIZE, 1.0).at[40:120, 80:120].set(0.6)


def error(sensor, depth, surfaces=MATT):
    return np.asarray(many(KEYS, sensor, depth, surfaces), float) - np.asarray(depth, float)


def test_a_perfect_and_the_ideal_sensor_are_what_there_was():
    depth = step().at[:, :5].set(jnp.inf)
    for sensor, model, exact in ((Sensor(), no_noise, 0.0), (SENSORS["ideal"], RandomDirection(), 1e-6)):
        expected = depth_of(CAMERA, model(KEYS[0], CAMERA, depth))
        np.testing.assert_allclose(one(KEYS[0], sensor, depth, MATT), expected, atol=exact)
    assert tuple(SENSORS) == get_args(SensorName)
    assert sensing_of(ASSUMED, ASSUMED.drawn(OPEN, 0, Camera(), Shelf())) is None


@pytest.mark.parametrize("depth", [0.8, 1.2])
def test_noise_is_as_large_and_as_alike_as_the_numbers_say(depth):
    sensor = Sensor(jitter=0.001, noise=0.003, length=6.0, wave=0.0, step=0.0)
    noise = error(sensor, wall(depth))
    # To first order.
    assert np.sqrt(np.mean(noise**2)) == pytest.approx(depth**2 * np.sqrt(1e-6 + 9e-6), rel=0.08)
    for lag in (1, 4, 16):
        across, down = noise[:, :, lag:] * noise[:, :, :-lag], noise[:, lag:] * noise[:, :-lag]
        expected = 0.9 * np.exp(-(lag**2) / (2 * 6.0**2))
        for product in (across, down):
            assert product.mean() / np.mean(noise**2) == pytest.approx(expected, abs=0.09)


def test_depth_comes_in_steps_of_its_inverse():
    measured = np.asarray(one(KEYS[0], Sensor(jitter=0.003, step=0.003), wall(0.9), MATT), float)
    steps = 1.0 / (measured * 0.003)
    np.testing.assert_allclose(steps, np.round(steps), atol=2e-3)
    assert len(np.unique(np.round(steps))) > 3


def test_dark_and_grazing_surfaces_lose_their_share():
    half = MATT.replace(material=jnp.zeros(SIZE).at[:, 100:].set(0.9))
    lost = np.isnan(error(Sensor(poor=0.2, lost=0.4), wall(0.8), half))
    assert not lost[..., :100].any()
    assert lost[..., 100:].mean() == pytest.approx(0.4, abs=0.06)
    # In holes, not singly: most neighbours of what is lost are lost.
    assert lost[..., 101:][lost[..., 100:-1]].mean() > 0.85
    assert not np.isnan(error(Sensor(poor=0.05, lost=0.4), wall(0.8), half)).any()
    # A wall seen at a cosine of about 0.35 against one seen face on.
    columns = (np.arange(SIZE[1]) + 0.5 - CAMERA.cx) / CAMERA.fx
    slanted = jnp.broadcast_to(jnp.asarray(0.8 / (1.0 - 2.7 * columns), jnp.float32), SIZE)
    grazing = Sensor(grazing=0.35, softness=0.05)
    assert np.isnan(error(grazing, slanted))[:, 5:-5, 90:110].mean() == pytest.approx(0.5, abs=0.2)
    assert not np.isnan(error(grazing, wall(0.8))).any()


def test_shadows_are_on_the_left_and_edges_reach_beyond():
    lost = np.isnan(error(Sensor(baseline=0.05, widest=22.0), step()))[0]
    width = int(np.ceil(0.05 * CAMERA.fx * (1 / 0.6 - 1)))
    assert np.flatnonzero(lost[80]).tolist() == list(range(80 - width, 80))
    assert not lost[:40].any()
    reach = error(Sensor(fattening=3.0), step()) < -0.1
    assert reach[:, 41:119, :80].sum(axis=-1).mean() == pytest.approx(3.0, abs=0.6)
    assert reach[:, 41:119, 120:].sum(axis=-1).mean() == pytest.approx(3.0, abs=0.6)
    assert reach[:, :40, 85:115].sum(axis=1).mean() == pytest.approx(3.0, abs=1.5)
    assert not reach[..., 40:120, 80:120].any()


def test_mixed_pixels_lie_between_both_depths_at_edges_alone():
    mixed = error(Sensor(mixed=0.5), step())
    changed = np.abs(mixed) > 1e-6
    assert (np.abs(mixed) < 0.4).all()
    assert changed[:, 45:115, 79].mean() == pytest.approx(0.5, abs=0.1)
    changed[:, 38:121, 78:121] = False
    assert not changed.any()


def test_eager_jitted_and_in_a_batch_the_same_and_a_sweep_traces_once():
    before = one._cache_size()
    for sensor in SENSORS.values():
        jitted = one(KEYS[1], sensor, step(), MATT)
        np.testing.assert_allclose(many(KEYS, sensor, step(), MATT)[1], jitted, atol=1e-5)
    assert one._cache_size() == max(before, 1)
    eager = depth_of(CAMERA, sensor(KEYS[1], CAMERA, step(), MATT))
    np.testing.assert_allclose(eager, jitted, atol=1e-5)


def test_the_simulated_camera_takes_images_by_the_sensor():
    masks = recogniser("masks", target_of(OPEN))

    def images(**mismatch):
        given = Mismatch(**mismatch)
        sensing = sensing_of(given, given.drawn(OPEN, 0, Camera(), Shelf()))
        return masks.images(jax.random.key(0), Snapshot(Camera(), Shelf(), from_scenario(OPEN), sensing=sensing))

    exact, stereo = (np.asarray(images(**given).depth) for given in ({"depth_noise": 0.0}, {"sensor": "active-stereo"}))
    there = np.isfinite(exact)
    assert 0.03 < 1 - np.isfinite(stereo[there]).mean() < 0.6
    both = there & np.isfinite(stereo)
    assert 0.0015 < np.median(np.abs(stereo[both] - exact[both])) < 0.004
    assert EDGE < 0.02
