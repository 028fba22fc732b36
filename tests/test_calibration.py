"""Where the shelf is in a depth image: what is found again, what is left alone, what is said, and what is written."""

import dataclasses
import json
import tomllib

import numpy as np
import pytest
from test_mutated_files import program

from mechsearch_jax.calibration.check import check_holds, check_in_sight, placement_faults
from mechsearch_jax.calibration.fit import FEW_PIXELS, LEVER, fit_shelf
from mechsearch_jax.calibration.limits import CalibrationLimits
from mechsearch_jax.calibration.report import correction, report
from mechsearch_jax.commands import main as cli
from mechsearch_jax.commands.cell.calibrate import _write_values
from mechsearch_jax.images.camera_pose import with_pose
from mechsearch_jax.images.examples import example_images
from mechsearch_jax.images.image_files import load_camera, load_lens, save_camera, save_depth
from mechsearch_jax.problem.settings import load_settings
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.tables import with_values
from mechsearch_jax.workspace.camera import rays
from mechsearch_jax.workspace.shelf import Shelf

IMAGES, SHELF = example_images(), Shelf()
PLACES = ("front", "back", "right", "left", "board", "ceiling")
CAMERA, DEPTH = IMAGES.camera, IMAGES.depth


def turned(axis, angle):
    """A rotation by Rodrigues' formula."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * across + (1 - np.cos(angle)) * across @ across


def off_by(shift, axis=(0.0, 0.0, 1.0), degrees=0.0):
    """The camera as it is wrongly taken to be."""
    T = np.eye(4)
    T[:3, :3] = turned(axis, np.radians(degrees)) @ np.array(CAMERA.rotation)
    T[:3, 3] = np.add(CAMERA.position, shift)
    return with_pose(CAMERA, T)


def cell(folder, shelf=SHELF):
    """The arguments of a configuration that says where a shelf is."""
    file = folder / "cell.toml"
    file.write_text("[shelf]\n" + "".join(f"{name} = {getattr(shelf, name)}\n" for name in PLACES))
    return "--config", str(file)


def between(camera, other):
    """Distance [m] and angle [degrees] between two cameras."""
    cosine = (np.trace(np.array(camera.rotation) @ np.array(other.rotation).T) - 1) / 2
    return np.linalg.norm(np.subtract(camera.position, other.position)), np.degrees(np.arccos(min(cosine, 1.0)))


def board_alone():
    """The example's depth where it shows the board."""
    points = np.array(CAMERA.position) + DEPTH[..., None] * np.asarray(rays(CAMERA))
    x, y, z = np.moveaxis(points, -1, 0)
    clear = (x < SHELF.back - 0.02) & (y > SHELF.right + 0.02) & (y < SHELF.left - 0.02)
    return np.where((np.abs(z - SHELF.board) < 0.01) & clear, DEPTH, 0.0).astype(np.float32)


@pytest.mark.parametrize("pixels", [1_000_000, FEW_PIXELS])
@pytest.mark.parametrize(
    ("shift", "axis", "degrees"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.0),
        ((0.012, -0.009, 0.013), (1.0, 2.0, -1.0), 3.0),
        ((-0.02, 0.0, 0.0), (0.0, 1.0, 0.0), 2.0),
        ((0.0, 0.05, -0.05), (0.3, -0.2, 1.0), 8.0),
    ],
)
def test_where_the_camera_is_is_found_again(shift, axis, degrees, pixels):
    fit = fit_shelf(off_by(shift, axis, degrees), SHELF, DEPTH, pixels)
    distance, angle = between(fit.corrected, CAMERA)
    assert distance < 0.002
    assert angle < 0.15
    assert fit.undetermined.shape == (6, 0)


def test_a_board_alone_tells_of_height_and_tilt_only():
    taken = off_by((0.01, 0.01, 0.01), (1.0, 1.0, 0.0), 1.0)
    fit = fit_shelf(taken, SHELF, board_alone())
    _, _, determined = correction(fit, "shelf")
    assert determined.tolist() == [[False, False, True], [True, True, False]]
    # Sliding along the board and turning on it stay as they are.
    assert np.abs(fit.shift[:2]).max() < 1e-4
    assert abs(LEVER * fit.turn[2]) < 1e-4
    points = np.array(fit.corrected.position) + DEPTH[..., None] * np.asarray(rays(fit.corrected))
    heights = points[board_alone() > 0][:, 2] - SHELF.board
    assert abs(np.median(heights)) < 0.001


