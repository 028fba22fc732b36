"""Many episodes: rows as they end, none missing or double, whatever is killed; and failures that are rows."""

import dataclasses
import io
import json
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import pytest
from rich.console import Console
from scripted import is_gone, one_by_one, run

from mechsearch_jax.benchmarks.report import console_tables
from mechsearch_jax.benchmarks.report.episode_tables import summary_table
from mechsearch_jax.benchmarks.running import evaluate as benchmark
from mechsearch_jax.benchmarks.running.evaluate import evaluate, make_jobs, present_code, shard_of
from mechsearch_jax.benchmarks.running.processes import Processes
from mechsearch_jax.benchmarks.statistics.rates import summarise
from mechsearch_jax.benchmarks.statistics.variants import Key
from mechsearch_jax.benchmarks.store.rows import episode_key, identity
from mechsearch_jax.benchmarks.store.shards import OPEN, Results
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.runtime import versions
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Body, Scenario, save_scenario

standard = PRESETS["standard"]
TARGET = Body("cylinder", (0.02, 0.02, 0.05), (0.62, 0.07, 0.4545), (1.0, 0.0, 0.0, 0.0))


@pytest.fixture
def files(tmp_path):
    names = ("one", "two", "raise", "three")
    for name in names:
        save_scenario(Scenario(name, (), TARGET), tmp_path / f"{name}.json")
    return [tmp_path / f"{name}.json" for name in names]


@pytest.fixture(autouse=True)
def log(tmp_path, monkeypatch):
    monkeypatch.setenv("LOG", str(tmp_path / "log"))
    return tmp_path / "log"


def read_rows(folder):
    results = Results(folder)
    results.refresh()
    return list(results.rows.values())


def ran(tmp_path):
    return sorted(line.split()[0] for line in (tmp_path / "log").read_text().splitlines())


def test_a_stopped_run_goes_on_where_it_was(tmp_path, files):
    out = tmp_path / "rows"
    jobs = make_jobs(files, [Method()], (0,))

    def stop(row, tally):
        if tally.ended == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(jobs, out, one_by_one, ended=stop)
    first = read_rows(out)
    assert len(first) == 2
    rows = evaluate(jobs, out, one_by_one)
    assert [row.scenario for row in rows] == ["one", "two", "raise", "three"]
    assert [row for row in read_rows(out) if row in first] == first
    (tmp_path / "log").write_text("")
    assert evaluate(jobs, out, one_by_one) == rows
    assert ran(tmp_path) == []


@pytest.mark.parametrize(
    "other",
    [
        {"retrieval_contact": False},
        {"max_steps": 5},
        {"sequences": 50},
        {"push_distances": (0.1,)},
        {"push_model": "physics"},
        {"gamma": 0.5},
    ],
    ids=lambda other: next(iter(other)),
)
def test_every_option_tells_rows_apart(tmp_path, files, other):
    out = tmp_path / "rows"
    for method in (Method(), Method(config=standard(**other)), Method()):
        rows = evaluate(make_jobs(files[:1], [method], (0,)), out, one_by_one)
        assert len(rows) == 1
    assert ran(tmp_path) == ["one", "one"]
    both = read_rows(out)
    assert len(both) == 2
    assert len({identity(row) for row in both}) == 2
    assert [rates.episodes for rates in summarise(both)] == [1] * 4


def test_an_edited_file_of_the_same_name_gets_rows_of_its_own(tmp_path, files):
    out = tmp_path / "rows"
    first = evaluate(make_jobs(files[:2], [Method()], (0,)), out, one_by_one)
    edited = Scenario("one", (), dataclasses.replace(TARGET, position=(0.62, 0.08, 0.4545)))
    save_scenario(edited, files[0])
    (row, other) = evaluate(make_jobs(files[:2], [Method()], (0,)), out, one_by_one)
    assert ran(tmp_path) == ["one", "one", "two"]
    assert (row.scenario, row.failure, row.content_hash) == ("one", None, edited.content_hash)
    assert other == first[1]
    assert sorted(read_rows(out), key=identity) == sorted([*first, row], key=identity)
    # As it was before, it has its rows still; and how a file is written does not matter.
    save_scenario(Scenario("one", (), TARGET), files[0])
    files[1].write_text(json.dumps(json.loads(files[1].read_text())))
    assert evaluate(make_jobs(files[:2], [Method()], (0,)), out, one_by_one) == first
    assert ran(tmp_path) == ["one", "one", "two"]


def test_rows_of_other_code_are_not_added_to(tmp_path, files, monkeypatch):
    out = tmp_path / "rows"
    (row,) = evaluate(make_jobs(files[:1], [Method()], (0,)), out, one_by_one)
    assert row.code == present_code()
    before = {path.name for path in out.iterdir()}
    monkeypatch.setattr(benchmark, "present_code", lambda: "mechsearch-jax 9.9 (abc)")
    with pytest.raises(InputError, match=r"rows: .* run by mechsearch-jax 0.* is mechsearch-jax 9.9 \(abc\);"):
        evaluate(make_jobs(files[:2], [Method()], (0,)), out, one_by_one)
    assert {path.name for path in out.iterdir()} == before
    assert ran(tmp_path) == ["one"]

    def stale(jobs, ended, begin):
        ended([dataclasses.replace(job.failed("no"), code="mechsearch-jax 9.9 (abc)") for job in jobs if begin(job)])

    monkeypatch.undo()
    with pytest.raises(InputError, match=r"a worker ran mechsearch-jax 9.9 \(abc\), this is mechsearch-jax 0"):
        evaluate(make_jobs(files[:2], [Method()], (0,)), out, stale)
    assert read_rows(out) == [row]


