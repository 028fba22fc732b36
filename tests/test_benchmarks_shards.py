"""Results as a folder: whoever adds to it and whatever is killed, each episode counts once and none is missing."""

import dataclasses
import errno
import json
import os
import subprocess
import sys
import time

import pyarrow.dataset
import pyarrow.parquet
import pytest

from mechsearch_jax.benchmarks.report.report import read_tables
from mechsearch_jax.benchmarks.store import claims as claiming
from mechsearch_jax.benchmarks.store.claims import CLAIMS, Claims
from mechsearch_jax.benchmarks.store.rows import (
    EpisodeRow,
    configuration,
    episode_key,
    write_rows,
)
from mechsearch_jax.benchmarks.store.shards import OPEN, Results, ShardWriter, close_shards_of
from mechsearch_jax.runtime.errors import InputError

ROW = EpisodeRow(
    "a", 2, "cylinder", "search-for-grasp", "oracle", 0.9, 3, 30, "push", 0, 1, 2, True, 3, None, 1.5, 0.6,
    configuration({"gamma": 0.9}), "00", code="this",
)  # fmt: skip
ROWS = [dataclasses.replace(ROW, seed=seed) for seed in range(10)]


def read(folder):
    results = Results(folder)
    results.refresh()
    return sorted(results.rows.values(), key=lambda row: row.seed)


def follow(results):
    return [results.rows[key] for key in results.refresh()]


def open_shards(folder):
    return sorted(path.name for path in (folder / OPEN).glob("*.jsonl"))


def test_rows_are_there_as_soon_as_they_are_added_and_shards_close_when_they_are_full(tmp_path):
    follower = Results(tmp_path)
    with ShardWriter(tmp_path, "me", rows_per_shard=4) as writer:
        for count, row in enumerate(ROWS, start=1):
            writer.append([row])
            assert read(tmp_path) == ROWS[:count]
            assert follow(follower) == [row]
        assert open_shards(tmp_path) == ["shard-me-00002.jsonl"]
    assert follower.refresh() == []
    assert open_shards(tmp_path) == []
    assert sorted(path.name for path in tmp_path.glob("*.parquet")) == [f"shard-me-{i:05d}.parquet" for i in range(3)]
    # Any reader of Parquet can do with it.
    assert pyarrow.dataset.dataset(tmp_path).to_table().column("seed").to_pylist() == list(range(10))


def test_a_line_that_a_kill_cut_short_does_not_count(tmp_path):
    writer = ShardWriter(tmp_path, "killed")
    writer.append(ROWS[:3])
    (name,) = open_shards(tmp_path)
    whole = (tmp_path / OPEN / name).read_bytes()
    (tmp_path / OPEN / name).write_bytes(whole[:-9])
    follower = Results(tmp_path)
    follower.refresh()
    assert read(tmp_path) == list(follower.rows.values()) == ROWS[:2]
    (tmp_path / OPEN / name).write_bytes(whole)
    assert follow(follower) == ROWS[2:3]
    (tmp_path / OPEN / name).write_bytes(b"nonsense\n" + whole)
    with pytest.raises(InputError, match=r"killed-00000\.jsonl: holds a line that is no row"):
        read(tmp_path)


def test_a_shard_that_was_left_open_is_closed_later(tmp_path):
    ShardWriter(tmp_path, "killed").append(ROWS[:3])
    follower = Results(tmp_path)
    assert follow(follower) == ROWS[:3]
    close_shards_of(tmp_path, "kil")
    assert len(open_shards(tmp_path)) == 1
    close_shards_of(tmp_path, "killed")
    assert open_shards(tmp_path) == []
    assert follower.refresh() == []
    assert read(tmp_path) == ROWS[:3]


def test_a_kill_between_closing_a_shard_and_removing_what_it_was_doubles_nothing(tmp_path):
    ShardWriter(tmp_path, "killed").append(ROWS[:3])
    (name,) = open_shards(tmp_path)
    write_rows(ROWS[:3], tmp_path / name.replace(".jsonl", ".parquet"))
    (tmp_path / ".shard-killed-00000.parquet.half").write_text("half")
    results = Results(tmp_path)
    assert follow(results) == ROWS[:3]
    assert set(results.attempts.values()) == {1}
    close_shards_of(tmp_path, "killed")
    assert open_shards(tmp_path) == []
    assert read(tmp_path) == ROWS[:3]


def test_who_is_taken_for_dead_loses_nothing(tmp_path):
    writer = ShardWriter(tmp_path, "sleeper")
    writer.append(ROWS[:3])
    close_shards_of(tmp_path, "sleeper")
    writer.append(ROWS[3:5])
    writer.close()
    assert read(tmp_path) == ROWS[:5]
    results = Results(tmp_path)
    assert len(results.refresh()) == 5


