"""Labels of an image from a network's: no more segments than there are slots for objects."""

import types

import jax
import jax.numpy as jnp
import numpy as np

from mechsearch_jax.perception import segmentation
from mechsearch_jax.perception.labels import FREE, INSTANCES, MISSING, OTHER
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
    found = np.asarray(leave_out_smallest(jnp.asarray(labels)))
    np.testing.assert_array_equal(found, np.where(labels == 2, OTHER, np.where(labels == 8, 2, labels)))
    last = stripes([*SIZES[:8], 1])
    found = np.asarray(leave_out_smallest(jnp.asarray(last)))
    np.testing.assert_array_equal(found, np.where(last == 8, OTHER, last))


def test_of_fewer_segments_none_is_left_out():
    labels = stripes([*SIZES[:4], 0, *SIZES[5:]])
    found = np.asarray(leave_out_smallest(jnp.asarray(labels)))
    np.testing.assert_array_equal(found, np.where(labels == 8, 4, labels))


def test_the_networks_nine_segments_become_eight(monkeypatch):
    """A network that tells nine things apart by where they are, of which the fourth is smallest."""
    shelf = Shelf()
    columns = np.delete(np.arange(9 * 20), np.s_[60:75])
    instance = columns // 20
    y = shelf.right + 0.03 + 0.08 * instance + 0.001 * (columns % 20)
    points = np.stack([np.full(y.shape, 0.6), y, np.full(y.shape, 0.5)], axis=-1)[None].astype(np.float32)

    def network(_, parameters, cloud):
        nearest = jnp.argmin(jnp.abs(cloud[0][:, None, 1] - jnp.asarray(y)[None]), axis=1)
        logits = jax.nn.one_hot(jnp.asarray(instance)[nearest], INSTANCES + 1)
        return types.SimpleNamespace(logits=logits[None, None])

    monkeypatch.setattr(segmentation, "apply_network", network)
    nowhere = jnp.zeros(points.shape[:2], bool)
    labels = np.asarray(NetworkSegmenter({}, None)(jax.random.key(0), shelf, jnp.asarray(points), nowhere))[0]
    np.testing.assert_array_equal(labels, np.where(instance == 3, OTHER, np.where(instance == 8, 3, instance)))
