"""Rendered images with the robot in them, a wrong camera pose and sensor noise, to segments and points."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from robot_images import ROBOT, robot_image
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.camera.simulated_camera import SHELF
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.images import camera_pose, real_camera
from mechsearch_jax.images.camera_pose import with_pose
from mechsearch_jax.images.colour import TargetColour
from mechsearch_jax.images.labels import FREE, MISSING, OTHER
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera, back_project
from mechsearch_jax.workspace.scenario import Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
CAMERA = Camera().scaled(4)
JOINTS, OPENING = np.array(HOME) + np.array([-0.3, 0.5, 0.0, -0.1, 0.0, 0.0, 0.0], np.float32), 0.05
SCENE = Scenario(
    "scene",
    (
        Body("box", (0.054, 0.025, 0.054), (0.6, 0.2, 0.4585), (0.966, 0.0, 0.0, 0.259)),
        Body("cylinder", (0.034, 0.034, 0.107), (0.62, 0.0, 0.5115), UPRIGHT),
        Body("box", (0.042, 0.018, 0.035), (0.52, -0.1, 0.4395), UPRIGHT),
    ),
    Body("cylinder", (0.02, 0.02, 0.05), (0.5, 0.08, 0.4545), UPRIGHT),
)


def pose_of(camera):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = camera.rotation, camera.position
    return T


def wrong(camera, seed, metres=0.02, degrees=2.0):
    """The camera where it is not: off by the full distance and angle, in random directions."""
    rng = np.random.default_rng(seed)
    shift, axis = rng.normal(size=(2, 3))
    T = pose_of(camera)
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    T[:3, 3] += metres * shift / np.linalg.norm(shift)
    return with_pose(camera, T)


def pose_error(T_world_camera, camera):
    """Error of the camera's position [m] and rotation [degrees]."""
    E = np.linalg.inv(pose_of(camera)) @ np.asarray(T_world_camera, float)
    return np.linalg.norm(E[:3, 3]), np.degrees(np.linalg.norm(Rotation.from_matrix(E[:3, :3]).as_rotvec()))


def sensed(camera, depth, colour, seed):
    """Images as a sensor gives them: 1 mm of noise, 3 % of the depths missing, noisy 8-bit colours."""
    rng = np.random.default_rng(seed)
    depth = depth + rng.normal(0, 0.001, depth.shape)
    depth = np.where(np.isfinite(depth) & (rng.random(depth.shape) > 0.03), depth, 0.0)
    colour = np.clip(colour + rng.normal(0, 0.01, colour.shape), 0, 1)
    return depth.astype(np.float32), (np.round(colour * 255) / 255).astype(np.float32)


@pytest.fixture(scope="module")
def images():
    return robot_image(CAMERA, Shelf(), SCENE, JOINTS, OPENING)


def test_distance_to_the_robot_is_that_of_another_implementation(images):
    """The simulator draws the robot's surface in by half a millimetre."""
    depth, _, owners = images
    points = back_project(CAMERA, jnp.asarray(depth))[owners == ROBOT]
    assert len(points) > 1000
    distance, normal = camera_pose.panda_distance(points, jnp.asarray(JOINTS), jnp.float32(OPENING))
    np.testing.assert_allclose(distance, -5e-4, atol=2e-5)
    off, _ = camera_pose.panda_distance(points + 0.003 * normal, jnp.asarray(JOINTS), jnp.float32(OPENING))
    assert np.mean(np.abs(np.asarray(off) - 0.0025) < 2e-5) > 0.95
    np.testing.assert_allclose(jnp.linalg.norm(normal, axis=1), 1.0, atol=1e-5)
    towards = np.sum(np.asarray(normal) * (np.array([CAMERA.position]) - np.asarray(points)), axis=1)
    assert np.mean(towards > 0) > 0.98


