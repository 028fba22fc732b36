"""The target in colour and depth: what is its own, what is another thing of its colour, and when it is visible."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.camera.simulated_camera import PALETTE, Appearance, observe
from mechsearch_jax.envs.world.world import TARGET, from_scenario
from mechsearch_jax.images.cloud import shelf_view
from mechsearch_jax.images.colour import RED, TargetColour, hue_difference, rgb_of_hue
from mechsearch_jax.images.detection import ColouredDepth, densest_place, detect, no_detection, without_strips
from mechsearch_jax.images.noise import RandomDirection, depth_of
from mechsearch_jax.images.target_pose import depth_tolerance
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

KEY, BOARD = jax.random.key(0), Shelf()
VIEW = shelf_view(Camera(), BOARD, 4)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
LIGHT = (-0.6, 0.3, 0.7)
X, Y = 0.6, 0.1


def standing(shape, half_size, x=X, y=-0.12, turn=UPRIGHT):
    return Body(shape, half_size, (x, y, BOARD.board + half_size[2]), turn)


CAN = standing("cylinder", (0.02, 0.02, 0.05), X, Y)
# Things that are not of the target's shape or size.
LARGE, FLAT, CUBE = (
    standing("box", half_size) for half_size in ((0.06, 0.06, 0.08), (0.01, 0.045, 0.045), (0.02, 0.02, 0.02))
)
TALL, WIDE, SHORT = (
    standing("cylinder", half_size) for half_size in ((0.02, 0.02, 0.1), (0.03, 0.03, 0.05), (0.02, 0.02, 0.03))
)
OTHERS = {"large": LARGE, "flat": FLAT, "cube": CUBE, "tall": TALL, "wide": WIDE, "short": SHORT}
# From the target towards the camera, and to the side, level.
TOWARDS = np.array(Camera().position[:2]) - (X, Y)
TOWARDS = TOWARDS / np.linalg.norm(TOWARDS)
ASIDE = np.array([-TOWARDS[1], TOWARDS[0]])


@functools.partial(jax.jit, static_argnames=("detector", "threshold"))
def detection(detector, threshold, image):
    return detect(KEY, detector, Target.cylinder(), BOARD, VIEW.camera, image, threshold)


def seen(other, colour, light=LIGHT, detector=None, can=CAN, threshold=6.0):
    """What is detected of a red target beside another body of a colour, and what each pixel shows."""
    world = from_scenario(Scenario("two", (other,), can or CAN))
    world = world.replace(valid=world.valid.at[TARGET].set(can is not None))
    colours = jnp.asarray(PALETTE).at[0].set(jnp.array(colour))
    image = observe(VIEW.camera, world, BOARD, Appearance(colours, jnp.array(light)))
    points = RandomDirection()(KEY, VIEW.camera, image.depth)
    depth = depth_of(VIEW.camera, points)
    found = detection(detector or TargetColour.lit(), threshold, ColouredDepth(points, depth, image.colour))
    return jax.tree.map(np.asarray, found), np.asarray(image.segmentation)


def assert_on_target(pixels, owner):
    """All but a few at the edges are the target's, and nearly all of its are there."""
    truth = owner == TARGET
    assert np.sum(pixels & truth) > 0.97 * np.sum(truth) > 30
    assert np.sum(pixels & ~truth) < 0.05 * np.sum(truth)


@pytest.mark.parametrize("light", [(-0.6, 0.3, 0.7), (0.0, -1.0, 0.1), (0.0, 1.0, 0.1)])
def test_the_target_is_detected_in_any_light_and_nothing_else_is(light):
    found, owner = seen(LARGE, PALETTE[1], light)
    assert found.visible
    assert_on_target(found.pixels, owner)


def test_without_the_target_nothing_is_detected():
    found, _ = seen(LARGE, PALETTE[1], can=None)
    assert not found.visible
    assert not found.pixels.any()
    assert not no_detection(jnp.zeros((3, 4))).visible


@pytest.mark.parametrize("name", OTHERS)
def test_a_thing_of_the_targets_colour_but_not_of_its_shape_and_size_is_an_object(name):
    found, _ = seen(OTHERS[name], RED, can=None)
    assert not found.visible
    assert not found.pixels.any()
    assert not found.unclear.any()


@pytest.mark.parametrize("name", OTHERS)
def test_the_target_is_found_beside_another_thing_of_its_colour(name):
    found, owner = seen(OTHERS[name], RED)
    assert found.visible
    assert_on_target(found.pixels, owner)


@pytest.mark.parametrize("aside", [-0.03, -0.02, 0.02, 0.03])
def test_the_target_is_found_behind_a_thing_of_another_colour(aside):
    x, y = np.array([X, Y]) + 0.09 * TOWARDS + aside * ASIDE
    whole = np.sum(seen(LARGE, PALETTE[1])[1] == TARGET)
    found, owner = seen(standing("cylinder", (0.025, 0.025, 0.08), x, y), PALETTE[1])
    assert 0.2 * whole < np.sum(owner == TARGET) < 0.8 * whole
    assert found.visible
    assert np.sum(found.pixels & (owner == TARGET)) > 0.95 * np.sum(owner == TARGET)
    assert np.sum(found.pixels & (owner != TARGET)) < 0.1 * np.sum(owner == TARGET)


