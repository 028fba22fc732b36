"""The ROS 2 example, with stand-ins for ROS that have the real messages' fields and refuse any other."""

import dataclasses
import importlib.util
import runpy
import sys
import time
import types
import unittest.mock
from pathlib import Path

import numpy as np
import pytest
from test_search_whole_trajectory import pushed, taken

from mechsearch_jax.images.lens import Lens
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera

NODE = Path(__file__).parents[1] / "examples" / "ros2" / "search_node.py"
ROS = ("rclpy", "action_msgs", "control_msgs", "franka_msgs", "sensor_msgs", "trajectory_msgs")
JOINTS = [f"fr3_joint{i}" for i in range(1, 8)]
HERE = [0.1 * i for i in range(7)]


def message(type_name, /, **fields):
    """A type with these fields, given by what makes their first values; others cannot be set, nor other types."""

    def start(self, **given):
        for field, make in fields.items():
            setattr(self, field, given.get(field, make()))

    def put(self, field, value):
        expected = type(fields[field]()) if field in fields else object
        assert isinstance(value, expected), f"{type_name}.{field} is of type {expected}, not {type(value)}"
        object.__setattr__(self, field, value)

    return type(type_name, (), {"__slots__": tuple(fields), "__init__": start, "__setattr__": put})


TIME = message("Time", sec=int, nanosec=int)
HEADER = message("Header", stamp=TIME, frame_id=str)
POINT = message(
    "JointTrajectoryPoint",
    positions=list,
    velocities=list,
    accelerations=list,
    effort=list,
    time_from_start=TIME,
)
PATH = message("JointTrajectory", header=HEADER, joint_names=list, points=list)
TOLERANCE = message("JointTolerance", name=str, position=float, velocity=float, acceleration=float)
IMAGE = message("Image", header=HEADER, height=int, width=int, encoding=str, is_bigendian=int, step=int, data=bytes)
INFO = message("CameraInfo", header=HEADER, height=int, width=int, distortion_model=str, d=list, k=list, r=list, p=list)
STATE = message("JointState", header=HEADER, name=list, position=list, velocity=list, effort=list)
EPSILON = message("GraspEpsilon", inner=float, outer=float)


def action(name, goal, result):
    return type(name, (), {"Goal": message("Goal", **goal), "Result": type("Result", (), {"SUCCESSFUL": 0, **result})})


FOLLOW = action(
    "FollowJointTrajectory",
    {
        "trajectory": PATH,
        "path_tolerance": list,
        "goal_tolerance": list,
        "goal_time_tolerance": TIME,
    },
    {"error_code": 0, "error_string": ""},
)
COMMAND = action(
    "GripperCommand",
    {"command": message("GripperCommand", position=float, max_effort=float)},
    {"reached_goal": True, "stalled": False},
)
MOVE = action("Move", {"width": float, "speed": float}, {"success": True})
GRASP = action("Grasp", {"width": float, "epsilon": EPSILON, "speed": float, "force": float}, {"success": True})


# Results of goals: none ever, or somebody presses Ctrl-C meanwhile.
NEVER, INTERRUPTED = object(), object()


class Future:
    """What arrives at once, or when `arrive` is called."""

    def __init__(self, value):
        self.value, self.calls = value, []

    def add_done_callback(self, call):
        if self.value is INTERRUPTED:
            raise KeyboardInterrupt
        if self.value is NEVER:
            self.calls.append(call)
        else:
            call(self)

    def arrive(self, value):
        self.value = value
        for call in self.calls:
            call(self)

    def result(self):
        return self.value


