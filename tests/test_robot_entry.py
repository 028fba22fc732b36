"""The way in and out: its poses, the arm along it, and what stands in the way of its stretch along x."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.geometry.transforms import back_off, make
from mechsearch_jax.robot import entry
from mechsearch_jax.robot.grasp_frames import gripper_rotation
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.kinematics import gripper_pose, inverse_kinematics, line_kinematics, path_kinematics
from mechsearch_jax.robot.motion import (
    MotionConfig,
    pick_and_place_reference,
    push_reference,
    retrieve_reference,
)
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.shelf import Shelf, hits_shelf

GRIPPER, SHELF = Gripper(), Shelf()
Q7 = jnp.float32(math.radians(30))
CONFIG = MotionConfig(waypoints=7)
# A pose deep in the shelf, whose pre-grasp is inside, and one near its front, whose pre-grasp is outside.
DEEP, NEAR = (0.7, 0.2, 0.54), (0.56, 0.2, 0.54)


def pose(position, yaw=0.0, tilt=25.0):
    rotation = gripper_rotation(jnp.float32(math.radians(yaw)), jnp.float32(math.radians(tilt)))
    return make(rotation, jnp.float32(position))


def test_a_way_in_begins_outside_goes_along_x_and_then_along_the_grippers_z():
    T = pose(DEEP, 20.0)
    path = np.asarray(entry.way_in(T, 0.374, GRIPPER, 5, 7), np.float64)
    assert path.shape == (12, 4, 4)
    np.testing.assert_allclose(path[:, :3, :3], np.broadcast_to(np.asarray(T)[:3, :3], (12, 3, 3)))
    pre = np.asarray(T, np.float64)[:3, 3] - GRIPPER.approach * np.asarray(T, np.float64)[:3, 2]
    assert pre[0] > SHELF.front
    length = float(entry.crossing_length(T, 0.374, GRIPPER))
    assert length == pytest.approx(pre[0] - 0.374, abs=1e-6)
    along = np.linspace(0, 1, 6)[:, None]
    np.testing.assert_allclose(path[:6, :3, 3], pre + (along - 1) * (length, 0, 0), atol=1e-6)
    np.testing.assert_allclose(path[0, 0, 3], 0.374, atol=1e-6)
    np.testing.assert_allclose(path[5:, :3, 3], pre + np.linspace(0, 0.3, 7)[:, None] * path[0, :3, 2], atol=1e-6)


def test_where_the_approach_begins_outside_there_is_no_crossing():
    T = pose(NEAR)
    assert float(entry.crossing_length(T, 0.374, GRIPPER)) == 0.0
    path = entry.way_in(T, 0.374, GRIPPER, 3, 7)
    np.testing.assert_allclose(path[:3], np.broadcast_to(path[3], (3, 4, 4)), atol=1e-6)
    line, _ = line_kinematics(T, jnp.float32(GRIPPER.approach), Q7, 7)
    q, reachable = path_kinematics(path, Q7)
    assert bool(reachable)
    np.testing.assert_allclose(q[3:], line, atol=1e-5)


def test_poses_come_in_batches_as_one_by_one():
    T = jnp.stack([pose(DEEP, yaw) for yaw in (-30.0, 0.0, 30.0)])
    outside = jnp.float32([0.3, 0.34, 0.374])
    batch = entry.crossing_poses(T, outside, GRIPPER, 4)
    assert batch.shape == (3, 4, 4, 4)
    for i in range(3):
        np.testing.assert_allclose(batch[i], entry.crossing_poses(T[i], outside[i], GRIPPER, 4), atol=1e-6)


def test_a_full_hand_is_taken_to_the_first_place_in_reach():
    find = jax.jit(lambda T: entry.ways_in(T, Q7, GRIPPER, 6, 12))
    q, reachable, outside = find(pose(DEEP))
    assert bool(reachable)
    assert float(outside) == pytest.approx(GRIPPER.outside[0])
    np.testing.assert_allclose(gripper_pose(q[0])[0, 3], outside, atol=1e-3)
    np.testing.assert_allclose(gripper_pose(q[-1]), pose(DEEP), atol=1e-3)
    assert not bool(find(pose((0.9, 0.4, 0.5)))[1])


def test_the_gripper_enters_where_the_arm_follows_and_what_it_sweeps_leaves_the_shelf_alone():
    T = jnp.stack(
        [
            pose((x, y, z), yaw)
            for x in (0.56, 0.68, 0.74)
            for y in (0.0, 0.2)
            for z in (0.46, 0.54)
            for yaw in (-20.0, 0.0, 20.0)
        ]
    )
    mask = jnp.arange(len(T)) % 5 != 0
    # Next to nothing, and what hangs so far down that it touches the board at the lower poses only.
    hanging = np.linspace((0.0, 0.0, 0.0), (0.12, 0.0, 0.0), 50)
    clouds = jnp.float32(np.stack([np.zeros((50, 3)), hanging])).swapaxes(1, 2)
    cloud = np.arange(len(T)) % 2
    find = jax.jit(
        lambda T, mask: entry.gripper_enters(
            SHELF, GRIPPER, 4, clouds, entry.WaysIn(T, jnp.full(len(T), Q7), cloud), mask
        )
    )
    entered = np.asarray(find(T, mask))
    follows = jax.jit(jax.vmap(lambda path: entry.arm_follows(path, Q7, SHELF)))
    whole = np.asarray(follows(jax.vmap(lambda T: entry.way_in(T, GRIPPER.nearest_outside, GRIPPER, 3, 4))(T)))
    points = np.einsum("kij,kpj->kpi", np.asarray(T)[:, :3, :3], np.asarray(clouds).swapaxes(1, 2)[cloud])
    points += np.asarray(T)[:, None, :3, 3]
    touches = np.asarray(hits_shelf(SHELF, jnp.asarray(points))).any(axis=1)
    np.testing.assert_array_equal(entered, whole & ~touches & np.asarray(mask))
    assert 5 < entered.sum() < len(T)
    assert (whole & touches & np.asarray(mask)).any()


def in_one_configuration(q, T_path_free=None):
    """Whether joint angles along a motion are the same solution of the inverse kinematics all the way."""
    q = np.asarray(q)
    solutions, _ = inverse_kinematics(gripper_pose(q), q[:, 6])
    error = np.abs(np.asarray(solutions) - q[:, None]).max(axis=-1)
    branch = error.argmin(axis=1)
    return bool((error.min(axis=1) < 0.02).all() and (branch == branch[0]).all())


def x_of(q):
    return np.asarray(gripper_pose(q))[..., 0, 3]


# What a motion is made of is an argument: of constants XLA computes much while it compiles.
PUSHED = jax.jit(push_reference, static_argnums=3)


@pytest.mark.parametrize("position", [DEEP, pytest.param(NEAR, marks=pytest.mark.slow)])
def test_every_motion_begins_and_ends_outside_and_passes_its_poses(position):
    T = pose(position)
    displacement, opening = jnp.float32([0.0, -0.06, 0.0]), jnp.float32(0.08)
    place = pose((position[0] - 0.02, position[1] - 0.1, position[2]), 10.0)
    limit, plan = GRIPPER.nearest_outside + 2e-3, CONFIG
    pushed, reachable = PUSHED(T, displacement, Q7, plan)
    assert bool(reachable)
    assert np.abs(np.asarray(gripper_pose(pushed.q)) - np.asarray(T)).max(axis=(1, 2)).min() < 2e-3
    assert in_one_configuration(pushed.q[::25])
    taken, reachable = jax.jit(retrieve_reference, static_argnums=3)(T, Q7, opening, plan)
    assert bool(reachable)
    np.testing.assert_allclose(gripper_pose(taken.q[int(taken.closed) - 1]), T, atol=2e-3)
    assert in_one_configuration(taken.q[::25])
    placed, reachable = jax.jit(pick_and_place_reference, static_argnums=4)(T, place, Q7, opening, plan)
    assert bool(reachable)
    raised = np.asarray(place).copy()
    raised[2, 3] += plan.clearance
    np.testing.assert_allclose(gripper_pose(placed.q[int(placed.closed) - 1]), T, atol=2e-3)
    np.testing.assert_allclose(gripper_pose(placed.q[int(placed.opens) - 1]), raised, atol=2e-3)
    for reference in (pushed, taken, placed):
        assert x_of(reference.start[:7]) <= limit
        assert x_of(reference.q[-1]) <= limit
        assert np.abs(np.diff(np.asarray(reference.q), axis=0)).max() < 0.05


def test_a_push_from_outside_takes_the_old_way():
    """Where both its ends are reached from outside, nothing is added to a push but time."""
    T, displacement = pose(NEAR), jnp.float32([0.0, -0.06, 0.0])
    reference, _ = PUSHED(T, displacement, Q7, CONFIG)
    before = back_off(T, jnp.float32(GRIPPER.approach))
    np.testing.assert_allclose(gripper_pose(reference.start[:7]), before, atol=1e-3)
    over = int(reference.length)
    np.testing.assert_allclose(
        reference.q[over:], np.broadcast_to(reference.q[-1], reference.q[over:].shape), atol=1e-5
    )
    turned = np.abs(np.diff(np.asarray(reference.q[:over]), axis=0)).max(axis=1)
    assert (turned > 0.0).mean() > 0.95


@pytest.mark.parametrize("outside", [(), (0.34, 0.3)])
def test_places_outside_come_in_order(outside):
    with pytest.raises(InputError, match="ascending"):
        Gripper(outside=outside)


def test_a_place_inside_does_not_count():
    entry.check_outside(GRIPPER, SHELF)
    with pytest.raises(InputError, match="in front of the shelf"):
        entry.check_outside(Gripper(outside=(0.3, 0.42)), SHELF)
