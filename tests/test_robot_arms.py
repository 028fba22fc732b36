"""Panda and FR3: each with its own limits, in planning, timing and checks, by figures that are given here once more."""

import dataclasses
import functools
import types

import jax.numpy as jnp
import numpy as np
import pytest
from test_search_whole_trajectory import CONFIG, SETTING, grasp, seen, taken

from mechsearch_jax.actions.kinds.retrieve import retrieve_action
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.problem.settings import load_settings
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.robot.arm_config import ARMS, FR3, PANDA, ArmConfig, check_joints
from mechsearch_jax.robot.free_motion import timed_rows
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.kinematics import HOME, gripper_pose, inverse_kinematics
from mechsearch_jax.robot.robot_trajectory import limit_shares
from mechsearch_jax.robot.ros_messages import joint_trajectory_message
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.whole_trajectory import TrajectoryConfig, whole_trajectory

# An FR3 may have these angles, a Panda may not.
FR3_ALONE = np.array([0.03, -1.4, 0.03, -2.0, 0.15, 3.9, 0.7])
DT = 0.004
ON_FR3 = types.SimpleNamespace(**{**vars(SETTING), "gripper": Gripper(arm=FR3)})


def allowed_velocities(q):
    """Lower and upper limits of an FR3's joint velocities, as libfranka's rate_limiting.h has them."""
    upper = (
        (2.62, 0.30, 12.0 * (2.7501 - q[:, 0])),
        (2.62, 0.20, 5.17 * (1.7918 - q[:, 1])),
        (2.62, 0.20, 7.0 * (2.9065 - q[:, 2])),
        (2.62, 0.30, 8.0 * (-0.1458 - q[:, 3])),
        (5.26, 0.35, 34.0 * (2.8101 - q[:, 4])),
        (4.18, 0.35, 11.0 * (4.5205 - q[:, 5])),
        (5.26, 0.35, 34.0 * (3.0196 - q[:, 6])),
    )
    lower = (
        (2.62, 0.30, 12.0 * (2.7501 + q[:, 0])),
        (2.62, 0.20, 5.17 * (1.7918 + q[:, 1])),
        (2.62, 0.20, 7.0 * (2.9065 + q[:, 2])),
        (2.62, 0.30, 8.0 * (3.0481 + q[:, 3])),
        (5.26, 0.35, 34.0 * (2.8101 + q[:, 4])),
        (4.18, 0.35, 11.0 * (-0.54092 + q[:, 5])),
        (5.26, 0.35, 34.0 * (3.0196 + q[:, 6])),
    )
    up, down = (
        np.stack([np.clip(np.sqrt(np.maximum(root, 0.0)) - offset, 0.0, most) for most, offset, root in side], axis=1)
        for side in (upper, lower)
    )
    return -down, up


def assert_an_fr3_may(q):
    """Follow these rows, from rest to rest, as differences of them say."""
    assert (q >= np.array(FR3.least) - 1e-4).all()
    assert (q <= np.array(FR3.most) + 1e-4).all()
    rest = np.concatenate([np.repeat(q[:1], 3, 0), q, np.repeat(q[-1:], 3, 0)])
    velocity = np.diff(rest, axis=0) / DT
    for at in (rest[:-1], rest[1:]):
        low, high = allowed_velocities(at)
        assert (velocity >= low - 1e-3).all()
        assert (velocity <= high + 1e-3).all()
    assert np.abs(np.diff(velocity, axis=0) / DT).max() <= 10.01
    assert np.abs(np.diff(velocity, 2, axis=0) / DT**2).max() <= 5005.0


@functools.cache
def on_fr3(speed=1.0):
    action = retrieve_action(grasp(), jnp.float32(np.radians(30.0)), jnp.float32(0.08))
    return whole_trajectory(ON_FR3, seen(), action, width=0.0, speed=speed, config=CONFIG)


def test_the_panda_is_what_it_was():
    """Rows of a trajectory of the version that knew no other arm."""
    trajectory = taken()
    assert trajectory.arm == PANDA == Gripper().arm == Workcell().gripper.arm
    assert len(trajectory.time) == 1627
    expected = [
        [-0.007022, -1.495183, 0.075122, -2.512587, 0.220005, 2.319705, 0.669245],
        [-0.038763, -0.756806, 0.303209, -2.725941, 0.484843, 3.116888, 0.523599],
        [-0.032313, -0.679469, 0.298531, -2.701162, 0.473575, 3.170695, 0.523599],
    ]
    np.testing.assert_allclose(trajectory.position[[100, 600, 1100]], expected, atol=1e-5)


def test_speeds_fall_near_the_ends_of_an_fr3s_joints_and_nowhere_on_a_panda():
    q = np.random.default_rng(0).uniform(FR3.least, FR3.most, (500, 7))
    low, high = allowed_velocities(q)
    for way, limit in ((1.0, high), (-1.0, -low)):
        speeds = FR3.speeds(q, np.full_like(q, way))
        np.testing.assert_allclose(speeds, np.maximum(limit, 1e-3), atol=1e-5)
        in_jax = FR3.speeds(jnp.float32(q), jnp.full(q.shape, way))
        np.testing.assert_allclose(in_jax, speeds, atol=2e-3)
    np.testing.assert_array_equal(PANDA.speeds(q, q), np.float32(PANDA.velocity)[None])


