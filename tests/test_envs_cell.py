"""One call makes a searcher from a configuration file, and it plans as `mechsearch search` does with that file."""

import os

import pytest

from mechsearch_jax.envs.cell import loading as cell
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.trials.named import named_trials
from mechsearch_jax.images.examples import example_images
from mechsearch_jax.problem.settings import Settings, load_settings
from mechsearch_jax.runtime.compiled import _KEEPING
from mechsearch_jax.runtime.errors import InputError

FILE = """
[camera]
width = 848
height = 480
fx = 404.0
fy = 404.0
cx = 424.0
cy = 240.0

[planner]
gamma = 0.8
max_steps = 3
push_model = "quasi-static"
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(FILE)
    return path


def test_a_file_says_workcell_and_planner(file):
    settings = load_settings(file)
    searcher = cell.load_searcher(file, keep=False)
    assert searcher.workcell == settings.workcell
    # A robot touches nothing beside what is to be moved, unless the file says that it may.
    config = settings.config.with_options(retrieval_contact=False)
    assert searcher.config == config
    assert cell.load_searcher(file, keep=False, retrieval_contact=True).config == settings.config
    expected = Method(config=config, workcell=settings.workcell).policy()
    policy = searcher._policy
    assert policy.config == expected.config
    assert policy.tries
    assert expected.tries
    assert searcher._trials == named_trials("physics")
    assert (policy.predict, policy.objective, policy.plan) == (expected.predict, expected.objective, expected.plan)


def test_what_is_given_goes_before_the_file(file):
    camera = example_images().camera
    searcher = cell.load_searcher(file, camera=camera, keep=False, trials="none", max_steps=7, seed=3)
    assert searcher.workcell.camera == camera
    assert (searcher.config.max_steps, searcher.config.planner.gamma) == (7, 0.8)
    assert (searcher._policy.tries, searcher._trials) == (False, None)
    with pytest.raises(InputError, match="option speed is unknown"):
        cell.load_searcher(file, keep=False, speed=1.0)


def test_without_a_file_all_is_as_by_default():
    assert cell.load_searcher(keep=False).config == Settings().config.with_options(retrieval_contact=False)


def test_compilations_are_kept(file, tmp_path, monkeypatch):
    monkeypatch.setenv("MECHSEARCH_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", os.environ.get("JAX_COMPILATION_CACHE_DIR", str(tmp_path)))
    cell.load_searcher(file)
    assert _KEEPING.executables.folder == tmp_path / "cache" / "executables"
