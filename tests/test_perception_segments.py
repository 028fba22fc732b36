"""Segments: cut, joined, kept, and numbered."""

import types

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
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.bodies import PARTS
from mechsearch_jax.images.labels import CAPACITY, FREE, INSTANCES, MISSING, OTHER
from mechsearch_jax.images.trained_view import TrainedView
from mechsearch_jax.networks import segmentation as networks
from mechsearch_jax.perception.parts.joining import FLOATS, TOUCHES, join_floating
from mechsearch_jax.perception.parts.segments import Connected, SegmentsConfig, connected_segments
from mechsearch_jax.perception.parts.unions import Evidence
from mechsearch_jax.perception.recogniser import labelled
from mechsearch_jax.perception.segmentation import NetworkSegmenter, leave_out_smallest
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


BOARD = 0.4
SIDE = 0.02


def cubes(*places, parts=1):
    """Bodies of upright cubes at x and at heights of their undersides above the board, with points all over them."""
    n = len(places)
    scene = superquadric.empty(n, PARTS)
    there = np.zeros((n, PARTS), bool)
    there[:, :parts] = True
    centres = np.zeros((n, PARTS, 3), np.float32)
    for i, (x, low) in enumerate(places):
        centres[i] = x, 0.0, BOARD + low + SIDE
    size = np.full((n, PARTS, 3), SIDE, np.float32)
    pieces = scene.parts.replace(
        valid=there, position=centres, size=size, exponents=np.full((n, PARTS, 2), 0.2, np.float32)
    )
    side = np.linspace(-SIDE, SIDE, 9)
    grid = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    shell = grid[np.max(np.abs(grid), axis=1) > SIDE - 1e-6].astype(np.float32)
    points = centres[:, :1] + shell[None]
    count = points.shape[1]
    evidence = Evidence(
        points=points,
        point_weight=np.ones((n, count), np.float32),
        origin=np.zeros((n, 3), np.float32),
        directions=np.ones((n, 1, 3), np.float32),
        free=np.zeros((n, 1), np.float32),
        ray_weight=np.ones(n, np.float32),
        pixels=np.full(n, float(count), np.float32),
        exact=np.full(n, 0.002, np.float32),
    )
    return jax.tree.map(jnp.asarray, (pieces, evidence))


def owners(*places, parts=1):
    after, owner = join_floating(*cubes(*places, parts=parts), BOARD)
    return after, np.asarray(owner).tolist()


def test_a_piece_that_stands_on_another_one_belongs_to_it():
    after, owner = owners((0.0, 0.0), (0.2, 0.0), (0.0, 2 * SIDE + 0.5 * TOUCHES))
    assert owner == [0, 1, 0]
    assert np.sum(np.asarray(after.valid), axis=1).tolist() == [2, 1, 0]
    heights = np.sort(np.asarray(after.position)[0, :2, 2])
    np.testing.assert_allclose(heights, BOARD + SIDE + np.array([0.0, 2 * SIDE + 0.5 * TOUCHES]), atol=1e-6)


def test_what_stands_or_touches_nothing_stays_as_it_is():
    for places in (
        ((0.0, 0.0), (2 * SIDE + 0.5 * TOUCHES, 0.0)),
        ((0.0, 0.0), (0.0, 2 * SIDE + 2 * TOUCHES)),
        ((0.0, 0.0), (2 * SIDE + 0.5 * TOUCHES, 0.5 * FLOATS)),
    ):
        before = cubes(*places)[0]
        after, owner = owners(*places)
        assert owner == list(range(len(places)))
        jax.tree.map(np.testing.assert_array_equal, after, before)


def test_a_tower_is_one_body_whatever_its_order():
    step = 2 * SIDE + 0.5 * TOUCHES
    for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
        after, owner = owners(*((0.0, k * step) for k in order))
        assert len(set(owner)) == 1
        assert np.sum(np.asarray(after.valid)) == 3


