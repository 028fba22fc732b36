"""The measurement of segmentation: what counts, what is missed, what is written, and what the picture shows."""

import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.benchmarks.lab.parts import images
from mechsearch_jax.benchmarks.lab.parts.segmentation import SegmentationBench, overlaps, true_masks
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

SCENE = images.scenes_of([load_scenario(example_scenarios()["first-light"])])[0]


def two_as_one(key, shelf, points, of_target, masks):
    """The first object taken for a part of the second."""
    return jnp.where(masks == 0, 1, masks)


@pytest.fixture(scope="module")
def perfect():
    return SegmentationBench([SCENE], ("clean",), labeller=true_masks).run()


@pytest.fixture(scope="module")
def wrong():
    return SegmentationBench([SCENE], ("clean", "gaussian"), labeller=two_as_one)


def test_the_true_masks_are_perfect(perfect):
    assert {row.iou for row in perfect.rows} == {1.0}
    assert {row.objects for row in perfect.rows} == {int(SCENE.world.valid[:TARGET].sum())}
    each, everything = perfect.summary()
    assert everything["objects"] is None
    assert each["iou_mean"] == everything["iou_mean"] == 1.0
    assert everything["missed"] == 0
    assert everything["counted"] <= everything["visible"] == len(perfect.rows)


def test_an_object_that_is_not_separated_counts_as_nothing(wrong):
    rows = {(row.noise, row.object): row for row in wrong.run().rows}
    for noise in ("clean", "gaussian"):
        assert rows[noise, 0].iou == 0.0
        assert 0.0 < rows[noise, 1].iou < 1.0
        assert all(row.iou == 1.0 for (sensor, i), row in rows.items() if sensor == noise and i > 1)


def test_overlaps_are_those_of_a_plain_count():
    rng = np.random.default_rng(0)
    segments, truth = rng.integers(-3, 6, (2, 20, 30))
    iou = overlaps(segments, truth)
    for i in range(TARGET):
        both, either = np.sum((segments == i) & (truth == i)), np.sum((segments == i) | (truth == i))
        assert iou[i] == pytest.approx(both / either) if (truth == i).any() else np.isnan(iou[i])
