"""Result files: what is written is read back, a file is whole or not there, and what is wrong is one line."""

import dataclasses
import json
import stat

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
    Row,
    configuration,
    episode_key,
    identity,
    options_of,
    parse_row,
    read_rows,
    write_rows,
)
from mechsearch_jax.envs.episode.earlier import EARLIER, GONE, RENAMED
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.episode.records import Episode, Step, load_episode, record_action, save_episode
from mechsearch_jax.envs.recording.narration import verdict
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import check_writable, replacing
from mechsearch_jax.viz.maps import Maps, load_maps, save_maps

PUSH = no_action().replace(
    kind=jnp.int32(ActionKind.PUSH), object=jnp.int32(3), displacement=jnp.array([0.0, 0.1, 0.0]), q7=jnp.float32(0.75)
)
STEPS = (
    Step(40, False, False, 52.0, record_action(PUSH), 31.0, 33.0, 24, None, {"plan": 0.5}),
    Step(17, True, True, 33.0, None, None, None, 0, "the object slipped", {"plan": 0.25}),
)
EPISODE = Episode("two-things", 2, {**EARLIER, "gamma": 0.9}, {"jax": "1.2.3"}, STEPS, 1, 1, True, None)
ROW = Row(
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
    told = dataclasses.replace(before, truth_possible=True, restarts=0, fallen=(), held_up=False, at_rest=True)
    steps = (
        told,
        dataclasses.replace(told, truth_possible=False, restarts=1, fallen=(1, 0), held_up=True, at_rest=False),
        dataclasses.replace(told, truth_possible=False, restarts=1, target_fallen=True, tracking_error=0.25),
        dataclasses.replace(after, restarts=1),
    )
    save_episode(
        dataclasses.replace(EPISODE, config={**OLD, "target": "box", "seed": 3}, steps=steps), tmp_path / "episode.json"
    )
    episode = load_episode(tmp_path / "episode.json")
    assert episode.steps == steps
    row = Row.of_episode(episode)
    assert [getattr(row, name) for name in EVENTS] == [3, 2, 1, 1, 2, 2, 1, 1]
    unknown = Row.of_episode(dataclasses.replace(episode, steps=STEPS))
    assert [getattr(unknown, name) for name in EVENTS] == [None] * len(EVENTS)


def test_a_row_says_whether_the_papers_grasps_would_have_done_if_the_steps_do():
    config = {**OLD, "policy": "search-and-grasp", "actions": ["push"], "target": "box", "seed": 3}

    def row(*said, step=None):
        steps = tuple(dataclasses.replace(STEPS[0], paper_graspable=each) for each in said)
        episode = dataclasses.replace(EPISODE, config=config, steps=steps, paper_graspable_step=step)
        found = Row.of_episode(episode)
        return found.paper_graspable, found.paper_graspable_step

    assert row(False, True, step=1) == (True, 1)
    assert row(False, False) == (False, None)
    assert row(None, None) == (None, None)


def test_an_episode_of_an_earlier_version_does_not_say_what_happened_on_the_way(tmp_path):
    save_episode(EPISODE, tmp_path / "episode.json")
    value = json.loads((tmp_path / "episode.json").read_text())
    assert value.pop("paper_graspable_step") is None
    names = ("truth_possible", "restarts", "fallen", "target_fallen", "held_up", "at_rest", "tracking_error")
    for step in value["steps"]:
        for name in (*names, "paper_graspable"):
            assert step.pop(name) is None
    (tmp_path / "episode.json").write_text(json.dumps(value))
    assert load_episode(tmp_path / "episode.json") == EPISODE


def test_an_episode_has_the_documented_keys(tmp_path):
    save_episode(EPISODE, tmp_path / "episode.json")
    value = json.loads((tmp_path / "episode.json").read_text())
    assert {"scenario", "config", "versions", "steps", "found_step", "graspable_step", "retrieved", "failure"} <= set(
        value
    )
    assert value["steps"][0]["action"]["kind"] == "push"
    assert value["steps"][0]["action"]["object"] == 3


@pytest.mark.parametrize("text", ["{", "[]", "3", '{"steps": [{}]}', '{"steps": []}', "[" * 100_000])
def test_what_is_no_episode_is_one_line(tmp_path, text):
    (tmp_path / "episode.json").write_text(text)
    with pytest.raises(InputError) as error:
        load_episode(tmp_path / "episode.json")
    assert str(tmp_path / "episode.json") in str(error.value)
    assert "\n" not in str(error.value)


def test_an_episode_without_a_push_model_was_planned_with_the_first_one(tmp_path):
    known = {"push_model": "physics", "topple_charge": 0.25}
    for config in ({"gamma": 0.9}, {"gamma": 0.9, **known}):
        save_episode(dataclasses.replace(EPISODE, config=config), tmp_path / "episode.json")
        assert load_episode(tmp_path / "episode.json").config == {**EARLIER, **config}


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


def test_a_file_gets_ordinary_permissions(tmp_path):
    (tmp_path / "plain").write_text("")
    save_episode(EPISODE, tmp_path / "episode.json")
    modes = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("plain", "episode.json")}
    assert len(modes) == 1


