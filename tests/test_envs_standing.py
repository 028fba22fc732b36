"""Scenes that no world can hold are named, and what leans comes to rest."""

import dataclasses
import math

import numpy as np
import pytest
from published import published_scenarios

from mechsearch_jax.commands import main as cli
from mechsearch_jax.envs.scenes.standing import check_standing, faults
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Body, Scenario, example_scenarios, load_scenario, save_scenario
from mechsearch_jax.workspace.shelf import Shelf

SHELF = Shelf()
BOARD = SHELF.board
FIRST = load_scenario(example_scenarios()["first-light"])
X, Y, Z = FIRST.objects[1].position
SWAPPED = "seems to be in the order x, y, z, w"
TARGET = Body("cylinder", (0.02, 0.02, 0.05), (0.5, -0.2, BOARD + 0.05), (1.0, 0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def world():
    return NativeWorld()


def put(i, **changes):
    objects = list(FIRST.objects)
    objects[i] = dataclasses.replace(objects[i], **changes)
    return dataclasses.replace(FIRST, objects=tuple(objects))


def about_y(angle):
    return (math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0)


IMPOSSIBLE = {
    "in-the-air": (put(1, position=(X, Y, Z + 0.03)), ["objects[1]: moves by 30 mm"]),
    "in-the-board": (put(1, position=(X, Y, Z - 0.005)), ["objects[1]: is 5.1 mm inside the board"]),
    "in-the-wall": (put(2, position=(0.568, 0.47, 0.4584)), ["objects[2]: is 13.4 mm inside the left wall"]),
    "in-the-upper-board": (
        put(1, half_size=(0.03, 0.05, 0.2), position=(X, Y, 0.6045)),
        ["objects[1]: is 31.5 mm inside the upper board"],
    ),
    "in-each-other": (
        put(1, position=(0.603, 0.1004, Z)),
        ["objects[0]: is 22.4 mm inside object 1", "objects[1]: is 22.4 mm inside object 0"],
    ),
    "leaning-on-nothing": (put(1, quaternion=about_y(0.3)), ["objects[1]: is 4.7 mm inside the board; moves by 25 mm"]),
    "swapped": (put(1, quaternion=(0.0, 0.0, math.sin(0.4), math.cos(0.4))), [SWAPPED]),
    "twice-at-one-pose": (
        dataclasses.replace(FIRST, objects=(*FIRST.objects, FIRST.objects[1])),
        ["objects[1]: is ", f"objects[{len(FIRST.objects)}]: is "],
    ),
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_what_no_world_can_hold_is_named(world, name):
    scenario, expected = IMPOSSIBLE[name]
    found = faults(scenario, world)
    assert len(found) == len(expected)
    assert all(text in line for text, line in zip(expected, found, strict=True))
    assert (SWAPPED in found[0]) == (name == "swapped")


def test_all_quaternions_in_another_order_are_said_to_be(world):
    objects = tuple(dataclasses.replace(b, quaternion=(*b.quaternion[1:], b.quaternion[0])) for b in FIRST.objects)
    found = faults(dataclasses.replace(FIRST, objects=objects), world)
    assert len(found) > 1
    assert all(SWAPPED in line for line in found)


@pytest.mark.parametrize("name", example_scenarios())
def test_shipped_scenes_stand(world, name):
    assert not faults(load_scenario(example_scenarios()[name]), world)


def test_published_scenes_stand(world):
    """Among them 8-16, where a cylinder leans on the back wall."""
    assert not [line for file in published_scenarios() for line in faults(load_scenario(file), world)]


def test_the_first_of_several_faults_is_raised_with_their_number():
    with pytest.raises(InputError, match=r"a\.json: objects\[0\]: is 22.4 mm inside object 1.*and 1 more"):
        check_standing({"b.json": FIRST, "a.json": IMPOSSIBLE["in-each-other"][0]}, SHELF)


def test_commands_refuse_what_no_world_can_hold(tmp_path, capsys, monkeypatch):
    file = tmp_path / "sunk.json"
    save_scenario(IMPOSSIBLE["in-the-board"][0], file)
    out = tmp_path / "out"
    for arguments in (
        ["scenarios", "check", str(file)],
        ["search", str(file), "--out", str(out)],
        ["evaluate", str(file), "--out", str(out)],
    ):
        monkeypatch.setattr("sys.argv", ["mechsearch", *arguments])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
        assert stopped.value.code == 2
        error = capsys.readouterr().err
        assert "sunk.json: objects[1]: is 5.1 mm inside the board" in error
        assert not out.exists()


def lying(tilt, x, y, half=(0.025, 0.025, 0.08), shape="cylinder"):
    """A body whose top leans to the back by an angle [rad]; the lowest point is on the board."""
    height = half[2] * math.cos(tilt) + half[0] * math.sin(tilt)
    return Body(shape, half, (x, y, BOARD + height), about_y(tilt))


def deep(tilt):
    """How far `lying` reaches to the back from its centre [m]."""
    return 0.08 * math.sin(tilt) + 0.025 * math.cos(tilt)


def against_the_back(tilt, **more):
    return lying(tilt, SHELF.back - deep(tilt), 0.1, **more)


@pytest.mark.parametrize("tilt", [10, 25, 40])
@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_what_leans_comes_to_rest(world, tilt, shape):
    """Where friction gives way as it did with `impratio` 10, the body slides down the wall for ever."""
    upright = Body("cylinder", (0.035, 0.035, 0.1), (0.62, 0.1, BOARD + 0.1), (1.0, 0.0, 0.0, 0.0))
    angle = math.radians(tilt)
    side = 0.62 - 0.035 - deep(angle) - 0.005
    for objects in ((against_the_back(angle, shape=shape),), (lying(angle, side, 0.11, shape=shape), upright)):
        world.reset(Scenario("leans", objects, TARGET))
        outcome = world.settle()
        assert bool(outcome.settled)
        assert not np.asarray(outcome.restless).any()
        world.settle()
        assert world.trace.time[-1] < 0.5
