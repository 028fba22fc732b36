"""Episodes in the workers of a Ray cluster: rows as of a run on this machine, whichever worker dies."""

import dataclasses
import os
import signal
import socket
import sys
import time
from pathlib import Path

import pytest
from scripted import is_gone
from stage import HIDDEN, OPEN

from mechsearch_jax.benchmarks.running import cluster
from mechsearch_jax.benchmarks.running.cluster import MOST_DEATHS, RayCluster, join
from mechsearch_jax.benchmarks.running.cluster_workers import OnCpus, OnGpus, Worker
from mechsearch_jax.benchmarks.running.evaluate import evaluate, make_jobs
from mechsearch_jax.benchmarks.running.processes import ENVIRONMENT, Processes
from mechsearch_jax.benchmarks.running.sequential import SequentialRunner
from mechsearch_jax.commands.options import EpisodeOptions
from mechsearch_jax.commands.runs import Here, OnRay, RunOptions
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.runtime.cores import VARIABLE
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Body, Scenario, save_scenario

TARGET = Body("cylinder", (0.02, 0.02, 0.05), (0.62, 0.07, 0.4545), (1.0, 0.0, 0.0, 0.0))
# What a clock says is not the same twice.
CLOCKED = ("planning_seconds", "simulation_seconds", "compile_seconds")


class Script:
    """Stands in for what runs jobs in a worker: does what a scenario's name asks for."""

    def __init__(self, folder):
        self._folder = Path(folder)

    def __call__(self, jobs, ended, begin):
        for job in jobs:
            name = job.scenario.name
            with open(self._folder / "log", "a") as log:
                log.write(f"{name} {os.getpid()}\n")
            if name == "crash" or (name == "once" and not self._seen(name)):
                # What ended before has arrived by then.
                time.sleep(0.5)
                os._exit(3)
            if name == "hang":
                time.sleep(600)
            if name == "refuse":
                raise InputError("the weights are missing")
            ended([dataclasses.replace(job.failed(""), failure=None, steps=job.seed)])

    def _seen(self, name):
        try:
            (self._folder / name).touch(exist_ok=False)
        except FileExistsError:
            return True
        return False


@dataclasses.dataclass(frozen=True)
class Scripted(OnCpus):
    """Workers that run a script instead of episodes."""

    folder: str = ""

    def runner(self):
        return Script(self.folder)


@dataclasses.dataclass(frozen=True)
class Unable(OnCpus):
    """Workers that cannot be started."""

    def runner(self):
        raise ImportError("no such library")


class Known(SequentialRunner):
    """The real thing, but it tells which process it is."""

    def __init__(self, folder):
        super().__init__()
        self._folder = Path(folder)

    def __call__(self, jobs, ended, begin):
        (self._folder / f"{os.getpid()}.worker").write_text(str(len(jobs)))
        super().__call__(jobs, ended, begin)


@dataclasses.dataclass(frozen=True)
class KnownOnCpus(OnCpus):
    """The real thing, in processes that are known."""

    folder: str = ""

    def runner(self):
        return Known(self.folder)


@pytest.fixture(scope="module")
def ray():
    """A cluster on this machine, with two CPUs and two GPUs, whatever it has."""
    library = pytest.importorskip("ray", reason="the library ray is not installed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        library.init("local", num_cpus=2, num_gpus=2, include_dashboard=False, log_to_driver=False)
        yield library
        library.shutdown()


def jobs_of(folder, *names, seeds=(0,), method=None):
    for name in names:
        save_scenario(Scenario(name, (), TARGET), folder / f"{name}.json")
    return make_jobs([folder / f"{name}.json" for name in names], [method or Method()], seeds)


def scripted(folder, workers=1, time_limit=60.0):
    return RayCluster(Scripted(workers, time_limit, str(folder)))


def ran(folder):
    return [line.split()[0] for line in (folder / "log").read_text().splitlines()]


def without_times(rows):
    return [dataclasses.replace(row, **dict.fromkeys(CLOCKED, 0.0)) for row in rows]


@pytest.mark.slow
def test_an_episode_that_kills_its_workers_is_a_row_with_the_reason(ray, tmp_path):
    jobs = jobs_of(tmp_path, "one", "crash", "three", "four", "five", "six", "seven", "eight")
    rows = evaluate(jobs, tmp_path / "rows", scripted(tmp_path))
    assert [row.scenario for row in rows if row.failure is None] == [
        job.scenario.name for job in jobs if job.scenario.name != "crash"
    ]
    assert str(rows[1].failure).startswith(f"error: {MOST_DEATHS} workers died of it, the last one so: The actor ")
    assert ran(tmp_path).count("crash") == MOST_DEATHS


@pytest.mark.slow
def test_workers_that_cannot_be_started_end_the_run(ray, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "MOST_DEATHS", 1)
    with pytest.raises(InputError, match=r"^Ray at local: no worker can be started \(ImportError: no such library\)$"):
        evaluate(jobs_of(tmp_path, "one"), tmp_path / "rows", RayCluster(Unable(1)))


@pytest.mark.slow
def test_an_interrupt_ends_all_workers(ray, tmp_path):
    jobs = jobs_of(tmp_path, "one", "hang", "three")

    def stop(row, tally):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(jobs, tmp_path / "rows", scripted(tmp_path), ended=stop)
    for line in (tmp_path / "log").read_text().splitlines():
        assert is_gone(int(line.split()[1]))


def test_cpus_are_shared_evenly():
    machines = [{"CPU": 8.0}, {"CPU": 4.0, "GPU": 1.0}, {"memory": 1.0}]
    for workers, expected, share in ((None, 12, 1), (12, 12, 1), (6, 6, 2), (3, 3, 4), (2, 2, 4), (1, 1, 8)):
        place = OnCpus(workers).place(machines)
        assert (place.workers, place.resources) == (expected, {"num_cpus": share})
        assert place.environment == {**ENVIRONMENT, VARIABLE: str(share)}
    with pytest.raises(InputError, match="has 12 CPUs, too few for 13 workers"):
        OnCpus(13).place(machines)
    with pytest.raises(InputError, match="has 0 CPUs"):
        OnCpus().place([{"memory": 1.0}])


def test_every_gpu_has_a_worker():
    place = OnGpus().place([{"CPU": 16.0, "GPU": 2.0}, {"CPU": 4.0, "GPU": 1.0}, {"CPU": 64.0}])
    assert place == (3, {"num_gpus": 1, "num_cpus": 1}, {VARIABLE: "4"})
    assert OnGpus().place([{"CPU": 1.0, "GPU": 2.0}]) == (2, {"num_gpus": 1, "num_cpus": 0}, {VARIABLE: "1"})
    with pytest.raises(InputError, match="has no GPU for batches"):
        OnGpus().place([{"CPU": 16.0}])


def test_chunks_are_single_jobs_on_cpus_and_share_a_compilation_on_gpus(tmp_path):
    jobs = jobs_of(tmp_path, "one", "two", "three", seeds=range(10))
    assert OnCpus().chunks(jobs, 2) == [(job,) for job in jobs]
    other = jobs_of(tmp_path, "one", seeds=range(3), method=Method(config=PRESETS["standard"](horizon=2)))
    chunks = OnGpus().chunks([*jobs, *other], 4)
    assert [len(chunk) for chunk in chunks] == [8, 8, 7, 7, 1, 1, 1]
    assert sorted(job.key for chunk in chunks for job in chunk) == sorted(job.key for job in [*jobs, *other])
    assert all(len({job.method for job in chunk}) == 1 for chunk in chunks)
    assert [len(chunk) for chunk in OnGpus(worlds=2).chunks(jobs, 2)] == [8, 8, 7, 7]


def test_a_worker_with_other_code_is_not_started():
    with pytest.raises(InputError, match=r" has mechsearch-jax 0.*, this machine mechsearch-jax 9.9 \(abc\)"):
        Worker(OnCpus(), "mechsearch-jax 9.9 (abc)")


def test_without_the_library_it_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"a cluster needs the library ray .*pip install 'mechsearch-jax\[ray\]'"):
        join()