@pytest.mark.parametrize(("axis", "degrees"), [("x", 20), ("y", 40), ("y", 90), ("x", 90)])
def test_a_target_that_leans_or_lies_is_detected(axis, degrees):
    x, y, z, w = Rotation.from_euler(axis, degrees, degrees=True).as_quat()
    tilt = np.radians(degrees)
    height = 0.02 * np.sin(tilt) + 0.05 * np.cos(tilt) if degrees < 90 else 0.02
    body = Body("cylinder", CAN.half_size, (X, Y, BOARD.board + height), (w, x, y, z))
    found, owner = seen(LARGE, PALETTE[1], can=body)
    assert found.visible
    # A few of the board's pixels next to it, too.
    assert_on_target(found.pixels & ((owner == TARGET) | (owner < TARGET)), owner)


@pytest.mark.slow
def test_specks_of_the_targets_colour_are_unclear():
    """They are no target, but neither may they be an object that rules out where the target is."""
    x, y = np.array([X, Y]) + 0.09 * TOWARDS + 0.01 * ASIDE
    pillar = standing("cylinder", (0.025, 0.025, 0.08), x, y)
    assert seen(pillar, PALETTE[1])[0].visible
    found, owner = seen(pillar, PALETTE[1], threshold=25.0)
    assert 10 < np.sum(owner == TARGET) < 25
    assert not found.visible
    assert not found.pixels.any()
    # A strip along the pillar's edge may be of the pillar.
    assert not (found.unclear & (owner != TARGET)).any()
    assert np.sum(found.unclear) > 0.9 * np.sum(owner == TARGET)


def test_the_densest_place_is_on_the_largest_thing():
    place = jnp.stack(jnp.meshgrid(jnp.arange(40) * 0.01, jnp.arange(40) * 0.01, indexing="ij"), axis=-1)
    points = jnp.concatenate([place, jnp.zeros((40, 40, 1))], axis=-1)
    coloured = jnp.zeros((40, 40), bool).at[2:8, 2:6].set(True)
    scattered = coloured.at[30, 30].set(True).at[10, 38].set(True).at[39, 1].set(True)
    x, y, _ = np.asarray(densest_place(KEY, Target.cylinder(), points, scattered))
    assert 0.02 <= x <= 0.07
    assert 0.02 <= y <= 0.05


def test_noise_that_neighbours_share_is_in_the_tolerance():
    smooth = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=(100, 100)), 3.0)
    # Of 1 / z, as that of a stereo camera is, 2 mm; at six pixels it still is alike in part.
    depth = 1.0 / (1.0 / 0.7 + 0.001 * np.arange(100.0)[:, None] + 0.002 / 0.7**2 * smooth / smooth.std())
    everywhere, low = jnp.ones((100, 100), bool), jnp.zeros((100, 100), bool).at[40:46].set(True)
    for chosen in (everywhere, low):
        assert 0.0045 < float(depth_tolerance(jnp.asarray(depth, jnp.float32), chosen)) < 0.0075


@pytest.mark.parametrize("gap", [0, 2])
@pytest.mark.parametrize("turned", [False, True])
def test_colours_at_the_edge_of_something_nearer_are_not_its_own(gap, turned):
    """Colours that lie three pixels over the edge of what is nearer, one of whose pixels may not be measured."""
    depth, chosen = np.full((40, 60), 0.8), np.zeros((40, 60), bool)
    depth[:, 30:] = 0.6
    depth[:, 33 : 33 + gap] = np.nan
    chosen[5:35, 20:33] = True
    wanted = chosen & (depth > 0.7)
    if turned:
        depth, chosen, wanted = depth.T, chosen.T, wanted.T
    np.testing.assert_array_equal(without_strips(jnp.asarray(chosen), jnp.asarray(depth)), wanted)
    # A thing of its own, however narrow, keeps its pixels.
    alone = np.full(depth.shape, 0.8)
    alone[chosen & ~wanted] = 0.6
    np.testing.assert_array_equal(without_strips(jnp.asarray(chosen), jnp.asarray(alone)), chosen)


def test_a_hue_and_a_tolerance_make_a_detector():
    blue = rgb_of_hue(240.0, 1.0)
    np.testing.assert_allclose(blue, (0.0, 0.0, 1.0), atol=1e-6)
    near = jnp.array(rgb_of_hue(220.0, 1.0))
    assert not TargetColour.lit(blue)(near)
    assert TargetColour.lit(blue, 25.0)(near)
    assert TargetColour.lit(blue, 25.0) == TargetColour.lit(blue, 25.0)
    # The usual tolerance is the usual detector.
    assert TargetColour.lit(blue, 15.0).difference is hue_difference
    with pytest.raises(InputError, match="hue_tolerance"):
        TargetColour.lit(blue, 90.0)
    with pytest.raises(InputError, match="saturation"):
        rgb_of_hue(240.0, 2.0)
    with pytest.raises(InputError, match="white, grey or black"):
        TargetColour.lit(rgb_of_hue(240.0, 0.1))
