"""The household catalogue: every thing stands, is described by few superquadrics, and has sizes that fit the shelf."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.scenes.household import body_at, draw_thing, household, standing_height
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.shapes.compound import half_extents, inertial, solids, surface_points
from mechsearch_jax.shapes.parts import PARTS, parts_of, volume_in_common
from mechsearch_jax.workspace.scenario import Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf

THINGS = household()
TARGET = Body("cylinder", (0.02, 0.02, 0.05), (0.45, -0.2, 0.4545), (1.0, 0.0, 0.0, 0.0))


def standing(compound, drop=0.0):
    return body_at(compound, 0.6, 0.1, Shelf().board + standing_height(compound) + drop)


@pytest.mark.parametrize("name", THINGS)
def test_a_thing_and_its_parts_have_their_volume_in_common(name):
    compound = THINGS[name].compound
    assert 1 <= len(parts_of(compound)) <= PARTS
    assert volume_in_common(compound) >= 0.9


@pytest.mark.parametrize("name", THINGS)
def test_a_thing_stays_where_it_stands(name):
    """Dropped by 2 mm, it comes to rest within 1 cm and 5 degrees of its standing pose, at both ends of its scale."""
    simulator = NativeWorld()
    for factor in THINGS[name].scale:
        start = standing(THINGS[name].sized(factor), drop=0.002)
        simulator.reset(Scenario("one", (start,), TARGET))
        outcome = simulator.settle()
        (after,) = simulator.scenario("after").objects
        assert bool(outcome.settled)
        assert not np.asarray(outcome.fallen).any()
        wanted = np.array(start.position) - (0.0, 0.0, 0.002)
        assert np.linalg.norm(np.array(after.position) - wanted) < 0.01
        turn = Rotation.from_quat(after.quaternion, scalar_first=True)
        assert np.degrees(turn.magnitude()) < 5.0


@pytest.mark.parametrize("name", THINGS)
def test_a_thing_fits_on_the_shelf_and_into_the_batch_simulator(name):
    largest = THINGS[name].sized(THINGS[name].scale[1])
    extent = np.ptp(surface_points(largest), axis=0)
    assert extent[2] < Shelf().ceiling - Shelf().board - 0.03
    assert extent.max() < 0.35
    assert extent.min() > 0.02
    assert 0.02 < inertial(largest).mass < 1.6
    assert len(solids(largest.pieces)) <= 10


def test_sizes_are_drawn_from_the_scales():
    rng = np.random.default_rng(0)
    drawn = [draw_thing(rng) for _ in range(300)]
    by_colour = {thing.compound.colour: thing for thing in THINGS.values()}
    assert len(by_colour) == len(THINGS)
    ratios = {name: [] for name in THINGS}
    for compound in drawn:
        thing = by_colour[compound.colour]
        ratios[thing.name].append(half_extents(compound)[2] / half_extents(thing.compound)[2])
        assert thing.scale[0] - 1e-3 <= ratios[thing.name][-1] <= thing.scale[1] + 1e-3
    assert all(ratios.values())
    assert np.std([ratio for each in ratios.values() for ratio in each]) > 0.05
    again = np.random.default_rng(0)
    assert [draw_thing(again) for _ in range(20)] == drawn[:20]