def spoilt(share, values):
    """The example's depth with a share of its pixels scattered over it replaced by others [m]."""
    rng = np.random.default_rng(0)
    hit = (rng.random(DEPTH.shape) < share) & (DEPTH > 0)
    return np.where(hit, rng.uniform(*values, DEPTH.shape), DEPTH).astype(np.float32)


@pytest.mark.parametrize("values", [(65.535, 65.536), (100.0, 100.1), (-1.0, 0.0), (0.2, 4.0)])
@pytest.mark.parametrize("pixels", [10**6, FEW_PIXELS])
def test_pixels_that_are_far_off_move_nothing(values, pixels):
    fit = fit_shelf(CAMERA, SHELF, spoilt(0.1, values), pixels)
    distance, angle = between(fit.corrected, fit_shelf(CAMERA, SHELF, DEPTH, pixels).corrected)
    assert distance < 0.0005
    assert angle < 0.05
    check_holds(fit, SHELF, spoilt(0.1, values))


@pytest.mark.parametrize(
    ("depth", "words"),
    [
        (spoilt(0.3, (0.2, 4.0)), "25% of what it shows through the shelf's opening is behind the shelf's faces"),
        (DEPTH[:, ::-1].copy(), "28% of what it shows through the shelf's opening is behind the shelf's faces"),
        (1.05 * DEPTH, "the upper board stays 18 mm outside of its place"),
        (DEPTH[::-1, ::-1].copy(), "is upside down"),
    ],
)
def test_a_camera_is_not_corrected_by_a_fit_that_does_not_hold(depth, words, tmp_path, monkeypatch):
    np.save(tmp_path / "depth.npy", depth)
    save_camera(CAMERA, tmp_path / "camera.json")
    files = ("--depth", str(tmp_path / "depth.npy"), "--camera", str(tmp_path / "camera.json"), *cell(tmp_path))
    (tmp_path / "out.json").write_text("mine")
    code, said = program(monkeypatch, "calibrate", *files, "--out", str(tmp_path / "out.json"))
    assert code != 0
    assert words in said
    assert len(said.strip().splitlines()) == 1
    assert (tmp_path / "out.json").read_text() == "mine"


def test_an_image_upside_down_for_its_camera_is_told_from_a_camera_that_hangs_upside_down():
    hanging = off_by((0.0, 0.0, 0.0), np.array(CAMERA.rotation)[:, 2], 180.0)
    upside_down = DEPTH[::-1, ::-1].copy()
    assert placement_faults(hanging, SHELF, upside_down, CalibrationLimits()) == ()
    for camera, depth in ((CAMERA, upside_down), (hanging, DEPTH)):
        with pytest.raises(InputError, match=r"is upside down for this pose.*turn the images.*or the pose.*not both"):
            placement_faults(camera, SHELF, depth, CalibrationLimits())


def test_nothing_of_the_shelf_in_sight_is_said():
    fit = fit_shelf(CAMERA, SHELF, np.zeros_like(DEPTH))
    assert np.abs(fit.shift).max() == np.abs(fit.turn).max() == 0.0
    with pytest.raises(InputError, match="depth image: shows no face of the shelf"):
        check_in_sight(fit, SHELF, np.zeros_like(DEPTH))


def test_a_wrong_measure_of_the_shelf_is_no_pose():
    low = dataclasses.replace(SHELF, ceiling=SHELF.ceiling - 0.02)
    fit = fit_shelf(CAMERA, low, DEPTH)
    assert np.abs(fit.shift).max() < 0.001
    assert "warning: shelf.ceiling: the upper board is 20 mm outside of its place" in report(fit, "camera")
    assert "warning" not in report(fit_shelf(CAMERA, SHELF, DEPTH), "camera")


def test_a_look_warns_and_then_refuses():
    limits = CalibrationLimits()
    assert placement_faults(CAMERA, SHELF, DEPTH, limits) == ()
    assert placement_faults(off_by((0.001, 0.0, 0.001), degrees=0.02), SHELF, DEPTH, limits) == ()
    (fault,) = placement_faults(off_by((0.0, 0.0, 0.006)), SHELF, DEPTH, limits)
    assert fault.startswith("camera or shelf: in the depth image the shelf is up to 6 mm and 0.0 degrees from where")
    assert "mechsearch calibrate" in fault
    with pytest.raises(InputError, match=r"the shelf is up to 60 mm .* too far to go on.*mechsearch calibrate"):
        placement_faults(off_by((0.0, 0.0, 0.06)), SHELF, DEPTH, limits)
    lax = CalibrationLimits(warn_shift=0.5, warn_turn=1.0, refuse_shift=0.5, refuse_turn=1.0)
    assert placement_faults(off_by((0.0, 0.0, 0.06)), SHELF, DEPTH, lax) == ()
    with pytest.raises(InputError, match=r"refuse_shift \(0.001\) must be at least warn_shift"):
        CalibrationLimits(refuse_shift=0.001)


