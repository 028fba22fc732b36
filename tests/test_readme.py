"""The README: what it tells a reader to do works, and what it shows is there."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mechsearch_jax.workspace.scenario import example_scenarios

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def test_it_fits_two_screens():
    assert len(README.splitlines()) <= 80


def test_there_are_two_commands():
    install_and_run, install_and_test = (block.strip() for block in blocks("bash"))
    assert re.search(r"mechsearch search (\S+)", install_and_run)[1] in example_scenarios()
    assert install_and_test.endswith("pytest")


def test_the_first_screen_moves():
    (moving,) = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", README)
    assert README[: README.index(moving)].count("\n") < 10
    assert (ROOT / moving).stat().st_size < 5_000_000
    with Image.open(ROOT / moving) as picture:
        assert picture.n_frames > 50


def test_the_command_that_made_the_animation_is_beside_it():
    (module,) = re.findall(r"`python -m (\S+pictures)`", README)
    assert importlib.util.find_spec(module)
    assert "](docs/search.webp)" in README


@pytest.mark.slow
@pytest.mark.always
def test_the_lines_of_python_lead_from_images_to_a_joint_trajectory(capsys, monkeypatch):
    # The process belongs to all tests, and keeps nothing.
    monkeypatch.setenv("MECHSEARCH_CACHE_DIR", "")
    (code,) = blocks("python")
    names = {}
    exec(code, names)
    assert capsys.readouterr().out == ""
    trajectory, decision = names["trajectory"], names["decision"]
    kinds = names["ms"].ActionKind
    kind = kinds(int(decision.action.kind))
    assert kind in (kinds.PUSH, kinds.PICK_AND_PLACE, kinds.RETRIEVE)
    assert kind == kinds.RETRIEVE or float(decision.predicted_cost) < float(decision.cost)
    steps = trajectory.time.shape[0]
    assert trajectory.position.shape == trajectory.velocity.shape == (steps, 7)
    assert trajectory.gripper.shape == (steps,)
    assert np.isfinite(trajectory.position).all()


@pytest.mark.parametrize("file", ["LICENSE", "CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff"])
def test_files_that_it_names_are_there(file):
    assert (ROOT / file).stat().st_size > 0
