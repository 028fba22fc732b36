"""The guides: their links lead somewhere, their code runs, and what the source cites of them is there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = ["README.md", "CHANGELOG.md", *sorted(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md"))]
# Links and code may stand between backticks or in a block without meaning what they say.
BLOCK = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
# As docstrings cite a page: docs/method.md, "Existence"; a line may end anywhere in between.
CITATION = re.compile(r'(docs/\w+\.md),\s+"([^"]+)"')
SOURCE = ("mechsearch_jax", "envs", "train", "benchmarks")


def read(page):
    return (ROOT / page).read_text(encoding="utf-8")


def headings(page):
    return [title.strip() for title in re.findall(r"^#+ (.+)$", BLOCK.sub("", read(page)), re.MULTILINE)]


def anchors(page):
    """The fragments that GitHub gives the headings of a page."""
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in headings(page)}


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    for link in LINK.findall(BLOCK.sub("", read(page))):
        if re.match(r"\w+:", link):
            continue
        path, _, fragment = link.partition("#")
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.exists(), f"{page}: {link}"
        if fragment:
            assert fragment in anchors(target), f"{page}: {link}"


def test_citations_in_the_source_name_a_heading():
    found = 0
    for folder in SOURCE:
        for file in (ROOT / folder).rglob("*.py"):
            for page, title in CITATION.findall(file.read_text(encoding="utf-8")):
                assert title in headings(page), f"{file}: {page}, {title}"
                found += 1
    assert found > 0


def test_no_table_row_is_broken():
    for page in PAGES:
        text = BLOCK.sub("", read(page))
        for table in re.findall(r"(?:^\|.*\|$\n?)+", text, re.MULTILINE):
            widths = {len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines()}
            assert len(widths) == 1, f"{page}: {table[:80]}"
        assert not re.search(r"^\|.*[^|\s]\s*$", text, re.MULTILINE), f"{page}: a row without an end"


@pytest.mark.slow
def test_the_code_of_the_python_guide_runs():
    code = re.findall(r"^```python\n(.*?)^```$", read("docs/python.md"), re.MULTILINE | re.DOTALL)
    # Classes in it are pytrees, and look for the module that they are defined in.
    exec(compile("\n".join(code), "docs/python.md", "exec"), {"__name__": "guide"})