@pytest.mark.parametrize("change", [0.012, -0.012])
def test_a_look_warns_of_a_face_that_is_not_where_the_others_put_it(change):
    wrong = dataclasses.replace(SHELF, ceiling=SHELF.ceiling + change)
    (fault,) = placement_faults(CAMERA, wrong, DEPTH, CalibrationLimits())
    side = "inside" if change > 0 else "outside"
    assert fault.startswith(f"depth image: the upper board is 12 mm {side} of shelf.ceiling")
    assert placement_faults(CAMERA, wrong, DEPTH, CalibrationLimits(warn_shift=0.02, refuse_shift=0.02)) == ()


def test_a_camera_file_is_corrected(tmp_path, monkeypatch, capsys):
    save_depth(DEPTH, tmp_path / "depth.png")
    save_camera(off_by((0.01, -0.01, 0.01), degrees=1.0), tmp_path / "camera.json")
    files = ("--depth", str(tmp_path / "depth.png"), "--camera", str(tmp_path / "camera.json"), *cell(tmp_path))
    for name in ("new.json", "new.toml"):
        status, message = program(monkeypatch, "calibrate", *files, "--out", str(tmp_path / name))
        assert (status, message) == (0, "")
    assert between(load_camera(tmp_path / "new.json"), CAMERA)[0] < 0.002
    other = load_settings(tmp_path / "new.toml").workcell.camera
    assert between(other, CAMERA)[0] < 0.002
    assert (other.width, other.fx) == (CAMERA.width, CAMERA.fx)
    status, message = program(monkeypatch, "calibrate", *files, "--out", str(tmp_path / "new.txt"))
    assert (status, message.splitlines()) == (
        2,
        [f"mechsearch: calibrate: --out {tmp_path}/new.txt must end in .toml or .json"],
    )


def test_without_a_shelf_of_its_own_nothing_is_measured(tmp_path, monkeypatch, capsys):
    save_depth(DEPTH, tmp_path / "depth.png")
    save_camera(CAMERA, tmp_path / "camera.json")
    (tmp_path / "mine.toml").write_text("[shelf]\nfront = 0.414\n")
    (tmp_path / "out.json").write_text("mine")
    files = ("--depth", str(tmp_path / "depth.png"), "--camera", str(tmp_path / "camera.json"))
    arguments = (*files, "--out", str(tmp_path / "out.json"))
    for config, words in (
        ((), "there is no --config"),
        (("--config", str(tmp_path / "mine.toml")), "has no back, right"),
    ):
        status, message = program(monkeypatch, "calibrate", *arguments, *config)
        assert (status, words in message, len(message.splitlines())) == (2, True, 1)
    assert (tmp_path / "out.json").read_text() == "mine"
    cli.parse(["calibrate", *files, *cell(tmp_path)])()
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith(f"{tmp_path / 'cell.toml'}: the shelf in the robot's frame: front 0.414, back 0.788")


def test_images_of_a_lens_that_distorts_are_undistorted_and_the_lens_is_kept(tmp_path, monkeypatch):
    D = (-0.12, 0.02, 0.001, -0.0005, 0.0)
    save_depth(raw(DEPTH, CAMERA, D), tmp_path / "depth.png")
    save_camera(off_by((0.01, -0.01, 0.01), degrees=1.0), tmp_path / "camera.json", D)
    files = ("--depth", str(tmp_path / "depth.png"), "--camera", str(tmp_path / "camera.json"), *cell(tmp_path))
    assert program(monkeypatch, "calibrate", *files, "--out", str(tmp_path / "new.json")) == (0, "")
    lens = load_lens(tmp_path / "new.json")
    assert lens.distortion == D
    assert between(lens.camera, CAMERA)[0] < 0.003
    status, message = program(monkeypatch, "calibrate", *files, "--out", str(tmp_path / "new.toml"))
    assert status == 2
    assert "distorts, and a configuration has none; give --out FILE.json" in message


def raw(image, camera, D):
    """What a lens makes of a pinhole camera's image, its inverse found by iteration."""
    k1, k2, p1, p2, k3 = D
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    x = u = (columns - camera.cx) / camera.fx
    y = v = (rows - camera.cy) / camera.fy
    for _ in range(50):
        s = x * x + y * y
        radial = 1 + k1 * s + k2 * s**2 + k3 * s**3
        x, y = (
            (u - 2 * p1 * x * y - p2 * (s + 2 * x * x)) / radial,
            (v - p1 * (s + 2 * y * y) - 2 * p2 * x * y) / radial,
        )
    row, column = np.floor(y * camera.fy + camera.cy).astype(int), np.floor(x * camera.fx + camera.cx).astype(int)
    inside = (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
    found = image[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)]
    return np.where(inside.reshape(inside.shape + (1,) * (image.ndim - 2)), found, 0).astype(image.dtype)


