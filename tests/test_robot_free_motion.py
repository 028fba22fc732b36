"""Motions through free space: the whole arm's clearance, straight and planned ways, and their timing."""

import functools
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.world import BODIES
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import make
from mechsearch_jax.robot.arm_clearance import (
    FARTHEST,
    HAND_FRAME,
    ArmBody,
    Held,
    Obstacles,
    bounds,
    clearance,
    tip_positions,
)
from mechsearch_jax.robot.arm_config import PANDA, check_joints
from mechsearch_jax.robot.free_motion import FreeMotionConfig, free_motion, free_path
from mechsearch_jax.robot.grasp_frames import WRIST_ORIGIN, gripper_rotation
from mechsearch_jax.robot.kinematics import FINGER_TIPS, HOME, gripper_pose, inverse_kinematics
from mechsearch_jax.robot.robot_trajectory import limit_shares
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body
from mechsearch_jax.workspace.shelf import Shelf

SHELF, HERE = Shelf(), np.array(HOME, float)
BODY = ArmBody.of(0.04)
# Turned aside.
ASIDE = HERE + np.array([1.6, 0.8, 0.0, 0.4, 0.0, 0.4, 0.0])
DT = 0.004


def boxes(*places, half=(0.05, 0.05, 0.05)):
    n = len(places)
    return Superquadrics(
        size=jnp.tile(jnp.float32(half), (n, 1)),
        exponents=jnp.full((n, 2), 0.2),
        position=jnp.float32(places),
        rotation=jnp.tile(jnp.eye(3), (n, 1, 1)),
        valid=jnp.ones(n, bool),
    )


def moved(**options):
    return free_motion(HERE, ASIDE, BODY, Obstacles.of(SHELF), timestep=DT, **options)


@functools.cache
def halfway_box():
    """A box where the hand is halfway between `HERE` and `ASIDE`."""
    place = tip_positions((HERE + ASIDE)[None] / 2)[0]
    return boxes(tuple(float(x) for x in place), half=(0.03, 0.03, 0.06))


@functools.cache
def around():
    obstacles = Obstacles.of(SHELF, (halfway_box(),))
    return obstacles, free_motion(HERE, ASIDE, BODY, obstacles, timestep=DT)


def test_the_clearance_is_never_more_than_that_of_the_simulators_geometry():
    """And rarely less by more than the cells and the planner's margins."""
    rng = np.random.default_rng(0)
    bare = Shelf(side_margin=0.0, ceiling_margin=0.0)
    box = Body("box", (0.05, 0.03, 0.06), (0.35, 0.1, 0.6), (1.0, 0.0, 0.0, 0.0))
    model = models.with_bodies(models.compile_model(bare, Camera()), [box] + [None] * (BODIES - 1), skin=0.0)
    data = models.initial_state(model, [box] + [None] * (BODIES - 1))
    links = [g for g in range(model.ngeom) if model.geom_bodyid[g] and model.geom_contype[g] == models.ROBOT_BIT]
    others = [model.geom(f"{name}_box").id for name in models.shelf_boxes(bare)] + [model.geom("box0").id]
    obstacles = Obstacles.of(bare, (boxes(box.position, half=box.half_size),))
    q = np.clip(HERE + rng.normal(0.0, 0.35, (60, 7)), PANDA.lower, PANDA.upper)
    distances = clearance(ArmBody.of(0.05), obstacles, q)
    short = []
    for angles, free in zip(q, distances.free, strict=True):
        data.qpos[:9] = [*angles, 0.025, 0.025]
        mujoco.mj_kinematics(model, data)
        exact = min(mujoco.mj_geomDistance(model, data, a, b, FARTHEST, None) for a in links for b in others)
        assert free <= max(exact, 0.0) + 2e-3
        if exact < 0.15 and free > 0.0:
            short.append(exact - free)
    assert len(short) > 10
    assert np.median(short) < 0.02


def test_fingers_and_what_is_held_count():
    place = tip_positions(HERE[None])[0]
    y = np.asarray(gripper_pose(HOME))[:3, 1]
    beside = Obstacles.of(SHELF, (boxes(tuple((place + 0.045 * y).tolist()), half=(0.004, 0.004, 0.004)),))
    closed, opened = (clearance(ArmBody.of(w), beside, HERE[None]).free[0] for w in (0.0, 0.08))
    assert closed > 0.01 > 0.0 >= opened
    held = Held(np.eye(4), (0.05, 0.05, 0.05))
    assert clearance(ArmBody.of(0.0, held), beside, HERE[None]).free[0] <= 0.0
    reach = [clearance(ArmBody.of(0.0, thing), beside, HERE[None]).inside[0] for thing in (None, held)]
    assert reach[1] > reach[0] + 0.02


