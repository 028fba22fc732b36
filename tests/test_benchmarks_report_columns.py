"""Reports by any columns: labels and their key, paired differences, intervals of steps, pages, and single episodes."""

import dataclasses
import itertools
import math
import re

import numpy as np
import pytest
from matplotlib import image

from mechsearch_jax.benchmarks.pages.pages import Heading, Paragraph, Table, as_html, as_latex, as_markdown
from mechsearch_jax.benchmarks.report import films
from mechsearch_jax.benchmarks.running.evaluate import make_jobs
from mechsearch_jax.benchmarks.running.sequential import SequentialRunner
from mechsearch_jax.benchmarks.statistics.paired import paired
from mechsearch_jax.benchmarks.statistics.rates import summarise
from mechsearch_jax.benchmarks.statistics.variants import Key, column, label_variants, natural
from mechsearch_jax.benchmarks.store.rows import EpisodeRow, configuration, options_of, write_rows
from mechsearch_jax.commands import main as cli
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.page import page
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario
from mechsearch_jax.workspace.shelf import Shelf

WON = EpisodeRow("a", 2, "cylinder", "search-for-grasp", "oracle", 0.9, 3, 30, "push", 0, 1, 2, True, 3, None, 1.5, 0.6)
LOST = dataclasses.replace(WON, found_step=None, graspable_step=None, retrieved=False, steps=10, failure="not found")


def rows_of(variants, episodes=3, lost=lambda variant, episode: False):
    """Rows of variants that differ in gamma, guidance and choice."""
    combinations = itertools.product(np.linspace(0.5, 1.0, 6).tolist(), (0.0, 0.4, 0.7, 0.9), "abcd")
    rows = []
    for i, (gamma, guided, choice) in enumerate(itertools.islice(combinations, variants)):
        options = {"gamma": gamma, "guidance": guided, "choice": choice, "push_distances": [0.1, 0.2]}
        for j in range(episodes):
            row = LOST if lost(i, j) else WON
            more = {"gamma": gamma, "configuration": configuration(options)}
            rows.append(dataclasses.replace(row, scenario=f"s{j}", objects=2 * (j % 2 + 1), **more))
    return rows


def test_labels_are_short_and_say_what_differs():
    assert dict(Key.of([WON]).short) == {"search-for-grasp": "search-for-grasp"}
    other = dataclasses.replace(WON, policy="search-and-grasp")
    assert list(Key.of([WON, other]).short.values()) == ["search-and-grasp", "search-for-grasp"]
    gammas = [dataclasses.replace(WON, gamma=gamma) for gamma in (1.0, 0.5)]
    key = Key.of(gammas)
    assert (list(key.short.values()), key.common, key.numbered) == (["gamma 0.5", "gamma 1"], "search-for-grasp", False)
    counts = Key.of([dataclasses.replace(WON, sequences=n) for n in (1000, 30, 10)])
    assert list(counts.short.values()) == ["sequences 10", "sequences 30", "sequences 1000"]
    long = Key.of([*gammas, other])
    assert long.numbered
    assert list(long.short.values()) == ["V1", "V2", "V3"]
    assert [dict(options) for options in long.options.values()][1] == {"policy": "search-for-grasp", "gamma": "0.5"}
    many = Key.of(rows_of(96))
    assert len(set(many.short.values())) == len(many.short) == 96
    assert max(map(len, many.short.values())) == 3


def test_a_variant_goes_by_its_label_or_by_what_tells_it_from_others():
    key = Key.of(rows_of(8))
    label = next(label for label, short in key.short.items() if short == "V4")
    assert {key.named(text) for text in ("V4", label, "guidance 0.4,choice=b".replace("-", "_"))} == {label}
    with pytest.raises(InputError, match=r'variant "choice=b" is one of several: V3'):
        key.named("choice=b")
    with pytest.raises(InputError, match=r'variant "V9" is unknown: V1 .*; \.\.\.$'):
        key.named("V9")


