"""What an earlier look showed better is kept where this one's image agrees, and nothing else is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.belief.unseen_motion import expected
from mechsearch_jax.geometry.superquadric import Superquadrics, empty, standard_edges
from mechsearch_jax.geometry.transforms import make, yaw_rotation
from mechsearch_jax.images.cloud import above_board, thinned_view
from mechsearch_jax.images.detection import BESIDE, TARGET_POINTS, fitted_pose, other_yaw, steady_pose, turned_by
from mechsearch_jax.images.labels import CAPACITY, FREE
from mechsearch_jax.images.target_pose import SampledPixels
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception import fusion
from mechsearch_jax.perception.confidence import Measures
from mechsearch_jax.perception.explanation import Fitted
from mechsearch_jax.perception.recognition import LabelledImage
from mechsearch_jax.workspace.camera import Camera, back_project, rays
from mechsearch_jax.workspace.render import object_depth
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target
from mechsearch_jax.workspace.target_view import main_body

CAMERA, SHELF, TARGET = Camera(), Shelf(), Target.of("cylinder")
VIEW = thinned_view(CAMERA, SHELF)
X, Y = (SHELF.front + SHELF.back) / 2, (SHELF.left + SHELF.right) / 2
# Half-extents, x and y beside the middle [m], and yaw [rad]: a carton, and what stands beside it.
CARTON, OTHER_BOX = ((0.035, 0.05, 0.085), 0.0, 0.05, 0.1), ((0.03, 0.04, 0.06), 0.02, -0.12, -0.4)


def objects(*boxes):
    """Boxes in the first of `CAPACITY` slots."""
    nothing, count = empty(CAPACITY), len(boxes)
    sizes, x, y, yaw = ([box[i] for box in boxes] for i in range(4))
    sizes = np.array(sizes, np.float32).reshape(-1, 3)
    place = np.stack([X + np.array(x), Y + np.array(y), SHELF.board + sizes[:, 2]], axis=-1)
    found = Superquadrics(
        sizes,
        np.full((count, 2), 0.2),
        place,
        np.array([yaw_rotation(jnp.float32(a)) for a in yaw]).reshape(-1, 3, 3),
        np.ones(count),
    )
    return jax.tree.map(lambda a, b: jnp.asarray(a).at[:count].set(jnp.asarray(b, a.dtype)), nothing, found)


@pytest.fixture(scope="module")
def image():
    """The image of carton and box, with 1 mm of noise, labelled by their numbers."""
    camera, directions = VIEW.camera, rays(VIEW.camera)
    origin, truth = jnp.array(camera.position), objects(CARTON, OTHER_BOX)
    board = (SHELF.board - camera.position[2]) / np.minimum(np.asarray(directions)[..., 2], -1e-6)
    of = [object_depth(jax.tree.map(lambda a, i=i: a[i], truth), origin, directions) for i in range(2)]
    depths = np.stack(of)
    depth = np.minimum(depths.min(axis=0), board)
    depth = jnp.asarray(depth + np.random.default_rng(0).normal(0, 0.001, depth.shape), jnp.float32)
    points = back_project(camera, depth)
    labels = np.where(np.asarray(above_board(SHELF, points)), depths.argmin(axis=0), FREE).astype(np.int8)
    return LabelledImage(points, depth, jnp.asarray(labels), jnp.zeros(labels.shape, bool))


def sure(*values):
    return jnp.zeros(CAPACITY).at[: len(values)].set(jnp.array(values))


def fuse(image, now, before, labels=None):
    """What becomes of boxes and confidences of this look and of the one before, which may be an observation."""
    zeros, labels = jnp.zeros(CAPACITY), image.labels if labels is None else jnp.asarray(labels)
    found = standard_edges(objects(*now[0]))
    fitted = Fitted(
        found, jnp.zeros(3), sure(*now[1]), Measures(found.valid, *[zeros] * 4), labels, jnp.zeros(CAPACITY, bool)
    )
    if isinstance(before, Observation):
        earlier = before
    else:
        earlier = Observation(objects(*before[0]), jnp.array(False), jnp.zeros(3), sure(*before[1]))
    settings = jnp.array(False), VIEW.camera, SHELF, TARGET
    return fitted, fusion.fused(jax.random.key(0), fitted, earlier, image.replace(labels=labels), *settings)


def moved(box, x=0.0, y=0.0, yaw=0.0, longer=0.0):
    """A box elsewhere, and longer than it is along x, where nobody sees it [m]."""
    (a, *rest), at, beside, turned = box
    return (a + longer / 2, *rest), at + x + longer / 2, beside + y, turned + yaw


# Eight centimetres too deep at a confidence of 0.8, as a single look may have it.
DEEP = moved(CARTON, longer=0.08)


def test_a_shape_that_was_seen_well_is_kept(image):
    _, after = fuse(image, ([DEEP, OTHER_BOX], [0.8, 0.95]), ([OTHER_BOX, CARTON], [0.9, 0.99]))
    assert np.flatnonzero(after.objects.valid).tolist() == [0, 1]
    np.testing.assert_allclose(after.objects.size[0], CARTON[0], atol=0.002)
    np.testing.assert_allclose(after.confidence[:2], [0.99, 0.95], atol=1e-6)
    # The box was not surer before, and is what this look made of it.
    assert np.asarray(after.changed).tolist() == [True] + [False] * (CAPACITY - 1)


def test_two_parts_of_what_was_one_are_one_again(image):
    left = (np.asarray(image.labels) == 0) & (np.asarray(image.points)[..., 1] > Y + CARTON[2])
    labels = np.where(left, 2, np.asarray(image.labels)).astype(np.int8)
    half = ((0.035, 0.025, 0.085), 0.0, 0.025, 0.1), ((0.035, 0.025, 0.085), 0.0, 0.075, 0.1)
    _, after = fuse(image, ([half[0], OTHER_BOX, half[1]], [0.5, 0.95, 0.4]), ([CARTON], [0.9]), labels)
    (slot,) = np.unique(np.asarray(after.labels)[left | (labels == 0)])
    assert np.flatnonzero(after.objects.valid).tolist() == sorted([1, slot])
    np.testing.assert_allclose(after.objects.size[slot], CARTON[0], atol=0.002)


def test_a_body_that_was_moved_keeps_its_size_and_is_fitted_where_it_is(image):
    planned = moved(CARTON, x=-0.012, y=0.01, yaw=0.1)
    _, after = fuse(image, ([DEEP, OTHER_BOX], [0.8, 0.95]), ([planned], [0.99]))
    np.testing.assert_allclose(after.objects.size[0], CARTON[0], atol=0.002)
    np.testing.assert_allclose(after.objects.position[0], objects(CARTON).position[0], atol=0.003)
    np.testing.assert_allclose(after.objects.rotation[0], objects(CARTON).rotation[0], atol=0.05)


@pytest.mark.parametrize(
    "before",
    [
        ([], []),
        # Another thing stood there, or the same one farther away than any plan is off.
        ([((0.035, 0.05, 0.13), 0.0, 0.05, 0.1)], [0.99]),
        ([moved(CARTON, x=0.15)], [0.99]),
        # It would reach where this look saw nothing.
        ([((0.035, 0.08, 0.085), 0.0, 0.08, 0.1)], [0.99]),
        # It was no surer.
        ([CARTON], [0.8]),
    ],
)
def test_what_this_look_contradicts_is_not_kept(image, before):
    fitted, after = fuse(image, ([DEEP, OTHER_BOX], [0.8, 0.95]), before)
    for name in ("objects", "confidence", "labels", "changed"):
        jax.tree.map(np.testing.assert_array_equal, getattr(after, name), getattr(fitted, name))


# Low, right behind the carton as the camera sees it.
BEHIND = ((0.02, 0.02, 0.03), 0.075, 0.05, 0.1)


def test_what_is_hidden_now_stands_where_it_stood(image):
    now = ([CARTON, OTHER_BOX], [0.9, 0.95])
    fitted, after = fuse(image, now, ([CARTON, OTHER_BOX, BEHIND], [0.8, 0.8, 0.3]))
    assert np.flatnonzero(after.objects.valid).tolist() == [0, 1, 2]
    np.testing.assert_allclose(after.objects.position[2], objects(BEHIND).position[0], atol=1e-6)
    np.testing.assert_allclose(after.confidence[:3], [0.9, 0.95, 0.3], atol=1e-6)
    np.testing.assert_array_equal(after.labels, fitted.labels)
    # In another slot where its own is taken.
    _, moved_on = fuse(image, now, ([BEHIND], [0.3]))
    np.testing.assert_allclose(moved_on.objects.size[2], BEHIND[0], atol=1e-6)
    # Where it would be seen, or stands something else that is seen, it is not.
    for gone in (moved(BEHIND, y=0.08), moved(BEHIND, x=-0.04)):
        assert np.flatnonzero(fuse(image, now, ([gone], [0.3]))[1].objects.valid).tolist() == [0, 1]


def test_what_is_kept_as_it_was_is_there_once(image, monkeypatch):
    """Where no fit of it with its size kept is as good, such as one that sinks into the board."""
    monkeypatch.setattr(fusion, "LEVEL", -1.0)
    monkeypatch.setattr(fusion, "fused", fusion.fused.__wrapped__)
    _, after = fuse(image, ([DEEP, OTHER_BOX], [0.8, 0.95]), ([OTHER_BOX, CARTON], [0.9, 0.99]))
    assert np.flatnonzero(after.objects.valid).tolist() == [0, 1]
    np.testing.assert_allclose(after.objects.position[0], objects(CARTON).position[0], atol=1e-6)


def test_what_was_carried_away_is_not_remembered_where_it_stood(image):
    """As a `Searcher` expects it after `acted(ok=True)`, where its old place is hidden."""
    was = Observation(objects(CARTON, OTHER_BOX, BEHIND), jnp.array(False), jnp.zeros(3), sure(0.8, 0.8, 0.3))
    place = was.objects.position[2]
    pick = no_action().replace(
        kind=jnp.int32(ActionKind.PICK_AND_PLACE),
        object=jnp.int32(2),
        T_world_gripper=make(jnp.eye(3), place),
        T_world_place=make(jnp.eye(3), place - jnp.float32([0.0, 0.14, 0.0])),
    )
    now = [CARTON, OTHER_BOX], [0.9, 0.95]
    for action, stands in ((no_action(), [0, 1, 2]), (pick, [0, 1])):
        _, after = fuse(image, now, expected(was, action))
        assert np.flatnonzero(after.objects.valid).tolist() == stands


def noisy_image(body, seed):
    """The image of a target's body alone, with 3 mm of noise, and the target's pixels."""
    camera, directions = VIEW.camera, rays(VIEW.camera)
    board = (SHELF.board - camera.position[2]) / np.minimum(np.asarray(directions)[..., 2], -1e-6)
    depth = np.asarray(object_depth(body, jnp.array(camera.position), directions))
    noise = np.random.default_rng(seed).normal(0, 0.003, depth.shape)
    seen = jnp.asarray(np.minimum(depth, board) + noise, jnp.float32)
    return back_project(camera, seen), seen, jnp.asarray(depth < board)


@pytest.mark.parametrize(("wide", "decided"), [(0.036, False), (0.06, True)])
def test_a_yaw_that_an_image_does_not_decide_stays_and_is_said(wide, decided):
    """A box 35 mm deep, and nearly as wide, or much wider."""
    target = Target.of("box", half_size=(0.0175, wide / 2, 0.055))
    place = jnp.array([X, Y, float(target.height(SHELF))])
    body = main_body(target, place, yaw_rotation(jnp.float32(0.4)), jnp.array(True))
    points, depth, of_target = noisy_image(body, 1)
    key, seen = jax.random.key(0), (target, SHELF, VIEW.camera, points, depth, of_target)
    pose, _ = fitted_pose(key, *seen)
    across = pose.at[2].add(jnp.pi / 2)
    steady = steady_pose(key, *seen, pose, across)
    expected = pose if decided else across
    assert float(turned_by(target, steady[2], expected[2])) < 0.1
    np.testing.assert_allclose(steady[:2], place[:2], atol=0.005)
    # One that stood elsewhere does not come back.
    np.testing.assert_array_equal(steady_pose(key, *seen, pose, across.at[0].add(-0.05)), pose)

    rng = np.random.default_rng(2)
    drawn = points[of_target][rng.integers(0, int(of_target.sum()), TARGET_POINTS)]
    near = np.flatnonzero(np.linalg.norm(np.asarray(points) - np.asarray(place), axis=-1) < 0.12)
    flat = [a.reshape(-1, 3) for a in (rays(VIEW.camera), points)]
    chosen = rng.choice(near, BESIDE)
    sample = SampledPixels(*(a[chosen] for a in (*flat, depth.reshape(-1), of_target.reshape(-1))), jnp.zeros(BESIDE))
    other = other_yaw(target, SHELF, jnp.array(VIEW.camera.position), drawn, sample, pose)
    assert bool(jnp.isnan(other)) == decided
    assert decided or float(turned_by(target, other, across[2])) < 0.3
