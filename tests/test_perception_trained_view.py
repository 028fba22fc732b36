"""What networks were trained on: what their cards say, and which cameras and shelves are far outside of it."""

import dataclasses
import json
import types
from pathlib import Path

import jax
import numpy as np
import pytest

from mechsearch_jax.images.cloud import BLOCK, shelf_view, thinned_view
from mechsearch_jax.images.trained_view import TOLERANCES, TrainedView, read_view, view_faults
from mechsearch_jax.networks.recognition import RecognitionConfig
from mechsearch_jax.networks.segmentation import SegmentationConfig
from mechsearch_jax.networks.weights import ARCHITECTURES, load_weights, read_card
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.perception.recognition import nearness
from mechsearch_jax.problem.settings import load_settings
from mechsearch_jax.session.searcher import Searcher
from mechsearch_jax.train.recognition import RecognitionTask
from mechsearch_jax.train.segmentation import SegmentationTask
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.sight import camera_faults

HERE = Path(__file__).resolve().parents[1]
VIEWS = HERE / "benchmarks" / "lab" / "parts" / "views"
PLACES = {file.stem: load_settings(file).workcell for file in sorted(VIEWS.glob("*.toml"))}
NEAR = ["camera-right", "camera-ahead", "camera-back", "shelf-low", "shelf-wide", "shelf-narrow"]
FAR = {"far-camera": "distance", "far-level": "elevation", "far-shelf": "depth"}
NETWORKS = ("recognition", "segmentation")
TRAINED = {
    name: read_view(read_card(HERE / "mechsearch_jax" / "networks" / f"{name}.npz", name), name) for name in NETWORKS
}


def faults(place):
    assert camera_faults(place.camera, place.shelf) == ()
    return view_faults(place.camera, place.shelf, TRAINED)


def test_the_shipped_cards_say_what_the_networks_were_trained_on():
    for task in (RecognitionTask(), SegmentationTask()):
        assert TRAINED[task.name] == TrainedView(task.view.camera, task.shelf) == TrainedView()
    # The thinned rays of the default camera are those that were cast, and a few beyond the shelf.
    shown, cast = thinned_view(Camera(), Shelf()), shelf_view()
    size = {"height": cast.camera.height, "width": cast.camera.width}
    assert dataclasses.replace(shown, camera=dataclasses.replace(shown.camera, **size)) == cast
    assert all(0 <= getattr(shown.camera, name) - least < BLOCK for name, least in size.items())


def test_of_six_plausible_places_at_most_one_is_warned_of():
    assert faults(PLACES["default"]) == ()
    assert sorted(PLACES) == sorted(["default", *NEAR, *FAR])
    assert sum(bool(faults(PLACES[name])) for name in NEAR) <= 1


@pytest.mark.parametrize(("name", "number"), FAR.items(), ids=FAR)
def test_a_place_far_outside_is_warned_of_in_a_line(name, number):
    lines = faults(PLACES[name])
    (line,) = [line for line in lines if line.startswith(TOLERANCES[number].what)]
    assert "\n" not in line
    value = PLACES[name]
    seen = TrainedView(thinned_view(value.camera, value.shelf).camera, value.shelf).numbers()[number]
    assert TOLERANCES[number].form.format(seen) in line
    assert "recognition and segmentation" in line


def test_a_place_that_was_measured_to_be_recognised_worse_is_warned_of():
    """The stored result; it is of these files."""
    measured = json.loads((HERE / "benchmarks" / "results" / "views-cpu.json").read_text())
    for name, place in PLACES.items():
        stored = measured["settings"]["places"][name]
        view = {"camera": dataclasses.asdict(place.camera), "shelf": dataclasses.asdict(place.shelf)}
        # Results of before shelves could lack faces are of all of them.
        stored["shelf"].setdefault("faces", list(place.shelf.faces))
        assert stored == json.loads(json.dumps(view))
    overlap = {
        (line["source"], line["noise"]): line["iou_mean"]
        for line in measured["summary"]
        if (line["method"], line["visible"]) == ("network-refined", "all")
    }
    noises = ("gaussian", "time-of-flight")
    assert set(overlap) == {(name, noise) for name in PLACES for noise in noises}
    for name, place in PLACES.items():
        loss = max(overlap["default", noise] - overlap[name, noise] for noise in noises)
        assert (loss > 0.03) <= bool(faults(place)), name