def test_the_code_is_that_of_planner_perception_and_environment(tmp_path, monkeypatch):
    inside = ["planner", "perception/far", "commands", "networks"]
    for name in (*(f"mechsearch_jax/{folder}" for folder in inside), "mechsearch_jax.envs"):
        (tmp_path / name).mkdir(parents=True)
        for file in ("one.py", "network.npz", "network.json"):
            (tmp_path / name / file).write_text(name)
    monkeypatch.setattr(versions.importlib.resources, "files", lambda package: tmp_path / package)
    before = present_code.__wrapped__()
    for decides, change in (
        (False, "mechsearch_jax/commands/one.py"),
        (False, "mechsearch_jax/networks/network.json"),
        (True, "mechsearch_jax/planner/one.py"),
        (True, "mechsearch_jax/planner/two.py"),
        (True, "mechsearch_jax.envs/one.py"),
        (True, "mechsearch_jax/perception/far/one.py"),
        (True, "mechsearch_jax/networks/network.npz"),
    ):
        (tmp_path / change).write_text("changed")
        after = present_code.__wrapped__()
        assert (after != before) == decides, change
        before = after


def test_a_method_that_cannot_be_used_is_refused_before_any_episode(tmp_path, files):
    for method, message in (
        (Method("guess"), 'policy "guess" is unknown'),
        (Method("nobody.there:Mine"), "nobody"),
        (Method(recognition="fog"), 'recognition "fog" is unknown'),
    ):
        with pytest.raises(InputError, match=message):
            make_jobs(files[:1], [Method(), method], (0,))


@pytest.mark.parametrize("name", ["rows", "rows.parquet"])
def test_a_file_is_no_place_for_results(tmp_path, files, name):
    (tmp_path / "rows").write_text("mine")
    with pytest.raises(InputError, match="results are kept in a folder"):
        evaluate(make_jobs(files[:1], [Method()], (0,)), tmp_path / name, one_by_one)
    assert (tmp_path / "rows").read_text() == "mine"
    assert not (tmp_path / "rows.parquet").exists()


def test_errors_are_run_again_where_the_option_says_so(tmp_path, files):
    out, jobs = tmp_path / "rows", make_jobs(files, [Method()], (0,))
    before = evaluate(jobs, out, one_by_one)
    (tmp_path / "log").write_text("")
    assert evaluate(jobs, out, one_by_one) == before
    assert ran(tmp_path) == []
    again = evaluate(jobs, out, one_by_one, retry_errors=True)
    assert ran(tmp_path) == ["raise"]
    assert [row.failure for row in again] == [row.failure for row in before]

    def mended(jobs, ended, begin):
        ended([dataclasses.replace(before[0], scenario=job.scenario.name) for job in jobs if begin(job)])

    # One that succeeds takes the place of the error.
    assert [row.failure for row in evaluate(jobs, out, mended, retry_errors=True)] == [None] * 4
    assert len(read_rows(out)) == 4


def test_shards_share_all_episodes_evenly(tmp_path, files):
    jobs = make_jobs(files, [Method()], range(5))
    shards = [shard_of(jobs, k, 3) for k in (1, 2, 3)]
    assert sorted(map(len, shards)) == [6, 7, 7]
    assert sorted(job.key for shard in shards for job in shard) == sorted(job.key for job in jobs)
    backwards = shard_of(jobs[::-1], 2, 3)
    assert {job.key for job in backwards} == {job.key for job in shards[1]}
    assert shard_of(jobs, 1, 1) == jobs
    with pytest.raises(InputError, match="shard 4/3"):
        shard_of(jobs, 4, 3)
    # Apart from each other, they come to what one run would have.
    for k, shard in enumerate(shards):
        rows = evaluate(shard, tmp_path / str(k), one_by_one)
        assert [episode_key(row) for row in rows] == [job.key for job in shard]
    assert len(ran(tmp_path)) == 20


def test_what_ends_elsewhere_meanwhile_is_not_run(tmp_path, files):
    out, jobs = tmp_path / "rows", make_jobs(files[:2], [Method()], (0, 1))
    counts = []

    def runner(missing, ended, begin):
        counts.append(len(missing))
        if len(counts) == 1:
            # Another process takes two of them, and ends both.
            evaluate([jobs[0], jobs[2]], out, one_by_one)
        one_by_one(missing, ended, begin)

    rows = evaluate(jobs, out, runner)
    assert [episode_key(row) for row in rows] == [job.key for job in jobs]
    assert ran(tmp_path) == ["one", "one", "two", "two"]
    assert len(read_rows(out)) == 4
    assert list((out / OPEN).glob("*.*")) == list((out / OPEN / "claims").iterdir()) == []


