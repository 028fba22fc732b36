"""The share of the slow tests that a run takes: all shares together are all slow tests, and no test is in two."""

import ast
import types
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


def test_what_was_measured_is_a_slow_test():
    for file, tests in shares.measured().items():
        tree = ast.parse((ROOT / "tests" / f"{file}.py").read_text())
        defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        assert {name.partition("[")[0] for name in tests} <= defined, file


def test_other_tests_are_in_every_part(monkeypatch):
    others = {item.nodeid for item in collected() if not item.slow}
    monkeypatch.setattr(conftest, "commit", lambda: "0f")
    for share in (None, "1/3", "2/3", "auto/3"):
        assert {item.nodeid for item in selected(share) if not item.slow} == others