@pytest.mark.parametrize("corners", [2, 3])
def test_random_ways_keep_an_fr3s_limits_by_its_controllers_own_rules(corners):
    rng = np.random.default_rng(corners)
    least, most = np.array(FR3.least) + 0.03, np.array(FR3.most) - 0.03
    beyond = 0
    for _ in range(20):
        ends = rng.uniform(least, most, (corners, 7))
        if corners == 3:
            ends = np.clip(HOME + rng.normal(0.0, 0.5, ends.shape), least, most)
        share = np.linspace(0.0, corners - 1, 31)
        points = np.stack([np.interp(share, np.arange(corners), joint) for joint in ends.T], axis=1)
        rows = timed_rows(points, DT, 1.0, arm=FR3)
        whole = np.concatenate([points[:1], rows])
        assert_an_fr3_may(np.clip(whole, np.array(FR3.least), np.array(FR3.most)))
        shares = limit_shares(whole, DT, FR3)
        assert max(shares) <= 1.0
        # And none waits for nothing.
        assert max(shares[0], shares[1] ** 0.5, shares[2] ** (1 / 3)) > 0.8
        of_panda = np.concatenate([points[:1], timed_rows(points, DT, 1.0)])
        beyond += max(limit_shares(of_panda, DT, FR3)) > 1.01
    assert beyond > 5


@pytest.mark.parametrize("speed", [1.0, 0.4])
def test_whole_trajectories_keep_an_fr3s_limits(speed):
    trajectory = on_fr3(speed)
    assert_an_fr3_may(trajectory.position)
    report = trajectory.report()
    assert report.within()
    assert report.velocity <= speed
    assert report.acceleration <= speed**2
    assert joint_trajectory_message(trajectory)["joint_names"] == [f"fr3_joint{i}" for i in range(1, 8)]


def test_a_motion_begins_where_an_fr3_alone_may_be():
    check_joints("joints", FR3_ALONE, FR3)
    with pytest.raises(
        InputError, match=r"joints: joint 6 at 3.9000 rad .* on the panda, .* this is the fr3, .* \[arm\]"
    ):
        check_joints("joints", FR3_ALONE)
    with pytest.raises(InputError, match=r"on the fr3, 0.5445 to 4.5169; if this is the panda"):
        check_joints("joints", np.where(np.arange(7) == 5, 0.2, FR3_ALONE), FR3)
    action = retrieve_action(grasp(), jnp.float32(np.radians(30.0)), jnp.float32(0.08))
    given = {"width": 0.0, "joints": FR3_ALONE}
    trajectory = whole_trajectory(ON_FR3, seen(), action, config=CONFIG, **given)
    np.testing.assert_array_equal(trajectory.position[0], FR3_ALONE)
    assert_an_fr3_may(trajectory.position)
    with pytest.raises(InputError, match="joint 6"):
        whole_trajectory(SETTING, seen(), action, config=CONFIG, **given)


def test_a_joint_at_its_very_end_is_not_crept_to_for_minutes():
    end = np.array(HOME, float)
    end[3] = FR3.most[3]
    with pytest.raises(InputError, match="near its end a joint of the fr3 may hardly move"):
        timed_rows(np.linspace(HOME, end, 31), DT, 1.0, arm=FR3)


@pytest.mark.parametrize(("joint", "angle", "able"), [(5, 4.0, "fr3"), (0, 2.8, "panda"), (6, 2.95, "fr3")])
def test_inverse_kinematics_keep_the_limits_of_the_arm(joint, angle, able):
    q = np.array([0.0, -0.6, 0.0, -2.4, 0.3, 2.2, 0.7])
    q[joint] = angle
    for name, arm in ARMS.items():
        solutions, valid = inverse_kinematics(gripper_pose(q), jnp.float32(q[6]), arm)
        found = (np.abs(np.asarray(solutions) - q).max(axis=1) < 1e-2) & np.asarray(valid)
        assert found.any() == (name == able)


def test_the_model_is_a_key_of_the_configuration(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(f"[arm]\nmodel = 'fr3'\nhome = {FR3_ALONE.tolist()}\n")
    cell = load_settings(file).workcell
    assert cell.arm.arm == cell.gripper.arm == FR3
    options = Method(workcell=cell).options()
    assert options["workcell.arm.model"] == "fr3"
    assert Method.of_options(options).workcell == cell
    assert not any(key.startswith("workcell") for key in Method(workcell=Workcell()).options())
    for text, message in (
        ("[arm]\nmodel = 'ur5'\n", r"mine.toml:2: \[arm\] model must be one of"),
        (f"[arm]\nhome = {FR3_ALONE.tolist()}\n", r"mine.toml:2: \[arm\] home: joint 6 at 3.9000 rad .* on the panda"),
        ("[gripper]\narm = 'fr3'\n", r"mine.toml:2: \[gripper\] arm is unknown; .* model in \[arm\]"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=message):
            load_settings(file)


def test_a_workcell_has_one_arm():
    cell = Workcell(arm=ArmConfig(model="fr3", place=tuple(FR3_ALONE)))
    assert cell.gripper == Gripper(arm=FR3)
    assert TrajectoryConfig(place=cell.arm.place).place == cell.arm.place
    assert Workcell().with_arm("fr3").with_arm("panda") == Workcell()
    with pytest.raises(InputError, match="ArmConfig: place: joint 6"):
        cell.with_arm("panda")
    with pytest.raises(InputError, match=r"the gripper is on the fr3, but arm\.model says panda"):
        Workcell(gripper=Gripper(arm=FR3))
    with pytest.raises(InputError, match="model 'fr4' is unknown; did you mean fr3"):
        ArmConfig(model="fr4")
    # Searches are saved with a digest of this text.
    assert repr(cell) != repr(Workcell(arm=dataclasses.replace(cell.arm, model="fr3", place=()))).replace(
        "fr3", "panda"
    )
    assert "arm=Arm(" not in repr(Workcell())
    assert "arm=Arm(name='fr3'" in repr(cell)
