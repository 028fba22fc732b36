"""The front door of perception: from the example images, masks and colours to objects and the target."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.envs.camera.example_images import SCENARIO, sensed_images
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.images.colour import TargetColour
from mechsearch_jax.images.examples import STEP, example_images, save_images
from mechsearch_jax.images.labels import FREE, MISSING, OTHER
from mechsearch_jax.perception.explanation import as_segmented
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.perception.scores import intersection_over_union, sharpened
from mechsearch_jax.perception.segmentation import NetworkSegmenter
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario, superquadrics
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

SCENE = load_scenario(example_scenarios()[SCENARIO])
OBJECTS = len(SCENE.objects)
IN_SIGHT = dataclasses.replace(SCENE, target=dataclasses.replace(SCENE.target, position=(0.46, 0.3, 0.4545)))
KEY = jax.random.key(0)
# Those that the camera sees well; of the fourth it sees a strip.
PLAIN = [0, 1, 2, 4]


def setting(camera):
    return types.SimpleNamespace(camera=camera, shelf=Shelf(), target=Target.cylinder())


def truth():
    return sharpened(superquadrics(SCENE.objects))


@pytest.fixture(scope="module")
def images():
    return example_images()


@pytest.fixture(scope="module")
def see(images):
    return Recogniser(setting(images.camera))


@pytest.fixture(scope="module")
def masked(see, images):
    return see(KEY, images.depth, mask=images.mask)


@pytest.fixture(scope="module")
def in_sight():
    return sensed_images(IN_SIGHT)


@pytest.fixture(scope="module")
def named(see, in_sight):
    return see(KEY, in_sight.depth, mask=in_sight.mask, target_id=in_sight.target_id)


def same(a, b):
    return jax.tree.all(jax.tree.map(lambda x, y: bool(jnp.array_equal(x, y)), a, b))


def test_the_shipped_images_are_what_the_script_makes(images, tmp_path):
    made = sensed_images(SCENE)
    # Of another machine's ray-cast the last digit may be another.
    assert np.mean(np.abs(made.depth - images.depth) > 0.51 * STEP) < 1e-4
    assert np.mean(made.mask != images.mask) < 1e-3
    assert np.mean(made.colour != images.colour) < 1e-3
    assert (images.target_id, images.camera) == (None, Camera())
    assert (images.depth.dtype, images.colour.dtype, images.mask.dtype) == (np.float32, np.uint8, np.int8)
    save_images(images, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").stat().st_size < 500_000


def test_with_a_mask_the_objects_of_the_scenario_are_found_in_their_slots(masked):
    assert masked.objects.valid.tolist() == [True] * OBJECTS + [False] * (8 - OBJECTS)
    assert not masked.target_visible
    overlap = np.asarray(intersection_over_union(truth(), masked.objects))
    assert overlap[:3].min() > 0.9
    assert overlap[:OBJECTS].min() > 0.6
    error = np.linalg.norm(np.asarray(masked.objects.position - truth().position), axis=-1)
    assert error[:3].max() < 0.002
    assert error[PLAIN].max() < 0.005
    # A box that is turned by a quarter, its width and depth swapped, is the same box.
    size = np.sort(masked.objects.size[..., :2]) - np.sort(truth().size[..., :2])
    assert np.abs(size[:3]).max() < 0.001
    height = np.asarray(masked.objects.size - truth().size)[..., 2]
    assert np.abs(height[:3]).max() < 0.001


def test_nothing_of_an_observation_has_a_weak_type(masked):
    """Else a plan that was compiled for true shapes would be compiled again for these."""
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(masked))


def test_without_a_measurement_is_zero_or_nan(see, images, masked):
    holes = np.where(images.depth == 0.0, np.nan, images.depth)
    assert same(see(KEY, holes, mask=images.mask), masked)


def test_the_same_images_give_the_same_objects_with_every_key(see, images, masked):
    for seed in (1, 2):
        assert same(see(jax.random.key(seed), images.depth, mask=images.mask), masked)


def test_a_target_that_the_mask_names_is_found_where_it_stands(named, masked):
    assert named.target_visible
    assert np.linalg.norm(np.asarray(named.target_pose)[:2] - IN_SIGHT.target.position[:2]) < 0.003
    np.testing.assert_array_equal(named.objects.valid, masked.objects.valid)


def test_a_target_is_seen_by_its_colour(see, in_sight, named):
    """Numbered in the mask, without a number, or with colours as floats: its pixels are nearly the same."""
    unnumbered = np.where(in_sight.mask == TARGET, OTHER, in_sight.mask)
    for mask, colour in ((in_sight.mask, in_sight.colour), (unnumbered, np.float32(in_sight.colour / 255))):
        seen = see(KEY, in_sight.depth, colour, mask)
        assert seen.target_visible
        assert np.linalg.norm(np.asarray(seen.target_pose)[:2] - IN_SIGHT.target.position[:2]) < 0.003
        np.testing.assert_array_equal(seen.objects.valid, named.objects.valid)
    blue = see(KEY, in_sight.depth, in_sight.colour[..., ::-1], unnumbered)
    assert not blue.target_visible


@pytest.mark.slow
def test_colour_alone_tells_which_object_of_a_mask_is_the_target(images, in_sight, named):
    """Also where the target is a little larger than it is said to be."""
    small = types.SimpleNamespace(camera=images.camera, shelf=Shelf(), target=Target("cylinder", (0.017, 0.017, 0.043)))
    seen = Recogniser(small)(KEY, in_sight.depth, in_sight.colour, in_sight.mask)
    assert seen.target_visible
    np.testing.assert_allclose(seen.target_pose[:2], named.target_pose[:2], atol=0.01)


def test_a_mask_that_does_not_show_the_target(see, in_sight, masked):
    unnumbered = np.where(in_sight.mask == TARGET, OTHER, in_sight.mask)
    seen = see(KEY, in_sight.depth, mask=unnumbered, target_id=-1)
    assert not seen.target_visible
    np.testing.assert_array_equal(seen.objects.valid, masked.objects.valid)


def test_what_lies_on_the_shelfs_faces_is_the_shelf_whatever_the_mask_says(see, images, masked):
    assert same(see(KEY, images.depth, mask=np.where(images.mask == FREE, OTHER, images.mask)), masked)
    assert (
        same(see(KEY, images.depth, mask=np.where(images.mask < 0, MISSING, images.mask).astype(int)), masked) is False
    )


def test_it_is_a_pytree(see, images):
    leaves, structure = jax.tree.flatten(see)
    # What the networks have learned, and where the camera is and what of its image is looked at.
    assert all(isinstance(leaf, jax.Array | float | int) for leaf in leaves)
    again = jax.tree.unflatten(structure, leaves)
    assert jax.tree.structure(again) == jax.tree.structure(Recogniser(setting(images.camera)))
    assert again.camera == images.camera


def test_slots_are_callables(images):
    """A segmenter and a detector of one's own, as functions."""

    def all_free(key, shelf, points, of_target):
        return jnp.where(jnp.isfinite(points).all(axis=-1), FREE, MISSING).astype(jnp.int8)

    # With segments as they are, the fit is the program that masks take.
    slots = {"segmenter": all_free, "detector": lambda colour: colour[..., 0] > 2.0, "fitter": as_segmented}
    see = Recogniser(setting(images.camera), **slots)
    seen = see(KEY, images.depth, images.colour)
    assert not seen.objects.valid.any()
    assert not seen.target_visible
    assert isinstance(Recogniser(setting(images.camera)).core.segmenter, NetworkSegmenter)


