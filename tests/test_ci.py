"""What checks a change: the gate has its reference, and files name the same version."""

import importlib.util
import re
import shlex
from pathlib import Path

from mechsearch_jax.benchmarks.guard import guard
from mechsearch_jax.commands import main as cli

ROOT = Path(__file__).parents[1]


def test_the_gate_has_a_reference_for_each_of_its_episodes():
    (line,) = re.findall(r'^step "mechsearch (bench guard .*)"$', (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    arguments = shlex.split(line)
    assert callable(cli.parse(arguments))
    scenes, reference = (arguments[arguments.index(name) + 1] for name in ("--scenes", "--reference"))
    outcomes = guard.read_reference(ROOT / reference).outcomes
    scene_names = [block.scene_name(index) for block, index in guard.suite(int(scenes))]
    assert [outcome.scenario for outcome in outcomes] == scene_names
    assert [comparison.measure for comparison in guard.compare(outcomes, outcomes)] == list(guard.MEASURES)


def test_the_files_of_this_checkout_name_the_same_version():
    spec = importlib.util.spec_from_file_location("version", ROOT / ".ci" / "version.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.check(ROOT)
