"""The pages of scene sets are of the declared sets, and pictures show today's scenes."""

import re
from pathlib import Path

import pytest
from PIL import Image

from mechsearch_jax.benchmarks.lab.site import gallery, method_pictures, set_pictures
from mechsearch_jax.commands import main as cli
from mechsearch_jax.commands.options import find_scenario
from mechsearch_jax.envs.page.page import stamp
from mechsearch_jax.envs.scenes.scene_sets import SETS, digest, recorded
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs/scene-sets"
PAGES = {file.stem: file.read_text(encoding="utf-8") for file in sorted(FOLDER.glob("*.md"))}
SHOWN = [name for name, text in PAGES.items() if set_pictures.shown_on(text)]
DRAW_SETS = f"run `python -m {set_pictures.__name__}`"


@pytest.mark.parametrize("name", [name for name, scene_set in SETS.items() if scene_set.about])
def test_every_set_is_on_a_page_as_it_is(name):
    first = SETS[name].blocks[0]
    seeds = f"{first.first_seed} to {first.first_seed + first.scenes - 1}"
    row = rf"^\| `{name}` \| {SETS[name].scenes} \|.*\| {seeds} \|.*\| {digest(SETS[name])} \|$"
    assert any(re.search(row, text, re.MULTILINE) for text in PAGES.values()), digest(SETS[name])


def test_every_page_of_sets_is_in_the_navigation_and_the_list():
    navigation = re.findall(r"scene-sets/(.+)\.md$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(navigation) == sorted(PAGES)
    assert {f"{name}.md" for name in PAGES} - {"index.md"} <= set(re.findall(r"\(([\w-]+\.md)\)", PAGES["index"]))


@pytest.mark.parametrize("name", SHOWN)
def test_a_picture_shows_the_scenes_on_record(name):
    with Image.open(FOLDER / f"{name}.png") as picture:
        hashes = picture.text["scenes"].split()
    shown = set_pictures.shown_on(PAGES[name])
    assert hashes == [recorded()[block.name][index] for block, index in shown], DRAW_SETS
    assert (FOLDER / f"{name}.png").stat().st_size < 400_000


def test_pictures_are_of_sets_alone_that_may_be_looked_at():
    assert {file.stem for file in FOLDER.glob("*.png")} == set(SHOWN), DRAW_SETS
    assert "report" not in SHOWN


@pytest.mark.parametrize("name", method_pictures.PICTURES)
def test_the_pictures_of_the_method_are_of_the_shipped_scene(name):
    with Image.open(ROOT / method_pictures.OUT / f"{name}.png") as picture:
        shows = picture.text[method_pictures.SHOWS]
    today = load_scenario(example_scenarios()[method_pictures.SCENE]).content_hash
    assert shows == today, f"run `python -m {method_pictures.__name__}`"
    assert f"](pictures/{name}.png)" in (ROOT / "docs/pictures.md").read_text(encoding="utf-8")


GALLERY = ROOT / "docs/gallery"
DRAW = f"what writes pages has changed; run `python -m {gallery.__name__} --recordings FOLDER`"


def test_the_gallery_declares_searches_that_the_command_line_takes():
    episodes = gallery.declared()
    assert len(episodes) == 8
    for episode in episodes:
        assert callable(cli.parse(["search", *episode.search, "--out", "out"]))
        find_scenario(episode.search[0])


def test_the_index_lists_the_pages_that_are_there():
    episodes = gallery.declared()
    text = gallery.index(episodes, GALLERY)
    assert (GALLERY / "index.md").read_text(encoding="utf-8") == text
    pages = sorted(GALLERY.glob("*.html"))
    assert {page.stem for page in pages} <= {episode.name for episode in episodes}
    assert all(f"]({page.name})" in text for page in pages)
    assert sum(page.stat().st_size for page in pages) < gallery.ALL
    for page in pages:
        words = re.sub(r"base64,[^\"]*", "", page.read_text(encoding="utf-8"))
        assert not re.search(r"https?:|file:", words), page.name
        assert "of an earlier version" not in words
        assert f'content="mechsearch view --save {stamp()}"' in words, f"{page.name}: {DRAW}"
