"""Images of a user in files: depth, colour, masks, cameras, BOP scenes and bags."""

import dataclasses
import json
import types

import numpy as np
import pytest
from PIL import Image
from test_mutated_files import program

from mechsearch_jax.commands import plan
from mechsearch_jax.images.bop import bop_image, bop_images
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
from mechsearch_jax.images.labels import OTHER
from mechsearch_jax.runtime.errors import InputError, Note
from mechsearch_jax.workspace.camera import Camera

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


H, W = 30, 40
K = [50.0, 0.0, 19.5, 0.0, 51.0, 14.5, 0.0, 0.0, 1.0]
# The world in the camera: turned by 90 degrees about z, and moved.
POSE = {"cam_R_w2c": [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0], "cam_t_w2c": [100.0, -200.0, 700.0]}


def scene(folder, entries, masks=2, colour="rgb"):
    """A scene with an image for each entry, and masks of falling size."""
    folder.mkdir(exist_ok=True)
    (folder / "scene_camera.json").write_text(json.dumps(entries))
    for name in ("depth", "rgb", "gray", "mask_visib"):
        (folder / name).mkdir(exist_ok=True)
    for i in map(int, entries):
        Image.fromarray(np.full((H, W), 7000 + i, np.uint16)).save(folder / "depth" / f"{i:06d}.png")
        picture = np.full((H, W, 3) if colour == "rgb" else (H, W), i, np.uint8)
        Image.fromarray(picture).save(folder / colour / f"{i:06d}.png")
        for j in range(masks):
            mask = np.zeros((H, W), np.uint8)
            mask[j, : W - j] = 255
            Image.fromarray(mask).save(folder / "mask_visib" / f"{i:06d}_{j:06d}.png")
    return folder


def test_images_masks_and_camera_of_a_scene(tmp_path):
    folder = scene(tmp_path, {"12": {"cam_K": K, "depth_scale": 0.1, **POSE}, "3": {"cam_K": K, **POSE}})
    images = bop_images(folder)
    assert isinstance(images, types.GeneratorType)
    first, second = images
    np.testing.assert_allclose(first.depth, 7.003, rtol=1e-6)
    np.testing.assert_allclose(second.depth, 0.7012, rtol=1e-6)
    assert (first.colour == 3).all()
    assert first.depth.dtype == np.float32
    assert [int((first.mask == i).sum()) for i in range(2)] == [W, W - 1]
    assert first.mask[2:].max() == OTHER
    assert first.target_id is None
    # A point of the world is where OpenCV's projection by the file puts it; the first pixel's centre is at 0 there.
    R, t, point = np.reshape(POSE["cam_R_w2c"], (3, 3)), np.array(POSE["cam_t_w2c"]), np.array([210.0, -90.0, 40.0])
    u, v, w = np.reshape(K, (3, 3)) @ (R @ point + t)
    camera = first.camera
    x, y, z = np.array(camera.rotation).T @ (point / 1000 - np.array(camera.position))
    assert (camera.width, camera.height) == (W, H)
    np.testing.assert_allclose(camera.fx * x / z + camera.cx - 0.5, u / w, rtol=1e-9)
    np.testing.assert_allclose(camera.fy * y / z + camera.cy - 0.5, v / w, rtol=1e-9)
    np.testing.assert_allclose(z, w / 1000, rtol=1e-9)


def test_of_too_many_objects_the_largest_and_the_target_stay(tmp_path):
    folder = scene(tmp_path, {"0": {"cam_K": K, **POSE}}, masks=12)
    with pytest.warns(Note, match="shows 12 objects; the 3 smallest are left out"):
        images = bop_image(folder)
    assert images.mask.max() == 8
    assert (images.mask[9:] == OTHER).all()
    with pytest.warns(Note, match="the 3 smallest are left out"):
        images = bop_image(folder, target=11)
    assert images.target_id == 8
    assert (images.mask[11] == 8).any()
    assert (images.mask[8] == OTHER).all()
    with (
        pytest.warns(Note, match="no mask that shows the target's number 40"),
        pytest.warns(Note, match="3 smallest are left out"),
    ):
        assert bop_image(folder, target=40).target_id == -1


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"cam_K": K}, r"image 5: has no cam_R_w2c and cam_t_w2c.*in \[camera\] of --config"),
        ({**POSE}, "image 5: cam_K is missing"),
        ({"cam_K": K[:4], **POSE}, "image 5: cam_K must be 9 numbers"),
        ({"cam_K": K, "depth_scale": "mm", **POSE}, "depth_scale must be a number"),
        ({"cam_K": K, "depth_scale": 0, **POSE}, "depth_scale 0 must be more than 0"),
        ({"cam_K": K, **POSE, "cam_R_w2c": [1.0] * 9}, "rotation must be a rotation matrix"),
        ([], "must hold an object for each image"),
    ],
)
def test_a_scene_that_cannot_be_used_is_refused_in_one_line(tmp_path, entry, words):
    with pytest.raises(InputError, match=rf"scene_camera\.json.*{words}") as refused:
        bop_image(scene(tmp_path, {"5": entry}), 5)
    assert len(str(refused.value).splitlines()) == 1


def test_plan_takes_a_scene_and_the_configuration_says_where_the_base_is(tmp_path, monkeypatch):
    folder, config = scene(tmp_path / "scene", {"0": {"cam_K": K, **POSE}, "1": {"cam_K": K}}), tmp_path / "mine.toml"
    config.write_text("[base]\nposition = [0.5, 0.25, 0.0]\n")
    given = Camera().moved((-0.5, -0.25, 0.0))
    files = plan.ImageFiles(bop=folder, image=0, target_id=1)
    files.check()
    images, camera, _ = files.load(config, given)
    assert sorted(images) == ["colour", "depth", "mask", "target_id"]
    assert images["target_id"] == 1
    own = bop_image(folder, 0).camera
    np.testing.assert_allclose(camera.position, np.array(own.position) - (0.5, 0.25, 0.0), atol=1e-12)
    # The second has no pose of its own.
    _, camera, _ = plan.ImageFiles(bop=folder, image=1).load(config, given)
    np.testing.assert_allclose(camera.position, given.position, atol=1e-12)
    assert (camera.rotation, camera.fx) == (given.rotation, 50.0)
    status, message = program(monkeypatch, "plan", "--bop", str(folder), "--image", "1", "--out", str(tmp_path / "out"))
    assert status == 2
    assert "say so in [camera] of --config" in message
    assert len(message.splitlines()) == 1
