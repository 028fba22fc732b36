"""The target's pixels in noise: colours evened out, votes, the fitted shape; and no object in the found target."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.envs.camera.example_images import SCENARIO, sensed_images
from mechsearch_jax.envs.camera.simulated_camera import PALETTE, observe
from mechsearch_jax.envs.world.world import TARGET, from_scenario
from mechsearch_jax.images.cloud import above_board
from mechsearch_jax.images.colour import RED, TargetColour
from mechsearch_jax.images.detection import coloured_pixels, evened, near_target, without_phantoms
from mechsearch_jax.images.labels import FREE, OTHER
from mechsearch_jax.images.target_pose import distance
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.overlaps import overlap_faults
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, example_scenarios, load_scenario, superquadrics
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

KEY = jax.random.key(0)
SETTING = types.SimpleNamespace(camera=Camera(), shelf=Shelf(), target=Target.cylinder())
SCENE = load_scenario(example_scenarios()[SCENARIO])
STANDING = (0.46, 0.3, 0.4545)
IN_SIGHT = dataclasses.replace(SCENE, target=dataclasses.replace(SCENE.target, position=STANDING))
HUES = {
    "red": (0.9, 0.0, 0.0),
    "orange": (1.0, 0.5, 0.0),
    "yellow": (1.0, 0.9, 0.0),
    "green": (0.0, 0.8, 0.0),
    "cyan": (0.0, 0.8, 0.9),
    "blue": (0.0, 0.0, 1.0),
    "magenta": (0.9, 0.0, 0.9),
}


def shown(rgb, noise, light, seed=0):
    """A plain image of a colour, as 8 bits a channel give it."""
    image = np.array(rgb) * light + np.random.default_rng(seed).normal(0.0, noise / 255, (30, 30, 3))
    return jnp.asarray(np.round(255 * np.clip(image, 0, 1)) / 255, jnp.float32)


def share(pixels, rgb, noise, light):
    return float(np.mean(pixels(shown(rgb, noise, light), jnp.full((30, 30), 0.6))))


@pytest.mark.parametrize("name", list(HUES))
@pytest.mark.parametrize("noise", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_a_target_of_any_hue_is_separated_from_others_in_light_and_shade(name, noise):
    hue, others = HUES[name], [*(rgb for other, rgb in HUES.items() if other != name), *PALETTE[:8], PALETTE[9]]
    pixels = jax.jit(functools.partial(coloured_pixels, TargetColour.lit(hue)))
    for light in (0.45, 0.7, 1.0):
        assert share(pixels, hue, noise, light) > 0.99
        assert max(share(pixels, other, noise, light) for other in others) < 0.01


def test_colours_are_evened_out_but_not_over_edges():
    image = jnp.concatenate([shown(RED, 8, 1.0)[:, :15], shown(PALETTE[0], 8, 1.0, 1)[:, 15:]], axis=1)
    depth = jnp.full((30, 30), 0.6)
    error = np.asarray(evened(image, depth)) - np.where(np.arange(30)[:, None] < 15, np.array(RED), PALETTE[0])
    assert np.std(error) < 0.4 * 8 / 255
    assert np.abs(error).max() < 0.05
    # Nor over steps in depth, or where nothing was measured.
    alone = 0.02 * jnp.arange(30)[:, None] + 0.31 * jnp.arange(1, 31)[None, :]
    np.testing.assert_array_equal(evened(image, alone), image)
    np.testing.assert_array_equal(evened(image, jnp.full((30, 30), jnp.nan)), image)


def test_a_segment_mostly_in_the_target_is_none():
    labels = jnp.full((4, 4), FREE, jnp.int8).at[0].set(2).at[1].set(3)
    inside = jnp.zeros((4, 4), bool).at[0, :3].set(True).at[1, :2].set(True)
    expected = jnp.where(labels == 2, OTHER, labels)
    of_target = jnp.zeros((4, 4), bool).at[2].set(True)
    np.testing.assert_array_equal(without_phantoms(labels, inside, of_target), expected)
    # A narrow part of the target says too little of where the rest of it is.
    np.testing.assert_array_equal(without_phantoms(labels, inside, of_target.at[2, :2].set(False)), labels)


def test_what_is_seen_inside_of_a_pose_is_not_the_target():
    target, shelf = Target.box(), Shelf()
    middle = jnp.float32([[0.6, 0.1, target.height(shelf)], [0.6 + target.half_size[0], 0.1, target.height(shelf)]])
    assert near_target(target, shelf, jnp.float32([0.6, 0.1, 0.0]), middle).tolist() == [False, True]


def target_patch(images):
    """A part of the target that faces the camera, as rows and columns."""
    rows, columns = np.nonzero(images.mask == TARGET)
    row, column = int(np.median(rows)), int(np.median(columns))
    return slice(row - 10, row + 10), slice(column - 6, column + 6)


@pytest.fixture(scope="module")
def in_sight():
    return sensed_images(IN_SIGHT)


def near(key, shelf, points, of_target):
    """A segmenter: what stands about the target and is not known as its, is one object."""
    close = jnp.hypot(points[..., 0] - STANDING[0], points[..., 1] - STANDING[1]) < 0.03
    return jnp.where(above_board(shelf, points) & close & ~of_target, 0, FREE).astype(jnp.int8)


@pytest.mark.slow
def test_what_the_detector_misses_of_the_target_is_no_object(in_sight):
    colour = in_sight.colour.copy()
    colour[target_patch(in_sight)] = 128
    seen = Recogniser(SETTING, segmenter=near)(KEY, in_sight.depth, colour)
    assert seen.target_visible
    assert not seen.objects.valid.any()
    assert np.linalg.norm(np.asarray(seen.target_pose)[:2] - STANDING[:2]) < 0.003


def test_an_instance_of_a_mask_that_lies_on_the_found_target_is_no_object(in_sight):
    mask = in_sight.mask.copy()
    mask[target_patch(in_sight)] = 7
    see = Recogniser(SETTING)
    seen = see(KEY, in_sight.depth, mask=mask, target_id=TARGET)
    assert seen.target_visible
    assert not seen.objects.valid[7]
    assert int(seen.objects.valid.sum()) == len(SCENE.objects)
    # Where the target is not found, nothing is known of what is its.
    assert see(KEY, in_sight.depth, mask=mask, target_id=-1).objects.valid[7]


def test_things_deep_in_each_other_are_said():
    def observed(*bodies, visible=False):
        pose = jnp.array([*STANDING[:2], 0.0])
        return Observation(superquadrics(bodies), jnp.array(visible), pose)

    box = Body("box", (0.03, 0.03, 0.05), (0.6, 0.0, 0.4545), (1.0, 0.0, 0.0, 0.0))
    beside = dataclasses.replace(box, position=(0.6, 0.05, 0.4545))
    assert overlap_faults(SETTING, observed(box, beside, visible=True)) == ()
    deeper = dataclasses.replace(box, position=(0.6, 0.03, 0.4545))
    assert overlap_faults(SETTING, observed(box, deeper)) == (
        "recognition: object 0 and object 1 are 3.0 cm deep in each other; at least one of them is wrong",
    )
    can = Body("cylinder", (0.02, 0.02, 0.05), (0.47, 0.3, 0.4545), (1.0, 0.0, 0.0, 0.0))
    (fault,) = overlap_faults(SETTING, observed(can, visible=True))
    assert "object 0 and the target are 3.0 cm deep" in fault
    assert overlap_faults(SETTING, observed(can)) == ()
    lost = observed(can)
    lost = lost.replace(objects=lost.objects.replace(size=lost.objects.size.at[0].set(jnp.nan)))
    (fault,) = overlap_faults(SETTING, lost)
    assert fault == "recognition: object 0 has no finite shape or place; look again"


@pytest.mark.slow
@pytest.mark.parametrize("noise", [4, 8])
def test_in_noise_no_object_is_recognised_in_a_target_of_another_red(noise):
    """As the camera shows it in shade and light, with the segmentation network."""
    image = observe(Camera(), from_scenario(IN_SIGHT))
    rng = np.random.default_rng(noise)
    depth = np.asarray(image.depth) + rng.normal(0, 0.001, image.depth.shape).astype(np.float32)
    of_target = np.asarray(image.segmentation)[..., None] == TARGET
    shade = (np.asarray(image.colour) / np.array(RED)).mean(axis=-1, keepdims=True)
    colour = np.where(of_target, np.array([190, 20, 30]) / 255 * (0.45 + (shade - 0.55) / 0.45 * 0.55), image.colour)
    colour = np.round(255 * np.clip(colour + rng.normal(0, noise / 255, colour.shape), 0, 1)).astype(np.uint8)
    seen = Recogniser(SETTING)(KEY, depth, colour)
    assert seen.target_visible
    centres = np.asarray(seen.objects.position)[np.asarray(seen.objects.valid)]
    assert not (np.asarray(distance(SETTING.target, Shelf(), seen.target_pose, jnp.asarray(centres))) < 0).any()
