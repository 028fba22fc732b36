"""The pages of scene sets are what declared sets and stored runs say, and pictures show today's scenes."""

import re
from pathlib import Path

import pytest
from PIL import Image

from mechsearch_jax.benchmarks.site import method_pictures, set_pages
from mechsearch_jax.benchmarks.site.set_texts import ABOUT
from mechsearch_jax.envs.scenes.scene_sets import SETS, recorded
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs/scene-sets"
SHOWN = [name for name, about in ABOUT.items() if about.shown]


def line(objects, rate, **settings):
    """A line of a stored run: `rate` on all scenes, and 0.5 on those that nothing was chosen on."""
    rates = {key: {"rate": rate, "interval": [rate - 0.1, rate + 0.1]} for key in set_pages.MEASURES}
    unseen = {key: {"rate": 0.5, "interval": [0.4, 0.6]} for key in set_pages.MEASURES}
    return {
        "run": "some-run",
        "preset": "standard",
        "settings": settings,
        "scene_set": "c2",
        "objects": objects,
        "episodes": 20,
        "scenes": 20,
        "scenes_chosen_on": 10,
        **rates,
        "on_scenes_not_chosen_on": {"episodes": 10, **unseen},
    }


def test_the_pages_are_what_the_stored_runs_say():
    pages = set_pages.pages(ROOT / "benchmarks/results")
    written = {file.name: file.read_text(encoding="utf-8") for file in FOLDER.glob("*.md")}
    assert written == pages, f"run `python -m {set_pages.__name__}`"


def test_every_set_has_a_page_in_the_navigation():
    navigation = re.findall(r"scene-sets/(.+)\.md$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert navigation == ["index", *ABOUT]


@pytest.mark.parametrize("name", SHOWN)
def test_a_picture_shows_the_scenes_on_record(name):
    with Image.open(FOLDER / f"{name}.png") as picture:
        hashes = picture.text["scenes"].split()
    shown = set_pages.blocks_shown(SETS[name], ABOUT[name])
    assert hashes == [recorded()[block.name][index] for block, index in shown]
    assert (FOLDER / f"{name}.png").stat().st_size < 400_000


def test_pictures_are_of_sets_alone_that_may_be_looked_at():
    assert {file.stem for file in FOLDER.glob("*.png")} == set(SHOWN)
    assert not any(name.startswith("report-") for name in SHOWN)


def test_rates_are_of_scenes_that_nothing_was_chosen_on():
    tables = set_pages.rate_tables([line(2, 0.9), line(8, 0.8, policy="random")])
    rows = [row for row in tables["Retrieved"].splitlines() if row.startswith("| `")]
    cell = "0.50 (0.40 to 0.60)"
    assert [row.split(" | ")[:4] for row in rows] == [
        ["| `standard`", "10", cell, "–"],
        ["| `standard`, `random`", "10", "–", cell],
    ]


def test_what_a_run_did_not_judge_has_no_table():
    unjudged = line(2, 0.9) | {"retrieved": None}
    unjudged["on_scenes_not_chosen_on"]["retrieved"] = None
    assert set(set_pages.rate_tables([unjudged])) == {"Found", "Graspable"}


def test_a_variant_says_what_differs():
    settings = {"actions": ["push"], "recognition": "masks", "rehearsal": "none"}
    assert set_pages.label(line(2, 0.9, **settings)) == "`standard`, `masks`, push alone, without trials"


@pytest.mark.parametrize("name", method_pictures.PICTURES)
def test_the_pictures_of_the_method_are_of_the_shipped_scene(name):
    with Image.open(ROOT / method_pictures.OUT / f"{name}.png") as picture:
        assert picture.text[method_pictures.SHOWS] == load_scenario(example_scenarios()["crowded-shelf"]).content_hash
    assert f"](pictures/{name}.png)" in (ROOT / "docs/pictures.md").read_text(encoding="utf-8")
