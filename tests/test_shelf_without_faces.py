"""A board without walls or upper board: what is missing blocks nothing, hides nothing and is not looked for."""

import dataclasses
import itertools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.calibration.check import placement_faults
from mechsearch_jax.calibration.limits import CalibrationLimits
from mechsearch_jax.dynamics.contacts import wall_depth
from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.world.model import compile_model
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.geometry.footprints import footprints
from mechsearch_jax.images.checks import Look
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.doubt import recognition_doubt
from mechsearch_jax.perception.plausibility import image_faults
from mechsearch_jax.problem.settings import load_settings
from mechsearch_jax.robot.arm_clearance import ArmBody, Obstacles, clearance
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera, back_project
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario, superquadrics
from mechsearch_jax.workspace.shelf import FACES, Shelf, hits_shelf, past_open_side, spheres_hit_shelf
from mechsearch_jax.workspace.sight import camera_faults, enters
from mechsearch_jax.workspace.target import Target

SHELF, TABLE = Shelf(), Shelf(faces=())
CAMERA = Camera().scaled(2)
SCENE = load_scenario(example_scenarios()["first-light"])
WORLD = from_scenario(SCENE)
SOME = [faces for n in range(len(FACES) + 1) for faces in itertools.combinations(FACES, n)]


def depth_of(shelf, camera=CAMERA):
    """The simulated depth; 0 where the sensor meets nothing, and half a millimetre of noise."""
    depth = np.asarray(observe(camera, WORLD, shelf).depth)
    return np.where(np.isfinite(depth), depth + np.random.default_rng(0).normal(0, 5e-4, depth.shape), 0.0)


def test_motions_are_stopped_by_the_faces_that_there_are_and_all_shelves_share_a_program():
    points = np.random.default_rng(0).uniform([0.2, -0.8, 0.2], [1.2, 1.0, 1.2], (4000, 3))
    radii = np.float32([0.02])
    # Functions of their own, which nobody else has compiled.
    hits, touch = jax.jit(lambda *a: hits_shelf(*a)), jax.jit(lambda *a: spheres_hit_shelf(*a))
    for faces in SOME:
        shelf = dataclasses.replace(SHELF, faces=faces)
        x, y, z = points.T
        stopped = {
            "back": x > shelf.back,
            "right": y < shelf.right + shelf.side_margin,
            "left": y > shelf.left - shelf.side_margin,
            "ceiling": z > shelf.ceiling - shelf.ceiling_margin,
        }
        solid = (z < shelf.board) | np.any([stopped[face] for face in faces] or [False], axis=0)
        expected = (x > shelf.front) & solid
        np.testing.assert_array_equal(hits(shelf, jnp.float32(points)), expected)
        touched = np.asarray(touch(shelf, jnp.float32(points)[:, None], radii))[:, 0]
        assert touched[expected].all()
        far = [face for face in FACES if face not in faces]
        walled = np.asarray(touch(SHELF, jnp.float32(points)[:, None], radii))[:, 0]
        assert (touched <= walled).all()
        assert (touched < walled).any() == bool(far)
    assert hits._cache_size() == touch._cache_size() == 1
    assert jax.tree.map(lambda leaf: leaf, TABLE) == TABLE
    assert hash(TABLE) != hash(SHELF)


def test_objects_at_an_edge_without_a_wall_are_not_in_a_wall_but_may_fall():
    prints = footprints(superquadrics(SCENE.objects))
    beyond = prints.replace(position=prints.position.at[:, 0].set(SHELF.back))
    valid = np.asarray(prints.valid)
    assert (np.asarray(wall_depth(SHELF, beyond)[0]).max(axis=(1, 2)) > 0.01)[valid].all()
    assert (np.asarray(wall_depth(TABLE, beyond)[0]) < -1.0)[valid].all()
    x, y = jnp.float32([0.5, 0.78, 0.5, 0.5]), jnp.float32([0.0, 0.0, -0.28, 0.48])
    np.testing.assert_array_equal(past_open_side(SHELF, x, y, 0.02), [False] * 4)
    np.testing.assert_array_equal(past_open_side(TABLE, x, y, 0.02), [False, True, True, True])
    np.testing.assert_array_equal(
        past_open_side(Shelf(faces=("back", "left")), x, y, 0.02), [False, False, True, False]
    )


