"""Writes docs/scene-sets, a page for each set: `python -m mechsearch_jax.benchmarks.lab.site.set_pages` in a checkout.

A page is the template `set_page.md.jinja` beside this file, filled with the words of `set_texts`, the declared sets,
and the lines of the stored runs. `--pictures` draws the pictures of `set_pictures`, too.
"""

from __future__ import annotations

import argparse
import functools
import json
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from mechsearch_jax.benchmarks.lab.site.results_page import table
from mechsearch_jax.benchmarks.lab.site.set_texts import ABOUT, CLUTTER, About, sets_of
from mechsearch_jax.benchmarks.statistics.preset_names import FORMER_STANDARDS
from mechsearch_jax.envs.scenes.scene_sets import SETS, Block, SceneSet, digest, is_chosen_on
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing

RESULTS = Path("benchmarks/results")
OUT = Path("docs/scene-sets")
MEASURES = ("retrieved", "found", "graspable")
# What variants on a set's page may differ in; others belong to studies.
SHOWN = ("policy", "recognition", "actions", "trials", "retrieval_contact")
_PRESETS = ("standard", *FORMER_STANDARDS, "paper")
_WORDS = {
    "trials=none": "without trials",
    "trials=learning": "with trials that learn the friction",
    "retrieval_contact=False": "with grasps that touch nothing",
    "retrieval_contact=True": "with grasps that may touch objects",
}

# What most runs simulated with; a label names another one.
_USUAL_SIMULATOR = "MjxSimulator"
_ROOT = Path(__file__).parents[3]

Line = Mapping[str, Any]


def stored_lines(results: PathLike) -> list[dict[str, Any]]:
    """The lines of all stored runs: what came of a variant on the scenes of a set with a number of objects."""
    files = sorted((Path(results) / "runs").glob("*.jsonl"))
    return [json.loads(line) for file in files for line in file.read_text(encoding="utf-8").splitlines()]


def blocks_shown(scene_set: SceneSet, about: About) -> list[tuple[Block, int]]:
    """The scenes of a set's picture, as block and index."""
    by_count = {block.objects: block for block in scene_set.blocks}
    return [(by_count[objects], index) for objects, index in about.shown]


def label(line: Line) -> str:
    """A variant in words: its preset, what differs from it, and the simulator where that is not the usual one."""
    settings = dict(line["settings"])
    words = [f"`{line['preset']}`"]
    words += [f"`{settings[name]}`" for name in ("policy", "recognition") if name in settings]
    if "actions" in settings:
        *kinds, last = settings["actions"]
        words.append((", ".join(kinds) + " and " if kinds else "") + f"{last} alone")
    pairs = (f"{name}={settings[name]}" for name in ("trials", "retrieval_contact") if name in settings)
    words += [_WORDS.get(pair, pair) for pair in pairs]
    if line["simulator"] != _USUAL_SIMULATOR:
        words.append(f"in `{line['simulator']}`")
    return ", ".join(words)


@functools.cache
def _own_settings(config: str) -> dict[str, Any]:
    """What a shelf's configuration file sets, by the names that the lines of stored runs have for it."""
    tables = tomllib.loads((_ROOT / config).read_text(encoding="utf-8")) if config else {}
    return {f"workcell.{table}.{key}": value for table, keys in tables.items() for key, value in keys.items()}


def is_shown(line: Line, about: About) -> bool:
    """Whether a line has a row on the page of its set: it differs in `SHOWN` alone, and in what the set's shelf is."""
    own = _own_settings(about.config)
    return all(name in SHOWN or (name in own and own[name] == value) for name, value in line["settings"].items())


def rates_of(line: Line) -> Mapping[str, Any]:
    """The rates of a line on scenes that nothing was chosen on, or on all where there are none of these."""
    unseen = line["on_scenes_not_chosen_on"]
    return unseen if unseen and unseen["episodes"] else line


def _order(line: Line) -> tuple[Any, ...]:
    preset = _PRESETS.index(line["preset"]) if line["preset"] in _PRESETS else len(_PRESETS)
    return preset, label(line), line["run"]