def test_an_unwritable_place_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    for write in (
        lambda: save_episode(EPISODE, tmp_path / "file" / "episode.json"),
        lambda: check_writable(tmp_path / "file"),
    ):
        with pytest.raises(InputError, match="cannot be written"):
            write()


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


BY_PAPER = ["paper_graspable", "paper_graspable_step"]
BESIDES = ["graspable_known", "compile_seconds", "code", "device", "versions"]
EARLIER_LACKED = [
    BESIDES,
    [*BY_PAPER, *BESIDES],
    [*EVENTS, *BY_PAPER, *BESIDES],
    ["content_hash", *EVENTS, *BY_PAPER, *BESIDES],
    ["configuration", "content_hash", *EVENTS, *BY_PAPER, *BESIDES],
]


@pytest.mark.parametrize("columns", EARLIER_LACKED, ids=len)
def test_rows_of_earlier_versions_are_read(tmp_path, columns):
    row = dataclasses.replace(
        ROW,
        content_hash="0123456789ab",
        configuration=configuration({**EARLIER, "gamma": 0.9}),
        **dict.fromkeys(EVENTS, 3),
        paper_graspable=True,
        paper_graspable_step=2,
        compile_seconds=4.0,
        code="mechsearch-jax 0.1.0 (0123456789ab)",
        device="cpu: cpu",
        versions="{}",
    )
    write_rows([row], tmp_path / "rows.parquet")
    table = pyarrow.parquet.read_table(tmp_path / "rows.parquet")
    more = [name for name in table.column_names if name not in vars(row)]
    pyarrow.parquet.write_table(table.drop_columns([*columns, *more]), tmp_path / "rows.parquet")
    lacked = {**dict.fromkeys(columns), "graspable_known": True}
    assert read_rows(tmp_path / "rows.parquet") == [dataclasses.replace(row, **lacked)]


def test_what_a_scenario_holds_tells_rows_apart():
    rows = [dataclasses.replace(ROW, content_hash=content) for content in ("0123456789ab", "ba9876543210", None)]
    assert len({identity(row) for row in rows}) == 3
    assert len({identity(dataclasses.replace(row, steps=7)) for row in rows[:1] * 2}) == 1


def test_an_episode_that_does_not_say_what_its_scenario_held_is_read(tmp_path):
    save_episode(dataclasses.replace(EPISODE, content_hash="0123456789ab"), tmp_path / "episode.json")
    value = json.loads((tmp_path / "episode.json").read_text())
    assert value.pop("content_hash") == "0123456789ab"
    (tmp_path / "episode.json").write_text(json.dumps(value))
    assert load_episode(tmp_path / "episode.json") == EPISODE


@pytest.mark.parametrize("text", ["{", "3"])
def test_a_configuration_that_is_none_is_one_line(tmp_path, text):
    write_rows([dataclasses.replace(ROW, configuration="{}")], tmp_path / "rows.parquet")
    table = pyarrow.parquet.read_table(tmp_path / "rows.parquet")
    place = table.column_names.index("configuration")
    pyarrow.parquet.write_table(table.set_column(place, "configuration", [[text]]), tmp_path / "rows.parquet")
    with pytest.raises(InputError, match=r"rows\.parquet: the configuration of 'two-things'"):
        read_rows(tmp_path / "rows.parquet")


