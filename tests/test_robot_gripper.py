"""The gripper's and the arm's geometry, and what hits them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from mechsearch_jax.envs.health.cell_health import robot_meshes
from mechsearch_jax.geometry.superquadric import Superquadrics, gauge
from mechsearch_jax.geometry.swept_cloud import mesh_of
from mechsearch_jax.robot import arm_hits, kinematics
from mechsearch_jax.robot import gripper as module
from mechsearch_jax.robot.gripper import Gripper, RobotPart, arm_points, finger_parts, hand_parts, link_parts
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.workspace.shelf import Shelf

GRIPPER = Gripper()
Q7 = float(np.pi / 4)
# z of the finger tips' ends in the gripper frame [m].
TIP = 0.009
COLLISION = robot_meshes()
BOUNDED = {"hand": hand_parts(), "finger": finger_parts(), "link6": link_parts()[5], "link7": link_parts()[6]}


def signed_distance(primitive: RobotPart, points: np.ndarray, swept: float = 0.0) -> np.ndarray:
    """Distance to a primitive's surface, negative inside; the primitive may be swept back along z."""
    rotation, centre = primitive.T_frame_primitive[:3, :3], primitive.T_frame_primitive[:3, 3]
    distance = np.full(len(points), np.inf)
    for back in np.linspace(0.0, swept, 1 if swept == 0 else 121):
        local = (points - centre + (0.0, 0.0, back)) @ rotation
        if primitive.kind == "box":
            excess = np.abs(local) - primitive.size
            step = np.linalg.norm(np.maximum(excess, 0), axis=-1) + np.minimum(excess.max(axis=-1), 0)
        else:
            radius, half = primitive.size
            local[:, 2] -= np.clip(local[:, 2], -half, half)
            step = np.linalg.norm(local, axis=-1) - radius
        distance = np.minimum(distance, step)
    return distance


def union_distance(primitives: tuple[RobotPart, ...], points: np.ndarray, swept: float = 0.0) -> np.ndarray:
    return np.min([signed_distance(primitive, points, swept) for primitive in primitives], axis=0)


def surface(primitives: tuple[RobotPart, ...]) -> np.ndarray:
    """Points all over the surface of a union."""
    points = np.concatenate(
        [
            trimesh.sample.sample_surface(mesh_of(one.kind, one.size, one.T_frame_primitive), 20000, seed=1)[0]
            for one in primitives
        ]
    )
    return points[union_distance(primitives, points) > -3e-4]


@pytest.mark.skipif(COLLISION is None, reason="the robot's meshes are not installed: pip install '.[meshes]'")
@pytest.mark.parametrize("body", sorted(BOUNDED))
def test_the_real_surface_lies_inside_the_primitives_and_at_most_8_mm_beneath(body):
    mesh = trimesh.load(COLLISION / f"{body}.stl", force="mesh")
    points = np.concatenate([mesh.vertices, trimesh.sample.sample_surface(mesh, 10000, seed=0)[0]])
    assert union_distance(BOUNDED[body], points).max() <= 0.0
    assert cKDTree(surface(BOUNDED[body])).query(points)[0].max() <= 0.008


@pytest.mark.skipif(COLLISION is None, reason="the robot's meshes are not installed: pip install '.[meshes]'")
@pytest.mark.parametrize("link", range(1, 6))
def test_the_arm_lies_inside_its_capsules(link):
    mesh = trimesh.load(COLLISION / f"link{link}.stl", force="mesh")
    points = np.concatenate([mesh.vertices, trimesh.sample.sample_surface(mesh, 5000, seed=0)[0]])
    distance = union_distance(link_parts()[link - 1], points)
    assert all(primitive.kind == "capsule" for primitive in link_parts()[link - 1])
    assert distance.max() <= 0.0
    assert np.quantile(distance, 0.05) > -0.03


def test_the_fingers_face_each_other_at_the_opening():
    primitives = module.primitives_in_gripper(GRIPPER, 0.06, Q7)
    left = primitives[len(hand_parts()) : len(hand_parts()) + len(finger_parts())]
    right = primitives[len(hand_parts()) + len(finger_parts()) : len(hand_parts()) + 2 * len(finger_parts())]
    y = np.linspace(-0.05, 0.05, 2001)
    middle = np.stack([0 * y, y, 0 * y], axis=-1)
    free = y[(union_distance(left, middle) > 0) & (union_distance(right, middle) > 0) & (np.abs(y) < 0.04)]
    np.testing.assert_allclose((free.min(), free.max()), (-0.03, 0.03), atol=5e-4)


@pytest.mark.parametrize("q7", [Q7, Q7 - np.pi, 1.1])
def test_links_6_and_7_sit_where_the_kinematics_put_them(q7):
    q = kinematics.HOME.copy()
    q[6] = q7
    frames = np.asarray(kinematics.forward_kinematics(q), np.float64)
    T_gripper_base = np.linalg.inv(np.asarray(kinematics.gripper_pose(q), np.float64))
    placed = module.primitives_in_gripper(GRIPPER, 0.0, q7)[len(hand_parts()) + 2 * len(finger_parts()) :]
    expected = [frames[6] @ one.T_frame_primitive for one in link_parts()[6]]
    expected += [frames[5] @ one.T_frame_primitive for one in link_parts()[5]]
    for primitive, T_base_primitive in zip(placed, expected, strict=True):
        np.testing.assert_allclose(primitive.T_frame_primitive, T_gripper_base @ T_base_primitive, atol=1e-5)


