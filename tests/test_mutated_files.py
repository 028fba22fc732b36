"""Files that a user gives and that are not what they should be: taken, or refused in one line; nothing else happens."""

import contextlib
import hashlib
import io
import json
import re
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from flax.traverse_util import unflatten_dict
from mutations import bomb, damaged, mutated_archive, mutated_json, mutated_toml, seeded

from mechsearch_jax.calibration.check import placement_faults
from mechsearch_jax.calibration.fit import fit_shelf
from mechsearch_jax.calibration.report import report
from mechsearch_jax.commands import main as cli
from mechsearch_jax.images.bop import bop_image
from mechsearch_jax.images.checks import check_images
from mechsearch_jax.images.examples import Images, example_images, load_images, save_images
from mechsearch_jax.images.image_files import (
    load_camera,
    load_colour,
    load_depth,
    load_lens,
    load_mask,
    save_camera,
    save_colour,
    save_depth,
    save_mask,
)
from mechsearch_jax.images.trained_view import TrainedView
from mechsearch_jax.networks.push import PushConfig
from mechsearch_jax.networks.weights import load_weights, save_weights, weight_shapes
from mechsearch_jax.problem.settings import example_config, load_settings
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.arrays import read_arrays
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import check_name, example_scenarios, load_scenario
from mechsearch_jax.workspace.sight import check_camera

FEW, MANY = 25, 1000
# Of cameras and configurations, which are used, too.
LOOKED_THROUGH = 100
SEEN, LOOK = example_images().camera.scaled(8), example_images().depth[4::8, 4::8].copy()
SMALL = Camera(width=16, height=9, fx=7.6, fy=7.6, cx=8.0, cy=4.5)


def either(rng, data, change):
    return change(rng, data) if rng.random() < 0.7 else damaged(rng, data)


def scenario(rng, folder):
    good = example_scenarios()["first-light"].read_bytes()
    (folder / "file.json").write_bytes(either(rng, good, mutated_json))
    return lambda: load_scenario(folder / "file.json")


def config(rng, folder):
    text = re.sub(r"(?m)^#(?=\w|\]|  )", "", example_config())
    (folder / "file.toml").write_bytes(either(rng, text.encode(), mutated_toml))
    return lambda: load_settings(folder / "file.toml")


def camera(rng, folder):
    """The camera's part of a configuration file."""
    text = "[camera]\n" + "\n".join(
        f"{key} = {json.dumps(value)}" for key, value in json.loads(json.dumps(vars(SMALL))).items()
    )
    (folder / "file.toml").write_bytes(either(rng, text.encode(), mutated_toml))
    return lambda: load_settings(folder / "file.toml")


def images(rng, folder):
    """Depth, colour, mask and camera in one archive."""
    depth = np.full((9, 16), 0.7, np.float32)
    example = Images(depth, np.zeros((9, 16, 3), np.uint8), np.zeros((9, 16), np.int8), 3, SMALL)
    save_images(example, folder / "file.npz")
    good = (folder / "file.npz").read_bytes()
    (folder / "file.npz").write_bytes(either(rng, good, lambda rng, data: mutated_archive(rng, data, mutated_json)))
    return lambda: load_images(folder / "file.npz")


def weights(rng, folder):
    """An archive and its card, which may know of the damage."""
    small = PushConfig(width=4, layers=1)
    zeros = {key: np.zeros(shape, np.float32) for key, shape in weight_shapes("push", small).items()}
    save_weights(folder / "file.npz", "push", small, unflatten_dict(zeros, sep="/"), {"view": TrainedView().entry()})
    archive, card = folder / "file.npz", folder / "file.json"
    if rng.random() < 0.4:
        card.write_bytes(either(rng, card.read_bytes(), mutated_json))
    else:
        archive.write_bytes(either(rng, archive.read_bytes(), mutated_archive))
        changed = json.loads(card.read_text()) | {"sha256": hashlib.sha256(archive.read_bytes()).hexdigest()}
        card.write_text(json.dumps(changed))
    return lambda: load_weights(archive, "push")


def camera_file(rng, folder):
    """Half of them of a lens that distorts, with an image that is undistorted."""
    save_camera(SMALL, folder / "file.json", ((), (-0.2, 0.05, 0.001, 0.0, 0.01))[rng.randrange(2)])
    (folder / "file.json").write_bytes(either(rng, (folder / "file.json").read_bytes(), mutated_json))

    def load():
        lens = load_lens(folder / "file.json")
        if max(lens.camera.width, lens.camera.height) < 100:
            lens.depth(np.ones((lens.camera.height, lens.camera.width), np.float32))

    return load