OLD = {
    "actions": "both", "caution": 0.5, "criterion": "detector", "focus": 0.7, "gamma": 0.9, "horizon": 3,
    "max_steps": 10, "method": "search-and-grasp", "push_distances": [0.05, 0.1], "recognition": "oracle",
    "sequences": 30, "simulator": "NativeSimulator",
}  # fmt: skip
# The columns of the tables that were written when a policy was called a method.
OLD_SCHEMA = pyarrow.schema(
    [
        ("scenario", pyarrow.string()),
        ("objects", pyarrow.int64()),
        ("target", pyarrow.string()),
        ("method", pyarrow.string()),
        ("recognition", pyarrow.string()),
        ("gamma", pyarrow.float64()),
        ("horizon", pyarrow.int64()),
        ("sequences", pyarrow.int64()),
        ("actions", pyarrow.string()),
        ("seed", pyarrow.int64()),
        ("found_step", pyarrow.int64()),
        ("graspable_step", pyarrow.int64()),
        ("retrieved", pyarrow.bool_()),
        ("steps", pyarrow.int64()),
        ("failure", pyarrow.string()),
        ("planning_seconds", pyarrow.float64()),
        ("simulation_seconds", pyarrow.float64()),
        ("configuration", pyarrow.string()),
    ]
)
OLD_VALUES = {
    "scenario": "two-things", "objects": 2, "target": "cylinder", "method": "search-and-grasp",
    "recognition": "oracle", "gamma": 0.9, "horizon": 3, "sequences": 30, "actions": "both", "seed": 0,
    "found_step": 1, "graspable_step": None, "retrieved": False, "steps": 2, "failure": "no grasp after 2 actions",
    "planning_seconds": 1.5, "simulation_seconds": 3.0,
}  # fmt: skip


def old_table(path, *configurations):
    rows = [{**OLD_VALUES, "configuration": json.dumps(value, sort_keys=True)} for value in configurations]
    schema = OLD_SCHEMA.with_metadata({b"mechsearch_code": b"mechsearch-jax 0.1.0 (0123456789ab)"})
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows, schema=schema), path)


def test_tables_with_earlier_names_of_options_are_read(tmp_path):
    old_table(tmp_path / "rows.parquet", OLD, {**OLD, "push_model": "learned", "topple_charge": 0.5})
    before = (tmp_path / "rows.parquet").read_bytes()
    first, second = read_rows(tmp_path / "rows.parquet")
    now = {
        **OLD,
        **EARLIER,
        "policy": OLD["method"],
        "actions": ["push", "pick-and-place"],
        "unseen_contact_penalty": 0.5,
        "guided_fraction": 0.7,
    }
    for name in ("method", "caution", "focus"):
        del now[name]
    assert first == dataclasses.replace(
        ROW, policy="search-and-grasp", configuration=configuration(now), code="mechsearch-jax 0.1.0 (0123456789ab)"
    )
    assert json.loads(second.configuration) == {**now, "push_model": "learned", "topple_charge": 0.5}
    assert (tmp_path / "rows.parquet").read_bytes() == before
    assert not set(RENAMED) & set(SCHEMA.names)


def test_tables_of_the_first_version_with_earlier_columns_are_read(tmp_path):
    table = pyarrow.Table.from_pylist([OLD_VALUES], schema=pyarrow.schema(list(OLD_SCHEMA)[:-1]))
    pyarrow.parquet.write_table(table, tmp_path / "rows.parquet")
    assert read_rows(tmp_path / "rows.parquet") == [dataclasses.replace(ROW, policy="search-and-grasp")]


def test_what_differs_goes_by_the_present_names_of_options(tmp_path):
    old_table(tmp_path / "rows.parquet", OLD, {**OLD, "caution": 1.0, "focus": 0.0})
    assert label_variants(read_rows(tmp_path / "rows.parquet")) == [
        "search-and-grasp, guided fraction 0.7, unseen contact penalty 0.5",
        "search-and-grasp, guided fraction 0, unseen contact penalty 1",
    ]


def test_an_episode_with_earlier_names_of_options_is_read(tmp_path):
    save_episode(dataclasses.replace(EPISODE, config={**OLD, "target": "box", "seed": 3}), tmp_path / "episode.json")
    config = load_episode(tmp_path / "episode.json").config
    assert config["policy"] == "search-and-grasp"
    assert (config["unseen_contact_penalty"], config["guided_fraction"]) == (0.5, 0.7)
    assert not set(RENAMED) & set(config)
    assert Row.of_episode(load_episode(tmp_path / "episode.json")).policy == "search-and-grasp"


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