CONFIG = """# My cell.
[base]
position = [0.1, 0.0, -0.2]  # on a table

[camera]
rotation = [
{rows}
]
position = {position}

[planner]
gamma = 0.8  # stays
"""


def test_a_configuration_is_corrected_and_its_comments_stay(tmp_path, monkeypatch):
    save_depth(DEPTH, tmp_path / "depth.png")
    taken = off_by((0.01, -0.01, 0.01), degrees=1.0)
    rows = ",\n".join(f"  {json.dumps(row)}" for row in taken.rotation)
    position = np.add(taken.position, (0.1, 0.0, -0.2)).tolist()
    # The shelf's place is in the file's frame, too.
    shelf = SHELF.moved((0.1, 0.0, -0.2))
    places = {name: getattr(shelf, name) for name in PLACES}
    table = "[shelf]\n" + "".join(f"{name} = {value}\n" for name, value in places.items())
    ranges = f"spawn_x = {list(shelf.spawn_x)}\nspawn_y = {list(shelf.spawn_y)}\n"
    config = CONFIG.format(rows=rows, position=position) + "\n" + table + ranges
    (tmp_path / "mine.toml").write_text(config)
    files = ("--depth", str(tmp_path / "depth.png"), "--config", str(tmp_path / "mine.toml"))
    assert program(monkeypatch, "calibrate", *files, "--out", str(tmp_path / "new.toml")) == (0, "")
    text = (tmp_path / "new.toml").read_text()
    assert "# My cell." in text
    assert "gamma = 0.8  # stays" in text
    loaded = load_settings(tmp_path / "new.toml")
    distance, angle = between(loaded.workcell.camera, CAMERA)
    assert distance < 0.002
    assert angle < 0.15
    before, after = tomllib.loads(config), tomllib.loads(text)
    assert {name: part for name, part in after.items() if name != "camera"} == {
        name: part for name, part in before.items() if name != "camera"
    }


def test_a_correction_that_cannot_be_read_leaves_the_file_as_it_was(tmp_path):
    out = tmp_path / "mine.toml"
    out.write_text("# My cell.\n")
    with pytest.raises(InputError, match="front") as error:
        _write_values(out, out, "shelf", {"front": 414.0})
    assert str(error.value).startswith(f"{out}:4: [shelf] front")
    assert str(error.value).endswith("was not written")
    assert [file.read_text() for file in tmp_path.iterdir()] == ["# My cell.\n"]


def test_the_place_of_the_shelf_is_corrected(tmp_path, monkeypatch):
    save_depth(DEPTH, tmp_path / "depth.png")
    save_camera(CAMERA, tmp_path / "camera.json")
    wrong = SHELF.moved((0.01, -0.015, 0.008))
    files = ("--depth", str(tmp_path / "depth.png"), "--camera", str(tmp_path / "camera.json"), *cell(tmp_path, wrong))
    arguments = (*files, "--moved", "shelf", "--out", str(tmp_path / "new.toml"))
    assert program(monkeypatch, "calibrate", *arguments) == (0, "")
    corrected = load_settings(tmp_path / "new.toml").workcell.shelf
    assert all(getattr(corrected, name) == pytest.approx(getattr(SHELF, name), abs=0.001) for name in PLACES)


@pytest.mark.parametrize(
    ("text", "after"),
    [
        ("", "[a]\nb = [1, 2]\n"),
        ("# x\n", "# x\n\n[a]\nb = [1, 2]\n"),
        ("[a]\nc = 1 # y\nb = [\n  3,\n]\n[d]\n", "[a]\nb = [1, 2]\nc = 1 # y\n[d]\n"),
    ],
)
def test_a_table_is_changed_and_the_rest_stays(text, after):
    assert with_values(text, "a", {"b": [1, 2]}, "f.toml") == after


@pytest.mark.parametrize("text", ["a = {b = 1}\n", "a.b = 1\n", "[[a]]\n", "[a\n", "a = 3\n"])
def test_a_table_that_is_not_plain_is_refused(text):
    with pytest.raises(InputError, match=r"f\.toml: cannot be changed; write \[a\]"):
        with_values(text, "a", {"b": [1, 2]}, "f.toml")
