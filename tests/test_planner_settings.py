"""Configuration files: what they say, what goes before them, and what is wrong in them."""

import dataclasses
import math
import os
import re
import types

import numpy as np
import pytest
import trimesh

from mechsearch_jax.commands import main as cli
from mechsearch_jax.envs.cell import loading as cell
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.trials.named import named_trials
from mechsearch_jax.images.colour import TargetColour
from mechsearch_jax.images.examples import example_images
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.problem import settings
from mechsearch_jax.problem.settings import Settings, load_settings
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime import tables
from mechsearch_jax.runtime.compiled import _KEEPING
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.searcher import Searcher
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target


def load(tmp_path, text):
    (tmp_path / "mine.toml").write_text(text)
    return load_settings(tmp_path / "mine.toml")


def test_the_example_holds_every_key_with_its_default(tmp_path):
    text = settings.example_config()
    assert load(tmp_path, text) == Settings()
    (tmp_path / "all.toml").write_text(re.sub(r"(?m)^#(?=\w|\]|  )", "", text))
    tables_in_file = tables.read_document(tmp_path / "all.toml").tables
    assert {name: list(keys) for name, keys in tables_in_file.items() if name} == {
        name: list(keys) for name, keys in settings.tables().items()
    }
    loaded = load_settings(tmp_path / "all.toml")
    assert dataclasses.replace(loaded, given={}) == Settings()
    assert loaded.config == Settings().config == PRESETS["standard"]()


def test_what_is_given_goes_where_it_belongs(tmp_path):
    loaded = load(
        tmp_path,
        """
[camera]
width = 848
height = 480
position = [0, 0.4, 0.7]
[shelf]
front = 0.9
back = 1.3
[target]
shape = "box"
half_size = [0.02, 0.025, 0.06]
inset = 0.04
[objects]
boxes = [[0.1, 0.1, 0.1]]
cylinders = []
[planner]
preset = "paper"
gamma = 1
push_distances = [0.1]
""",
    )
    assert loaded.workcell.camera == dataclasses.replace(Camera(), width=848, height=480, position=(0.0, 0.4, 0.7))
    assert loaded.workcell.shelf == dataclasses.replace(Shelf(), front=0.9, back=1.3)
    assert loaded.workcell.target == dataclasses.replace(Target.box(), half_size=(0.02, 0.025, 0.06), inset=0.04)
    assert loaded.objects.catalogue == (("box", (0.05, 0.05, 0.05)),)
    assert loaded.config == PRESETS["paper"](gamma=1.0, push_distances=(0.1,))
    assert isinstance(loaded.config.planner.gamma, float)


def test_a_robot_that_stands_elsewhere_sees_camera_and_shelf_from_there(tmp_path):
    where = "[base]\nposition = [0.5, -0.25, 0.125]\n[shelf]\nfront = 1.0\nback = 1.5\n"
    workcell = load(tmp_path, where).workcell
    assert (workcell.shelf.front, workcell.shelf.back) == (0.5, 1.0)
    assert workcell.shelf.board == Shelf().board - 0.125
    assert (workcell.shelf.left, workcell.shelf.spawn_y[1]) == (Shelf().left + 0.25, Shelf().spawn_y[1] + 0.25)
    np.testing.assert_allclose(
        np.subtract(workcell.camera.position, Camera().position), (-0.5, 0.25, -0.125), atol=1e-12
    )
    assert workcell.camera.rotation == Camera().rotation
    assert load(tmp_path, "[base]\nposition = [0, 0, 0]").workcell == Workcell()


def test_the_targets_place_is_in_the_frame_of_the_shelf_but_joint_angles_are_not(tmp_path):
    shelf = "[shelf]\nfront = 5.414\nback = 5.788\nspawn_x = [5.45, 5.73]\n"
    base = f"{shelf}[base]\nposition = [5, -0.25, 0.125]\n[arm]\nplace = "
    assert load(tmp_path, base + "[5.4, -0.5, 0.2]").workcell.arm.place == (0.4, -0.25, 0.075)
    angles = Workcell().arm.home
    assert load(tmp_path, base + str(list(angles))).workcell.arm.place == angles
    assert load(tmp_path, base + "[]").workcell.arm.place == ()
    assert load(tmp_path, "[arm]\nplace = [0.4, -0.5, 0]").workcell.arm.place == (0.4, -0.5, 0.0)


