"""The share of the slow tests that a run takes: all shares together are all slow tests, no test is in two, and they
take about as long as each other."""

import ast
import json
import re
import subprocess
import sys
import time
import types
from collections import defaultdict
from pathlib import Path

import conftest
import pytest
import shares

ROOT = Path(__file__).parents[1]


class Item:
    """Stands in for a collected test."""

    def __init__(self, nodeid, slow):
        self.nodeid, self.path, self.slow = nodeid, nodeid.split("::")[0], slow

    def get_closest_marker(self, name):
        return self.slow if name == "slow" and self.slow else None


class Config:
    """Stands in for pytest's configuration."""

    def __init__(self, share):
        self.option = types.SimpleNamespace(slow_share=share)
        self.left_out = []
        self.hook = types.SimpleNamespace(pytest_deselected=lambda items: self.left_out.extend(items))

    def getoption(self, name):
        return getattr(self.option, name)


def collected():
    return [Item(f"tests/test_{i % 5}.py::test_{i}[{i}]", i % 3 == 0) for i in range(120)]


def selected(share):
    config, items = Config(share), collected()
    conftest.pytest_configure(config)
    conftest.pytest_collection_modifyitems(config, items)
    assert sorted(item.nodeid for item in items + config.left_out) == sorted(item.nodeid for item in collected())
    return items


@pytest.mark.parametrize("parts", [1, 3, 8])
def test_every_slow_test_is_in_one_part(parts):
    every = sorted(item.nodeid for item in collected() if item.slow)
    each = [[i.nodeid for i in selected(f"{k}/{parts}") if i.slow] for k in range(1, parts + 1)]
    assert sorted(nodeid for part in each for nodeid in part) == every


def names(file, count):
    return [f"tests/{file}.py::test_{i}" for i in range(count)]


def loads(part_of, parts, seconds):
    return [sum(shares.seconds_of(n, seconds) for n, p in part_of.items() if p == k) for k in range(1, parts + 1)]


def test_parts_take_as_long_as_each_other():
    seconds = {file: {f"test_{i}": 3.0 + i**2 % 11 for i in range(9)} for file in ("a", "b", "c")}
    nodeids = [nodeid for file in "abcd" for nodeid in names(file, 9)]
    part_of = shares.part_of_each(nodeids, 4, seconds)
    heaviest = max(total for _, total in shares.bundles(nodeids, 4, seconds))
    total = loads(part_of, 4, seconds)
    assert max(total) - min(total) <= heaviest <= sum(total) / 8
    # One that was not measured counts as others do.
    assert sum(total) == pytest.approx(sum(sum(of.values()) for of in seconds.values()) + 9 * shares.UNKNOWN)


def test_what_shares_programs_stays_together_unless_it_takes_too_long():
    seconds = {"short": {f"test_{i}": 2.0 for i in range(8)}, "long": {f"test_{i}": 20.0 for i in range(8)}}
    part_of = shares.part_of_each(names("short", 8) + names("long", 8), 2, seconds)
    assert len({part_of[nodeid] for nodeid in names("short", 8)}) == 1
    assert {part_of[nodeid] for nodeid in names("long", 8)} == {1, 2}


def test_what_takes_longest_comes_first_in_a_part():
    every = [item.path for item in selected("2/3")]
    first = dict.fromkeys(every)
    assert sorted(first, key=lambda path: -every.count(path)) == list(first)


def test_what_was_measured_is_a_slow_test():
    for file, tests in shares.measured().items():
        tree = ast.parse((ROOT / "tests" / f"{file}.py").read_text())
        defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        assert {name.partition("[")[0] for name in tests} <= defined, file


