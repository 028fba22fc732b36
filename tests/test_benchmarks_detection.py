"""Figures of the target's detection: what counts as missed and as false, and how scenes are made."""

import numpy as np
import pytest

from mechsearch_jax.benchmarks.lab.detection.detection import (
    COLOURS,
    Condition,
    Looks,
    conditions,
    detection_figures,
    total,
    worlds_of,
)
from mechsearch_jax.benchmarks.lab.tables import detection_table
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario
from mechsearch_jax.workspace.shelf import Shelf

CYLINDER, BOX = (load_scenario(example_scenarios()[name]) for name in ("first-light", "hidden-box"))
LOOKS = Looks(
    shown=np.array([0, 60, 100, 101, 150, 1000, 2000]),
    visible=np.array([True, True, False, False, True, True, True]),
    true=np.array([0, 15, 25, 25, 40, 250, 500]),
    found=np.array([30, 26, 0, 10, 50, 200, 500]),
    right=np.array([0, 15, 0, 10, 40, 200, 500]),
)


def test_what_is_missed_and_what_is_false():
    figures = LOOKS.figures(100.0)
    assert (figures["in_sight"], figures["missed"], figures["missed_pixels"]) == (4, 1, [101])
    assert (figures["barely_in_sight"], figures["barely_missed"]) == (2, 1)
    # The second is the target itself, of which too little is in sight.
    assert (figures["out_of_sight"], figures["false"], figures["false_on_target"]) == (3, 2, 1)
    assert figures["precision"] == pytest.approx((0.8 + 1.0 + 1.0) / 3, abs=1e-4)
    assert figures["recall"] == pytest.approx((1.0 + 0.8 + 1.0) / 3, abs=1e-4)
    nothing = Looks(*(values[:1] for values in vars(LOOKS).values())).figures(100.0)
    assert nothing["precision"] is None
    both = total([figures, nothing, figures])
    assert (both["in_sight"], both["false"], both["precision"]) == (8, 5, figures["precision"])


def test_conditions_are_all_exposures_noises_and_colours():
    every = conditions()
    assert len(set(every)) == len(every) == 13 * len(COLOURS)
    assert {(c.exposure, c.noise) for c in every} == {(e, n) for e in (0.5, 1.0, 1.5) for n in (0.0, 4.0, 8.0)}


def test_targets_stand_at_free_places():
    worlds = worlds_of([CYLINDER, CYLINDER], 3, 0, Shelf())
    assert worlds.kind.shape[0] == 8
    place, half, valid = (np.asarray(a) for a in (worlds.position, worlds.half_size, worlds.valid))
    np.testing.assert_allclose(place[0, TARGET], CYLINDER.target.position, rtol=1e-6)
    assert len({tuple(xy) for xy in place[:, TARGET, :2]}) == 7
    gap = np.linalg.norm(place[:, :TARGET, :2] - place[:, TARGET:, :2], axis=-1)
    gap -= np.linalg.norm(half[:, :TARGET, :2], axis=-1) + np.linalg.norm(half[:, TARGET:, :2], axis=-1)
    free = [1, 2, 3, 5, 6, 7]
    assert gap[free][valid[free][:, :TARGET]].min() > 0


def test_targets_of_different_shapes_are_refused():
    for scenarios in ([], [CYLINDER, BOX]):
        with pytest.raises(InputError, match="lab detection: give scenarios"):
            detection_figures(scenarios)


@pytest.mark.slow
def test_a_target_in_sight_is_detected():
    figures = detection_figures([CYLINDER], 3, 0, [Condition("red"), Condition("red", exposure=0.5, noise=8.0)])
    every = figures["all"]
    assert every["in_sight"] >= 2
    assert (every["missed"], every["false"]) == (0, 0)
    assert min(every["precision"], every["recall"]) > 0.9
    assert detection_table(figures).row_count == 3
