"""Trajectories from the present joints through an action and home: what they hold, and the files made of them."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mechsearch_jax.actions import Action
from mechsearch_jax.actions.kinds.retrieve import retrieve_action
from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.simulators.simulator import ARM, LAG, ROBOT
from mechsearch_jax.envs.world.model import compile_model, initial_state
from mechsearch_jax.envs.world.world import BODIES, from_scenario, true_superquadrics
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.geometry.transforms import make
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.doubt import DoubtConfig, recognition_doubt
from mechsearch_jax.robot.arm_clearance import HAND_FRAME, tip_positions
from mechsearch_jax.robot.free_motion import FreeMotionConfig
from mechsearch_jax.robot.grasp_frames import gripper_rotation
from mechsearch_jax.robot.gripper import Gripper, gripper_cloud
from mechsearch_jax.robot.hand import HandConfig
from mechsearch_jax.robot.kinematics import FINGER_TIPS, HOME, forward_kinematics
from mechsearch_jax.robot.motion import MotionConfig
from mechsearch_jax.robot.robot_trajectory import Part
from mechsearch_jax.robot.trajectory_files import csv_header, save_csv, save_ros
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.step import touches
from mechsearch_jax.session.whole_trajectory import TrajectoryConfig, whole_trajectory
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

SETTING = types.SimpleNamespace(camera=Camera(), shelf=Shelf(), gripper=Gripper(), target=Target())
CONFIG = TrajectoryConfig(motion=MotionConfig(waypoints=7))
PLACE = (0.6, 0.1)
HERE = np.array(HOME, float)
Q7 = jnp.float32(np.radians(30.0))


def seen(objects=None, visible=True):
    return Observation(objects or empty(8), jnp.array(visible), jnp.float32([*PLACE, 0.0]))


def grasp(height=0.05):
    return make(gripper_rotation(jnp.float32(0.1), jnp.float32(0.436)), jnp.float32([*PLACE, Shelf().board + height]))


@functools.cache
def taken(speed=1.0):
    return whole_trajectory(
        SETTING, seen(), retrieve_action(grasp(), Q7, jnp.float32(0.08)), width=0.0, speed=speed, config=CONFIG
    )


def pushed(**options):
    action = Action(
        kind=jnp.int32(1),
        object=jnp.int32(0),
        T_world_gripper=grasp(0.08),
        displacement=jnp.float32([0.0, -0.05, 0.0]),
        T_world_place=grasp(0.08),
        q7=Q7,
        opening=jnp.float32(0.0),
    )
    return whole_trajectory(SETTING, options.pop("observation", seen(visible=False)), action, config=CONFIG, **options)


def test_it_leads_from_home_through_the_action_and_home():
    trajectory = taken()
    assert trajectory.action == "retrieve"
    for row in (0, -1):
        np.testing.assert_allclose(trajectory.position[row], HERE, atol=1e-9)
        np.testing.assert_allclose(trajectory.velocity[row], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.diff(trajectory.time), 0.004)
    assert (np.diff(trajectory.part) >= 0).all()
    assert set(trajectory.part) == set(Part) - {Part.PLACE}
    tips = tip_positions(trajectory.position)
    assert np.linalg.norm(tips - (*PLACE, Shelf().board + 0.05), axis=1).min() < 2e-3
    assert tips[trajectory.part != Part.ACTION, 0].max() < Gripper().nearest_outside + 2e-3
    report = trajectory.report()
    assert report.within()
    assert report.ends_at_home
    assert report.clearance > 0.005
    assert f"{report.duration:.1f} s" in str(report)


def test_positions_velocities_and_accelerations_are_of_one_curve():
    trajectory = taken()
    step = trajectory.time[1]
    middle = (trajectory.velocity[1:] + trajectory.velocity[:-1]) / 2
    np.testing.assert_allclose(np.diff(trajectory.position, axis=0) / step, middle, atol=2e-3)
    middle = (trajectory.acceleration[1:] + trajectory.acceleration[:-1]) / 2
    np.testing.assert_allclose(np.diff(trajectory.velocity, axis=0) / step, middle, atol=5e-2)


def test_the_fingers_open_on_the_way_grip_and_hold_on():
    trajectory = taken()
    width, force, part = trajectory.width, trajectory.force, trajectory.part
    assert width[0] == 0.0
    assert np.abs(np.diff(width)).max() / 0.004 < 0.1001
    assert width[part == Part.WAY_THERE][-1] == pytest.approx(0.08, abs=1e-6)
    gripping = force > 0.0
    assert np.flatnonzero(np.diff(gripping.astype(int))).size == 1
    assert (force[gripping] == HandConfig().force).all()
    np.testing.assert_allclose(width[part == Part.WAY_HOME], 0.04)
    assert gripping[part == Part.WAY_HOME].all()
    assert not gripping[part == Part.WAY_THERE].any()


def test_what_is_held_goes_home_gently():
    trajectory = taken()
    home = np.abs(trajectory.velocity[trajectory.part == Part.WAY_HOME]).max()
    there = np.abs(trajectory.velocity[trajectory.part == Part.WAY_THERE]).max()
    assert home < 2.175 * MotionConfig().carry_pace
    # The arm waits for the hand there.
    assert there > 0.4


def test_speed_is_a_share_of_the_limits():
    slow, report = taken(0.4), taken(0.4).report()
    assert report.velocity <= 0.4
    assert report.acceleration <= 0.4**2
    # The hand takes its time at any speed.
    assert report.duration > 1.8 * taken().report().duration
    fast = taken()
    for trajectory in (fast, slow):
        grips = np.argmax(trajectory.force > 0.0)
        assert np.linalg.norm(tip_positions(trajectory.position[grips][None])[0] - (*PLACE, 0.4545)) < 3e-3


def test_it_begins_at_the_present_joints_and_ends_at_another_home():
    joints, home = HERE + np.array([0.5, 0.2, 0, 0, 0, 0, 0]), HERE + np.array([-0.4, 0, 0, 0, 0, 0, 0.3])
    trajectory = pushed(joints=joints, home=home, width=0.03)
    np.testing.assert_allclose(trajectory.position[0], joints, atol=1e-9)
    np.testing.assert_allclose(trajectory.position[-1], home, atol=1e-9)
    assert trajectory.width[0] == 0.03
    assert trajectory.width[-1] == 0.0
    assert (trajectory.force == 0.0).all()
    assert trajectory.report().within()


def test_where_home_is_not_free_with_the_target_it_stops_outside():
    near = np.array(taken().position[taken().part == Part.WAY_HOME][0])
    deep = taken().position[np.argmax(tip_positions(taken().position)[:, 0] > 0.40)]
    action = retrieve_action(grasp(), Q7, jnp.float32(0.08))
    trajectory = whole_trajectory(SETTING, seen(), action, joints=near, home=deep, config=CONFIG)
    assert not trajectory.ends_at_home
    assert (trajectory.part != Part.WAY_HOME).all()
    assert tip_positions(trajectory.position[-1:])[0, 0] < Gripper().nearest_outside
    assert "stops outside" in str(trajectory.report())


def test_to_do_nothing_is_the_way_home():
    nothing = jax.tree.map(jnp.zeros_like, retrieve_action(grasp(), Q7, jnp.float32(0.08)))
    still = whole_trajectory(SETTING, seen(), nothing, config=CONFIG)
    np.testing.assert_array_equal(still.position, HERE[None])
    assert still.report().within()
    home = whole_trajectory(SETTING, seen(), nothing, joints=HERE + 0.1, config=CONFIG)
    np.testing.assert_allclose(home.position[[0, -1]], [HERE + 0.1, HERE], atol=1e-9)


def blocking():
    """Something in front of the shelf, where the hand goes in."""
    place = tip_positions(taken().position[taken().part == Part.WAY_THERE][-1:])[0]
    scene = empty(8)
    return scene.replace(
        size=scene.size.at[2].set(0.03),
        position=scene.position.at[2].set(jnp.float32(place)),
        valid=scene.valid.at[2].set(True),
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"speed": 0.0}, "speed: 0.0 must be above 0"),
        ({"speed": 1.5}, "at most 1"),
        ({"width": 0.2}, "width: 0.2 m"),
        ({"home": HERE + 9.0}, "home: joint 1"),
        ({"joints": HERE[:6]}, "joints: .* seven"),
    ],
)
def test_impossible_arguments_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        pushed(**options)


def test_a_blocked_way_is_refused_in_one_line():
    with pytest.raises(InputError, match="the way to the push: free motion: where it ends the arm touches"):
        pushed(observation=seen(blocking()))


def test_an_action_out_of_reach_is_refused():
    far = grasp().at[0, 3].add(0.5)
    with pytest.raises(InputError, match="retrieve: the arm does not reach"):
        whole_trajectory(SETTING, seen(), retrieve_action(far, Q7, jnp.float32(0.08)), config=CONFIG)


HELD, STAND = np.array([0.02, 0.025, 0.06]), (0.58, -0.12)


def placed(beside, sure=1.0, height=0.06, of=STAND, keep=0.01):
    """A pick-and-place of object 0, with object 1 so far to the right of its new place, or its old one [m], of which it
    is so sure."""
    scene = empty(8)
    for i, (place, half) in enumerate(
        (((*PLACE, HELD[2]), HELD), ((of[0], of[1] - beside, height), [0.02, 0.02, height]))
    ):
        scene = scene.replace(
            size=scene.size.at[i].set(jnp.float32(half)),
            exponents=scene.exponents.at[i].set(0.1),
            position=scene.position.at[i].set(jnp.float32(place) + jnp.float32([0.0, 0.0, Shelf().board])),
            valid=scene.valid.at[i].set(True),
        )
    confidence = jnp.ones(8).at[1].set(sure)
    action = Action(
        kind=jnp.int32(2),
        object=jnp.int32(0),
        T_world_gripper=grasp(),
        displacement=jnp.zeros(3),
        T_world_place=grasp().at[:2, 3].set(jnp.float32(STAND)),
        q7=Q7,
        opening=jnp.float32(0.08),
    )
    observation = dataclasses.replace(seen(scene, visible=False), confidence=confidence)
    return whole_trajectory(SETTING, observation, action, config=dataclasses.replace(CONFIG, beside=keep))


def release(trajectory):
    """Pose of the gripper as it lets go."""
    row = np.flatnonzero((trajectory.force[:-1] > 0.0) & (trajectory.force[1:] == 0.0))[0]
    T = np.array(forward_kinematics(jnp.float32(trajectory.position[row]))[HAND_FRAME], float)
    T[:3, 3] += FINGER_TIPS * T[:3, 2]
    return T


def test_an_object_is_put_down_clear_of_what_stands_beside():
    """Measured at the release with points on the surface of the open hand and the box, against a box along the axes."""
    T = np.array(grasp().at[:2, 3].set(jnp.float32(STAND)), float)
    hand = gripper_cloud(Gripper(), 0.08, float(Q7), 20000) @ T[:3, :3].T + T[:3, 3]
    box = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * HELD + (*STAND, Shelf().board + HELD[2])

    def gap(beside, height=0.06):
        past = np.abs(np.concatenate([hand, box]) - (STAND[0], STAND[1] - beside, Shelf().board + height))
        return np.linalg.norm(np.maximum(past - (0.02, 0.02, height), 0.0), axis=1).min()

    free = np.array([beside for beside in np.arange(0.07, 0.15, 0.0005) if gap(beside) > 0.01]).min()
    placed(free + 0.005)
    with pytest.raises(InputError, match=r"where it puts object 0 down, .* mm from object 1, not 10 mm or more"):
        placed(free - 0.002)
    with pytest.raises(InputError, match="not 25 mm or more; decide anew"):
        placed(free + 0.005, sure=0.4)
    placed(free + 0.02, sure=0.4)


def test_where_it_may_it_comes_so_far_into_what_it_does_not_move():
    def least(keep):
        """The least distance of object 1's middle at which it is made, and what is made there, by bisection [m]."""
        low, high, made = 0.06, 0.15, None
        while made is None or high - low > 2e-4:
            middle = (low + high) / 2
            try:
                made, high = placed(middle, keep=keep), middle
            except InputError:
                low = middle
        return high, made

    (clear, _), (into, made) = least(0.0), least(-0.003)
    assert 0.0015 < clear - into < 0.0045
    distance = {each.body: each.distance for each in made.nearest}["object 1"]
    assert -0.003 <= distance < 0.0
    (warning,) = touches(made, seen())
    assert f"may touch object 1 ({-1000 * distance:.0f} mm into it)" in warning


