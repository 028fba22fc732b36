"""What checks a change, and what a release: the gate has its reference; a stopped release goes on, and says what is
missing; a version is set and tagged only by it."""

import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
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
    checkout.mkdir()
    folder.mkdir()
    # No other Python is in sight, but for the one that reads and writes versions.
    for tool in ("bash", "cp", "date", "dirname", "env", "git", "mkdir", "rm", "sed", "tar"):
        (folder / tool).symlink_to(shutil.which(tool))
    (folder / "python3").symlink_to(sys.executable)
    shutil.copytree(ROOT / ".ci", checkout / ".ci", ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "CITATION.cff", "CHANGELOG.md"):
        shutil.copy(ROOT / file, checkout)

    def git(*arguments):
        done = subprocess.run(["git", *arguments], cwd=checkout, check=True, capture_output=True, text=True)
        return done.stdout.strip()

    git("init", "--quiet")
    for name, value in (("user.name", "a"), ("user.email", "a@example.org"), ("commit.gpgsign", "false")):
        git("config", name, value)
    git("config", "tag.gpgsign", "false")
    git("add", ".")
    git("commit", "--quiet", "-m", "one")

    def run(versions, fails="", what=()):
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
        command = [folder / "bash", str(checkout / ".ci" / "release"), str(tmp_path / "kept"), *what]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        return done, calls.read_text().splitlines()

    run.checkout, run.git = checkout, git
    return run


def table(done):
    rows = [line.split() for line in done.stdout.rpartition("\n\n")[2].splitlines()]
    return {name: state for name, state, *_ in rows}


def test_what_passed_is_not_run_again_and_what_is_missing_is_said(release):
    first, calls = release(["3.11", "3.12"], fails="--slow-share 3/12")
    assert first.returncode == 1
    assert "python3.13 is missing" in first.stdout
    states = table(first)
    missing = {"python3.13-wheels": "missing", "python3.13-tests": "missing"}
    assert {name: state for name, state in states.items() if state != "passed"} == missing | {"slow-3-of-12": "failed"}
    assert any(call.startswith("install --quiet -e .[test] jax==") for call in calls)
    assert sum("goldens/net.py compare" in call for call in calls) == 7
    second, calls = release(["3.11", "3.12", "3.13"])
    assert second.returncode == 0, second.stdout
    assert "-m pytest -m slow and not gpu --slow-share 3/12" in calls
    assert sum(call.startswith("install ") for call in calls) == 3
    assert set(table(second).values()) == {"passed"}
    assert not release.git("tag")


def test_the_wheel_is_tried_with_each_python_and_the_lowest_and_the_newest_jax(release):
    done, calls = release(["3.11", "3.12", "3.13"], what=["wheels"])
    assert done.returncode == 0, done.stdout
    tried = [f"python{number}-wheel-{which}" for number in ("3.11", "3.12", "3.13") for which in ("newest", "lowest")]
    assert list(table(done)) == ["build", "metadata", *tried]
    installed = [call for call in calls if re.match(r"install --quiet \S*/dist/", call)]
    assert ["jax==" in call for call in installed] == [False, True] * 3
    checked = [call for call in calls if ".ci/installed.py" in call]
    (version,) = re.findall(r'^version = "(.*)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert [call.rpartition(" ")[2] for call in checked] == [version] * 6


@pytest.mark.parametrize("fails", ["check", "installed.py", "-m build", "-m twine"])
def test_a_package_that_fails_a_check_fails_its_step(release, fails):
    done, _ = release(["3.11", "3.12", "3.13"], fails, what=["wheels"])
    assert done.returncode == 1
    assert "failed" in table(done).values()


def test_a_release_sets_the_version_checks_that_commit_and_tags_it(release):
    (version,) = re.findall(r"^## (\S+) \(unreleased\)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    failed, _ = release(["3.11", "3.12", "3.13"], fails="--slow-share 3/12", what=[version])
    assert failed.returncode == 1
    assert not release.git("tag")
    assert release.git("log", "--format=%s").splitlines() == [f"version {version}", "one"]
    done, calls = release(["3.11", "3.12", "3.13"], what=[version])
    assert done.returncode == 0, done.stdout
    # The commit of the first attempt is checked further, and not made anew.
    assert calls == ["-m pytest -m slow and not gpu --slow-share 3/12"]
    assert release.git("log", "--format=%s").splitlines() == [f"version {version}", "one"]
    assert release.git("tag", "--points-at", "HEAD") == f"v{version}"
    again, calls = release(["3.11", "3.12", "3.13"], what=[version])
    assert (again.returncode, calls) == (2, [])
    assert "is tagged already" in again.stderr


def test_a_checkout_that_differs_from_its_commit_is_refused(release):
    (release.checkout / "pyproject.toml").write_text("")
    done, calls = release(["3.11"])
    assert (done.returncode, calls) == (2, [])
    assert done.stderr == ".ci/release: the checkout differs from its commit; commit or stash first\n"


def test_what_is_no_version_is_refused(release):
    for what in ("0.2", "wheel"):
        done, calls = release(["3.11"], what=[what])
        assert (done.returncode, calls) == (2, [])
        assert done.stderr == "usage: bash .ci/release FOLDER [wheels|VERSION]\n"
    done, calls = release(["3.11"], what=["9.9.9"])
    assert (done.returncode, calls) == (2, [])
    assert "its newest entry is of" in done.stderr


def version_module():
    spec = importlib.util.spec_from_file_location("version", ROOT / ".ci" / "version.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_files_of_this_checkout_name_the_same_version():
    version_module().check(ROOT)


def test_a_version_is_set_wherever_it_stands(tmp_path):
    version = version_module()
    for file in ("pyproject.toml", "CITATION.cff", "CHANGELOG.md"):
        shutil.copy(ROOT / file, tmp_path)
    log = (tmp_path / "CHANGELOG.md").read_text()
    (tmp_path / "CHANGELOG.md").write_text(
        re.sub(r"^## \S+ \(.*\)$", "## 7.8.9 (unreleased)", log, count=1, flags=re.M)
    )
    with pytest.raises(ValueError, match=r"newest entry is of 7\.8\.9, not of 1\.0\.0"):
        version.set_version(tmp_path, "1.0.0", "2030-01-02")
    with pytest.raises(ValueError, match="no version"):
        version.set_version(tmp_path, "1.0", "2030-01-02")
    assert version.set_version(tmp_path, "7.8.9", "2030-01-02")
    assert version.named(tmp_path) == ("7.8.9", "7.8.9", "7.8.9", "2030-01-02")
    assert "\nversion: 7.8.9\ndate-released: 2030-01-02\n" in (tmp_path / "CITATION.cff").read_text()
    assert not version.set_version(tmp_path, "7.8.9", "2030-01-03")
    version.check(tmp_path)
    (tmp_path / "CITATION.cff").write_text("version: 7.8.8\n")
    with pytest.raises(ValueError, match=r"pyproject\.toml is 7\.8\.9, CITATION\.cff 7\.8\.8"):
        version.check(tmp_path)
