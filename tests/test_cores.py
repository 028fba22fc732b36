"""Who shares a machine keeps its share of the cores busy, and leaves no files behind that nobody wants."""

import math
import os

import jax
import mujoco
import numpy as np
import pytest

from mechsearch_jax.envs.world import model
from mechsearch_jax.runtime import cores as cores_module
from mechsearch_jax.runtime.cores import VARIABLE, cores, cpu_quota, on_host, share_of_cores
from mechsearch_jax.workspace.camera import Camera
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


V1, V2 = (
    "31 23 0:29 {root} /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu,cpuacct",
    "31 23 0:29 {root} /sys/fs/cgroup rw - cgroup2 cgroup2 rw",
)
PERIOD = {"a/cpu.cfs_period_us": "100000"}
BOTH = "30 23 0:1 / /proc rw - proc proc rw\n32 23 0:28 / /sys/fs/cgroup/pids rw - cgroup cgroup rw,pids\n"


@pytest.mark.parametrize(
    ("mount", "group", "files", "expected"),
    [
        (V2.format(root="/"), "0::/a/b", {"a/b/cpu.max": "200000 100000"}, 2.0),
        (V2.format(root="/"), "0::/a/b", {"a/b/cpu.max": "max 100000", "a/cpu.max": "50000 100000"}, 0.5),
        (V2.format(root="/"), "0::/", {"cpu.max": "max 100000"}, math.inf),
        (V2.format(root="/docker/a"), "0::/docker/a/b", {"cpu.max": "150000 100000"}, 1.5),
        # Not a folder that the process sees.
        (V2.format(root="/"), "0::/../../a", {"cpu.max": "300000 100000"}, 3.0),
        (V2.format(root="/"), "0::/a", {"a/cpu.max": "nonsense"}, math.inf),
        (V2.format(root="/"), "nonsense", {}, math.inf),
        (V1.format(root="/"), "4:pids:/c\n1:cpu,cpuacct:/a\n0::/d", {"a/cpu.cfs_quota_us": "50000", **PERIOD}, 0.5),
        (V1.format(root="/"), "1:cpu,cpuacct:/a", {"a/cpu.cfs_quota_us": "-1", **PERIOD}, math.inf),
        (V1.format(root="/"), "1:pids:/a", {"a/cpu.cfs_quota_us": "50000", **PERIOD}, math.inf),
    ],
)  # fmt: skip
def test_a_quota_of_processor_time_is_read_of_the_group_and_those_that_hold_it(tmp_path, mount, group, files, expected):
    at = mount.split()[4].lstrip("/")
    for name, text in {"proc/self/cgroup": group, "proc/self/mountinfo": BOTH + mount}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    for name, text in files.items():
        (tmp_path / at / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / at / name).write_text(text)
    assert cpu_quota(tmp_path) == expected


@pytest.mark.parametrize(("quota", "expected"), [(0.5, 1), (1.0, 1), (2.9, 2), (8.0, 4), (math.inf, 4)])
def test_a_quota_counts_as_cores(monkeypatch, quota, expected):
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(cores_module, "cpu_quota", lambda: quota)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(4)))
    assert cores() == expected
    monkeypatch.setenv(VARIABLE, "6")
    assert cores() == 6


def test_without_control_groups_there_is_no_quota(tmp_path):
    assert cpu_quota(tmp_path) == math.inf


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


def test_a_simulation_that_diverges_leaves_no_log(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    compiled = model.compile_model(Shelf(), Camera())
    data = mujoco.MjData(compiled)
    data.qvel[:] = 1e30
    mujoco.mj_step(compiled, data)
    assert np.sum([warning.number for warning in data.warning]) > 0
    assert list(tmp_path.iterdir()) == []
