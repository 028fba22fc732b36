"""The comparison of recognisers: what counts, what is lost, and what is written."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.benchmarks.lab.parts import images, recognition, recognition_methods
from mechsearch_jax.benchmarks.lab.parts.recognition import RecognitionBench, RecognitionRow
from mechsearch_jax.benchmarks.lab.parts.recognition_methods import Method
from mechsearch_jax.envs.world.world import true_superquadrics
from mechsearch_jax.images.cloud import shelf_view
from mechsearch_jax.perception.scores import sharpened
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario
from mechsearch_jax.workspace.shelf import Shelf

SCENE = images.scenes_of([load_scenario(example_scenarios()["first-light"])])[0]
TRUTH = sharpened(true_superquadrics(SCENE.world))
ROW = RecognitionRow("files", "a", 0, "box", "clean", "network", 500, 0.5, "answered", 0.9, 0.001, True)


def method_of(scene, after=None):
    """The method that always gives the same answer."""
    return Method(lambda key, shown, begin: scene, after)


def shifted(key, shown, begin):
    return TRUTH.replace(position=TRUTH.position + jnp.array([[0.005, 0.0, 0.0]]))


METHODS = {
    "truth": method_of(TRUTH),
    "shifted": Method(shifted),
    "mended": method_of(TRUTH, after="shifted"),
    "unchanged": Method(lambda key, shown, begin: begin, after="shifted"),
    "nan": method_of(TRUTH.replace(rotation=TRUTH.rotation.at[0, 1, 1].set(jnp.nan))),
    "silent": method_of(TRUTH.replace(valid=TRUTH.valid.at[0].set(False))),
    "confused": method_of(TRUTH.replace(exponents=TRUTH.exponents.at[:, 1].set(1.01 - TRUTH.exponents[:, 1]))),
}


@pytest.fixture(scope="module")
def bench():
    return RecognitionBench([SCENE], METHODS)


@pytest.fixture(scope="module")
def measured(bench):
    return bench.run()


@pytest.fixture(scope="module")
def summary(measured):
    return {(line["noise"], line["method"], line["visible"]): line for line in measured.summary()}


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["clean", "gaussian"])
def test_the_truth_scores_as_perfect_and_everything_else_worse(summary, noise):
    truth, shifted = summary[noise, "truth", "all"], summary[noise, "shifted", "all"]
    assert truth["objects"] > 1
    assert truth["iou_mean"] > 0.995
    assert truth["centre_median_mm"] == 0
    assert truth["wrong_class"] == truth["not_finite"] == truth["unanswered"] == 0
    assert shifted["centre_median_mm"] == pytest.approx(5.0, abs=1e-3)
    assert shifted["iou_mean"] < truth["iou_mean"] - 0.05
    assert shifted["wrong_class"] == 0
    assert summary[noise, "confused", "all"]["wrong_class"] == 1
    assert summary[noise, "confused", "all"]["iou_mean"] < truth["iou_mean"] - 0.05


def test_the_gain_is_over_the_method_that_it_begins_with(summary):
    mended, unchanged = summary["clean", "mended", "all"], summary["clean", "unchanged", "all"]
    difference = summary["clean", "truth", "all"]["iou_mean"] - summary["clean", "shifted", "all"]["iou_mean"]
    assert mended["gain_mean"] == pytest.approx(difference)
    assert mended["better"] == 1
    assert mended["worse"] == 0
    assert unchanged["gain_mean"] == unchanged["better"] == unchanged["worse"] == 0
    assert "gain_mean" not in summary["clean", "truth", "all"]


def test_what_is_lost_is_counted_and_has_no_overlap(measured, summary):
    truth = summary["clean", "truth", "all"]
    for method, count in (("nan", "not_finite"), ("silent", "unanswered")):
        line = summary["clean", method, "all"]
        assert line["objects"] == truth["objects"]
        assert (line["not_finite"], line["unanswered"]) == ((1, 0) if count == "not_finite" else (0, 1))
        expected = truth["iou_mean"] * (1 - 1 / truth["objects"])
        assert line["iou_mean"] == pytest.approx(expected, abs=0.01)
    (lost,) = [row for row in measured.rows if row.method == "nan" and row.noise == "clean" and row.object == 0]
    assert (lost.outcome, lost.iou, lost.centre, lost.right) == ("not finite", 0.0, None, None)


def test_figures_of_rows_by_hand():
    lost = dataclasses.replace(ROW, outcome="nothing", iou=0.0, centre=None, right=None)
    wrong = dataclasses.replace(ROW, iou=0.6, centre=0.003, right=False)
    value = recognition.figures([ROW, wrong, lost], [wrong, wrong, wrong])
    assert value["iou_mean"] == pytest.approx(0.5)
    assert value["centre_median_mm"] == pytest.approx(3.0)
    assert value["wrong_class"] == 0.5
    assert value["gain_mean"] == pytest.approx(-0.1)
    assert (value["better"], value["worse"]) == (pytest.approx(1 / 3), pytest.approx(1 / 3))
    assert value["gain_standard_error"] == pytest.approx(np.std([0.3, 0.0, -0.6]) / math.sqrt(3))
    # Where most are lost there is no median; and none at all is no mistake.
    assert recognition.figures([ROW, lost, lost])["centre_median_mm"] is None
    assert recognition.figures([]) == {"objects": 0}


def test_only_objects_with_enough_pixels_count(bench, measured):
    _, image = bench.image(0, "clean")
    rows = [row for row in measured.rows if row.method == "truth" and row.noise == "clean"]
    expected = np.flatnonzero(np.asarray(SCENE.world.valid[:8]) & (np.asarray(image.pixels) >= 100))
    assert [row.object for row in rows] == expected.tolist()
    assert all(0 < row.visible <= 1 for row in rows)
    # In a view with every second ray a pixel stands for four of the full image.
    labels = np.asarray(image.shown.labels)
    assert rows[0].pixels == pytest.approx(4 * np.sum(labels == rows[0].object), rel=0.1)


@pytest.mark.slow
def test_held_out_scenes_are_reproducible_and_their_seeds_checked():
    first, again, other = (images.held_out_scenes(2, seed) for seed in (0, 0, 1))
    for a, b, c in zip(first, again, other, strict=True):
        assert a.name == b.name != c.name
        np.testing.assert_array_equal(a.world.position, b.world.position)
        assert not np.array_equal(a.world.position, c.world.position)
    for count, seed in ((-1, 0), (1, -1), (1, 2**31)):
        with pytest.raises(InputError, match=r"--(scenes|seed) -?[0-9]+ must be"):
            images.held_out_scenes(count, seed)


@pytest.mark.slow
def test_refinement_improves_on_the_network_whatever_the_noise():
    """On scenes of a seed that nothing was tuned on; what is hardly visible must not get worse either."""
    methods = recognition.shipped_methods(shelf_view().camera, Shelf())
    chosen = recognition.chosen_methods(methods, ["network-refined"])
    measured = RecognitionBench(images.held_out_scenes(12, 7), chosen, tuple(images.NOISES)).run()
    lines = {(line["noise"], line["visible"]): line for line in measured.summary() if "gain_mean" in line}
    for noise in images.NOISES:
        assert lines[noise, "all"]["objects"] > 40
        assert lines[noise, "all"]["gain_mean"] > 0
        for name, *_ in recognition.SHARES:
            line = lines[noise, name]
            assert line["gain_mean"] > -0.005 - 2 * line["gain_standard_error"], (noise, name)


@pytest.mark.slow
def test_the_classical_method_recognises_what_is_clearly_seen():
    methods = recognition.shipped_methods(shelf_view().camera, Shelf())
    measured = RecognitionBench([SCENE], {"ems": methods["ems"]}, ("clean",)).run()
    visible = [row for row in measured.rows if row.visible > 0.6]
    assert {row.outcome for row in visible} == {"answered"}
    assert max(row.iou for row in visible) > 0.8
    points, labels = recognition_methods.sampled_points(RecognitionBench([SCENE], METHODS).image(0, "clean")[1].shown)
    counts = np.bincount(np.asarray(labels)[np.asarray(labels) >= 0], minlength=8)
    assert counts.max() == recognition.EMS_POINTS
    assert bool(jax.numpy.isfinite(points[labels >= 0]).all())
