"""What all experiments cost: the page is what its generator gives, and counts the episodes that commands would run."""

import sys
from pathlib import Path

import pytest

from mechsearch_jax.benchmarks.report.results_page import Stored
from mechsearch_jax.benchmarks.studies import costs_page
from mechsearch_jax.benchmarks.studies.declared import STUDIES

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def experiments():
    return {experiment.name: experiment for experiment in costs_page.experiments()}


@pytest.fixture(scope="module")
def measures():
    return costs_page.Measures.of(Stored(ROOT / "benchmarks/results"))


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
    assert measures.episode == pytest.approx((209.3 - 108.0) / 720)
    table = experiments["Table 1"]
    plain = table.count * measures.episode / 3600
    images = table.count / 3 * measures.looks * (measures.look["masks"] + measures.look["full"]) / 3600
    assert measures.running(table) == pytest.approx(plain + images)
    assert images < 0.1 * plain


def test_a_folder_without_the_stored_results_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["costs_page", "--results", str(tmp_path), "--out", str(tmp_path / "costs.md")])
    with pytest.raises(SystemExit):
        costs_page.main()
    assert "standard-h100.json: is not there; give the folder" in capsys.readouterr().err
    assert not (tmp_path / "costs.md").exists()
