"""Labels of an image from a network's: no more segments than there are slots for objects."""

import types

import jax
import jax.numpy as jnp
import numpy as np

from mechsearch_jax.images.labels import CAPACITY, FREE, INSTANCES, MISSING, OTHER
from mechsearch_jax.images.trained_view import TrainedView
from mechsearch_jax.networks import segmentation as networks
from mechsearch_jax.perception.segmentation import NetworkSegmenter, leave_out_smallest
from mechsearch_jax.workspace.shelf import Shelf

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