def test_on_its_way_the_hand_passes_at_half_of_that():
    """Measured at the grasp, as above; the way in is straight, and the open hand nowhere nearer."""
    T = np.array(grasp(), float)
    hand = gripper_cloud(Gripper(), 0.08, float(Q7), 20000) @ T[:3, :3].T + T[:3, 3]

    def gap(beside, tall=0.09):
        past = np.abs(hand - (PLACE[0], PLACE[1] + beside, Shelf().board + tall)) - (0.02, 0.02, tall)
        return np.linalg.norm(np.maximum(past, 0.0), axis=1).min()

    free = np.array([beside for beside in np.arange(0.07, 0.2, 0.0005) if gap(beside) > 0.005]).min()
    near = placed(-free - 0.004, height=0.09, of=PLACE)
    with pytest.raises(
        InputError, match=r"on its way the hand or what it holds would be \d+ mm from object 1, not 5 mm"
    ):
        placed(0.002 - free, height=0.09, of=PLACE)
    with pytest.raises(InputError, match="not 12 mm or more; decide anew"):
        placed(-free - 0.004, sure=0.4, height=0.09, of=PLACE)
    # What comes near is said: the nearer, the surer one has to be.
    sure = dataclasses.replace(seen(), confidence=jnp.full(8, 0.99))
    assert touches(near, sure) == ()
    (warning,) = touches(near, dataclasses.replace(seen(), confidence=jnp.full(8, 0.4)))
    distance = {each.body: each.distance for each in near.nearest}["object 1"]
    assert warning == f"the hand, or what it holds, may touch object 1 ({1000 * distance:.0f} mm beside it)"


