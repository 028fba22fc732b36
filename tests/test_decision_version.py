"""A change of what is decided by default has a number of its own."""

import importlib.util
import json
from pathlib import Path

import pytest

from mechsearch_jax.runtime.versions import DECISION_VERSION

GOLDENS = Path(__file__).parent / "goldens"
HOW = "write the golden anew: python tests/goldens/decisions.py"


@pytest.fixture(scope="module")
def golden():
    spec = importlib.util.spec_from_file_location("decisions", GOLDENS / "decisions.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def check(golden, now):
    number, before = golden.kept()
    assert number == DECISION_VERSION, f"DECISION_VERSION is {DECISION_VERSION}, the golden's {number}: {HOW}"
    changed = list(golden.differences({name: before[name] for name in before.keys() & now.keys()}, now))
    assert not changed, f"decisions changed: raise DECISION_VERSION and {HOW}\n" + "\n".join(changed)


def test_decisions_from_true_shapes_are_those_of_their_version(golden, problem):
    check(golden, golden.from_true_shapes(problem))


@pytest.mark.slow
@pytest.mark.always
def test_decisions_from_images_are_those_of_their_version(golden, problem):
    check(golden, golden.from_images(problem))


def test_other_decisions_are_noticed_and_other_machines_are_not(golden):
    _, before = golden.kept()
    name, answer = next((name, answer) for name, answer in before.items() if answer["kind"] == "pick-and-place")

    def noticed(**changes):
        return len(list(golden.differences(before, {**before, name: {**answer, **changes}})))

    assert noticed() == 0
    assert noticed(**{"from": [x + 0.001 for x in answer["from"]]}, possible=answer["possible"] + 1) == 0
    assert noticed(kind="push") == 1
    assert noticed(object=answer["object"] + 1) == 1
    assert noticed(**{"from": [x + 0.01 for x in answer["from"]]}) == 1
    assert noticed(possible=2 * answer["possible"]) == 1


def test_the_golden_is_not_written_anew_under_its_old_number(golden, monkeypatch, tmp_path):
    import mechsearch_jax.problem.cache as cache

    _, before = golden.kept()
    other = {name: {**answer, "kind": "none"} for name, answer in before.items()}
    file = tmp_path / "decisions.json"
    file.write_text(json.dumps({"decision_version": DECISION_VERSION, "decisions": other}))
    monkeypatch.setattr(golden, "FILE", file)
    monkeypatch.setattr(golden, "from_true_shapes", lambda problem: before)
    monkeypatch.setattr(golden, "from_images", lambda problem: {})
    monkeypatch.setattr(cache, "cached_problem", lambda: None)
    monkeypatch.setattr(cache, "keep_compilations", lambda: None)
    with pytest.raises(SystemExit, match="decisions changed: raise DECISION_VERSION"):
        golden.main()
    assert golden.kept() == (DECISION_VERSION, other)
    file.write_text(json.dumps({"decision_version": DECISION_VERSION - 1, "decisions": other}))
    golden.main()
    assert golden.kept() == (DECISION_VERSION, before)
