"""Looks are scored as a person would: what is missing, off, turned, a phantom, and why."""

import dataclasses

import numpy as np
import pytest

from mechsearch_jax.benchmarks.looks import looks, scoring
from mechsearch_jax.benchmarks.looks.scoring import failure_kind, gaps, matched, phantom_kind, turned_by
from mechsearch_jax.perception.doubt import Thing
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Body, example_scenarios, load_scenario


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


def test_an_image_has_the_sensors_noise():
    workcell, scenario = Workcell(), load_scenario(example_scenarios()["first-light"])
    picture = looks.taken(workcell, scenario)
    seen = np.isfinite(picture.depth)
    clean, noisy = (looks.noisy(workcell, picture, noise, 1) for noise in ("clean", "gaussian"))
    np.testing.assert_array_equal(clean[seen], picture.depth[seen])
    assert (clean[~seen] == 0).all()
    assert np.std((noisy - clean)[seen]) == pytest.approx(0.001, rel=0.05)
    with pytest.raises(InputError, match='noise "loud" is unknown'):
        looks.noisy(workcell, picture, "loud", 1)
    shown = {int(slot) for slot in np.unique(picture.owner)} & set(range(len(scenario.objects)))
    assert len(shown) > 1


def test_a_bench_of_nothing_is_refused():
    with pytest.raises(InputError, match="nothing to look at"):
        looks.Bench({})


@pytest.mark.slow
def test_true_segments_of_a_simple_scene_are_all_right():
    scenario = load_scenario(example_scenarios()["first-light"])
    picture = looks.taken(Workcell(), scenario)
    measured = looks.Bench({scenario.name: (scenario, picture)}, ("clean",), ("true",)).run()
    everything = measured.summary()[0]
    assert everything["wrong"] == everything["phantoms"] == 0
    assert everything["objects"] == len(measured.rows) == sum(row.pixels >= scoring.PIXELS for row in measured.rows)
    assert {dataclasses.asdict(row)["kind"] for row in measured.rows} == {""}
