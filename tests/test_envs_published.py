"""The published scenes: files as the authors' become scenarios, and nothing else is unpickled."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from published import FOLDER as OURS

from mechsearch_jax.commands.main import parse
from mechsearch_jax.envs.scenes.published import published_files, read_published
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import load_scenario


def body(shape, size, position, orientation=(0.0, 0.0, 0.0, 1.0)):
    return {
        "type": shape, "size": size, "position": position, "orientation": orientation,
        "object_color": (np.float64(0.1), 0.2, 0.3, 1.0),
    }  # fmt: skip


CYLINDER = body("cylinder", [np.float64(0.032), 0.032, 0.122], (0.6271400004, -0.055227, 0.46549), (0.0, 0.0, 1.0, 0.0))
BOX = body("box", [0.156, 0.044, 0.192], np.array([0.677852, -0.026518, 0.500489]))
TARGET = body("cylinder", [0.02, 0.02, 0.1], (0.738, -0.14043, 0.4545))


def write(folder, number, content, objects=2):
    file = folder / f"objects_{objects}" / f"initial_scenario_{number}.pkl"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(pickle.dumps(content))
    return file


def test_a_published_file_is_a_scenario(tmp_path):
    scenario = read_published(write(tmp_path, 7, [CYLINDER, BOX, TARGET]))
    assert scenario.name == "published-2-07"
    cylinder, box = scenario.objects
    assert (cylinder.shape, cylinder.half_size) == ("cylinder", (0.032, 0.032, 0.061))
    assert cylinder.position == (0.62714, -0.055227, 0.46549)
    # Their quaternions end with the real part, ours begin with it.
    assert cylinder.quaternion == (0.0, 0.0, 0.0, 1.0)
    assert (box.half_size, box.quaternion) == ((0.078, 0.022, 0.096), (1.0, 0.0, 0.0, 0.0))
    assert scenario.target.half_size == (0.02, 0.02, 0.05)


def test_the_command_makes_scenarios_of_all(tmp_path, capsys):
    for number in (10, 2):
        write(tmp_path / "exp_configs", number, [CYLINDER, BOX, TARGET])
    assert [file.name for file in published_files(tmp_path)] == ["initial_scenario_2.pkl", "initial_scenario_10.pkl"]
    parse(["scenarios", "import", str(tmp_path / "exp_configs"), "--out", str(tmp_path / "out")])()
    assert capsys.readouterr().out == f"2 scenarios: {tmp_path / 'out'}\n"
    assert load_scenario(tmp_path / "out" / "published-2-10.json").objects[1].shape == "box"


@pytest.mark.skipif(not OURS.is_dir(), reason="the published scenes are not there")
def test_it_is_what_results_ran_on(tmp_path):
    ours = load_scenario(OURS / "objects_2_00.json")
    bodies = []
    for each in (*ours.objects, ours.target):
        size = np.array(each.half_size) * (2.0 if each.shape == "box" else [1.0, 1.0, 2.0])
        w, *xyz = each.quaternion
        bodies.append(body(each.shape, size.tolist(), each.position, (*xyz, w)))
    again = read_published(write(tmp_path, 0, bodies))
    assert (again.name, again.content_hash) == (ours.name, ours.content_hash)


class Evil:
    def __reduce__(self):
        return Path.touch, (Path("evil"),)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ([Evil()], "neither a number nor an array"),
        ([CYLINDER, TARGET], "holds 2 bodies, not 2 objects and a target"),
        ([CYLINDER, BOX, {"type": "box"}], "none of the published scenes"),
        ([CYLINDER, BOX, {**TARGET, "type": "sphere"}], "neither box nor cylinder"),
        (3, "none of the published scenes"),
    ],
    ids=["code", "too few", "no size", "shape", "number"],
)
def test_what_is_no_published_scene_is_refused(content, reason, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = write(tmp_path, 0, content)
    with pytest.raises(InputError, match=reason):
        read_published(file)
    assert not Path("evil").exists()
    with pytest.raises(InputError, match="objects_N/initial_scenario_K"):
        published_files(tmp_path / "nothing")
    file.rename(tmp_path / "scene.pkl")
    with pytest.raises(InputError, match="is not named"):
        read_published(tmp_path / "scene.pkl")