def test_what_is_missing_is_in_no_image_and_no_model():
    depth = {shelf: np.asarray(observe(CAMERA, WORLD, shelf).depth) for shelf in (SHELF, TABLE, Shelf(faces=("back",)))}
    table, back, full = depth[TABLE], depth[Shelf(faces=("back",))], depth[SHELF]
    assert np.isfinite(full).mean() > np.isfinite(back).mean() > np.isfinite(table).mean() > 0.1
    seen = np.isfinite(table)
    points = np.asarray(back_project(CAMERA, jnp.asarray(table)))[seen]
    assert points[:, 0].max() < SHELF.back + SHELF.thickness + 1e-3
    np.testing.assert_array_equal(np.minimum(full, table), full)
    names = {compile_model(TABLE, CAMERA).geom(i).name for i in range(compile_model(TABLE, CAMERA).ngeom)}
    assert {"board_plane", "board_box"} <= names
    assert not {f"{face}_{kind}" for face in FACES for kind in ("plane", "box")} & names


@pytest.mark.parametrize("faces", [(), ("back",), ("right", "left"), ("back", "right", "left")])
def test_a_look_at_a_board_without_all_faces_is_warned_of_for_nothing(faces):
    shelf = dataclasses.replace(SHELF, faces=faces)
    depth = depth_of(shelf)
    look = Look(CAMERA, shelf, depth.astype(np.float32))
    assert image_faults(look) == ()
    assert placement_faults(CAMERA, shelf, depth, CalibrationLimits()) == ()
    seen = Observation(superquadrics(SCENE.objects), jnp.array(False), jnp.zeros(3))
    setting = types.SimpleNamespace(camera=CAMERA, shelf=shelf, target=Target())
    assert recognition_doubt(setting, seen, depth).missing < 0.05
    # As a shelf with all faces it is warned of, or refused, but for the upper board, which need not be seen.
    try:
        said = [
            *image_faults(Look(CAMERA, SHELF, look.depth)),
            *placement_faults(CAMERA, SHELF, depth, CalibrationLimits()),
        ]
    except InputError as error:
        said = [str(error)]
    assert said or "back" in faces


def test_a_table_top_among_other_furniture_is_warned_of_only_if_it_is_elsewhere():
    """A part of a larger table, with a wall far behind it and things beside it."""
    wide = Shelf(front=0.2, back=1.4, right=-1.2, left=1.4, ceiling=1.2, faces=("back",))
    high = CAMERA.moved((-0.3, 0.0, 0.35))
    depth = depth_of(wide, high)
    region = dataclasses.replace(SHELF, faces=())
    assert image_faults(Look(high, region, depth.astype(np.float32))) == ()
    assert placement_faults(high, region, depth, CalibrationLimits()) == ()
    (fault,) = placement_faults(
        high, dataclasses.replace(region, board=region.board - 0.006), depth, CalibrationLimits()
    )
    assert fault.startswith("camera or shelf: in the depth image the shelf is up to 6 mm")
    assert "faces" not in fault


def test_one_looks_in_through_every_side_without_a_face():
    rng = np.random.default_rng(0)
    middle = np.array([0.6, 0.1, 0.5])
    places = {"front": (-0.2, 0.1, 0.5), "back": (1.5, 0.1, 0.5), "left": (0.6, 1.5, 0.5), "ceiling": (0.6, 0.1, 1.6)}
    for face, place in places.items():
        ways = middle + rng.normal(0, 0.03, (50, 3)) - place
        assert enters(TABLE, np.array(place), ways).all()
        assert enters(SHELF, np.array(place), ways).all() == (face == "front")
        assert not enters(TABLE, np.array(place), -ways).any()
    above = Camera(
        position=(0.6, 0.1, 1.4), rotation=((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)), fx=500.0, fy=500.0
    )
    assert camera_faults(above, TABLE) == ()
    assert camera_faults(above, SHELF)


def test_a_free_motion_keeps_away_from_what_there_is_only():
    rng = np.random.default_rng(0)
    q = HOME + rng.normal(scale=1.0, size=(400, 7))
    walled, free = (clearance(ArmBody.of(0.04), Obstacles.of(shelf), q).free for shelf in (SHELF, TABLE))
    assert (free >= walled).all()
    assert ((walled <= 0) & (free > 0)).sum() > 10


def test_a_file_says_which_faces_there_are(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('[shelf]\nfaces = ["left", "back"]\n')
    assert load_settings(file).workcell.shelf == Shelf(faces=("back", "left"))
    file.write_text("[shelf]\nfaces = []\n[base]\nposition = [0.0, 0.1, 0.0]\n")
    assert load_settings(file).workcell.shelf.faces == ()
    file.write_text('[shelf]\nfaces = ["top"]\n')
    with pytest.raises(InputError, match=r'mine\.toml:2: \[shelf\] faces \["top"\] must be a list of those'):
        load_settings(file)
