"""What all experiments cost: the page is what its generator gives, and counts the episodes that commands would run."""

import sys
from pathlib import Path

import pytest

from mechsearch_jax.benchmarks.report.results_page import Stored
from mechsearch_jax.benchmarks.running import estimate
from mechsearch_jax.benchmarks.running.episode_seconds import H100, Kind
from mechsearch_jax.benchmarks.running.planned import SceneOutline, planned_jobs
from mechsearch_jax.benchmarks.statistics.settings import THREE_AHEAD
from mechsearch_jax.benchmarks.studies import costs_page
from mechsearch_jax.benchmarks.studies.declared import STUDIES
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.scenes.scene_sets import find_set
from mechsearch_jax.planner import PRESETS

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def experiments():
    return {experiment.name: experiment for experiment in costs_page.experiments()}


@pytest.fixture(scope="module")
def measures():
    return costs_page.Measures.of(Stored(ROOT / "benchmarks/results"))


@pytest.mark.slow
@pytest.mark.always
def test_the_page_is_what_is_declared_and_stored():
    written = (ROOT / "docs/costs.md").read_text(encoding="utf-8")
    assert written == costs_page.page(ROOT / "benchmarks/results"), f"run `python -m {costs_page.__name__}`"
    assert len(written.splitlines()) <= 80


def test_the_tables_have_the_episodes_of_the_paper(experiments):
    counts = {name: experiments[name].count for name in ("Table 1", "Table 3", "Table 4", "Table 5")}
    assert counts == {"Table 1": 17_280, "Table 3": 2_400, "Table 4": 5_400, "Table 5": 960}
    (again,) = (part for name, part in experiments.items() if "more seeds" in name)
    assert (again.count, len(again.episodes)) == (720 * 3, 1)


def test_what_studies_have_in_common_is_run_once(experiments):
    variants = {name: sum(len(study.variants) for study in group) for name, group in costs_page.GROUPS.items()}
    assert set(variants) <= set(experiments)
    assert sum(variants.values()) == sum(len(study.variants) for study in STUDIES.values())
    ablations = experiments["Ablations"]
    assert len(ablations.episodes) < variants["Ablations"]
    # Gamma and other numbers compile nothing.
    assert ablations.programs < len(ablations.episodes)
    assert set(ablations.episodes.values()) == {100, 200}


def test_costs_are_those_of_what_was_measured(measures, experiments):
    assert measures.episode(Method(engine=costs_page.ENGINE)) == pytest.approx((209.3 - 108.0) / 720, abs=1e-3)
    (again,) = (part for name, part in experiments.items() if "more seeds" in name)
    seconds = {each.kind: each.seconds.episode_seconds for each in measures.on_gpu}
    with_masks = seconds[Kind(THREE_AHEAD, "masks", True, "MjxSimulator")]
    assert measures.running(again) == pytest.approx(again.count * with_masks / 3600)


def test_processes_share_gpus_evenly():
    jobs = [
        {"start": 0, "end": 10, "part": 1},
        {"start": 0, "end": 30, "part": 0.5},
        {"start": 4, "end": 10, "part": 0},
    ]
    # Two share two GPUs for 4 s, three for 6 s, then one has a GPU for itself for 20 s.
    assert costs_page.gpu_seconds(jobs, 2) == pytest.approx(4 * 1.5 + 6 * 1.5 * 2 / 3 + 20 * 0.5)
    assert costs_page.gpu_seconds(jobs, 1) == pytest.approx(4 * 1.5 / 2 + 6 * 1.5 / 3 + 20 * 0.5)
    assert costs_page.gpu_seconds([], 1) == 0.0


def test_the_clock_counts_every_episode_of_table_1_once(experiments):
    counted = costs_page.clock(Stored(ROOT / "benchmarks/results"))
    assert counted["episodes"] == experiments["Table 1"].count


def test_dry_runs_count_as_the_page_does(measures, monkeypatch, tmp_path):
    """Also of episodes that are natively simulated, which take a time of their own."""
    monkeypatch.setattr(estimate, "versions", lambda: {"device": H100})
    paper = PRESETS["paper"]()
    methods = [
        Method(engine="MjxSimulator"),
        Method(config=paper, engine="MjxSimulator"),
        Method(config=paper, engine="NativeSimulator", protocol="published-code"),
    ]
    outlines = [SceneOutline.of_block(find_set("d1").blocks[0], 0)]
    parts = estimate.estimate(planned_jobs(outlines, methods, (0,)), tmp_path / "none", None).parts
    assert [part.seconds.episode_seconds for part in parts] == [measures.episode(method) for method in methods]
    assert len({part.seconds.episode_seconds for part in parts}) == len({part.grounds for part in parts}) + 1 == 3


def test_a_folder_without_the_stored_results_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["costs_page", "--results", str(tmp_path), "--out", str(tmp_path / "costs.md")])
    with pytest.raises(SystemExit):
        costs_page.main()
    assert "report-cpu.json: is not there; give the folder" in capsys.readouterr().err
    assert not (tmp_path / "costs.md").exists()
