"""Trajectories as ROS 2 messages: their fields, and the legs in which arm and hand take turns."""

import itertools
import json

import numpy as np
import pytest
from test_robot_hand import BESIDE, retrieved
from test_search_whole_trajectory import pushed, taken

from mechsearch_jax.robot.arm_clearance import tip_positions
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.hand import HandGrasp, HandMove
from mechsearch_jax.robot.ros_messages import (
    gripper_command_goal,
    hand_goal,
    joint_trajectory_message,
    legs,
    ros_messages,
)
from mechsearch_jax.robot.trajectory_files import save_ros
from mechsearch_jax.runtime.errors import InputError


def seconds(point):
    return point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"]


def test_the_arms_message_has_the_fields_of_a_joint_trajectory(tmp_path):
    trajectory, path = taken(), tmp_path / "t.json"
    save_ros(trajectory, path)
    message = json.loads(path.read_text())
    assert message == ros_messages(trajectory)
    arm = message["arm"]
    assert set(arm) == {"header", "joint_names", "points"}
    assert arm["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    assert arm["joint_names"] == [f"panda_joint{i}" for i in range(1, 8)]
    fields = {"positions", "velocities", "accelerations", "effort", "time_from_start"}
    sequences = joint_trajectory_message(trajectory)["points"][0]
    assert {
        name: np.asarray(value).dtype for name, value in sequences.items() if name in fields - {"time_from_start"}
    } == (dict.fromkeys(fields - {"time_from_start"}, np.dtype(np.float64)))
    for point in arm["points"]:
        assert set(point) == fields
        assert set(point["time_from_start"]) == {"sec", "nanosec"}
        assert type(point["time_from_start"]["sec"]) is type(point["time_from_start"]["nanosec"]) is int
        assert 0 <= point["time_from_start"]["nanosec"] < 10**9
    np.testing.assert_allclose([seconds(p) for p in arm["points"]], trajectory.time, atol=1e-9)
    for key, name in (("positions", "position"), ("velocities", "velocity"), ("accelerations", "acceleration")):
        np.testing.assert_allclose([p[key] for p in arm["points"]], getattr(trajectory, name))


def test_other_robots_have_other_names():
    names = [f"left_fr3_joint{i}" for i in range(1, 8)]
    assert joint_trajectory_message(taken(), names)["joint_names"] == names
    with pytest.raises(InputError, match="7 different names"):
        ros_messages(taken(), joint_names=["a"] * 7)


def test_the_hands_goals_have_the_fields_of_franka_and_of_a_gripper_command():
    move = HandMove(0.0, 1.0, False, 0.08, 0.1)
    grasp = HandGrasp(2.0, 1.0, True, 0.04, 0.1, 60.0, 0.01, 0.02)
    assert hand_goal(move) == {"width": 0.08, "speed": 0.1}
    assert hand_goal(grasp) == {
        "width": 0.04,
        "speed": 0.1,
        "force": 60.0,
        "epsilon": {"inner": 0.01, "outer": 0.02},
    }
    assert gripper_command_goal(move) == {"command": {"position": 0.04, "max_effort": 20.0}}
    assert gripper_command_goal(move, effort=5.0, widest=0.079) == {"command": {"position": 0.0395, "max_effort": 5.0}}
    assert gripper_command_goal(grasp, widest=0.079) == gripper_command_goal(grasp)
    assert gripper_command_goal(grasp, 1.0) == {"command": {"position": 0.04, "max_effort": 60.0}}


def test_goals_hold_floats_alone():
    width, whole = np.float32(0.04), 1
    for event in (HandMove(0.0, 1.0, False, width, whole), HandGrasp(0.0, 1.0, True, width, whole, 60, width, whole)):
        goal = hand_goal(event)
        numbers = [*goal.pop("epsilon", {}).values(), *goal.values(), *gripper_command_goal(event)["command"].values()]
        assert {type(number) for number in numbers} == {float}


def test_events_are_listed_beside_the_arm():
    trajectory = retrieved(BESIDE)
    message = ros_messages(trajectory)
    types = [event["type"].rpartition("/")[2] for event in message["gripper"]]
    assert types == ["Move", "Grasp", "Move"]
    assert [event["waits"] for event in message["gripper"]] == [False, True, True]
    for written, event in zip(message["gripper"], trajectory.events, strict=True):
        assert (written["start"], written["duration"]) == (event.start, event.duration)
        assert written["goal"]["width"] == event.width
    json.dumps(message, allow_nan=False)


@pytest.mark.parametrize("make", [taken, pushed, lambda: retrieved(BESIDE)])
def test_legs_are_from_rest_to_rest_and_leave_nothing_out(make):
    trajectory = make()
    pieces = legs(trajectory)
    assert [leg.event for leg in pieces if leg.event] == list(trajectory.events)
    assert pieces[0].first == 0
    assert pieces[-1].last == len(trajectory.time) - 1
    # The hand has ended before the arm enters the shelf.
    entered = tip_positions(trajectory.position)[:, 0] > Gripper().nearest_outside + 2e-3
    assert not entered[: pieces[0].last + 1].any()
    assert entered[pieces[1].first : pieces[1].last + 1].any()
    written = ros_messages(trajectory)
    for leg, named in zip(pieces, written["legs"], strict=True):
        if leg.event is not None and leg.event.waits:
            assert leg.first == leg.last
        message = joint_trajectory_message(trajectory, first=leg.first, last=leg.last)
        assert seconds(message["points"][0]) == 0.0
        # Exactly: ROS 2's controller refuses 1e-6 rad/s at the end of a goal.
        ends = [message["points"][0], message["points"][-1]]
        for point in (*ends, *(written["arm"]["points"][named[end]] for end in ("first", "last"))):
            np.testing.assert_array_equal(point["velocities"], 0.0)
            np.testing.assert_array_equal(point["accelerations"], 0.0)
    for before, after in itertools.pairwise(pieces):
        np.testing.assert_array_equal(trajectory.position[before.last], trajectory.position[after.first])
    moving = sum(leg.last - leg.first for leg in pieces)
    waiting = sum(round(e.duration / 0.004) for e in trajectory.events if e.waits)
    assert moving + waiting == len(trajectory.time) - 1