@settings(deadline=None, max_examples=10)
@given(st.lists(st.tuples(st.floats(0.0, 0.3), st.floats(0.0, 0.2)), min_size=3, max_size=3))
@pytest.mark.slow
def test_eager_compiled_and_batched_agree(places):
    arguments = cubes(*places)
    eager = join_floating(*arguments, BOARD)
    compiled = jax.jit(join_floating)(*arguments, jnp.float32(BOARD))
    batched = jax.vmap(join_floating, in_axes=(0, 0, None))(*jax.tree.map(lambda a: a[None], arguments), BOARD)
    for other in (compiled, jax.tree.map(lambda a: a[0], batched)):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), eager, other)
    # What is joined stays so.
    parts, owner = jax.device_get(eager)
    assert all(owner[owner[i]] == owner[i] for i in range(len(places)))
    assert [bool(parts.valid[i].any()) for i in range(len(places))] == [owner[i] == i for i in range(len(places))]


SIZES = np.array([9, 8, 3, 7, 6, 12, 5, 4, 10])


def stripes(sizes):
    """One row of pixels for each segment, so many long; beside them the shelf, and a pixel that was not measured."""
    labels = np.where(np.arange(14)[None] < np.asarray(sizes)[:, None], np.arange(len(sizes))[:, None], FREE)
    labels[0, 13] = MISSING
    return labels.astype(np.int8)


def test_of_nine_segments_the_smallest_is_left_out_and_the_last_takes_its_number():
    labels = stripes(SIZES)
    kept = np.asarray(leave_out_smallest(jnp.asarray(labels), 9, CAPACITY))
    np.testing.assert_array_equal(kept, np.where(labels == 2, OTHER, np.where(labels == 8, 2, labels)))
    last = stripes([*SIZES[:8], 1])
    kept = np.asarray(leave_out_smallest(jnp.asarray(last), 9, CAPACITY))
    np.testing.assert_array_equal(kept, np.where(last == 8, OTHER, last))


def test_of_fewer_segments_none_is_left_out():
    labels = stripes([*SIZES[:4], 0, *SIZES[5:]])
    kept = np.asarray(leave_out_smallest(jnp.asarray(labels), 9, CAPACITY))
    np.testing.assert_array_equal(kept, np.where(labels == 8, 4, labels))


SHELF = Shelf()
COLUMNS = np.delete(np.arange(9 * 20), np.s_[60:75])
INSTANCE = COLUMNS // 20
# A row of points: nine things beside each other, of which the fourth is smallest.
Y = SHELF.right + 0.03 + 0.08 * INSTANCE + 0.001 * (COLUMNS % 20)
POINTS = np.stack([np.full(Y.shape, 0.6), Y, np.full(Y.shape, 0.5)], axis=-1)[None].astype(np.float32)


def labels_of(monkeypatch, shelf, points, view=None):
    """What the segmenter makes of a network that tells nine things apart by where they are."""

    def network(_, parameters, cloud):
        nearest = jnp.argmin(jnp.abs(cloud[0][:, None, 1] - jnp.asarray(Y)[None]), axis=1)
        logits = jax.nn.one_hot(jnp.asarray(INSTANCE)[nearest], INSTANCES + 1)
        return types.SimpleNamespace(logits=logits[None, None])

    monkeypatch.setattr(networks, "apply_network", network)
    nowhere = jnp.zeros(points.shape[:2], bool)
    segmented = jax.jit(lambda points: NetworkSegmenter({}, None, view)(jax.random.key(0), shelf, points, nowhere))
    return np.asarray(segmented(points))[0]


def test_the_networks_nine_segments_become_eight(monkeypatch):
    labels = labels_of(monkeypatch, SHELF, POINTS)
    np.testing.assert_array_equal(labels, np.where(INSTANCE == 3, OTHER, np.where(INSTANCE == 8, 3, INSTANCE)))


def test_the_network_sees_a_shelf_elsewhere_as_that_of_its_training(monkeypatch):
    shift = (0.2, -0.1, 0.25)
    usual = labels_of(monkeypatch, SHELF, POINTS, TrainedView())
    elsewhere = SHELF.moved(shift), POINTS + np.float32(shift)
    np.testing.assert_array_equal(labels_of(monkeypatch, *elsewhere, TrainedView()), usual)
    assert (labels_of(monkeypatch, *elsewhere) != usual).any()
