"""Images and cameras in files: what drivers write is read, and what is not meant is refused in one line."""

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image

from mechsearch_jax.images.examples import example_images
from mechsearch_jax.images.image_files import (
    load_camera,
    load_colour,
    load_depth,
    load_mask,
    save_camera,
    save_colour,
    save_depth,
    save_mask,
)
from mechsearch_jax.runtime.errors import InputError

IMAGES = example_images()


def test_what_is_written_is_read(tmp_path):
    save_depth(IMAGES.depth, tmp_path / "d.png")
    save_colour(IMAGES.colour, tmp_path / "c.png")
    save_mask(IMAGES.mask, tmp_path / "m.png")
    save_camera(IMAGES.camera, tmp_path / "camera.json")
    np.testing.assert_allclose(load_depth(tmp_path / "d.png"), IMAGES.depth, atol=1e-6)
    np.testing.assert_array_equal(load_colour(tmp_path / "c.png"), IMAGES.colour)
    mask, numbers = load_mask(tmp_path / "m.png", 255)
    np.testing.assert_array_equal(mask, np.where(IMAGES.mask < 0, -1, IMAGES.mask))
    assert numbers == {i: i for i in range(len(numbers))}
    assert load_camera(tmp_path / "camera.json") == IMAGES.camera


@pytest.mark.parametrize("name", ["d.npy", "d.tiff"])
def test_floats_are_metres(tmp_path, name):
    depth = np.float32([[0.5, np.nan], [0.0, 1.25]])
    np.save(tmp_path / name, depth) if name.endswith("npy") else Image.fromarray(depth).save(tmp_path / name)
    np.testing.assert_array_equal(load_depth(tmp_path / name), depth)


def test_a_mask_has_any_numbers(tmp_path):
    image = np.zeros((20, 30), np.uint8)
    image[2:6, 2:6], image[8:12, 8:12], image[14:18, 14:18] = 30, 10, 20
    Image.fromarray(image).save(tmp_path / "m.png")
    mask, numbers = load_mask(tmp_path / "m.png", 0)
    assert numbers == {10: 0, 20: 1, 30: 2}
    assert [int(mask[3, 3]), int(mask[9, 9]), int(mask[15, 15]), int(mask[0, 0])] == [2, 0, 1, -1]
    with pytest.raises(InputError, match=r"number 0 covers 92% of the image.*--background 0"):
        load_mask(tmp_path / "m.png", 255)


@pytest.mark.parametrize(
    ("load", "image", "words"),
    [
        (load_depth, np.zeros((4, 4), np.uint8), "holds uint8"),
        (load_depth, np.zeros((4, 4, 3), np.uint8), "3 channels"),
        (load_colour, np.zeros((4, 4), np.uint8), "red, green and blue"),
        (lambda path: load_mask(path, 255), np.zeros((4, 4, 3), np.uint8), "one whole number a pixel"),
        (lambda path: load_mask(path, 255), np.arange(16, dtype=np.uint8).reshape(4, 4), "names 16 objects"),
    ],
)
def test_another_image_is_refused(tmp_path, load, image, words):
    Image.fromarray(image).save(tmp_path / "image.png")
    with pytest.raises(InputError, match=rf"image\.png: .*{words}"):
        load(tmp_path / "image.png")


def changed(**changes):
    return lambda value: value | changes


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (changed(width=0), "width must be a whole number"),
        (changed(K=[1, 2]), "K must be 9 numbers"),
        (changed(D=[0.1, 0.0]), "D must have 4 or 5 or 8 numbers"),
        (changed(D=[0.1, 0.0, 0.0, 0.0]), "the lens distorts"),
        (changed(distortion_model="equidistant"), "distortion_model equidistant is not understood"),
        (changed(T_world_camera=np.eye(4).T.tolist()[:3]), "T_world_camera must be 16 numbers"),
        (lambda v: v | {"T_world_camera": np.transpose(v["T_world_camera"]).tolist()}, "transposed"),
        (lambda v: {key: part for key, part in v.items() if key != "K"}, "K is missing"),
        (changed(widht=3), "did you mean width"),
        (changed(K=[1, 0.5, 0, 0, 1, 0, 0, 0, 1]), "skewed"),
    ],
)
def test_an_impossible_camera_is_refused(tmp_path, change, words):
    path = tmp_path / "camera.json"
    save_camera(IMAGES.camera, path)
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    with pytest.raises(InputError, match=rf"camera\.json: .*{words}"):
        load_camera(path)


def test_a_camera_as_ros_writes_it(tmp_path):
    path = tmp_path / "camera.json"
    save_camera(IMAGES.camera, path)
    value = json.loads(path.read_text())
    ros = {"k": value.pop("K"), "d": value.pop("D"), "header": {"frame_id": "camera"}, "distortion_model": "plumb_bob"}
    path.write_text(json.dumps(value | ros | {"P": [0.0] * 12, "R": [0.0] * 9, "roi": {}}))
    assert load_camera(path) == IMAGES.camera
    # The centre of the first pixel is at 0 there, and at one half here.
    assert np.reshape(ros["k"], (3, 3))[0, 2] == dataclasses.asdict(IMAGES.camera)["cx"] - 0.5