def test_an_object_that_turns_between_the_fingers_does_not_meet_the_board():
    T = release(placed(0.3))
    corners = HELD * np.stack(np.meshgrid(*3 * [[-1, 1]]), axis=-1).reshape(-1, 3)
    stands = np.array(make(jnp.eye(3), jnp.float32([*PLACE, Shelf().board + HELD[2]])), float)
    held = np.linalg.inv(np.array(grasp(), float)) @ stands
    for turn in np.radians([-5, 5]):
        about = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
        points = (corners @ held[:3, :3].T + held[:3, 3]) @ about.T @ T[:3, :3].T + T[:3, 3]
        assert 0.0 < points[:, 2].min() - Shelf().board < 0.01


def test_a_target_that_turned_between_the_fingers_does_not_meet_its_stand():
    place, target = (0.35, -0.35, 0.2), SETTING.target
    config = dataclasses.replace(CONFIG, place=place)
    trajectory = whole_trajectory(
        SETTING, seen(), retrieve_action(grasp(), Q7, jnp.float32(0.08)), width=0.0, config=config
    )
    assert trajectory.place_fault == ""
    T, half = release(trajectory), np.array(target.half_size)
    corners = half * np.stack(np.meshgrid(*3 * [[-1, 1]]), axis=-1).reshape(-1, 3)
    stands = np.array(make(jnp.eye(3), jnp.float32([*PLACE, Shelf().board + half[2]])), float)
    held = np.linalg.inv(np.array(grasp(), float)) @ stands
    for turn in np.radians([-5, 5]):
        about = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
        points = (corners @ held[:3, :3].T + held[:3, 3]) @ about.T @ T[:3, :3].T + T[:3, 3]
        assert 0.0 < points[:, 2].min() - place[2] < 0.012


