"""Pages that the lab writes are of the stored runs and the declared sets, pictures of today's scenes."""

import dataclasses
import hashlib
import json
import re
import shutil
import sys
from pathlib import Path

import pytest
from PIL import Image
from stored_rows import row_of

from mechsearch_jax.benchmarks.lab.site import gallery, network_pages, pictures, set_pictures, store_run
from mechsearch_jax.benchmarks.statistics.intervals import wilson
from mechsearch_jax.benchmarks.statistics.preset_names import settings_of
from mechsearch_jax.benchmarks.store.rows import episode_key
from mechsearch_jax.benchmarks.store.runs import merged, stored_runs
from mechsearch_jax.benchmarks.store.shards import ShardWriter
from mechsearch_jax.commands import main as cli
from mechsearch_jax.commands.options import find_scenario
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.page.page import stamp
from mechsearch_jax.envs.scenes.scene_sets import SETS, digest, recorded
from mechsearch_jax.networks.weights import ARCHITECTURES
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.versions import DECISION_VERSION
from mechsearch_jax.workspace.scenario import load_scenario

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


DRAW_PICTURES = f"run `python -m {pictures.__name__}`"
SEARCHED = json.loads((ROOT / pictures.OUT / pictures.RECORD).read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", pictures.SEARCHES)
def test_the_pictures_are_of_searches_by_the_decisions_of_today(name):
    scene = load_scenario(find_scenario(pictures.SEARCHES[name][0])).content_hash
    assert (SEARCHED[name]["scene"], SEARCHED[name]["decisions"]) == (scene, DECISION_VERSION), DRAW_PICTURES


# Random actions are others wherever a number is rounded otherwise.
@pytest.mark.slow
@pytest.mark.parametrize("name", sorted({*pictures.SEARCHES} - {"random"}))
def test_a_search_ends_today_as_its_pictures_say(name, tmp_path, monkeypatch):
    # As a user has it: these tests compile for speed of compilation.
    monkeypatch.setenv("XLA_FLAGS", "")
    folder = pictures.search(name, tmp_path)
    assert pictures.record_of(folder) == SEARCHED[name], DRAW_PICTURES


@pytest.mark.parametrize("name", pictures.METHOD)
def test_the_pictures_of_the_method_are_shown(name):
    assert (ROOT / pictures.OUT / pictures.RECORD.parent / f"{name}.png").is_file(), DRAW_PICTURES
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


RESULTS, CARDS = ROOT / network_pages.RESULTS, ROOT / network_pages.CARDS
WRITTEN = {name: (ROOT / network_pages.OUT / f"{name}.md").read_text(encoding="utf-8") for name in ARCHITECTURES}


def test_every_network_has_figures_and_a_place_in_the_navigation():
    assert set(network_pages.FIGURES) == set(ARCHITECTURES)
    navigation = re.findall(r"networks/(.+)\.md$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(navigation) == sorted(ARCHITECTURES)


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_the_figures_are_those_of_the_stored_file(name):
    anew = network_pages.page(name, WRITTEN[name], RESULTS, CARDS)
    assert anew == WRITTEN[name], f"run `python -m {network_pages.__name__}`"


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_a_page_is_of_the_weights_that_ship_and_of_all_that_trained_them(name):
    digest = hashlib.sha256((CARDS / f"{name}.npz").read_bytes()).hexdigest()
    card = json.loads((CARDS / f"{name}.json").read_text(encoding="utf-8"))
    assert f"`{digest}`" in WRITTEN[name]
    assert f"{card['parameters']:,} parameters" in WRITTEN[name]
    commands = []
    while card:
        commands.insert(0, card["command"])
        card = card.get("started_from")
    assert re.findall(r"^mechsearch train .*$", WRITTEN[name], re.MULTILINE) == commands


def test_figures_of_other_weights_are_refused(tmp_path):
    shutil.copy(CARDS / "push.json", tmp_path)
    card = json.loads((tmp_path / "push.json").read_text(encoding="utf-8"))
    (tmp_path / "push.json").write_text(json.dumps({**card, "sha256": "0" * 64}), encoding="utf-8")
    with pytest.raises(InputError, match=r"push-cpu\.json: is of other weights \(23a87126\w*\) than push\.npz \(0+\)"):
        network_pages.page("push", WRITTEN["push"], RESULTS, cards=tmp_path)


def write(folder, rows, writer="me"):
    with ShardWriter(folder, writer) as shards:
        shards.append(rows)
    return folder


def test_a_run_is_read_back_and_says_what_came_of_it(tmp_path, monkeypatch, capsys):
    rows = [row_of("c2-4-001"), row_of("c2-4-100", found_step=None, graspable_step=None, retrieved=False, steps=10)]
    paper = Method("search-and-grasp", PRESETS["paper"](gamma=0.5), "masks")
    rows.append(row_of("c2-4-100", paper, objects_fallen=1, paper_graspable=None))
    folders = [write(tmp_path / name, part) for name, part in (("a", rows[:2]), ("b", rows[1:]))]
    arguments = [*map(str, folders), "--name", "two", "--command", "mechsearch evaluate c2", "--commit", "abc"]
    monkeypatch.setattr(sys, "argv", ["store_run", *arguments, "--out", str(tmp_path / "runs")])
    store_run.main()
    assert "two.parquet: 0.0" in capsys.readouterr().out
    (run,) = stored_runs(tmp_path / "runs")
    rounded = {episode_key(row): dataclasses.replace(row, planning_seconds=1.23, compile_seconds=0.12) for row in rows}
    assert {episode_key(row): row for row in run.rows} == rounded
    one, other = sorted(run.lines, key=lambda line: line["preset"] == "paper")
    assert (one["run"], one["commit"], one["code"], one["command"]) == ("two", "abc", "this code", arguments[5])
    assert (one["scene_set"], one["objects"], one["seeds"], one["devices"]) == ("c2", 4, [0], ["cuda: H100"])
    assert (one["preset"], one["settings"], one["episodes"], one["errors"]) == ("standard", {}, 2, 0)
    assert (one["scenes"], one["scenes_chosen_on"]) == (2, 1)
    interval = [round(bound, 4) for bound in wilson(1, 2)]
    assert one["retrieved"] == one["found"] == {"rate": 0.5, "interval": interval}
    assert (one["drop_free"]["rate"], one["actions"]) == (1.0, 6.5)
    assert one["on_scenes_not_chosen_on"]["episodes"] == 1
    assert one["on_scenes_not_chosen_on"]["retrieved"]["rate"] == 0.0
    assert other["settings"] == {"policy": "search-and-grasp", "recognition": "masks", "gamma": 0.5}
    assert other["drop_free"]["rate"] == 0.0
    assert other["paper_graspable"] is None


def test_parts_of_other_code_and_those_that_disagree_are_refused(tmp_path):
    one = write(tmp_path / "one", [row_of("c2-4-001")])
    other = write(tmp_path / "other", [row_of("c2-4-002", code="other code")])
    with pytest.raises(InputError, match=r"run by other code, those of .*one by this code; store them as two runs"):
        merged([one, other])
    changed = write(tmp_path / "changed", [row_of("c2-4-001", steps=5, planning_seconds=9.0)])
    with pytest.raises(InputError, match="'c2-4-001', seed 0, has another steps than the same episode in"):
        merged([one, changed])
    (empty := tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no results in this folder"):
        merged([empty])


def test_what_agrees_counts_once_and_an_error_gives_way(tmp_path):
    good, failed = row_of("c2-4-001"), row_of("c2-4-001", failure="error: no", retrieved=False)
    again = dataclasses.replace(good, planning_seconds=7.0, device="cuda: H200")
    folders = [write(tmp_path / str(i), [row]) for i, row in enumerate((failed, good, again, failed))]
    assert merged(folders) == [good]


def test_every_preset_is_its_own_settings():
    for name, preset in PRESETS.items():
        options = {**Method(config=preset()).options(), "simulator": "MjxSimulator", "target": "box"}
        assert settings_of(options) == (name, {})
        assert settings_of({**options, "gamma": 0.5}) == (name, {"gamma": 0.5})
    later = Method().options()
    del later["move_target"]
    assert settings_of(later) == ("standard", {})