def scene(rng, folder):
    """The cameras of a BOP scene."""
    (folder / "depth").mkdir()
    save_depth(np.ones((9, 16), np.float32), folder / "depth" / "000003.png")
    pose = {"cam_R_w2c": np.eye(3).ravel().tolist(), "cam_t_w2c": [0.0, 1.0, 2.0]}
    good = {"3": {"cam_K": [9.0, 0.0, 8.0, 0.0, 9.0, 4.0, 0.0, 0.0, 1.0], "depth_scale": 0.5, **pose}}
    (folder / "scene_camera.json").write_bytes(either(rng, json.dumps(good).encode(), mutated_json))
    return lambda: bop_image(folder, 3)


def picture(rng, folder):
    """A depth or colour image or a mask, as another one or with its bytes changed."""
    kind = ("depth", "colour", "mask")[rng.randrange(3)]
    path = folder / ("file.png", "file.npy")[rng.randrange(2)]
    if path.suffix == ".npy":
        shape = ((9, 16), (9, 16, 3), (0, 4), (9,), (1, 2, 3, 4))[rng.randrange(5)]
        np.save(path, np.full(shape, 1, (np.float32, np.uint16, np.int8, bool, "U3", complex)[rng.randrange(6)]))
    else:
        saves = (
            lambda: save_depth(np.ones((9, 16), np.float32), path),
            lambda: save_colour(np.ones((9, 16, 3), np.uint8), path),
            lambda: save_mask(np.ones((9, 16), np.int8), path),
        )
        saves[rng.randrange(3)]()
    if rng.random() < 0.7:
        path.write_bytes(damaged(rng, path.read_bytes()))
    load = {"depth": load_depth, "colour": load_colour, "mask": lambda path: load_mask(path, 255)}[kind]
    return lambda: load(path)


KINDS = {kind.__name__: kind for kind in (scenario, config, camera, camera_file, scene, images, picture, weights)}


def check(kind, number, folder):
    """Try one mutation; whether it was taken."""
    inside = folder / str(number)
    inside.mkdir()
    load = KINDS[kind](seeded(kind, number), inside)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            load()
        except InputError as error:
            message = str(error)
            assert message.startswith(str(inside)), message
            assert len(message.splitlines()) == 1, message
            assert len(message) < 600, message
            taken = False
        else:
            taken = True
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    shutil.rmtree(inside)
    return taken


@pytest.mark.parametrize("kind", KINDS)
def test_mutated_files_are_taken_or_refused_in_one_line(kind, tmp_path):
    taken = sum(check(kind, number, tmp_path) for number in range(FEW))
    assert taken < FEW


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_thousand_mutated_files_are_taken_or_refused_in_one_line(kind, tmp_path):
    taken = sum(check(kind, number, tmp_path) for number in range(FEW, FEW + MANY))
    assert 0 < taken < MANY


def used(kind, number, folder):
    """Read a mutated camera or configuration and look through it at the example; whether nothing was refused."""
    inside = folder / str(number)
    inside.mkdir()
    load = (
        (lambda: Workcell(camera=load_camera(mutated))) if kind == "camera" else lambda: load_settings(mutated).workcell
    )
    rng = seeded(f"used {kind}", number)
    if kind == "camera":
        mutated = inside / "file.json"
        save_camera(SEEN, mutated)
        mutated.write_bytes(either(rng, mutated.read_bytes(), mutated_json))
    else:
        mutated = inside / "file.toml"
        text = re.sub(r"(?m)^#(?=\w|\]|  )", "", example_config())
        for key, value in json.loads(json.dumps(vars(SEEN))).items():
            text = re.sub(rf"(?m)^{key} = (\[\n(  .*\n)*\]|.*)$", f"{key} = {json.dumps(value)}", text, count=1)
        mutated.write_bytes(either(rng, text.encode(), mutated_toml))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            cell = load()
            check_camera(cell.camera, cell.shelf)
            check_images(cell.camera, LOOK)
            placement_faults(cell.camera, cell.shelf, LOOK, cell.calibration)
            fit = fit_shelf(cell.camera, cell.shelf, LOOK)
            assert report(fit, "camera")
            assert np.isfinite(fit.corrected.position).all()
        except InputError as error:
            message = str(error)
        else:
            return True
    assert len(message.splitlines()) == 1, message
    return False


