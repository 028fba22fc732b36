"""The pages of scene sets are of the declared sets, and pictures show today's scenes."""

import dataclasses
import re
import types
from pathlib import Path

import pytest
from PIL import Image
from recordings import RECORDING
from stored_rows import USUAL, row_of

from mechsearch_jax.benchmarks.lab.site import all_pages, gallery, method_pictures, set_pictures
from mechsearch_jax.benchmarks.statistics.variants import Key
from mechsearch_jax.commands import main as cli
from mechsearch_jax.commands.options import find_scenario
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.page.page import stamp
from mechsearch_jax.envs.recording.recording import save_recording
from mechsearch_jax.envs.scenes.scene_sets import SETS, digest, recorded
from mechsearch_jax.runtime.errors import InputError
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


def test_the_baseline_of_the_guide_to_many_variants_is_one_of_them():
    guide = (ROOT / "docs/scale.md").read_text(encoding="utf-8")
    gammas, policies = re.findall(r"mechsearch sweep .*--gamma ([\d. ]+) --policy ([\w -]+?) --out", guide)[0]
    (baseline,) = re.findall(r"mechsearch report .*--baseline (\S+)", guide)
    configs = [USUAL.config.with_options(gamma=float(gamma)) for gamma in gammas.split()]
    methods = [Method(policy, config) for policy in policies.split() for config in configs]
    rows = [row_of("development-2-000", method) for method in methods]
    assert Key.of(rows).named(baseline) == "random, gamma 0.9"


@pytest.mark.parametrize("name", method_pictures.PICTURES)
def test_the_pictures_of_the_method_are_of_the_shipped_scene(name):
    with Image.open(ROOT / method_pictures.OUT / f"{name}.png") as picture:
        shows = picture.text[method_pictures.SHOWS]
    today = load_scenario(example_scenarios()[method_pictures.SCENE]).content_hash
    assert shows == today, f"run `python -m {method_pictures.__name__}`"
    assert f"](pictures/{name}.png)" in (ROOT / "docs/pictures.md").read_text(encoding="utf-8")


def test_steps_that_are_left_out_are_counted():
    figure = method_pictures.steps(dataclasses.replace(RECORDING, steps=RECORDING.steps * 3))
    assert figure.get_suptitle() == "The first 6 of 9 steps"
    assert not method_pictures.steps(RECORDING).get_suptitle()


def test_one_command_writes_every_page_that_the_docs_name():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    named = set(re.findall(r"`python -m (mechsearch_jax\.benchmarks\.[a-z_.]+(?:page|pages|seconds))\b", text))
    assert named - {all_pages.__name__} == {write.__module__ for write in all_pages.PAGES.values()}


def test_outside_a_checkout_nothing_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        all_pages.main([])
    assert end.value.code == 2
    assert "give the folder of the stored results as --results" in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("episode = 3", "declares no gallery"),
        ("[[episode]]\nname = 'a'", "declares no gallery"),
        ("[[episode]]\nname = 'A b'\ntitle = ''\nshows = ''\nsearch = []", "names are of small letters"),
    ],
)
def test_a_wrong_declaration_is_refused_in_one_line(text, message, tmp_path):
    (tmp_path / "gallery.toml").write_text(text)
    with pytest.raises(InputError, match=message) as refused:
        gallery.declared(tmp_path / "gallery.toml")
    assert "\n" not in str(refused.value)


def test_a_gallery_is_drawn_of_the_recordings_that_are_there(tmp_path, monkeypatch, capsys):
    save_recording(RECORDING, tmp_path / "recordings" / "easy" / "recording.npz")

    def run(program, **options):
        assert program[3:5] == ["view", str(tmp_path / "recordings" / "easy")]
        cli.parse(program[3:])()
        return types.SimpleNamespace(returncode=0)

    monkeypatch.setattr(gallery.subprocess, "run", run)
    gallery.main(["easy", "--out", str(tmp_path), "--recordings", str(tmp_path / "recordings")])
    text = (tmp_path / "index.md").read_text(encoding="utf-8")
    assert "[An easy search](easy.html)" in text
    assert "| retrieved |" in text
    assert text.count(".html") == 1
    with pytest.raises(SystemExit):
        gallery.main(["easy", "--index"])
    assert "--index writes the list alone" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        gallery.main(["nothing"])
    assert "nothing is no episode of the gallery; there are easy," in capsys.readouterr().err
    monkeypatch.setattr(gallery.subprocess, "run", lambda program: types.SimpleNamespace(returncode=3))
    with pytest.raises(SystemExit):
        gallery.main(["box", "--out", str(tmp_path)])
    assert "mechsearch search hidden-box --out" in capsys.readouterr().err
