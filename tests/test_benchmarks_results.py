"""Result files: what is written is read back, a file is whole or not there, and what is wrong is one line."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from mechsearch_jax.actions import ActionKind, no_action
from mechsearch_jax.benchmarks.statistics.intervals import wilson
from mechsearch_jax.benchmarks.statistics.rates import summarise
from mechsearch_jax.benchmarks.statistics.variants import label_variants
from mechsearch_jax.benchmarks.store.rows import (
    EVENTS,
    SCHEMA,
    EpisodeRow,
    configuration,
    episode_key,
    parse_row,
    read_rows,
    write_rows,
)
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.episode.records import Episode, Step, load_episode, record_action, save_episode
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import replacing
from mechsearch_jax.viz.maps import Maps, load_maps, save_maps

PUSH = no_action().replace(
    kind=jnp.int32(ActionKind.PUSH), object=jnp.int32(3), displacement=jnp.array([0.0, 0.1, 0.0]), q7=jnp.float32(0.75)
)
OPTIONS = {**Method().options(), "target": "box", "simulator": "NativeSimulator", "seed": 3}
STEPS = (
    Step(40, False, False, 52.0, record_action(PUSH), 31.0, 33.0, 24, None, {"plan": 0.5}),
    Step(17, True, True, 33.0, None, None, None, 0, "the object slipped", {"plan": 0.25}),
)
EPISODE = Episode("two-things", 2, OPTIONS, {"jax": "1.2.3"}, STEPS, 1, 1, True, None)
ROW = EpisodeRow(
    scenario="two-things",
    objects=2,
    target="cylinder",
    policy="search-for-grasp",
    recognition="oracle",
    gamma=0.9,
    horizon=3,
    sequences=30,
    actions="push+pick-and-place",
    seed=0,
    found_step=1,
    graspable_step=None,
    retrieved=False,
    steps=2,
    failure="no grasp after 2 actions",
    planning_seconds=1.5,
    simulation_seconds=3.0,
)


def maps():
    return Maps(
        poses=np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32),
        existence=np.array([True, False, True, True, False]),
        graspability=np.array([1, 0, -1, -2, 1]),
        scene=jax.tree.map(np.asarray, superquadric.empty(4)),
    )


def test_an_episode_is_read_back(tmp_path):
    save_episode(EPISODE, tmp_path / "new" / "episode.json")
    assert load_episode(tmp_path / "new" / "episode.json") == EPISODE
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["episode.json"]


def test_what_happened_on_the_way_is_read_back_and_counted(tmp_path):
    before, after = STEPS
    calm = dataclasses.replace(before, truth_possible=True, restarts=0, fallen=(), held_up=False, at_rest=True)
    calm = dataclasses.replace(calm, around_possible=True)
    steps = (
        calm,
        dataclasses.replace(calm, truth_possible=False, restarts=1, fallen=(1, 0), held_up=True, at_rest=False),
        dataclasses.replace(
            calm, truth_possible=False, around_possible=False, restarts=1, target_fallen=True, tracking_error=0.25
        ),
        dataclasses.replace(after, restarts=1),
    )
    save_episode(dataclasses.replace(EPISODE, steps=steps), tmp_path / "episode.json")
    episode = load_episode(tmp_path / "episode.json")
    assert episode.steps == steps
    row = EpisodeRow.of_episode(episode)
    assert [getattr(row, name) for name in EVENTS] == [3, 2, 1, 1, 2, 2, 1, 1, 1, 2, 0]
    unknown = EpisodeRow.of_episode(dataclasses.replace(episode, steps=()))
    assert [getattr(unknown, name) for name in EVENTS] == [None] * len(EVENTS)


def test_a_row_says_whether_the_papers_grasps_would_have_done():
    for flags, step, expected in (((False, True), 1, True), ((False, False), None, False)):
        steps = tuple(dataclasses.replace(STEPS[0], paper_graspable=flag) for flag in flags)
        row = EpisodeRow.of_episode(dataclasses.replace(EPISODE, steps=steps, paper_graspable_step=step))
        assert (row.paper_graspable, row.paper_graspable_step) == (expected, step)


@pytest.mark.parametrize("text", ["{", "[]", "3", '{"steps": [{}]}', '{"steps": []}', "[" * 100_000])
def test_what_is_no_episode_is_one_line(tmp_path, text):
    (tmp_path / "episode.json").write_text(text)
    with pytest.raises(InputError) as error:
        load_episode(tmp_path / "episode.json")
    assert str(tmp_path / "episode.json") in str(error.value)
    assert "\n" not in str(error.value)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "episode.json"
    save_episode(EPISODE, path)
    before = path.read_bytes()
    with pytest.raises(ValueError):
        save_episode(dataclasses.replace(EPISODE, config={"gamma": float("nan")}), path)

    def fail_halfway():
        with replacing(path) as file:
            file.write(b"half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_halfway()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["episode.json"]


def test_maps_are_read_back(tmp_path):
    save_maps(maps(), tmp_path / "maps.npz")
    jax.tree.map(
        np.testing.assert_array_equal,
        dataclasses.asdict(load_maps(tmp_path / "maps.npz")),
        dataclasses.asdict(maps()),
    )
    with np.load(tmp_path / "maps.npz") as file:
        assert set(file) == {
            "poses", "existence", "graspability", "size", "exponents", "position", "rotation", "valid",
        }  # fmt: skip


def test_what_holds_no_maps_is_one_line(tmp_path):
    (tmp_path / "text.npz").write_text("no")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    for name in ("text.npz", "other.npz", "none.npz"):
        with pytest.raises(InputError, match=name) as error:
            load_maps(tmp_path / name)
        assert "\n" not in str(error.value)


def test_rows_are_read_back(tmp_path):
    rows = [ROW, dataclasses.replace(ROW, seed=1, found_step=None, failure=None, graspable_step=2, retrieved=True)]
    write_rows(rows, tmp_path / "new" / "rows.parquet")
    assert read_rows(tmp_path / "new" / "rows.parquet") == rows
    assert pyarrow.parquet.read_schema(tmp_path / "new" / "rows.parquet").equals(SCHEMA)


@pytest.mark.parametrize("text", ["{", "3"])
def test_a_configuration_that_is_none_is_one_line(tmp_path, text):
    write_rows([dataclasses.replace(ROW, configuration="{}")], tmp_path / "rows.parquet")
    table = pyarrow.parquet.read_table(tmp_path / "rows.parquet")
    place = table.column_names.index("configuration")
    pyarrow.parquet.write_table(table.set_column(place, "configuration", [[text]]), tmp_path / "rows.parquet")
    with pytest.raises(InputError, match=r"rows\.parquet: the configuration of 'two-things'"):
        read_rows(tmp_path / "rows.parquet")


def test_options_that_differ_tell_rows_apart():
    full = configuration({"gamma": 0.9, "push_distances": [0.05, 0.1], "seed": 3, "target": "box"})
    assert json.loads(full) == {"gamma": 0.9, "push_distances": [0.05, 0.1]}
    rows = [dataclasses.replace(ROW, configuration=full), ROW, dataclasses.replace(ROW, gamma=0.5)]
    assert label_variants(rows) == [
        "search-for-grasp, gamma 0.9, push distances 0.05/0.1",
        "search-for-grasp, gamma 0.9, push distances unknown",
        "search-for-grasp, gamma 0.5, push distances unknown",
    ]
    assert label_variants(rows[1:2]) == ["search-for-grasp"]
    assert [rates.episodes for rates in summarise(rows)] == [1] * 6


def test_what_ran_with_an_option_that_is_unknown_cannot_be_run_again():
    assert Method.of_options(OPTIONS) == Method()
    with pytest.raises(InputError, match="option topple_charge is unknown to this version"):
        Method.of_options({**OPTIONS, "topple_charge": 0.5})


def test_confidence_intervals_are_wilsons():
    # Newcombe 1998, table I: 81 of 263, 15 of 148, 0 of 20, 29 of 29.
    for counts, interval in {
        (81, 263): (0.2553, 0.3662), (15, 148): (0.0624, 0.1605), (0, 20): (0.0, 0.1611), (29, 29): (0.8830, 1.0),
    }.items():  # fmt: skip
        assert wilson(*counts) == pytest.approx(interval, abs=5e-5)
    assert wilson(0, 0) == (0.0, 1.0)


def test_every_option_is_a_column(tmp_path):
    method = Method(config=PRESETS["standard"](gamma=0.5, push_distances=(0.1,), max_steps=7))
    options = {**method.options(), "target": "box", "simulator": "NativeSimulator", "seed": 3}
    row = EpisodeRow.of_episode(dataclasses.replace(EPISODE, config=options))
    write_rows([row, ROW], tmp_path / "rows.parquet")
    first, second = pyarrow.parquet.read_table(tmp_path / "rows.parquet").to_pylist()
    for name, value in options.items():
        assert first[name] == ("+".join(value) if name == "actions" else value), name
    assert second["max_steps"] is None
    assert [first["episode"], second["episode"]] == [episode_key(row), episode_key(ROW)]
    assert len({row["episode"] for row in (first, second)}) == 2
    assert read_rows(tmp_path / "rows.parquet") == [row, ROW]


def test_a_row_says_what_ran_it_and_how_long_compiling_took():
    timings = ({"plan": 0.5, "simulate": 1.0, "compile": 20.0}, {"plan": 0.25, "compile": 2.0})
    steps = tuple(dataclasses.replace(step, timings=spent) for step, spent in zip(STEPS, timings, strict=True))
    versions = {"jax": "1.2.3", "device": "cpu: cpu"}
    row = EpisodeRow.of_episode(dataclasses.replace(EPISODE, steps=steps, versions=versions), "this code")
    assert (row.planning_seconds, row.simulation_seconds, row.compile_seconds) == (0.75, 1.0, 22.0)
    assert (row.code, row.device, json.loads(row.versions)) == ("this code", "cpu: cpu", {"jax": "1.2.3"})


def test_a_table_without_the_later_columns_says_nothing_of_them(tmp_path):
    write_rows([dataclasses.replace(ROW, truth_ruled_out=1, truth_ruled_out_step=0)], tmp_path / "rows.parquet")
    table = pyarrow.parquet.read_table(tmp_path / "rows.parquet")
    before = table.drop_columns(["truth_ruled_out", "truth_ruled_out_step"])
    pyarrow.parquet.write_table(before, tmp_path / "before.parquet")
    assert read_rows(tmp_path / "before.parquet") == [ROW]
    assert parse_row(json.dumps(before.to_pylist()[0])) == ROW


def test_what_is_no_table_of_episodes_is_one_line(tmp_path):
    (tmp_path / "text.parquet").write_text("no")
    write_rows([ROW], tmp_path / "other.parquet")
    table = pyarrow.parquet.read_table(tmp_path / "other.parquet").drop_columns(["content_hash"])
    pyarrow.parquet.write_table(table, tmp_path / "other.parquet")
    for name in ("text.parquet", "other.parquet: lacks the column content_hash", "none.parquet"):
        with pytest.raises(InputError, match=name) as error:
            read_rows(tmp_path / name.partition(":")[0])
        assert "\n" not in str(error.value)


def test_rows_are_summarised_by_method_and_number_of_objects():
    rows = [
        ROW,
        dataclasses.replace(ROW, seed=1, graspable_step=2, retrieved=True, steps=4, paper_graspable=True),
        dataclasses.replace(ROW, objects=8, found_step=None, steps=10, paper_graspable=False),
        dataclasses.replace(ROW, policy="search-and-grasp"),
    ]
    summary = summarise(rows)
    assert [(r.method, r.objects, r.episodes) for r in summary] == [
        ("search-and-grasp", 2, 1),
        ("search-and-grasp", None, 1),
        ("search-for-grasp", 2, 2),
        ("search-for-grasp", 8, 1),
        ("search-for-grasp", None, 3),
    ]
    two = summary[2]
    assert (two.found, two.graspable, two.retrieved, two.steps) == (1.0, 0.5, 0.5, 3.0)
    assert two.planning_seconds == pytest.approx(0.5)
    assert [(r.paper_episodes, r.paper_graspable) for r in summary[1:]] == [(0, None), (1, 1.0), (1, 0.0), (2, 0.5)]
