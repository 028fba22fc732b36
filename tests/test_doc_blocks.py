"""The guides' blocks of code: commands are parsed, files of settings read, and what a page tells to do is done."""

import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import trimesh

from mechsearch_jax.benchmarks.lab import PROGRAM
from mechsearch_jax.benchmarks.lab import __main__ as lab
from mechsearch_jax.commands import main as cli
from mechsearch_jax.problem.settings import load_settings
from mechsearch_jax.workspace.scenario import COMPOUND_VERSION, FORMAT, parse_scenario

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "examples/ros2/README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
# Pages of which all that they tell to do is done, in order; and those whose lines of Python are run.
DONE = ("start.md", "camera.md", "robot.md")
RUN = ("docs/python.md", "docs/extend.md", "CONTRIBUTING.md")
# Programs that are not ours.
OTHERS = {"pip", "git", "ray", "source", "pytest", "mkdocs", "wait", "search_node.py"}
# Words of the shell in front of a command, and what stands for a value in it.
IN_FRONT = re.compile(r"^(?:(?:for \w+ in [^;]+; *do\b|do\b|[A-Z_]+=(?:\$\(\(.*?\)\)(?= )|\S+)) *)+")
VARIABLES = {"$table": "table3", "$k": "0"}
UNREADABLE = "unreadable"


def blocks(page):
    """The language and the text of each block of a page."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def commands(page):
    """The commands of a page's shell blocks, each as its words.

    What cannot be read becomes a command of its own kind, that no test accepts, so that all others are still tested.
    """
    for language, text in blocks(page):
        if language in ("sh", "bash"):
            for line in re.split(r"\n| && ", text.replace("\\\n", " ")):
                line = re.sub(r" *[;&]? *(?:\bdone\b.*)?$", "", IN_FRONT.sub("", line.strip()))
                try:
                    words = shlex.split(line, comments=True)
                    words = [re.sub(r"\$\w+", lambda name: VARIABLES[name[0]], word) for word in words]
                except ValueError as error:
                    words = [UNREADABLE, f"{page}: {line!r}: {error}"]
                except KeyError as error:
                    words = [UNREADABLE, f"{page}: {line!r}: nothing in VARIABLES stands for {error}"]
                if words:
                    yield words


def named(page):
    return str(page.relative_to(ROOT))


def test_every_block_is_of_a_kind_that_is_tested():
    kinds = {(language, page.name) for page in PAGES for language, _ in blocks(page)}
    assert {language for language, _ in kinds} == {"bash", "sh", "toml", "python", "json"}
    assert {name for language, name in kinds if language == "python"} == {
        *("README.md", "robot.md"),
        *(Path(page).name for page in RUN),
    }


@pytest.mark.parametrize("page", [page for page in PAGES if any(commands(page))], ids=named)
def test_commands_are_understood(page):
    for program, *arguments in commands(page):
        assert program != UNREADABLE, arguments[0]
        if program == "mechsearch":
            assert callable(cli.parse(arguments)), arguments
        elif program == "python" and arguments[0] == "-m":
            assert importlib.util.find_spec(arguments[1]), arguments
            assert arguments[1] != PROGRAM.split()[-1] or callable(lab.parse(arguments[2:])), arguments
        else:
            assert program in OTHERS or (program == "python" and arguments[0] in OTHERS), (program, arguments)


DRY = [words for page in PAGES for words in commands(page) if "--dry-run" in words]


@pytest.mark.slow
@pytest.mark.parametrize("arguments", DRY, ids=" ".join)
def test_what_would_be_run_is_said(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (cli.parse(arguments[1:]) if arguments[0] == "mechsearch" else lab.parse(arguments[3:]))()
    assert re.search(r"\d+ episodes", capsys.readouterr().out)
    assert not list(tmp_path.rglob("*.parquet"))


def test_objects_of_scenario_files_are_read(tmp_path):
    trimesh.creation.box((80.0, 80.0, 100.0)).export(tmp_path / "mug.obj")
    target = {
        "shape": "cylinder",
        "half_size": [0.02, 0.02, 0.05],
        "position": [0.6, 0, 0.46],
        "quaternion": [1, 0, 0, 0],
    }
    texts = [text for page in PAGES for language, text in blocks(page) if language == "json"]
    assert texts
    for text in texts:
        scene = {"format": FORMAT, "version": COMPOUND_VERSION, "name": "doc", "objects": [json.loads(text)]}
        (body,) = parse_scenario({**scene, "target": target}, "a page", folder=tmp_path).objects
        assert body.half_size == pytest.approx((0.04, 0.04, 0.05))


def test_settings_in_files_are_read(tmp_path):
    count = 0
    for page in PAGES:
        for text in (text for language, text in blocks(page) if language == "toml"):
            # A sweep has a list of scenarios; how it is read is tested with sweeps.
            if "scenarios" not in tomllib.loads(text):
                (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
                load_settings(tmp_path / "mine.toml")
                count += 1
    assert count > 2


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN)
def test_python_runs_as_it_stands(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = [text for language, text in blocks(ROOT / page) if language == "python"]
    # Classes in it are pytrees, and look for the module that they are defined in.
    exec(compile("\n".join(code), page, "exec"), {"__name__": "guide"})


@pytest.mark.slow
@pytest.mark.release
@pytest.mark.parametrize("page", DONE)
def test_what_a_page_tells_to_do_can_be_done(page, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for language, text in blocks(ROOT / "docs" / page):
        if language == "toml":
            (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
        if language == "python":
            calls = [["-c", text]]
        elif language == "sh":
            calls = [["-m", "mechsearch_jax.commands.main", *shlex.split(line)[1:]] for line in text.splitlines()]
        else:
            continue
        for call in calls:
            done = subprocess.run(
                [sys.executable, *call], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900
            )
            assert done.returncode == 0, (call[-3:], done.stderr[-2000:])
