"""Writes docs/scene-sets, a page for each set: `python -m mechsearch_jax.benchmarks.lab.site.set_pages` in a checkout.

A page is the template `set_page.md.jinja` beside this file, filled with the words of `set_texts`, the declared sets,
and what stored runs ran on them. `--pictures` draws the pictures of `set_pictures`, too.
"""

from __future__ import annotations

import argparse
import functools
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from mechsearch_jax.benchmarks.lab.site.results_page import table
from mechsearch_jax.benchmarks.lab.site.set_texts import ABOUT, CLUTTER, About, sets_of
from mechsearch_jax.envs.scenes.scene_sets import SETS, Block, SceneSet, digest, is_chosen_on
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing

RESULTS = Path("benchmarks/results")
OUT = Path("docs/scene-sets")

Line = Mapping[str, Any]


def stored_lines(results: PathLike) -> list[dict[str, Any]]:
    """The lines of all stored runs: what came of a variant on the scenes of a set with a number of objects."""
    files = sorted((Path(results) / "runs").glob("*.jsonl"))
    return [json.loads(line) for file in files for line in file.read_text(encoding="utf-8").splitlines()]


def blocks_shown(scene_set: SceneSet, about: About) -> list[tuple[Block, int]]:
    """The scenes of a set's picture, as block and index."""
    by_count = {block.objects: block for block in scene_set.blocks}
    return [(by_count[objects], index) for objects, index in about.shown]


def _parts(scene_sets: Sequence[SceneSet]) -> str:
    rows = []
    for scene_set in scene_sets:
        first, last = scene_set.blocks[0], scene_set.blocks[-1]
        scenes = (block.scene_name(index) for block in scene_set.blocks for index in range(block.scenes))
        rows.append(
            [
                f"`{scene_set.name}`",
                scene_set.scenes,
                ", ".join(str(block.objects) for block in scene_set.blocks),
                first.target,
                f"{first.first_seed} to {first.first_seed + first.scenes - 1}",
                f"`{first.scene_name(0)}` to `{last.scene_name(last.scenes - 1)}`",
                sum(map(is_chosen_on, scenes)),
                digest(scene_set),
            ]
        )
    header = ("set", "scenes", "objects", "target", "seeds", "names", "settings were chosen on", "digest")
    return table(header, rows)


def _commands(name: str, about: About, scene_set: SceneSet | None) -> list[str]:
    config = f" --config {about.config}" if about.config else ""
    if scene_set is None:
        return [
            "mechsearch scenarios import Search-for-Grasp-public/exp_configs --out published",
            "mechsearch evaluate published --out rows",
        ]
    commands = [f"mechsearch evaluate {name}{config} --out rows"]
    if about.shown:
        first, index = blocks_shown(scene_set, about)[0]
        commands.append(f"mechsearch search {first.scene_name(index)}{config} --out out --video out/search.mp4")
    commands.append(f"mechsearch scenarios generate --set {name} --out scenes")
    return commands


@functools.cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    environment.filters["tick"] = lambda text: f"`{text}`"
    return environment.from_string(Path(__file__).with_name("set_page.md.jinja").read_text(encoding="utf-8"))


def _runs(name: str, lines: Iterable[Line]) -> str:
    """The links of the stored runs that ran on the sets of a page."""
    runs = sorted({line["run"] for line in lines if line["scene_set"] in sets_of(name)})
    return ", ".join(f"[{run}](../../{RESULTS}/runs/{run}.jsonl)" for run in runs)


def page(name: str, lines: Sequence[Line]) -> str:
    """The page of a set, or of several, in Markdown.

    Args:
      name: one of `ABOUT`.
      lines: of `stored_lines`.
    """
    about = ABOUT[name]
    scene_sets = [SETS[each] for each in sets_of(name) if each in SETS]
    to_run = sets_of(name)[-1]
    text = _template().render(
        name=name,
        about=about,
        picture=f"{name}.png" if about.shown else "",
        shown=[block.scene_name(index) for block, index in blocks_shown(scene_sets[0], about)] if scene_sets else [],
        parts=_parts(scene_sets) if scene_sets else "",
        commands=_commands(to_run, about, SETS.get(to_run)),
        runs=_runs(name, lines),
        paper=about.paper,
    )
    return _tidy(text)


def _tidy(text: str) -> str:
    """Text without spaces at the ends of lines, and with one empty line where there are several."""
    lines: list[str] = []
    for line in map(str.rstrip, text.splitlines()):
        if line or (lines and lines[-1]):
            lines.append(line)
    return "\n".join(lines).strip() + "\n"


def index_page() -> str:
    """The page that lists all sets, in Markdown."""
    rows = []
    for name, about in ABOUT.items():
        sets = [SETS[each] for each in sets_of(name) if each in SETS]
        counts = ", ".join(str(block.objects) for block in sets[0].blocks) if sets else "2, 4, 6, 8"
        scenes = f"{sets[0].scenes}" + (" each" if len(sets) > 1 else "") if sets else "100"
        names = [f"`{each}`" for each in sets_of(name)]
        ends = names if len(names) == 1 else [names[0], names[-1]]
        rows.append([f"[{' to '.join(ends)}]({name}.md)", about.title, scenes, counts])
    text = f"""# Scene sets

Scenes have names, and any command takes them: `mechsearch evaluate c2 --out rows` runs all of a set, `c2-4` a part,
`c2-4-017` one scene. They are made when they are first needed, from seeds.

{table(["set", "what it is", "scenes", "objects"], rows)}

Which one?

- **To try something**: `development`, as often as you like.
- **To compare with the paper**: `c2`, `d1`, `d2`, `d3`. Of `c2` report numbers 090 and up: settings were chosen on the
  others.
- **To report a change**: a new set, declared beside the sets [`report-*`](report.md) in `envs/scenes/scene_sets.py`:
  something ran on each of these. Decide what you compare before you run it.
- **To see what another shelf does**: `shelf-*`.

## How they are made

{CLUTTER}

So are all sets but `d1`, `household*` and `published`, whose pages say how they are. A page lists a set's seeds, and a
digest of what its scenes hold.

"""
    return text


def pages(results: PathLike) -> dict[str, str]:
    """All pages by the names of their files."""
    lines = stored_lines(results)
    return {"index.md": index_page(), **{f"{name}.md": page(name, lines) for name in ABOUT}}


def main(arguments: Sequence[str] | None = None) -> None:
    """Rewrite the pages, with `--pictures` the pictures, too."""
    parser = argparse.ArgumentParser(description=f"Write {OUT} from the declared scene sets and the stored runs.")
    parser.add_argument("--results", default=RESULTS, type=Path, help="folder of stored results")
    parser.add_argument("--out", default=OUT, type=Path, help="folder of the pages")
    parser.add_argument("--pictures", action="store_true", help="draw the pictures, too")
    given = parser.parse_args(arguments)
    if not (given.results / "runs").is_dir():
        parser.error(f"{given.results}: holds no runs; start it at the root of a checkout, or give --results")
    try:
        texts = pages(given.results)
    except InputError as error:
        raise SystemExit(str(error)) from error
    given.out.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        with replacing(given.out / name) as file:
            file.write(text.encode())
    if given.pictures:
        from mechsearch_jax.benchmarks.lab.site.set_pictures import draw

        for name, about in ABOUT.items():
            if about.shown:
                draw(blocks_shown(SETS[name], about), given.out / f"{name}.png")


if __name__ == "__main__":
    main()