def test_the_arm_keeps_off_itself_and_the_floor():
    folded = np.array([0.0, 0.0, 0.0, -3.05, 0.0, 0.6, 0.7])
    assert clearance(BODY, Obstacles.of(SHELF), folded[None]).free[0] < 0.02
    assert clearance(BODY, Obstacles.of(SHELF, floor=0.3), HERE[None]).free[0] <= 0.0
    with pytest.raises(InputError, match="where it begins the arm touches"):
        free_motion(HERE, ASIDE, BODY, Obstacles.of(SHELF, floor=0.3), timestep=DT)


def test_a_free_way_is_straight_and_keeps_the_limits():
    way = moved()
    assert way.straight
    np.testing.assert_allclose(way.position[-1], ASIDE, atol=1e-12)
    along = (way.position - HERE)[:, :2] / (ASIDE - HERE)[:2]
    np.testing.assert_allclose(along[:, 0], along[:, 1], atol=1e-5)
    shares = limit_shares(np.concatenate([HERE[None], way.position]), DT)
    assert 0.95 < max(shares) <= 1.0


@pytest.mark.parametrize("pace", [0.5, 0.1])
def test_a_slower_pace_scales_velocities_and_accelerations(pace):
    fast, slow = (limit_shares(np.concatenate([HERE[None], moved(pace=p).position]), DT) for p in (1.0, pace))
    for power, (a, b) in enumerate(zip(fast, slow, strict=True), start=1):
        assert b == pytest.approx(a * pace**power, rel=0.1)


def test_a_way_of_no_length_takes_what_it_must():
    still = free_motion(HERE, HERE, BODY, Obstacles.of(SHELF), timestep=DT, least=0.1)
    np.testing.assert_array_equal(still.position, np.tile(HERE, (25, 1)))
    assert len(free_motion(HERE, HERE, BODY, Obstacles.of(SHELF), timestep=DT).position) == 0


def test_a_blocked_way_is_planned_around_and_stays_clear():
    obstacles, way = around()
    assert not way.straight
    rows = np.concatenate([HERE[None], way.position])
    distances = clearance(BODY, obstacles, rows)
    assert distances.free.min() >= 0.005
    assert way.clearance == pytest.approx(distances.free.min(), abs=5e-3)
    assert distances.inside.max() < 0.0
    np.testing.assert_allclose(way.position[-1], ASIDE, atol=1e-12)
    assert max(limit_shares(rows, DT)) <= 1.0


def test_the_same_way_is_found_again():
    obstacles, way = around()
    again = free_path(HERE, ASIDE, BODY, obstacles, FreeMotionConfig())
    same = free_path(HERE, ASIDE, BODY, obstacles, FreeMotionConfig())
    other = free_path(HERE, ASIDE, BODY, obstacles, FreeMotionConfig(seed=1))
    np.testing.assert_array_equal(again, same)
    assert again.shape != other.shape or np.abs(again - other).max() > 1e-3
    nearest = np.abs(way.position[:, None] - again[None, 1:-1]).max(axis=2).min(axis=0)
    assert nearest.max() < 0.2


def test_nothing_passes_the_shelfs_front_although_it_is_open():
    """A stretched arm that turns from one side to the other would reach into the opening halfway."""
    pose = make(gripper_rotation(jnp.float32(0.0), jnp.float32(0.4)), jnp.float32([0.47, 0.0, 0.56]))
    solutions, valid = inverse_kinematics(pose, jnp.float32(WRIST_ORIGIN))
    middle = np.array(solutions[np.argmax(valid)], float)
    left, right = (middle + np.array([side, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]) for side in (0.75, -0.75))
    obstacles = Obstacles.of(SHELF)
    halfway = clearance(BODY, obstacles, np.array([left, right, middle]))
    assert halfway.free[2] > 0.0
    assert halfway.inside[:2].max() < 0.0
    assert halfway.inside[2] > 0.05
    config = FreeMotionConfig()
    path = free_path(left, right, BODY, obstacles, config)
    lines = np.concatenate([a + np.linspace(0, 1, 40)[:, None] * (b - a) for a, b in itertools.pairwise(path)])
    assert len(path) > 2
    assert clearance(BODY, obstacles, lines).inside.max() < 2 * config.slack


