"""The target's colour, clusters by colour, and planes among outliers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.camera import simulated_camera
from mechsearch_jax.envs.camera.simulated_camera import PALETTE
from mechsearch_jax.envs.world import world
from mechsearch_jax.images import colour, planes
from mechsearch_jax.images.colour import TargetColour
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera, back_project
from mechsearch_jax.workspace.scenario import Body, Scenario

CAMERA = Camera().scaled(4)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
BEHIND = Body("box", (0.022, 0.078, 0.096), (0.66, 0.1, 0.5005), UPRIGHT)
POST = Body("cylinder", (0.024, 0.024, 0.067), (0.5, 0.14, 0.4715), UPRIGHT)
CAN = Body("cylinder", (0.032, 0.032, 0.061), (0.6, -0.12, 0.4655), UPRIGHT)
TARGET = Body("cylinder", (0.02, 0.02, 0.05), (0.5, -0.02, 0.4545), UPRIGHT)
SCENE = Scenario("scene", (BEHIND, POST, CAN), TARGET)


@pytest.fixture(scope="module")
def seen():
    return simulated_camera.observe(CAMERA, world.from_scenario(SCENE))


def colours_of(*segments):
    """Pixels of segments given as lists of colours, and their labels."""
    labels = np.concatenate([np.full(len(s), i) for i, s in enumerate(segments)])
    return jnp.asarray(np.concatenate(segments), jnp.float32), jnp.asarray(labels, jnp.int32)


def test_target_is_the_one_segment_whose_mean_colour_is_near():
    rng = np.random.default_rng(0)
    red = np.array(TargetColour().rgb)
    blue, yellow = np.array(PALETTE[0]), np.array(PALETTE[1])
    noisy = [c + rng.normal(0, 0.2, (500, 3)) for c in (blue, red, yellow)]
    detection = colour.detect_target(*colours_of(*noisy), 4)
    assert detection.found
    assert detection.segment == 1
    mean = np.mean((noisy[0].mean(axis=0) - red) ** 2)
    np.testing.assert_allclose(detection.difference[0], mean, rtol=1e-3)
    assert jnp.isinf(detection.difference[3])
    assert not colour.detect_target(*colours_of(noisy[0], noisy[2]), 4).found
    assert not colour.detect_target(*colours_of(noisy[1], noisy[1]), 4).found


def test_chromaticity_tells_the_target_from_brown_in_any_light():
    """At the paper's threshold a brown thing passes for red, and the target's shadowed side for another colour."""
    red, brown = np.array([TargetColour().rgb]), np.array([PALETTE[6]])
    for light in (0.3, 0.6, 1.0):
        pixels = colours_of(np.repeat(red * light, 9, axis=0), np.repeat(brown, 9, axis=0))
        detection = colour.detect_target(*pixels, 2, TargetColour.lit())
        assert detection.found
        assert detection.segment == 0
    assert not colour.detect_target(*colours_of(red, brown), 2).found
    assert not colour.detect_target(*colours_of(red, brown), 2, TargetColour(minimum_pixels=2)).found


@pytest.mark.parametrize("rgb", [(255, 0, 0), (200, 0, 0), (220, 20, 20), (186, 40, 54)])
def test_every_red_is_the_target_by_default(rgb):
    for light in (0.45, 0.7, 1.0):
        assert TargetColour.lit()(light * jnp.array(rgb) / 255)
    others = np.delete(PALETTE, 8, axis=0)
    assert not TargetColour.lit()(jnp.asarray(others)).any()
    assert not TargetColour.lit()(jnp.asarray(0.45 * others)).any()


def test_a_target_has_the_hue_of_its_colour_and_may_be_purer():
    blue = TargetColour.lit((0.2, 0.3, 0.8))
    assert blue(jnp.array([0.0, 0.0, 1.0]))
    assert not blue(jnp.array([0.6, 0.65, 0.8]))
    assert not blue(jnp.array([0.0, 0.0, 0.05]))
    assert not blue(jnp.array(TargetColour().rgb))


@pytest.mark.parametrize("rgb", [(1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.5, 0.5, 0.5), (0.8, 0.75, 0.7), (0.1, 0.0, 0.0)])
def test_a_target_without_a_hue_is_refused_in_a_line(rgb):
    with pytest.raises(InputError, match="give masks with target_id") as refused:
        TargetColour.lit(rgb)
    assert "\n" not in str(refused.value)


def test_target_is_detected_in_a_rendered_image(seen):
    labels = seen.segmentation.reshape(-1).astype(jnp.int32)
    pixels = seen.colour.reshape(-1, 3)
    detection = colour.detect_target(pixels, labels, 9, TargetColour.lit())
    assert detection.found
    assert detection.segment == world.TARGET
    assert not colour.detect_target(pixels, jnp.where(labels == world.TARGET, -1, labels), 9, TargetColour.lit()).found
    # With the paper's measure the target is the most similar one, and at its threshold a shaded yellow passes too.
    assert colour.detect_target(pixels, labels, 9).segment == world.TARGET
    assert colour.detect_target(pixels, labels, 9, TargetColour(threshold=0.05)).found


def test_clusters_of_a_rendered_image_are_its_bodies(seen):
    """The box behind the post is seen in two parts; in the noise of a sensor they still are one thing."""
    rng = np.random.default_rng(1)
    truth = np.array(seen.segmentation)
    objects = (truth >= 0) & (truth < simulated_camera.SHELF)
    depth = np.array(seen.depth) + rng.normal(0, 0.001, truth.shape).astype(np.float32)
    image = np.clip(np.array(seen.colour) + rng.normal(0, 0.01, (*truth.shape, 3)), 0, 1).astype(np.float32)
    points = np.array(back_project(CAMERA, jnp.asarray(depth)))
    labels = colour.cluster_by_colour(image, depth, points, objects)
    assert np.all(labels[~objects] == -1)
    assert labels.max() == 3
    for body in np.unique(truth[objects]):
        of_body = truth == body
        label = np.bincount(labels[of_body & (labels >= 0)]).argmax()
        assert np.sum(of_body & (labels == label)) / np.sum(of_body | (labels == label)) > 0.98
    sizes = np.bincount(labels[labels >= 0])
    assert np.all(np.diff(sizes) <= 0)
    nothing = colour.cluster_by_colour(image, depth, points, np.zeros_like(objects))
    assert np.all(nothing == -1)


@pytest.mark.parametrize("seed", range(3))
def test_plane_is_found_among_outliers(seed):
    rng = np.random.default_rng(seed)
    tilt = Rotation.from_rotvec([*rng.uniform(-0.1, 0.1, 2), 0.0]).as_matrix()
    normal, offset = tilt[:, 2], 0.39
    floor = rng.uniform(-0.4, 0.4, (600, 3))
    floor[:, 2] = rng.normal(0, 0.001, 600)
    floor = floor @ tilt.T + offset * normal
    # A wall has more points than the floor, and is not what is looked for.
    wall = np.stack([np.full(900, 0.3), rng.uniform(-0.4, 0.4, 900), rng.uniform(0, 1, 900)], axis=1)
    points = np.concatenate([floor, wall, rng.uniform(-0.5, 1, (400, 3)), np.full((100, 3), np.nan)])
    valid = np.isfinite(points).all(axis=1)
    order = rng.permutation(len(points))
    arguments = (jax.random.key(seed), jnp.asarray(points[order], jnp.float32), jnp.asarray(valid[order]))
    plane = planes.find_plane(*arguments)
    assert np.degrees(np.arccos(np.clip(plane.normal @ normal, -1, 1))) < 0.2
    assert abs(plane.offset - offset) < 5e-4
    assert 550 < plane.support < 750
    again = planes.find_plane(*arguments)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, plane, again))