@functools.cache
def pictured():
    """A scene, what a perfect recogniser sees of it, and its depth image."""
    world = from_scenario(load_scenario(example_scenarios()["first-light"]))
    depth = np.asarray(observe(Camera(), world, Shelf()).depth)
    return Observation(true_superquadrics(world), jnp.array(False), jnp.zeros(3)), depth


def test_what_was_recognised_well_leaves_no_doubt():
    observation, depth = pictured()
    doubt = recognition_doubt(SETTING, observation, depth)
    assert doubt.unexplained < 0.05
    assert doubt.passed < 0.02
    assert doubt.reason(DoubtConfig()) is None


def moved_object(objects):
    first = int(np.argmax(objects.valid))
    return objects.replace(position=objects.position.at[first, 1].add(0.08))


@pytest.mark.parametrize(
    ("spoil", "depth_of", "message"),
    [
        (moved_object, lambda d: d, "of the rays that reach object|is on no recognised object"),
        (lambda o: o.replace(valid=jnp.zeros_like(o.valid)), lambda d: d, "100 % of what stands on the board"),
        (lambda o: o, lambda d: np.where(np.arange(d.shape[1]) % 3 > 0, 0.0, d), "6. % .* are not measured"),
    ],
)
def test_what_does_not_explain_the_image_is_refused(spoil, depth_of, message):
    observation, depth = pictured()
    wrong = observation.replace(objects=spoil(observation.objects))
    with pytest.raises(InputError, match=f"recognition is too doubtful to move: .*(?:{message})") as error:
        pushed(observation=wrong, depth=depth_of(depth))
    assert "\n" not in str(error.value)