def test_bad_images_are_refused_in_one_line(see, images):
    depth, colour, mask = images.depth, images.colour, images.mask
    for arguments, words in (
        ((depth[1:],), "depth image: its shape"),
        ((None,), "depth image: is a NoneType"),
        ((depth, colour[..., 0]), "colour image: its shape"),
        ((depth, None, mask[:, 1:]), "mask image: its shape"),
        (((1000 * depth).astype(np.uint16),), "metres"),
        ((1000 * depth,), "metres, not millimetres"),
        ((depth, colour.astype(np.float32)), "divide 8-bit"),
        ((depth, colour.astype(np.int32)), "floats from 0 to 1, or uint8"),
        ((depth, None, mask.astype(np.float32)), "whole numbers"),
        ((depth, None, mask + np.int8(10)), "objects are 0 to 8"),
        ((depth, None, np.where(mask == 0, 8, mask)), "say with target_id"),
        ((depth, None, None, 3), "give the mask too"),
        ((depth, None, mask, 1.5), "one whole number"),
    ):
        with pytest.raises(InputError, match=words) as error:
            see(KEY, *arguments)
        assert "\n" not in str(error.value)
    away = dataclasses.replace(images.camera, position=(2.0, 0.0, 0.6))
    with pytest.raises(InputError, match="looks away from the shelf"):
        Recogniser(setting(images.camera), camera=away)
    with pytest.raises(InputError, match="threshold"):
        Recogniser(setting(images.camera), detector=TargetColour(threshold=-1.0))


def best_overlaps(objects):
    """Of each true object with any that was found."""
    pairs = jax.vmap(jax.vmap(intersection_over_union, (None, 0)), (0, None))
    each = functools.partial(jax.tree.map, lambda a: a[:, None])
    return np.asarray(pairs(each(truth()), each(objects)))[:OBJECTS, :, 0].max(axis=1)


@pytest.mark.slow
def test_without_a_mask_most_objects_are_separated(see, images, in_sight):
    assert (best_overlaps(see(KEY, images.depth, images.colour).objects) > 0.7).sum() >= 4
    blind = see(KEY, images.depth)
    assert (best_overlaps(blind.objects) > 0.7).sum() >= 4
    assert not blind.target_visible
    seen = see(KEY, in_sight.depth, in_sight.colour)
    assert seen.target_visible
    assert np.linalg.norm(np.asarray(seen.target_pose)[:2] - IN_SIGHT.target.position[:2]) < 0.003


@pytest.mark.slow
def test_a_batch_is_what_each_is_alone(see, images, in_sight, masked, named):
    keys = jnp.stack([KEY, KEY])
    depth, mask = (np.stack([getattr(i, name) for i in (images, in_sight)]) for name in ("depth", "mask"))
    batch = jax.jit(jax.vmap(lambda k, d, m, t: see(k, d, mask=m, target_id=t)))(keys, depth, mask, jnp.array([-1, 8]))
    np.testing.assert_array_equal(batch.target_visible, [False, True])
    for i, alone in enumerate((masked, named)):
        np.testing.assert_array_equal(batch.objects.valid[i], alone.objects.valid)
        valid = np.asarray(alone.objects.valid)
        np.testing.assert_allclose(batch.objects.position[i][valid], alone.objects.position[valid], atol=1e-3)
        np.testing.assert_allclose(batch.objects.size[i][valid], alone.objects.size[valid], atol=1e-3)
    np.testing.assert_allclose(batch.target_pose[1], named.target_pose, atol=1e-3)