def test_numbers_in_texts_sort_as_numbers():
    texts = ["b 10", "b 9", "b 1.5", "a 30", "b", "b 1e-05"]
    assert sorted(texts, key=natural) == ["a 30", "b", "b 1e-05", "b 1.5", "b 9", "b 10"]
    assert sorted([None, 3, "x", 2.5, True], key=natural) == [True, 2.5, 3, "x", None]


def test_rates_are_grouped_by_any_columns():
    rows = rows_of(8, lost=lambda variant, episode: variant < 4 and episode == 0)
    assert set(column(rows, "guidance")) == {0.0, 0.4}
    assert set(column(rows, "push_distances")) == {"0.1/0.2"}
    assert column(rows, "variant") == label_variants(rows)
    summary = summarise(rows, ["guidance", "scenario"])
    assert [(*rates.group.values(), rates.episodes, rates.found) for rates in summary] == [
        *((0.0, "s0", 4, 0.0), (0.0, "s1", 4, 1.0), (0.0, "s2", 4, 1.0), (0.0, None, 12, 8 / 12)),
        *((0.4, "s0", 4, 1.0), (0.4, "s1", 4, 1.0), (0.4, "s2", 4, 1.0), (0.4, None, 12, 1.0)),
    ]
    assert [rates.group for rates in summarise(rows, ["seed"])] == [{"seed": 0}, {"seed": None}]
    with pytest.raises(InputError, match=r"column gama is unknown; did you mean gamma\?"):
        summarise(rows, ["gama"])


def test_steps_have_an_interval_from_drawing_scenes_again():
    second = dataclasses.replace(WON, scenario="b", steps=5, found_step=4)
    (rates, _) = summarise([WON, second, LOST], ["seed"])
    assert (rates.found_steps, rates.graspable_steps, rates.retrieved_steps) == (2.5, 2.0, 4.0)
    assert rates.retrieved_steps_interval == (3.0, 5.0)
    # Another seed of the same scene says nothing of how scenes differ.
    assert summarise([WON, dataclasses.replace(second, scenario="a")])[0].retrieved_steps_interval is None
    assert summarise([LOST])[0].found_steps_interval is None


def test_differences_are_paired():
    """The baseline loses s0, the other s1 and s2 and has s4 twice; s3 is another scene under the same name, s5 has no
    partner."""

    def rows(gamma, lost, more=()):
        names = ("s0", "s1", "s2", "s3", "s4")
        each = [(LOST if name in lost else WON, name) for name in names]
        return [
            *(dataclasses.replace(row, scenario=name, gamma=gamma, content_hash=name) for row, name in each),
            *(dataclasses.replace(row, gamma=gamma) for row in more),
        ]

    base = rows(0.9, {"s0"})
    base[3] = dataclasses.replace(base[3], content_hash="other")
    slower = dataclasses.replace(WON, scenario="s4", content_hash="s4", seed=7, steps=6)
    other = rows(0.5, {"s1", "s2"}, [slower, dataclasses.replace(WON, scenario="s5")])
    label = label_variants([*base, *other])[0]
    ((variant, goals),) = paired([*base, *other], label, ["scenario"]).items()
    values = [1.0, -1.0, -1.0, 0.0]
    assert variant == "search-for-grasp, gamma 0.5"
    retrieved = goals["retrieved"]
    assert (retrieved.pairs, retrieved.gains, retrieved.losses) == (4, 1, 2)
    assert retrieved.mean == pytest.approx(np.mean(values))
    assert retrieved.standard_error == pytest.approx(np.std(values, ddof=1) / math.sqrt(4))
    # Only s4 was retrieved by both: after 3 actions, and after 3 and 6.
    steps = goals["retrieved_steps"]
    assert (steps.pairs, steps.mean, steps.standard_error, steps.interval) == (1, 1.5, None, None)
    assert paired([*base, *other], label)[variant]["found"].pairs == 4
    with pytest.raises(InputError, match="no other variant shares seed with the baseline"):
        paired([*base, *(dataclasses.replace(row, seed=9) for row in other)], label, ["seed"])


