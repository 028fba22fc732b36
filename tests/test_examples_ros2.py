"""The ROS 2 example, with stand-ins for ROS that have the real messages' fields and refuse any other."""

import dataclasses
import importlib.util
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from test_search_whole_trajectory import pushed, taken

from mechsearch_jax.workspace.camera import Camera

NODE = Path(__file__).parents[1] / "examples" / "ros2" / "search_node.py"
ROS = ("rclpy", "control_msgs", "franka_msgs", "sensor_msgs", "trajectory_msgs")
JOINTS = [f"fr3_joint{i}" for i in range(1, 8)]
HERE = [0.1 * i for i in range(7)]


def message(type_name, /, **fields):
    """A type with these fields, given by what makes their first values; others cannot be set."""

    def start(self, **given):
        for field, make in fields.items():
            setattr(self, field, given.get(field, make()))

    return type(type_name, (), {"__slots__": tuple(fields), "__init__": start})


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


class Future:
    def __init__(self, value):
        self.value = value

    def add_done_callback(self, call):
        call(self)

    def result(self):
        return self.value


class StandIn:
    """What the node is told of ROS, and what it does with it.

    Attributes:
      goals: in the order in which they were sent, with the name of their action.
      answers: results of actions by the last part of their names; a success if there is none.
    """

    def __init__(self, **parameters):
        self.parameters, self.goals, self.answers, self.callbacks = parameters, [], {}, {}

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
                return types.SimpleNamespace(info=self.log.append, warning=self.log.append)

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
                result = stand_in.answers.get(self.name.rpartition("/")[2], self.kind.Result)
                handle = types.SimpleNamespace(
                    accepted=result is not None,
                    get_result_async=lambda: Future(types.SimpleNamespace(result=result)),
                )
                return Future(handle)

        held = {
            "rclpy": {"init": None, "shutdown": None},
            "rclpy.action": {"ActionClient": Client},
            "rclpy.executors": {"MultiThreadedExecutor": None},
            "rclpy.node": {"Node": Node},
            "rclpy.qos": {"qos_profile_sensor_data": None},
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

    def publish(self, topic, message):
        kind, call = self.callbacks[topic]
        assert type(message) is kind
        call(message)


@pytest.fixture
def start(monkeypatch):
    """A node of the example, and its stand-in."""

    def started(**parameters):
        stand_in = StandIn(robot="fr3", **parameters)
        for name, module in stand_in.modules():
            monkeypatch.setitem(sys.modules, name, module)
        spec = importlib.util.spec_from_file_location("search_node", NODE)
        example = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(example)
        monkeypatch.setattr(example, "PATIENCE", 0.05)
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
    camera = example.camera_of(info, usual)
    assert camera == dataclasses.replace(usual, width=848, height=480, fx=424.0, fy=425.0, cx=424.0, cy=240.0)
    info.d = [0.1]
    with pytest.raises(ValueError, match="distorts"):
        example.camera_of(info, usual)


def test_old_images_and_missing_ones_are_not_taken(start):
    _, node, stand_in = start()
    with pytest.raises(TimeoutError, match="new depth and colour images did not come"):
        node.look(0.0)
    published(stand_in, seconds=4)
    with pytest.raises(TimeoutError, match="are the topics right"):
        node.look(5.0)
    published(stand_in, seconds=6)
    depth, colour = node.look(5.0)
    assert (depth.shape, colour.shape) == ((3, 4), (3, 4, 3))
    assert depth[0, 0] == pytest.approx(1.5)
    assert node.joints == HERE
    assert node.width == pytest.approx(0.03)


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
    # It did not open, so that the arm stays outside.
    assert not node.follow(taken())
    assert stand_in.goals[0][0] == "/hand/gripper_action"
    assert len(stand_in.goals) == 2
    stand_in.goals.clear()
    stand_in.answers["gripper_action"] = types.SimpleNamespace(reached_goal=True, stalled=False)
    assert node.follow(taken())
    commands = [goal.command for name, goal in stand_in.goals if name == "/hand/gripper_action"]
    assert [(c.position, c.max_effort) for c in commands] == [
        (pytest.approx(0.04), 0.0),
        (pytest.approx(0.02), 60.0),
    ]


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
    """A searcher that hands out motions and is told what became of them."""

    def __init__(self, *trajectories):
        self.left, self.told, self.given = list(trajectories), [], []

    @property
    def finished(self):
        return not self.left

    def next(self, depth, colour, joints, width):
        self.given.append((depth.shape, colour.shape, joints, width))
        kind = "none" if self.left[0] is None else self.left[0].action
        return types.SimpleNamespace(kind=kind, reason="why", warnings=("odd",), trajectory=self.left[0])

    def acted(self, ok):
        self.told.append(ok)
        self.left.pop(0)


def test_a_search_goes_on_until_the_target_is_out(start):
    example, node, stand_in = start()
    published(stand_in)
    searcher = Searching(pushed(), taken())
    assert example.search(node, searcher)
    assert searcher.told == [True, True]
    assert searcher.given[0] == ((3, 4), (3, 4, 3), HERE, pytest.approx(0.03))
    assert node.log[:2] == ["push: why", "odd"]


def test_a_search_ends_where_nothing_can_be_done_or_somebody_says_no(start):
    example, node, stand_in = start()
    published(stand_in)
    searcher = Searching(None)
    assert not example.search(node, searcher)
    assert len(searcher.given) == example.IDLE
    assert not example.search(node, Searching(taken()), confirm=lambda step: False)
    assert stand_in.goals == []


def test_what_failed_is_told_to_the_searcher_though_the_arm_stopped(start):
    example, node, stand_in = start()
    published(stand_in)
    stand_in.answers["follow_joint_trajectory"] = types.SimpleNamespace(error_code=-5, error_string="")
    searcher = Searching(pushed())
    with pytest.raises(example.ArmStoppedError, match="error -5"):
        example.search(node, searcher)
    assert searcher.told == [False]


def test_the_package_needs_no_ros():
    for folder in ("mechsearch_jax", "envs"):
        for file in (NODE.parents[2] / folder).rglob("*.py"):
            lines = file.read_text(encoding="utf-8").splitlines()
            imported = [line.split()[1].split(".")[0] for line in lines if line.startswith(("import ", "from "))]
            assert not set(imported) & set(ROS), file
