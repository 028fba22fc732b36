"""`mechsearch doctor`: what it finds, what it advises, and when it says that nothing works."""

import dataclasses
import importlib.metadata
import re
import sys

import numpy as np
import pytest

from mechsearch_jax.commands import main as cli
from mechsearch_jax.envs.health import cell_health as health
from mechsearch_jax.envs.health.cell_health import State
from mechsearch_jax.problem import cache
from mechsearch_jax.problem.problem import NOWHERE
from mechsearch_jax.problem.settings import Settings
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime import kept_arrays
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario
from mechsearch_jax.workspace.target import Target

SCENE = load_scenario(example_scenarios()["first-light"])


def findings_of(subject, settings=None):
    return list(health.examine(subject, health.checks(SCENE, settings or Settings())[subject]))


@pytest.mark.parametrize("prefix", ["site/cmeel.prefix", "env"])
def test_the_robots_meshes_are_found_without_a_module(tmp_path, monkeypatch, prefix):
    monkeypatch.setattr(sys, "path", [str(tmp_path / "site"), *(p for p in sys.path if "site-packages" not in p)])
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "env"))
    (missing,) = findings_of("meshes")
    assert (missing.state, missing.remedy) == (State.MISSING, "pip install 'mechsearch-jax[meshes]'")
    folder = tmp_path / prefix / "share/example-robot-data/robots/panda_description/meshes/collision"
    folder.mkdir(parents=True)
    (found,) = findings_of("meshes")
    assert (found.state, str(folder) in found.says) == (State.FINE, True)


def cell_of(problem, monkeypatch, settings=None):
    """The findings on a cell with a cached problem, by subject."""
    monkeypatch.setattr(Workcell, "problem", lambda self, target=None, config=None: problem)
    checks = health.checks(None, settings or Settings(), cell=True)
    return {part: list(health.examine(part, checks[part])) for part in health.CELL}


def test_the_default_cell_is_fine(problem, monkeypatch):
    findings = cell_of(problem, monkeypatch)
    assert {finding.state for part in findings.values() for finding in part} == {State.FINE}
    assert "sees 100% of the board" in findings["camera"][0].says
    share, *lost, tilts = (finding.says for finding in findings["shelf"])
    assert "can grasp the target at 95% of its 792" in share
    # The walls are alike, and keep the hand from the row of poses beside each.
    counts = [
        int(re.match(r"not at (\d+) of them: the (?:back|right|left) wall is in the way", one)[1]) for one in lost
    ]
    assert counts[1] == counts[2] == 18
    assert "of the board's front left 7%, middle left 7%, back left 7%" in lost[2]
    assert sum(counts) == 792 - len(np.unique(problem.grasps.pair_pose))
    assert re.search(rf"down by 0 to 60° instead of 20 to 30° could grasp it at \d of these {sum(counts)}$", tilts)
    assert "told by its colour, red 0.7282" in findings["target"][0].says
    assert "recognition and segmentation" in findings["networks"][0].says
    assert "trials physics, push model learned, at most 10 actions" in findings["planner"][0].says


def test_a_cell_that_cannot_work_is_broken(problem, monkeypatch):
    camera = Camera()
    flipped = tuple((a, -b, -c) for a, b, c in camera.rotation)
    away = Settings(Workcell(camera=dataclasses.replace(camera, rotation=flipped)))
    (finding,) = cell_of(problem, monkeypatch, away)["camera"]
    assert (finding.state, "OpenGL" in finding.says, "[camera]" in finding.remedy) == (State.BROKEN, True, True)

    wide = Settings(Workcell(target=Target.of("box", (0.06, 0.06, 0.05))))
    (finding,) = cell_of(problem, monkeypatch, wide)["target"]
    assert (finding.state, "0.120 m wide" in finding.says) == (State.BROKEN, True)

    def nowhere(self, target=None, config=None):
        raise InputError(NOWHERE)

    monkeypatch.setattr(Workcell, "problem", nowhere)
    (finding,) = health.examine("shelf", health.checks(None, Settings(), cell=True)["shelf"])
    assert (finding.state, finding.says) == (State.BROKEN, NOWHERE)