@pytest.mark.parametrize("kind", ["camera", "configuration"])
def test_mutated_cameras_and_configurations_are_looked_through_or_refused(kind, tmp_path):
    taken = sum(used(kind, number, tmp_path) for number in range(LOOKED_THROUGH))
    assert 0 < taken < LOOKED_THROUGH


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["camera", "configuration"])
def test_a_thousand_mutated_cameras_and_configurations_are_looked_through_or_refused(kind, tmp_path):
    taken = sum(used(kind, number, tmp_path) for number in range(LOOKED_THROUGH, LOOKED_THROUGH + MANY))
    assert 0 < taken < MANY


def program(monkeypatch, *arguments):
    """Run the command line in this process; its status and what it wrote to standard error."""
    monkeypatch.setattr("sys.argv", ["mechsearch", *arguments])
    stderr = io.StringIO()
    with contextlib.redirect_stderr(stderr), contextlib.redirect_stdout(io.StringIO()):
        try:
            cli.main()
        except SystemExit as end:
            return end.code, stderr.getvalue()
    return 0, stderr.getvalue()


def check_command(number, folder, monkeypatch):
    inside = folder / str(number)
    inside.mkdir()
    rng = seeded("command", number)
    scenario(rng, inside)
    settings = ("--config", str(inside / "file.toml")) if config(rng, inside) and rng.random() < 0.5 else ()
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    status, message = program(monkeypatch, "scenarios", "check", str(inside / "file.json"), *settings)
    assert status in (0, 2)
    lines = message.splitlines()
    # What does not stand by itself is named in a line of its own.
    each = rf"{re.escape(str(inside))}/file\.json: (objects\[\d\]|target): (is .* inside|moves by) "
    assert bool(status) == bool(lines)
    assert len(lines) <= 1 or all(re.match(each, line) for line in lines), message
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    shutil.rmtree(inside)


def test_the_command_line_ends_with_one_line(tmp_path, monkeypatch):
    for number in range(FEW):
        check_command(number, tmp_path, monkeypatch)


@pytest.mark.slow
def test_the_command_line_ends_with_one_line_a_thousand_times(tmp_path, monkeypatch):
    for number in range(FEW, FEW + MANY):
        check_command(number, tmp_path, monkeypatch)


def test_a_name_is_no_path(tmp_path, monkeypatch):
    for name in ("..", ".", "/tmp/x", "a/b", "", "x" * 200, "a\nb", "a\0", "\ud800", 3, None):
        with pytest.raises(InputError, match="name: must be a text"):
            check_name(name, "file: name")
    value = json.loads(example_scenarios()["first-light"].read_text())
    (tmp_path / "bad.json").write_text(json.dumps(value | {"name": "../../x"}))
    status, message = program(monkeypatch, "scenarios", "check", str(tmp_path / "bad.json"))
    assert (status, len(message.splitlines())) == (2, 1), message
    assert "name: must be a text" in message
    assert [path.name for path in tmp_path.iterdir()] == ["bad.json"]


def test_two_scenarios_of_one_name_do_not_overwrite_each_others_maps(tmp_path, monkeypatch):
    text = example_scenarios()["first-light"].read_text()
    for name in ("a.json", "b.json"):
        (tmp_path / name).write_text(text)
    status, message = program(monkeypatch, "inspect", str(tmp_path), "--out", str(tmp_path / "out"))
    assert status == 2
    assert "two scenes, and their maps, are called first-light" in message


def test_an_archive_that_unpacks_to_too_much_is_refused():
    assert len(bomb()) < 2**15
    with pytest.raises(InputError, match=r"bomb\.npz: unpacks to 16777216 bytes; at most 1048576"):
        read_arrays(bomb(), "bomb.npz", 2**20)


def test_a_path_that_is_none_is_one_line(tmp_path, monkeypatch):
    for name in ("x" * 5000, "a" * 300 + ".json", "/dev/null/x", str(Path(tmp_path) / ("y" * 256))):
        status, message = program(monkeypatch, "inspect", name, "--out", str(tmp_path / "out"))
        assert (status, len(message.splitlines())) == (2, 1), message
