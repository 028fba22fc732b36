"""Many episodes: rows as they end, none missing or double, whatever is killed; and failures that are rows."""

import dataclasses
import io
import json
import subprocess
import sys

import pytest
from rich.console import Console

from mechsearch_jax.benchmarks.report import tables
from mechsearch_jax.benchmarks.report.episode_tables import rates_table
from mechsearch_jax.benchmarks.running import evaluate as benchmark
from mechsearch_jax.benchmarks.running.evaluate import evaluate, make_jobs, present_code, shard_of
from mechsearch_jax.benchmarks.running.processes import Processes
from mechsearch_jax.benchmarks.statistics.rates import summarise
from mechsearch_jax.benchmarks.store.rows import episode_key, identity
from mechsearch_jax.benchmarks.store.shards import OPEN, Results, ShardWriter
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.planner import OPTIONS, PRESETS
from mechsearch_jax.runtime import versions
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Body, Scenario, save_scenario

standard = PRESETS["standard"]
TARGET = Body("cylinder", (0.02, 0.02, 0.05), (0.62, 0.07, 0.4545), (1.0, 0.0, 0.0, 0.0))

# Stands in for the real worker: says what a scenario's name asks for.
FAKE = """
import json, os, pathlib, sys, time

def settings(config, path=""):
    for name, value in config.items():
        yield from settings(value, path + name + ".") if isinstance(value, dict) else [(path + name, value)]

names = json.loads(os.environ["OPTIONS"])
for line in sys.stdin:
    job = json.loads(line)
    name = json.loads(pathlib.Path(job["path"]).read_text())["name"]
    with open(os.environ["LOG"], "a") as log:
        log.write(name + "\\n")
    if name == "hang":
        time.sleep(600)
    if name == "crash":
        print("out of luck", file=sys.stderr, flush=True)
        os._exit(3)
    method = job["method"]
    options = {names[path]: value for path, value in settings(method["config"]) if path in names}
    options.update(policy=method["name"], recognition="oracle", simulator="NativeSimulator")
    columns = ("policy", "recognition", "gamma", "horizon", "sequences")
    row = dict({column: options[column] for column in columns}, actions="+".join(options["actions"]), scenario=name,
               objects=0, target="cylinder", seed=job["seed"], found_step=1, graspable_step=2, retrieved=True, steps=3,
               failure=None, planning_seconds=1.0, simulation_seconds=0.5, content_hash=os.environ["CONTENT"],
               code=os.environ["CODE"])
    row["configuration"] = json.dumps(options, sort_keys=True)
    if name == "confused":
        row["gamma"] = 0.123
    print(json.dumps({"error": "ValueError: no"} if name == "raise" else {"row": row}), flush=True)
"""


@pytest.fixture
def files(tmp_path):
    names = ("one", "two", "crash", "raise", "three")
    for name in names:
        save_scenario(Scenario(name, (), TARGET), tmp_path / f"{name}.json")
    return [tmp_path / f"{name}.json" for name in names]


@pytest.fixture
def command(tmp_path, monkeypatch):
    monkeypatch.setenv("LOG", str(tmp_path / "log"))
    monkeypatch.setenv("CODE", present_code())
    monkeypatch.setenv("CONTENT", Scenario("any", (), TARGET).content_hash)
    monkeypatch.setenv("OPTIONS", json.dumps({".".join(option.path): option.name for option in OPTIONS}))
    return (sys.executable, "-c", FAKE)


def read_rows(folder):
    results = Results(folder)
    results.refresh()
    return list(results.rows.values())


def ran(tmp_path):
    return sorted((tmp_path / "log").read_text().split())


def test_all_combinations_become_rows(tmp_path, files, command):
    jobs = make_jobs([files[0], files[1]], [Method(), Method("search-and-grasp")], (0, 1))
    rows = evaluate(jobs, tmp_path / "rows", Processes(2, command=command))
    assert len(rows) == len({identity(row) for row in rows}) == 8
    assert sorted(map(identity, read_rows(tmp_path / "rows"))) == sorted(map(identity, rows))


