"""A search with a real Franka robot through ROS 2: images in, arm and gripper goals out.

    ros2 run or: python search_node.py --ros-args -p config:=mine.toml -p robot:=fr3

The node subscribes to a depth image, a colour image registered to it, the camera's intrinsics and the joint states. It
asks a `Searcher` what to do, and executes it in legs: the arm by `FollowJointTrajectory`, the hand by Franka's `Move`
and `Grasp`, or by `GripperCommand`. The arm waits until the hand has answered. README.md, beside this file, lists the
parameters.
"""

from __future__ import annotations

import dataclasses
import threading
import time

import numpy as np
import rclpy
from control_msgs.action import FollowJointTrajectory, GripperCommand
from control_msgs.msg import JointTolerance
from rclpy.action import ActionClient
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from mechsearch_jax.envs.cell.loading import load_searcher
from mechsearch_jax.problem.settings import Settings, load_settings
from mechsearch_jax.robot.ros_messages import gripper_command_goal, hand_goal, joint_trajectory_message, legs

# How far the stamps of images that belong together may be apart [s], and how long the node waits for what it needs [s].
SLOP, PATIENCE = 0.1, 30.0
# Longer than a goal's own time [s]: then the controller is taken to be dead.
SPARE = 30.0
# Steps without a motion, one after the other, after which the search ends.
IDLE = 3

PARAMETERS = {
    "config": "",
    "robot": "panda",
    "depth": "/camera/camera/aligned_depth_to_color/image_raw",
    "colour": "/camera/camera/color/image_raw",
    "camera_info": "/camera/camera/color/camera_info",
    "joint_states": "/joint_states",
    "arm_action": "",
    "gripper": "franka",
    "gripper_namespace": "",
    "confirm": True,
}