def test_the_seeds_of_a_scene_are_no_pairs_of_their_own():
    """Three seeds of a, which all end alike, and one of b and c: three scenes, not five."""
    episodes = [*(("a", seed) for seed in range(3)), ("b", 0), ("c", 0)]
    base = [dataclasses.replace(LOST if name == "a" else WON, scenario=name, seed=seed) for name, seed in episodes]
    other = [dataclasses.replace(WON, scenario=name, seed=seed, gamma=0.5) for name, seed in episodes]
    label = label_variants([*base, *other])[0]

    def goals(base, *columns):
        return next(iter(paired([*base, *other], label, *columns).values()))

    retrieved, values = goals(base)["retrieved"], [1.0, 0.0, 0.0]
    assert (retrieved.pairs, retrieved.scenes, retrieved.gains, retrieved.losses) == (5, 3, 3, 0)
    assert retrieved.mean == pytest.approx(np.mean(values))
    assert retrieved.standard_error == pytest.approx(np.std(values, ddof=1) / math.sqrt(3))
    # Where scenes do not distinguish pairs, each of them counts.
    by_seed = goals(base, ["seed"])["retrieved"]
    assert (by_seed.pairs, by_seed.scenes, by_seed.mean) == (3, 3, pytest.approx((1 / 3 + 1 + 1) / 3))


def test_a_page_is_written_three_ways():
    long = "x" * 100
    table = Table.of(("x", "n"), [("p|q\n<r>", "0.50"), *[(long, 1)] * 99])
    parts = [Heading("A_b", 1), Paragraph("50% *of* <all>"), table, Heading("C")]
    text = re.sub(" +", " ", as_markdown(parts))
    assert text.startswith("# A_b\n\n50% *of* <all>\n\n| x | n |\n|:--")
    assert "| p\\|q <r> | 0.50 |\n" in text
    assert text.endswith(f"| {long} | 1 |\n\n## C\n")
    tex = as_latex(parts)
    assert "\\section*{A\\_b}\n\n50\\% " in tex
    assert "\\begin{longtable}{lr}\n\\toprule\nx & n \\\\\n\\midrule\n" in tex
    assert "p\\textbar{}q \\textless{}r\\textgreater{} & 0.50 \\\\\n" in tex
    page = as_html(parts, "t", {})
    assert "<p>50% <em>of</em> &lt;all&gt;</p>" in page
    assert "<td>p|q &lt;r&gt;</td>" in page
    assert page.count(long) == text.count(long) == tex.count(long) == 99


