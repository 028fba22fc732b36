"""The first picture: two films of one scene, one above the other."""

from pathlib import Path

import numpy as np
from PIL import Image

from mechsearch_jax.benchmarks.lab.site.first_picture import OUT, POLICIES, SCENE, both
from mechsearch_jax.commands.options import find_scenario

ROOT = Path(__file__).parents[1]


class Shades:
    """A film of grey pictures."""

    def __init__(self, *shades):
        self.size, self._shades = (160, 20), shades

    def __iter__(self):
        return (np.full((20, 160, 3), shade, np.uint8) for shade in self._shades)


def test_the_shorter_film_stands_still_at_its_end():
    pictures = list(both([Shades(10, 20, 30), Shades(40)], ["first", "second"]))
    assert len(pictures) == 3
    strip = (len(pictures[0]) - 40) // 2
    assert [(int(p[strip, 0, 0]), int(p[-1, 0, 0])) for p in pictures] == [(10, 40), (20, 40), (30, 40)]
    assert all(len(picture) % 2 == 0 for picture in pictures)
    assert (pictures[0][:strip] != pictures[0][strip + 20 : 2 * strip + 20]).any()


def test_the_picture_is_there_and_moves():
    find_scenario(SCENE)
    assert "search-for-grasp" in POLICIES
    with Image.open(ROOT / OUT) as picture:
        assert picture.n_frames > 40
        assert picture.height > picture.width / 2
