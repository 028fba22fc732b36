"""A search with a real Franka robot through ROS 2: images in, arm and gripper goals out.

    ros2 run or: python search_node.py --ros-args -p config:=mine.toml -p robot:=fr3

The node subscribes to a depth image, a colour image registered to it, the camera's intrinsics and the joint states. It
asks a `Searcher` what to do, and executes it in legs: the arm by `FollowJointTrajectory`, the hand by Franka's `Move`
and `Grasp`, or by `GripperCommand`. The arm waits until the hand has answered. README.md, beside this file, lists the
parameters.
"""

from __future__ import annotations

import functools
import signal
import threading
import time

import numpy as np
import rclpy
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory, GripperCommand
from control_msgs.msg import JointTolerance
from rclpy.action import ActionClient
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, Image, JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from mechsearch_jax.envs.cell.loading import load_searcher
from mechsearch_jax.images.image_files import numbered
from mechsearch_jax.images.measured import median_depth
from mechsearch_jax.images.ros_images import colour_of, depth_of, lens_of, mask_of
from mechsearch_jax.problem.settings import Settings, load_settings
from mechsearch_jax.robot.arm_config import ARMS
from mechsearch_jax.robot.ros_messages import gripper_command_goal, hand_goal, joint_trajectory_message, legs
from mechsearch_jax.session.loop import run_search

# How far the stamps of images that belong together may be apart [s], and how long the node waits for what it needs [s].
SLOP, PATIENCE = 0.1, 30.0
# Longer than a goal's own time [s]: then the controller is taken to be dead. How long a cancellation is waited for [s].
SPARE, CANCELLING = 30.0, 2.0
# Age at which a joint state counts no more [s].
STALE = 1.0

PARAMETERS = {
    "config": "",
    "robot": "",
    "depth": "/camera/camera/aligned_depth_to_color/image_raw",
    "colour": "/camera/camera/color/image_raw",
    "camera_info": "/camera/camera/color/camera_info",
    "mask": "",
    "background": 255,
    "target_id": -1,
    "frames": 5,
    "rectified": False,
    "joint_states": "/joint_states",
    "arm_action": "",
    "gripper": "franka",
    "gripper_namespace": "",
    "widest": 0.079,
    "confirm": True,
    "state": "",
}


def filled(message, values):
    """A message whose fields have the values of nested dictionaries."""
    for name, value in values.items():
        if isinstance(value, dict):
            filled(getattr(message, name), value)
        else:
            # Of sequences rclpy takes lists.
            setattr(message, name, value.tolist() if isinstance(value, np.ndarray) else value)
    return message


def model_of(robot):
    """The model of the arm whose joints have names with this prefix."""
    models = [model for model in ARMS if robot.endswith(model)]
    if not models:
        raise ValueError(f"robot: {robot} is none of {', '.join(ARMS)}, with or without something in front of it")
    return models[0]


def seconds_of(stamp):
    return stamp.sec + 1e-9 * stamp.nanosec


def succeeded(answer):
    """Whether a goal came to its end; a goal that was cancelled or aborted has a result, too, often an empty one."""
    return answer is not None and answer.status == GoalStatus.STATUS_SUCCEEDED


class ArmStoppedError(RuntimeError):
    """The arm did not reach the end of a leg, and may stand inside the shelf."""


