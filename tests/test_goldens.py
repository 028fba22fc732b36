"""The safety net for refactoring: what its episodes cover."""

import importlib.util
from pathlib import Path

import pytest

from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.planner import PRESETS


@pytest.fixture
def net(monkeypatch):
    # It sets what is not set, for the processes that it starts.
    monkeypatch.setenv("PJRT_NPROC", "1")
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    spec = importlib.util.spec_from_file_location("net", Path(__file__).parent / "goldens" / "net.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_goldens_cover_trials_as_the_default_has_them(net):
    jobs = net.episode_jobs()
    assert len({(Path(file).stem, *rest) for file, *rest in jobs}) == len(jobs)
    default = Method().config.trials
    for recognition in net.RECOGNITIONS:
        tried = {r for _, method, seen, r in jobs if (method, seen) == ("search-for-grasp", recognition)}
        assert tried == ({default, "none"} if recognition == "oracle" else {default})
    assert ("search-and-grasp", "oracle", default) in {tuple(rest) for _, *rest in jobs}
    assert PRESETS["standard"](trials="none") != PRESETS["standard"](trials=default)
