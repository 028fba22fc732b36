"""How episodes per second grow with the workers: the same scenes for each of them, and only what they do once up."""

import collections
import dataclasses
import sys
import types

import pytest

from mechsearch_jax.benchmarks.parts import scaling
from mechsearch_jax.benchmarks.report.report_bench import drawn_rows
from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.benchmarks.store.shards import ShardWriter
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

SCENES = [load_scenario(file) for file in example_scenarios().values()]


def ended(job):
    """The row of an episode that ended without a retrieval."""
    row = job.failed("")
    return dataclasses.replace(row, failure="not found", steps=4, device="cpu: cpu", versions="{}")


class InTwos:
    """Instead of `Processes`: workers take turns, and every episode takes a second of a clock of their own."""

    def __init__(self, workers, run, cores):
        self.workers, self.run = workers, run

    def __call__(self, jobs, took, begin):
        for place, job in enumerate(jobs):
            assert begin(job)
            scaling.os.worker = place % self.workers
            took([self.run(job)])


@pytest.fixture
def workers(monkeypatch):
    seconds = collections.Counter()

    def monotonic():
        seconds[scaling.os.worker] += 1
        return float(seconds[scaling.os.worker])

    here = types.SimpleNamespace(getpid=lambda: here.worker, worker=0)
    monkeypatch.setattr(scaling, "os", here)
    monkeypatch.setattr(scaling, "time", types.SimpleNamespace(monotonic=monotonic, process_time=lambda: 7.0))
    monkeypatch.setattr(scaling, "run_job", ended)
    monkeypatch.setattr(scaling, "Processes", InTwos)


def test_every_worker_has_a_copy_of_each_scene():
    jobs = scaling._copies(SCENES, 3)
    assert len({job.key for job in jobs}) == len(jobs) == 3 * (len(SCENES) + 1)
    contents = collections.Counter(job.scenario.content_hash for job in jobs[3:])
    assert contents == {scenario.content_hash: 3 for scenario in SCENES}
    assert {job.scenario.content_hash for job in jobs[:3]} <= set(contents)


def test_only_what_a_worker_does_once_up_is_timed(workers):
    one, three = (scaling.measure_workers(SCENES, count, 2, "typed") for count in (1, 3))
    # A spell takes a second, and the next begins a second later.
    assert (one.episodes, one.seconds, one.cores) == (len(SCENES), 2.0 * len(SCENES), 2)
    assert (three.episodes, three.seconds) == (3 * len(SCENES), 2.0 * len(SCENES))
    assert scaling.ratio(three, [one, three]) == pytest.approx(3.0)
    assert scaling.scaling_table([one, three]).row_count == 2
    assert (three.cpu_seconds, three.code, three.device, three.steps) == (0.0, present_code(), "cpu: cpu", 4.0)


def test_an_episode_that_fails_is_no_measurement(workers, monkeypatch):
    monkeypatch.setattr(scaling, "run_job", lambda job: job.failed("no memory"))
    with pytest.raises(InputError, match="error: no memory"):
        scaling.measure_workers(SCENES, 1, 1, "typed")


def test_each_gpu_has_a_process_and_its_share_of_the_cores(monkeypatch, tmp_path):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,6,7")
    shards = scaling._commands("shards", 2, range(4), 16, tmp_path)
    assert [variables for _, variables in shards] == [
        {"CUDA_VISIBLE_DEVICES": name, "MECHSEARCH_CORES": "16"} for name in ("4", "6")
    ]
    assert [arguments[arguments.index("--shard") + 1] for arguments, _ in shards] == ["1/2", "2/2"]
    assert len({arguments[arguments.index("--out") + 1] for arguments, _ in shards}) == 2
    ((arguments, variables),) = scaling._commands("ray", 2, range(4), 16, tmp_path)
    assert variables == {"CUDA_VISIBLE_DEVICES": "4,6", "MECHSEARCH_CORES": "32"}
    assert arguments[arguments.index("--cluster") + 1] == "ray"
    with pytest.raises(InputError, match="4 GPUs are wanted, and 3 are here"):
        scaling.measure_gpus("shards", 4, 8, 1, "typed")


# Adds the rows of one folder to another, as the command would.
COPY = "import shutil, sys, time; shutil.copytree(sys.argv[1], sys.argv[3], dirs_exist_ok=True); time.sleep({})"


def test_rows_are_timed_as_they_come(tmp_path):
    rows = drawn_rows(8)
    for name, part in (("a", rows[:4]), ("b", rows[4:])):
        with ShardWriter(tmp_path / name, name) as writer:
            writer.append(part)
    commands = [
        ([sys.executable, "-c", COPY.format(60), str(tmp_path / name), "--out", str(tmp_path / f"{name}-out")], {})
        for name in ("a", "b")
    ]
    read, times = scaling._times_of_rows(commands, tmp_path, 8, lambda what: None)
    assert sorted(map(repr, read)) == sorted(map(repr, rows))
    assert len(times) == 8
    assert times == sorted(times)
    assert isinstance(read[0], EpisodeRow)
