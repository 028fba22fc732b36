"""The networks' cards are what the files beside the weights and the stored benchmarks say."""

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
ANEW = f"run `python -m {network_pages.__name__}`"


def page(name, **folders):
    return network_pages.page(
        name, **{"results": ROOT / network_pages.RESULTS, "cards": ROOT / network_pages.CARDS, **folders}
    )


def test_every_network_has_a_card_and_a_place_in_the_navigation():
    assert set(network_pages.CARD_OF) == set(ARCHITECTURES)
    navigation = re.findall(r"networks/(.+)\.md$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(navigation) == sorted(ARCHITECTURES)


@pytest.mark.parametrize("name", network_pages.CARD_OF)
def test_a_card_is_what_the_stored_files_say(name):
    assert (ROOT / network_pages.OUT / f"{name}.md").read_text(encoding="utf-8") == page(name), ANEW


@pytest.mark.parametrize("name", network_pages.CARD_OF)
def test_a_card_is_of_the_weights_that_ship(name):
    digest = hashlib.sha256((ROOT / network_pages.CARDS / f"{name}.npz").read_bytes()).hexdigest()
    assert f"`{digest}`" in page(name)


def test_figures_are_those_of_the_stored_file():
    stored = json.loads((ROOT / network_pages.RESULTS / "push-cpu.json").read_text(encoding="utf-8"))
    scores = stored["models"]["learned"]["15 cm"]
    row = f"| 15 cm | {scores['pushes']} | {scores['pushed_mm']:.1f} mm, {scores['pushed_deg']:.1f}° |"
    assert row in page("push")


def test_figures_of_other_weights_are_refused(tmp_path):
    shutil.copy(ROOT / network_pages.CARDS / "push.json", tmp_path)
    card = json.loads((tmp_path / "push.json").read_text(encoding="utf-8"))
    (tmp_path / "push.json").write_text(json.dumps({**card, "sha256": "0" * 64}), encoding="utf-8")
    with pytest.raises(InputError, match=r"push-cpu\.json: is of other weights \(23a87126\w*\) than push\.npz \(0+\)"):
        page("push", cards=tmp_path)


def test_what_a_training_went_on_from_comes_first():
    text = page("segmentation")
    first, *later = re.findall(r"^mechsearch train .*$", text, re.MULTILINE)
    assert "--start" not in first
    assert len(later) == 3
    assert all("--start" in command for command in later)