@pytest.mark.parametrize("seed", range(4))
def test_wrong_pose_is_corrected_on_the_robot(images, seed):
    depth, colour = sensed(CAMERA, *images[:2], seed)
    given = wrong(CAMERA, seed)
    key = jax.random.key(seed)
    prepared = real_camera.prepare(key, given, Shelf(), depth, colour, None, JOINTS, OPENING)
    before = pose_error(pose_of(given), CAMERA)
    after = pose_error(prepared.pose.T_world_camera, CAMERA)
    assert before == pytest.approx((0.02, 2.0), abs=1e-3)
    assert after[0] < 0.0015
    assert after[1] < 0.15
    assert prepared.pose.corrected
    assert prepared.pose.error < 0.002
    np.testing.assert_allclose(pose_of(prepared.camera), prepared.pose.T_world_camera, atol=1e-6)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_segments_are_the_objects(images, seed, masked):
    """From the wrong pose, with noise: every object's segment, no shelf, no robot, and the floor as it was measured."""
    owners = images[2]
    depth, colour = sensed(CAMERA, *images[:2], seed)
    mask = np.where(owners <= TARGET, owners, -1) if masked else None
    given = wrong(CAMERA, seed + 10)
    prepared = real_camera.prepare(jax.random.key(seed), given, Shelf(), depth, colour, mask, JOINTS, OPENING)
    segmentation = np.array(prepared.segmentation)
    segments = np.unique(segmentation[segmentation >= 0])
    assert len(segments) == 4
    for body in np.unique(owners[(owners >= 0) & (owners <= TARGET)]):
        of_body = (owners == body) & (depth > 0)
        label = body if masked else np.bincount(segmentation[of_body & (segmentation >= 0)]).argmax()
        overlap = np.sum(of_body & (segmentation == label)) / np.sum(of_body | (segmentation == label))
        # What touches the floor or the robot's outline is given up.
        assert overlap > 0.85
        if body == TARGET:
            assert prepared.detection.found
            assert prepared.detection.segment == label
    assert np.mean(owners[segmentation >= 0] == SHELF) < 0.01
    assert prepared.floor.support > 500
    assert np.degrees(np.arccos(min(1.0, float(prepared.floor.normal[2])))) < 0.6
    assert abs(float(prepared.floor.height(jnp.array([0.6, 0.1, Shelf().board])))) < 0.003

    points = np.array(back_project(prepared.camera, prepared.depth))[segmentation >= 0]
    truth = np.array(back_project(CAMERA, jnp.asarray(images[0])))[(owners <= TARGET) & (owners >= 0)]
    low, high = truth.min(axis=0) - 0.01, truth.max(axis=0) + 0.01
    assert np.all((points > low) & (points < high))


def test_labels_are_those_that_a_recogniser_takes(images):
    """The shelf is FREE, the robot OTHER, and what was not measured MISSING."""
    owners = images[2]
    depth, colour = sensed(CAMERA, *images[:2], 3)
    prepared = real_camera.prepare(jax.random.key(0), CAMERA, Shelf(), depth, colour, None, JOINTS, OPENING)
    labels = np.array(prepared.segmentation)
    np.testing.assert_array_equal(labels == MISSING, depth == 0)
    seen = depth > 0
    assert np.mean(labels[seen & (owners == SHELF)] == FREE) > 0.97
    points = np.array(back_project(CAMERA, jnp.asarray(images[0])))
    robot = seen & (owners == ROBOT) & (points[..., 2] > Shelf().board + 0.01)
    assert robot.sum() > 500
    assert np.mean(labels[robot] == OTHER) > 0.98
    assert prepared.target_id == prepared.detection.segment
    assert np.mean(owners[labels == int(prepared.target_id)] == TARGET) > 0.95


@pytest.mark.slow
def test_a_recogniser_takes_the_segmentation_as_its_mask():
    camera = Camera().scaled(2)
    depth, colour = sensed(camera, *robot_image(camera, Shelf(), SCENE, JOINTS, OPENING)[:2], 0)
    key = jax.random.key(0)
    prepared = real_camera.prepare(key, wrong(camera, 0), Shelf(), depth, colour, None, JOINTS, OPENING)
    problem = types.SimpleNamespace(camera=camera, shelf=Shelf(), target=Target.cylinder())
    perceive = Recogniser(problem, camera=prepared.camera)
    seen = perceive(key, prepared.depth, mask=prepared.segmentation, target_id=prepared.target_id)
    assert seen.target_visible
    assert np.linalg.norm(np.asarray(seen.target_pose)[:2] - SCENE.target.position[:2]) < 0.005
    positions = np.asarray(seen.objects.position)[np.asarray(seen.objects.valid)]
    assert len(positions) == len(SCENE.objects)
    for body in SCENE.objects:
        assert np.linalg.norm(positions - body.position, axis=1).min() < 0.01


def test_the_same_key_gives_the_same_and_the_given_pose_stays_without_joints(images):
    depth, colour = sensed(CAMERA, *images[:2], 5)
    mask = np.full(depth.shape, -1)
    mask[images[2] == 2] = 0
    first, second = (real_camera.prepare(jax.random.key(0), CAMERA, Shelf(), depth, colour, mask) for _ in range(2))
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(a, b)
    assert 0 < np.sum(first.segmentation == 0) < 2048
    assert first.target_id == OTHER
    assert first.pose is None
    assert first.camera == CAMERA


def test_bad_images_are_refused_in_one_line(images):
    depth, colour, _ = images
    depth = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
    mask = np.zeros(depth.shape, int)

    def call(depth=depth, colour=colour, mask=mask):
        return real_camera.prepare(jax.random.key(0), CAMERA, Shelf(), depth, colour, mask)

    for arguments, word in (
        ({"depth": depth[1:]}, "depth image: its shape"),
        ({"colour": colour[:, 1:]}, "colour image: its shape"),
        ({"mask": mask[1:]}, "mask image: its shape"),
        ({"colour": (colour * 255).astype(np.uint8)}, "divide 8-bit"),
        ({"mask": mask * 1.0}, "whole numbers"),
        ({"depth": depth * 0}, "depth image: nothing was measured: no positive depth"),
        ({"depth": depth * 1000}, "not millimetres"),
    ):
        with pytest.raises(InputError, match=word):
            call(**arguments)
    with pytest.raises(InputError):
        TargetColour(minimum_pixels=0)
