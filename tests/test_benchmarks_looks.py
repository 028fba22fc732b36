"""Looks are scored as a person would: what is missing, off, turned, a phantom, and why."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.benchmarks.lab.looks import looks, pictures, scoring
from mechsearch_jax.benchmarks.lab.looks.scoring import failure_kind, gaps, matched, phantom_kind, turned_by
from mechsearch_jax.envs.camera.colour_image import drawn_appearance, scene_key
from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.world.mismatch import USUAL_COLOUR_NOISE, USUAL_HUE_GAP
from mechsearch_jax.envs.world.world import TARGET, from_scenario
from mechsearch_jax.images.cloud import thinned_view
from mechsearch_jax.images.colour import RED
from mechsearch_jax.images.labels import CAPACITY
from mechsearch_jax.perception.confidence import Measures
from mechsearch_jax.perception.doubt import Thing
from mechsearch_jax.perception.explanation import Fitted
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Body, example_scenarios, load_scenario, superquadrics

WORKCELL = Workcell()


def turn(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def thing(size, degrees=0.0, is_round=False):
    return Thing("", np.array(size), is_round, turn(degrees), np.zeros(3))


@pytest.mark.parametrize(
    ("truth", "answer", "angle"),
    [
        (thing((0.03, 0.06, 0.1)), thing((0.03, 0.06, 0.1), 20), 20),
        (thing((0.03, 0.06, 0.1)), thing((0.03, 0.06, 0.1), 190), 10),
        # The same box with its axes named otherwise.
        (thing((0.03, 0.06, 0.1)), thing((0.06, 0.03, 0.1), 95), 5),
        (thing((0.03, 0.06, 0.1)), thing((0.03, 0.06, 0.1), 90), 90),
        (thing((0.05, 0.05, 0.1)), thing((0.05, 0.05, 0.1), 80), 10),
        (thing((0.05, 0.05, 0.1), 0, True), thing((0.05, 0.05, 0.1), 77, True), 0),
    ],
)
def test_an_angle_is_taken_modulo_the_symmetry_of_the_shape(truth, answer, angle):
    assert turned_by(truth, answer) == pytest.approx(angle, abs=0.1)


def test_each_body_gets_one_object_and_the_rest_are_phantoms():
    iou = np.array([[0.8, 0.1, 0.0], [0.0, 0.0, 0.0]])
    distance = np.array([[0.01, 0.03, 0.5], [0.3, 0.3, 0.04]])
    chosen, stands_for_one = matched(iou, distance)
    assert chosen.tolist() == [0, 2]
    assert stands_for_one.tolist() == [True, False, True]


def test_two_in_one_segment_and_one_in_two_are_told_apart():
    owner = np.repeat([0, 1, 2, -1], 10)[None] * np.ones((5, 1), int)
    segments = owner.copy()
    segments[owner == 1] = 0
    segments[:, 25:30] = 4
    assert failure_kind(0, owner, segments) == failure_kind(1, owner, segments) == "merged"
    assert failure_kind(2, owner, segments) == "split"
    assert failure_kind(2, owner, owner) == "shape"
    assert failure_kind(2, owner, np.where(owner == 2, -1, owner)) == "hole"
    assert phantom_kind(4, owner, segments) == "split"
    assert phantom_kind(5, owner, np.where(owner < 0, 5, owner)) == "other"


def test_gaps_between_bodies():
    bodies = [Body("box", (0.03, 0.03, 0.05), (0.1 * i, 0.0, 0.05), (1.0, 0.0, 0.0, 0.0)) for i in (0, 1, 3)]
    np.testing.assert_allclose(gaps(bodies), [0.04, 0.04, 1.0], atol=1e-6)


@pytest.fixture(scope="module")
def scene():
    """A scene whose target is in sight, and its image."""
    scenario = load_scenario(example_scenarios()["first-light"])
    x, _, z = scenario.target.position
    in_sight = dataclasses.replace(scenario, target=dataclasses.replace(scenario.target, position=(x, -0.06, z)))
    return in_sight, pictures.taken(WORKCELL, in_sight)


def test_an_image_has_the_sensors_noise(scene):
    scenario, picture = scene
    seen = np.isfinite(picture.depth)
    clean, noisy = (pictures.noisy_depth(WORKCELL, picture, noise, 1) for noise in ("clean", "gaussian"))
    np.testing.assert_array_equal(clean[seen], picture.depth[seen])
    assert (clean[~seen] == 0).all()
    assert np.std((noisy - clean)[seen]) == pytest.approx(0.001, rel=0.05)
    with pytest.raises(InputError, match='noise "loud" is unknown'):
        pictures.noisy_depth(WORKCELL, picture, "loud", 1)
    shown = {int(slot) for slot in np.unique(picture.owner)} & set(range(len(scenario.objects)))
    assert len(shown) > 1


def test_colours_are_those_of_an_episode(scene):
    """MuJoCo's image and the package's own have the same colours wherever they show the same."""
    scenario, picture = scene
    world = from_scenario(scenario)
    own = observe(WORKCELL.camera, world, WORKCELL.shelf, drawn_appearance(scene_key(world), RED, USUAL_HUE_GAP))
    alike = (np.asarray(own.segmentation) == picture.owner) & (picture.owner >= 0) & (picture.owner <= TARGET)
    alike[alike] = np.abs(np.asarray(own.depth)[alike] - picture.depth[alike]) < 1e-3
    assert len(np.unique(picture.owner[alike])) > 3
    levels = 255 * np.asarray(own.colour)[alike] - picture.colour[alike]
    assert np.quantile(np.abs(levels), 0.99) < 2
    noise = pictures.noisy_colour(picture, 1)[alike].astype(float) - picture.colour[alike]
    assert np.std(noise) == pytest.approx(255 * USUAL_COLOUR_NOISE, rel=0.05)


def test_an_object_that_stands_for_a_found_target_is_a_phantom(scene):
    scenario, picture = scene
    view = thinned_view(WORKCELL.camera, WORKCELL.shelf)
    labels = np.asarray(view.of(jnp.asarray(picture.owner)))
    truth = superquadrics([scenario.target], CAPACITY)
    zeros = np.zeros(CAPACITY)
    measures = Measures(truth.valid, zeros, zeros, zeros, zeros)
    fitted = Fitted(truth, np.zeros(3), np.full(CAPACITY, 0.9), measures, labels, np.zeros(CAPACITY, bool))
    kind = "explained", "clean"
    counts = [len(looks.judged(scenario, picture, kind, fitted, visible, view.of)[1]) for visible in (False, True)]
    assert counts == [0, 1]


def test_missed_and_false_targets_are_counted():
    seen = [(500, True, True), (400, True, False), (20, False, True), (0, False, False)]
    sightings = [scoring.Sighting("", "explained", "clean", *row) for row in seen]
    counts = scoring.detection_counts(sightings)
    assert counts == {"targets_in_sight": 2, "targets_missed": 1, "targets_false": 1}


def test_a_bench_of_nothing_is_refused():
    with pytest.raises(InputError, match="nothing to look at"):
        looks.LooksBench({})


@pytest.mark.slow
def test_a_simple_scene_is_all_right_and_its_target_is_seen(scene):
    scenario, picture = scene
    bench = looks.LooksBench({scenario.name: scene}, ("gaussian",), ("explained", "true"))
    measured = bench.run()
    lines = [line for line in measured.summary() if "looks" in line]
    assert [line["segments"] for line in lines] == ["explained", "true"]
    for line in lines:
        assert line["wrong"] == line["phantoms"] == 0
        assert (line["targets_in_sight"], line["targets_missed"], line["targets_false"]) == (1, 0, 0)
        assert line["objects"] == sum(
            (picture.owner == i).sum() >= scoring.PIXELS for i in range(len(scenario.objects))
        )
    assert {row.kind for row in measured.rows} == {""}
    assert [sighting.pixels for sighting in measured.sightings] == 2 * [(picture.owner == TARGET).sum()]