def test_only_a_camera_farther_away_is_shown_as_nearer_and_only_a_denser_image_is_thinned_more():
    assert nearness(Camera(), Shelf()) == 1.0
    for name, ratio, stride in (
        ("camera-back", 0.775 / 1.23, 3),
        ("far-camera", 0.775 / 3.01, 1),
        ("far-level", 1.0, 2),
    ):
        place = PLACES[name]
        assert nearness(place.camera, place.shelf) == pytest.approx(ratio, rel=0.01)
        assert thinned_view(place.camera, place.shelf).stride == stride
    # The same view at twice the resolution.
    one = PLACES["camera-back"].camera
    twice = {name: 2 * getattr(one, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    assert thinned_view(dataclasses.replace(one, **twice), Shelf()).stride == 6


def test_numbers_by_hand():
    camera = Camera(fx=400.0, fy=400.0, position=(0.0, 0.4, 0.5))
    shelf = Shelf(front=0.2, back=0.6, right=-0.3, left=0.3, board=0.2, ceiling=0.5)
    numbers = TrainedView(camera, shelf).numbers()
    distance = np.sqrt(0.4**2 + 0.4**2 + 0.3**2)
    expected = {
        "distance": distance,
        "azimuth": 45.0,
        "elevation": np.degrees(np.arcsin(0.3 / distance)),
        "density": 400.0 / distance,
        "depth": 0.4,
        "width": 0.6,
        "height": 0.3,
    }
    assert numbers == pytest.approx(expected)
    # Where all of it stands does not matter.
    shift = (0.2, -0.1, 0.3)
    assert TrainedView(camera.moved(shift), shelf.moved(shift)).numbers() == pytest.approx(expected)


def test_each_size_of_a_shelf_is_reported_once_it_is_out_of_its_range_and_not_before():
    ends = {"depth": "back", "width": "left", "height": "ceiling"}
    usual = Shelf()
    for number, end in ends.items():
        size = TrainedView().numbers()[number]
        for edge, sign in zip(TOLERANCES[number].range(size), (-1, 1), strict=True):
            for over in (False, True):
                by = edge - size + sign * (0.004 if over else -0.004)
                shelf = dataclasses.replace(usual, **{end: getattr(usual, end) + by})
                lines = view_faults(Camera(), shelf, TRAINED)
                assert [line for line in lines if TOLERANCES[number].what in line] == list(lines[-1:] if over else ())


@pytest.mark.parametrize(
    ("task", "config"),
    [(RecognitionTask, RecognitionConfig(12, 1, 2)), (SegmentationTask, SegmentationConfig(12, 1, 2, 4, 9))],
    ids=NETWORKS,
)
def test_a_training_writes_what_it_saw_and_the_weights_know(task, config, tmp_path):
    shelf = Shelf().moved((0.1, 0.0, -0.1))
    training = task(network=config, shelf=shelf, view=shelf_view(shelf=shelf, stride=4))
    shapes = ARCHITECTURES[training.name].shapes(config)
    training.save(tmp_path / "w.npz", jax.tree.map(lambda a: np.zeros(a.shape), shapes), {"seed": 1})
    weights = load_weights(tmp_path / "w.npz", training.name)
    assert weights.view == TrainedView(training.view.camera, shelf)
    assert weights.card["seed"] == 1


def test_the_searcher_tells_it_before_the_first_image():
    for name in ("default", "far-shelf"):
        place = PLACES[name]
        searcher = Searcher(place)
        # Building a problem takes long, and nothing here depends on it.
        grasps = types.SimpleNamespace(pair_pose=np.arange(9))
        setting = {"camera": place.camera, "shelf": place.shelf, "target": place.target}
        searcher.problem = types.SimpleNamespace(**setting, poses=np.zeros((9, 3)), grasps=grasps)
        assert isinstance(searcher.recogniser, Recogniser)
        assert searcher.check().warnings == faults(place)
