"""What checks a change, and what a release: the gate has its reference; a stopped release goes on, and says what is
missing."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from mechsearch_jax.benchmarks.guard import guard
from mechsearch_jax.commands import main as cli

ROOT = Path(__file__).parents[1]
# Stands in for each Python: makes an environment of itself, and fails where its arguments hold what $FAILS says.
PYTHON = """#!/usr/bin/env bash
case "$*" in
    -c*) echo "${0##*python}" ;;
    *venv*) mkdir -p "${@: -1}/bin"; cp "$0" "${@: -1}/bin/python"; cp "$0" "${@: -1}/bin/pip" ;;
    *) echo "$*" >> "$CALLS"; [[ -z $FAILS || "$*" != *$FAILS* ]] ;;
esac
"""


def test_the_gate_has_a_reference_for_each_of_its_episodes():
    (line,) = re.findall(r'^step "mechsearch (bench guard .*)"$', (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    arguments = shlex.split(line)
    assert callable(cli.parse(arguments))
    scenes, reference = (arguments[arguments.index(name) + 1] for name in ("--scenes", "--reference"))
    outcomes = guard.read_reference(ROOT / reference).outcomes
    scene_names = [block.scene_name(index) for block, index in guard.suite(int(scenes))]
    assert [outcome.scenario for outcome in outcomes] == scene_names
    assert [comparison.measure for comparison in guard.compare(outcomes, outcomes)] == list(guard.MEASURES)


def test_the_site_is_built_so_that_a_broken_link_fails():
    (line,) = re.findall(r"mkdocs' (build .*?)\"$", (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    assert "--strict" in line
    # It hides warnings, and strict counts none then.
    assert "--quiet" not in line


def test_what_is_always_run_and_what_is_drawn_are_all_slow_tests_but_those_of_a_release():
    ci = (ROOT / ".ci" / "run").read_text()
    assert '"XLA_FLAGS= $always tests/test_readme.py"' in ci
    assert "&& $always --ignore tests/test_readme.py" in ci
    (chosen,) = re.findall(r"-m '([^']*)' --slow-share auto/", ci)
    assert chosen == "slow and not gpu and not release and not always"


def test_the_readme_says_how_much_of_the_slow_tests_a_change_has_to_pass():
    (parts,) = re.findall(r"^PARTS=(\d+) ", (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    assert f"one of {parts} parts of the slow tests" in " ".join((ROOT / "README.md").read_text().split())


@pytest.fixture
def release(tmp_path):
    """Runs the command on a checkout of its own, with the Pythons of these versions."""
    checkout, calls, folder = tmp_path / "checkout", tmp_path / "calls", tmp_path / "bin"
    (checkout / ".ci").mkdir(parents=True)
    folder.mkdir()
    # No other Python is in sight.
    for tool in ("bash", "cp", "dirname", "git", "mkdir", "rm", "sed"):
        (folder / tool).symlink_to(shutil.which(tool))
    shutil.copy(ROOT / ".ci" / "release", checkout / ".ci")
    shutil.copy(ROOT / "pyproject.toml", checkout)
    identity = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
    for command in (("init", "--quiet"), ("add", "."), (*identity, "commit", "--quiet", "-m", "one")):
        subprocess.run(["git", *command], cwd=checkout, check=True)

    def run(versions, fails=""):
        for version in versions:
            (folder / f"python{version}").write_text(PYTHON)
            (folder / f"python{version}").chmod(0o755)
        environment = {
            "PATH": str(folder),
            "HOME": str(tmp_path),
            "PYENV_ROOT": str(tmp_path),
            "CALLS": str(calls),
            "FAILS": fails,
        }
        calls.write_text("")
        command = [folder / "bash", str(checkout / ".ci" / "release"), str(tmp_path / "kept")]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        return done, calls.read_text().splitlines()

    run.checkout = checkout
    return run


def table(done):
    rows = [line.split() for line in done.stdout.rpartition("\n\n")[2].splitlines()]
    return {name: state for name, state, *_ in rows}


def test_what_passed_is_not_run_again_and_what_is_missing_is_said(release):
    first, calls = release(["3.11"], fails="--slow-share 3/12")
    assert first.returncode == 1
    assert "python3.12 is missing" in first.stdout
    states = table(first)
    assert {name for name, state in states.items() if state != "passed"} == {"python3.12-tests", "slow-3-of-12"}
    assert (states["python3.12-tests"], states["slow-3-of-12"]) == ("missing", "failed")
    assert any(call.startswith("install --quiet -e .[test] jax==") for call in calls)
    assert sum("goldens/net.py compare" in call for call in calls) == 7
    second, calls = release(["3.11", "3.12"])
    assert second.returncode == 0, second.stdout
    assert calls == [
        "install --quiet -e .[test]",
        "-m pytest",
        "-m pytest -m slow and not gpu --slow-share 3/12",
    ]
    assert set(table(second).values()) == {"passed"}


def test_a_checkout_that_differs_from_its_commit_is_refused(release):
    (release.checkout / "pyproject.toml").write_text("")
    done, calls = release(["3.11"])
    assert (done.returncode, calls) == (2, [])
    assert done.stderr == ".ci/release: the checkout differs from its commit; commit or stash first\n"