def _by_variant(lines: Iterable[Line]) -> dict[tuple[str, str], dict[int, Line]]:
    """Lines in the order of rows: by label and run, and then by number of objects.

    Raises:
      InputError: two lines of a run would share a cell.
    """
    variants: dict[tuple[str, str], dict[int, Line]] = {}
    for line in sorted(lines, key=_order):
        by_count = variants.setdefault((label(line), line["run"]), {})
        if line["objects"] in by_count:
            raise InputError(
                f"{RESULTS}/runs/{line['run']}.jsonl: two lines with {line['objects']} objects read {label(line)!r}; "
                "let `label` in benchmarks/lab/site/set_pages.py say what tells them apart"
            )
        by_count[line["objects"]] = line
    return variants


def rate_tables(lines: Sequence[Line]) -> dict[str, str]:
    """By measure a table of shares, with a row for each variant of each run and a column for each number of objects.

    Raises:
      InputError: two lines of a run would share a cell.
    """
    counts = sorted({line["objects"] for line in lines})
    variants = _by_variant(lines)
    tables = {}
    for measure in MEASURES:
        rows = [
            [name, sum(rates_of(line)["episodes"] for line in by_count.values())]
            + [_cell(by_count.get(count), measure) for count in counts]
            + [f"[{run}](../../{RESULTS}/runs/{run}.jsonl)"]
            for (name, run), by_count in variants.items()
            if any(rates_of(line)[measure] for line in by_count.values())
        ]
        if rows:
            tables[measure.capitalize()] = table(["variant", "episodes", *map(str, counts), "run"], rows)
    return tables


def _cell(line: Line | None, measure: str) -> str:
    rate = rates_of(line)[measure] if line else None
    if rate is None:
        return "–"
    low, high = rate["interval"]
    return f"{rate['rate']:.2f} ({low:.2f} to {high:.2f})"


def _parts(scene_sets: Sequence[SceneSet]) -> str:
    rows = []
    for block in (block for scene_set in scene_sets for block in scene_set.blocks):
        seeds = f"{block.first_seed} to {block.first_seed + block.scenes - 1}"
        chosen = sum(is_chosen_on(block.scene_name(index)) for index in range(block.scenes))
        ends = f"`{block.scene_name(0)}` to `{block.scene_name(block.scenes - 1)}`"
        rows.append([f"`{block.name}`", block.scenes, block.objects, block.target, seeds, ends, chosen])
    return table(["part", "scenes", "objects", "target", "seeds", "names", "settings were chosen on"], rows)


def _digests(scene_sets: Sequence[SceneSet]) -> str:
    if len(scene_sets) == 1:
        return f"The digest of what they hold is {digest(scene_sets[0])}."
    return "Digests of what they hold: " + ", ".join(f"`{each.name}` {digest(each)}" for each in scene_sets) + "."


def _starts(results: PathLike, name: str) -> str:
    """What the scenes of a set are like before the first action; empty where nobody measured it."""
    summary = json.loads((Path(results) / "scenes-start-cpu.json").read_bytes())["summary"]
    rows = [
        [
            each["objects"],
            f"{each['possible_mean']:.0f} ± {each['possible_standard_error']:.0f}",
            f"{each['possible_share']:.1%}",
            f"{each['visible_mean']:.1f}",
            f"{each['target_hidden']} of {each['scenes']}",
        ]
        for each in summary
        if each["source"] == name
    ]
    header = ["objects", "poses where f = 1", "share of all poses", "objects in sight", "target shows no pixel"]
    return table(header, rows) if rows else ""


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


def _rates(name: str, lines: Iterable[Line], about: About) -> dict[str, Any]:
    """What came of the stored runs on a set, for the template: tables, their scope, and where other variants are."""
    of_set = [line for line in lines if line["scene_set"] == name]
    shown = [line for line in of_set if is_shown(line, about)]
    partly = any(0 < line["scenes_chosen_on"] < line["scenes"] for line in shown)
    others = sorted({line["run"] for line in of_set if not is_shown(line, about)})
    links = ", ".join(f"[{run}](../../{RESULTS}/runs/{run}.jsonl)" for run in others)
    where = "[log](../experiments.md)"
    return {
        "tables": rate_tables(shown),
        "scope": "Shares are of episodes on scenes that nothing was chosen on." if partly else "",
        "others": f"Other variants ran on it in {links}: {where}." if others else "",
    }