def test_the_colour_of_the_target_is_the_recognisers_and_not_the_problems(tmp_path):
    workcell = load(tmp_path, '[target]\nshape = "box"\ncolour = [0, 0.2, 1]').workcell
    assert workcell == Workcell(target=Target.box(), colour=(0.0, 0.2, 1.0))
    assert workcell.detector == TargetColour.lit((0.0, 0.2, 1.0))
    assert load(tmp_path, "[target]\ncolour = [0, 0.2, 1]").workcell.target == Target()
    hue = load(tmp_path, "[target]\ncolour = {hue = 240, saturation = 0.8}\nhue_tolerance = 20").workcell
    np.testing.assert_allclose(hue.colour, (0.2, 0.2, 1.0))
    assert hue.detector == TargetColour.lit(hue.colour, 20.0)
    setting = types.SimpleNamespace(camera=Camera(), shelf=Shelf(), target=Target())
    searcher = Searcher(workcell)
    searcher.problem = setting
    assert searcher.recogniser.core.detector.func == workcell.detector


WRONG = {
    "[target]\ncolour = [255, 0, 0]": ":2: [target] colour (255.0, 0.0, 0.0) must be red, green and blue, each",
    "[target]\n\ncolour = [1, 1, 1]": ":3: [target] colour (1.0, 1.0, 1.0) is white, grey or black, or nearly so",
    "[target]\ncolour = {hue = 40, saturation = 0.1}": ":2: [target] colour saturation 0.1 is too grey",
    "[target]\ncolour = {hue = 400, saturation = 1}": ":2: [target] colour: hue (400.0) must be from 0 to 360 degrees",
    "[target]\ncolour = {hue = 40}": ":2: [target] colour must be red, green and blue, or {hue = DEGREES",
    "[target]\nhue_tolerance = 90": ":2: [target] hue_tolerance (90.0) must be from 1 to 60 degrees",
    "[target]\ncolour = [1, 1]": ":2: [target] colour must be a list of 3, not of 2",
    "[target]\ncolor = [1, 0, 0]": ":2: [target] color is called colour now",
    "[base]\nposition = [0, 11, 0]": ":2: [base] position y (11.0) must be from -10 to 10 m",
    "[base]\nposition = [9.9, 0, 0]\n[camera]\nposition = [-5, 0, 0]": ":1: [base]: position x (-14.9) must be from",
    "[base]\nposition = [5, 0, 0]\n[arm]\nplace = [0.4, 0, 0]": ":4: [arm] place [-4.6, 0.0, 0.0] must be x, y and z",
    "[arm]\nplace = [0.4, 'a', 0]": ":2: [arm] place[1] must be a number",
    "[camera]\nwidth = 0": ":2: [camera] width (0) must be from 1 to",
    "[camera]\n\nwidth = 1.5": ":3: [camera] width must be a whole number, not 1.5",
    "[camera]\nwidth = true": ":2: [camera] width must be a whole number, not true",
    "[camera]\nwidht = 3": ":2: [camera] widht is unknown; did you mean width?",
    "[camera]\nx.width = 3": ":1: [camera] x is unknown",
    "[camera]\nposition = [0, 0, nan]": ":2: [camera] position[2] must be a number that is finite",
    "[camera]\nposition = [0, 0]": ":2: [camera] position must be a list of 3, not of 2",
    "[camera]\nposition = [0, 700, 0]": ":2: [camera] position y (700.0) must be from -10 to 10 m",
    "[camera]\nrotation = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]": ":2: [camera] rotation mirrors",
    "[camera]\nrotation = 1": ":2: [camera] rotation must be a list, not 1",
    "[camera]\nfx = 1" + "0" * 400: ":2: [camera] fx must be a number that is finite",
    "[shelf]\nfront = 0.5\nback = 0.4": ":2: [shelf] front (0.5) must be below back (0.4)",
    "[shelf]\nfront = 1.0\nback = 1.4\nthickness = 0": ":4: [shelf] thickness (0.0) must be from",
    "[shelf]\nfront = 0.374": ": [gripper]: outside (0.26, 0.3, 0.34, 0.374) must lie in front of the shelf, at 0.334",
    "[gripper]\noutside = [0.26, 0.39]": ":1: [gripper]: outside (0.26, 0.39) must lie in front of the shelf, at 0.374",
    "[shelves]\nfront = 0.5": ":1: [shelves] is unknown; did you mean shelf?",
    "# mine\nfront = 0.5": ":2: front stands in no table; begin one of [camera], [shelf]",
    '[target]\nshape = "ball"': ':2: [target] shape: "ball" is unknown',
    '[target]\nshape = ["box"]': ':2: [target] shape must be a text, not ["box"]',
    "[target]\ninset = 0.2": ":2: [target] inset (0.2) leaves no place",
    "[target]\ngrid = [1000, 1000]": ":2: [target] grid (1000, 1000) and yaws 1 make more than",
    "[objects]\nboxes = []\ncylinders = []": ":2: [objects] boxes and cylinders are both empty",
    "[objects]\nboxes = [[100, 50, 50]]": ":2: [objects] boxes (100.0, 50.0, 50.0) must be lengths in metres",
    '[planner]\npreset = "papr"': ':2: [planner] preset must be one of "standard", "paper"',
    '[planner]\npush_model = "eye"': ':2: [planner] push_model must be one of "quasi-static"',
    "[planner]\npush_directions = [1.5]": ":2: [planner] push_directions 1.5 is in degrees, of which 4 is the least",
    "[calibration]\nwarn_turn = 0.007": ":2: [calibration] warn_turn 0.007 is in degrees, of which 0.05 is the least",
    '[planner]\ncriterion = "detector"': ":2: [planner] criterion is unknown",
    "[planner]\nhorizon = 3\ngamma = 3": ":3: [planner] gamma 3.0 is outside",
    '[planner]\nactions = ["fly"]': ':2: [planner] actions: "fly" is unknown',
    '[planner]\nactions = ["push", "paper"]': ":2: [planner] actions: paper is a whole set",
    "[planner]\nmax_steps = 99999999999999999999": ":2: [planner] max_steps must be a whole number within 32 bits",
    "[planner]\ngama = 1": ":2: [planner] gama is unknown; did you mean gamma?",
    "[planner\n": ":1: is not TOML",
    "[planner]\ngamma = 2024-01-01": ':2: [planner] gamma must be a number, not "2024-01-01"',
    "a = " + "[" * 100_000: ": is not TOML",
    "#" * 300_000: ": is too large",
}


