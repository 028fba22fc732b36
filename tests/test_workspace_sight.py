"""A camera that does not see the shelf is refused before anything is built, with the likely mistake by its name."""

import contextlib
import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mechsearch_jax.existence import ExistenceConfig, target_window
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.planner import build_problem
from mechsearch_jax.problem import problem as problems
from mechsearch_jax.problem.cache import cached_problem
from mechsearch_jax.problem.settings import load_settings
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.searcher import Searcher
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.sight import BODY, OPENGL, blindness, camera_faults, check_camera
from mechsearch_jax.workspace.target import Target

VIEWS = sorted((Path(__file__).parents[1] / "benchmarks" / "lab" / "parts" / "views").glob("*.toml"))
INVERTED = (
    "camera: T_world_camera looks inverted: its inverse sees the shelf; give the camera's pose in the robot's frame"
)
TRANSPOSED = (
    "camera: its rotation looks transposed: the shelf is seen with its rows as columns; give the rows of R_world_camera"
)
OPENGL_AXES = (
    "camera: looks away from the shelf, as with OpenGL's axes (y up, z backward): negate the second and third columns "
    "of the rotation"
)
BODY_AXES = (
    "camera: looks elsewhere, as with the axes of a robot's body (x forward, y left, z up); its frame must have x "
    "right, y down and z forward, as the optical frame of ROS has"
)
AWAY = (
    "camera: looks away from the shelf; its frame must have x right, y down and z forward, and its pose be that in the "
    "robot's frame"
)


def at(camera, rotation, position):
    return dataclasses.replace(
        camera, rotation=tuple(map(tuple, np.asarray(rotation).tolist())), position=tuple(np.asarray(position).tolist())
    )


def mistaken(camera):
    """A camera with the usual mistakes in its pose, by what is to be said of each."""
    R, p = np.array(camera.rotation), np.array(camera.position)
    return {
        INVERTED: at(camera, R.T, -R.T @ p),
        TRANSPOSED: at(camera, R.T, p),
        OPENGL_AXES: at(camera, R @ OPENGL, p),
        BODY_AXES: at(camera, R @ BODY.T, p),
    }


@pytest.mark.parametrize("line", [INVERTED, TRANSPOSED, OPENGL_AXES, BODY_AXES])
def test_a_usual_mistake_is_named_and_refused(line):
    camera, shelf = mistaken(Camera())[line], Shelf()
    assert blindness(camera, shelf) == line
    assert camera_faults(camera, shelf) == (line,)
    with pytest.raises(InputError) as refused:
        check_camera(camera, shelf)
    assert str(refused.value) == line


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.stem)
def test_other_cameras_are_good_and_their_mistakes_named(view):
    cell = load_settings(view).workcell
    assert camera_faults(cell.camera, cell.shelf) == ()
    named = mistaken(cell.camera)
    for line in (TRANSPOSED, OPENGL_AXES):
        assert blindness(named[line], cell.shelf) == line


def test_a_camera_that_looks_away_or_at_little_is_refused():
    R, p = np.array(Camera().rotation), Camera().position
    assert blindness(at(Camera(), np.diag([-1.0, -1.0, 1.0]) @ R, p), Shelf()) == AWAY
    narrow = dataclasses.replace(Camera(), fx=6000.0, fy=6000.0)
    assert "% of the board only; check its pose and focal lengths" in blindness(narrow, Shelf())


def test_a_camera_may_hang_upside_down():
    turned = at(Camera(), np.array(Camera().rotation) @ np.diag([-1.0, -1.0, 1.0]), Camera().position)
    assert blindness(turned, Shelf()) is None
    assert camera_faults(turned, Shelf()) == ()


def test_what_the_numbers_still_work_with_is_a_warning():
    near = dataclasses.replace(Camera(), fx=1900.0, fy=1900.0)
    assert blindness(near, Shelf()) is None
    assert "% of the board only" in camera_faults(near, Shelf())[0]


def test_nothing_is_built_for_a_camera_that_sees_nothing(problem, monkeypatch):
    monkeypatch.setenv("MECHSEARCH_CACHE_DIR", "")

    def built(*args, **kwargs):
        raise AssertionError("tables were built")

    for name in ("candidate_grasps", "grasp_tables", "existence_tables", "action_tables"):
        monkeypatch.setattr(problems, name, built)
    camera = mistaken(Camera())[INVERTED]
    for make in (
        lambda: build_problem(camera=camera),
        lambda: cached_problem(camera=camera),
        lambda: Workcell(camera=camera).problem(),
        lambda: Searcher(Workcell(camera=camera)),
        lambda: Recogniser(problem, camera=camera),
    ):
        with pytest.raises(InputError, match="looks inverted"):
            make()


def poses(count):
    """Random poses, and the default one with usual and unusual mistakes."""
    random = np.random.default_rng(0)
    R, p = np.array(Camera().rotation), np.array(Camera().position)
    flips = [np.diag(signs) for signs in ([1, 1, 1], [1, -1, -1], [-1, -1, 1], [-1, 1, -1])]
    for _ in range(count):
        rotation = random.choice([R, R.T, BODY, Rotation.random(rng=random).as_matrix()])
        position = random.choice([p, -R.T @ p, -p, random.uniform(-1, 1, 3), random.uniform(-6, 6, 3)])
        rotation = rotation @ random.choice(flips)
        if random.random() < 0.3:
            rotation = Rotation.from_rotvec(random.normal(0, 0.3, 3)).as_matrix() @ rotation
        if random.random() < 0.3:
            position = position * random.choice([0.01, 0.5, 1.5])
        yield at(Camera(), rotation, position)


def test_no_pose_makes_windows_larger_than_the_image_or_raises_anything_else():
    shelf, target, config = Shelf(), Target(), ExistenceConfig()
    T = upright_pose(jnp.asarray(target.places(shelf, config.places)), target.height(shelf))
    half = np.array(target.half_size, np.float32)
    refused = 0
    for camera in poses(240):
        coarse = camera.scaled(config.downscale)
        (rows, columns), _ = target_window(coarse, half, T)
        assert 0 < rows <= coarse.height + 2
        assert 0 < columns <= coarse.width + 2
        line = blindness(camera, shelf)
        refused += line is not None
        assert line is None or len(line.splitlines()) == 1
        with pytest.raises(InputError) if line else contextlib.nullcontext():
            check_camera(camera, shelf)
        assert (line is None) or camera_faults(camera, shelf) == (line,)
    assert 100 < refused < 240


def test_the_window_of_a_target_in_sight_is_as_large_as_its_image():
    target, config = Target(), ExistenceConfig()
    T = upright_pose(jnp.asarray(target.places(Shelf(), config.places)), target.height(Shelf()))
    (rows, columns), _ = target_window(Camera().scaled(config.downscale), np.array(target.half_size, np.float32), T)
    assert rows < 40
    assert columns < 20
