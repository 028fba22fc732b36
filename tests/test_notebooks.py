"""The notebooks: they are stored as they were executed, their links lead somewhere, and their code runs."""

import contextlib
import io
import json
import re
from pathlib import Path

import pytest

from mechsearch_jax.benchmarks.lab.site import notebooks

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / notebooks.FOLDER
NAMES = notebooks.names(FOLDER)
ANEW = f"run `python -m {notebooks.__name__}`"
LINK = re.compile(r"\]\(([^)\s#]+)(?:#[^)\s]*)?\)")


def read(name):
    return json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))


def outputs(notebook):
    return [output for cell in notebook["cells"] for output in cell.get("outputs", ())]


def test_there_are_two():
    assert NAMES == ["compare-policies", "first-search"]


@pytest.mark.parametrize("name", NAMES)
def test_each_cell_is_stored_with_what_it_said(name):
    notebook = read(name)
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1)), ANEW
    kinds = {output["output_type"] for output in outputs(notebook)}
    assert kinds <= {"stream", "display_data", "execute_result"}, ANEW
    assert not [output for output in outputs(notebook) if output.get("name") == "stderr"], ANEW
    assert sum("image/png" in output.get("data", {}) for output in outputs(notebook)) >= 1
    assert notebooks.tidied(notebook) == notebook, ANEW


@pytest.mark.parametrize("name", NAMES)
def test_it_is_small_and_says_nothing_of_where_it_was_executed(name):
    text = (FOLDER / f"{name}.ipynb").read_text(encoding="utf-8")
    assert len(text) < notebooks.LARGEST
    for output in outputs(json.loads(text)):
        said = "".join(output.get("text", ())) + "".join(output.get("data", {}).get("text/plain", ()))
        assert not re.search(r"/(?:home|root|tmp|work|Users)/", said)


@pytest.mark.parametrize("name", NAMES)
def test_its_links_lead_somewhere(name):
    text = "\n".join("".join(cell["source"]) for cell in read(name)["cells"] if cell["cell_type"] == "markdown")
    links = [link for link in LINK.findall(text) if ":" not in link]
    assert links
    assert not [link for link in links if not (FOLDER / link).resolve().exists()]


def test_each_has_a_page_in_the_navigation():
    navigation = re.findall(r"notebooks/(.+)\.md$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(navigation) == NAMES


def run(name, tmp_path, monkeypatch, changes=()):
    """Execute the cells of code; returns what they print and their names."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MECHSEARCH_CACHE_DIR", "")
    code = "\n".join(notebooks.code_cells(read(name)))
    for old, new in changes:
        assert code.count(old) == 1
        code = code.replace(old, new)
    said, names = io.StringIO(), {"__name__": "notebook"}
    with contextlib.redirect_stdout(said):
        exec(compile(code, name, "exec"), names)
    return said.getvalue(), names


@pytest.mark.slow
def test_the_first_search_takes_the_target_out(tmp_path, monkeypatch):
    said, names = run("first-search", tmp_path, monkeypatch)
    assert said.splitlines()[-1] == "the target is out"
    assert names["steps"][-1].kind == "retrieve"
    stored = "".join("".join(output.get("text", ())) for output in outputs(read("first-search")))
    assert stored.splitlines()[-1] == "the target is out", ANEW


@pytest.mark.slow
def test_policies_are_compared_on_fewer_scenes(tmp_path, monkeypatch):
    said, names = run("compare-policies", tmp_path, monkeypatch, [("SCENES = 50", "SCENES = 2")])
    assert [row.policy for row in names["rows"]] == ["search-for-grasp"] * 2 + ["free-or-not"] * 2
    assert not any(row.is_error for row in names["rows"])
    # Some are of episodes alone in which the target was found.
    assert max(change.pairs for change in names["differences"].values()) == 2
    assert said.splitlines()[-1].endswith("of 2 scenes")