def test_what_cannot_be_reached_is_said_in_one_line():
    end = tip_positions(ASIDE[None])[0]
    inside = Obstacles.of(SHELF, (boxes(tuple(end.tolist())),))
    with pytest.raises(InputError, match="where it ends the arm touches") as error:
        free_motion(HERE, ASIDE, BODY, inside, timestep=DT)
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match=r"no way .* 3 attempts"):
        free_path(
            HERE, ASIDE, BODY, Obstacles.of(SHELF, (halfway_box(),)), FreeMotionConfig(attempts=3, extension=1e-3)
        )
    deep = HERE + np.array([0.0, 1.5, 0.0, 0.6, 0.0, 0.5, 0.0])
    with pytest.raises(InputError, match="inside the shelf; take it out"):
        free_motion(deep, HERE, BODY, Obstacles.of(SHELF), timestep=DT)


@pytest.mark.parametrize(
    ("q", "message"),
    [
        (np.zeros(6), "seven"),
        (np.full(7, np.nan), "seven"),
        (np.degrees(HERE), r"joint 2 at -84"),
    ],
)
def test_joint_angles_are_checked(q, message):
    with pytest.raises(InputError, match=message):
        check_joints("joints", q)


@pytest.mark.slow
def test_a_way_takes_hardly_more_than_the_time_optimal_one():
    """Of velocities and accelerations, without a limit of the jerk."""
    toppra = pytest.importorskip("toppra")

    bounds = [np.outer(limit, (-1.0, 1.0)) for limit in (PANDA.velocity, PANDA.acceleration)]
    limits = [
        toppra.constraint.JointVelocityConstraint(bounds[0]),
        toppra.constraint.JointAccelerationConstraint(bounds[1]),
    ]
    for way in (moved(), around()[1]):
        rows = np.concatenate([HERE[None], way.position])
        path = toppra.SplineInterpolator(np.linspace(0, 1, len(rows)), rows, bc_type="natural")
        solver = toppra.algorithm.TOPPRA(limits, path, parametrizer="ParametrizeConstAccel")
        assert 0.98 < len(way.position) * DT / solver.compute_trajectory().duration < 2.2


def test_random_ends_are_joined_without_touching_anything():
    rng = np.random.default_rng(1)
    scene = boxes((0.5, 0.1, 0.45), (0.42, -0.1, 0.46))
    obstacles = Obstacles.of(SHELF, (scene,))
    q = np.clip(HERE + rng.normal(0.0, 0.5, (60, 7)), PANDA.lower + 0.01, PANDA.upper - 0.01)
    distances = clearance(BODY, obstacles, q)
    free = q[(distances.free > 0.01) & (distances.inside < -0.01)][:8]
    assert len(free) == 8
    for end in free:
        way = free_motion(HERE, end, BODY, obstacles, timestep=DT)
        assert clearance(BODY, obstacles, way.position).free.min() > 0.003
        rows = np.concatenate([HERE[None], way.position])
        assert max(limit_shares(rows, DT)) <= 1.0
        assert (rows >= PANDA.lower - 1e-3).all()
        assert (rows <= PANDA.upper + 1e-3).all()


def test_poses_come_in_blocks_as_at_once():
    q = HERE + np.random.default_rng(2).normal(0.0, 0.2, (70, 7))
    np.testing.assert_allclose(tip_positions(q), jax.vmap(gripper_pose)(jnp.float32(q))[:, :3, 3], atol=1e-5)


@pytest.mark.parametrize(("e2", "is_round"), [(0.1, False), (0.7, True), (1.0, True), (1.3, True)])
def test_what_bounds_an_object_holds_it(e2, is_round):
    """Points on the outline of superquadrics, and the spheres that cover one in the hand."""
    angle = np.linspace(0.0, np.pi / 2, 500)
    outline = np.stack([0.04 * np.cos(angle) ** e2, 0.035 * np.sin(angle) ** e2], axis=1)
    (half_size,), (found,) = bounds(np.array([[0.04, 0.035, 0.06]]), np.array([[0.2, e2]]))
    assert found == is_round
    reach = np.linalg.norm(outline, axis=1).max() if is_round else outline.max()
    assert reach <= half_size[0] + 1e-9 < reach + 0.005
    held = Held.of(np.eye(4), (0.04, 0.035, 0.06), (0.2, e2))
    body = ArmBody.of(0.08, held).fine
    covers = (body.frame == HAND_FRAME) & (body.centre[:, 2] > FINGER_TIPS - 0.06)
    points = np.concatenate([np.column_stack([outline, np.full(500, z)]) for z in (-0.06, 0.0, 0.06)])
    gaps = np.linalg.norm(points[:, None] + [0.0, 0.0, FINGER_TIPS] - body.centre[covers], axis=-1)
    assert (gaps - body.radius[covers]).min(axis=1).max() <= 1e-6