def test_a_depth_image_of_another_size_is_refused():
    with pytest.raises(InputError, match="depth image: its shape"):
        pushed(depth=np.ones((4, 5)))


def test_a_csv_file_holds_it(tmp_path):
    trajectory, path = taken(), tmp_path / "out" / "t.csv"
    save_csv(trajectory, path)
    lines = path.read_text().splitlines()
    assert lines[0].split(",") == csv_header()
    assert [name.split()[0] for name in csv_header()] == [
        "time", *(f"q{i}" for i in range(1, 8)), *(f"v{i}" for i in range(1, 8)), "width", "force",
    ]  # fmt: skip
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    assert table.shape == (len(trajectory.time), 17)
    np.testing.assert_allclose(table[:, 0], trajectory.time, atol=1e-9)
    np.testing.assert_allclose(table[:, 1:8], trajectory.position, atol=1e-8)
    np.testing.assert_allclose(table[:, 8:15], trajectory.velocity, atol=1e-8)
    np.testing.assert_allclose(table[:, 15:], np.stack([trajectory.width, trajectory.force], axis=1), atol=1e-8)


@pytest.mark.parametrize("save", [save_csv, save_ros])
def test_files_are_not_overwritten_silently(tmp_path, save):
    path = tmp_path / "t"
    path.write_text("mine")
    with pytest.raises(InputError, match="is there already"):
        save(taken(), path)
    assert path.read_text() == "mine"
    save(taken(), path, overwrite=True)
    assert len(path.read_text()) > 1000
    assert list(tmp_path.iterdir()) == [path]


def tip_error(model, trajectory):
    """Largest distance of a simulated arm's tip from the commanded one in free motion [m]."""
    free = trajectory.part[1:] != Part.ACTION
    data, fingers = initial_state(model, [None] * BODIES), trajectory.width[:, None] / 2
    # The integrator applies the stiffness at the positions before a step: with commands for the positions after it,
    # as in `simulator.controls`, the arm is one time step ahead, 4 mm at full speed.
    arm = trajectory.position[:-1] + LAG * np.diff(trajectory.position, axis=0) / trajectory.time[1]
    data.qpos[:ARM], data.qpos[ARM:ROBOT] = trajectory.position[0], fingers[0]
    followed = np.empty_like(arm)
    for i, data.ctrl[:] in enumerate(np.concatenate([arm, fingers[1:], fingers[1:]], axis=1)):
        mujoco.mj_step(model, data)
        followed[i] = data.qpos[:ARM]
    apart = tip_positions(followed[free]) - tip_positions(trajectory.position[1:][free])
    return np.linalg.norm(apart, axis=1).max()


@pytest.mark.slow
def test_a_simulated_arm_follows_random_actions():
    model, rng = compile_model(SETTING.shelf, SETTING.camera, 0.004), np.random.default_rng(0)
    config = dataclasses.replace(CONFIG, free=FreeMotionConfig(attempts=200))
    made = 0
    while made < 12:
        x, y, z = rng.uniform(0.5, 0.7), rng.uniform(-0.15, 0.35), rng.uniform(0.04, 0.12)
        rotation = gripper_rotation(jnp.float32(rng.uniform(-0.4, 0.4)), jnp.float32(0.4))
        action = retrieve_action(make(rotation, jnp.float32([x, y, Shelf().board + z])), Q7, jnp.float32(0.08))
        try:
            trajectory = whole_trajectory(SETTING, seen(visible=False), action, config=config)
        except InputError:
            continue
        made += 1
        assert trajectory.report().within()
        assert tip_error(model, trajectory) < 2e-3
