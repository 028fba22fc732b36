"""The networks' pages are of the weights that ship, and their figures those of the stored benchmarks."""

import hashlib
import json
import re
import shutil
from pathlib import Path

import pytest

from mechsearch_jax.benchmarks.lab.site import network_pages
from mechsearch_jax.networks.weights import ARCHITECTURES
from mechsearch_jax.runtime.errors import InputError

ROOT = Path(__file__).parents[1]
RESULTS, CARDS = ROOT / network_pages.RESULTS, ROOT / network_pages.CARDS
PAGES = {name: (ROOT / network_pages.OUT / f"{name}.md").read_text(encoding="utf-8") for name in ARCHITECTURES}


def test_every_network_has_figures_and_a_place_in_the_navigation():
    assert set(network_pages.FIGURES) == set(ARCHITECTURES)
    navigation = re.findall(r"networks/(.+)\.md$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(navigation) == sorted(ARCHITECTURES)


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_the_figures_are_those_of_the_stored_file(name):
    anew = network_pages.page(name, PAGES[name], RESULTS, CARDS)
    assert anew == PAGES[name], f"run `python -m {network_pages.__name__}`"


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_a_page_is_of_the_weights_that_ship_and_of_all_that_trained_them(name):
    digest = hashlib.sha256((CARDS / f"{name}.npz").read_bytes()).hexdigest()
    card = json.loads((CARDS / f"{name}.json").read_text(encoding="utf-8"))
    assert f"`{digest}`" in PAGES[name]
    assert f"{card['parameters']:,} parameters" in PAGES[name]
    commands = []
    while card:
        commands.insert(0, card["command"])
        card = card.get("started_from")
    assert re.findall(r"^mechsearch train .*$", PAGES[name], re.MULTILINE) == commands


def test_figures_of_other_weights_are_refused(tmp_path):
    shutil.copy(CARDS / "push.json", tmp_path)
    card = json.loads((tmp_path / "push.json").read_text(encoding="utf-8"))
    (tmp_path / "push.json").write_text(json.dumps({**card, "sha256": "0" * 64}), encoding="utf-8")
    with pytest.raises(InputError, match=r"push-cpu\.json: is of other weights \(23a87126\w*\) than push\.npz \(0+\)"):
        network_pages.page("push", PAGES["push"], RESULTS, cards=tmp_path)
