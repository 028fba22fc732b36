"""Segments of things of any shape: cut where depth jumps, joined where it does not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from mechsearch_jax.envs.camera import recognisers
from mechsearch_jax.envs.camera.snapshot import Snapshot
from mechsearch_jax.envs.scenes.scene_sets import find_scene, make_scene
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.images.labels import CAPACITY, FREE, MISSING, OTHER
from mechsearch_jax.perception.parts.segments import Connected, SegmentsConfig, connected_segments
from mechsearch_jax.perception.recogniser import labelled
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.detector import SAMPLED, found_pixels
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

CONFIG = SegmentsConfig()
PIXEL = 0.0025


def image(rectangles, size=(40, 60)):
    """Points and labels of upright plates in front of nothing: row and column ranges, distance [m], and label."""
    rows, columns = np.meshgrid(np.arange(size[0]), np.arange(size[1]), indexing="ij")
    points = np.stack([np.full(size, 2.0), PIXEL * columns, PIXEL * rows], axis=-1).astype(np.float32)
    labels = np.full(size, FREE, np.int8)
    for (top, bottom), (left, right), distance, label in rectangles:
        points[top:bottom, left:right, 0] = distance
        labels[top:bottom, left:right] = label
    return points, labels


def things(rectangles, config=CONFIG, least=0.0):
    """The segments of an image, as the pixels of each."""
    points, labels = image(rectangles)
    after = np.asarray(connected_segments(points, labels, config, least))
    assert after.dtype == labels.dtype
    return [after == number for number in range(CAPACITY) if (after == number).any()], after


def test_one_segment_of_two_things_is_cut():
    for apart in (((5, 25), (20, 30), 0.9, 3), ((5, 25), (30, 40), 0.9, 3)):
        segments, _ = things([((5, 25), (5, 20), 0.8, 3), apart])
        assert sorted(int(each.sum()) for each in segments) == [200, 300]


def test_segments_of_one_thing_are_joined_over_a_long_border_without_a_jump():
    just, less = int(CONFIG.border) + 1, int(CONFIG.border)
    for length, jump, count in ((just, 0.0, 1), (less, 0.0, 2), (just, 1.5 * CONFIG.jump, 2)):
        sides = [((0, 20), (5, 20), 0.8, 0), ((20 - length, 40 - length), (20, 35), 0.8 + jump, 5)]
        assert len(things(sides)[0]) == count, (length, jump)


def test_short_borders_of_joined_pieces_add_up():
    # The third piece borders on either of the others over fewer pixels than it takes, and on both together over more.
    pieces = [((0, 20), (0, 20), 0.8, 0), ((20, 40), (0, 20), 0.8, 1), ((12, 28), (20, 40), 0.8, 2)]
    assert len(things(pieces)[0]) == 1
    assert len(things([pieces[0], pieces[2]])[0]) == 2


def test_the_largest_are_kept_and_crumbs_are_no_things():
    # Ten plates that nothing connects, the first ones largest.
    plates = [((4 * i, 4 * i + 3), (0, 50 - 3 * i), 0.8, i % 9) for i in range(10)]
    segments, after = things(plates)
    assert [int(each.sum()) for each in segments] == [3 * (50 - 3 * i) for i in range(CAPACITY)]
    assert all((after[4 * i : 4 * i + 3, : 50 - 3 * i] == OTHER).all() for i in (8, 9))
    small = ((0, 2), (0, 5), 0.8, 4)
    assert not things([small])[0]
    large = [((0, 10), (0, 10), 0.8, 4)]
    assert len(things(large, least=99.0)[0]) == 1
    assert not things(large, least=100.0)[0]


def test_what_is_no_segment_stays_what_it_is():
    points, labels = image([((5, 25), (5, 20), 0.8, 3), ((5, 25), (20, 30), 0.8, OTHER)])
    labels[10, 10:15] = MISSING
    points[10, 10:15] = np.nan
    after = np.asarray(connected_segments(points, labels, CONFIG))
    np.testing.assert_array_equal(after[labels < 0], labels[labels < 0])
    assert (after[labels >= 0] == 0).all()


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**31 - 1))
@pytest.mark.slow
def test_pieces_are_those_of_a_reference_and_compiled_and_batched_agree(seed):
    """With no joining, segments are the connected components of each label, which SciPy finds."""
    rng = np.random.default_rng(seed)
    points, labels = image([])
    coarse = rng.integers(-2, 4, (4, 5))
    labels[:] = np.kron(coarse, np.ones((10, 12)))
    points[..., 0] = 0.8
    alone = SegmentsConfig(border=1e9, least=0.0)
    after = np.asarray(connected_segments(points, labels, alone))
    reference = []
    for label in range(4):
        pieces, count = ndimage.label(labels == label)
        reference += [pieces == number for number in range(1, count + 1)]
    kept = sorted((int(piece.sum()) for piece in reference), reverse=True)[:CAPACITY]
    assert [int((after == number).sum()) for number in range(len(kept))] == kept
    for piece in reference:
        assert len(np.unique(after[piece])) == 1
    with jax.disable_jit():
        eager = np.asarray(connected_segments(jnp.asarray(points), jnp.asarray(labels), alone))
    batched = jax.vmap(lambda p, x: connected_segments(p, x, alone))(points[None], labels[None])[0]
    np.testing.assert_array_equal(eager, after)
    np.testing.assert_array_equal(batched, after)


@pytest.mark.slow
def test_each_household_thing_of_a_shelf_has_one_segment():
    """A drill, a bottle, a carton and a spray bottle, of which the network alone makes eight segments."""
    world = from_scenario(make_scene(*find_scene("household-4-162")))
    snapshot = Snapshot(Camera(), Shelf(), world)
    view = snapshot.view
    eyes, key = recognisers.recogniser("full-parts", Target.of("cylinder")), jax.random.key(0)
    core = eyes.core
    unseen = found_pixels(snapshot.camera) / view.stride**2
    seen, _ = labelled(core, key, snapshot.camera, view, snapshot.shelf, eyes.images(key, snapshot))
    after = np.asarray(connected_segments(seen.points, seen.labels, CONFIG, SAMPLED * unseen))
    true = np.asarray(
        recognisers.true_labels(seen.points, recognisers.observe(view.camera, world, Shelf()).segmentation, Shelf())
    )
    assert len(np.unique(np.asarray(seen.labels)[np.asarray(seen.labels) >= 0])) > 4
    assert sorted(np.unique(after[after >= 0])) == [0, 1, 2, 3]
    for thing in range(4):
        numbers, counts = np.unique(after[true == thing], return_counts=True)
        assert numbers[np.argmax(counts)] >= 0
        assert counts.max() > 0.95 * counts.sum()
    assert jnp.sum(after >= 0) >= 0.95 * np.sum((true >= 0) & (true < 4))
    # Each has its object, whether one superquadric explains it or not.
    fitted = Connected()(
        jax.random.split(jax.random.key(1)),
        seen,
        core.shapes,
        view.camera,
        snapshot.shelf,
        core.target,
        core.refinement,
        least=SAMPLED * unseen,
    )
    np.testing.assert_array_equal(fitted.labels, after)
    assert np.asarray(fitted.objects.valid).tolist() == [True] * 4 + [False] * 4
    assert not np.asarray(fitted.changed).any()