def pixels(image, kinds):
    """The array of a `sensor_msgs/Image`, whose encoding must be one of `kinds`: type and number of channels."""
    if image.encoding not in kinds:
        raise ValueError(f"images of encoding {image.encoding} cannot be used; publish one of {', '.join(kinds)}")
    kind, channels = kinds[image.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
    rows = np.frombuffer(bytes(image.data), np.uint8).reshape(image.height, image.step)
    row = np.ascontiguousarray(rows[:, : image.width * channels * dtype.itemsize])
    return row.view(dtype).reshape(image.height, image.width, channels).astype(kind)


def depth_of(image):
    """Depth in metres, float32 (H, W); 0 or NaN where nothing was measured."""
    array = pixels(image, {"16UC1": (np.uint16, 1), "mono16": (np.uint16, 1), "32FC1": (np.float32, 1)})[..., 0]
    return array if array.dtype == np.float32 else array.astype(np.float32) * np.float32(0.001)


def colour_of(image):
    """Red, green and blue, uint8 (H, W, 3)."""
    channels = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
    array = pixels(image, {name: (np.uint8, count) for name, count in channels.items()})[..., :3]
    return array[..., ::-1].copy() if image.encoding.startswith("bgr") else array


def camera_of(info, camera):
    """The configuration's camera, which has the pose, with the intrinsics of a `CameraInfo`."""
    if any(abs(value) > 1e-6 for value in info.d):
        raise ValueError("camera_info: the lens distorts; subscribe to rectified images, whose d is zeros")
    k = [float(value) for value in info.k]
    # In k the centre of the first pixel is at 0.
    return dataclasses.replace(
        camera, width=info.width, height=info.height, fx=k[0], fy=k[4], cx=k[2] + 0.5, cy=k[5] + 0.5
    )


def filled(message, values):
    """A message whose fields have the values of nested dictionaries."""
    for name, value in values.items():
        if isinstance(value, dict):
            filled(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message


def seconds_of(stamp):
    return stamp.sec + 1e-9 * stamp.nanosec


class ArmStoppedError(RuntimeError):
    """The arm did not reach the end of a leg, and may stand inside the shelf."""


class SearchNode(Node):
    """Topics and actions of one robot and its camera."""

    def __init__(self):
        super().__init__("mechsearch")
        self.given = {name: self.declare_parameter(name, usual).value for name, usual in PARAMETERS.items()}
        robot = self.given["robot"]
        self.joint_names = [f"{robot}_joint{i}" for i in range(1, 8)]
        self.finger_names = [f"{robot}_finger_joint{i}" for i in (1, 2)]
        self._latest, self._positions = {}, {}
        for name, kind in (("depth", Image), ("colour", Image), ("camera_info", CameraInfo)):
            self.create_subscription(kind, self.given[name], self._keeper(name), qos_profile_sensor_data)
        self.create_subscription(JointState, self.given["joint_states"], self._keep_joints, qos_profile_sensor_data)
        arm = self.given["arm_action"] or f"/{robot}_arm_controller/follow_joint_trajectory"
        self._arm = ActionClient(self, FollowJointTrajectory, arm)
        self._hand = self._hand_clients(self.given["gripper_namespace"] or f"/{robot}_gripper")

    def _hand_clients(self, namespace):
        """Type and client of the action for each kind of event."""
        if self.given["gripper"] == "command":
            client = ActionClient(self, GripperCommand, f"{namespace}/gripper_action")
            return {kind: (GripperCommand, client) for kind in ("move", "grasp")}
        if self.given["gripper"] != "franka":
            raise ValueError(f"gripper: {self.given['gripper']} is unknown; use franka or command")
        # Where there is another gripper, franka_msgs need not be installed.
        from franka_msgs.action import Grasp, Move

        kinds = {"move": Move, "grasp": Grasp}
        return {name: (kind, ActionClient(self, kind, f"{namespace}/{name}")) for name, kind in kinds.items()}

    def _keeper(self, name):
        def keep(message):
            self._latest[name] = message

        return keep

    def _keep_joints(self, message):
        self._positions.update(zip(message.name, message.position, strict=True))

    @property
    def joints(self):
        """Where the arm is: seven angles [rad]."""
        self._wait_for(lambda: all(name in self._positions for name in self.joint_names), "joint states of the arm")
        return [self._positions[name] for name in self.joint_names]

    @property
    def width(self):
        """How far the fingers are apart [m]; None if nobody publishes it."""
        fingers = [self._positions.get(name) for name in self.finger_names]
        return None if None in fingers else sum(fingers)

    def camera_info(self):
        self._wait_for(lambda: "camera_info" in self._latest, "the camera's intrinsics")
        return self._latest["camera_info"]

    def now(self):
        return 1e-9 * self.get_clock().now().nanoseconds

    def look(self, since):
        """A depth and a colour image that belong together and were taken after `since` [s]."""

        def arrived():
            stamps = [seconds_of(self._latest[n].header.stamp) for n in ("depth", "colour") if n in self._latest]
            return len(stamps) == 2 and min(stamps) > since and max(stamps) - min(stamps) <= SLOP

        self._wait_for(arrived, "new depth and colour images")
        return depth_of(self._latest["depth"]), colour_of(self._latest["colour"])

    def follow(self, trajectory):
        """Execute a trajectory leg by leg; whether the hand did all that it was to do.

        The hand that does not open ends it outside the shelf. After a grasp that failed the arm goes on, for that is
        its way out.

        Raises:
          ArmStoppedError: the arm did not follow.
        """
        ok = True
        for leg in legs(trajectory):
            events = [] if leg.event is None else [self._begin_event(leg.event)]
            if leg.last > leg.first:
                self._end_arm(self._begin_arm(trajectory, leg), leg)
            done = all(self._end_event(*begun) for begun in events)
            if not done and not leg.event.waits:
                return False
            ok &= done
        return ok

    def _begin_arm(self, trajectory, leg):
        message = joint_trajectory_message(trajectory, self.joint_names, leg.first, leg.last)
        points = [filled(JointTrajectoryPoint(), point) for point in message.pop("points")]
        goal = FollowJointTrajectory.Goal()
        goal.trajectory = filled(JointTrajectory(), message)
        goal.trajectory.points = points
        tracking = trajectory.bounds.tracking
        goal.path_tolerance = [
            filled(JointTolerance(), {"name": name, "position": tracking}) for name in self.joint_names
        ]
        seconds = float(trajectory.time[leg.last] - trajectory.time[leg.first])
        return self._send(self._arm, goal), seconds

    def _end_arm(self, begun, leg):
        result = self._result(*begun)
        if result is None or result.error_code != FollowJointTrajectory.Result.SUCCESSFUL:
            why = "no answer" if result is None else result.error_string or f"error {result.error_code}"
            raise ArmStoppedError(f"the arm stopped in rows {leg.first} to {leg.last}: {why}; take it out by hand")

    def _begin_event(self, event):
        kind, client = self._hand[event.kind]
        values = gripper_command_goal(event) if kind is GripperCommand else hand_goal(event)
        return event, self._send(client, filled(kind.Goal(), values))

    def _end_event(self, event, sent):
        result = self._result(sent, event.duration)
        if result is None:
            done = False
        elif self._hand[event.kind][0] is GripperCommand:
            done = result.reached_goal or (event.kind == "grasp" and result.stalled)
        else:
            done = result.success
        if not done:
            self.get_logger().warning(f"the hand could not {event.kind} to {1000 * event.width:.0f} mm")
        return bool(done)

    def _send(self, client, goal):
        if not client.wait_for_server(timeout_sec=PATIENCE):
            raise TimeoutError("an action server of the arm or the gripper does not answer; is its driver running?")
        return client.send_goal_async(goal)

    def _result(self, sent, seconds):
        """The result of a goal; None if it is refused or does not come."""
        handle = self._done(sent, PATIENCE)
        if handle is None or not handle.accepted:
            return None
        answer = self._done(handle.get_result_async(), seconds + SPARE)
        return None if answer is None else answer.result

    def _done(self, future, seconds):
        """The result of a future, for which another thread spins; None if it does not come in time."""
        arrived = threading.Event()
        future.add_done_callback(lambda _: arrived.set())
        return future.result() if arrived.wait(seconds) else None

    def _wait_for(self, arrived, what):
        end = time.monotonic() + PATIENCE
        while not arrived():
            if time.monotonic() > end:
                raise TimeoutError(f"{what} did not come; are the topics right?")
            time.sleep(0.02)


def search(node, searcher, confirm=lambda step: True):
    """Search until the target is taken out; False if nothing more can be done, or the operator says no."""
    log, since, idle = node.get_logger(), node.now(), 0
    while not searcher.finished:
        depth, colour = node.look(since)
        step = searcher.next(depth, colour, joints=node.joints, width=node.width)
        log.info(f"{step.kind}: {step.reason}")
        for warning in step.warnings:
            log.warning(warning)
        if step.trajectory is None:
            idle += 1
            if idle == IDLE:
                return False
            continue
        if not confirm(step):
            return False
        idle, ok = 0, False
        try:
            ok = node.follow(step.trajectory)
        finally:
            searcher.acted(ok)
            since = node.now()
    return True


def asked(step):
    """Whether the operator agrees to a motion."""
    print(f"{step.kind}: {step.reason}\n{step.trajectory.report()}")
    return input("Move? [y/N] ").strip().lower() == "y"


def main():
    rclpy.init()
    node = SearchNode()
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    try:
        path = node.given["config"] or None
        settings = Settings() if path is None else load_settings(path)
        searcher = load_searcher(path, camera=camera_of(node.camera_info(), settings.workcell.camera))
        for warning in searcher.check().warnings:
            node.get_logger().warning(warning)
        searcher.warm_up(lambda what, left: node.get_logger().info(f"preparing {what}"), colour=True)
        found = search(node, searcher, asked if node.given["confirm"] else lambda step: True)
        node.get_logger().info("the target is out" if found else "the search ended without the target")
    finally:
        executor.shutdown()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
