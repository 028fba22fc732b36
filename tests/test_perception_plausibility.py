"""Images that do not fit shelf and target: shifted walls, exchanged colours, missing numbers, nothing to see."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
from published import published_scenarios

from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.images.checks import Look
from mechsearch_jax.images.colour import RED, TargetColour
from mechsearch_jax.images.examples import example_images
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception import plausibility
from mechsearch_jax.perception.plausibility import (
    EMPTY_SHELF,
    colour_faults,
    detection_faults,
    identity_faults,
    image_faults,
    sight_faults,
)
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera, back_project
from mechsearch_jax.workspace.scenario import Body, Scenario, example_scenarios, load_scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

CAMERA, SHELF, TARGET = Camera().scaled(2), Shelf(), Target()
SCENE = load_scenario(example_scenarios()["crowded-shelf"])
IMAGES = example_images()
IN_SIGHT = dataclasses.replace(SCENE, target=dataclasses.replace(SCENE.target, position=(0.46, 0.3, 0.4545)))


@functools.cache
def sensed(scene, camera=CAMERA):
    """Depth with 1 mm of noise, and colour with 4/255."""
    image = observe(camera, from_scenario(scene), SHELF)
    rng = np.random.default_rng(0)
    depth = np.asarray(image.depth) + rng.normal(0, 0.001, image.depth.shape).astype(np.float32)
    depth = np.where(np.isfinite(depth) & (rng.random(depth.shape) > 0.005), depth, 0.0).astype(np.float32)
    colour = np.asarray(image.colour) + rng.normal(0, 4 / 255, image.colour.shape)
    return depth, np.round(255 * np.clip(colour, 0, 1)).astype(np.uint8)


@pytest.mark.parametrize(
    ("by", "words"),
    [
        ((0.02, 0.0, 0.0), ("front edge appears", "back wall appears 2.0 cm farther than shelf.back")),
        ((-0.02, 0.0, 0.0), ("front edge appears", "back wall appears 2.0 cm nearer than shelf.back")),
        (
            (0.0, 0.02, 0.0),
            ("right side wall appears 2.0 cm farther in than", "left side wall appears 2.0 cm farther out"),
        ),
        (
            (0.0, -0.02, 0.0),
            ("right side wall appears 2.0 cm farther out than", "left side wall appears 2.0 cm farther in"),
        ),
    ],
)
def test_a_shelf_elsewhere_is_said(by, words):
    x, y, z = by
    faults = image_faults(Look(CAMERA, SHELF.moved((-x, -y, -z)), sensed(SCENE)[0]))
    assert len(faults) == len(words)
    for fault, text in zip(faults, words, strict=True):
        assert fault.startswith("depth image: ")
        assert text in fault


def test_one_5_mm_off_or_hardly_seen_is_not():
    assert image_faults(look(sensed(SCENE)[0])) == ()
    assert image_faults(Look(CAMERA, SHELF.moved((0.005, -0.005, 0.0)), sensed(SCENE)[0])) == ()
    # A wall of which nothing was measured is not looked for.
    depth = sensed(SCENE)[0].copy()
    points = np.asarray(back_project(CAMERA, jnp.asarray(depth)))
    depth[(points[..., 0] > SHELF.back - 0.03) & (points[..., 1] < 0.3)] = 0.0
    (fault,) = image_faults(Look(CAMERA, SHELF.moved((-0.02, 0.0, 0.0)), depth))
    assert "front edge" in fault


def test_a_row_of_boxes_before_the_back_wall_is_not_the_wall():
    row = tuple(Body("box", (0.03, 0.078, 0.096), (0.735, y, 0.5005), (1.0, 0.0, 0.0, 0.0)) for y in (-0.1, 0.1, 0.3))
    assert image_faults(look(sensed(Scenario("row", row, SCENE.target))[0])) == ()


@pytest.mark.slow
@pytest.mark.skipif(not published_scenarios(), reason="the published scenes are not there")
def test_no_published_scene_is_said_to_be_wrong():
    for file in published_scenarios()[::5]:
        scene = load_scenario(file)
        depth, colour = sensed(scene)
        assert image_faults(look(depth)) == ()
        assert colour_faults(look(depth, colour, detector=TargetColour.lit()), TARGET) == ()


def look(depth, colour=None, **fields):
    return Look(CAMERA, SHELF, depth, colour, **fields)


def unseen(visible=False):
    return Observation(empty(8), jnp.array(visible), jnp.zeros(3))


def test_things_of_the_targets_colour_that_are_not_the_target_are_said():
    depth, colour = sensed(IN_SIGHT)
    red, blue = TargetColour.lit(), TargetColour.lit((0.0, 0.0, 0.8))
    (fault,) = detection_faults(look(depth, colour, detector=red), unseen())
    assert "pixels have the target's colour, but nothing that shows them has its shape and size" in fault
    assert detection_faults(look(depth, colour, detector=red), unseen(visible=True)) == ()
    assert detection_faults(look(*sensed(SCENE), detector=red), unseen()) == ()
    assert len(detection_faults(look(depth, colour[..., ::-1], detector=blue), unseen())) == 1


def test_blue_green_red_is_said():
    depth, colour = sensed(IN_SIGHT)
    detector = TargetColour.lit()
    assert colour_faults(look(depth, colour, detector=detector), TARGET) == ()
    (fault,) = colour_faults(look(depth, colour[..., ::-1], detector=detector), TARGET)
    assert fault.startswith("colour image: looks like blue, green, red")
    floats = np.float32(colour[..., ::-1] / 255)
    assert len(colour_faults(look(depth, floats, detector=detector), TARGET)) == 1
    # A hidden target leaves nothing to tell by, and another thing of the exchanged colour is not of its shape.
    hidden = sensed(SCENE)
    assert colour_faults(look(*hidden, detector=detector), TARGET) == ()
    other = hidden[1].astype(np.float32) / 255
    image = np.asarray(observe(CAMERA, from_scenario(SCENE)).segmentation)
    for slot in range(len(SCENE.objects)):
        painted = np.where((image == slot)[..., None], RED[::-1], other).astype(np.float32)
        assert colour_faults(look(hidden[0], painted, detector=detector), TARGET) == ()


def test_what_keeps_the_target_from_being_recognised_is_named():
    mask = np.full((4, 4), -1)
    mask[0] = 3

    def faults(colour=None, mask=None, target_id=None):
        return identity_faults(look(np.ones((4, 4)), colour, mask=mask), target_id)

    (fault,) = faults()
    assert "give a colour image, or a mask with target_id" in fault
    assert len(faults(mask=mask)) == 1
    assert faults(np.zeros((4, 4, 3))) == ()
    assert faults(mask=mask, target_id=3) == faults(mask=mask, target_id=-1) == ()
    (fault,) = faults(mask=mask, target_id=5)
    assert "no pixel holds the target's number 5" in fault


def nothing_seen():
    return Observation(empty(8), jnp.array(False), jnp.zeros(3))


def test_an_empty_shelf_differs_from_one_on_which_nothing_is_recognised():
    bare = observe(CAMERA, from_scenario(SCENE).replace(valid=jnp.zeros(9, bool)))
    depth = np.asarray(bare.depth) + np.random.default_rng(0).normal(0, 0.001, bare.depth.shape).astype(np.float32)
    assert sight_faults(look(depth), nothing_seen()) == (EMPTY_SHELF,)
    (fault,) = sight_faults(look(sensed(SCENE)[0]), nothing_seen())
    assert "something stands on the shelf, but no object and no target is recognised" in fault
    assert sight_faults(look(depth), nothing_seen().replace(target_visible=jnp.array(True))) == ()


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, -np.inf, 65.535, 1000.0])
def test_an_image_without_a_measurement_is_said_and_refused(value):
    depth = np.full((CAMERA.height, CAMERA.width), value, np.float32)
    with pytest.raises(InputError, match="depth image: nothing was measured where it shows the shelf"):
        image_faults(look(depth))


def test_an_edge_that_the_image_cuts_off_is_not_the_boards():
    # Looks straight in; the lower rows of its image end on the board.
    right, down = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0])
    rotation = np.stack([right, down, np.cross(right, down)], axis=1)
    camera = Camera(
        width=1280,
        height=380,
        cy=190.0,
        rotation=tuple(map(tuple, rotation.tolist())),
        position=(-0.15, 0.1, 0.62),
    )
    shelf = Shelf()
    points = np.stack(np.meshgrid(np.linspace(0.43, 0.78, 200), np.linspace(-0.28, 0.48, 400), [shelf.board]), -1)
    assert not plausibility._edge_in_image(camera, shelf).any()
    assert plausibility._edge_fault(camera, shelf, points.reshape(-1, 3)) is None
    assert plausibility._edge_in_image(Camera(), shelf).sum() >= plausibility.LEAST_STRIPS
    assert "farther" in (plausibility._edge_fault(Camera(), shelf, points.reshape(-1, 3)) or "")