@pytest.mark.parametrize(("opening", "distance"), [(0.08, 0.0), (0.08, 0.3), (0.0, 0.1)])
def test_clouds_lie_on_the_boundary_of_what_is_swept(opening, distance):
    points = module.swept_cloud(GRIPPER, opening, Q7, 300, distance)
    assert points.shape == (300, 3)
    assert points.dtype == np.float32
    gap = union_distance(module.primitives_in_gripper(GRIPPER, opening, Q7), points.astype(np.float64), distance)
    assert np.abs(gap).max() < 1e-3


def test_a_cloud_at_rest_is_a_swept_cloud_over_no_distance():
    cloud = module.gripper_cloud(GRIPPER, 0.08, Q7, 100, seed=4)
    np.testing.assert_array_equal(cloud, module.swept_cloud(GRIPPER, 0.08, Q7, 100, 0.0, seed=4))


def test_clouds_cover_evenly_and_densely_in_front():
    cloud = module.swept_cloud(GRIPPER, 0.08, Q7, 600)
    spacing = cKDTree(cloud).query(cloud, k=2)[0][:, 1]
    front = cloud[:, 2] > GRIPPER.front + 0.02
    behind = cloud[:, 2] < GRIPPER.front - 0.04
    assert np.quantile(spacing[front], 0.95) < 0.018
    assert spacing[behind].max() < 0.045
    assert spacing.min() > 0.004
    everything = module.swept_cloud(GRIPPER, 0.08, Q7, 4000, seed=5)
    hole = cKDTree(cloud).query(everything)[0]
    assert hole[everything[:, 2] > GRIPPER.front + 0.02].max() < 0.025
    assert hole.max() < 0.04


def test_the_approach_ends_at_the_tips():
    assert module.swept_cloud(GRIPPER, 0.08, Q7, 100)[:, 2].max() == pytest.approx(TIP, abs=1e-3)


def bounding_box(primitives: tuple[RobotPart, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Half-extents and centre of the smallest upright box around primitives."""
    bounds = np.array(
        [mesh_of(primitive.kind, primitive.size, primitive.T_frame_primitive).bounds for primitive in primitives]
    )
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    return (high - low) / 2, (high + low) / 2


def test_boxes_hold_the_fingers_and_the_hand():
    primitives = module.primitives_in_gripper(GRIPPER, 0.08, 0.0)
    half_size, centre = bounding_box(primitives[len(hand_parts()) : len(hand_parts()) + 2 * len(finger_parts())])
    np.testing.assert_allclose(centre[:2], (0.0, 0.0), atol=1e-3)
    assert centre[2] + half_size[2] == pytest.approx(TIP, abs=1e-3)
    assert half_size[1] == pytest.approx(0.04 + 0.0267, abs=1e-3)
    cloud = module.gripper_cloud(GRIPPER, 0.08, Q7, 2000)
    hand_half, hand_centre = bounding_box(primitives[: len(hand_parts())])
    fingers = cloud[cloud[:, 2] > hand_centre[2] + hand_half[2] + 1e-3]
    assert (np.abs(fingers - centre) <= half_size + 1e-3).all()
    assert hand_half[1] > 0.1


def test_arm_points_lie_on_the_capsules_axes():
    q = jnp.asarray(kinematics.HOME)
    points, radii = module.arm_points(q, 3)
    frames = np.asarray(kinematics.forward_kinematics(q))
    assert points.shape == (len(radii), 3)
    start = 0
    for link in range(1, 5):
        for capsule in link_parts()[link]:
            axis = frames[link] @ capsule.T_frame_primitive
            np.testing.assert_allclose(points[start + 1], axis[:3, 3], atol=1e-5)
            ends = axis[:3, 3] + np.array([[-1.0], [1.0]]) * capsule.size[1] * axis[:3, 2]
            np.testing.assert_allclose(points[jnp.array([start, start + 2])], ends, atol=1e-5)
            np.testing.assert_allclose(radii[start : start + 3], capsule.size[0], atol=1e-6)
            start += 3


def test_the_arm_hits_the_shelf_only_when_it_reaches_in():
    shelf = Shelf()
    home = jnp.asarray(kinematics.HOME)
    stretched_low = jnp.array([0.0, 1.5, 0.0, -0.4, 0.0, 1.9, 0.8])
    assert not module.arm_hits_shelf(home, shelf)
    assert module.arm_hits_shelf(stretched_low, shelf)
    assert not module.arm_hits_shelf(stretched_low.at[0].set(2.8), shelf)
    both = jnp.stack([home, stretched_low])
    np.testing.assert_array_equal(module.arm_hits_shelf(both, shelf), (False, True))
    np.testing.assert_array_equal(jax.jit(lambda q: module.arm_hits_shelf(q, shelf))(both), (False, True))
    np.testing.assert_array_equal(jax.vmap(lambda q: module.arm_hits_shelf(q, shelf))(both), (False, True))


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
        size, rounder = arm_hits.grown(jnp.float32(half), jnp.float32(exponents), jnp.float32(radius))
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
    np.testing.assert_array_equal(jax.jit(arm_hits.arm_hits)(path, scene), each)
    scenes = jax.tree.map(lambda a: np.stack([a, a]), scene)
    both = jax.jit(jax.vmap(arm_hits.arm_hits))(path[:, None], scenes)
    np.testing.assert_array_equal(both[:, 0], each)