class SearchNode(Node):
    """Topics and actions of one robot and its camera."""

    def __init__(self):
        super().__init__("mechsearch")
        self.given = {name: self.declare_parameter(name, usual).value for name, usual in PARAMETERS.items()}
        path = self.given["config"]
        self.settings = load_settings(path) if path else Settings()
        robot = self.given["robot"] or self.settings.workcell.arm.model
        self.model = model_of(robot)
        self.joint_names = [f"{robot}_joint{i}" for i in range(1, 8)]
        self.finger_names = [f"{robot}_finger_joint{i}" for i in (1, 2)]
        self._latest, self._positions = {}, {}
        # Futures of the handles of goals whose result has not come.
        self._running = []
        self._images = ["depth", "colour", *(["mask"] if self.given["mask"] else [])]
        for name, kind in (*((name, Image) for name in self._images), ("camera_info", CameraInfo)):
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
        # Some drivers publish velocities or efforts alone.
        if len(message.position) == len(message.name):
            now = time.monotonic()
            self._positions.update({q: (x, now) for q, x in zip(message.name, message.position, strict=True)})

    def _position(self, name):
        """The present position of a joint; None if nobody has published it lately."""
        position, arrived = self._positions.get(name, (None, 0.0))
        return None if time.monotonic() - arrived > STALE else position

    @property
    def joints(self):
        """Where the arm is: seven angles [rad]."""
        positions = []

        def arrived():
            positions[:] = [self._position(name) for name in self.joint_names]
            return None not in positions

        self._wait_for(arrived, "joint states of the arm")
        return positions

    @property
    def width(self):
        """How far the fingers are apart [m]; None if nobody publishes it."""
        fingers = [self._position(name) for name in self.finger_names]
        return None if None in fingers else sum(fingers)

    @functools.cached_property
    def lens(self):
        """The camera, and how its lens distorts, for good: with the configured pose."""
        self._wait_for(lambda: "camera_info" in self._latest, "the camera's intrinsics")
        return lens_of(self._latest["camera_info"], self.settings.workcell.camera, self.given["rectified"])

    def now(self):
        return 1e-9 * self.get_clock().now().nanoseconds

    def look(self, since):
        """Images that belong together and were taken after `since` [s], undistorted, as `Searcher.next` takes them.

        The depth is the median of several frames.
        """
        images = self._new(self._images, since)
        frames = [images["depth"]]
        while len(frames) < self.given["frames"]:
            frames.append(self._new(["depth"], seconds_of(frames[-1].header.stamp))["depth"])
        look = {
            "depth": self.lens.depth(median_depth([depth_of(frame) for frame in frames])),
            "colour": self.lens.colour(colour_of(images["colour"])),
        }
        if "mask" in images:
            mask, numbers = numbered(mask_of(images["mask"]), self.given["background"], "mask")
            look["mask"] = self.lens.mask(mask)
            if self.given["target_id"] >= 0:
                look["target_id"] = numbers.get(self.given["target_id"], -1)
        return look

    def _new(self, names, since):
        """The messages of images that belong together and were taken after `since` [s]."""
        found = {}

        def arrived():
            found.update(self._latest)
            stamps = [seconds_of(found[name].header.stamp) for name in names if name in found]
            return len(stamps) == len(names) and min(stamps) > since and max(stamps) - min(stamps) <= SLOP

        self._wait_for(arrived, f"new {' and '.join(names)} images")
        return found

    def follow(self, trajectory):
        """Execute a trajectory leg by leg; whether the hand did all that it was to do.

        If the hand does not open on the way to the shelf, the arm goes the same way back, out of the camera's sight.
        After a grasp that failed it goes on, for that is its way out. Whatever ends it early, no goal stays behind.

        Raises:
          ArmStoppedError: the arm did not follow.
        """
        ok = True
        try:
            for leg in legs(trajectory):
                events = [] if leg.event is None else [self._begin_event(leg.event)]
                self._move_arm(trajectory, leg)
                done = all(self._end_event(*begun) for begun in events)
                if not done and not leg.event.waits:
                    self._move_arm(trajectory, leg, backward=True)
                    return False
                ok &= done
        finally:
            self.cancel()
        return ok

    def cancel(self):
        """Cancel all goals that have no result."""
        for sent in list(self._running):
            self._cancel(sent)

    def _cancel(self, sent):
        self._running.remove(sent)
        handle = self._done(sent, CANCELLING)
        if handle is None:
            # It may be accepted yet.
            sent.add_done_callback(lambda late: late.result().accepted and late.result().cancel_goal_async())
        if handle is None or (handle.accepted and self._done(handle.cancel_goal_async(), CANCELLING) is None):
            self.get_logger().error("a goal may go on, for its server does not answer; stop the robot by hand")

    def _move_arm(self, trajectory, leg, backward=False):
        if leg.last == leg.first:
            return
        answer = self._answer(*self._begin_arm(trajectory, leg, backward))
        if succeeded(answer) and answer.result.error_code == FollowJointTrajectory.Result.SUCCESSFUL:
            return
        if answer is None:
            why = "no answer"
        else:
            why = answer.result.error_string or f"error {answer.result.error_code}, status of the goal {answer.status}"
        raise ArmStoppedError(f"the arm stopped in rows {leg.first} to {leg.last}: {why}; take it out by hand")

    def _begin_arm(self, trajectory, leg, backward):
        message = joint_trajectory_message(trajectory, self.joint_names, leg.first, leg.last, backward=backward)
        points = [filled(JointTrajectoryPoint(), point) for point in message.pop("points")]
        goal = FollowJointTrajectory.Goal()
        goal.trajectory = filled(JointTrajectory(), message)
        goal.trajectory.points = points
        tracking = float(trajectory.bounds.tracking)
        goal.path_tolerance = [
            filled(JointTolerance(), {"name": name, "position": tracking}) for name in self.joint_names
        ]
        seconds = float(trajectory.time[leg.last] - trajectory.time[leg.first])
        return self._send(self._arm, goal), seconds

    def _begin_event(self, event):
        kind, client = self._hand[event.kind]
        if kind is GripperCommand:
            values = gripper_command_goal(event, widest=self.given["widest"])
        else:
            values = hand_goal(event)
        return event, self._send(client, filled(kind.Goal(), values))

    def _end_event(self, event, sent):
        answer = self._answer(sent, event.duration)
        if not succeeded(answer):
            done = False
        elif self._hand[event.kind][0] is GripperCommand:
            done = answer.result.reached_goal or (event.kind == "grasp" and answer.result.stalled)
        else:
            done = answer.result.success
        if not done:
            self.get_logger().warning(f"the hand could not {event.kind} to {1000 * event.width:.0f} mm")
        return bool(done)

    def _send(self, client, goal):
        if not client.wait_for_server(timeout_sec=PATIENCE):
            raise TimeoutError("an action server of the arm or the gripper does not answer; is its driver running?")
        sent = client.send_goal_async(goal)
        self._running.append(sent)
        return sent

    def _answer(self, sent, seconds):
        """Status and result of a goal; None if it is refused, or cancelled because no result came in time."""
        handle = self._done(sent, PATIENCE)
        if handle is not None and not handle.accepted:
            self._running.remove(sent)
            return None
        answer = None if handle is None else self._done(handle.get_result_async(), seconds + SPARE)
        if answer is None:
            self._cancel(sent)
        else:
            self._running.remove(sent)
        return answer

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