def test_a_runner_that_loses_an_episode_raises(tmp_path, files):
    def runner(missing, ended, begin):
        assert all(begin(job) for job in missing)
        ended([dataclasses.replace(missing[0].failed("of something else"), seed=7)])

    with pytest.raises(RuntimeError, match="the episode of one ended without a row of its own"):
        evaluate(make_jobs(files[:1], [Method()], (0,)), tmp_path / "rows", runner)


@pytest.mark.slow
def test_a_policy_of_another_module_reaches_the_worker(tmp_path, files, monkeypatch):
    source = (
        "import os",
        "def Mine(config, **push_models):",
        "    if 'PJRT_NPROC' in os.environ:",
        "        raise RuntimeError(f'gamma {config.gamma} arrived')",
        "    return print",
    )
    (tmp_path / "their_lab.py").write_text("\n".join(source))
    monkeypatch.delenv("PJRT_NPROC", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    method = Method("their_lab:Mine", standard(gamma=0.25))
    (row,) = evaluate(make_jobs(files[:1], [method], (0,)), tmp_path / "rows", Processes(1))
    assert (row.policy, row.gamma) == ("their_lab:Mine", 0.25)
    assert row.failure == "error: RuntimeError: gamma 0.25 arrived"


@pytest.mark.slow
@pytest.mark.always
def test_workers_that_die_hang_or_fail_cost_one_row_each(tmp_path, files):
    for name in ("crash", "exit", "hang"):
        save_scenario(Scenario(name, (), TARGET), tmp_path / f"{name}.json")
    names = ("one", "crash", "exit", "hang", "raise", "three")
    jobs = make_jobs([tmp_path / f"{name}.json" for name in names], [Method()], (0,))
    rows = evaluate(jobs, tmp_path / "rows", Processes(1, 1.5, run))
    assert {row.scenario: row.failure for row in rows} == {
        "one": None,
        "crash": "error: the worker process ended with status 3: out of luck",
        "exit": "error: SystemExit: enough",
        "hang": "error: it took longer than 1.5 s, and its worker was killed",
        "raise": "error: ValueError: no",
        "three": None,
    }
    assert ran(tmp_path) == sorted(names)


def broken(job):
    """No worker has this: it is no function of a module that they find."""


@pytest.mark.slow
@pytest.mark.always
def test_workers_that_cannot_be_started_end_the_run(tmp_path, files, monkeypatch):
    broken.__module__ = "nobody.there"
    monkeypatch.setitem(sys.modules, "nobody", types.ModuleType("nobody"))
    monkeypatch.setitem(sys.modules, "nobody.there", types.SimpleNamespace(broken=broken))
    with pytest.raises(InputError, match=r"worker processes end while they start: ModuleNotFoundError: .*nobody"):
        evaluate(make_jobs(files[:2], [Method()], (0,)), tmp_path / "rows", Processes(1, run=broken))
    assert read_rows(tmp_path / "rows") == []


@pytest.mark.slow
@pytest.mark.always
@pytest.mark.parametrize("how", ["an interrupt", "a kill"])
def test_workers_end_with_the_run_whatever_they_are_doing(tmp_path, files, how):
    save_scenario(Scenario("hang", (), TARGET), tmp_path / "hang.json")
    # Whoever starts the tests in the background has interrupts ignored, also by what they start.
    program = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from scripted import run; from mechsearch_jax.benchmarks.running.evaluate import *; "
        "from mechsearch_jax.benchmarks.running.processes import Processes; "
        "evaluate(make_jobs([sys.argv[1]], [Method()], (0,)), sys.argv[2], Processes(1, run=run))"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "hang.json"), str(tmp_path / "rows")]
    with subprocess.Popen(command, cwd=Path(__file__).parent, stderr=subprocess.DEVNULL) as process:
        while not (tmp_path / "log").exists() or not (tmp_path / "log").read_text().endswith("\n"):
            time.sleep(0.1)
        process.send_signal(signal.SIGINT if how == "an interrupt" else signal.SIGKILL)
    worker = int((tmp_path / "log").read_text().split()[1])
    assert is_gone(worker)
    assert read_rows(tmp_path / "rows") == []


def test_progress_and_rates_are_shown(tmp_path, files):
    screen = io.StringIO()
    console = Console(file=screen, width=100)
    with console_tables.EpisodeProgress(console, 3) as progress:
        jobs = make_jobs(files[:3], [Method()], (0,))
        rows = evaluate(jobs, tmp_path / "rows", one_by_one, ended=progress.ended)
    console.print(summary_table(summarise(rows), Key.of(rows)))
    text = screen.getvalue()
    assert "3/3 raise: the program failed after 0 actions: ValueError: no" in text
    everything = next(line for line in text.splitlines() if " all " in line)
    assert everything.split()[:6] == ["search-for-grasp", "all", "3", "0.67", "0.67", "0.00"]
