"""Segments that do not explain the image are split, joined or left as they are."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.images.cloud import above_board, thinned_view
from mechsearch_jax.images.labels import CAPACITY, FREE, OTHER
from mechsearch_jax.perception.confidence import Measures, confidence_of
from mechsearch_jax.perception.explanation import Explaining
from mechsearch_jax.perception.hypotheses import WAYS
from mechsearch_jax.perception.recognition import LabelledImage, ShapeNetwork
from mechsearch_jax.perception.refinement import RefinementConfig
from mechsearch_jax.perception.selection import Costs, moves_of, sample_of, select_objects
from mechsearch_jax.workspace.camera import Camera, back_project, rays
from mechsearch_jax.workspace.render import object_depth
from mechsearch_jax.workspace.scenario import Body, superquadrics
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

CAMERA, SHELF = Camera(), Shelf()
VIEW = thinned_view(CAMERA, SHELF)
MIDDLE = (SHELF.front + SHELF.back) / 2, (SHELF.left + SHELF.right) / 2


def box(x, y, half):
    return Body("box", half, (MIDDLE[0] + x, MIDDLE[1] + y, SHELF.board + half[2]), (1.0, 0.0, 0.0, 0.0))


BODIES = (
    box(-0.05, -0.05, (0.03, 0.04, 0.05)),
    box(0.0, 0.031, (0.03, 0.04, 0.09)),
    box(0.0, 0.25, (0.04, 0.03, 0.06)),
)


TARGET = Target.of("cylinder")
TARGET_BODY = Body(
    "cylinder",
    TARGET.half_size,
    (MIDDLE[0], MIDDLE[1] - 0.25, SHELF.board + TARGET.half_size[2]),
    (1.0, 0.0, 0.0, 0.0),
)


@pytest.fixture(scope="module")
def explained():
    """A function of the segment of each body, and of the target if it is there: what explains the image of `BODIES`.

    Of the target's pixels those of a segment are not detected as the target's: the left part of it.
    """
    camera, directions = VIEW.camera, rays(VIEW.camera)
    origin = jnp.array(camera.position)
    board = (SHELF.board - camera.position[2]) / np.minimum(np.asarray(directions)[..., 2], -1e-6)

    def explain(*segments):
        truth = superquadrics([*BODIES, TARGET_BODY][: len(segments)])
        depths = np.stack(
            [object_depth(jax.tree.map(lambda a, i=i: a[i], truth), origin, directions) for i in range(len(segments))]
        )
        depth = np.minimum(depths.min(axis=0), board)
        points = back_project(camera, jnp.asarray(depth, jnp.float32))
        owner = np.where(np.asarray(above_board(SHELF, points)), depths.argmin(axis=0), FREE)
        labels = np.where(owner >= 0, np.array(segments)[np.maximum(owner, 0)], owner).astype(np.int8)
        of_target = owner == len(BODIES)
        left = of_target & (np.asarray(points)[..., 1] > TARGET_BODY.position[1] + 0.005)
        labels[of_target & ~left] = CAPACITY
        image = LabelledImage(
            points, jnp.asarray(depth, jnp.float32), jnp.asarray(labels), jnp.asarray(of_target & ~left)
        )
        settings = ShapeNetwork.of(), camera, SHELF, TARGET, RefinementConfig()
        return labels, Explaining()(jax.random.split(jax.random.key(0)), image, *settings)

    return explain


def recognised(scene):
    """Distance of each body from the nearest object [m], and the number of objects."""
    places = np.asarray(scene.position)[np.asarray(scene.valid)]
    truth = np.array([body.position for body in BODIES])
    return np.linalg.norm(truth[:, None] - places[None], axis=-1).min(axis=1), len(places)


@pytest.mark.slow
def test_right_segments_stay_and_two_in_one_are_split(explained):
    labels, right = explained(0, 1, 2)
    np.testing.assert_array_equal(right.labels, labels)
    assert not np.asarray(right.changed).any()
    errors, count = recognised(right.objects)
    assert errors.max() < 0.01
    assert count == 3

    _, split = explained(0, 0, 2)
    errors, count = recognised(split.objects)
    assert errors.max() < 0.02
    assert count == 3
    assert np.asarray(split.changed).sum() == 2
    assert (np.asarray(right.confidence) > 0.9).tolist() == np.asarray(right.objects.valid).tolist()

    # What the segmenter gave to no object, such as a target that is not detected, is given to none.
    labels, rest = explained(0, 1, OTHER)
    np.testing.assert_array_equal(np.asarray(rest.labels)[labels == OTHER], OTHER)
    assert recognised(rest.objects)[1] == 2


@pytest.mark.slow
def test_no_object_stands_in_a_found_target(explained):
    """A part of it has a segment, and its own pixels have a label beyond the slots."""
    labels, seen = explained(0, 1, 2, 3)
    assert (labels == 3).sum() > 20
    assert (labels == CAPACITY).sum() > 50
    errors, count = recognised(seen.objects)
    assert errors.max() < 0.01
    assert count == 3
    assert not np.isin(np.asarray(seen.labels)[labels >= 3], range(CAPACITY)).any()
    np.testing.assert_allclose(seen.target_pose[:2], TARGET_BODY.position[:2], atol=0.01)


BOX = (0.03, 0.03, 0.05)


@functools.partial(jax.jit, static_argnames="costs")
def chosen_of(scene, image, united, pixels, costs):
    """The selection among segments, what the first is split into, and the union of the first two if there is one."""
    base = jax.tree.map(lambda a: a[:CAPACITY], scene)
    sample = sample_of(jax.random.key(0), image, base, VIEW.camera, SHELF, costs)
    pair = jnp.zeros(1, int), jnp.ones(1, int)
    moves = moves_of(CAPACITY, jnp.zeros(1, int), jnp.zeros(WAYS, bool), pair, united)
    return select_objects(scene, moves, sample, pixels, costs)


def selection(bodies, shown, unions=(), target=None, costs=None, segmented=None):
    """What is selected of bodies for the first segments and for the first unions, in an image of the bodies `shown`, of
    which the first `segmented`, all if None, have segments."""
    count = 2 * WAYS
    scene = superquadrics([*bodies], CAPACITY + count + 2)
    absent = np.arange(scene.capacity) >= len(bodies)
    scene = scene.replace(valid=jnp.asarray(~absent))
    for i, body in [*enumerate(unions, CAPACITY + count), *([(scene.capacity - 1, target)] if target else [])]:
        alone = superquadrics([body])
        scene = jax.tree.map(lambda a, b, i=i: a.at[i].set(b[0]), scene, alone)
    camera, directions = VIEW.camera, rays(VIEW.camera)
    truth = superquadrics(shown)
    origin = jnp.array(camera.position)
    depths = np.stack(
        [object_depth(jax.tree.map(lambda a, i=i: a[i], truth), origin, directions) for i in range(len(shown))]
    )
    depth, owner = depths.min(axis=0), depths.argmin(axis=0)
    points = back_project(camera, jnp.asarray(np.where(np.isfinite(depth), depth, np.nan), jnp.float32))
    shows = np.isfinite(depth)
    owner = np.where(owner < (len(shown) if segmented is None else segmented), owner, OTHER)
    labels = np.where(shows, owner, FREE).astype(np.int8)
    image = LabelledImage(points, jnp.asarray(depth, jnp.float32), jnp.asarray(labels), jnp.zeros(depth.shape, bool))
    pixels = jnp.zeros(CAPACITY, int).at[0].set(int(shows.sum()))
    chosen = chosen_of(scene, image, jnp.full(1, bool(unions)), pixels, costs or Costs())
    return np.flatnonzero(chosen.selected).tolist(), np.asarray(chosen.margin)


def test_a_phantom_in_an_object_is_dropped():
    kept, margin = selection([box(0.0, 0.0, BOX)], [box(0.0, 0.0, BOX)])
    assert kept == [0]
    # Without it, its pixels would be unexplained.
    assert margin[0] > 100.0
    # The second box explains nothing that the first one does not.
    assert selection([box(0.0, 0.0, BOX), box(0.005, 0.0, BOX)], [box(0.0, 0.0, BOX)])[0] == [0]


def test_the_target_is_priced_like_an_object():
    shown, target, last = [box(0.0, 0.0, BOX)], box(0.035, 0.0, BOX), CAPACITY + 2 * WAYS + 1
    cheap, dear = (selection(shown, shown, target=target, costs=Costs(overlap_cost=cost)) for cost in (20.0, 40.0))
    assert cheap[0] == dear[0] == [0, last]
    # It is 2.5 cm in the target, of which 1 cm is recognition's own error.
    assert cheap[1][0] - dear[1][0] == pytest.approx(30.0, abs=1.0)


def test_two_objects_in_one_another_become_one():
    whole = box(0.0, 0.0, (0.03, 0.08, 0.05))
    parts = [box(0.0, -0.03, (0.03, 0.05, 0.05)), box(0.0, 0.03, (0.03, 0.05, 0.05))]
    assert selection(parts, [whole], unions=[whole])[0] == [CAPACITY + 2 * WAYS]


def test_pixels_of_no_segment_speak_for_no_object():
    """The second box would explain what is shown of it, but that belongs to no segment."""
    bodies = [box(0.0, -0.1, BOX), box(0.0, 0.1, BOX)]
    assert selection(bodies, bodies)[0] == [0, 1]
    assert selection(bodies, bodies, segmented=1)[0] == [0]


def test_confidence_falls_with_what_is_measured():
    """Each measure alone makes an object less sure; an absent object has no confidence."""
    sure = {"valid": True, "pixels": 500, "misfit": 0.0, "error": 0.001, "margin": np.inf}
    worse = {"misfit": 0.2, "error": 0.02, "margin": 5.0, "valid": False}
    rows = [sure, *({**sure, name: value} for name, value in worse.items())]
    measures = Measures(**{name: jnp.array([row[name] for row in rows]) for name in sure})
    best, *others = np.asarray(confidence_of(measures)).tolist()
    assert 0.95 < best < 1.0
    assert all(other < best for other in others)
    assert others[-1] == 0.0
