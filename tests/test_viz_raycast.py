"""The ray-caster of films: against the simulated camera, and capsules against their own definition."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs import simulated_camera as seen_by
from mechsearch_jax.envs.model import shelf_boxes
from mechsearch_jax.envs.world import from_scenario
from mechsearch_jax.robot.arm_clearance import link_poses
from mechsearch_jax.robot.kinematics import FINGER_TIPS, HOME
from mechsearch_jax.shapes import in_order, shape_of
from mechsearch_jax.viz.panda import GREY, panda_solids
from mechsearch_jax.viz.raycast import RAYS, Capsule, Eye, Solid
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
        yield Solid(BOARD, (high - low) / 2, np.eye(3), (low + high) / 2, tuple(map(float, seen_by.PALETTE[-1])))
    for i in np.flatnonzero(world.valid):
        fields = (np.asarray(a[i]) for a in (world.half_size, world.rotation, world.position))
        yield Solid(in_order()[int(world.kind[i])], *fields, tuple(map(float, seen_by.PALETTE[i])))


def test_it_sees_what_the_simulated_camera_sees():
    world = from_scenario(SCENE)
    picture = eye().picture(solids(world))
    expected = seen_by.observe(Camera().scaled(16 // RAYS), world)
    np.testing.assert_allclose(picture.depth, expected.depth, atol=1e-5)
    # The camera takes the boards' normals from where they are, at edges it may take the other face's.
    differs = np.abs(picture.colour - np.asarray(expected.colour)).max(axis=-1) > 2e-3
    assert not differs[np.asarray(expected.segmentation) != seen_by.SHELF].any()
    assert differs.mean() < 0.05


def test_what_is_drawn_later_is_the_same_as_drawn_at_once():
    every = list(solids(from_scenario(SCENE)))
    before = eye().picture(every[:4])
    kept = before.colour.copy()
    both = eye().picture(every[4:], before)
    np.testing.assert_array_equal(both.pixels, eye().picture(every).pixels)
    np.testing.assert_array_equal(before.colour, kept)


def test_a_pixel_is_the_mean_of_its_rays():
    assert eye().empty().pixels.shape == (CAMERA.height, CAMERA.width, 3)
    picture = eye().picture(solids(from_scenario(SCENE)))
    mean = picture.colour[2 * RAYS : 3 * RAYS, 5 * RAYS : 6 * RAYS].mean(axis=(0, 1))
    np.testing.assert_allclose(picture.pixels[2, 5] / 255, mean, atol=0.003)


@pytest.mark.parametrize("distance", [-0.5, 0.0, 4.0])
def test_what_is_behind_around_or_far_from_the_camera_does_no_harm(distance):
    forward = np.array(CAMERA.rotation)[:, 2]
    ball = Solid(Capsule(), np.full(3, 0.05), np.eye(3), np.array(CAMERA.position) + distance * forward, GREY)
    picture = eye().picture([ball])
    assert np.isfinite(picture.colour).all()
    assert np.isinf(picture.depth).all() == (distance <= 0.0)


def outside(point, radius, half):
    """Distance to a capsule, by its definition."""
    nearest = np.clip(point[..., 2], -half, half)
    return np.linalg.norm(point - np.stack([0 * nearest, 0 * nearest, nearest], axis=-1), axis=-1) - radius


number = st.floats(-1.0, 1.0)


@settings(max_examples=60, deadline=None)
@given(
    aim=st.tuples(number, number, number),
    start=st.tuples(number, number, number).filter(lambda s: np.linalg.norm(s) > 0.3),
    radius=st.floats(0.02, 0.3),
    half=st.floats(0.0, 0.5),
)
def test_rays_meet_a_capsule_where_they_first_come_to_its_surface(aim, start, radius, half):
    start = np.array(start) / np.linalg.norm(start) * 2.0
    way = 0.5 * np.array(aim) - start
    size = np.array([radius, radius, half + radius])
    with np.errstate(all="ignore"):
        met = float(Capsule().cut(list(start), list(way), size, np))
    shares = np.linspace(0.0, 2.0, 4001)
    distance = outside(start + shares[:, None] * way, radius, half)
    if np.isinf(met):
        assert distance.min() > -1e-6
        return
    point = start + met * way
    assert outside(point, radius, half) == pytest.approx(0.0, abs=1e-9)
    assert (distance[shares < met - 1e-3] > 0.0).all()
    normal = Capsule().normal(point[None], size[None], np)[0]
    assert normal @ way <= 1e-9
    assert np.linalg.norm(normal) == pytest.approx(radius)


def test_the_panda_has_its_fingers_where_they_are():
    (poses,) = link_poses(np.asarray(HOME)[None])
    closed, opened = (panda_solids(poses, opening) for opening in (0.0, 0.08))
    assert len(closed) == len(opened)
    moved = [b.position - a.position for a, b in zip(closed, opened, strict=True)]
    still, fingers = moved[:-6], moved[-6:]
    np.testing.assert_allclose(still, 0.0)
    across = poses[7][:3, 1]
    np.testing.assert_allclose(fingers, np.outer([0.04] * 3 + [-0.04] * 3, across), atol=1e-6)
    # The finger tips are where the gripper is, and nothing reaches further.
    tip = poses[7][:3, 3] + FINGER_TIPS * poses[7][:3, 2]
    reach = [
        (s.position - tip) @ poses[7][:3, 2] + np.abs(s.rotation.T @ poses[7][:3, 2]) @ s.half_size for s in closed[-6:]
    ]
    assert max(reach) == pytest.approx(0.0, abs=0.01)
