"""The planner's eyes: what recognisers make of the simulated world."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.benchmarks.lab.parts.segmentation import numbered
from mechsearch_jax.envs.camera import recognisers
from mechsearch_jax.envs.camera.recognisers import recogniser, true_labels
from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.camera.snapshot import Snapshot, nearest_bodies
from mechsearch_jax.envs.episode.episodes import target_of
from mechsearch_jax.envs.world.world import TARGET, from_scenario, true_superquadrics
from mechsearch_jax.images.cloud import shelf_view, thinned_view
from mechsearch_jax.images.labels import FREE, MISSING, OTHER
from mechsearch_jax.perception.recogniser import Recogniser, labelled, large_segments
from mechsearch_jax.perception.scores import intersection_over_union, sharpened
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace import scenario
from mechsearch_jax.workspace.camera import Camera, back_project
from mechsearch_jax.workspace.detector import found_pixels
from mechsearch_jax.workspace.shelf import Shelf

CAMERA, SHELF = Camera(), Shelf()
SCENE = scenario.load_scenario(scenario.example_scenarios()["first-light"])


def moved(world, index, position):
    return world.replace(position=world.position.at[index].set(jnp.float32(position)))


@pytest.fixture(scope="module")
def world():
    return from_scenario(SCENE)


@pytest.fixture(scope="module")
def masks():
    return recogniser("masks", target_of(SCENE))


@pytest.fixture(scope="module")
def seen(world, masks):
    return masks(jax.random.key(0), Snapshot(CAMERA, SHELF, world))


def test_true_masks_and_noisy_depth_give_the_shapes(world, seen):
    truth = sharpened(true_superquadrics(world))
    overlap = np.asarray(intersection_over_union(truth, seen.objects))
    both = np.asarray(truth.valid & seen.objects.valid)
    assert both.sum() >= np.asarray(truth.valid).sum() - 1
    assert overlap[both].mean() > 0.85
    assert not np.asarray(seen.objects.valid & ~truth.valid).any()
    assert not seen.target_visible
    # As the oracle has them, whatever fits the image best.
    np.testing.assert_array_equal(seen.objects.exponents[both, 0], np.float32(shape_of("box").exponents[0]))


def test_the_same_key_gives_the_same_and_another_key_other_noise(world, masks, seen):
    again = masks(jax.random.key(0), Snapshot(CAMERA, SHELF, world))
    other = masks(jax.random.key(1), Snapshot(CAMERA, SHELF, world))
    np.testing.assert_array_equal(again.objects.size, seen.objects.size)
    assert np.abs(np.asarray(other.objects.size - seen.objects.size)).max() > 1e-5


def test_a_target_in_sight_is_found_where_it_stands_and_is_none_of_the_objects(world, masks, seen):
    place = [0.46, 0.3, SHELF.board + float(world.half_size[TARGET, 2])]
    plain = masks(jax.random.key(0), Snapshot(CAMERA, SHELF, moved(world, TARGET, place)))
    assert plain.target_visible
    assert np.linalg.norm(np.asarray(plain.target_pose)[:2] - place[:2]) < 0.004
    np.testing.assert_array_equal(plain.objects.valid, seen.objects.valid)


def test_labels_are_float64_geometry(world):
    view = shelf_view(CAMERA, SHELF)
    image = observe(view.camera, world, SHELF)
    points = back_project(view.camera, image.depth).at[:5].set(jnp.nan)
    labels = np.asarray(true_labels(points, image.segmentation, SHELF))
    owner, xyz = np.asarray(image.segmentation), np.asarray(points, np.float64)
    assert (labels[:5] == MISSING).all()
    high = xyz[..., 2] > SHELF.board + 0.005
    for slot in range(len(SCENE.objects)):
        inside = (owner == slot) & high & np.isfinite(xyz[..., 2])
        assert (labels[inside] == slot).all()
    on_board = (owner == TARGET + 1) & (np.abs(xyz[..., 2] - SHELF.board) < 0.003)
    assert on_board.sum() > 1000
    assert (labels[on_board] == FREE).all()


def test_segments_are_named_after_the_objects_that_they_overlap_most():
    truth = np.full((4, 6), FREE, np.int8)
    truth[:, 0:2], truth[:, 2:4], truth[:, 4:5] = 5, 1, 3
    segments = np.full((4, 6), FREE, np.int8)
    segments[:, 0:2], segments[:, 2:3], segments[:, 3:4], segments[:, 4:5], segments[0, 5] = 4, 0, 2, 7, OTHER
    segments[0, 2] = 2
    named = np.asarray(numbered(jnp.asarray(segments), jnp.asarray(truth)))
    assert (named[:, 0:2] == 5).all()
    assert (named[:, 4] == 3).all()
    assert (named[:, 3] == 1).all()
    assert (named[1:, 2] != 1).all()
    assert named[0, 5] == OTHER
    assert (named[1:, 5] == FREE).all()


def test_no_segment_is_lost_because_the_truth_knows_no_object_there():
    """Eight segments: that of number 3 shows a target that the detector does not see."""
    truth = np.repeat(np.int8([[0, 1, 2, TARGET, 4, 5, 6, 7]]), 3, axis=0)
    segments = np.repeat(np.int8([[7, 6, 5, 3, 4, 2, 1, 0]]), 3, axis=0)
    named = np.asarray(numbered(jnp.asarray(segments), jnp.asarray(truth)))
    np.testing.assert_array_equal(named, np.where(truth == TARGET, 3, truth))


def test_what_may_be_the_target_is_no_segment():
    labels = np.full((10, 10), FREE, np.int8)
    labels[0, :5], labels[1, :6], labels[2, :2], labels[3] = 0, 7, 8, OTHER
    expected = labels.copy()
    expected[0, :5], expected[2, :2] = OTHER, OTHER
    np.testing.assert_array_equal(large_segments(jnp.asarray(labels), 5.9), expected)
    np.testing.assert_array_equal(large_segments(jnp.asarray(labels), 0.0), labels)


def curious_segments(key, shelf, points, of_target):
    """A segmenter that takes the target's pixels for the ninth instance, and all else for the shelf."""
    return jnp.where(of_target, 8, FREE).astype(jnp.int8)