def page(name: str, lines: Sequence[Line], results: PathLike) -> str:
    """The page of a set, or of several, in Markdown.

    Args:
      name: one of `ABOUT`.
      lines: of `stored_lines`.
      results: folder of stored results.

    Raises:
      InputError: two lines of a run would share a cell of a table.
    """
    about = ABOUT[name]
    scene_sets = [SETS[each] for each in sets_of(name) if each in SETS]
    rates = {each: _rates(each, lines, about) for each in sets_of(name)}
    used = {line["scene_set"] for line in lines}
    to_run = next((each for each in about.sets if each not in used), sets_of(name)[0])
    text = _template().render(
        name=name,
        about=about,
        picture=f"{name}.png" if about.shown else "",
        shown=[block.scene_name(index) for block, index in blocks_shown(scene_sets[0], about)] if scene_sets else [],
        parts=_parts(scene_sets) if scene_sets else "",
        digests=_digests(scene_sets) if scene_sets else "",
        starts=_starts(results, name),
        commands=_commands(to_run, about, SETS.get(to_run)),
        rates=rates,
        scope=f"The paper's {about.paper}; [beside its figures](../reproduction.md)." if about.paper else "",
    )
    return _tidy(text)


def _tidy(text: str) -> str:
    """Text without spaces at the ends of lines, and with one empty line where there are several."""
    lines: list[str] = []
    for line in map(str.rstrip, text.splitlines()):
        if line or (lines and lines[-1]):
            lines.append(line)
    return "\n".join(lines).strip() + "\n"


def _unused(lines: Iterable[Line]) -> str:
    """Which of the sets to report with nothing ran on yet, as a sentence; where there is none, what to do instead."""
    used = {line["scene_set"] for line in lines}
    left = [f"`{name}`" for name in sets_of("report") if name not in used]
    if left:
        return f"of the sets [`report-*`](report.md) one that nothing ran on yet: {', '.join(left)}."
    return (
        "a new set, declared beside the sets [`report-*`](report.md) in `envs/scenes/scene_sets.py`, for something ran "
        "on each of these."
    )


def index_page(lines: Sequence[Line]) -> str:
    """The page that lists all sets, in Markdown."""
    rows = []
    for page_name, about in ABOUT.items():
        for name in sets_of(page_name):
            scene_set = SETS.get(name)
            counts = ", ".join(str(block.objects) for block in scene_set.blocks) if scene_set else "2, 4, 6, 8"
            scenes = scene_set.scenes if scene_set else 100
            runs = len({line["run"] for line in lines if line["scene_set"] == name})
            rows.append([f"[`{name}`]({page_name}.md)", about.title, scenes, counts, runs or "–"])
    text = f"""# Scene sets

Scenes have names, and any command takes them: `mechsearch evaluate c2 --out rows` runs all of a set, `c2-4` a part,
`c2-4-017` one scene. They are made when they are first needed, from seeds. [How they are made and
kept](../method.md#scene-sets).

{table(["set", "what it is", "scenes", "objects", "stored runs"], rows)}

Which one?

- **To try something**: `development`, as often as you like.
- **To compare with the paper**: `c2`, `d1`, `d2`, `d3`. Of `c2` report numbers 090 and up: settings were chosen on the
  others.
- **To report a change**: {_unused(lines)} Decide what you compare before you run it.
- **To see what another shelf does**: `shelf-*`.

## How they are made

{CLUTTER}

So are all sets but `d1`, `household*` and `published`, whose pages say how they are. A page lists a set's seeds, and a
digest of what its scenes hold.

## How to read the rates

Every row on a set's page is a variant of a [stored run](../commands.md#stored-runs): a preset and what differs from it,
which has search-for-grasp, true shapes and the simulator
`{_USUAL_SIMULATOR}` where it does not say otherwise. Columns are numbers of objects. A cell is a share of episodes,
with a 95% interval that knows that [seeds of a scene are alike](../commands.md#reports). [What the words
mean](../method.md#verdicts).

## Write these pages anew

`python -m mechsearch_jax.benchmarks.lab.site.set_pages` writes these pages from the declared sets and the stored runs,
with `--pictures` the pictures too.
"""
    return text


def pages(results: PathLike) -> dict[str, str]:
    """All pages by the names of their files."""
    lines = stored_lines(results)
    return {"index.md": index_page(lines), **{f"{name}.md": page(name, lines, results) for name in ABOUT}}


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