def test_failures_are_rows_with_their_reason_and_do_not_end_the_run(tmp_path, files, command):
    rows = evaluate(make_jobs(files, [Method()], (0,)), tmp_path / "rows", Processes(1, command=command))
    reasons = {row.scenario: row.failure for row in rows}
    assert reasons == {
        "one": None,
        "two": None,
        "crash": "error: the worker process ended with status 3: out of luck",
        "raise": "error: ValueError: no",
        "three": None,
    }


def test_a_stopped_run_goes_on_where_it_was(tmp_path, files, command):
    out = tmp_path / "rows"
    jobs = make_jobs(files, [Method()], (0,))

    def stop(row, tally):
        if tally.ended == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(jobs, out, Processes(1, command=command), ended=stop)
    first = read_rows(out)
    assert len(first) == 2
    rows = evaluate(jobs, out, Processes(1, command=command))
    assert [row.scenario for row in rows] == ["one", "two", "crash", "raise", "three"]
    assert [row for row in read_rows(out) if row in first] == first
    (tmp_path / "log").write_text("")
    assert evaluate(jobs, out, Processes(1, command=command)) == rows
    assert ran(tmp_path) == []


def test_rows_of_other_options_stay(tmp_path, files, command):
    out = tmp_path / "rows"
    for gamma in (0.9, 0.5):
        rows = evaluate(
            make_jobs(files[:1], [Method(config=standard(gamma=gamma))], (0,)), out, Processes(1, command=command)
        )
        assert [row.gamma for row in rows] == [gamma]
    assert sorted(row.gamma for row in read_rows(out)) == [0.5, 0.9]


@pytest.mark.parametrize(
    "other",
    [
        {"criterion": "depth-mse"},
        {"max_steps": 5},
        {"unseen_contact_penalty": 0.5},
        {"push_distances": (0.1,)},
        {"push_model": "physics"},
        {"crowding_weight": 0.5},
    ],
    ids=lambda other: next(iter(other)),
)
def test_every_option_tells_rows_apart(tmp_path, files, command, other):
    out = tmp_path / "rows"
    for method in (Method(), Method(config=standard(**other)), Method()):
        rows = evaluate(make_jobs(files[:1], [method], (0,)), out, Processes(1, command=command))
        assert len(rows) == 1
    assert ran(tmp_path) == ["one", "one"]
    both = read_rows(out)
    assert len(both) == 2
    assert len({identity(row) for row in both}) == 2
    assert [rates.episodes for rates in summarise(both)] == [1] * 4


def test_an_edited_file_of_the_same_name_gets_rows_of_its_own(tmp_path, files, command, monkeypatch):
    out = tmp_path / "rows"
    first = evaluate(make_jobs(files[:2], [Method()], (0,)), out, Processes(1, command=command))
    edited = Scenario("one", (), dataclasses.replace(TARGET, position=(0.62, 0.08, 0.4545)))
    save_scenario(edited, files[0])
    monkeypatch.setenv("CONTENT", edited.content_hash)
    (row, other) = evaluate(make_jobs(files[:2], [Method()], (0,)), out, Processes(1, command=command))
    assert ran(tmp_path) == ["one", "one", "two"]
    assert (row.scenario, row.failure, row.content_hash) == ("one", None, edited.content_hash)
    assert other == first[1]
    assert sorted(read_rows(out), key=identity) == sorted([*first, row], key=identity)
    # As it was before, it has its rows still; and how a file is written does not matter.
    save_scenario(Scenario("one", (), TARGET), files[0])
    files[1].write_text(json.dumps(json.loads(files[1].read_text())))
    assert evaluate(make_jobs(files[:2], [Method()], (0,)), out, Processes(1, command=command)) == first
    assert ran(tmp_path) == ["one", "one", "two"]


def test_a_file_that_changes_while_it_waits_is_a_failure(tmp_path, files, command, monkeypatch):
    monkeypatch.setenv("CONTENT", "another")
    (row,) = evaluate(make_jobs(files[:1], [Method()], (0,)), tmp_path / "rows", Processes(1, command=command))
    assert row.failure == "error: the worker ran another episode than was asked for: other options, or a changed file"