def test_of_several_rows_of_an_episode_one_counts_whatever_order_they_came_in(tmp_path):
    broken = dataclasses.replace(ROW, failure="error: no luck", retrieved=False)
    slower = dataclasses.replace(ROW, planning_seconds=9.0)
    rows = (("a", broken), ("b", slower), ("c", ROW))
    for name, order in (("one", rows), ("other", rows[::-1])):
        for writer, row in order:
            with ShardWriter(tmp_path / name, writer) as shards:
                shards.append([row])
        assert read(tmp_path / name) == [slower]
    with ShardWriter(tmp_path / "one", "d") as shards:
        shards.append([dataclasses.replace(ROW, code="other")])
    with pytest.raises(InputError, match=r"one: holds scenario 'a', seed 0, run .* by this and by other;"):
        read(tmp_path / "one")


def test_folders_of_folders_and_files_are_reported_together(tmp_path):
    for name, rows in (("first", ROWS[:3]), ("deep/second", ROWS[3:5])):
        with ShardWriter(tmp_path / "all" / name, "me") as writer:
            writer.append(rows)
    ShardWriter(tmp_path / "all" / "third", "running").append(ROWS[5:6])
    write_rows(ROWS[6:7], tmp_path / "all" / "old.parquet")
    write_rows(ROWS[7:8], tmp_path / "alone.parquet")
    rows = read_tables([tmp_path / "all", tmp_path / "alone.parquet"])
    assert sorted(row.seed for row in rows) == list(range(8))
    write_rows(ROWS[:1], tmp_path / "twice.parquet")
    with pytest.raises(InputError, match=r"twice\.parquet: holds scenario 'a', seed 0, .*one by one"):
        read_tables([tmp_path / "all", tmp_path / "twice.parquet"])


def full_disk(table, file, **options):
    file.write(b"half")
    raise OSError(errno.ENOSPC, "No space left on device")


def test_what_an_error_left_open_is_closed_by_who_comes_next(tmp_path, monkeypatch):
    with Claims(tmp_path) as claims:
        writer = ShardWriter(tmp_path, claims.owner)
        writer.append(ROWS[:3])
        monkeypatch.setattr(pyarrow.parquet, "write_table", full_disk)
        with pytest.raises(InputError, match=r"\.parquet: cannot be written \(No space left .*; the rows are kept in "):
            writer.close()
    # Nothing half is left, and nothing is lost.
    assert [path.name for path in tmp_path.iterdir()] == [OPEN]
    assert read(tmp_path) == ROWS[:3]
    monkeypatch.undo()
    with Claims(tmp_path) as claims, ShardWriter(tmp_path, claims.owner) as writer:
        # Of one that is at work, nothing is touched.
        with Claims(tmp_path) as other, ShardWriter(tmp_path, other.owner) as others:
            others.append(ROWS[3:4])
            claims.close_what_is_left()
            assert len(open_shards(tmp_path)) == 1
        writer.append(ROWS[4:5])
    assert open_shards(tmp_path) == []
    assert sorted(pyarrow.dataset.dataset(tmp_path).to_table().column("seed").to_pylist()) == list(range(5))
    assert read(tmp_path) == ROWS[:5]


def test_what_was_open_as_its_machine_went_down_is_closed_once_it_is_old(tmp_path, monkeypatch):
    with monkeypatch.context() as before:
        before.setattr(claiming, "_machine", lambda: "this machine, before")
        gone = Claims(tmp_path)
        ShardWriter(tmp_path, gone.owner).append(ROWS[:3])
    with Claims(tmp_path) as claims:
        claims.close_what_is_left()
        assert len(open_shards(tmp_path)) == 1
        ago = time.time() - 2 * claiming.OLD
        os.utime(tmp_path / OPEN / f"{gone.owner}.owner", (ago, ago))
        claims.close_what_is_left()
    assert open_shards(tmp_path) == []
    assert len(list(tmp_path.glob("*.parquet"))) == 1


def test_an_episode_is_taken_once(tmp_path):
    with Claims(tmp_path) as one, Claims(tmp_path) as other:
        assert one.take("e")
        assert not one.take("e")
        assert not other.take("e")
        assert not other.is_free("e")
        one.release("e")
        assert other.take("e")
        assert one.take("f")
    assert list((tmp_path / OPEN / CLAIMS).iterdir()) == []
    assert [path.name for path in (tmp_path / OPEN).iterdir()] == [CLAIMS]


