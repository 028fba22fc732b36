"""Images in bags of ROS 1 and ROS 2, small ones made here."""

import numpy as np
import pytest

from mechsearch_jax.commands import plan
from mechsearch_jax.images.bags import bag_images
from mechsearch_jax.images.lens import Lens
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera

pytest.importorskip("rosbags")
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

H, W = 30, 40
INFO, IMAGE = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Image"
POSED = Camera()
BARREL = (-0.2, 0.05, 0.001, 0.0, 0.0)


class Bag:
    """Writes messages of one release, which go by the time in tenths of a second."""

    def __init__(self, path, ros1):
        self.store, self.ros1 = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE), ros1
        self.writer = Writer1(path) if ros1 else Writer2(path, version=8)
        self.writer.open()
        self.connections = {}

    def put(self, topic, kind, tenths, frame="camera_color", **values):
        types = self.store.types
        stamp = types["builtin_interfaces/msg/Time"](sec=tenths // 10, nanosec=tenths % 10 * 10**8)
        more = {"seq": tenths} if self.ros1 else {}
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(
            self.connections[topic], tenths * 10**8, serialize(types[kind](header=header, **values), kind)
        )

    def image(self, topic, tenths, array, encoding, frame="camera_color"):
        data = np.frombuffer(array.tobytes(), np.uint8)
        values = {"encoding": encoding, "is_bigendian": 0, "step": data.size // H, "data": data}
        self.put(topic, IMAGE, tenths, frame, height=H, width=W, **values)

    def info(self, topic, tenths, D=(0.0,) * 5, model="plumb_bob", fx=50.0):
        roi = self.store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        K, P = [fx, 0.0, 19.5, 0.0, 51.0, 14.5, 0.0, 0.0, 1.0], [60.0, 0, 19.5, 0, 0, 61.0, 14.5, 0, 0, 0, 1, 0]
        arrays = {"D": np.array(D), "K": np.array(K), "R": np.eye(3).ravel(), "P": np.array(P)}
        fields = arrays if self.ros1 else {name.lower(): value for name, value in arrays.items()}
        rest = {"height": H, "width": W, "distortion_model": model, "binning_x": 0, "binning_y": 0, "roi": roi}
        self.put(topic, INFO, tenths, **rest, **fields)


@pytest.fixture(params=["ros1", "ros2"])
def bag(request, tmp_path):
    """A bag to write to; its path is `path`."""
    path = tmp_path / ("bag.bag" if request.param == "ros1" else "bag")
    made = Bag(path, request.param == "ros1")
    made.path = path
    return made


def looks(bag, count=3, frame="camera_color", **info):
    """Depth of 1, 2, ... metres and colours of the same number, which come in another order."""
    for i in range(count):
        bag.info("/camera/camera_info", 10 * i, **info)
        bag.image("/camera/colour", 10 * i, np.full((H, W, 3), (10 + i, 20, 30), np.uint8), "bgr8")
        bag.image("/camera/depth", 10 * i, np.full((H, W), 1000 * (i + 1), np.uint16), "16UC1", frame)
    bag.image("/camera/infra", 0, np.zeros((H, W), np.uint8), "mono8")
    bag.writer.close()


def test_the_last_or_another_look_is_found_without_names(bag):
    looks(bag)
    for image, depth in ((None, 3.0), (0, 1.0), (1, 2.0)):
        images = bag_images(bag.path, POSED, image=image)
        np.testing.assert_allclose(images.depth, np.full((H, W), depth), rtol=1e-6)
        assert images.colour[0, 0].tolist() == [30, 20, 9 + depth]
        assert images.mask is images.target_id is None
    camera = images.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (W, H, 50.0, 51.0, 20.0, 15.0)
    assert (camera.rotation, camera.position) == (POSED.rotation, POSED.position)


def test_a_lens_that_distorts_is_undistorted(bag, tmp_path):
    looks(bag, D=BARREL)
    config = tmp_path / "mine.toml"
    config.write_text("")
    files = plan.ImageFiles(bag=bag.path, image=0, topics=("depth=/camera/depth", "info=/camera/camera_info"))
    files.check()
    images, camera, _ = files.load(config, POSED)
    lens = Lens(camera, BARREL)
    np.testing.assert_array_equal(images["depth"], lens.depth(np.ones((H, W), np.float32)))
    raw = np.broadcast_to(np.array([30, 20, 10], np.uint8), (H, W, 3))
    np.testing.assert_array_equal(images["colour"], lens.colour(raw))
    with pytest.raises(InputError, match=r"--bag does not say where the camera is; say so in \[camera\] of --config"):
        files.load(None, POSED)


def test_rectified_images_have_the_intrinsics_of_p_and_metres_may_be_floats(bag):
    bag.info("/camera/camera_info", 0, D=BARREL)
    bag.image("/camera/image_rect", 0, np.full((H, W), 0.7, np.float32), "32FC1")
    bag.writer.close()
    images = bag_images(bag.path, POSED)
    assert (images.depth == np.float32(0.7)).all()
    assert images.colour is None
    assert (images.camera.fx, images.camera.fy) == (60.0, 61.0)


@pytest.mark.parametrize(
    ("change", "arguments", "words"),
    [
        ({}, {"image": 3}, "/camera/depth has no image 3; they are counted from 0"),
        ({}, {"image": -1}, "image -1: depth images are counted from 0"),
        ({}, {"topics": {"depth": "/camera/dept"}}, "no messages of topic /camera/dept; did you mean /camera/depth?"),
        ({}, {"topics": {"deep": "/camera/depth"}}, "topics: deep is unknown"),
        ({}, {"topics": {"depth": "/camera/infra"}}, "images of encoding mono8 cannot be used"),
        ({"frame": "camera_depth"}, {}, "the depth is in frame camera_depth, the colour in camera_color"),
        ({"model": "equidistant", "D": (0.0,) * 4}, {}, "distortion_model equidistant is not understood"),
        ({"fx": 0.0}, {}, "k holds no focal lengths"),
    ],
)
def test_a_bag_that_cannot_be_used_is_refused_in_one_line(bag, change, arguments, words):
    looks(bag, **change)
    with pytest.raises(InputError) as refused:
        bag_images(bag.path, POSED, **arguments)
    assert words in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_several_topics_of_a_kind_have_to_be_told_apart(bag):
    bag.image("/b/depth", 0, np.zeros((H, W), np.uint16), "16UC1")
    bag.image("/a/colour", 7, np.zeros((H, W, 3), np.uint8), "rgb8")
    bag.info("/a/camera_info", 0)
    bag.info("/b/camera_info", 0, fx=70.0)
    bag.image("/a/depth", 0, np.ones((H, W), np.uint16), "16UC1")
    bag.writer.close()
    with pytest.raises(InputError, match="has the topics /a/depth, /b/depth for depth; say which with depth=TOPIC"):
        bag_images(bag.path, POSED)
    with pytest.raises(InputError, match=r"/a/colour has no image within 0\.1 s"):
        bag_images(bag.path, POSED, topics={"depth": "/b/depth"})