def test_rows_of_other_code_are_not_added_to(tmp_path, files, command, monkeypatch):
    out = tmp_path / "rows"
    (row,) = evaluate(make_jobs(files[:1], [Method()], (0,)), out, Processes(1, command=command))
    assert row.code == present_code()
    before = {path.name for path in out.iterdir()}
    monkeypatch.setattr(benchmark, "present_code", lambda: "mechsearch-jax 9.9 (abc)")
    with pytest.raises(InputError, match=r"rows: .* run by mechsearch-jax 0.* is mechsearch-jax 9.9 \(abc\);"):
        evaluate(make_jobs(files[:2], [Method()], (0,)), out, Processes(1, command=command))
    assert {path.name for path in out.iterdir()} == before
    assert ran(tmp_path) == ["one"]

    # Rows that do not say what ran them may be anything.
    with ShardWriter(tmp_path / "unknown", "me") as writer:
        writer.append([dataclasses.replace(row, code=None)])
    with pytest.raises(InputError, match="does not say which"):
        evaluate(make_jobs(files[:1], [Method()], (0,)), tmp_path / "unknown", Processes(1, command=command))


def test_a_worker_of_other_code_is_not_believed(tmp_path, files, command, monkeypatch):
    monkeypatch.setenv("CODE", "mechsearch-jax 9.9 (abc)")
    (row,) = evaluate(make_jobs(files[:1], [Method()], (0,)), tmp_path / "rows", Processes(1, command=command))
    assert row.failure == "error: the worker ran other code: mechsearch-jax 9.9 (abc)"


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


def test_a_worker_that_cannot_be_started_makes_rows_too(tmp_path, files):
    jobs = make_jobs(files[:2], [Method()], (0,))
    rows = evaluate(jobs, tmp_path / "rows", Processes(1, command=(str(tmp_path / "nothing"),)))
    assert all("FileNotFoundError" in str(row.failure) for row in rows)


def test_a_worker_that_ran_something_else_is_not_believed(tmp_path, command):
    save_scenario(Scenario("confused", (), TARGET), tmp_path / "confused.json")
    jobs = make_jobs([tmp_path / "confused.json"], [Method()], (0,))
    (row,) = evaluate(jobs, tmp_path / "rows", Processes(1, command=command))
    assert row.failure == "error: the worker ran another episode than was asked for: other options, or a changed file"


def test_a_method_that_cannot_be_used_is_told_of_before_any_episode(tmp_path, files):
    for method, message in (
        (Method("guess"), 'policy "guess" is unknown'),
        (Method("nobody.there:Mine"), "nobody"),
        (Method(recognition="fog"), 'recognition "fog" is unknown'),
    ):
        with pytest.raises(InputError, match=message):
            make_jobs(files[:1], [Method(), method], (0,))


@pytest.mark.parametrize("name", ["rows", "rows.parquet"])
def test_a_file_is_no_place_for_results(tmp_path, files, command, name):
    (tmp_path / "rows").write_text("mine")
    with pytest.raises(InputError, match="results are kept in a folder"):
        evaluate(make_jobs(files[:1], [Method()], (0,)), tmp_path / name, Processes(1, command=command))
    assert (tmp_path / "rows").read_text() == "mine"
    assert not (tmp_path / "rows.parquet").exists()


def test_an_episode_that_hangs_is_a_row_and_its_worker_is_replaced(tmp_path, files, command):
    save_scenario(Scenario("hang", (), TARGET), tmp_path / "hang.json")
    jobs = make_jobs([tmp_path / "hang.json", *files[:2]], [Method()], (0,))
    rows = evaluate(jobs, tmp_path / "rows", Processes(1, 1.5, command))
    assert [row.failure for row in rows] == [
        "error: it took longer than 1.5 s, and its worker was killed", None, None,
    ]  # fmt: skip


