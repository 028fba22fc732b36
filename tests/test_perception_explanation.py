"""Segments that do not explain the image are split, joined or left as they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.images.cloud import above_board, thinned_view
from mechsearch_jax.images.labels import FREE
from mechsearch_jax.perception.explanation import ExplanationConfig, explained_image
from mechsearch_jax.perception.recognition import LabelledImage, ShapeNetwork
from mechsearch_jax.perception.refinement import RefinementConfig
from mechsearch_jax.runtime.errors import InputError
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


@pytest.fixture(scope="module")
def explained():
    """A function of the segment of each body: what explains the image of `BODIES`."""
    camera, directions = VIEW.camera, rays(VIEW.camera)
    truth = superquadrics(BODIES)
    origin = jnp.array(camera.position)
    depths = np.stack([object_depth(jax.tree.map(lambda a, i=i: a[i], truth), origin, directions) for i in range(3)])
    board = (SHELF.board - camera.position[2]) / np.minimum(np.asarray(directions)[..., 2], -1e-6)
    depth = np.minimum(depths.min(axis=0), board)
    points = back_project(camera, jnp.asarray(depth, jnp.float32))
    shown = np.where(np.asarray(above_board(SHELF, points)), depths.argmin(axis=0), FREE)
    shapes, none = ShapeNetwork.of(), np.zeros(depth.shape, bool)

    def explain(*segments):
        labels = np.where(shown >= 0, np.array(segments)[np.maximum(shown, 0)], shown).astype(np.int8)
        image = LabelledImage(points, jnp.asarray(depth, jnp.float32), jnp.asarray(labels), jnp.asarray(none))
        keys, target = jax.random.split(jax.random.key(0), 3), Target.of("cylinder")
        settings = shapes, camera, SHELF, target, RefinementConfig(), ExplanationConfig()
        return labels, explained_image(keys, image, *settings)[0]

    return explain


def found(scene):
    """Distance of each body from the nearest object [m], and the number of objects."""
    places = np.asarray(scene.position)[np.asarray(scene.valid)]
    truth = np.array([body.position for body in BODIES])
    return np.linalg.norm(truth[:, None] - places[None], axis=-1).min(axis=1), len(places)


@pytest.mark.slow
def test_right_segments_stay_and_two_in_one_are_split(explained):
    labels, right = explained(0, 1, 2)
    np.testing.assert_array_equal(right.labels, labels)
    assert not np.asarray(right.changed).any()
    errors, count = found(right.scene)
    assert errors.max() < 0.01
    assert count == 3

    _, split = explained(0, 0, 2)
    errors, count = found(split.scene)
    assert errors.max() < 0.02
    assert count == 3
    assert np.asarray(split.changed).sum() == 2


def test_impossible_settings_are_refused():
    with pytest.raises(InputError, match="gain"):
        ExplanationConfig(gain=-1.0)
    with pytest.raises(InputError, match="at most 8"):
        ExplanationConfig(splits=9)