def test_an_address_where_nobody_answers_is_refused(monkeypatch):
    library = pytest.importorskip("ray", reason="the library ray is not installed")
    monkeypatch.setattr(library, "is_initialized", lambda: False)
    with socket.create_server(("127.0.0.1", 0)) as server:
        closed = f"127.0.0.1:{server.getsockname()[1]}"
    with pytest.raises(InputError, match=r"^Ray at 127.0.0.1:\d+: cannot be reached \(.*\); is it running"):
        join(closed)
    for wrong in ("host", "host:port", "http://host:80", "host:70000", ":80"):
        with pytest.raises(InputError, match=r"is not HOST:PORT"):
            join(wrong)


def test_where_episodes_run_goes_by_what_the_cluster_has(monkeypatch):
    machines = [{"CPU": 4.0}]
    entered = []
    monkeypatch.setattr(cluster, "join", lambda address: entered.append(address) or machines)
    assert RunOptions().site("evaluate") == Here()
    for text, address in (("ray", "local"), ("ray:auto", "auto"), ("ray:10.0.0.1:6379", "10.0.0.1:6379")):
        assert RunOptions(cluster=text).site("evaluate") == OnRay(address)
    run = RunOptions(cluster="ray:auto")
    assert run.engine("evaluate", EpisodeOptions()) == "NativeSimulator"
    assert entered[0] == "auto"
    assert run.in_processes("evaluate", "auto")
    machines.append({"CPU": 4.0, "GPU": 1.0})
    assert run.engine("evaluate", EpisodeOptions()) == "MjxSimulator"
    assert run.engine("evaluate", EpisodeOptions(simulator="native")) == "NativeSimulator"
    assert not run.in_processes("evaluate", "native")
    assert dataclasses.replace(run, workers=2).in_processes("evaluate", "auto")
    assert run.site("evaluate").runner(run, False, None) == RayCluster(OnGpus(None), "auto")
    few = dataclasses.replace(run, workers=2, time_limit=9.0)
    assert run.site("evaluate").runner(few, True, None) == RayCluster(OnCpus(2, 9.0), "auto")


@pytest.mark.slow
def test_rows_are_those_of_a_local_run_although_a_worker_was_killed(ray, tmp_path):
    """As `evaluate --cluster ray` runs them, with planner and native simulator."""
    for scene in (HIDDEN, OPEN):
        save_scenario(scene, tmp_path / f"{scene.name}.json")
    method = Method(config=PRESETS["standard"](max_steps=2, sequences=5, horizon=1))
    jobs = make_jobs([tmp_path / "hidden.json", tmp_path / "open.json"], [method], range(4))
    killed = []

    def kill(row, tally):
        if not killed:
            # Of the two, one has ended an episode, and is about to run the next one.
            killed.append(min(tmp_path.glob("*.worker"), key=lambda file: file.stat().st_mtime))
            os.kill(int(killed[0].stem), signal.SIGKILL)

    runner = RayCluster(KnownOnCpus(2, folder=str(tmp_path)))
    rows = evaluate(jobs, tmp_path / "cluster", runner, ended=kill)
    assert len(list(tmp_path.glob("*.worker"))) == 3
    assert not any(row.is_error for row in rows)
    assert without_times(rows) == without_times(evaluate(jobs, tmp_path / "local", Processes(2)))