def test_errors_are_run_again_if_asked_for(tmp_path, files, command):
    out, jobs = tmp_path / "rows", make_jobs(files, [Method()], (0,))
    before = evaluate(jobs, out, Processes(1, command=command))
    (tmp_path / "log").write_text("")
    assert evaluate(jobs, out, Processes(1, command=command)) == before
    assert ran(tmp_path) == []
    again = evaluate(jobs, out, Processes(1, command=command), retry_errors=True)
    assert ran(tmp_path) == ["crash", "raise"]
    assert [row.failure for row in again] == [row.failure for row in before]
    # One that succeeds takes the place of the error.
    save_scenario(Scenario("crash", (), TARGET), files[2])
    command = (*command[:-1], command[-1].replace('"crash"', '"never"'))
    mended = evaluate(jobs, out, Processes(1, command=command), retry_errors=True)
    assert [row.failure for row in mended] == [None, None, None, "error: ValueError: no", None]
    assert len(read_rows(out)) == 5


def test_shards_share_all_episodes_evenly(tmp_path, files, command):
    jobs = make_jobs(files, [Method()], range(5))
    shards = [shard_of(jobs, k, 3) for k in (1, 2, 3)]
    assert sorted(map(len, shards)) == [8, 8, 9]
    assert sorted(job.key for shard in shards for job in shard) == sorted(job.key for job in jobs)
    backwards = shard_of(jobs[::-1], 2, 3)
    assert {job.key for job in backwards} == {job.key for job in shards[1]}
    assert shard_of(jobs, 1, 1) == jobs
    with pytest.raises(InputError, match="shard 4/3"):
        shard_of(jobs, 4, 3)
    # Apart from each other, they come to what one run would have.
    for k, shard in enumerate(shards):
        rows = evaluate(shard, tmp_path / str(k), Processes(2, command=command))
        assert [episode_key(row) for row in rows] == [job.key for job in shard]
    assert len(ran(tmp_path)) == 25


def test_what_ends_elsewhere_meanwhile_is_not_run(tmp_path, files, command):
    out, jobs = tmp_path / "rows", make_jobs(files[:2], [Method()], (0, 1))
    inner, told = Processes(1, command=command), []

    def runner(missing, ended, begin):
        told.append(len(missing))
        if len(told) == 1:
            # Another process takes two of them, and ends both.
            evaluate([jobs[0], jobs[2]], out, inner)
        inner(missing, ended, begin)

    rows = evaluate(jobs, out, runner)
    assert [episode_key(row) for row in rows] == [job.key for job in jobs]
    assert ran(tmp_path) == ["one", "one", "two", "two"]
    assert len(read_rows(out)) == 4
    assert list((out / OPEN).glob("*.*")) == list((out / OPEN / "claims").iterdir()) == []


def test_a_runner_that_loses_an_episode_is_told_of(tmp_path, files):
    def runner(missing, ended, begin):
        assert all(begin(job) for job in missing)
        ended([dataclasses.replace(missing[0].failed("of something else"), seed=7)])

    with pytest.raises(RuntimeError, match="the episode of one ended without a row of its own"):
        evaluate(make_jobs(files[:1], [Method()], (0,)), tmp_path / "rows", runner)


def test_progress_and_rates_are_shown(tmp_path, files, command):
    screen = io.StringIO()
    console = Console(file=screen, width=100)
    with tables.EpisodeProgress(console, 3) as progress:
        jobs = make_jobs([files[0], files[1], files[3]], [Method()], (0,))
        rows = evaluate(jobs, tmp_path / "rows", Processes(1, command=command), ended=progress.ended)
    console.print(rates_table(rows))
    text = screen.getvalue()
    assert "3/3 raise: error: ValueError: no" in text
    everything = next(line for line in text.splitlines() if " all " in line)
    assert everything.split()[:6] == ["search-for-grasp", "all", "3", "0.67", "0.67", "0.00"]


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


def test_a_worker_ends_with_its_input_whatever_it_is_doing():
    program = (
        "import sys, time; from mechsearch_jax.benchmarks.running.worker import until_closed; "
        "next(until_closed(sys.stdin)); print('busy', flush=True); time.sleep(100)"
    )
    pipe, command = subprocess.PIPE, [sys.executable, "-c", program]
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        process.stdin.write("a job\n")
        process.stdin.flush()
        assert process.stdout.readline() == "busy\n"
        process.stdin.close()
        assert process.wait(60) == 0