def test_what_another_machine_took_is_free_once_it_has_been_silent(tmp_path, monkeypatch):
    with Claims(tmp_path, touched_every=0.02) as here, monkeypatch.context() as there:
        there.setattr(claiming, "_machine", lambda: "another machine")
        gone = Claims(tmp_path, silence=0.3)
        assert gone.take("e")
        assert here.take("f")
        there.undo()
        patient = Claims(tmp_path, silence=0.3)
        assert not patient.take("e")
        assert not gone.take("f")
        time.sleep(0.4)
        assert patient.take("e")
        # The other shows that it is there.
        assert not gone.take("f")
        # It wakes up, and does not give up what is no longer its own.
        gone.release("e")
        assert (tmp_path / OPEN / CLAIMS / "e").read_text() == patient.owner


# Several processes run the same jobs in one folder. They are killed at random and started again.
KILLED = """
import functools, os, random, signal, sys, time
from pathlib import Path
from mechsearch_jax.benchmarks.running import evaluate as benchmark
from mechsearch_jax.benchmarks.running.evaluate import Job, evaluate
from mechsearch_jax.benchmarks.store.shards import ShardWriter
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.workspace.scenario import Body, Scenario

out, log, kills = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
target = Body("cylinder", (0.02, 0.02, 0.05), (0.62, 0.07, 0.4545), (1.0, 0.0, 0.0, 0.0))
jobs = [Job("", Scenario(f"s{i}", (), target), Method(), seed) for i in range(20) for seed in range(8)]
[job.key for job in jobs]
benchmark.ShardWriter = functools.partial(ShardWriter, rows_per_shard=7)
benchmark.LOOK_EVERY = 0.01

def runner(jobs, ended, begin):
    together = []
    for job in random.sample(jobs, len(jobs)):
        if begin(job):
            with open(log, "a") as file:
                file.write(job.key + "\\n")
            time.sleep(random.uniform(0.0, 0.01))
            row = job.failed("")
            together.append(type(row)(**{**vars(row), "failure": None, "retrieved": True}))
        if len(together) > 2:
            ended(together)
            together = []
    ended(together)

def start():
    process = os.fork()
    if process:
        return process
    status = 1
    try:
        random.seed(os.getpid())
        rows = evaluate(jobs, out, runner)
        status = 0 if [row.scenario for row in rows] == [job.scenario.name for job in jobs] else 2
    finally:
        os._exit(status)

random.seed(int(sys.argv[4]))
running = {start() for _ in range(3)}
killed = 0
while running:
    if killed < kills:
        time.sleep(random.uniform(0.01, 0.08))
        process = random.choice(sorted(running))
        os.kill(process, signal.SIGKILL)
        killed += 1
    process, status = os.wait()
    running.remove(process)
    if status:
        assert os.WIFSIGNALED(status), status
        running.add(start())
"""


def run_and_kill(tmp_path, kills, seed):
    log = tmp_path / "log"
    arguments = (str(tmp_path / "rows"), str(log), str(kills), str(seed))
    ended = subprocess.run([sys.executable, "-W", "ignore", "-c", KILLED, *arguments], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    results = Results(tmp_path / "rows")
    every = results.refresh()
    assert len(results.rows) == 160
    assert len(every) == 160
    assert open_shards(tmp_path / "rows") == []
    assert list((tmp_path / "rows" / OPEN / CLAIMS).iterdir()) == []
    begun = log.read_text().split()
    assert set(begun) == set(results.rows)
    # Only what a kill cut off was run again: three at a time at most.
    assert len(begun) <= 160 + 3 * kills
    stored = pyarrow.dataset.dataset(tmp_path / "rows", exclude_invalid_files=False).to_table()
    assert sorted(stored.column("episode").to_pylist()) == sorted(results.rows)


@pytest.mark.slow
@pytest.mark.always
def test_nothing_is_missing_or_double_after_kills(tmp_path):
    run_and_kill(tmp_path, 8, 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_missing_or_double_after_many_kills(tmp_path, seed):
    run_and_kill(tmp_path, 40, seed + 1)


def test_a_key_is_the_same_for_the_same_episode():
    assert len({episode_key(row) for row in ROWS}) == 10
    assert episode_key(dataclasses.replace(ROW, steps=7, code="other")) == episode_key(ROW)
    spaced = dataclasses.replace(ROW, configuration=json.dumps(json.loads(ROW.configuration), indent=1))
    assert episode_key(spaced) == episode_key(ROW)


def test_an_unwritable_folder_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    for make in (Claims, lambda folder: ShardWriter(folder, "me")):
        with pytest.raises(InputError, match="cannot be written to"):
            make(tmp_path / "file" / "rows")
    with pytest.raises(InputError, match="cannot be written"):
        ShardWriter(tmp_path, f"me{os.sep}no").append(ROWS)
