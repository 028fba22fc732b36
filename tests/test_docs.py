"""The guides: their links lead somewhere, their code runs, and what the source cites of them is there."""

import importlib.util
import json
import math
import re
from pathlib import Path

import pytest

import mechsearch_jax
from mechsearch_jax.benchmarks.lab.site import results_page
from mechsearch_jax.benchmarks.store.runs import load_run
from mechsearch_jax.envs.scenes.scene_sets import SETS, recorded
from mechsearch_jax.envs.world.mismatch import ASSUMED, MISMATCH_OPTIONS
from mechsearch_jax.planner import OPTIONS, PRESETS

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks/results"
PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md")),
]
MANUAL = [page for page in PAGES if not page.startswith(("docs/record/", "CONTRIBUTING"))]
# Links and code may stand between backticks or in a block without meaning what they say.
BLOCK = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
# As docstrings cite a page: docs/method.md, "Existence"; a line may end anywhere in between.
CITATION = re.compile(r'(docs/[\w/]+\.md),\s+"([^"]+)"')
SOURCE = ("mechsearch_jax", "envs", "train", "benchmarks")
# What a cell of a table says, and what follows from it.
WORDS = {"yes": True, "no": False, "true": True, "false": False}


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
    count = 0
    for folder in SOURCE:
        for file in (ROOT / folder).rglob("*.py"):
            for page, title in CITATION.findall(file.read_text(encoding="utf-8")):
                assert title in headings(page), f"{file}: {page}, {title}"
                count += 1
    assert count > 0


def test_no_table_row_is_broken():
    for page in PAGES:
        text = BLOCK.sub("", read(page))
        for table in re.findall(r"(?:^\|.*\|$\n?)+", text, re.MULTILINE):
            widths = {len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines()}
            assert len(widths) == 1, f"{page}: {table[:80]}"
        assert not re.search(r"^\|.*[^|\s]\s*$", text, re.MULTILINE), f"{page}: a row without an end"


def rows(page, header):
    """The cells of the table with a header, without the header."""
    table = re.search(rf"^{re.escape(header)}\n\|[-|]+\|\n((?:\|.*\|\n)+)", read(page), re.MULTILINE)
    assert table, f"{page}: {header}"
    return [[cell.strip() for cell in row.strip("|").split(" | ")] for row in table[1].splitlines()]


def said(cell):
    """The value, list of angles or list of numbers in brackets that a cell begins with."""
    cell = cell.strip('`"')
    if cell.startswith("["):
        return [float(number) for number in cell.strip("[]").split()]
    if "°" in cell:
        return [math.radians(float(angle)) for angle in re.findall(r"(-?[\d.]+)°", cell)]
    word = re.match(r"[\w.-]+", cell)[0]
    return WORDS.get(word.lower(), float(word) if word[0].isdigit() else word)


@pytest.mark.parametrize("page", [page for page in PAGES if page.startswith("docs/")])
def test_files_that_a_page_names_are_there(page):
    for path in re.findall(r"`([\w/]+\.py)`", read(page)):
        assert any((ROOT / folder / path).is_file() for folder in ("", *SOURCE)), f"{page}: {path}"


def test_what_the_python_guides_name_of_modules_is_there():
    package, count = ROOT / "mechsearch_jax", 0
    rooms = {path.stem for path in package.iterdir()} | set(SOURCE)
    guides = "\n".join(read(f"docs/{name}.md") for name in ("python", "extend", "camera", "robot"))
    for path, name in re.findall(r"`(?:mechsearch_jax\.)?((?:\w+\.)+)(\w+)[`(]", guides):
        folders = [folder for folder in path.strip(".").split(".") if folder != "mechsearch_jax"]
        if folders and folders[0] in rooms:
            places = [root.joinpath(*folders) for root in (package, ROOT)]
            modules = [file for place in places for file in (place.with_suffix(".py"), place / "__init__.py")]
            text = "\n".join(file.read_text(encoding="utf-8") for file in modules if file.is_file())
            within = any((place / name).is_dir() or (place / f"{name}.py").is_file() for place in places)
            assert within or re.search(rf'^(def|class) {name}\b|^    "{name}",$', text, re.MULTILINE), (path, name)
            count += 1
    assert count > 15


def test_the_python_guide_names_all_of_the_front_door():
    guide = read("docs/python.md")
    assert f"gives the {len(mechsearch_jax.__all__)} names" in guide
    for name in mechsearch_jax.__all__:
        assert re.search(rf"`(?:[^`]*\W)?{name}\b", guide), name


def test_the_api_pages_hold_all_of_the_front_door():
    pages = "\n".join(read(page) for page in PAGES if page.startswith("docs/api/"))
    shown = re.findall(r"^::: mechsearch_jax\.([\w.]+)\.(\w+)$", pages, re.MULTILINE)
    assert len(shown) == len(set(shown))
    assert set(mechsearch_jax._ROOMS.items()) <= {(name, room) for room, name in shown}


def test_the_options_of_the_command_line_are_all_there_with_their_defaults():
    table = rows("docs/commands.md", "| option | what it sets | `standard` | `paper` |")
    stated = {re.match(r"`--([\w-]+)", row[0])[1].replace("-", "_"): row[2:] for row in table}
    assert {option.name for option in OPTIONS} == set(stated) - {"preset", "recognition", "simulator"}
    for name, cells in stated.items():
        for preset, cell in zip(("standard", "paper"), cells, strict=False):
            value = PRESETS[preset]().options().get(name)
            if value is not None and name not in ("actions", "push_distances"):
                # An angle is stated as a list of one.
                value = [value] if "°" in cell and not isinstance(value, list) else value
                assert said(cell) == (pytest.approx(value) if isinstance(value, list) else value), f"{name}: {cell}"


