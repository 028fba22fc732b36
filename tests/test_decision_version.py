"""A change of what is decided by default has a number of its own."""

import importlib.util
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