def test_a_cell_that_works_less_well_is_doubtful(problem, monkeypatch):
    near = Settings(Workcell(camera=dataclasses.replace(Camera(), fx=1900.0, fy=1900.0)))
    findings = cell_of(problem, monkeypatch, near)
    assert [finding.state for finding in findings["camera"]] == [State.DOUBTFUL, State.FINE]
    findings = cell_of(problem, monkeypatch, Settings(Workcell(camera=Camera().moved((-0.5, 0.27, 0.2)))))
    assert findings["networks"][0].state is State.DOUBTFUL


def test_doctor_looks_at_the_cell_that_is_given(problem, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(health, "CHECKS", {})
    monkeypatch.setattr(Workcell, "problem", lambda self, target=None, config=None: problem)
    monkeypatch.setenv(kept_arrays.VARIABLE, "")
    file = tmp_path / "mine.toml"
    file.write_text("[shelf]\nfront = 1.414\nback = 1.788\nspawn_x = [1.45, 1.73]\n")
    cli.parse(["doctor", "--config", str(file)])()
    printed = capsys.readouterr().out
    assert [line.split()[0] for line in printed.splitlines() if line[0] != " "][:3] == ["camera", "target", "shelf"]
    assert "first-light" not in printed
    file.write_text("[camera]\nposition = [3.0, 0.0, 0.6]\n")
    with pytest.raises(SystemExit) as end:
        cli.parse(["doctor", "--config", str(file)])()
    assert end.value.code == 1
    assert "camera     BROKEN   camera: looks away from the shelf" in capsys.readouterr().out


def test_a_check_that_fails_is_reported():
    def fails():
        raise RuntimeError("two\nlines")
        yield

    (needed,) = health.examine("simulator", fails)
    assert (needed.state, needed.says) == (State.BROKEN, "RuntimeError: two lines")
    assert next(iter(health.examine("meshes", fails))).state is State.MISSING


def test_versions_devices_and_simulator_are_named():
    (versions,) = findings_of("versions")
    assert versions.state is State.FINE
    assert f"mechsearch-jax {importlib.metadata.version('mechsearch-jax')}" in versions.says
    assert "JAX computes on cpu" in findings_of("devices")[0].says
    assert findings_of("simulator")[0].state is State.FINE


def test_a_package_that_is_missing_breaks_the_main_job(monkeypatch):
    monkeypatch.setattr(health, "PACKAGES", ("jax", "no-such-package"))
    broken = findings_of("versions")[-1]
    assert (broken.state, broken.remedy) == (State.BROKEN, "pip install no-such-package")


def test_releases_of_mujoco_that_do_not_go_together_are_told(monkeypatch):
    monkeypatch.setattr(health, "_version", lambda name: "4.0.0" if name == "mujoco" else "3.17.0")
    doubtful = findings_of("versions")[-1]
    assert (doubtful.state, doubtful.remedy) == (State.DOUBTFUL, "pip install mujoco==3.17.0")


@pytest.mark.parametrize(("state", "status"), [(State.MISSING, None), (State.BROKEN, 1)])
def test_the_status_says_whether_the_main_job_runs(monkeypatch, capsys, state, status):
    def check():
        yield health.Finding("weights", state, "gone", "install them")

    monkeypatch.setattr(health, "CHECKS", {"weights": check})
    monkeypatch.setattr(cache, "is_cached", lambda *args, **parts: True)
    command = cli.parse(["doctor"])
    if status:
        with pytest.raises(SystemExit) as end:
            command()
        assert end.value.code == status
    else:
        command()
    printed = capsys.readouterr().out
    assert "gone" in printed
    assert "-> install them" in printed
    assert printed.splitlines()[-1] == ("nothing can be searched here" if status else "searching works here")
