"""Writes docs/gallery, a page for each declared episode: `python -m mechsearch_jax.benchmarks.lab.site.gallery`.

The episodes are declared in `gallery.toml` beside this file. Each is searched as a user would search it; its page is
what `mechsearch view --save` writes. `index.md` lists those whose pages are there, and how each of them ended.
"""

from __future__ import annotations

import argparse
import dataclasses
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path

import jinja2

from mechsearch_jax.envs.recording.recording import NAME
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, read_text, replacing

DECLARED = Path(__file__).with_name("gallery.toml")
OUT = Path("docs/gallery")
# Largest page, and all pages together [bytes].
LARGEST, ALL = 800_000, 2_000_000
_INDEX = Path(__file__).with_name("gallery_index.md.jinja")
_PROGRAM = (sys.executable, "-m", "mechsearch_jax.commands.main")
_ENDED = re.compile(r"<title>[^:<]*: ([^<]*)</title>")


@dataclasses.dataclass(frozen=True)
class Shown:
    """An episode of the gallery.

    Attributes:
      name: of its page's file.
      title: of the episode.
      shows: what to look at, in one line.
      search: the arguments of `mechsearch search`, without the folder.
    """

    name: str
    title: str
    shows: str
    search: tuple[str, ...]


def declared(path: PathLike = DECLARED) -> list[Shown]:
    """The episodes that a file declares, in their order.

    Raises:
      InputError: the file cannot be read or declares something else.
    """
    try:
        tables = tomllib.loads(read_text(path))["episode"]
        episodes = [Shown(**{**table, "search": tuple(table["search"])}) for table in tables]
    except (tomllib.TOMLDecodeError, KeyError, TypeError) as error:
        raise InputError(f"{path}: declares no gallery ({' '.join(str(error).split())})") from error
    names = [episode.name for episode in episodes]
    if len(set(names)) < len(names) or not all(re.fullmatch(r"[a-z0-9-]+", name) for name in names):
        raise InputError(f"{path}: names are of small letters, digits and hyphens, each once; they are {names}")
    return episodes


def draw(episode: Shown, out: Path, recordings: Path) -> Path:
    """Write the page of an episode.

    Args:
      episode: which one; it is searched unless its recording is there.
      out: folder of the pages.
      recordings: folder of folders of recordings, by the episodes' names.

    Raises:
      InputError: the search fails, or the page is too large.
    """
    page, folder = out / f"{episode.name}.html", recordings / episode.name
    if not (folder / NAME).is_file():
        mechsearch("search", *episode.search, "--out", str(folder), "--record")
    with tempfile.TemporaryDirectory() as fresh:
        mechsearch("view", str(folder), "--save", str(Path(fresh) / "page.html"))
        content = (Path(fresh) / "page.html").read_bytes()
    if len(content) > LARGEST:
        raise InputError(f"{episode.name}: its page has {len(content)} bytes, more than {LARGEST}")
    with replacing(page) as file:
        file.write(content)
    return page


def mechsearch(*command: str) -> None:
    """Run a command of `mechsearch`.

    Raises:
      InputError: it fails.
    """
    if code := subprocess.run([*_PROGRAM, *command]).returncode:
        raise InputError(f"mechsearch {' '.join(command)} ended with {code}")


def index(episodes: Sequence[Shown], out: Path) -> str:
    """The page that lists those episodes whose pages are there, and how each ended."""
    there = [(episode, out / f"{episode.name}.html") for episode in episodes]
    shown = [(episode, ended(page)) for episode, page in there if page.is_file()]
    environment = jinja2.Environment(trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string(_INDEX.read_text(encoding="utf-8"))
    return template.render(shown=shown, declared=len(episodes)) + "\n"


def ended(page: PathLike) -> str:
    """How the episode of a page ended, by the page's title.

    Raises:
      InputError: it is no page of an episode.
    """
    match = _ENDED.search(read_text(page))
    if match is None:
        raise InputError(f"{page}: is no page of an episode; write it anew")
    return match[1]


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the pages of some episodes, or of all, and the index."""
    episodes = declared()
    parser = argparse.ArgumentParser(description=f"Search the episodes of the gallery and write their pages to {OUT}.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="episodes; all of them without")
    parser.add_argument("--index", action="store_true", help="write the index alone")
    parser.add_argument("--out", default=OUT, type=Path, help="folder of the pages")
    parser.add_argument("--recordings", type=Path, help="keep the recordings here, and use those that are there")
    given = parser.parse_args(arguments)
    if given.index and given.names:
        parser.error("--index writes the list alone; name no episodes with it")
    names = [episode.name for episode in episodes]
    if unknown := [name for name in given.names if name not in names]:
        parser.error(f"{unknown[0]} is no episode of the gallery; there are {', '.join(names)}")
    chosen = [episode for episode in episodes if not given.index and (not given.names or episode.name in given.names)]
    try:
        with tempfile.TemporaryDirectory() as fresh:
            for episode in chosen:
                print(draw(episode, given.out, given.recordings or Path(fresh)))
        with replacing(given.out / "index.md") as file:
            file.write(index(episodes, given.out).encode())
        size = sum(page.stat().st_size for page in given.out.glob("*.html"))
        if size > ALL:
            parser.error(f"{given.out}: the pages have {size} bytes together, more than {ALL}; show fewer")
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
