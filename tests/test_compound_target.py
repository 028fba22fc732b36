"""The planner with a target of several pieces: images of f, grasps, detection, belief, motions and pictures."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_shapes_union import cut_of
from test_workspace_target import BOTTLE, CUP, TEE

import mechsearch_jax as ms
from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.actions.trajectory import grip_for
from mechsearch_jax.belief.belief import with_target
from mechsearch_jax.config.config import ProblemConfig
from mechsearch_jax.existence import existence_tables
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.grasping.graspability import grasp_tables
from mechsearch_jax.images.target_pose import target_poses
from mechsearch_jax.observation import Observation
from mechsearch_jax.robot.gripper import Gripper, primitives_in_gripper
from mechsearch_jax.robot.pads import between, grip_between
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import union
from mechsearch_jax.shapes.compound import Piece, solids
from mechsearch_jax.shapes.solid import surface
from mechsearch_jax.shapes.union import field_of
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario, superquadrics
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target
from mechsearch_jax.workspace.target_view import swept_target

TARGETS = {name: Target.from_parts(pieces) for name, pieces in (("bottle", BOTTLE), ("cup", CUP), ("tee", TEE))}
CAMERA, SHELF = Camera(), Shelf()
every_target = pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS.keys())


def coarse_grid(target):
    return dataclasses.replace(target, grid=(3, 4))


def seen_from(camera, target, pose, rows, columns):
    """Depth of a target at pixels, float64; infinite beside it."""
    x, y, yaw = pose
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    ray = np.stack([(columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy, np.ones(rows.shape)])
    along = (np.array(camera.rotation) @ ray.reshape(3, -1)).T @ R
    start = (np.array(camera.position) - [x, y, float(target.height(SHELF))]) @ R
    origin = np.tile(start, (len(along), 1))
    depths = [cut_of(piece, origin, along) for piece in solids(target.compound.pieces)]
    return np.min(depths, axis=0).reshape(rows.shape)


@every_target
def test_f_holds_the_images_of_the_union(target):
    target, config = coarse_grid(target), ProblemConfig().existence
    tables = existence_tables(CAMERA, SHELF, target, config)
    coarse = CAMERA.scaled(config.step(CAMERA))
    places = target.places(SHELF, config.places)
    depth, corner = np.asarray(tables.depth), np.asarray(tables.corner)
    assert depth.shape[:2] == places.shape[:2]
    rows, columns = np.meshgrid(np.arange(coarse.height), np.arange(coarse.width), indexing="ij")
    for x, s in ((0, 0), (len(places) // 2, 1), (len(places) - 1, 3)):
        exact = seen_from(coarse, target, places[x, s], rows, columns)
        (top, left), (height, width) = corner[x, s], depth.shape[2:]
        assert np.isfinite(exact).sum() > 15
        part = np.full((height, width), np.inf)
        r, c = rows - top, columns - left
        within = (r >= 0) & (r < height) & (c >= 0) & (c < width)
        assert not np.isfinite(exact[~within]).any()
        part[r[within], c[within]] = exact[within]
        inside = np.isfinite(part) & np.isfinite(depth[x, s])
        # Rays that graze an edge.
        assert (np.isfinite(part) != np.isfinite(depth[x, s])).sum() <= 0.02 * inside.sum() + 1
        np.testing.assert_allclose(depth[x, s][inside], part[inside], atol=1e-4)
    cloud = np.asarray(tables.cloud).T
    np.testing.assert_allclose(union.distance(target.compound, list(cloud.T), np), 0.0, atol=1e-3)
    assert np.linalg.norm(cloud, axis=1).max() <= float(tables.radius) + 1e-6


@every_target
def test_grasps_close_on_material_and_reach_it_free(target):
    gripper, config = Gripper(), GraspConfig()
    tables = grasp_tables(gripper, target, config)
    T = np.asarray(tables.T_target_gripper, float)
    # The other rows hold no grasp.
    T = T[T[:, 2, 3] > -1.0]
    assert 20 <= len(T) <= 4 * 4 * len(config.tilts) * len(config.wrists)
    field = field_of(target.compound)
    body = surface(target.compound, 1500)
    boxes = primitives_in_gripper(gripper, gripper.max_opening, 0.0)[:11]
    for pose in T[:: max(len(T) // 12, 1)]:
        low, high = grip_between(target.compound, pose, gripper.max_opening)
        assert 0.001 < low <= high <= gripper.usable_opening / 2 + 1e-3
        ends, _ = between(field, pose[:3, :3], pose[:3, 3], gripper.max_opening)
        # The body is in the middle of the fingers.
        assert abs(np.nanmin(ends[:, 0]) + np.nanmax(ends[:, 1])) < 0.004
        local = (body - pose[:3, 3]) @ pose[:3, :3]
        for back in np.linspace(0.0, 0.15, 16):
            for box in boxes:
                placed = (local + np.array([0.0, 0.0, back]) - box.T_frame_primitive[:3, 3]) @ box.T_frame_primitive[
                    :3, :3
                ]
                assert not (np.abs(placed) < np.array(box.size) - 0.002).all(axis=1).any()
    yaw = np.arctan2(T[:, 1, 2], T[:, 0, 2])
    if not target.solid.round:
        # From all sides: whatever its yaw, some approach is within 45 degrees of the shelf's depth.
        gaps = np.diff(np.sort(np.concatenate([yaw, [yaw.min() + 2 * math.pi]])))
        assert gaps.max() < math.radians(90) + 1e-6


@every_target
def test_what_it_sweeps_is_around_it(target):
    direction = np.array([-0.9, 0.0, 0.43588989])
    points = swept_target(target, direction, 0.3, 500, 0.0)
    assert points.shape == (500, 3)
    # No point is inside: each is on the surface at some moment.
    back = points[:, None] - np.linspace(0.0, 0.3, 200)[None, :, None] * direction
    away = union.distance(target.compound, [back[..., i] for i in range(3)], np)
    assert np.abs(away.min(axis=1)).max() < 0.002 + 0.3 / 200


def test_a_box_of_one_piece_is_grasped_square_to_its_sides_as_a_box_is():
    target = Target.from_parts((Piece("box", Target.box().half_size),))
    poses = [
        np.asarray(grasp_tables(Gripper(), each, GraspConfig()).T_target_gripper) for each in (target, Target.box())
    ]
    own, usual = ({round(math.degrees(math.atan2(T[1, 2], T[0, 2]))) % 360 for T in each} for each in poses)
    assert own == usual == {0, 90, 180, 270}


def test_a_target_that_the_gripper_cannot_take_is_refused_in_one_line():
    ball = Target.from_parts((Piece("ellipsoid", (0.06, 0.06, 0.06)),))
    with pytest.raises(InputError, match="Target: the gripper fits nowhere"):
        grasp_tables(Gripper(), ball, GraspConfig())


@every_target
def test_its_pose_is_found_from_its_visible_points(target):
    camera, pose = CAMERA.scaled(3), np.array([0.6, 0.1, 0.7])
    rows, columns = np.meshgrid(np.arange(camera.height), np.arange(camera.width), indexing="ij")
    depth = seen_from(camera, target, pose, rows, columns)
    r, c = np.nonzero(np.isfinite(depth))
    ray = np.stack([(c + 0.5 - camera.cx) / camera.fx, (r + 0.5 - camera.cy) / camera.fy, np.ones(len(r))])
    points = np.array(camera.position) + (np.array(camera.rotation) @ ray).T * depth[r, c, None]
    chosen = np.random.default_rng(0).choice(len(points), 256)
    poses, costs = target_poses(
        target, SHELF, jnp.float32(camera.position), jnp.float32(points[chosen]), jnp.ones(256, bool)
    )
    best = np.asarray(poses)[int(np.argmin(costs))]
    np.testing.assert_allclose(best[:2], pose[:2], atol=2e-3)
    if not target.solid.round:
        apart = (best[2] - pose[2]) % target.turn
        assert min(apart, target.turn - apart) < 0.05


@pytest.mark.slow
def test_looks_at_a_target_of_pieces_are_computed_in_batches():
    """One after the other and in a batch f is the same, also where a closer look decides."""
    target = coarse_grid(TARGETS["cup"])
    problem = ms.build_problem(target)
    scenes = [superquadrics(load_scenario(example_scenarios()[n]).objects) for n in ("crowded-shelf", "first-light")]
    seen = [
        Observation(objects=objects, target_visible=jnp.array(False), target_pose=jnp.zeros(3)) for objects in scenes
    ]
    looks = [ms.update_belief(problem, ms.initial_belief(problem), one) for one in seen]
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *seen)
    batch = jax.jit(jax.vmap(lambda one: ms.update_belief(problem, ms.initial_belief(problem), one)))(both)
    for i, look in enumerate(looks):
        np.testing.assert_array_equal(batch.exists[i], look.exists)
        np.testing.assert_array_equal(batch.allowed[i], look.allowed)


@pytest.mark.slow
def test_a_hidden_and_a_found_target_of_pieces_are_planned_for():
    target = coarse_grid(TARGETS["cup"])
    problem = ms.build_problem(target)
    T = np.asarray(upright_pose(problem.poses, target.height(SHELF)))
    np.testing.assert_allclose(np.asarray(problem.grasps.T_world_target), T, atol=1e-6)
    objects = superquadrics(load_scenario(example_scenarios()["crowded-shelf"]).objects)
    unseen = Observation(objects=objects, target_visible=jnp.array(False), target_pose=jnp.zeros(3))
    belief = ms.update_belief(problem, ms.initial_belief(problem), unseen)
    assert 0 < int(belief.exists.sum()) < len(problem.poses)
    pose = jnp.float32([0.52, 0.05, 2.0])
    seen = unseen.replace(objects=empty(8), target_visible=jnp.array(True), target_pose=pose)
    belief = ms.update_belief(problem, belief, seen)
    scene, is_target = with_target(problem, belief, seen.objects)
    # Its barrel.
    assert scene.parts is None
    np.testing.assert_allclose(scene.size[is_target][0, 2], target.compound.pieces[0].half_size[2], atol=2e-3)
    decision = ms.search_and_grasp(sequences=10, horizon=1)(jax.random.key(0), problem, belief, seen)
    assert int(decision.action.kind) == ActionKind.RETRIEVE
    grip = grip_for(problem, seen, decision.action)
    # The barrel, or the handle.
    assert 0.009 < grip.low <= grip.high < 0.064
    trajectory = ms.whole_trajectory(problem, seen, decision.action)
    assert trajectory.clearance > 0.0
    assert len(ms.joint_trajectory(problem, decision.action, observation=seen).time) > 100
