"""The target in colour and depth: what is its own, what is another thing of its colour, and when it is visible."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.envs.camera.simulated_camera import PALETTE, Appearance, observe
from mechsearch_jax.envs.world.world import TARGET, from_scenario
from mechsearch_jax.images.cloud import shelf_view
from mechsearch_jax.images.colour import RED, TargetColour, hue_difference, rgb_of_hue
from mechsearch_jax.images.detection import detect, in_one_place, no_detection
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera, back_project
from mechsearch_jax.workspace.scenario import Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

KEY, BOARD = jax.random.key(0), Shelf()
VIEW = shelf_view(Camera(), BOARD, 4)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
CAN = Body("cylinder", (0.02, 0.02, 0.05), (0.6, 0.1, BOARD.board + 0.05), UPRIGHT)
# A box that is larger than the target, and one that is not.
LARGE = Body("box", (0.06, 0.06, 0.08), (0.6, -0.12, BOARD.board + 0.08), UPRIGHT)
FLAT = Body("box", (0.01, 0.045, 0.045), (0.6, -0.12, BOARD.board + 0.045), UPRIGHT)


def seen(other, colour, light=(-0.6, 0.3, 0.7), detector=None, valid=True):
    """What is detected of a red target beside another body of a colour, and what each pixel shows."""
    world = from_scenario(Scenario("two", (other,), CAN))
    world = world.replace(valid=world.valid.at[TARGET].set(valid))
    colours = jnp.asarray(PALETTE).at[0].set(jnp.array(colour))
    image = observe(VIEW.camera, world, BOARD, Appearance(colours, jnp.array(light)))
    points = back_project(VIEW.camera, image.depth)
    eyes = detector or TargetColour.lit()
    found = detect(KEY, eyes, Target.cylinder(), BOARD, VIEW.camera, points, image.depth, image.colour, 6.0)
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
    found, _ = seen(LARGE, PALETTE[1], valid=False)
    assert not found.visible
    assert not found.pixels.any()
    assert not no_detection(found.pixels).visible


def test_another_hue_is_not_the_targets():
    found, _ = seen(LARGE, PALETTE[1], detector=TargetColour.lit((0.1, 0.3, 0.8)))
    assert not found.visible


@pytest.mark.parametrize("body", [LARGE, FLAT])
def test_a_thing_of_the_targets_colour_but_not_of_its_shape_is_an_object(body):
    found, _ = seen(body, RED, valid=False)
    assert not found.visible
    assert not found.pixels.any()


@pytest.mark.parametrize("body", [LARGE, FLAT])
def test_the_target_is_found_beside_another_thing_of_its_colour(body):
    found, owner = seen(body, RED)
    assert found.visible
    assert_on_target(found.pixels, owner)


def test_what_is_farther_away_than_the_target_is_large_is_not_the_targets():
    place = jnp.stack(jnp.meshgrid(jnp.arange(40) * 0.01, jnp.arange(40) * 0.01, indexing="ij"), axis=-1)
    points = jnp.concatenate([place, jnp.zeros((40, 40, 1))], axis=-1)
    coloured = jnp.zeros((40, 40), bool).at[2:8, 2:6].set(True)
    scattered = coloured.at[30, 30].set(True).at[10, 38].set(True).at[39, 1].set(True)
    np.testing.assert_array_equal(in_one_place(KEY, Target.cylinder(), points, scattered), coloured)
    assert not in_one_place(KEY, Target.cylinder(), points, jnp.zeros((40, 40), bool)).any()


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
