"""The simulated cell: what its camera sees, where its arm goes, and what it says became of a trajectory."""

import dataclasses

import numpy as np
import pytest
from stage import HIDDEN, OPEN

from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.cell.simulated_cell import SensorNoise, SimulatedCell
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.robot.arm_config import ArmConfig
from mechsearch_jax.robot.robot_trajectory import Bounds, RobotTrajectory
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera

SMALL = Camera(width=320, height=180, fx=152.4, fy=152.4, cx=160.0, cy=90.0)
CELL = Workcell(camera=SMALL)
EXACT = SensorNoise(depth=0.0, colour=0.0, missing=0.0)


def moving(start, by, steps=250):
    """A smooth trajectory of all joints."""
    share = np.linspace(0.0, 1.0, steps + 1)
    smooth = (share**3 * (10 - 15 * share + 6 * share**2))[:, None]
    position = start[None] + smooth * by
    zero = np.zeros(steps + 1)
    return RobotTrajectory(
        time=0.004 * np.arange(steps + 1),
        position=position,
        velocity=np.gradient(position, 0.004, axis=0),
        acceleration=np.zeros_like(position),
        width=zero,
        force=zero,
        part=zero.astype(int),
        action="push",
        bounds=Bounds(),
        clearance=0.1,
        straight=True,
        ends_at_home=False,
    )


def test_the_images_are_those_of_an_independent_ray_cast():
    depth, colour = SimulatedCell(CELL, HIDDEN, noise=EXACT).look()
    image = observe(SMALL, from_scenario(HIDDEN), CELL.shelf)
    expected = np.where(np.isfinite(image.depth), image.depth, 0.0)
    # The one shows the robot, too, and the pixels at edges may differ.
    same = np.abs(depth - expected) < 2e-3
    assert same.mean() > 0.97
    assert colour.shape == (180, 320, 3)
    assert colour.dtype == np.uint8


def test_noise_is_as_large_as_it_says_and_missing_pixels_are_0():
    exact, _ = SimulatedCell(CELL, HIDDEN, noise=EXACT).look()
    noisy, colour = SimulatedCell(CELL, HIDDEN, noise=SensorNoise(0.001, 4 / 255, 0.01)).look()
    seen = (exact > 0) & (noisy > 0)
    assert np.std((noisy - exact)[seen]) == pytest.approx(0.001, rel=0.05)
    assert np.mean(noisy[exact > 0] == 0.0) == pytest.approx(0.01, rel=0.3)
    _, clean = SimulatedCell(CELL, HIDDEN, noise=EXACT).look()
    dark = (clean > 30) & (clean < 225)
    assert np.std((colour.astype(float) - clean)[dark]) == pytest.approx(4.0, rel=0.1)


def test_the_target_is_counted_where_it_is_seen():
    assert SimulatedCell(CELL, HIDDEN, noise=EXACT).target_pixels() == 0
    assert SimulatedCell(CELL, OPEN, noise=EXACT).target_pixels() > 20


def test_the_arm_follows_a_trajectory_and_says_where_it_is():
    cell = SimulatedCell(CELL, OPEN, noise=EXACT)
    np.testing.assert_allclose(cell.joints, CELL.arm.home, atol=2e-3)
    done = cell.follow(moving(cell.joints, np.array([0.1, 0.0, 0.0, 0.1, 0.0, 0.0, 0.2])))
    assert done.ok
    assert done.tracking_error < 0.01
    assert (done.retrieved, done.fallen) == (False, ())
    np.testing.assert_allclose(cell.joints[[0, 3, 6]] - np.array(CELL.arm.home)[[0, 3, 6]], [0.1, 0.1, 0.2], atol=3e-3)


def test_a_trajectory_that_begins_elsewhere_is_refused():
    cell = SimulatedCell(CELL, OPEN)
    with pytest.raises(InputError, match=r"begins 0\.500 rad from where the arm is"):
        cell.follow(moving(cell.joints + 0.5, np.zeros(7)))


def test_an_arm_that_is_held_up_is_not_ok():
    cell = SimulatedCell(CELL, OPEN)
    narrow = dataclasses.replace(moving(cell.joints, np.full(7, 0.3), steps=40), bounds=Bounds(tracking=1e-4))
    assert not cell.follow(narrow).ok


def test_an_empty_hand_is_no_retrieval():
    cell = SimulatedCell(CELL, OPEN)
    done = cell.follow(dataclasses.replace(moving(cell.joints, np.zeros(7), 10), action="retrieve"))
    assert not done.ok
    assert not done.retrieved


@pytest.mark.slow
def test_a_searcher_takes_a_target_out_of_the_cell(problem):
    from test_search import searcher_of

    cell = SimulatedCell(Workcell(), OPEN)
    searcher = searcher_of(problem, OPEN)
    step = searcher.next(*cell.look(), joints=cell.joints, width=cell.width)
    assert step.kind == "retrieve"
    done = cell.follow(step.trajectory)
    assert (done.ok, done.retrieved, done.fallen) == (True, True, ())
    assert done.tracking_error < 0.02


@pytest.mark.slow
def test_a_target_is_put_down_at_its_place(problem):
    from test_search import searcher_of

    # In simulation the board goes on in front of the shelf.
    place = (0.3, -0.12, CELL.shelf.board)
    workcell = Workcell(arm=ArmConfig(place=place))
    cell = SimulatedCell(workcell, OPEN)
    step = searcher_of(problem, OPEN, workcell=workcell).next(*cell.look(), joints=cell.joints, width=cell.width)
    trajectory = step.trajectory
    done = cell.follow(trajectory)
    assert (done.ok, done.retrieved, done.fallen) == (True, True, ())
    centre = np.add(place, (0.0, 0.0, OPEN.target.half_size[2]))
    np.testing.assert_allclose(cell.scenario("after").target.position, centre, atol=5e-3)
    assert cell.width == pytest.approx(0.08, abs=2e-3)
    np.testing.assert_allclose(cell.joints, workcell.arm.home, atol=5e-3)


def test_the_present_opening_is_measured():
    cell = SimulatedCell(CELL, OPEN, noise=EXACT)
    assert cell.width == pytest.approx(0.0, abs=1e-3)
    still = moving(cell.joints, np.zeros(7), 300)
    cell.follow(dataclasses.replace(still, width=np.full(301, 0.05)))
    assert cell.width == pytest.approx(0.05, abs=2e-3)


def test_what_is_gripped_is_pressed_with_the_given_force():
    cell = SimulatedCell(CELL, OPEN, noise=EXACT)
    still = moving(cell.joints, np.zeros(7), 100)
    ahead = cell._control(still.position[0], 0.0, 60.0)
    assert ahead[-2:].tolist() == pytest.approx([-0.06, -0.06])
    assert cell._control(still.position[0], 0.08)[-2:].tolist() == pytest.approx([0.04, 0.04])
