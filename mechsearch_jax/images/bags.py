"""The images of a look in a bag of ROS 1 or ROS 2, read by `rosbags` without ROS."""

from __future__ import annotations

import collections
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mechsearch_jax.images.examples import Images
from mechsearch_jax.images.ros_images import COLOUR, DEPTH, colour_of, depth_of, lens_of
from mechsearch_jax.runtime.errors import InputError, nearest
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.workspace.camera import Camera

TOPICS = ("depth", "colour", "info")
# How far the stamps of images that belong together may be apart [s].
SLOP = 0.1


def bag_images(
    path: PathLike, camera: Camera, *, topics: Mapping[str, str] | None = None, image: int | None = None
) -> Images:
    """A depth image of a bag, and the colour image and the `CameraInfo` nearest to it in time, undistorted.

    Topics whose last part holds "rect" are taken for `image_proc`'s: rectified, with the intrinsics of P.

    Args:
      path: a file of ROS 1 (.bag), or a folder of ROS 2.
      camera: has the pose; all else is the `CameraInfo`'s.
      topics: those of "depth", "colour" and "info". The others are found: the only topic with depth images, the only
        one with colour images, and the only `CameraInfo`, or the one beside the depth images.
      image: which depth image, counted from 0; the last if None.

    Raises:
      InputError: the bag cannot be read, a topic is not there or not the only one of its kind, the images cannot be
        used, or rosbags is not installed.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(
            f"bags need the library rosbags ({error}); install it with: pip install 'mechsearch-jax[bags]'"
        ) from None
    given = dict(topics or {})
    for name in given:
        if name not in TOPICS:
            raise InputError(f"topics: {name} is unknown; {nearest(name, TOPICS)}")
    if image is not None and image < 0:
        raise InputError(f"image {image}: depth images are counted from 0")
    try:
        # Bags in SQLite, of before ROS 2 Iron, have no definitions of messages.
        with AnyReader([Path(path)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            return _images(reader, camera, given, image)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    # Damaged bags raise exceptions of many kinds.
    except Exception as error:
        raise InputError(f"{path}: is no bag that can be read ({' '.join(str(error).split())[:200]})") from error


def _images(reader: Any, camera: Camera, given: dict[str, str], image: int | None) -> Images:
    topics = _topics(reader, given)
    depths = _messages(reader, topics["depth"])
    chosen = collections.deque(depths if image is None else itertools.islice(depths, image, image + 1), maxlen=1)
    if not chosen:
        raise InputError(f"{topics['depth']} has no image {image}; they are counted from 0")
    depth = chosen[0]

    def apart(message: Any) -> float:
        return abs(_stamp(message) - _stamp(depth))

    # ROS calls rectified images so, and gives them the CameraInfo of the raw ones.
    rectified = "rect" in topics["depth"].rpartition("/")[2]
    lens = lens_of(min(_messages(reader, topics["info"]), key=apart), camera, rectified)
    colour = None
    if "colour" in topics:
        message = min(_messages(reader, topics["colour"]), key=apart)
        if apart(message) > SLOP:
            raise InputError(f"{topics['colour']} has no image within {SLOP} s of that depth image; choose another one")
        frames = [each.header.frame_id for each in (depth, message)]
        if all(frames) and frames[0] != frames[1]:
            raise InputError(
                f"the depth is in frame {frames[0]}, the colour in {frames[1]}; choose with depth=TOPIC what is "
                "registered to the colour image"
            )
        colour = lens.colour(colour_of(message))
    return Images(lens.depth(depth_of(depth)), colour, None, None, lens.camera)


def _messages(reader: Any, topic: str) -> Iterator[Any]:
    connections = [each for each in reader.connections if each.topic == topic]
    for connection, _, data in reader.messages(connections):
        yield reader.deserialize(data, connection.msgtype)


def _stamp(message: Any) -> float:
    stamp = message.header.stamp
    return stamp.sec + 1e-9 * stamp.nanosec


def _topics(reader: Any, given: dict[str, str]) -> dict[str, str]:
    """The topic of each kind; "colour" may be missing."""
    there = {each.topic: each.msgtype.split("/")[-1] for each in reader.connections if each.msgcount}
    for topic in given.values():
        if topic not in there:
            raise InputError(f"has no messages of topic {topic}; {nearest(topic, there)}")
    encodings = {topic: next(_messages(reader, topic)).encoding for topic in sorted(there) if there[topic] == "Image"}
    found = {
        "depth": [topic for topic, encoding in encodings.items() if encoding in DEPTH],
        "colour": [topic for topic, encoding in encodings.items() if encoding in COLOUR],
        "info": sorted(topic for topic, kind in there.items() if kind == "CameraInfo"),
    }
    chosen = dict(given)
    for name in TOPICS:
        if name in given:
            continue
        beside = f"{chosen['depth'].rpartition('/')[0]}/camera_info" if name == "info" else ""
        choice = [beside] if beside in found[name] else found[name]
        if len(choice) == 1:
            chosen[name] = choice[0]
        elif choice or name != "colour":
            says = f"the topics {', '.join(choice)}" if choice else "no topic"
            raise InputError(
                f"has {says} for {name}; say which with {name}=TOPIC (there are {', '.join(sorted(there))})"
            )
    return chosen