def search(node, searcher, confirm=lambda step: True, ask=lambda reason: False):
    """Search until the target is taken out; False if nothing more can be done, or the operator says no."""
    return run_search(
        searcher,
        lambda: {**node.look(node.now()), "joints": node.joints, "width": node.width},
        node.follow,
        ask,
        confirm=confirm,
        tell=node.get_logger().info,
        state=node.given["state"] or None,
    )


def confirmed(step):
    """Whether the operator agrees to a motion."""
    print(f"{step.kind}: {step.reason}\n{step.trajectory.report()}")
    return input("Move? [y/N] ").strip().lower() == "y"


def asked(searcher):
    """A function that asks whether to look again; the operator may also say that the hand has the target."""

    def ask(reason):
        answer = input("Look again? [y/N, t: the target is in the hand] ").strip().lower()
        if answer == "t":
            searcher.acted()
        return answer in ("y", "t")

    return ask


def main():
    # ROS's own handlers would end the connection before goals are cancelled.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    node = SearchNode()
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    try:
        path = node.given["config"] or None
        if node.lens.distorts:
            node.get_logger().info("images are undistorted by d of camera_info; if they are rectified: rectified:=true")
        searcher = load_searcher(path, camera=node.lens.camera, arm=node.model)
        check = searcher.check()
        for line in (*check.warnings, *check.notices):
            node.get_logger().warning(line)
        mask = bool(node.given["mask"])
        kinds = {"colour": True, "mask": mask, "target_id": mask and node.given["target_id"] >= 0}
        searcher.warm_up(lambda what, left: node.get_logger().info(f"preparing {what}"), **kinds)
        asking = (confirmed, asked(searcher)) if node.given["confirm"] else ()
        retrieved = search(node, searcher, *asking)
        node.get_logger().info("the target is out" if retrieved else "the search ended without the target")
    finally:
        node.cancel()
        executor.shutdown()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
