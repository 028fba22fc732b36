"""Studies: every declared variant can be run, rows go to their variants, and the page says what they say."""

import dataclasses
import random

import pytest
from stored_rows import row_of

from mechsearch_jax.benchmarks.lab.__main__ import parse
from mechsearch_jax.benchmarks.lab.commands import study as command
from mechsearch_jax.benchmarks.lab.studies.comparison import compare, screen, sentence
from mechsearch_jax.benchmarks.lab.studies.declared import GROUPS, STUDIES
from mechsearch_jax.benchmarks.lab.studies.studies import Study, Variant, find_studies
from mechsearch_jax.envs.scenes.scene_sets import SETS, SHELVES, is_chosen_on
from mechsearch_jax.runtime.errors import InputError

STUDY = Study("gamma", "Does it matter?", "development", (Variant("0.9"), Variant("0.5", {"gamma": 0.5})))


def rows_of(variant, share, seed=0, engine="MjxSimulator", scenes=25, first=0):
    """Rows of a variant on scenes of `development`, of which a share is retrieved."""
    draw, method = random.Random(first), variant.method()
    rows = []
    for i in range(scenes):
        for count in (2, 8):
            reached = draw.random() < share
            fields = {"retrieved": reached, "steps": 3 if reached else 10}
            rows.append(row_of(f"development-{count}-{i:03d}", method, seed, **fields))
    return [
        dataclasses.replace(row, configuration=row.configuration.replace('"NativeSimulator"', f'"{engine}"'))
        for row in rows
    ]


@pytest.mark.parametrize("study", STUDIES.values(), ids=lambda study: study.name)
def test_the_scenes_of_a_study_stand_on_the_shelf_of_its_variants(study):
    shelves = {block.shelf for block in SETS[study.scenes].blocks}
    for variant in study.variants:
        assert [SHELVES[shelf] for shelf in shelves] == [variant.method().workcell.shelf]


@pytest.mark.parametrize("study", STUDIES.values(), ids=lambda study: study.name)
def test_every_declared_variant_can_be_run_and_differs_from_the_others(study):
    assert study.scenes in SETS
    assert study.question.endswith(("?", "."))
    labels = [variant.label for variant in study.variants]
    assert len(set(labels)) == len(labels)
    methods = {}
    for variant in study.variants:
        method = variant.method()
        options = {**method.options(), "engine": method.engine}
        assert options not in methods.values(), variant.label
        methods[variant.label] = options


def test_ablations_leave_the_scenes_to_report_with_unseen():
    for group, studies in GROUPS.items():
        for study in studies:
            first = SETS[study.scenes].blocks[0].scene_name(0)
            assert is_chosen_on(first) == (group == "Ablations"), study.name


def test_names_are_found_and_others_refused():
    assert [study.name for study in find_studies(["gamma", "mass", "gamma"], STUDIES)] == ["gamma", "mass"]
    assert find_studies(["all"], STUDIES) == list(STUDIES.values())
    for names, reason in (([], "name one or more of gamma"), (["gama"], "gama is unknown; did you mean gamma")):
        with pytest.raises(InputError, match=reason):
            find_studies(names, STUDIES)


def test_the_help_names_every_study():
    text = " ".join(command.study.__doc__.partition("names: of studies: ")[2].split())
    assert text.startswith(f"{', '.join(STUDIES)}; or all.")


def test_a_row_goes_to_the_variant_that_it_ran_with():
    base, other = STUDY.variants
    strange = rows_of(Variant("", {"gamma": 0.5, "horizon": 2}), 1.0)
    elsewhere = [row_of("c2-2-000", base.method())]
    groups = STUDY.rows_of([*rows_of(base, 0.5), *rows_of(other, 0.5), *strange, *elsewhere])
    assert {label: len(rows) for label, rows in groups.items()} == {"0.9": 50, "0.5": 50}
    assert {row.gamma for row in groups["0.5"]} == {0.5}


def test_rows_of_one_simulator_are_compared():
    base, other = STUDY.variants
    native = rows_of(base, 0.0, engine="NativeSimulator", scenes=5)
    groups = STUDY.rows_of([*native, *rows_of(base, 1.0), *rows_of(other, 1.0)])
    assert all(row.retrieved for rows in groups.values() for row in rows)
    needing = dataclasses.replace(base, engine="NativeSimulator")
    study = dataclasses.replace(STUDY, variants=(needing, other))
    assert not any(row.retrieved for row in study.rows_of([*native, *rows_of(base, 1.0)])["0.9"])


def test_changes_are_those_of_the_same_scenes_and_seeds():
    base, other = STUDY.variants
    worse = [dataclasses.replace(row, retrieved=False) if i < 10 else row for i, row in enumerate(rows_of(other, 1.0))]
    # Rows of another seed have no partner.
    rows = [*rows_of(base, 1.0), *worse, *rows_of(other, 0.0, seed=1)]
    first, second = compare(STUDY, rows)
    assert (first.episodes, first.changes, second.episodes) == (50, {}, 100)
    change = second.changes["retrieved"]
    assert (change.pairs, change.losses, change.gains) == (50, 10, 0)
    assert change.mean == pytest.approx(-0.2)
    assert first.means["retrieved"] == 1.0
    assert second.means["retrieved"] == pytest.approx(0.4)
    assert "fewer are retrieved with 0.5 -20.0 (" in sentence(STUDY, [first, second])
    assert screen(STUDY, rows).row_count == 2


def failed(row):
    return dataclasses.replace(row, failure="error: x", objects_fallen=None, retrieved=False, steps=0)


def test_an_error_is_neither_retrieved_nor_free_of_drops():
    rows = [failed(row) for row in rows_of(STUDY.variants[0], 1)]
    (only,) = compare(STUDY, rows)
    assert (only.errors, only.means["drop-free"]) == (50, 0.0)
    assert only.means["actions"] is None
    assert screen(STUDY, rows).row_count == 1


def test_the_actions_of_errors_do_not_count():
    base, other = STUDY.variants
    rows = [failed(row) if i < 10 else row for i, row in enumerate(rows_of(other, 1.0))]
    first, second = compare(STUDY, [*rows_of(base, 1.0), *rows])
    assert first.means["actions"] == second.means["actions"] == 3.0
    assert (second.changes["actions"].pairs, second.changes["actions"].mean) == (40, 0.0)
    assert (second.changes["retrieved"].pairs, second.changes["retrieved"].losses) == (50, 10)


def test_without_partners_the_sentence_says_whose_rows_lack():
    base, other = STUDY.variants
    assert sentence(STUDY, compare(STUDY, rows_of(base, 1.0))) == "There are no rows of another variant yet."
    assert sentence(STUDY, compare(STUDY, rows_of(other, 1.0))) == "There are no rows of 0.9 yet."


def test_what_is_the_same_within_chance_is_called_so():
    base, other = STUDY.variants
    text = sentence(STUDY, compare(STUDY, [*rows_of(base, 0.5, first=1), *rows_of(other, 0.5, first=2)]))
    assert text.endswith("no difference is certain with 0.5.")


def test_the_command_says_what_it_would_do(capsys, tmp_path):
    parse(["study", "gamma", "--scenes", "1", "--out", str(tmp_path / "rows"), "--dry-run", "--simulator", "native"])()
    printed = capsys.readouterr().out
    assert "gamma: Does the discount of later actions matter? 6 variants on development" in printed
    assert "6 variants, 24 episodes" in printed
    assert "1 compilation" in printed
    assert not (tmp_path / "rows").exists()
