"""The comparison of recognisers: what counts, what is lost, and what is written."""

import dataclasses
import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.benchmarks.lab.commands import quality
from mechsearch_jax.benchmarks.lab.parts import images, recognition, recognition_methods
from mechsearch_jax.benchmarks.lab.parts.recognition import RecognitionBench, RecognitionRow
from mechsearch_jax.benchmarks.lab.parts.recognition_methods import Method
from mechsearch_jax.benchmarks.store.json_rows import save_rows
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


def test_objects_fall_into_one_visible_share_each(summary):
    parts = [summary["clean", "truth", name]["objects"] for name, *_ in recognition.SHARES]
    assert sum(parts) == summary["clean", "truth", "all"]["objects"]


def test_only_objects_with_enough_pixels_count(bench, measured):
    _, image = bench.image(0, "clean")
    rows = [row for row in measured.rows if row.method == "truth" and row.noise == "clean"]
    expected = np.flatnonzero(np.asarray(SCENE.world.valid[:8]) & (np.asarray(image.pixels) >= 100))
    assert [row.object for row in rows] == expected.tolist()
    assert all(0 < row.visible <= 1 for row in rows)
    # In a view with every second ray a pixel stands for four of the full image.
    labels = np.asarray(image.shown.labels)
    assert rows[0].pixels == pytest.approx(4 * np.sum(labels == rows[0].object), rel=0.1)


def test_a_file_holds_every_row_and_the_figures_that_follow_from_them(measured, tmp_path):
    path = tmp_path / "recognition.json"
    save_rows(measured.value(), measured.rows, path)
    value = json.loads(path.read_text())
    rows = tuple(recognition.RecognitionRow(**dict(zip(value["columns"], row, strict=True))) for row in value["rows"])
    assert rows == measured.rows
    assert value["summary"] == dataclasses.replace(measured, rows=rows).summary()
    assert set(value["seconds_per_object"]) == set(METHODS)
    assert value["settings"]["scenario_files"] == 1
    assert "device" in value["versions"]
    assert [p.name for p in tmp_path.iterdir()] == ["recognition.json"]


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


def test_methods_bring_along_what_they_begin_with():
    assert list(recognition.chosen_methods(METHODS, ["mended", "truth", "mended"])) == ["shifted", "mended", "truth"]
    with pytest.raises(InputError, match='"guess" is unknown'):
        recognition.chosen_methods(METHODS, ["guess"])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"scenes": []}, "there are no scenes"),
        ({"noises": ()}, "at least one noise"),
        ({"methods": {}}, "one method"),
        ({"noises": ("fog",)}, '"fog" is unknown'),
        ({"slow_scenes": 0}, "must be at least 1"),
    ],
)
def test_a_comparison_of_nothing_is_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        RecognitionBench(**{"scenes": [SCENE], "methods": METHODS, **wrong})


@pytest.mark.parametrize(("slow_scenes", "expected"), [(1, 1), (3, 3), (7, 7), (10, 10), (99, 10), (None, 10)])
def test_slow_methods_are_measured_on_scenes_spread_over_all(slow_scenes, expected):
    methods = {"fast": method_of(TRUTH), "slow": Method(shifted, slow=True)}
    bench = RecognitionBench([SCENE] * 10, methods, slow_scenes=slow_scenes)
    chosen = [i for i in range(10) if "slow" in bench.methods_for(i)]
    assert len(chosen) == expected
    assert chosen[0] == 0
    assert max(np.diff([*chosen, 10])) <= -(-10 // expected)
    assert all("fast" in bench.methods_for(i) for i in range(10))


def test_two_scenarios_of_one_name_are_refused():
    scenario = load_scenario(example_scenarios()["first-light"])
    with pytest.raises(InputError, match="two scenes are called"):
        images.scenes_of([scenario, scenario])


PLACE = """
[camera]
width = 160
height = 90
fx = 76.2
fy = 76.2
cx = 80.0
cy = 45.0

[shelf]
left = {left}
"""


def test_every_configuration_is_a_place_of_its_own(monkeypatch, tmp_path, capsys):
    """The command, on generated scenes that are always the same one, with a method that knows the truth."""
    stood, seen = [], []

    def scenes(count, seed, shelf, source):
        stood.append(shelf)
        return [dataclasses.replace(SCENE, source=source)] * count

    def methods(camera, shelf):
        seen.append((camera, shelf))
        return {"network": method_of(TRUTH), "network-refined": method_of(TRUTH, after="network")}

    monkeypatch.setattr(images, "held_out_scenes", scenes)
    monkeypatch.setattr(recognition, "shipped_methods", methods)
    places = {"wide": 0.6, "wider": 0.7}
    files = [tmp_path / f"{name}.toml" for name in places]
    for file, left in zip(files, places.values(), strict=True):
        file.write_text(PLACE.format(left=left))
    out = tmp_path / "places.json"
    measured = {"noise": ("clean",), "method": ("network-refined",), "out": out}
    quality.bench_recognition(generated=quality.GeneratedScenes(tuple(files), 1), **measured)
    assert [shelf.left for shelf in stood] == list(places.values())
    assert [shelf.left for _, shelf in seen] == list(places.values())
    assert {camera.fx for camera, _ in seen} == {76.2}
    value = json.loads(out.read_text())
    rows = [recognition.RecognitionRow(**dict(zip(value["columns"], row, strict=True))) for row in value["rows"]]
    assert list(dict.fromkeys(row.source for row in rows)) == list(places)
    assert {name: place["shelf"]["left"] for name, place in value["settings"]["places"].items()} == places
    assert value["settings"]["held_out_scenes"] == 1
    assert value["seconds_per_object"] == {}
    printed = capsys.readouterr().out
    assert all(f"source {name}, noise clean, method network-refined" in printed for name in places)


@pytest.mark.parametrize(
    ("config", "scenarios", "message"),
    [
        (("a/x.toml", "b/x.toml"), (), "two configuration files are called x"),
        (("x.toml",), ("first-light",), "leave the scenario files out"),
    ],
)
def test_places_without_names_of_their_own_are_refused(config, scenarios, message):
    with pytest.raises(InputError, match=message):
        quality.bench_recognition(scenarios, generated=quality.GeneratedScenes(tuple(map(Path, config))))


@pytest.mark.slow
def test_generated_scenes_stand_on_the_given_shelf():
    shelf = Shelf().moved((0.1, -0.05, 0.2))
    (scene,) = images.held_out_scenes(1, 0, shelf, "there")
    (usual,) = images.held_out_scenes(1)
    shift = np.asarray(scene.world.position - usual.world.position)
    np.testing.assert_allclose(shift[np.asarray(usual.world.valid)] - (0.1, -0.05, 0.2), 0.0, atol=1e-3)
    assert (scene.source, usual.source) == ("there", "held-out")


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
