"""How agreement between simulators is measured, and the speed of the batch simulator."""

import dataclasses
import json
import math

import jax
import numpy as np
import pytest

from mechsearch_jax.actions import ActionKind
from mechsearch_jax.benchmarks.lab.parts.agreement import (
    Agreement,
    Case,
    agreement,
    draw_actions,
    pose_differences,
)
from mechsearch_jax.benchmarks.parts import simulation
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Body, Scenario, example_scenarios, load_scenario

CASE = Case("scene", 2, "push", 0, None, None, 0.1, 0.11, 775, 775, 0.004, 1.0, 50.0, 0, 0.002, 4.0)
VERSIONS = {"device": "cpu: cpu"}


def turned(box, cylinder, shift=0.0):
    """A box and a cylinder, turned about the vertical by angles [degrees], one of them shifted."""
    q = [(math.cos(math.radians(a) / 2), 0.0, 0.0, math.sin(math.radians(a) / 2)) for a in (box, cylinder)]
    bodies = (
        Body("box", (0.02, 0.03, 0.05), (0.6 + shift, 0.1, 0.45), q[0]),
        Body("cylinder", (0.03, 0.03, 0.05), (0.6, 0.25, 0.45), q[1]),
    )
    target = Body("cylinder", (0.02, 0.02, 0.05), (0.7, 0.0, 0.45), (1.0, 0.0, 0.0, 0.0))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], from_scenario(Scenario("two", bodies, target)))


def test_a_cylinder_has_no_spin_but_a_box_has():
    distance, angle, spin = pose_differences(turned(0, 0), turned(2, 40, shift=0.003))
    assert distance == pytest.approx([0.003], abs=1e-6)
    assert angle == pytest.approx([2], abs=0.05)
    assert spin == pytest.approx([40], abs=0.05)


def test_the_summary_counts_what_agrees():
    far = dataclasses.replace(
        CASE, kind="pick-and-place", position_difference=0.02, batch_failure="dropped", overflow=2
    )
    result = Agreement((CASE, CASE, far), 1.0, 3.0, VERSIONS)
    summary = result.summary()
    assert list(summary) == ["push", "pick-and-place", "all"]
    assert summary["push"]["agreeing"] == 1.0
    assert summary["push"]["agreeing_with_spin"] == 0.0
    assert summary["push"]["native_agreeing_with_itself"] == 0.0
    assert summary["all"]["agreeing"] == pytest.approx(2 / 3)
    assert summary["all"]["same_failure"] == pytest.approx(2 / 3)
    assert summary["all"]["overflowed"] == 1
    assert summary["all"]["native_moved_median"] == pytest.approx(0.1)
    written = json.loads(json.dumps(result.value()))
    assert len(written["cases"]) == 3
    assert written["summary"]["all"]["actions"] == 3


@pytest.mark.slow
def test_actions_that_are_drawn_agree():
    """Where the native simulator ends in the same place whatever the nudge, the batch simulator ends there too."""
    scene = load_scenario(example_scenarios()["first-light"])
    cases = draw_actions([scene], 8, seed=1)
    assert {int(action.kind) for _, action in cases} == {ActionKind.PUSH, ActionKind.PICK_AND_PLACE}
    result = agreement(cases, nudges=8)
    assert not any(case.overflow for case in result.cases)
    assert all(case.native_failure == case.batch_failure for case in result.cases)
    assert all(case.native_moved > 0.01 for case in result.cases)
    steady = [case for case in result.cases if case.native_agrees]
    assert len(steady) >= 5
    assert all(case.agrees for case in steady)
    with pytest.raises(InputError, match="take more scenes"):
        draw_actions([scene], 100, tries=2)


@pytest.mark.slow
def test_the_speed_of_the_batch_simulator_is_measured():
    timing = simulation.bench_simulate(2, 20, repeats=1, scenes=1)
    assert timing.rate == pytest.approx(40 / timing.median)
    assert timing.shapes["overflowed_worlds"] == timing.shapes["diverged_worlds"] == 0