def test_the_command_reports_what_its_options_name(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    write_rows(rows_of(8, lost=lambda variant, episode: variant == 0), tmp_path / "table.parquet")
    arguments = ["report", "table.parquet", "--rows", "guidance,objects", "--curve", "guidance"]
    cli.parse([*arguments, "--baseline", "V1", "--paired", "scenario,seed", "--out", "out"])()
    said = capsys.readouterr().out
    assert "guidance objs runs found graspable paper's retrieved actions plan  act" in said
    assert re.search(r"V2\s+3 \+100\.0 ± 0\.0", said)
    assert not re.search("…", said)
    assert max(map(len, said.splitlines())) <= 100
    assert "no picture; report --films draws it" in (tmp_path / "out" / "report.md").read_text()
    with pytest.raises(InputError, match="--films are drawn into a folder; give --out"):
        cli.parse(["report", "table.parquet", "--films"])()
    with pytest.raises(InputError, match="give --baseline"):
        cli.parse(["report", "table.parquet", "--paired", "scenario"])()


def test_episodes_are_chosen_for_what_they_show():
    lost = [
        dataclasses.replace(LOST, scenario=f"l{i}", failure=f"{reason} at action {i}")
        for i, reason in enumerate(["dropped", "dropped", "fell", "dropped", "held up"])
    ]
    won = [dataclasses.replace(WON, scenario=f"w{i}", steps=steps) for i, steps in enumerate((1, 3, 3, 3, 3, 9))]
    slow = dataclasses.replace(WON, scenario="slow", planning_seconds=99.0)
    broken = dataclasses.replace(LOST, scenario="broken", failure="error: no", planning_seconds=999.0)
    rows = [*lost, *won, slow, broken]
    chosen = films.chosen(rows)
    assert chosen == films.chosen(rows[::-1])
    by_why = {
        why: [row for reason, row in chosen if reason == why] for why in (films.TYPICAL, films.LOST, films.SLOWEST)
    }
    assert [len(episodes) for episodes in by_why.values()] == [3, 3, 3]
    assert {row.steps for row in by_why[films.TYPICAL]} == {3}
    assert [row.failure.partition(" at")[0] for row in by_why[films.LOST]] == ["dropped", "fell", "held up"]
    assert by_why[films.SLOWEST][0] is slow
    assert films.chosen([broken]) == []


def test_a_method_is_what_its_options_say():
    method = Method(
        "random",
        dataclasses.replace(PRESETS["paper"](gamma=0.7, push_distances=(0.1,)), max_steps=4),
        "masks",
        workcell=Workcell(shelf=dataclasses.replace(Shelf(), back=0.75)),
    )
    actions = dataclasses.replace(method.config.problem.actions, push_tilt=0.4, placements=(16, 2))
    problem = dataclasses.replace(method.config.problem, actions=actions)
    method = dataclasses.replace(method, config=dataclasses.replace(method.config, problem=problem))
    assert Method.of_options({**method.options(), "target": "box", "simulator": "MjxSimulator"}) == method
    with pytest.raises(InputError, match=r"setting nowhere\.at is unknown"):
        Method.of_options({**method.options(), "workcell.nowhere.at": 1})


def check_evidence(step):
    """What a recorded step foresees is what the planner says."""
    foreseen = step.evidence.forecasts
    # The best two, and the best that moves another object than the best one.
    others = np.flatnonzero(step.sampled.action.object != step.sampled.action.object[0])
    assert set(foreseen.row) == {0, 1, *others[:1]}
    # J counts crowding, too.
    costs = (foreseen.existence * (2.0 - foreseen.graspability)).sum(axis=1)
    compared = step.sampled.cost[foreseen.row]
    np.testing.assert_allclose(costs, compared, rtol=0.05)
    assert (costs <= compared).all()


@pytest.mark.slow
def test_an_episode_is_replayed_from_its_row(tmp_path, monkeypatch):
    file = example_scenarios()["first-light"]
    (job,) = make_jobs([file], [Method(config=PRESETS["standard"](max_steps=1, sequences=5, horizon=1))], (3,))
    row = SequentialRunner().run(job)
    assert Method.of_options(options_of(row)).options()["max_steps"] == 1
    recordings = []
    write = page.save_page
    monkeypatch.setattr(page, "save_page", lambda shown, path: recordings.append(shown) or write(shown, path))
    assert films.replay(row, load_scenario(file), tmp_path / "film.png") == ""
    check_evidence(recordings[0].steps[0])
    assert image.imread(tmp_path / "film.png").std() > 0.05
    assert "Trials: simulated before acting" in (tmp_path / "film.html").read_text(encoding="utf-8")
    remark = films.replay(dataclasses.replace(row, steps=7), load_scenario(file), tmp_path / "film.png")
    assert remark.startswith("run again on another machine, perhaps, it ended otherwise: ")
    with pytest.raises(InputError, match="holds something else today"):
        films.replay(dataclasses.replace(row, content_hash="0"), load_scenario(file), tmp_path / "film.png")
