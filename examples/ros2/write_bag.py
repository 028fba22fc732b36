"""A motion as a ROS 2 bag, without ROS: what `mechsearch plan` decided, as a `trajectory_msgs/msg/JointTrajectory`.

    pip install rosbags
    python write_bag.py mine.bag

Copy it and change it: `bag_message` makes a message of any dictionary of `mechsearch_jax.robot.ros_messages` whose type
the store knows.
"""

from __future__ import annotations

import sys

from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

import mechsearch_jax as ms
from mechsearch_jax.robot.ros_messages import joint_trajectory_message

KIND, TOPIC = "trajectory_msgs/msg/JointTrajectory", "/joint_trajectory"


def bag_message(store, kind, values):
    """A message of a type's name from a dictionary with its fields."""

    def made(description, value):
        node, of = description
        if node == Nodetype.NAME:
            return bag_message(store, of, value)
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE) and of[0][0] == Nodetype.NAME:
            return [bag_message(store, of[0][1], each) for each in value]
        return value

    _, fields = store.fielddefs[kind]
    return store.types[kind](**{name: made(description, values[name]) for name, description in fields})


def write_bag(path, trajectory, release=Stores.ROS2_HUMBLE):
    """Write all rows of a trajectory as one message; the folder must not be there."""
    store = get_typestore(release)
    message = bag_message(store, KIND, joint_trajectory_message(trajectory))
    with Writer(path, version=8) as bag:
        connection = bag.add_connection(TOPIC, KIND, typestore=store)
        bag.write(connection, 0, store.serialize_cdr(message, KIND))


def main(path):
    images = ms.example_images()
    step = ms.Searcher(ms.Workcell(camera=images.camera)).next(images.depth, images.colour)
    print(f"{step.kind}: {step.reason}")
    if step.trajectory is not None:
        write_bag(path, step.trajectory)


if __name__ == "__main__":
    main(sys.argv[1])
