"""Draws docs/search.webp, the first picture: `python -m mechsearch_jax.benchmarks.lab.site.first_picture`.

One scene is searched twice, by the shipped planner and by random actions; the two films run one above the other.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mechsearch_jax.envs.recording.film import Film
from mechsearch_jax.envs.recording.recording import NAME, Recording, load_recording
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.viz import drawing
from mechsearch_jax.viz.movie import save_movie

SCENE = "development-6-017"
OUT = Path("docs/search.webp")
# The policies, and what is written above each film.
POLICIES: Mapping[str, str] = {"search-for-grasp": "search-for-grasp", "random": "random actions, the same scene"}
# Of the films: width [pixels], pictures in a second, how many times as fast as it was, and height of a title [inches].
WIDTH, FPS, SPEED, TITLE = 720, 8, 5.0, 0.3
_PROGRAM = (sys.executable, "-m", "mechsearch_jax.commands.main")

Picture = UInt8[np.ndarray, "h w 3"]


def recording_of(policy: str, recordings: Path) -> Recording:
    """The recording of the scene by a policy, which is searched unless it is there.

    Raises:
      InputError: the search fails.
    """
    folder = recordings / policy
    if not (folder / NAME).is_file():
        command = ("search", SCENE, "--policy", policy, "--out", str(folder), "--record")
        if code := subprocess.run([*_PROGRAM, *command]).returncode:
            raise InputError(f"mechsearch {' '.join(command)} ended with {code}")
    return load_recording(folder / NAME)


class Pictures(Protocol):
    """A film: its size and its pictures."""

    size: tuple[int, int]

    def __iter__(self) -> Iterator[Picture]: ...


def both(films: Sequence[Pictures], titles: Sequence[str]) -> Iterator[Picture]:
    """Pictures of films one above the other; one that has ended stands still."""
    last: list[Picture] = []
    strips = [title_strip(title, film.size[0]) for title, film in zip(titles, films, strict=True)]
    for pictures in itertools.zip_longest(*films):
        last = [new if new is not None else last[i] for i, new in enumerate(pictures)]
        yield np.concatenate([part for strip, picture in zip(strips, last, strict=True) for part in (strip, picture)])


def title_strip(text: str, width: int) -> Picture:
    """A line of text as a picture, of an even height."""
    dots = width / 8.0
    height = round(TITLE * dots / 2) * 2
    figure = Figure(figsize=(8.0, height / dots), dpi=dots, facecolor=drawing.PAPER)
    canvas = FigureCanvasAgg(figure)
    figure.text(0.01, 0.45, text, fontsize=13, weight="bold", color=drawing.ACTION, va="center")
    canvas.draw()
    return np.array(canvas.buffer_rgba())[:height, :width, :3]


def main(arguments: Sequence[str] | None = None) -> None:
    """Search the scene by both policies, and write the picture."""
    parser = argparse.ArgumentParser(description=f"Search {SCENE} by two policies, and write both films to {OUT}.")
    parser.add_argument("--out", default=OUT, type=Path, help="the picture, .webp or .mp4")
    parser.add_argument("--recordings", type=Path, help="keep the recordings here, and use those that are there")
    given = parser.parse_args(arguments)
    try:
        with tempfile.TemporaryDirectory() as fresh:
            recordings = [recording_of(policy, given.recordings or Path(fresh)) for policy in POLICIES]
        films = [Film(recording, WIDTH, FPS, SPEED) for recording in recordings]
        save_movie(both(films, list(POLICIES.values())), given.out, FPS)
    except InputError as error:
        parser.error(str(error))
    print(given.out)


if __name__ == "__main__":
    main()