def test_reports_are_added_to_what_was_measured(tmp_path):
    path, report = tmp_path / "seconds.json", tmp_path / "slow.xml"
    path.write_text('{"test_a": {"test_old": 1.0, "test_one[2]": 2.0}}')
    cases = (
        '<testcase classname="tests.test_a" name="test_one[2]" time="9.04"/>'
        '<testcase classname="test_b" name="test_x" time="0.2"/>'
    )
    report.write_text(f"<testsuites><testsuite>{cases}</testsuite></testsuites>")
    shares.write([report], path)
    assert json.loads(path.read_text()) == {"test_a": {"test_old": 1.0, "test_one[2]": 9.0}, "test_b": {"test_x": 0.2}}


def test_other_tests_are_in_every_part(monkeypatch):
    others = {item.nodeid for item in collected() if not item.slow}
    monkeypatch.setattr(conftest, "commit", lambda: "0f")
    for share in (None, "1/3", "2/3", "auto/3"):
        assert {item.nodeid for item in selected(share) if not item.slow} == others


def git(folder, *arguments):
    identity = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
    ran = subprocess.run(["git", *identity, *arguments], cwd=folder, capture_output=True, text=True, check=True)
    return ran.stdout.strip()


def test_the_same_commit_has_the_same_part_and_other_commits_have_others(tmp_path, monkeypatch):
    git(tmp_path, "init", "--quiet")
    parts = {}
    for i in range(12):
        git(tmp_path, "commit", "--quiet", "--allow-empty", "-m", f"number {i}")
        head = git(tmp_path, "rev-parse", "HEAD")
        assert conftest.commit(tmp_path) == head
        monkeypatch.setattr(conftest, "commit", lambda head=head: head)
        # On whatever day.
        for day in (20000, 20001):
            monkeypatch.setattr(time, "time", lambda day=day: 86400.0 * day + 5)
            config = Config("auto/4")
            conftest.pytest_configure(config)
            parts.setdefault(head, set()).add(config.option.slow_share)
        monkeypatch.undo()
    assert {len(chosen) for chosen in parts.values()} == {1}
    # All twelve in one of four parts has a chance of one in four million.
    assert len(set.union(*parts.values())) > 1


def test_where_there_is_no_commit_that_is_said(tmp_path, monkeypatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    with pytest.raises(pytest.UsageError, match=r"tells no commit to choose a part by \(fatal: not a git .*give K/N"):
        conftest.commit(tmp_path)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(pytest.UsageError, match=r"\(there is no git\); give K/N"):
        conftest.commit(tmp_path)


@pytest.mark.parametrize("wrong", ["", "3", "0/4", "5/4", "auto/0", "auto", "1/many", "-1/4"])
def test_a_part_that_there_is_none_of_is_refused(wrong):
    with pytest.raises(pytest.UsageError, match="K/N"):
        conftest.share_of(wrong)


def test_what_drops_what_was_traced_comes_first_and_then_what_takes_longest():
    names = ("test_viz", "test_readme", "test_planner", "test_program_budget")
    items = [Item(f"tests/{name}.py::test", False) for name in names]
    conftest.pytest_collection_modifyitems(Config(None), items)
    assert [item.path for item in items] == [f"tests/{name}.py" for name in reversed(names)]


@pytest.mark.slow
def test_files_that_are_traced_together_run_in_one_process():
    """As pytest does it: the workers that it names are the same for all files of a group."""
    quick = "options_are_changed or papers_preset or fits_a_few or two_commands or upright or backing_off"
    files = ["test_planner", "test_readme", "test_geometry_transforms"]
    command = ["-m", "pytest", "-vv", "-p", "no:cacheprovider", *(f"tests/{name}.py" for name in files), "-k", quick]
    ran = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=True)
    workers = defaultdict(set)
    for worker, file in re.findall(r"^\[(gw\d)\].* PASSED tests/(\w+)\.py", ran.stdout, re.MULTILINE):
        workers[file].add(worker)
    assert workers["test_planner"] == workers["test_readme"]
    assert {len(w) for w in workers.values()} == {1}
    assert workers["test_geometry_transforms"] != workers["test_planner"]