@pytest.fixture(scope="module")
def shown():
    """What `full` sees of a world, but for its segments, and what the pixels truly show."""
    full, view, key = recogniser("full", target_of(SCENE)), thinned_view(CAMERA, SHELF), jax.random.key(0)
    curious = full.core.replace(segmenter=jax.tree_util.Partial(curious_segments))

    def see(world):
        images = full.images(key, Snapshot(CAMERA, SHELF, world))
        image, seen = labelled(curious, key, CAMERA, view, SHELF, images)
        owner = np.asarray(observe(view.camera, world, SHELF).segmentation)
        return jax.tree.map(np.asarray, image), owner, bool(seen)

    return see


@pytest.mark.slow
@pytest.mark.parametrize(("y", "in_sight"), [(-0.03, False), (-0.06, True)])
def test_full_finds_the_target_in_colour_where_it_is_in_sight(world, shown, y, in_sight):
    x, _, z = SCENE.target.position
    image, owner, seen = shown(moved(world, TARGET, [x, y, z]))
    assert seen == in_sight
    assert image.of_target.any() == in_sight
    true = owner == TARGET
    assert np.sum(true) > 60 or not in_sight
    if in_sight:
        named = image.labels == 8
        assert np.sum(named & true) > 0.95 * np.sum(true)
        assert np.sum(named & ~true) < 0.05 * np.sum(true)


@pytest.mark.parametrize("name", ["masks", "full"])
def test_what_sees_images_reads_nothing_else_of_the_truth(world, name):
    """A snapshot that refuses to give the truth does not differ."""

    class Blind(Snapshot):
        @property
        def target_seen(self):
            raise AssertionError("read whether the target is in sight")

        @property
        def target_pose(self):
            raise AssertionError("read where the target is")

    eyes = recogniser(name, target_of(SCENE))
    jax.eval_shape(lambda here: eyes(jax.random.key(0), Blind(CAMERA, SHELF, here)), world)


def test_images_of_full_are_the_same_whatever_the_true_segments_are(world, monkeypatch):
    def scrambled(*arguments):
        image = observe(*arguments)
        return image.replace(segmentation=jnp.zeros_like(image.segmentation) + 3)

    full, key = recogniser("full", target_of(SCENE)), jax.random.key(0)
    true = full.images(key, Snapshot(CAMERA, SHELF, world))
    monkeypatch.setattr(recognisers, "observe", scrambled)
    jax.clear_caches()
    assert true.mask is None
    assert true.target_id is None
    jax.tree.map(np.testing.assert_array_equal, full.images(key, Snapshot(CAMERA, SHELF, world)), true)


def test_a_robot_with_the_same_images_recognises_the_same(world, masks, seen):
    """To the bit: the view's pixels in an image of the whole camera, through the front door."""
    target, key = target_of(SCENE), jax.random.key(0)
    robot = Recogniser(types.SimpleNamespace(camera=CAMERA, shelf=SHELF, target=target))
    images, view = masks.images(key, Snapshot(CAMERA, SHELF, world)), robot.view

    def whole(part, rest):
        image = np.full((CAMERA.height, CAMERA.width), rest, part.dtype)
        rows, columns = (
            first + view.stride * np.arange(n) for first, n in zip((view.row, view.column), part.shape, strict=True)
        )
        image[np.ix_(rows, columns)] = part
        return image

    depth, mask = whole(np.asarray(images.depth), np.nan), whole(np.asarray(images.mask), OTHER)
    again = robot(jax.random.key(7), depth, mask=mask, target_id=int(images.target_id))
    jax.tree.map(np.testing.assert_array_equal, again, seen)


@pytest.mark.slow
def test_without_masks_most_visible_objects_are_separated(world):
    recognised = recogniser("full", target_of(SCENE))(jax.random.key(0), Snapshot(CAMERA, SHELF, world))
    bodies, there = nearest_bodies(world, recognised.objects)
    truth = jax.tree.map(lambda a: a[bodies], sharpened(true_superquadrics(world)))
    overlap = np.asarray(intersection_over_union(truth, recognised.objects))[np.asarray(there)]
    assert (overlap > 0.5).sum() >= 4


@pytest.mark.slow
def test_a_target_that_is_not_detected_is_given_to_no_object(world):
    full, key, view = recogniser("full", target_of(SCENE)), jax.random.key(0), thinned_view(CAMERA, SHELF)
    x, _, z = SCENE.target.position
    peeping = moved(world, TARGET, [x, -0.034, z])
    images = full.images(key, Snapshot(CAMERA, SHELF, peeping))
    fitted, visible = full.core.fitted(CAMERA, view, SHELF, images)
    owner = np.asarray(observe(view.camera, peeping, SHELF).segmentation)
    labels = np.asarray(fitted.labels)[owner == TARGET]
    assert not visible
    assert 5 < len(labels) <= found_pixels(CAMERA) / view.stride**2
    assert (labels < 0).all()
    np.testing.assert_array_equal(fitted.confidence > 0.0, fitted.objects.valid)