def test_rows_without_a_push_model_were_planned_with_the_first_one(tmp_path):
    old, new, other = (
        dataclasses.replace(ROW, configuration=configuration({"gamma": 0.9, **more}))
        for more in ({}, {"push_model": "quasi-static"}, {"push_model": "physics"})
    )
    write_rows([old, new, other], tmp_path / "rows.parquet")
    old, new, other = read_rows(tmp_path / "rows.parquet")
    assert identity(old) == identity(new) != identity(other)
    labels = label_variants([old, new, other])
    assert labels == [
        "search-for-grasp, push model quasi-static",
        "search-for-grasp, push model quasi-static",
        "search-for-grasp, push model physics",
    ]


@pytest.mark.parametrize("name", GONE)
def test_rows_with_an_option_that_is_gone_are_as_todays_only_where_they_ran_so(tmp_path, name):
    assert name not in Method().options()
    today, same, other = (
        dataclasses.replace(ROW, configuration=configuration({"gamma": 0.9, **more}))
        for more in ({}, {name: GONE[name]}, {name: 0.125})
    )
    write_rows([today, same, other], tmp_path / "rows.parquet")
    today, same, other = read_rows(tmp_path / "rows.parquet")
    assert identity(today) == identity(same) != identity(other)
    assert episode_key(today) == episode_key(same) != episode_key(other)
    assert name not in json.loads(same.configuration)
    assert json.loads(other.configuration)[name] == 0.125
    labels = label_variants([today, same, other])
    assert labels[0] == labels[1] != labels[2] == f"search-for-grasp, {name.replace('_', ' ')} 0.125"
    assert not any("unknown" in label for label in labels)
    with pytest.raises(InputError, match=f"option {name} is gone: what ran with 0.125 cannot be run again"):
        Method.of_options(options_of(other))


def test_rows_of_the_planner_of_the_published_code_are_as_todays():
    then = {"hindrance_weight": 0.1, "later_draws": "present", "later_placements": False}
    plain, published, today, half = (
        dataclasses.replace(ROW, configuration=configuration({**EARLIER, **more}))
        for more in ({}, then, {"imitates": "published-code"}, {**then, "hindrance_weight": 1.0})
    )
    assert identity(published) == identity(today) != identity(plain)
    assert options_of(published) == options_of(today)
    # What was varied beside the preset is still said.
    assert len({identity(row) for row in (plain, today, half)}) == 3
    assert options_of(half).keys() - options_of(plain).keys() == {"later_draws", "later_placements"}
    Method.of_options(options_of(published))
    with pytest.raises(InputError, match="option later_draws is gone: what ran with 'present' cannot be run again"):
        Method.of_options(options_of(half))


def test_confidence_intervals_are_wilsons():
    # Newcombe 1998, table I: 81 of 263, 15 of 148, 0 of 20, 29 of 29.
    for counts, interval in {
        (81, 263): (0.2553, 0.3662), (15, 148): (0.0624, 0.1605), (0, 20): (0.0, 0.1611), (29, 29): (0.8830, 1.0),
    }.items():  # fmt: skip
        assert wilson(*counts) == pytest.approx(interval, abs=5e-5)
    assert wilson(0, 0) == (0.0, 1.0)


def test_confidence_intervals_are_those_of_the_formula():
    z = 1.959963984540054
    for count in (1, 2, 7, 100):
        for successes in range(count + 1):
            share = successes / count
            middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
            half = z / (1 + z**2 / count) * np.sqrt(share * (1 - share) / count + z**2 / (4 * count**2))
            assert wilson(successes, count) == pytest.approx((middle - half, middle + half), abs=1e-12)


def test_the_columns_are_those_of_earlier_tables_but_for_names():
    since = [pyarrow.string(), *[pyarrow.int64()] * len(EVENTS), pyarrow.bool_(), pyarrow.int64()]
    besides = [pyarrow.bool_(), pyarrow.float64(), *[pyarrow.string()] * 3]
    names = [field.name for field in dataclasses.fields(Row)]
    assert SCHEMA.types[: len(names)] == [*OLD_SCHEMA.types, *since, *besides]
    known = [RENAMED.get(name, name) for name in OLD_SCHEMA.names]
    assert SCHEMA.names[: len(names)] == names == [*known, "content_hash", *EVENTS, *BY_PAPER, *BESIDES]