@pytest.mark.parametrize("text", list(WRONG), ids=lambda text: text[:40])
def test_what_is_wrong_is_named_by_line_and_key(tmp_path, text):
    with pytest.raises(InputError) as refused:
        load(tmp_path, text)
    message = str(refused.value)
    assert message.startswith(f"{tmp_path / 'mine.toml'}{WRONG[text]}")
    assert "\n" not in message
    assert len(message) < 500


def test_a_missing_file_and_one_that_is_no_text_are_refused(tmp_path):
    (tmp_path / "mine.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="UTF-8"):
        load_settings(tmp_path / "mine.toml")
    with pytest.raises(InputError, match=r"none\.toml: cannot be read"):
        load_settings(tmp_path / "none.toml")


def options_of(tmp_path, text, *arguments):
    (tmp_path / "mine.toml").write_text(text)
    command = ["inspect", "first-light", "--out", "out", "--config", str(tmp_path / "mine.toml"), *arguments]
    return cli.parse(command).keywords["options"]


def test_the_command_line_goes_before_the_file(tmp_path):
    text = '[planner]\npreset = "paper"\ngamma = 0.5\nactions = ["standard"]\n[shelf]\nback = 0.8\n'
    options = PRESETS["standard"]().options()
    standard = {name: options[name] for name in ("push_directions",)}
    given = options_of(tmp_path, text)
    assert given.settings().config == PRESETS["paper"](gamma=0.5, **standard)
    assert given.settings().workcell.shelf.back == 0.8
    given = options_of(tmp_path, text, "--gamma", "0.7", "--preset", "standard", "--push-directions", "0")
    assert given.settings().config == PRESETS["standard"](gamma=0.7, **{**standard, "push_directions": (0.0,)})


PIECES = """[target]
pieces = [
 {shape = "box", half_size = [0.015, 0.05, 0.012], position = [0, 0, 0.012], quaternion = [1, 0, 0, 0]},
 {shape = "box", half_size = [0.015, 0.014, 0.03], position = [0, 0, 0.054], quaternion = [1, 0, 0, 0]},
]
density = 700
inset = 0.06
"""


def test_a_target_of_pieces_or_of_a_mesh(tmp_path):
    target = load(tmp_path, PIECES).workcell.target
    assert (target.shape, target.inset, target.yaws, len(target.compound.pieces)) == ("compound", 0.06, 6, 2)
    assert target.compound.density == 700.0
    assert target.bottom + target.top == pytest.approx(0.084)
    trimesh.creation.box(extents=(30, 40, 100)).export(tmp_path / "brick.stl")
    target = load(tmp_path, '[target]\nmesh = "brick.stl"\nscale = 0.001\nyaws = 4').workcell.target
    assert (target.yaws, target.turn) == (4, math.pi)
    np.testing.assert_allclose(target.half_size, (0.015, 0.02, 0.05))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('mesh = "no.stl"', r"\[target\]\.mesh: .*no.stl cannot be read"),
        ('mesh = "no.stl"\nshape = "box"', r"\[target\] shape: follows from the mesh"),
        ('pieces = [{shape = "cone"}]', r"\[target\]\.pieces\[0\]"),
        ('compound = "a"', r"\[target\] compound is unknown"),
    ],
)
def test_a_wrong_target_of_pieces_is_refused(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        load(tmp_path, f"[target]\n{text}")


FILE = """
[camera]
width = 848
height = 480
fx = 404.0
fy = 404.0
cx = 424.0
cy = 240.0

[planner]
gamma = 0.8
max_steps = 3
push_model = "quasi-static"
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(FILE)
    return path


def test_a_file_says_workcell_and_planner(file):
    settings = load_settings(file)
    searcher = cell.load_searcher(file, keep=False)
    assert searcher.workcell == settings.workcell
    # A robot touches nothing beside what is to be moved, unless the file says that it may.
    config = settings.config.with_options(retrieval_contact=False)
    assert searcher.config == config
    assert cell.load_searcher(file, keep=False, retrieval_contact=True).config == settings.config
    expected = Method(config=config, workcell=settings.workcell).policy()
    policy = searcher._policy
    assert policy.config == expected.config
    assert policy.tries
    assert expected.tries
    assert searcher._trials == named_trials("physics")
    assert (policy.predict, policy.objective, policy.plan) == (expected.predict, expected.objective, expected.plan)


def test_what_is_given_goes_before_the_file(file):
    camera = example_images().camera
    searcher = cell.load_searcher(file, camera=camera, keep=False, trials="none", max_steps=7, seed=3)
    assert searcher.workcell.camera == camera
    assert (searcher.config.max_steps, searcher.config.planner.gamma) == (7, 0.8)
    assert (searcher._policy.tries, searcher._trials) == (False, None)
    with pytest.raises(InputError, match="option speed is unknown"):
        cell.load_searcher(file, keep=False, speed=1.0)


def test_without_a_file_all_is_as_by_default():
    assert cell.load_searcher(keep=False).config == Settings().config.with_options(retrieval_contact=False)


def test_compilations_are_kept(file, tmp_path, monkeypatch):
    monkeypatch.setenv("MECHSEARCH_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", os.environ.get("JAX_COMPILATION_CACHE_DIR", str(tmp_path)))
    cell.load_searcher(file)
    assert _KEEPING.executables.folder == tmp_path / "cache" / "executables"