class StandIn:
    """What the node gets from ROS, and what it does with it.

    Attributes:
      goals: in the order in which they were sent, with the name of their action.
      answers: results of actions by the last part of their names; a success if there is none, a refusal if None.
      statuses: of the goals, in the same way; 4, succeeded, if there is none.
      late: futures of the goals' handles by action, which arrive when the test says so.
      cancelled: names of the actions whose goals were cancelled, and what else is done at the end.
    """

    def __init__(self, **parameters):
        self.parameters, self.goals, self.answers, self.callbacks = parameters, [], {}, {}
        self.statuses, self.late, self.cancelled = {}, {}, []

    def modules(self):
        stand_in = self

        class Node:
            def __init__(self, name):
                self.log = []

            def declare_parameter(self, name, usual):
                return types.SimpleNamespace(value=stand_in.parameters.get(name, usual))

            def create_subscription(self, kind, topic, call, qos):
                stand_in.callbacks[topic] = kind, call

            def get_logger(self):
                return types.SimpleNamespace(**dict.fromkeys(("info", "warning", "error"), self.log.append))

            def get_clock(self):
                return types.SimpleNamespace(now=lambda: types.SimpleNamespace(nanoseconds=5 * 10**9))

        class Client:
            def __init__(self, node, kind, name):
                self.kind, self.name = kind, name

            def wait_for_server(self, timeout_sec):
                return True

            def send_goal_async(self, goal):
                assert type(goal) is self.kind.Goal
                stand_in.goals.append((self.name, goal))
                name = self.name.rpartition("/")[2]
                result = stand_in.answers.get(name, self.kind.Result)
                answer = types.SimpleNamespace(result=result, status=stand_in.statuses.get(name, 4))

                def cancel():
                    stand_in.cancelled.append(name)
                    return Future("cancelling")

                handle = types.SimpleNamespace(
                    accepted=result is not None,
                    get_result_async=lambda: Future(result if result in (NEVER, INTERRUPTED) else answer),
                    cancel_goal_async=cancel,
                )
                if name in stand_in.late:
                    stand_in.late[name] = Future(NEVER), handle
                    return stand_in.late[name][0]
                return Future(handle)

        held = {
            "action_msgs": {},
            "action_msgs.msg": {"GoalStatus": types.SimpleNamespace(STATUS_SUCCEEDED=4)},
            "rclpy": {"init": self.init, "shutdown": lambda: self.cancelled.append("shutdown")},
            "rclpy.action": {"ActionClient": Client},
            "rclpy.executors": {"MultiThreadedExecutor": unittest.mock.Mock},
            "rclpy.node": {"Node": Node},
            "rclpy.qos": {"qos_profile_sensor_data": None},
            "rclpy.signals": {"SignalHandlerOptions": types.SimpleNamespace(NO="no")},
            "control_msgs": {},
            "control_msgs.action": {"FollowJointTrajectory": FOLLOW, "GripperCommand": COMMAND},
            "control_msgs.msg": {"JointTolerance": TOLERANCE},
            "franka_msgs": {},
            "franka_msgs.action": {"Move": MOVE, "Grasp": GRASP},
            "sensor_msgs": {},
            "sensor_msgs.msg": {"CameraInfo": INFO, "Image": IMAGE, "JointState": STATE},
            "trajectory_msgs": {},
            "trajectory_msgs.msg": {"JointTrajectory": PATH, "JointTrajectoryPoint": POINT},
        }
        for name, values in held.items():
            module = types.ModuleType(name)
            vars(module).update(values)
            yield name, module

    def init(self, signal_handler_options):
        # Else Ctrl-C ends the connection, and nothing can be cancelled.
        assert signal_handler_options == "no"

    def publish(self, topic, message):
        kind, call = self.callbacks[topic]
        assert type(message) is kind
        call(message)


@pytest.fixture
def start(monkeypatch):
    """A node of the example, and its stand-in."""

    def started(**parameters):
        stand_in = StandIn(**{"robot": "fr3", "frames": 1, **parameters})
        for name, module in stand_in.modules():
            monkeypatch.setitem(sys.modules, name, module)
        spec = importlib.util.spec_from_file_location("search_node", NODE)
        example = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(example)
        for name, seconds in (("PATIENCE", 0.05), ("CANCELLING", 0.05), ("SPARE", -10.0), ("STALE", 60.0)):
            monkeypatch.setattr(example, name, seconds)
        return example, example.SearchNode(), stand_in

    return started


def image(pixels, encoding, seconds=10, padding=0, big=False):
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))).view(np.uint8)
    rows = np.pad(rows.reshape(height, -1), ((0, 0), (0, padding)))
    header = HEADER(stamp=TIME(sec=seconds))
    return IMAGE(
        header=header,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=int(big),
        step=rows.shape[1],
        data=rows.tobytes(),
    )


def published(stand_in, seconds=10, width=0.03):
    depth = image(np.full((3, 4), 1500, np.uint16), "16UC1", seconds)
    stand_in.publish("/camera/camera/aligned_depth_to_color/image_raw", depth)
    stand_in.publish("/camera/camera/color/image_raw", image(np.full((3, 4, 3), 7, np.uint8), "rgb8", seconds))
    info = INFO(width=4, height=3, k=[4.0, 0.0, 1.5, 0.0, 4.0, 1.0, 0.0, 0.0, 1.0])
    stand_in.publish("/camera/camera/color/camera_info", info)
    stand_in.publish("/joint_states", STATE(name=JOINTS, position=HERE))
    fingers = [f"fr3_finger_joint{i}" for i in (1, 2)]
    stand_in.publish("/joint_states", STATE(name=fingers, position=[width / 2] * 2))