def test_what_a_simulated_world_may_differ_in_is_all_there_with_its_default():
    table = rows("docs/commands.md", "| key of `--world` | what it sets | if not given |")
    stated = {name: said(row[-1]) for row in table for name in re.findall(r"`(\w+)`", row[0])}
    usual = {name: getattr(ASSUMED, name) for name in MISMATCH_OPTIONS}
    assert stated == usual


def test_the_results_page_is_what_its_stored_results_say():
    written = read("docs/results.md")
    assert written == results_page.page(RESULTS), f"run `python -m {results_page.__name__}`"
    assert len(written.splitlines()) <= 150


def test_every_stored_result_is_linked_from_the_manual():
    linked = {
        Path(link).name
        for page in (*MANUAL, "CONTRIBUTING.md")
        for link in LINK.findall(read(page))
        if "benchmarks/results/" in link
    }
    stored = {file.name for pattern in ("*.json", "runs/*.jsonl") for file in RESULTS.glob(pattern)}
    assert stored - linked == set()


def test_the_manual_is_of_todays_program():
    """What an earlier default came to is in the record, and no row of the manual is labelled so."""
    label = re.compile(r"^\|[^|]*\b(before|until|former|formerly)\b *[:|]|standard`? until|the default (before|until)")
    for page in MANUAL:
        for line in read(page).splitlines():
            assert not label.search(line), f"{page}: {line[:80]}"


def test_the_manual_can_be_read_in_an_afternoon():
    site = [*(page for page in MANUAL if page != "README.md"), "examples/ros2/README.md"]
    assert sum(len(read(page).split()) for page in site) <= 45_000


def unseen_line(run, objects, **settings):
    """What the default with such settings comes to on scenes of a run that nothing was chosen on."""
    (line,) = (
        line
        for line in run.lines
        if (line["preset"], line["settings"], line["objects"]) == ("standard", settings, objects)
    )
    return line["on_scenes_not_chosen_on"]


def test_the_rates_of_the_readme_are_the_stored_ones():
    run = load_run(RESULTS / "runs", "report-h200")
    header = " | ".join(f"{seen}: found | graspable | retrieved" for seen in ("true shapes", "`full`"))
    stated = {row[0]: row[1:] for row in rows("README.md", f"| objects | {header} |")}
    assert list(stated) == ["2", "4", "6", "8"]
    for objects, figures in stated.items():
        expected = []
        for settings in ({}, {"recognition": "full"}):
            line = unseen_line(run, int(objects), **settings)
            assert line["episodes"] == 200
            low, high = line["retrieved"]["interval"]
            expected += [f"{line[name]['rate']:.2f}" for name in ("found", "graspable")]
            expected.append(f"{line['retrieved']['rate']:.2f} ({low:.2f} to {high:.2f})")
        assert figures == expected


def test_the_other_figures_of_the_readme_are_the_stored_ones():
    text = read("README.md")
    seconds = json.loads((RESULTS / "plan-trials-cpu.json").read_text())["median_seconds"]
    assert f"[{1000 * seconds:.0f} ms on two CPU cores]" in text
    things, assumed, drawn = (
        unseen_line(load_run(RESULTS / "runs", f"report-{name}-h200"), 8, **settings)["retrieved"]["rate"]
        for name, settings in (
            ("household-bases", {"recognition": "full-parts"}),
            ("i", {}),
            ("i-worlds", {"mismatch.friction_spread": 2.0, "mismatch.mass_spread": 2.0}),
        )
    )
    assert f"[{things:.2f}](docs/results.md#household-things)" in text
    assert f"[{100 * (assumed - drawn):.1f} points fewer](docs/results.md#worlds-that-are-not-as-assumed)" in text


def test_stored_scenes_are_those_on_record():
    stored = json.loads((ROOT / "benchmarks/results/scenes-cpu.json").read_text())
    made = {(row[1], row[2]) for row in stored["rows"] if row[0] in SETS}
    sets = [SETS[name] for name in ("c2", "d1", "d2", "d3")]
    on_record = {
        (block.scene_name(i), content)
        for scene_set in sets
        for block in scene_set.blocks
        for i, content in enumerate(recorded()[block.name])
    }
    assert made == on_record


def glossary():
    """The words of the glossary with what their rows say: meaning, paper, code, option."""
    lines = re.findall(r"^\| (?!word |-)(.*) \|$", read("docs/glossary.md"), re.MULTILINE)
    return {row[0]: row[1:] for row in (line.split(" | ") for line in lines)}


def test_the_code_that_the_glossary_names_is_there():
    for word, (_, _, code, _) in glossary().items():
        path = code.strip("`").replace("ms.", "")
        package, _, name = f"mechsearch_jax.{path}".rpartition(".")
        there = hasattr(importlib.import_module(package), name) or importlib.util.find_spec(f"{package}.{name}")
        assert code == "–" or there, f"{word}: {code}"


def test_the_options_that_the_glossary_names_are_there():
    commands = read("docs/commands.md")
    for word, (*_, option) in glossary().items():
        assert option == "–" or option.strip("`") in commands, f"{word}: {option}"
