"""Who shares a machine keeps its share of the cores busy, and leaves no files behind that nobody wants."""

import os

import jax
import mujoco
import numpy as np
import pytest
import scripted

from mechsearch_jax.benchmarks.running.evaluate import make_jobs
from mechsearch_jax.benchmarks.running.processes import Processes
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.world import model
from mechsearch_jax.runtime.cores import VARIABLE, cores, on_host, share_of_cores
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import example_scenarios
from mechsearch_jax.workspace.shelf import Shelf


def test_the_cores_are_those_given_or_all(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    everything = cores()
    assert 1 <= everything <= (os.cpu_count() or 1)
    for wrong in ("", "0", "-1", "many"):
        monkeypatch.setenv(VARIABLE, wrong)
        assert cores() == everything
    monkeypatch.setenv(VARIABLE, "6")
    assert cores() == 6


def test_beside_a_gpu_the_host_computes_and_alone_it_is_what_computes_anyway(monkeypatch):
    with on_host():
        assert jax.default_device.value is None
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with on_host():
        assert jax.default_device.value.platform == "cpu"
    assert jax.default_device.value is None

    def not_there(backend):
        raise RuntimeError(f"Unknown backend {backend}")

    monkeypatch.setattr(jax, "local_devices", not_there)
    with on_host():
        assert jax.default_device.value is None


@pytest.mark.parametrize(("processes", "each"), [(1, "6"), (2, "3"), (4, "1"), (7, "1")])
def test_processes_share_them(monkeypatch, processes, each):
    monkeypatch.setenv(VARIABLE, "6")
    assert share_of_cores(processes) == {VARIABLE: each}


@pytest.mark.slow
@pytest.mark.always
def test_workers_are_given_their_share(monkeypatch):
    monkeypatch.setenv(VARIABLE, "6")
    jobs = make_jobs([example_scenarios()["first-light"]], [Method()], (0, 1))
    rows, before = [], dict(os.environ)
    Processes(4, run=scripted.share)(jobs, rows.extend, lambda job: True)
    assert [row.failure for row in rows] == ["error: share 3"] * 2
    assert dict(os.environ) == before


def test_a_simulation_that_diverges_leaves_no_log(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    compiled = model.compile_model(Shelf(), Camera())
    data = mujoco.MjData(compiled)
    data.qvel[:] = 1e30
    mujoco.mj_step(compiled, data)
    assert np.sum([warning.number for warning in data.warning]) > 0
    assert list(tmp_path.iterdir()) == []