def test_images_of_any_layout_are_read(start):
    example, _, _ = start()
    depth = np.arange(12, dtype=np.uint16).reshape(3, 4) * 300
    for big in (False, True):
        read = example.depth_of(image(depth, "16UC1", padding=6, big=big))
        assert read.dtype == np.float32
        np.testing.assert_allclose(read, depth * 0.001, rtol=1e-6)
        metres = example.depth_of(image(depth.astype(np.float32), "32FC1", big=big))
        np.testing.assert_array_equal(metres, depth)
    colour = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    np.testing.assert_array_equal(example.colour_of(image(colour, "rgb8", padding=4)), colour)
    np.testing.assert_array_equal(example.colour_of(image(colour[..., ::-1], "bgr8")), colour)
    with_alpha = np.concatenate([colour, colour[..., :1]], axis=-1)
    np.testing.assert_array_equal(example.colour_of(image(with_alpha, "rgba8")), colour)
    with pytest.raises(ValueError, match="encoding yuv422"):
        example.colour_of(image(colour, "yuv422"))


def test_the_camera_has_its_own_intrinsics_and_the_configured_pose(start):
    example, _, _ = start()
    info = INFO(width=848, height=480, d=[0.0] * 5, k=[424.0, 0.0, 423.5, 0.0, 425.0, 239.5, 0.0, 0.0, 1.0])
    usual = Camera()
    camera = example.lens_of(info, usual).camera
    assert camera == dataclasses.replace(usual, width=848, height=480, fx=424.0, fy=425.0, cx=424.0, cy=240.0)
    info.d, info.distortion_model = [0.1, 0.0, 0.0, 0.0, 0.0], "plumb_bob"
    assert example.lens_of(info, usual) == Lens(camera, (0.1, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="p holds no focal lengths"):
        example.lens_of(INFO(p=[0.0] * 12), usual, rectified=True)
    info.p = [400.0, 0.0, 400.5, 0.0, 0.0, 401.0, 220.5, 0.0, 0.0, 0.0, 1.0, 0.0]
    camera = example.lens_of(info, usual, rectified=True).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (400.0, 401.0, 401.0, 221.0)


def test_old_images_and_missing_ones_are_not_taken(start):
    _, node, stand_in = start()
    with pytest.raises(TimeoutError, match="new depth and colour images did not come"):
        node.look(0.0)
    published(stand_in, seconds=4)
    with pytest.raises(TimeoutError, match="are the topics right"):
        node.look(5.0)
    published(stand_in, seconds=6)
    look = node.look(5.0)
    assert {name: image.shape for name, image in look.items()} == {"depth": (3, 4), "colour": (3, 4, 3)}
    assert look["depth"][0, 0] == pytest.approx(1.5)
    assert node.joints == HERE
    assert node.width == pytest.approx(0.03)


def test_joint_states_without_positions_and_stale_ones_are_not_taken(start, monkeypatch):
    example, node, stand_in = start()
    stand_in.publish("/joint_states", STATE(name=JOINTS, velocity=HERE))
    with pytest.raises(TimeoutError, match="joint states of the arm"):
        _ = node.joints
    published(stand_in)
    stand_in.publish("/joint_states", STATE(name=JOINTS, velocity=HERE))
    assert node.joints == HERE
    monkeypatch.setattr(example, "STALE", 0.0)
    time.sleep(0.001)
    with pytest.raises(TimeoutError, match="joint states of the arm"):
        _ = node.joints
    assert node.width is None


def test_the_arm_is_the_nodes_or_the_configurations(start, tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text("[arm]\nmodel = 'fr3'\n")
    for given, joint, model in (
        ({"robot": ""}, "panda_joint1", "panda"),
        ({"robot": "", "config": str(file)}, "fr3_joint1", "fr3"),
        ({"robot": "panda", "config": str(file)}, "panda_joint1", "panda"),
        ({"robot": "left_fr3"}, "left_fr3_joint1", "fr3"),
    ):
        _, node, _ = start(**given)
        assert (node.joint_names[0], node.model) == (joint, model)
    with pytest.raises(ValueError, match="robot: ur5 is none of panda, fr3"):
        start(robot="ur5")


def test_a_motion_is_written_as_a_bag(tmp_path):
    pytest.importorskip("rosbags")
    from rosbags.highlevel import AnyReader

    example = runpy.run_path(str(NODE.with_name("write_bag.py")))
    trajectory = taken()
    example["write_bag"](tmp_path / "bag", trajectory)
    with AnyReader([tmp_path / "bag"]) as reader:
        ((connection, _, data),) = reader.messages()
        read = reader.deserialize(data, connection.msgtype)
    assert connection.msgtype == "trajectory_msgs/msg/JointTrajectory"
    assert read.joint_names == [f"panda_joint{i}" for i in range(1, 8)]
    np.testing.assert_array_equal([point.positions for point in read.points], trajectory.position)
    np.testing.assert_array_equal([point.velocities for point in read.points], trajectory.velocity)
    assert read.points[1].time_from_start.nanosec == 4_000_000


def test_arm_and_hand_take_turns(start):
    _, node, stand_in = start()
    trajectory = taken()
    assert node.follow(trajectory)
    names = [name for name, _ in stand_in.goals]
    arm = "/fr3_arm_controller/follow_joint_trajectory"
    assert names == ["/fr3_gripper/move", arm, arm, "/fr3_gripper/grasp", arm]
    (_, opens), (_, there), (_, enters), (_, closes), (_, out) = stand_in.goals
    assert (opens.width, opens.speed) == (pytest.approx(0.08), 0.1)
    assert (closes.width, closes.force) == (pytest.approx(0.04), 60.0)
    assert (closes.epsilon.inner, closes.epsilon.outer, closes.speed) == (0.01, 0.01, 0.1)
    assert there.trajectory.joint_names == JOINTS
    np.testing.assert_allclose(there.trajectory.points[0].positions, trajectory.position[0])
    np.testing.assert_allclose(enters.trajectory.points[0].positions, there.trajectory.points[-1].positions)
    np.testing.assert_allclose(out.trajectory.points[0].positions, enters.trajectory.points[-1].positions)
    np.testing.assert_allclose(out.trajectory.points[-1].positions, trajectory.position[-1])
    first, second = out.trajectory.points[:2]
    assert (first.time_from_start.sec, first.time_from_start.nanosec) == (0, 0)
    assert second.time_from_start.nanosec == 4_000_000
    assert [t.name for t in there.path_tolerance] == JOINTS
    assert there.path_tolerance[0].position == trajectory.bounds.tracking


def test_a_gripper_of_another_make_is_commanded_by_position(start):
    _, node, stand_in = start(gripper="command", gripper_namespace="/hand")
    stand_in.answers["gripper_action"] = types.SimpleNamespace(reached_goal=False, stalled=True)
    # It did not open, so that the arm stays outside, and goes back.
    assert not node.follow(taken())
    arm = "/fr3_arm_controller/follow_joint_trajectory"
    assert [name for name, _ in stand_in.goals] == ["/hand/gripper_action", arm, arm]
    stand_in.goals.clear()
    stand_in.answers["gripper_action"] = types.SimpleNamespace(reached_goal=True, stalled=False)
    assert node.follow(taken())
    commands = [goal.command for name, goal in stand_in.goals if name == "/hand/gripper_action"]
    assert [(c.position, c.max_effort) for c in commands] == [
        (pytest.approx(0.0395), 20.0),
        (pytest.approx(0.02), 60.0),
    ]
    stand_in.goals.clear()
    assert node.follow(pushed())
    closes = stand_in.goals[0][1].command
    # Franka's server closes by a grasp.
    assert (closes.position, closes.max_effort) == (0.0, 20.0)


@pytest.mark.parametrize("answer", [None, NEVER, types.SimpleNamespace(success=False), "canceled"])
def test_an_arm_whose_hand_does_not_open_goes_back_out_of_sight(start, answer):
    _, node, stand_in = start()
    if answer == "canceled":
        stand_in.statuses["move"] = 5
    else:
        stand_in.answers["move"] = answer
    trajectory = taken()
    assert not node.follow(trajectory)
    assert [name.rpartition("/")[2] for name, _ in stand_in.goals] == ["move", *["follow_joint_trajectory"] * 2]
    there, back = (goal.trajectory.points for _, goal in stand_in.goals[1:])
    np.testing.assert_array_equal([p.positions for p in back], [p.positions for p in there][::-1])
    np.testing.assert_allclose([p.velocities for p in back], -np.array([p.velocities for p in there])[::-1], atol=1e-9)
    assert [p.time_from_start.nanosec for p in back] == [p.time_from_start.nanosec for p in there]
    assert stand_in.cancelled == (["move"] if answer is NEVER else [])


def test_goals_that_were_cancelled_are_not_done(start):
    example, node, stand_in = start()
    # The result of a goal that was cancelled is an empty one, whose error code is that of a success.
    stand_in.statuses["follow_joint_trajectory"] = 5
    with pytest.raises(example.ArmStoppedError, match="error 0, status of the goal 5; take it out by hand"):
        node.follow(taken())
    stand_in.statuses = {"grasp": 5}
    assert not node.follow(taken())


@pytest.mark.parametrize(("answer", "error"), [(NEVER, RuntimeError), (INTERRUPTED, KeyboardInterrupt)])
def test_goals_are_cancelled_when_time_is_up_and_when_somebody_stops_the_node(start, answer, error):
    _, node, stand_in = start()
    stand_in.answers["follow_joint_trajectory"] = answer
    with pytest.raises(error):
        node.follow(taken())
    # The hand's goal is on its way, too.
    assert sorted(stand_in.cancelled) == ["follow_joint_trajectory", "move"]
    node.cancel()
    assert len(stand_in.cancelled) == 2


def test_a_goal_that_is_accepted_too_late_is_cancelled_then(start):
    example, node, stand_in = start()
    stand_in.late["follow_joint_trajectory"] = None
    with pytest.raises(example.ArmStoppedError, match="no answer"):
        node.follow(taken())
    assert stand_in.cancelled == ["move"]
    assert any("stop the robot by hand" in line for line in node.log)
    future, handle = stand_in.late["follow_joint_trajectory"]
    future.arrive(handle)
    assert stand_in.cancelled == ["move", "follow_joint_trajectory"]


def test_the_node_cancels_before_it_shuts_down(start, monkeypatch):
    example, node, stand_in = start(confirm=False)
    stand_in.answers["grasp"] = INTERRUPTED
    trajectory, interrupted = taken(), []

    def search(node, searcher, confirm=lambda step: True):
        node._begin_event(trajectory.events[-1])
        interrupted.append(confirm(None))
        raise KeyboardInterrupt

    info = INFO(k=[400.0, 0.0, 400.5, 0.0, 401.0, 220.5, 0.0, 0.0, 1.0], width=640, height=480)
    monkeypatch.setattr(example, "SearchNode", lambda: node)
    load = unittest.mock.MagicMock()
    monkeypatch.setattr(example, "load_searcher", load)
    monkeypatch.setattr(example, "search", search)
    monkeypatch.setattr(example.signal, "signal", lambda number, handler: None)
    stand_in.publish("/camera/camera/color/camera_info", info)
    with pytest.raises(KeyboardInterrupt):
        example.main()
    assert interrupted == [True]
    assert load.call_args.kwargs["arm"] == "fr3"
    assert stand_in.cancelled == ["grasp", "shutdown"]


def test_after_a_grasp_that_failed_the_arm_goes_its_way_out(start):
    _, node, stand_in = start()
    stand_in.answers["grasp"] = types.SimpleNamespace(success=False)
    assert not node.follow(taken())
    assert len(stand_in.goals) == 5
    assert any("could not grasp to 40 mm" in line for line in node.log)


def test_an_arm_that_stops_ends_it(start):
    example, node, stand_in = start()
    stopped = types.SimpleNamespace(error_code=-4, error_string="path tolerance violated")
    stand_in.answers["follow_joint_trajectory"] = stopped
    with pytest.raises(example.ArmStoppedError, match="path tolerance violated; take it out by hand"):
        node.follow(taken())
    # A goal that is refused has no result.
    stand_in.answers["follow_joint_trajectory"] = None
    with pytest.raises(example.ArmStoppedError, match="no answer"):
        node.follow(pushed())


class Searching:
    """A searcher that hands out motions, None for a refusal, and receives what became of them."""

    moving = False

    def __init__(self, *trajectories):
        self.left, self.outcomes, self.given = list(trajectories), [], []

    @property
    def finished(self):
        return not self.left

    def next(self, depth, colour, joints, width, **mask):
        self.given.append((depth.shape, colour.shape, joints, width, mask))
        if isinstance(self.left[0], Exception):
            raise self.left.pop(0)
        kind = "none" if self.left[0] is None else self.left[0].action
        self.moving = self.left[0] is not None
        trajectory = self.left[0] if self.moving else self.left.pop(0)
        return types.SimpleNamespace(kind=kind, reason="why", warnings=("odd",), trajectory=trajectory)

    def acted(self, ok):
        self.outcomes.append(ok)
        self.left.pop(0)
        self.moving = False

    def save(self, path):
        Path(path).write_text(f"{len(self.left)} {self.moving}")

    def load(self, path):
        left, moving = Path(path).read_text().split()
        self.left, self.moving = self.left[-int(left) :], moving == "True"


def test_a_search_goes_on_until_the_target_is_out(start):
    example, node, stand_in = start()
    published(stand_in)
    searcher = Searching(pushed(), taken())
    assert example.search(node, searcher)
    assert searcher.outcomes == [True, True]
    assert searcher.given[0] == ((3, 4), (3, 4, 3), HERE, pytest.approx(0.03), {})
    assert node.log[:2] == ["push: why", "warning: odd"]


def test_it_looks_again_before_it_asks_and_ends_where_somebody_says_no(start):
    example, node, stand_in = start()
    published(stand_in)
    refused = InputError("depth image: nothing was measured")
    searcher, asked = Searching(refused, None, None, None, refused, taken()), []
    assert example.search(node, searcher, ask=lambda reason: not asked.append(reason))
    assert (asked, len(searcher.given), searcher.outcomes) == (["none: why"], 6, [True])
    assert node.log[0] == "refused: depth image: nothing was measured"
    stand_in.goals.clear()
    searcher = Searching(*[None] * 9)
    assert not example.search(node, searcher)
    assert len(searcher.given) == 3
    assert not example.search(node, Searching(taken()), confirm=lambda step: False)
    assert stand_in.goals == []


def test_a_node_that_died_goes_on_and_its_last_motion_counts_as_failed(start, tmp_path):
    example, node, stand_in = start(state=str(tmp_path / "search.npz"))
    published(stand_in)
    motions = (pushed(), pushed(), taken())
    first, second = Searching(*motions), Searching(*motions)
    # The power goes off in the second motion: nothing more is written.
    follow = iter([lambda: True, lambda: first.__dict__.update(save=lambda path: None) or 1 / 0])
    node.follow = lambda trajectory: next(follow)()
    with pytest.raises(ZeroDivisionError):
        example.search(node, first)
    node.follow = lambda trajectory: True
    assert example.search(node, second)
    assert second.outcomes == [False, True]


def test_masks_and_bursts_are_taken(start):
    _, node, stand_in = start(mask="/mask", background=0, target_id=40, frames=2)
    published(stand_in, seconds=6)
    numbers = np.array([[0, 7, 7, 40], [0, 0, 7, 7], [0, 0, 0, 0]], np.uint8)
    stand_in.publish("/mask", image(numbers, "mono8", 6))
    with pytest.raises(TimeoutError, match="new depth images did not come"):
        node.look(5.0)
    assert node.lens.camera.width == 4

    def arriving(arrived, what):
        mm, seconds = (1600, 7) if what == "new depth images" else (1400, 6)
        depth = image(np.full((3, 4), mm, np.uint16), "16UC1", seconds)
        stand_in.publish("/camera/camera/aligned_depth_to_color/image_raw", depth)
        assert arrived()

    node._wait_for = arriving
    look = node.look(5.0)
    np.testing.assert_allclose(look["depth"], 1.4, rtol=1e-6)
    assert look["mask"].tolist() == [[-1, 0, 0, 1], [-1, -1, 0, 0], [-1] * 4]
    assert look["target_id"] == 1


def test_what_failed_is_told_to_the_searcher_though_the_arm_stopped(start):
    example, node, stand_in = start()
    published(stand_in)
    stand_in.answers["follow_joint_trajectory"] = types.SimpleNamespace(error_code=-5, error_string="")
    searcher = Searching(pushed())
    with pytest.raises(example.ArmStoppedError, match="error -5"):
        example.search(node, searcher)
    assert searcher.outcomes == [False]


def test_the_package_needs_no_ros():
    for folder in ("mechsearch_jax", "envs"):
        for file in (NODE.parents[2] / folder).rglob("*.py"):
            lines = file.read_text(encoding="utf-8").splitlines()
            imported = [line.split()[1].split(".")[0] for line in lines if line.startswith(("import ", "from "))]
            assert not set(imported) & set(ROS), file
