"""The guides: their links lead somewhere, their code runs, and what the source cites of them is there."""

import importlib.util
import json
import math
import re
import statistics
from pathlib import Path

import pytest

import mechsearch_jax
from mechsearch_jax.benchmarks.guard.guard import read_reference
from mechsearch_jax.benchmarks.paper.paper_tables import BOTH, METHODS, TABLES, paper_figures
from mechsearch_jax.benchmarks.paper.reproduce import CONTACT
from mechsearch_jax.benchmarks.report import results_page
from mechsearch_jax.benchmarks.statistics.intervals import mean_interval, share_interval, wilson
from mechsearch_jax.benchmarks.statistics.outcomes import OUTCOMES
from mechsearch_jax.benchmarks.statistics.paired import change_of, same_episodes
from mechsearch_jax.benchmarks.statistics.settings import FROM_THE_FRONT, WITHIN_45
from mechsearch_jax.benchmarks.store import runs
from mechsearch_jax.benchmarks.store.rows import options_of
from mechsearch_jax.benchmarks.store.runs import load_run
from mechsearch_jax.benchmarks.studies import page as studies_page
from mechsearch_jax.benchmarks.studies import yardstick_page
from mechsearch_jax.benchmarks.studies.shown import shown
from mechsearch_jax.benchmarks.studies.yardstick import YARDSTICK, measure
from mechsearch_jax.envs.scenes.scene_sets import SETS, digest, is_chosen_on, recorded
from mechsearch_jax.envs.world.mismatch import ASSUMED, MISMATCH_OPTIONS
from mechsearch_jax.planner import OPTIONS, PRESETS
from mechsearch_jax.workspace.detector import FOUND_PIXELS

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks/results"
PAGES = ["README.md", "CHANGELOG.md", *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md"))]
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
    count = 0
    for folder in SOURCE:
        for file in (ROOT / folder).rglob("*.py"):
            for page, title in CITATION.findall(file.read_text(encoding="utf-8")):
                assert title in headings(page), f"{file}: {page}, {title}"
                count += 1
    assert count > 0


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


def test_what_the_python_guides_name_of_modules_is_there():
    package, count = ROOT / "mechsearch_jax", 0
    rooms = {path.stem for path in package.iterdir()} | set(SOURCE)
    guides = "\n".join(read(f"docs/{name}.md") for name in ("python", "extend", "camera"))
    for path, name in re.findall(r"`(?:mechsearch_jax\.)?((?:\w+\.)+)(\w+)[`(]", guides):
        folders = [folder for folder in path.strip(".").split(".") if folder != "mechsearch_jax"]
        if folders and folders[0] in rooms:
            places = [root.joinpath(*folders) for root in (package, ROOT)]
            modules = [file for place in places for file in (place.with_suffix(".py"), place / "__init__.py")]
            text = "\n".join(file.read_text(encoding="utf-8") for file in modules if file.is_file())
            within = any((place / name).is_dir() or (place / f"{name}.py").is_file() for place in places)
            assert within or re.search(rf'^(def|class) {name}\b|^    "{name}",$', text, re.MULTILINE), (path, name)
            count += 1
    assert count > 15


def test_the_python_guide_names_all_of_the_front_door():
    guide = read("docs/python.md")
    assert f"gives the {len(mechsearch_jax.__all__)} names" in guide
    for name in mechsearch_jax.__all__:
        assert re.search(rf"`(?:[^`]*\W)?{name}\b", guide), name


def test_the_api_pages_hold_all_of_the_front_door():
    pages = "\n".join(read(page) for page in PAGES if page.startswith("docs/api/"))
    shown = re.findall(r"^::: mechsearch_jax\.([\w.]+)\.(\w+)$", pages, re.MULTILINE)
    assert len(shown) == len(set(shown))
    assert set(mechsearch_jax._ROOMS.items()) <= {(name, room) for room, name in shown}


def test_the_options_of_the_command_line_are_all_there_with_their_defaults():
    table = rows("docs/commands.md", "| option | what it sets | `standard` | `paper` |")
    stated = {re.match(r"`--([\w-]+)", row[0])[1].replace("-", "_"): row[2:] for row in table}
    assert {option.name for option in OPTIONS} == set(stated) - {"preset", "recognition", "simulator", "protocol"}
    for name, cells in stated.items():
        for preset, cell in zip(("standard", "paper"), cells, strict=False):
            value = PRESETS[preset]().options().get(name)
            if value is not None and name not in ("actions", "push_distances"):
                # An angle is stated as a list of one.
                value = [value] if "°" in cell and not isinstance(value, list) else value
                assert said(cell) == (pytest.approx(value) if isinstance(value, list) else value), f"{name}: {cell}"


def test_what_a_simulated_world_may_differ_in_is_all_there_with_its_default():
    table = rows("docs/commands.md", "| option | what it sets | if not given |")
    stated = {name: said(row[-1]) for row in table for name in re.findall(r"--([\w-]+)`", row[0])}
    usual = {option.name.replace("_", "-"): getattr(ASSUMED, option.path[0]) for option in MISMATCH_OPTIONS}
    assert stated == usual


def test_the_scene_sets_are_those_that_there_are():
    stated = {row[0].strip("`"): row[1:] for row in rows("docs/method.md", "| set | scenes | what | seeds | digest |")}
    whole = [scene_set for scene_set in SETS.values() if scene_set.about]
    assert list(stated) == [scene_set.name for scene_set in whole]
    for scene_set in whole:
        scenes, _, seeds, digest_stated = stated[scene_set.name]
        first, last = map(int, seeds.split(" to "))
        assert int(re.match(r"\d+", scenes)[0]) == scene_set.scenes
        assert {(b.first_seed, b.first_seed + b.scenes - 1) for b in scene_set.blocks} == {(first, last)}
        assert digest_stated == digest(scene_set)
        counts = re.search(r"(\d+) each with ([\d, ]+) objects", scenes)
        if counts:
            each = [(int(counts[1]), int(objects)) for objects in counts[2].split(", ")]
            assert each == [(b.scenes, b.objects) for b in scene_set.blocks]


def test_the_results_page_is_what_its_stored_results_say():
    written = read("docs/results.md")
    assert written == results_page.page(RESULTS), f"run `python -m {results_page.__name__}`"
    assert len(written.splitlines()) <= 150


@pytest.mark.slow
@pytest.mark.always
def test_the_page_of_studies_is_what_its_stored_runs_say():
    compared = shown(runs.stored_runs(RESULTS / "runs"))
    assert read("docs/studies.md") == studies_page.page(compared), f"run `python -m {studies_page.__name__}`"
    assert {file.stem for file in (ROOT / "docs/studies").iterdir()} == set(compared)
    measured = measure(compared[YARDSTICK.study])
    assert read("docs/yardstick.md") == yardstick_page.page(measured), f"run `python -m {studies_page.__name__}`"
    assert {file.stem for file in (ROOT / "docs/yardstick").iterdir()} == set(yardstick_page.pictures(measured))


def test_every_stored_result_is_linked_from_a_guide():
    linked = {Path(link).name for page in PAGES for link in LINK.findall(read(page)) if "benchmarks/results/" in link}
    assert {file.name for file in RESULTS.glob("*.json")} - linked == set()


def test_the_log_begins_with_the_newest():
    dates = [title for title in headings("docs/experiments.md") if re.fullmatch(r"\d{4}-\d\d-\d\d", title)]
    assert dates == sorted(set(dates), reverse=True) != []


def test_what_the_log_says_of_scenes_is_what_is_stored():
    stored, log = json.loads((RESULTS / "scenes-cpu.json").read_text()), " ".join(read("docs/experiments.md").split())
    scenes = [dict(zip(stored["columns"], row, strict=True)) for row in stored["rows"]]
    in_sight = {(row["scenario"], str(row["target_pixels"])) for row in scenes if row["target_pixels"] > FOUND_PIXELS}
    assert set(re.findall(r"`(published-\d-\d\d)` \((\d+)\)", log)) == in_sight
    sizes = {
        (line["source"], line["objects"]): f"{line['possible_mean']:.0f} ± {line['possible_standard_error']:.0f}"
        for line in stored["summary"]
    }
    published, ours = ([sizes[source, objects] for objects in (2, 4, 6, 8)] for source in ("published", "c2"))
    stated = [f"{', '.join(each[:3])} and {each[3]}" for each in (published, ours)]
    assert f"f has {stated[0]} poses in the published scenes and {stated[1]} in `c2`" in log


def stored_runs(name):
    """The runs of a stored result, whose episodes are by the names of their columns."""
    stored = json.loads((ROOT / "benchmarks/results" / name).read_text())
    return [
        run | {"episodes": [dict(zip(stored["columns"], row, strict=True)) for row in run["episodes"]]}
        for run in stored["runs"]
    ]


# What a table calls the shares that it holds, and how to compute them of episodes.
RATES = {
    "found": lambda e: e["found_step"] is not None,
    "graspable": lambda e: e["graspable_step"] is not None,
    "graspable or retrieved": lambda e: e["graspable_or_retrieved_step"] is not None,
    "retrieved": lambda e: e["retrieved"],
    "left": lambda e: e["objects_fallen"],
    "fell": lambda e: (e["failure"] or "").startswith("the target fell"),
    "held": lambda e: e["held_up"],
    "ruled out": lambda e: e["truth_lost"],
    "with the paper's": lambda e: e["paper_graspable_step"] is not None,
}


def share(name, episodes, digits):
    return f"{sum(bool(RATES[name](episode)) for episode in episodes) / len(episodes):.{digits}f}"


def with_interval(name, episodes):
    reached = [bool(RATES[name](episode)) for episode in episodes]
    low, high = share_interval(reached, [episode["scenario"] for episode in episodes])
    return f"{share(name, episodes, 2)} ({low:.2f} to {high:.2f})"


# What a column of the log says of the episodes of a run, and with how many digits.
COLUMNS = {
    "found": ("found", 2),
    "graspable": ("graspable", 2),
    "graspable or retrieved": ("graspable or retrieved", 2),
    "with the paper's grasps": ("with the paper's", 2),
    "retrieved": ("retrieved", 2),
    "an object left the board": ("left", 3),
    "the target fell": ("fell", 3),
    "the arm was held up": ("held", 2),
    "f ruled out the true pose": ("ruled out", 3),
}
# Where episodes do not say it: the key of a run's own summary.
SUMMARY = {
    "an object left the board": "object_left_board",
    "the target fell": "target_tipped_or_fell",
    "the arm was held up": "held_up",
    "f ruled out the true pose": "truth_ruled_out",
    "actions": "mean_steps",
}


def cell_of(column, run):
    """What a cell of the log has to say of a run."""
    episodes = run["episodes"]
    if column == "episodes":
        return str(len(episodes))
    if column.startswith("with 2"):
        return ", ".join(
            share("retrieved", with_objects(episodes, count), 2) for count in "2468" if with_objects(episodes, count)
        )
    if column in SUMMARY and "steps" not in episodes[0]:
        digits = 1 if column == "actions" else COLUMNS[column][1]
        return f"{run['by_objects']['all'][SUMMARY[column]]:.{digits}f}"
    if column == "actions":
        return f"{sum(episode['steps'] or 0 for episode in episodes) / len(episodes):.1f}"
    return share(COLUMNS[column][0], episodes, COLUMNS[column][1])


TABLE = re.compile(r"^\| run of `([\w-]+)` \| (.*) \|\n\|[-|]+\|\n((?:\|.*\|\n)+)", re.MULTILINE)


@pytest.mark.parametrize(("name", "columns", "lines"), TABLE.findall(read("docs/experiments.md")))
def test_the_tables_of_the_log_are_the_stored_runs(name, columns, lines):
    runs = stored_runs(f"{name}.json")
    named = {str(i): run for i, run in enumerate(runs)} | {run["name"]: run for run in runs if "name" in run}
    for line in lines.splitlines():
        label, *cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        run = named[re.match(r"`([^`]+)`", label)[1]]
        assert cells == [cell_of(column, run) for column in columns.split(" | ")], f"{name}: {label}"


def with_objects(episodes, count):
    return [episode for episode in episodes if episode["scenario"].split("-")[1] == count]


def new_scenes(episodes):
    """Those of `c2` that nothing was chosen on."""
    return [e for e in episodes if e["scenario"].startswith("c2-") and not is_chosen_on(e["scenario"])]


def unseen_line(run, objects, preset="standard", **settings):
    """What the default, or one before, with such settings comes to on scenes of a run that nothing was chosen on."""
    (line,) = (
        line for line in run.lines if (line["preset"], line["settings"], line["objects"]) == (preset, settings, objects)
    )
    return line["on_scenes_not_chosen_on"]


def test_the_rates_of_the_readme_are_the_stored_ones():
    run = load_run(RESULTS / "runs", "report-i-h200")
    header = " | ".join(f"{seen}: found | graspable | retrieved" for seen in ("true shapes", "`full`"))
    stated = {row[0]: row[1:] for row in rows("README.md", f"| objects | {header} |")}
    assert list(stated) == ["2", "4", "6", "8"]
    for objects, figures in stated.items():
        expected = []
        for settings in ({}, {"recognition": "full"}):
            line = unseen_line(run, int(objects), **settings)
            assert line["episodes"] == 200
            low, high = line["retrieved"]["interval"]
            expected += [f"{line[name]['rate']:.2f}" for name in ("found", "graspable")]
            expected.append(f"{line['retrieved']['rate']:.2f} ({low:.2f} to {high:.2f})")
        assert figures == expected


def test_what_comes_of_images_stands_beside_the_papers_figures():
    run, any_grasp = (load_run(RESULTS / "runs", name) for name in ("collision-free-h200", "table1-narrow-sides-h200"))
    seeds = len(run.lines[0]["seeds"])
    header = (
        f"| objects | `masks`, {90 * seeds} episodes: found | graspable | retrieved | the paper: found | graspable |"
    )
    stated = {row[0]: row[1:] for row in rows("README.md", header)}
    assert list(stated) == ["2", "4", "6", "8"]
    assert f"on numbers 090 to 179 of [`c2`](docs/scene-sets/c2.md) with {seeds} seeds" in " ".join(
        read("README.md").split()
    )
    for line in run.lines:
        assert line["preset"] == FROM_THE_FRONT
        assert line["settings"] == {"recognition": "masks", CONTACT: False}
        new = line["on_scenes_not_chosen_on"]
        assert new["episodes"] == 90 * seeds
        low, high = new["graspable"]["interval"]
        graspable = f"{new['graspable']['rate']:.2f} ({low:.2f} to {high:.2f})"
        figures = paper_figures(TABLES["table1"], "masks", METHODS[1], BOTH, line["objects"])
        paper = [f"{figures.find:.2f}", f"{figures.grasp:.2f}"]
        ours = [f"{new['found']['rate']:.2f}", graspable, f"{new['retrieved']['rate']:.2f}"]
        assert stated[str(line["objects"])] == [*ours, *paper]
        # Of every cell all of ours are above the paper's, on all scenes of the set, too.
        for shares in (line, new, unseen_line(any_grasp, line["objects"], WITHIN_45, recognition="masks")):
            assert shares["found"]["rate"] > figures.find
            assert shares["retrieved"]["rate"] > figures.grasp
        assert min(line["graspable"]["rate"], new["graspable"]["rate"]) > figures.grasp
    *first, last = (
        f"{unseen_line(any_grasp, count, WITHIN_45, recognition='masks')['retrieved']['rate']:.2f}"
        for count in (2, 4, 6, 8)
    )
    retrieved = f"{', '.join(first)} and {last} are retrieved by the default before the latter."
    assert f"With grasps that may brush something, as by default, and 1 seed {retrieved}" in read("README.md")


def stored_median(name):
    stored = json.loads((ROOT / "benchmarks/results" / name).read_text())
    return (stored["runs"][0] if "runs" in stored else stored)["median_seconds"]


def test_the_times_of_a_decision_are_the_stored_ones():
    readme = " ".join(read("README.md").split())
    alone = "plan-farther-sides-h200.json"
    assert f"A decision takes [{1000 * stored_median(alone):.1f} ms on one H200](benchmarks/results/{alone})" in readme
    # With what is tried out.
    files = list((ROOT / "benchmarks/results").glob("plan-farther-sides-rehearsal-*.json"))
    assert len(files) == 2
    for file in files:
        assert f"[{1000 * stored_median(file.name):.0f} ms on" in readme
        assert f"](benchmarks/results/{file.name})" in readme
    rows = load_run(RESULTS / "runs", "one-ahead-c2-h200").rows
    batch = 1000 * sum(row.planning_seconds for row in rows) / sum(row.steps for row in rows)
    assert f"{batch:.0f} ms in [a batch](docs/results.md#speed)" in readme


def test_what_grasps_from_the_side_gain_is_what_is_stored():
    today, before = (load_run(RESULTS / "runs", name).rows for name in ("report-h-h200", "report-h-before-h200"))
    change = change_of(same_episodes(today, before), OUTCOMES["retrieved"])
    assert change.pairs == len(today) == len(before) == 480
    least, most = (100 * bound for bound in change.interval)
    log = "docs/experiments.md#boxes-grasped-from-their-narrow-sides"
    gain = f"retrieves [{100 * change.mean:+.1f} points]({log}) on `report-h` ({least:+.1f} to {most:+.1f})"
    runs = (load_run(RESULTS / "runs", f"table1-{name}-h200").rows for name in ("narrow-sides", "with-friction"))
    usual = {"recognition": "oracle", "policy": "search-for-grasp"}
    after, before = ([row for row in rows if usual.items() <= vars(row).items()] for rows in runs)
    change = change_of(same_episodes(after, before), OUTCOMES["retrieved"])
    assert change.pairs == 720
    least, most = (100 * bound for bound in change.interval)
    gain += f" and {100 * change.mean:+.1f} on `c2` ({least:+.1f} to {most:+.1f})"
    after, before = (load_run(RESULTS / "runs", f"report-i-{name}").rows for name in ("h200", "before-h200"))
    change = change_of(
        same_episodes([row for row in after if row.recognition == "oracle"], before), OUTCOMES["retrieved"]
    )
    assert change.pairs == len(before) == 799
    least, most = (100 * bound for bound in change.interval)
    log = "docs/experiments.md#a-found-target-from-farther-to-the-side"
    gain += f", and a found target from farther to the side: [{100 * change.mean:+.1f} points]({log}) on `report-i`"
    gain += f" ({least:+.1f} to {most:+.1f})"
    assert gain in " ".join(read("README.md").split())


def test_what_images_lose_is_what_is_stored():
    readme = " ".join(read("README.md").split())
    rows = load_run(RESULTS / "runs", "report-i-h200").rows
    full, true = ([row for row in rows if row.recognition == seen] for seen in ("full", "oracle"))
    assert len(same_episodes(full, true)) == len(full) == len(true) == 800
    change, *by_count = (change_of(same_episodes(full, true, n), OUTCOMES["retrieved"]) for n in (None, 2, 4, 6, 8))
    least, most = (100 * bound for bound in change.interval)
    assert (
        f"On `report-i`, `full` retrieves [{100 * change.mean:+.1f} points](docs/results.md#from-images) against true "
        f"shapes ({least:+.1f} to {most:+.1f}), with 2, 4, 6 and 8 objects "
        f"{', '.join(f'{100 * each.mean:+.1f}' for each in by_count[:3])} and {100 * by_count[3].mean:+.1f}."
    ) in readme


def test_what_household_things_cost_is_what_is_stored():
    runs = (load_run(RESULTS / "runs", name).rows for name in ("report-household-bases-h200", "report-i-h200"))
    things, usual = ([row for row in rows if row.objects in (4, 8)] for rows in runs)
    assert len(things) == len(usual) == 800

    def lost(seen, beside, counts=(4, 8)):
        shares = [
            statistics.mean(row.retrieved for row in rows if row.recognition == name and row.objects in counts)
            for rows, name in ((usual, beside), (things, seen))
        ]
        return 100 * (shares[0] - shares[1])

    assert (
        "Among [household things](docs/experiments.md#household-things-and-other-worlds-on-whole-sets) "
        f"{lost('oracle', 'oracle'):.1f} points fewer are retrieved with true shapes, {lost('full-parts', 'full'):.1f} "
        f"from images, with 8 objects {lost('full-parts', 'full', (8,)):.1f}."
    ) in read("README.md")


def test_what_unknown_friction_and_shapes_cost_is_what_is_stored():
    readme, friction, sizes = " ".join(read("README.md").split()), ("friction_spread", "mass_spread"), ("size_spread",)

    def assumed(run):
        return [row for row in load_run(RESULTS / "runs", run).rows if row.recognition == "oracle"]

    def drawn(run):
        """The rows of a run by what is drawn in their worlds."""
        groups = {}
        for row in load_run(RESULTS / "runs", run).rows:
            spread = tuple(sorted(name.split(".")[1] for name in options_of(row) if name.endswith("_spread")))
            groups.setdefault(spread, []).append(row)
        return groups

    def costs(worlds, known, counts=(2, 4, 6, 8)):
        """Points of retrieved that each kind of world costs."""
        counted = {name: [row for row in rows if row.objects in counts] for name, rows in worlds.items()}
        changes = {name: change_of(same_episodes(rows, known), OUTCOMES["retrieved"]) for name, rows in counted.items()}
        assert all(change.pairs == 200 * len(counts) for change in changes.values())
        return {name: f"{-100 * change.mean:.1f}" for name, change in changes.items()}

    known, worlds = assumed("report-i-h200"), drawn("report-i-worlds-h200")
    today, crowded = costs(worlds, known), costs(worlds, known, (8,))
    before = costs(drawn("report-h-worlds-h200"), assumed("report-h-whole-h200"))
    log, log_before = (
        f"docs/experiments.md#{entry}"
        for entry in ("household-things-and-other-worlds-on-whole-sets", "todays-default-on-all-that-is-measured")
    )
    assert (
        f"Where friction and mass of each body are half to twice what is assumed, [{today[friction]} points "
        f"fewer]({log}) are retrieved on `report-i`, with 8 objects {crowded[friction]}; where shapes are up to 5% "
        f"off, {today[sizes]}; on `report-h`, by the default before, [{before[friction]} and {before[sizes]}, with "
        f"both {before[tuple(sorted((*friction, *sizes)))]}]({log_before})."
    ) in readme
    as_assumed, rough, off = (
        statistics.mean(row.retrieved for row in rows if row.objects == 8)
        for rows in (known, worlds[friction], worlds[sizes])
    )
    assert (
        f"half to twice that, [{rough:.2f} instead of {as_assumed:.2f} are retrieved with 8 objects]({log}) on "
        f"`report-i`, where shapes are up to 5% off {off:.2f};"
    ) in readme


def test_what_came_of_searches_in_a_cell_is_what_is_stored():
    stored = json.loads(read("benchmarks/results/cell-cpu.json"))
    rows = stored["rows"]
    retrieved = sum(row["retrieved"] for row in rows)
    low, high = wilson(retrieved, len(rows))
    moved, failed = (sum(row[name] for row in rows) for name in ("motions", "failed"))
    assert all(row["found_step"] is not None and not row["phantoms"] and row["error"] is None for row in rows)
    taken = f"{retrieved} of {len(rows)} targets were taken out ({low:.2f} to {high:.2f}), and all {len(rows)} found"
    assert f"{taken}; {failed} of {moved} motions failed" in " ".join(read("docs/experiments.md").split())
    assert stored["config"] == read("benchmarks/parts/cells/other-cell.toml")


def test_what_came_of_fifty_searches_in_a_cell_is_what_is_stored():
    stored = json.loads(read("benchmarks/results/cell-50-cpu.json"))
    rows, log = stored["rows"], " ".join(read("docs/experiments.md").split())
    retrieved, found = (sum(row["retrieved"] for row in rows), sum(row["found_step"] is not None for row in rows))
    low, high = wilson(retrieved, len(rows))
    moved, failed = (sum(row[name] for row in rows) for name in ("motions", "failed"))
    assert all(not row["phantoms"] and not row["undetected"] and row["error"] is None for row in rows)
    # No search ends without a line that says why.
    assert all(row["retrieved"] or row["idle"] for row in rows)
    taken = f"{retrieved} of {len(rows)} targets were taken out ({low:.2f} to {high:.2f}) and {found} found"
    assert f"{taken}; {failed} of {moved} motions failed" in log
    share = {
        noise: [row["retrieved"] for row in rows if round(255 * row["colour_noise"]) == noise] for noise in (0, 4, 8)
    }
    stated = ", ".join(f"{sum(share[noise])} of {len(share[noise])}" for noise in (0, 4, 8))
    assert f"With noise of 0, 4 and 8/255: {stated}." in log
    first = [row["retrieved"] for row in rows[:20]]
    assert f"{sum(first)} of the first {len(first)}" in log
    assert f"took [{retrieved} of {len(rows)} hidden targets out](" in " ".join(read("README.md").split())
    assert stored["config"] == read("benchmarks/parts/cells/other-cell.toml")


def test_what_more_grasps_came_to_in_a_cell_is_what_is_stored():
    before, after = (json.loads(read(f"benchmarks/results/cell-50{name}-cpu.json")) for name in ("", "-more-grasps"))
    log = " ".join(read("docs/experiments.md").split())
    taken = [{row["seed"] for row in stored["rows"] if row["retrieved"]} for stored in (before, after)]
    low, high = after["summary"]["retrieved_interval"]
    assert f"take {len(taken[1])} of {len(after['rows'])} out** ({low:.2f} to {high:.2f};" in log
    assert taken[0] < taken[1]
    *most, last = map(str, sorted(taken[1] - taken[0]))
    assert f"{', '.join(most)} and {last}, and all {len(taken[0])} that were taken out before" in log
    moved, failed = (sum(row[name] for row in after["rows"]) for name in ("motions", "failed"))
    assert f"{failed} of {moved} motions failed" in log
    assert after["conditions"] == before["conditions"]
    assert after["config"] == read("benchmarks/parts/cells/other-cell-more-grasps.toml")
    ahead = json.loads(read("benchmarks/results/cell-50-three-ahead-cpu.json"))
    assert ahead["config"] == after["config"] + "horizon = 3\n"
    low, high = ahead["summary"]["retrieved_interval"]
    assert f"**With `--horizon 3` as well, {ahead['summary']['retrieved']} of 50** ({low:.2f} to {high:.2f};" in log
    assert taken[1] < {row["seed"] for row in ahead["rows"] if row["retrieved"]}
    assert ahead["config"] == read("benchmarks/parts/cells/other-cell-three-ahead.toml")
    new = json.loads(read("benchmarks/results/cell-50-new-scenes-cpu.json"))
    low, high = new["summary"]["retrieved_interval"]
    assert f"On 50 new scenes {new['summary']['retrieved']} are taken out** ({low:.2f} to {high:.2f})" in log
    assert f"None of {new['summary']['motions']} motions failed" in log
    assert new["summary"]["failed_motions"] == 0


def test_what_the_log_says_of_recognition_in_episodes_is_what_is_stored():
    log = " ".join(read("docs/experiments.md").split())
    masks, full = (run["episodes"] for run in stored_runs("rehearsal-recognition-cpu.json"))
    retrieved, lost = ([share(name, each, 2) for each in (masks, full)] for name in ("retrieved", "ruled out"))
    assert f"`masks` retrieved {retrieved[0]} and `full` {retrieved[1]}," in log
    assert f"f ruled out the truth in {lost[0]} and {lost[1]};" in log
    true, before, after = (run["episodes"] for run in stored_runs("small-segments-cpu.json"))
    assert {share("retrieved", each, 2) for each in (true, before, after)} == {"0.95"}
    lost = [share("ruled out", each, 2) for each in (true, before, after)]
    assert (
        f"retrieved is 0.95 with true shapes, with `full` before and after ({points('retrieved', [(after, true)])}"
        in log
    )
    assert f"f ruled out the truth in {lost[0]}, {lost[1]} and {lost[2]}." in log


def test_the_guard_is_paired_with_what_it_replaced_as_the_page_says():
    before, after = (read_reference(ROOT / f"benchmarks/results/guard-{name}.json") for name in ("before-cpu", "cpu"))
    pairs = {one.episode: one.retrieved for one in before.outcomes}
    changes = [(pairs[one.episode], one.retrieved) for one in after.outcomes]
    assert (len(changes), changes.count((False, True)), changes.count((True, False))) == (160, 2, 0)
    assert "two of 160 episodes are retrieved that were not, and none the other way" in " ".join(
        read("docs/experiments.md").split()
    )


def test_scenes_that_nothing_was_chosen_on_are_shown_apart():
    new = new_scenes(stored_runs("standard-h200.json")[1]["episodes"])
    page = " ".join(read("docs/experiments.md").split())
    groups = [with_objects(new, objects) for objects in "2468"]
    found = ", ".join(share("found", each, 2) for each in groups)
    retrieved = ", ".join(with_interval("retrieved", each) for each in groups)
    scenes = "numbers 090 to 179 of `c2`, 90 episodes each, with 2, 4, 6 and 8 objects (95% intervals)"
    assert f"{scenes}: found {found}, retrieved {retrieved}." in page
    assert set(map(len, groups)) == {90}


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
    page = " ".join(read("docs/experiments.md").split())
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


def test_what_another_friction_costs_is_what_is_stored():
    runs = {run["name"]: run["episodes"] for run in stored_runs("rehearsal-frictions-cpu.json")}
    factors = {"0.5": "X5", "0.75": "XA5", "1.5": "XA1", "2": "X2", "3": "XA2"}
    stated = [f"{factor} {points('retrieved', [(runs[name], runs['X1'])], 0)}" for factor, name in factors.items()]
    page = " ".join(read("docs/experiments.md").split())
    assert f"Retrieved, paired with 1: {', '.join(stated)}." in page
    for factor, name in {**factors, "1": "X1"}.items():
        assert f"| `{name}` {factor} |" in page
    # Of two frictions the larger one decides.
    ends = {name: [(each["scenario"], each["retrieved"], each["steps"]) for each in runs[name]] for name in runs}
    assert (ends["XC5"], ends["XC1"]) == (ends["X1"], ends["X2"])


def points(name, pairs, digits=1):
    """A difference in percentage points with its error, the seeds of a scene averaged first."""
    scenes = {}
    for one, other in pairs:
        before = {(episode["scenario"], episode["seed"]): bool(RATES[name](episode)) for episode in other}
        for episode in one:
            if (pair := (episode["scenario"], episode["seed"])) in before:
                scenes.setdefault(episode["scenario"], []).append(bool(RATES[name](episode)) - before[pair])
    means = [statistics.fmean(values) for values in scenes.values()]
    mean = round(100 * statistics.fmean(means), digits)
    stated = f"{mean:+.{digits}f}" if mean else "0.0"
    return f"{stated} ± {100 * statistics.stdev(means) / math.sqrt(len(means)):.{digits}f}"


# In words of docs/experiments.md: the file and the runs, by their names or places, and the rate.
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
    stated = points(rate, [(known[one], known[other]) for one, other in pairs])
    assert words.format(stated) in " ".join(read("docs/experiments.md").split())


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


SEEN = {"in": "into the shelf", "left": "to the left", "roll": "about x", "pitch": "about y", "yaw": "about z"}


def test_what_recognition_tolerates_is_what_is_stored():
    stored = json.loads(read("benchmarks/results/calibration-tolerance-cpu.json"))
    parts = {}
    for offset, size, _, missing, phantoms, _ in stored["rows"]:
        unit = "°" if offset in ("roll", "pitch", "yaw") else " mm"
        parts.setdefault(SEEN.get(offset, offset), []).append(f"{size}{unit}: {missing} and {phantoms}")
    table = rows("docs/experiments.md", "| seen | by how much: missing and phantoms |")
    assert table == [[name, ", ".join(sizes)] for name, sizes in parts.items()]


def test_what_calibration_finds_is_what_is_stored():
    stored = json.loads(read("benchmarks/results/calibration-cpu.json"))
    header = "| noise, use | x [mm] | y [mm] | z [mm] | about x [degrees] | about y [degrees] | about z [degrees] |"
    lines = []
    for part in stored["summary"]:
        errors = [f"{each['median']:.3f}, {each['95th percentile']:.3f}" for each in part["errors"].values()]
        lines.append([f"{part['noise']}, {part['use']}", *errors])
    assert rows("docs/experiments.md", header) == lines
    page = " ".join(read("docs/experiments.md").split())
    usual = stored["summary"][1]
    statement = f"of {usual['without an offset']} looks without an offset {usual['false warnings']} are warned of"
    assert statement in page


def glossary():
    """The words of the glossary with what their rows say: meaning, paper, code, option."""
    lines = re.findall(r"^\| (?!word |-)(.*) \|$", read("docs/glossary.md"), re.MULTILINE)
    return {row[0]: row[1:] for row in (line.split(" | ") for line in lines)}


def test_the_code_that_the_glossary_names_is_there():
    for word, (_, _, code, _) in glossary().items():
        path = code.strip("`").replace("ms.", "")
        package, _, name = f"mechsearch_jax.{path}".rpartition(".")
        there = hasattr(importlib.import_module(package), name) or importlib.util.find_spec(f"{package}.{name}")
        assert code == "–" or there, f"{word}: {code}"


def test_the_options_that_the_glossary_names_are_there():
    commands = read("docs/commands.md")
    for word, (*_, option) in glossary().items():
        assert option == "–" or option.strip("`") in commands, f"{word}: {option}"


def test_the_glossary_says_a_word_once():
    words = [word for row in glossary() for word in row.split(", ")]
    assert len(words) == len(set(words)) > 50
