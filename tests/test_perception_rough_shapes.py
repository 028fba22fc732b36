"""Shapes around points, and what stands on something else than the board."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.images.cloud import above_board, thinned_view
from mechsearch_jax.images.labels import CAPACITY, FREE
from mechsearch_jax.perception.explanation import as_segmented
from mechsearch_jax.perception.hypotheses import standing
from mechsearch_jax.perception.recognition import LabelledImage, ShapeNetwork
from mechsearch_jax.perception.refinement import RefinementConfig
from mechsearch_jax.perception.rough_shapes import SHAPES, rough_shapes
from mechsearch_jax.perception.selection import Sample
from mechsearch_jax.workspace.camera import Camera, back_project, rays
from mechsearch_jax.workspace.render import object_depth
from mechsearch_jax.workspace.scenario import Body, superquadrics
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

CAMERA, SHELF = Camera(), Shelf()
VIEW = thinned_view(CAMERA, SHELF)
MIDDLE = (SHELF.front + SHELF.back) / 2, (SHELF.left + SHELF.right) / 2
EYE = np.array([-0.05, 0.45, 0.9])
KINDS = BOX, UPRIGHT, ALONG_X, ALONG_Y, LEANING = range(SHAPES)


def box_points(half, count, rng):
    """Points on the faces of a box that are seen from -x and above, and from +y; float64."""
    points = rng.uniform(-1, 1, (count, 3))
    face = rng.integers(0, 3, count)
    points[np.arange(count), face] = np.array([-1, 1, 1])[face]
    return points * half


def guessed(points, board, count=256):
    padded = np.zeros((count, 3), np.float32)
    padded[: len(points)] = points
    valid = jnp.arange(count) < len(points)
    return jax.jit(rough_shapes)(jnp.asarray(padded), valid, jnp.asarray(EYE, jnp.float32), jnp.float32(board))


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.2])
def test_a_wide_box_is_guessed_from_its_points(turn):
    half, place = np.array([0.06, 0.15, 0.04]), np.array([0.6, 0.1, 0.44])
    R = Rotation.from_euler("z", turn).as_matrix()
    guess = guessed(box_points(half, 250, np.random.default_rng(0)) @ R.T + place, 0.4)
    size, axes = np.asarray(guess.size[BOX], float), np.asarray(guess.rotation[BOX], float)
    order = [0, 1, 2] if abs(axes[:, 0] @ R[:, 0]) > 0.7 else [1, 0, 2]
    # Stray points are left out: some 2% at each end.
    np.testing.assert_allclose(size[order], half, atol=0.012)
    np.testing.assert_allclose(guess.position[BOX], place, atol=0.012)
    assert np.abs(axes[:, order[0]] @ R[:, 0]) > np.cos(np.radians(3.1))
    np.testing.assert_allclose(np.linalg.det(np.asarray(guess.rotation, float)), 1.0, atol=1e-5)


def test_half_a_cylinder_is_guessed_whole_and_one_on_its_edge_along_its_axis():
    rng, radius = np.random.default_rng(1), 0.1
    place = np.array([0.6, 0.1, 0.45])
    ahead = np.arctan2(*(place - EYE)[1::-1])
    turn = ahead + np.pi + rng.uniform(-1.5, 1.5, 250)
    side = np.stack([radius * np.cos(turn), radius * np.sin(turn), rng.uniform(-0.05, 0.05, 250)], axis=1)
    upright = guessed(place + side, 0.4)
    np.testing.assert_allclose(upright.size[UPRIGHT], (radius, radius, 0.05), atol=0.008)
    np.testing.assert_allclose(upright.position[UPRIGHT], place, atol=0.01)

    # A tin whose axis is level along y, of which one flat face is seen and the rim above.
    r, turn = radius * np.sqrt(rng.uniform(0, 1, 200)), rng.uniform(0, 2 * np.pi, 200)
    flat = np.stack([r * np.cos(turn), np.full(200, 0.03), r * np.sin(turn)], axis=1)
    rim = rng.uniform(0.2, np.pi - 0.2, 50)
    rim = np.stack([radius * np.cos(rim), rng.uniform(-0.03, 0.03, 50), radius * np.sin(rim)], axis=1)
    lying = guessed(np.concatenate([flat, rim]) + np.array([0.6, 0.1, 0.5]), 0.4)
    assert np.asarray(lying.exponents)[ALONG_Y, 1] == 1.0
    axis = np.argmax(np.abs(np.asarray(lying.rotation)[[ALONG_X, ALONG_Y], 1, 2]))
    tin = jax.tree.map(lambda a: np.asarray(a)[[ALONG_X, ALONG_Y][axis]], lying)
    assert abs(tin.rotation[1, 2]) > 0.99
    np.testing.assert_allclose(tin.size, (radius, radius, 0.03), atol=0.01)


@pytest.mark.parametrize(("turn", "lean"), [(0.0, 0.25), (0.9, -0.3), (-0.5, 1.5708)])
def test_a_leaning_box_is_guessed_from_one_face(turn, lean):
    """Of a leaning book or a flat thing that lies only the face towards the camera is seen."""
    half = np.array([0.01, 0.07, 0.1])
    R = Rotation.from_euler("zy", (turn, lean)).as_matrix()
    face = np.random.default_rng(4).uniform(-1, 1, (250, 3)) * half
    place = np.array([0.6, 0.1, 0.5])
    towards = np.sign(R[:, 0] @ (EYE - place))
    face[:, 0] = half[0] * towards
    guess = guessed(face @ R.T + place, 0.4)
    axes, size = np.asarray(guess.rotation[LEANING], float), np.asarray(guess.size[LEANING], float)
    assert np.abs(axes[:, 2] @ R[:, 0]) > np.cos(np.radians(1))
    np.testing.assert_allclose(size[2], half[0], atol=1e-3)
    np.testing.assert_allclose(np.sort(size), half, atol=0.012)
    np.testing.assert_allclose(guess.position[LEANING], place, atol=0.008)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-5)


def test_nothing_is_guessed_without_points_and_one_face_reaches_away_from_the_camera():
    assert not guessed(np.zeros((0, 3)), 0.4).valid.any()
    face = np.random.default_rng(2).uniform((0.6, 0.0, 0.4), (0.6, 0.2, 0.5), (200, 3))
    guess = guessed(face, 0.4)
    assert guess.valid.all()
    assert np.isfinite(guess.size).all()
    low = np.asarray(guess.position[BOX]) - np.abs(np.asarray(guess.rotation[BOX])) @ np.asarray(guess.size[BOX])
    assert abs(low[0] - 0.6) < 0.003


def sample(points, label):
    index = np.arange(len(points))
    return Sample(jnp.asarray(points, jnp.float32), jnp.asarray(label), jnp.asarray(index), *[None] * 6, 1.0)


def test_what_lies_over_another_stands_on_it_and_what_is_behind_does_not():
    """The lower body is slot 0; another stands on it, and a third behind it shows its upper half only."""
    sizes = jnp.asarray([(0.08, 0.08, 0.03)] + [(0.02,) * 3] * (CAPACITY - 1))
    places = jnp.asarray([(0.6, 0.0, 0.43)] + [(0.6, 9.0, 0.5)] * (CAPACITY - 1))
    edges = jnp.full((CAPACITY, 2), 0.03)
    base = Superquadrics(sizes, edges, places, jnp.broadcast_to(jnp.eye(3), (CAPACITY, 3, 3)), jnp.arange(CAPACITY) < 3)
    rng = np.random.default_rng(3)
    lower = np.concatenate([rng.uniform((0.52, -0.08, 0.4), (0.52, 0.08, 0.46), (60, 3))] * 2)
    lower[60:, 0], lower[60:, 2] = rng.uniform(0.52, 0.68, 60), 0.46
    upper = rng.uniform((0.56, -0.03, 0.46), (0.56, 0.03, 0.55), (60, 3))
    behind = rng.uniform((0.69, -0.03, 0.47), (0.69, 0.03, 0.55), (60, 3))
    points, label = np.concatenate([lower, upper, behind]), np.repeat([0, 1, 2], [120, 60, 60])
    masks = jnp.asarray(label[None, None] == np.arange(3)[:, None, None])
    heights = jax.jit(standing)(masks, base, sample(points, label), jnp.float32(0.4))
    np.testing.assert_allclose(heights, (0.4, 0.46, 0.4), atol=0.002)
    # Turned about the vertical and moved, all is as it was.
    R, shift = Rotation.from_euler("z", 0.7).as_matrix(), np.array([0.1, -0.2, 0.05])
    turned = base.replace(
        position=jnp.asarray(np.asarray(places) @ R.T + shift, jnp.float32),
        rotation=jnp.broadcast_to(jnp.asarray(R, jnp.float32), (CAPACITY, 3, 3)),
    )
    moved = jax.jit(standing)(masks, turned, sample(points @ R.T + shift, label), jnp.float32(0.45))
    np.testing.assert_allclose(moved, np.asarray(heights) + 0.05, atol=0.002)


def recognised(bodies):
    """What is made of the true segments of an image of bodies, and the true bodies."""
    camera, directions = VIEW.camera, rays(VIEW.camera)
    truth, origin = superquadrics(bodies), jnp.array(camera.position)
    each = [jax.tree.map(lambda a, i=i: a[i], truth) for i in range(len(bodies))]
    depths = np.stack([object_depth(body, origin, directions) for body in each])
    board = (SHELF.board - camera.position[2]) / np.minimum(np.asarray(directions)[..., 2], -1e-6)
    depth = jnp.asarray(np.minimum(depths.min(axis=0), board), jnp.float32)
    points = back_project(camera, depth)
    owner = np.where(np.asarray(above_board(SHELF, points)), depths.argmin(axis=0), FREE).astype(np.int8)
    image = LabelledImage(points, depth, jnp.asarray(owner), jnp.zeros(depth.shape, bool))
    settings = ShapeNetwork.of(), camera, SHELF, Target.of("cylinder"), RefinementConfig()
    return as_segmented(jax.random.split(jax.random.key(0)), image, *settings), truth


def test_a_box_on_a_box_is_recognised_where_it_stands():
    lower = Body("box", (0.07, 0.1, 0.03), (*MIDDLE, SHELF.board + 0.03), (1.0, 0.0, 0.0, 0.0))
    upper = Body("box", (0.03, 0.05, 0.05), (*MIDDLE, SHELF.board + 0.11), (0.98, 0.0, 0.0, 0.2))
    seen, truth = recognised([lower, upper])
    assert np.asarray(seen.objects.valid).tolist() == [True, True] + [False] * (CAPACITY - 2)
    # The upper one hides how deep the lower one is.
    np.testing.assert_allclose(seen.objects.position[:2], truth.position[:2], atol=0.02)
    np.testing.assert_allclose(seen.objects.position[1], truth.position[1], atol=0.006)
    np.testing.assert_allclose(seen.objects.size[1, 2], 0.05, atol=0.006)
    assert (np.asarray(seen.confidence)[:2] > 0.5).all()


@pytest.mark.parametrize("lean", [0.25, 0.5])
def test_a_leaning_book_is_recognised_as_it_leans(lean):
    half, R = np.array([0.012, 0.09, 0.11]), Rotation.from_euler("y", lean).as_matrix()
    place = (*MIDDLE, SHELF.board + float(np.abs(R[2]) @ half))
    seen, _ = recognised([Body("box", tuple(half), place, (np.cos(lean / 2), 0.0, np.sin(lean / 2), 0.0))])
    size, axes, at = (
        np.asarray(a[0], float) for a in (seen.objects.size, seen.objects.rotation, seen.objects.position)
    )
    thin = np.argmin(size)
    assert np.abs(axes[:, thin] @ R[:, 0]) > np.cos(np.radians(3))
    np.testing.assert_allclose(np.sort(size), half, atol=0.012)
    np.testing.assert_allclose(at, place, atol=0.012)
    assert at[2] - np.abs(axes[2]) @ size > SHELF.board - 0.004
