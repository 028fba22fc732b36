"""The guides: their links lead somewhere, their code runs, and what the source cites of them is there."""

import json
import math
import re
import statistics
from pathlib import Path

import pytest

import mechsearch_jax
from mechsearch_jax.benchmarks.guard.guard import read_reference
from mechsearch_jax.benchmarks.paper.paper_tables import BOTH, METHODS, TABLES, paper_figures
from mechsearch_jax.benchmarks.statistics.intervals import mean_interval, share_interval, wilson
from mechsearch_jax.envs.episode.earlier import EARLIER, GONE, RENAMED
from mechsearch_jax.envs.scenes.scene_sets import SETS, digest, is_chosen_on, recorded
from mechsearch_jax.planner import OPTIONS, PRESETS
from mechsearch_jax.workspace.detector import FOUND_PIXELS

ROOT = Path(__file__).parents[1]
PAGES = ["README.md", "CHANGELOG.md", *sorted(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md"))]
# Links and code may stand between backticks or in a block without meaning what they say.
BLOCK = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
# As docstrings cite a page: docs/method.md, "Existence"; a line may end anywhere in between.
CITATION = re.compile(r'(docs/\w+\.md),\s+"([^"]+)"')
SOURCE = ("mechsearch_jax", "envs", "train", "benchmarks")
# What a cell of a table says, and what follows from it.
WORDS = {"yes": True, "no": False, "true": True, "false": False}


def read(page):
    return (ROOT / page).read_text(encoding="utf-8")


def headings(page):
    return [title.strip() for title in re.findall(r"^#+ (.+)$", BLOCK.sub("", read(page)), re.MULTILINE)]


def anchors(page):
    """The fragments that GitHub gives the headings of a page."""
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in headings(page)}


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    for link in LINK.findall(BLOCK.sub("", read(page))):
        if re.match(r"\w+:", link):
            continue
        path, _, fragment = link.partition("#")
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.exists(), f"{page}: {link}"
        if fragment:
            assert fragment in anchors(target), f"{page}: {link}"


def test_citations_in_the_source_name_a_heading():
    found = 0
    for folder in SOURCE:
        for file in (ROOT / folder).rglob("*.py"):
            for page, title in CITATION.findall(file.read_text(encoding="utf-8")):
                assert title in headings(page), f"{file}: {page}, {title}"
                found += 1
    assert found > 0


def test_no_table_row_is_broken():
    for page in PAGES:
        text = BLOCK.sub("", read(page))
        for table in re.findall(r"(?:^\|.*\|$\n?)+", text, re.MULTILINE):
            widths = {len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines()}
            assert len(widths) == 1, f"{page}: {table[:80]}"
        assert not re.search(r"^\|.*[^|\s]\s*$", text, re.MULTILINE), f"{page}: a row without an end"


def rows(page, header):
    """The cells of the table with a header, without the header."""
    table = re.search(rf"^{re.escape(header)}\n\|[-|]+\|\n((?:\|.*\|\n)+)", read(page), re.MULTILINE)
    assert table, f"{page}: {header}"
    return [[cell.strip() for cell in row.strip("|").split(" | ")] for row in table[1].splitlines()]


def said(cell):
    """The value, list of angles or list of numbers in brackets that a cell begins with."""
    cell = cell.strip('`"')
    if cell.startswith("["):
        return [float(number) for number in cell.strip("[]").split()]
    if "°" in cell:
        return [math.radians(float(angle)) for angle in re.findall(r"(-?[\d.]+)°", cell)]
    word = re.match(r"[\w.-]+", cell)[0]
    return WORDS.get(word.lower(), float(word) if word[0].isdigit() else word)


@pytest.mark.parametrize("page", [page for page in PAGES if page.startswith("docs/")])
def test_files_that_a_page_names_are_there(page):
    for path in re.findall(r"`([\w/]+\.py)`", read(page)):
        assert any((ROOT / folder / path).is_file() for folder in ("", *SOURCE)), f"{page}: {path}"


def test_what_the_python_guide_names_of_modules_is_there():
    package, found = ROOT / "mechsearch_jax", 0
    rooms = {path.stem for path in package.iterdir()} | set(SOURCE)
    for path, name in re.findall(r"`(?:mechsearch_jax\.)?((?:\w+\.)+)(\w+)[`(]", read("docs/python.md")):
        folders = [folder for folder in path.strip(".").split(".") if folder != "mechsearch_jax"]
        if folders and folders[0] in rooms:
            places = [root.joinpath(*folders) for root in (package, ROOT)]
            modules = [file for place in places for file in (place.with_suffix(".py"), place / "__init__.py")]
            text = "\n".join(file.read_text(encoding="utf-8") for file in modules if file.is_file())
            within = any((place / name).is_dir() or (place / f"{name}.py").is_file() for place in places)
            assert within or re.search(rf'^(def|class) {name}\b|^    "{name}",$', text, re.MULTILINE), (path, name)
            found += 1
    assert found > 15


def test_the_python_guide_names_all_of_the_front_door():
    guide = read("docs/python.md")
    assert f"gives the {len(mechsearch_jax.__all__)} names" in guide
    for name in mechsearch_jax.__all__:
        assert re.search(rf"`(?:[^`]*\W)?{name}\b", guide), name


def test_old_names_are_what_is_read():
    page = "docs/results.md"
    renamed = [(old.strip("`"), new.strip("`")) for old, new in rows(page, "| then | now |")]
    assert dict(pair for pair in renamed if " " not in pair[0]) == RENAMED
    missing = {name.strip("`"): said(value) for name, value in rows(page, "| option | value then |")}
    assert missing == {
        name: pytest.approx(value) if isinstance(value, list) else value for name, value in EARLIER.items()
    }
    assert {name.strip("`"): said(value) for name, value in rows(page, "| option | value of today |")} == GONE


def test_the_options_of_the_command_line_are_all_there_with_their_defaults():
    table = rows("docs/commands.md", "| option | what it sets | `standard` | `paper` |")
    told = {re.match(r"`--([\w-]+)", row[0])[1].replace("-", "_"): row[2:] for row in table}
    assert {option.name for option in OPTIONS} == set(told) - {"preset", "recognition", "simulator", "protocol"}
    for name, cells in told.items():
        for preset, cell in zip(("standard", "paper"), cells, strict=False):
            value = PRESETS[preset]().options().get(name)
            if value is not None and name not in ("actions", "push_distances"):
                assert said(cell) == (pytest.approx(value) if isinstance(value, list) else value), f"{name}: {cell}"


def test_the_scene_sets_are_those_that_there_are():
    told = {row[0].strip("`"): row[1:] for row in rows("docs/method.md", "| set | scenes | what | seeds | digest |")}
    whole = [scene_set for scene_set in SETS.values() if scene_set.about]
    assert list(told) == [scene_set.name for scene_set in whole]
    for scene_set in whole:
        scenes, _, seeds, digest_told = told[scene_set.name]
        first, last = map(int, seeds.split(" to "))
        assert int(re.match(r"\d+", scenes)[0]) == scene_set.scenes
        assert {(b.first_seed, b.first_seed + b.scenes - 1) for b in scene_set.blocks} == {(first, last)}
        assert digest_told == digest(scene_set)
        counts = re.search(r"(\d+) each with ([\d, ]+) objects", scenes)
        if counts:
            each = [(int(counts[1]), int(objects)) for objects in counts[2].split(", ")]
            assert each == [(b.scenes, b.objects) for b in scene_set.blocks]


def test_the_table_of_scenes_is_the_stored_result():
    stored = json.loads((ROOT / "benchmarks/results/scenes-cpu.json").read_text())
    told = {
        (row[0].strip("`"), row[1]): row[2:]
        for row in rows(
            "docs/results.md",
            "| set | objects | scenes | size of f | targets with 0, 1 to 100, more pixels | share of the target seen "
            "| objects seen (100 pixels or more) | share of each object seen |",
        )
    }
    lines = {(line["source"], str(line["objects"])): line for line in stored["summary"]}
    assert told.keys() == lines.keys()
    for key, line in lines.items():
        scenes, possible, targets, target_share, visible, objects_share = told[key]
        assert int(scenes) == line["scenes"]
        assert possible.startswith(f"{line['possible_mean']:.0f} ± {line['possible_standard_error']:.0f}")
        counts = [line[f"target_{name}"] for name in ("hidden", "below_threshold", "found")]
        assert [int(count) for count in targets.split(", ")] == counts
        assert target_share == f"{line['target_share_mean']:.3f}"
        assert visible == f"{line['visible_mean']:.2f}"
        assert objects_share.startswith(f"{line['objects_share_mean']:.2f} ± ")
    scenes = [dict(zip(stored["columns"], row, strict=True)) for row in stored["rows"]]
    in_sight = {(row["scenario"], str(row["target_pixels"])) for row in scenes if row["target_pixels"] > FOUND_PIXELS}
    assert set(re.findall(r"`(published-\d-\d\d)` \((\d+)\)", read("docs/results.md"))) == in_sight


def stored_runs(name):
    """The runs of a stored result, whose episodes are by the names of their columns."""
    stored = json.loads((ROOT / "benchmarks/results" / name).read_text())
    return [
        run | {"episodes": [dict(zip(stored["columns"], row, strict=True)) for row in run["episodes"]]}
        for run in stored["runs"]
    ]


# What a table calls the shares that it tells, and how often it was so in some episodes.
RATES = {
    "found": lambda e: e["found_step"] is not None,
    "graspable": lambda e: e["graspable_step"] is not None,
    "retrieved": lambda e: e["retrieved"],
    "left": lambda e: e["objects_fallen"],
    "fell": lambda e: (e["failure"] or "").startswith("the target fell"),
    "held": lambda e: e["held_up"],
    "ruled out": lambda e: e["truth_lost"],
}


def share(name, episodes, digits):
    return f"{sum(bool(RATES[name](episode)) for episode in episodes) / len(episodes):.{digits}f}"


def share_of_graspable(episodes):
    """As a table has it that keeps graspable and retrieved apart: "–" where an episode does not."""
    apart = all(episode.get("graspable_known") for episode in episodes)
    return share("graspable", episodes, 2) if apart else "–"


def with_interval(name, episodes):
    reached = [bool(RATES[name](episode)) for episode in episodes]
    low, high = share_interval(reached, [episode["scenario"] for episode in episodes])
    return f"{share(name, episodes, 2)} ({low:.2f} to {high:.2f})"


def mean_steps(episodes):
    return f"{sum(episode['steps'] or 0 for episode in episodes) / len(episodes):.1f}"


def with_objects(episodes, count):
    return [episode for episode in episodes if episode["scenario"].split("-")[1] == count]


def new_scenes(episodes):
    """Those of `c2` that nothing was chosen on."""
    return [e for e in episodes if e["scenario"].startswith("c2-") and not is_chosen_on(e["scenario"])]


def test_the_rates_of_the_readme_are_the_stored_ones():
    published = [
        episode for name in ("standard-cpu.json", "standard-h200.json") for episode in stored_runs(name)[0]["episodes"]
    ]
    new = new_scenes(stored_runs("standard-h200.json")[1]["episodes"])
    columns = [f"{scenes} episodes: found | graspable | retrieved" for scenes in ("published, 150", "new, 90")]
    header = f"| objects | {' | '.join(columns)} |"
    told = {row[0]: row[1:] for row in rows("README.md", header)}
    assert list(told) == ["2", "4", "6", "8"]
    for objects, figures in told.items():
        groups = [with_objects(each, objects) for each in (published, new)]
        assert list(map(len, groups)) == [150, 90]
        parts = [
            (share("found", each, 2), share_of_graspable(each), with_interval("retrieved", each)) for each in groups
        ]
        assert figures == [*parts[0], *parts[1]]
        assert all(is_chosen_on(episode["scenario"]) for episode in groups[0])


# Of its O-Search-for-Grasp.
PAPER = {objects: paper_figures(TABLES["table1"], "oracle", METHODS[1], BOTH, int(objects)) for objects in "2468"}


def test_preset_paper_stands_beside_the_papers_figures():
    run = stored_runs("published-paper-h200.json")[0]
    assert (run["preset"], run["policy"]) == ("paper", "search-for-grasp")
    # A retrieval did not count as graspable yet.
    assert "rehearsal" not in run["configuration"]
    header = "| objects | preset `paper`: found | graspable | retrieved | the paper: found | graspable |"
    told = rows("README.md", header)
    assert [objects for objects, *_ in told] == ["2", "4", "6", "8"]
    for objects, *figures in told:
        episodes = with_objects(run["episodes"], objects)
        ours = [share(rate, episodes, 2) for rate in ("found", "graspable", "retrieved")]
        assert figures == [*ours, f"{PAPER[objects].find:.2f}", f"{PAPER[objects].grasp:.2f}"]


def stored_median(name):
    stored = json.loads((ROOT / "benchmarks/results" / name).read_text())
    return (stored["runs"][0] if "runs" in stored else stored)["median_seconds"]


def test_the_times_of_a_decision_are_the_stored_ones():
    readme = " ".join(read("README.md").split())
    runs = json.loads(read("benchmarks/results/plan-batch-h100.json"))["runs"]
    (alone,) = [1000 * run["median_seconds"] for run in runs if (run["code"], run["batch"]) == ("after", 1)]
    assert f"A decision takes [{alone:.0f} ms on one H100](benchmarks/results/plan-batch-h100.json)" in readme
    # With what is tried out.
    for file in (ROOT / "benchmarks/results").glob("plan-rehearsal-*.json"):
        assert f"[{1000 * stored_median(file.name):.0f} ms on" in readme
        assert f"](benchmarks/results/{file.name})" in readme


def test_what_came_of_searches_in_a_cell_is_what_is_stored():
    stored = json.loads(read("benchmarks/results/cell-cpu.json"))
    rows = stored["rows"]
    low, high = wilson(sum(row["retrieved"] for row in rows), len(rows))
    counts = (
        len(rows),
        sum(row["found_step"] is not None for row in rows),
        sum(row["retrieved"] for row in rows),
        f"{low:.2f} to {high:.2f}",
        *(sum(row[name] for row in rows) for name in ("motions", "failed", "phantoms")),
        sum(row["error"] is not None for row in rows),
    )
    assert "| " + " | ".join(map(str, counts)) + " |" in read("docs/results.md")
    assert f"took [{counts[2]} of {len(rows)} hidden targets out](" in " ".join(read("README.md").split())
    assert stored["config"] == read("benchmarks/parts/cells/other-cell.toml")


def test_the_guard_is_paired_with_what_it_replaced_as_the_page_says():
    before, after = (read_reference(ROOT / f"benchmarks/results/guard-{name}.json") for name in ("before-cpu", "cpu"))
    pairs = {one.episode: one.retrieved for one in before.outcomes}
    changes = [(pairs[one.episode], one.retrieved) for one in after.outcomes]
    assert (len(changes), changes.count((False, True)), changes.count((True, False))) == (160, 2, 0)
    assert "two of 160 episodes are retrieved that were not, and none the other way" in read("docs/commands.md")


def test_scenes_that_nothing_was_chosen_on_are_told_apart():
    new, page = new_scenes(stored_runs("standard-h200.json")[1]["episodes"]), " ".join(read("docs/results.md").split())
    groups = [with_objects(new, objects) for objects in "2468"]
    found = ", ".join(share("found", each, 2) for each in groups)
    retrieved = ", ".join(with_interval("retrieved", each) for each in groups)
    scenes = "numbers 090 to 179 of `c2`, 90 episodes each, with 2, 4, 6 and 8 objects (95% intervals)"
    assert f"{scenes}: found {found}, retrieved {retrieved}." in page
    assert set(map(len, groups)) == {90}


def header_above(page, row):
    """The header of the table that a row is in."""
    return re.findall(r"^(\|.*\|)\n\|[-|]+\|$", page[: page.index(row)], re.MULTILINE)[-1]


def counts_retrievals(run):
    """Whether the graspable step of a run's episodes may be that of the retrieval."""
    return not all(episode.get("graspable_known") for episode in run["episodes"])


@pytest.mark.parametrize(
    ("name", "labels"),
    [
        ("rehearsal-h200.json", ["published", "`c2`", "`c2`, nothing rehearsed"]),
        ("standard-cpu.json", ["published, C MuJoCo"]),
        ("standard-h100.json", ["`c2`, b62958a", "`c2`, f86e8f8", "`c2`, 8787b53", "published, 8787b53"]),
        (
            "standard-h200.json",
            [
                "published",
                "`c2`",
                "published, `--preset best`, 20 actions",
                "published, `--recognition masks`",
                "published, `--recognition full`",
            ],
        ),
    ],
)
def test_the_rates_of_the_results_by_number_of_objects_are_the_stored_ones(name, labels):
    page = read("docs/results.md")
    for run, label in zip(stored_runs(name), labels, strict=True):
        for objects in "2468":
            episodes = with_objects(run["episodes"], objects)
            rates = [share(rate, episodes, 2) for rate in ("found", "graspable", "retrieved")]
            rest = [share(rate, episodes, n) for rate, n in (("left", 3), ("fell", 3), ("held", 2), ("ruled out", 3))]
            cells = [label, objects, str(len(episodes)), *rates, *rest, mean_steps(episodes)]
            line = f"| {' | '.join(cells)} |"
            assert line in page
            assert ("| graspable or retrieved |" in header_above(page, line)) == counts_retrievals(run)


def by_scene(*runs):
    """The share of a scene's episodes in which the target was retrieved."""
    scenes = {}
    for episode in (episode for run in runs for episode in run["episodes"]):
        scenes.setdefault(episode["scenario"], []).append(bool(episode["retrieved"]))
    return {scene: statistics.fmean(values) for scene, values in scenes.items()}


def test_what_the_rebuilt_engine_loses_is_what_is_stored():
    *c2, published = stored_runs("standard-h100.json")
    pairs = (c2, stored_runs("standard-h200.json")[1:2]), ([published], stored_runs("standard-cpu.json"))
    differences = []
    for after, before in pairs:
        now, then = by_scene(*after), by_scene(*before)
        assert set(now) == set(then)
        changes = [100 * (now[scene] - then[scene]) for scene in now]
        low, high = mean_interval(changes, list(now))
        assert low > -2.0
        differences.append([round(value, 1) + 0.0 for value in (statistics.fmean(changes), low, high)])
    page = " ".join(read("docs/results.md").split())
    (one, low, high), (other, least, most) = differences
    assert f"three runs against one, {one:.1f} ({low:+.1f} to {high:+.1f}) points" in page
    assert f"the native simulator, {other:+.1f} ({least:+.1f} to {most:+.1f})." in page
    clock = c2[0]["clock"]["nothing kept"]
    ready, last = clock["all compiled [s]"], clock["last episode [s]"]
    assert f"compiled after {ready:.0f} s, and the last of 720 episodes ended {last - ready:.0f} s after that" in page
    seconds, actions = c2[0]["seconds"], sum(episode["steps"] for episode in c2[0]["episodes"])
    assert (
        f"{seconds['planning']:.0f} went into looking, planning and trying out, and {seconds['simulation']:.0f}" in page
    )
    assert f"{actions:,} actions: {1000 * seconds['planning'] / actions:.0f} ms each" in page


def test_the_rates_of_the_experiments_are_the_stored_ones():
    page = read("docs/results.md")
    for run in stored_runs("first-draws-h200.json"):
        shares = [(rate, 2) for rate in ("found", "graspable", "retrieved", "left")]
        cells = [share(rate, run["episodes"], n) for rate, n in (*shares, ("ruled out", 3))]
        line = f"| {' | '.join(cells)} | {mean_steps(run['episodes'])} |"
        assert line in page
        assert ("| graspable or retrieved |" in header_above(page, line)) == counts_retrievals(run)
    for run in stored_runs("rehearsal-frictions-cpu.json"):
        found, retrieved, held = (share(rate, run["episodes"], 2) for rate in ("found", "retrieved", "held"))
        assert f"| {found} | {retrieved} | {held} | {mean_steps(run['episodes'])} |" in page


def points(name, pairs):
    """A difference in percentage points with its error, the seeds of a scene averaged first."""
    scenes = {}
    for one, other in pairs:
        before = {(episode["scenario"], episode["seed"]): bool(RATES[name](episode)) for episode in other}
        for episode in one:
            if (pair := (episode["scenario"], episode["seed"])) in before:
                scenes.setdefault(episode["scenario"], []).append(bool(RATES[name](episode)) - before[pair])
    means = [statistics.fmean(values) for values in scenes.values()]
    mean = round(100 * statistics.fmean(means), 1)
    told = f"{mean:+.1f}" if mean else "0.0"
    return f"{told} ± {100 * statistics.stdev(means) / math.sqrt(len(means)):.1f}"


# In words of docs/results.md: the file and the runs, by their names or places, and the rate.
DIFFERENCES = {
    "nothing was gained (found {} points": ("opened-cpu.json", [(1, 0)], "found"),
    "points, retrieved {}, [opened-cpu": ("opened-cpu.json", [(1, 0)], "retrieved"),
    "the first gains found {},": ("opened-h200.json", [("B", "C"), ("D", "E")], "found"),
    "graspable +3.6 ± 1.3, retrieved {}, and costs": ("opened-h200.json", [("B", "C"), ("D", "E")], "retrieved"),
    "that leave the board ({})": ("opened-h200.json", [("B", "C"), ("D", "E")], "left"),
    "gains nothing: found {},": ("opened-h200.json", [("B", "D"), ("C", "E")], "found"),
    "3.2 ± 1.3, retrieved {}, against": ("motion-h200.json", [("P", "Q")], "retrieved"),
    "with 8 objects: found +1.3 ± 5.6, retrieved {}.": ("rehearsal-cpu.json", [(3, 2)], "retrieved"),
    "gains found {} and retrieved 0.0": ("standard-h200.json", [(2, 0)], "found"),
    "**`masks`**: retrieved {} points": ("standard-h200.json", [(3, 0)], "retrieved"),
    "**`full`**: {}, found": ("standard-h200.json", [(4, 0)], "retrieved"),
    "the true pose {} points more often": ("standard-h200.json", [(4, 0)], "ruled out"),
    "shares on gains retrieved {},": ("draws-h200.json", [("B1", "A1"), ("B3", "A3"), ("B0", "A0")], "retrieved"),
    "at all loses retrieved {}.": ("draws-h200.json", [("A0", "A1"), ("B0", "B1")], "retrieved"),
    "passed on {} retrieved;": ("draws-cpu.json", [(3, 0)], "retrieved"),
    "none {}. The charge": ("draws-cpu.json", [(2, 0)], "retrieved"),
    "and retrieved {} points, draws of all": ("first-draws-h200.json", [("GF", "G0")], "retrieved"),
    "is opened loses retrieved {}:": ("first-draws-h200.json", [("GP", "G0")], "retrieved"),
}


@pytest.mark.parametrize("words", DIFFERENCES)
def test_differences_are_those_of_scenes(words):
    name, pairs, rate = DIFFERENCES[words]
    runs = stored_runs(name)
    known = {run.get("name"): run["episodes"] for run in runs} | {i: run["episodes"] for i, run in enumerate(runs)}
    told = points(rate, [(known[one], known[other]) for one, other in pairs])
    assert words.format(told) in " ".join(read("docs/results.md").split())


def test_stored_scenes_are_those_on_record():
    stored = json.loads((ROOT / "benchmarks/results/scenes-cpu.json").read_text())
    made = {(row[1], row[2]) for row in stored["rows"] if row[0] in SETS}
    sets = [SETS[name] for name in ("c2", "d1", "d2", "d3")]
    on_record = {
        (block.scene_name(i), content)
        for scene_set in sets
        for block in scene_set.blocks
        for i, content in enumerate(recorded()[block.name])
    }
    assert made == on_record


@pytest.mark.slow
def test_the_code_of_the_python_guide_runs():
    code = re.findall(r"^```python\n(.*?)^```$", read("docs/python.md"), re.MULTILINE | re.DOTALL)
    # Classes in it are pytrees, and look for the module that they are defined in.
    exec(compile("\n".join(code), "docs/python.md", "exec"), {"__name__": "guide"})
