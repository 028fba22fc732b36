"""The README: what it tells a reader to do works, and what it shows is there."""

import re
from pathlib import Path

import pytest

from mechsearch_jax.workspace.scenario import example_scenarios

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def test_there_are_two_commands():
    install_and_run, install_and_test = (block.strip() for block in blocks("bash"))
    assert re.search(r"mechsearch search (\S+)", install_and_run)[1] in example_scenarios()
    assert install_and_test.endswith("pytest")


def test_the_first_screen_has_the_picture():
    (picture,) = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", README)
    assert (ROOT / picture).read_bytes().startswith(b"\x89PNG")


def test_ten_lines_of_python_decide_on_an_action(capsys):
    (code,) = blocks("python")
    assert code.count("\n") <= 10
    exec(code, {})
    kind, _, cost, predicted = capsys.readouterr().out.split()
    assert int(kind) in (1, 2)
    assert float(predicted) < float(cost)


@pytest.mark.parametrize("file", ["LICENSE", "CHANGELOG.md", ".ci/run"])
def test_files_that_it_names_are_there(file):
    assert (ROOT / file).stat().st_size > 0
