"""What is said of parts of a depth image in which nothing was measured."""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from test_perception_plausibility import CAMERA, IN_SIGHT, SCENE, SHELF, sensed, unseen

from mechsearch_jax.images.checks import Look, hole_faults, unmeasured_target_faults
from mechsearch_jax.images.colour import TargetColour
from mechsearch_jax.images.examples import example_images

IMAGES = example_images()


def holes(depth, camera=IMAGES.camera):
    return hole_faults(Look(camera, SHELF, depth))


def without(pixels, value=0.0):
    return np.where(pixels, np.float32(value), IMAGES.depth)


@pytest.mark.parametrize("value", [0.0, np.nan, -np.inf, 65.535])
def test_a_thing_without_depth_is_a_hole(value):
    thing = IMAGES.mask == 0
    (fault,) = holes(without(thing, value))
    share, top, bottom, left, right = map(int, re.findall(r"\d+", fault))
    rows, columns = np.nonzero(thing)
    assert 2 <= share <= 15
    assert "in a hole" in fault
    assert np.abs(np.array([top, bottom]) - [rows.min(), rows.max()]).max() < 12
    assert np.abs(np.array([left, right]) - [columns.min(), columns.max()]).max() < 12
    (fault,) = holes(without(thing | (IMAGES.mask == 1), value))
    assert "in 2 holes" in fault or "in a hole" in fault


def test_usual_images_have_none():
    rng = np.random.default_rng(0)
    assert holes(IMAGES.depth) == ()
    assert holes(np.where(IMAGES.depth > 0, IMAGES.depth, np.inf)) == ()
    assert holes(sensed(SCENE)[0], CAMERA) == ()
    assert holes(without(rng.random(IMAGES.depth.shape) < 0.3)) == ()
    # The shadow to the left of things, 12 pixels wide: nothing stands in it.
    step = ndimage.grey_erosion(IMAGES.depth, (1, 13)) < IMAGES.depth - 0.05
    assert holes(without(step & (IMAGES.mask < 0))) == ()


def test_the_targets_colour_without_depth_is_said():
    depth, colour = sensed(IN_SIGHT)
    detector = TargetColour.lit()
    red = np.asarray(detector(jnp.asarray(colour / np.float32(255))))
    assert red.sum() > 100
    look = Look(CAMERA, SHELF, np.where(red, 0, depth), colour, detector=detector)
    (fault,) = unmeasured_target_faults(look, unseen())
    assert "the target's colour is seen where nothing was measured" in fault
    assert unmeasured_target_faults(look, unseen(visible=True)) == ()
    measured = dataclasses.replace(look, depth=depth)
    assert unmeasured_target_faults(measured, unseen()) == ()
    # Outside of the shelf, such as on the robot, nothing is looked for.
    elsewhere = dataclasses.replace(look, shelf=SHELF.moved((0.0, 0.0, 0.25)))
    assert unmeasured_target_faults(elsewhere, unseen()) == ()