def test_every_option_is_a_column(tmp_path):
    method = Method(config=PRESETS["standard"](gamma=0.5, push_distances=(0.1,), max_steps=7))
    options = {**method.options(), "target": "box", "simulator": "NativeSimulator", "seed": 3}
    row = Row.of_episode(dataclasses.replace(EPISODE, config=options))
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
    config = {**OLD, "policy": "random", "actions": ["push"], "target": "box", "seed": 3}
    row = Row.of_episode(dataclasses.replace(EPISODE, steps=steps, versions=versions, config=config), "this code")
    assert (row.planning_seconds, row.simulation_seconds, row.compile_seconds) == (0.75, 1.0, 22.0)
    assert (row.code, row.device, json.loads(row.versions)) == ("this code", "cpu: cpu", {"jax": "1.2.3"})


def test_what_is_no_table_of_episodes_is_one_line(tmp_path):
    (tmp_path / "text.parquet").write_text("no")
    pyarrow.parquet.write_table(pyarrow.table({"a": [1]}), tmp_path / "other.parquet")
    for name in ("text.parquet", "other.parquet", "none.parquet"):
        with pytest.raises(InputError, match=name) as error:
            read_rows(tmp_path / name)
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


# Rows as earlier versions wrote them: since there were rehearsals, a retrieval set `graspable_step`.
REHEARSED, BEFORE_REHEARSALS = json.dumps({"rehearsal": "physics"}), json.dumps({"focus": 0.7})


@pytest.mark.parametrize(
    ("configuration", "graspable_step", "retrieved", "steps", "known"),
    [
        (REHEARSED, 3, True, 4, False),
        (json.dumps({"retrieval_model": "physics"}), 0, True, 1, False),
        # The judge said it before the retrieval, nothing was retrieved, or there was nothing to say.
        (REHEARSED, 2, True, 4, True),
        (REHEARSED, 3, False, 4, True),
        (REHEARSED, None, False, 4, True),
        # Nor did a retrieval set it in rows that are older still.
        (BEFORE_REHEARSALS, 3, True, 4, True),
        (None, 3, True, 4, True),
    ],
)
def test_an_earlier_row_whose_retrieval_may_have_set_graspable_does_not_say_it(
    tmp_path, configuration, graspable_step, retrieved, steps, known
):
    row = dataclasses.replace(
        ROW, configuration=configuration, graspable_step=graspable_step, retrieved=retrieved, steps=steps
    )
    fields = {name: value for name, value in vars(row).items() if name != "graspable_known"}
    write_rows([row], tmp_path / "rows.parquet")
    table = pyarrow.parquet.read_table(tmp_path / "rows.parquet").drop_columns(["graspable_known"])
    pyarrow.parquet.write_table(table, tmp_path / "rows.parquet")
    expected = (known, graspable_step if known else None)
    for read in (parse_row(json.dumps(fields)), *read_rows(tmp_path / "rows.parquet")):
        assert (read.graspable_known, read.graspable_step) == expected
        # It stays so when it is written again.
        write_rows([read], tmp_path / "again.parquet")
        assert read_rows(tmp_path / "again.parquet") == [parse_row(json.dumps(vars(read)))] == [read]
    # Today's rows say it.
    assert parse_row(json.dumps(vars(row))).graspable_step == graspable_step


def test_an_earlier_episode_is_graspable_where_a_step_says_so_whatever_was_retrieved(tmp_path):
    steps = (STEPS[0], dataclasses.replace(STEPS[1], graspable=False))
    save_episode(dataclasses.replace(EPISODE, steps=steps, graspable_step=1), tmp_path / "episode.json")
    episode = load_episode(tmp_path / "episode.json")
    assert (episode.retrieved, episode.graspable_step) == (True, None)
    assert "never graspable without touching something, retrieved" in verdict(episode)
    config = {**OLD, "policy": "random", "actions": ["push"], "target": "box", "seed": 3}
    row = Row.of_episode(dataclasses.replace(episode, config=config))
    assert (row.retrieved, row.graspable_step, row.graspable_known) == (True, None, True)


def test_a_share_of_which_some_episodes_do_not_say_it_is_none():
    """Those that say it did not retrieve the target, so that they are not like the others."""
    known = dataclasses.replace(ROW, graspable_step=None, failure="found, but not graspable")
    unknown = dataclasses.replace(ROW, scenario="other", retrieved=True, graspable_known=False, objects=8)
    two, eight, every = summarise([known, unknown])
    assert (two.graspable, eight.graspable, every.graspable) == (0.0, None, None)
    assert (every.found, every.retrieved, every.graspable_interval, every.graspable_steps) == (1, 0.5, (0, 1), None)
