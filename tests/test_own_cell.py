"""The cell of one's own measures what it says: its arm, its camera's noise, its forces, and a controller's limits."""

import math

import numpy as np
import pytest
from own_cell import camera, execution, limits, search, setup, summary, world

from mechsearch_jax.problem.settings import load_settings
from mechsearch_jax.robot.kinematics import forward_kinematics

pytestmark = pytest.mark.slow
SHIFT = np.array([0.5, 0.3, -0.3, 0.4, 0.2, -0.4, 0.5])


@pytest.fixture(scope="module")
def cell():
    return world.World(world.drawn_layout(0))


def smooth(q, to, seconds):
    """Rows of a quintic from rest to rest."""
    time = np.arange(0.0, seconds + 0.005, 0.01)
    u = (time / seconds)[:, None]
    return time, q + (to - q) * u**3 * (10 - 15 * u + 6 * u * u), (to - q) * 30 * u**2 * (1 - u) ** 2 / seconds


def written(path, time, q, v):
    names = [
        "time [s]",
        *(f"q{i} [rad]" for i in range(1, 8)),
        *(f"v{i} [rad/s]" for i in range(1, 8)),
        "width",
        "force",
    ]
    rows = np.column_stack([time, q, v, np.zeros((len(q), 2))])
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=",".join(names), comments="")
    return path


def test_layouts_repeat_themselves_and_hide_the_target(cell):
    assert world.drawn_layout(0) == cell.layout != world.drawn_layout(1)
    assert camera.target_pixels(cell) == 0


def test_the_arm_is_that_of_the_package_and_servos_follow(cell):
    assert np.abs(np.asarray(forward_kinematics(world.HOME))[7] - cell.hand_pose()).max() < 1e-4
    moving = world.World(cell.layout)
    done = execution.follow(moving, execution.Hand(), smooth(world.HOME, world.HOME + SHIFT, 2.0), [], 0.05, 50.0)
    assert done.ok
    assert done.gap < 2e-3
    assert np.abs(np.asarray(forward_kinematics(world.HOME + SHIFT))[7] - moving.hand_pose()).max() < 2e-4


def test_an_arm_that_is_in_the_way_is_touched_and_stopped(cell):
    """With joint 1 turned to the left the outstretched arm meets the camera's post."""
    moving = world.World(cell.layout)
    around = world.HOME + np.array([2.4, 1.4, 0.0, 0.2, 0.0, 0.0, 0.0])
    done = execution.follow(moving, execution.Hand(), smooth(world.HOME, around, 4.0), [], 0.05, 50.0)
    assert not done.ok
    assert any(size > 5.0 and {"post", "camera"} & set(pair) for pair, size in done.forces.items())


def test_depth_is_as_noisy_as_said():
    noise = camera.measure(np.full((camera.HEIGHT, camera.WIDTH), 0.8), np.random.default_rng(0))
    known = noise[noise > 0]
    assert abs(known.std() / (0.005 * 0.8**2) - 1) < 0.1
    assert abs((noise == 0).mean() - camera.MISSING) < 2e-3


def test_a_controller_refuses_what_is_beyond_its_limits(tmp_path):
    rows = smooth(world.HOME, world.HOME + SHIFT, 2.0)
    good = written(tmp_path / "good.csv", *rows)
    assert all(limits.faults(good, arm, world.HOME)[0] == [] for arm in ("panda", "fr3"))
    assert "measured joints" in limits.faults(good, "panda", world.HOME + 0.1)[0][0]
    fast = written(tmp_path / "fast.csv", *smooth(world.HOME, world.HOME + SHIFT, 0.3))
    assert any("velocity" in fault for fault in limits.faults(fast, "panda", world.HOME)[0])


def test_the_configuration_is_read(tmp_path):
    for target in ("box", "cylinder"):
        (tmp_path / "cell.toml").write_text(setup.configuration(target))
        assert load_settings(tmp_path / "cell.toml").workcell.camera.width == camera.WIDTH


def test_only_what_no_motion_is_for_counts_as_a_contact():
    forces = {
        ("left finger", "can"): 60.0,
        ("can (held)", "shelf below"): 12.0,
        ("tin (held)", "shelf below"): 7.0,
        ("hand", "box"): 30.0,
        ("hand", "tin"): 30.0,
        ("can (held)", "shelf"): 6.0,
        ("hand", "target"): 4.0,
    }
    note = {
        "reason": "pick object 4",
        "warnings": ["the hand, or what it holds, may touch object 2 (3 mm beside it) and the target (1 mm into it)"],
        "of": "can",
        "objects": [{"slot": 2, "is": "box"}, {"slot": 4, "is": "can"}, {"slot": 0, "is": "tin"}],
    }
    done = execution.Executed(forces=forces)
    assert search.unannounced(note, done) == {
        "tin (held)|shelf below": 7.0,
        "hand|tin": 30.0,
        "can (held)|shelf": 6.0,
    }
    # What is shoved against its board is no longer put down.
    done.forces["can (held)", "shelf below"] = 40.0
    assert search.unannounced(note, done)["can (held)|shelf below"] == 40.0


def test_intervals_are_wilsons():
    low, high = summary.wilson(36, 40)
    assert math.isclose(low, 0.7695, abs_tol=2e-3)
    assert math.isclose(high, 0.9604, abs_tol=2e-3)
