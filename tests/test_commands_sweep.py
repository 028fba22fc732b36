"""`mechsearch sweep`: all combinations of what flags and a file give, run as `evaluate` runs them; and what a run would
take."""

import dataclasses
import itertools
import json
import math
import re
from pathlib import Path

import pytest

from mechsearch_jax.benchmarks.running import evaluate as evaluation
from mechsearch_jax.benchmarks.running.episode_seconds import FILE as SECONDS_FILE
from mechsearch_jax.benchmarks.running.episode_seconds import Kind, MeasuredSeconds, entries
from mechsearch_jax.benchmarks.running.estimate import CONTINUOUS, estimate
from mechsearch_jax.benchmarks.running.evaluate import SceneOutline, make_jobs, planned_jobs, present_code
from mechsearch_jax.benchmarks.store.runs import stored_runs
from mechsearch_jax.benchmarks.store.shards import ShardWriter
from mechsearch_jax.commands import main as cli
from mechsearch_jax.commands.runs import outlines_of
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.scenes.scene_sets import recorded
from mechsearch_jax.envs.world.mismatch import Mismatch
from mechsearch_jax.planner import OPTIONS, PRESETS
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.workspace.scenario import Body, Scenario, save_scenario

standard = PRESETS["standard"]
TARGET = Body("cylinder", (0.02, 0.02, 0.05), (0.62, 0.07, 0.4545), (1.0, 0.0, 0.0, 0.0))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("one", "two"):
        save_scenario(Scenario(name, (), TARGET), tmp_path / f"{name}.json")
    return tmp_path


@pytest.fixture
def jobs_of(folder, monkeypatch):
    """The jobs that a command line asks for."""

    def collected(*arguments):
        seen = []

        def evaluate(jobs, *rest):
            seen.extend(jobs)
            return []

        monkeypatch.setattr(evaluation, "evaluate", evaluate)
        cli.parse([*arguments, "--workers", "1", "--out", "rows"])()
        return seen

    return collected


def settings_of(jobs):
    return [(job.scenario.name, job.method, job.seed) for job in jobs]


def test_a_sweep_is_all_combinations(jobs_of):
    jobs = jobs_of(
        *("sweep", "one.json", "two.json", "--seed", "3", "4", "--gamma", "0.5", "1", "--recognition", "oracle"),
        *("masks", "--policy", "random", "search-for-grasp", "--push-distances", "0.05,0.1", "0.1"),
        *("--move-target", "True", "False"),
    )
    expected = {
        (scene, Method(policy, standard(gamma=gamma, push_distances=pushes, move_target=again), seen), seed)
        for scene, policy, gamma, pushes, again, seen, seed in itertools.product(
            *(("one", "two"), ("random", "search-for-grasp"), (0.5, 1.0), ((0.05, 0.1), (0.1,)), (True, False)),
            *(("oracle", "masks"), (3, 4)),
        )
    }
    assert len(jobs) == len(expected) == 128
    assert set(settings_of(jobs)) == expected


def test_a_sweep_of_one_point_is_what_evaluate_runs(jobs_of):
    common = ("one.json", "--gamma", "0.7", "--preset", "paper", "--actions", "push", "--seed", "1")
    swept, evaluated = jobs_of("sweep", *common), jobs_of("evaluate", *common)
    assert [job.key for job in swept] == [job.key for job in evaluated]
    assert settings_of(jobs_of("sweep", "one.json")) == settings_of(jobs_of("evaluate", "one.json"))


def test_worlds_that_differ_are_swept_and_share_a_compilation(jobs_of):
    plain = jobs_of("sweep", "one.json")
    jobs = jobs_of("sweep", "one.json", "--world", "friction=0.5,1,2", "physics=usual,fine-step")
    expected = {(f, p) for f in (0.5, 1.0, 2.0) for p in ("usual", "fine-step")}
    assert {(job.method.mismatch.friction, job.method.mismatch.physics) for job in jobs} == expected
    assert len({job.method.compile_key() for job in jobs}) == 1
    assert len({job.key for job in jobs}) == len(jobs) == 6
    assert [job.key for job in jobs if job.method == Method()] == [job.key for job in plain]
    (swept,), (evaluated,) = (
        jobs_of(command, "one.json", "--world", "shelf_turn=2") for command in ("sweep", "evaluate")
    )
    assert swept.key == evaluated.key
    assert swept.options["mismatch.shelf_turn"] == 2.0
    with pytest.raises(InputError, match="add --recognition masks or full"):
        jobs_of("sweep", "one.json", "--world", "missing_depth=0.1")
    with pytest.raises(InputError, match=r"camera_shift \(1.0\) must be from 0 to 0.2 m"):
        jobs_of("evaluate", "one.json", "--world", "camera_shift=1")


def test_a_file_has_a_table_of_worlds_and_what_is_given_goes_before_it(folder, jobs_of):
    (folder / "sweep.toml").write_text(
        'scenarios = "one.json"\n[world]\nmass = [1, 2]\narm_stop = 2\nholes = "objects"\n'
    )
    jobs = jobs_of("sweep", "--file", "sweep.toml", "--world", "holes=none,shadows")
    stop = math.radians(2)
    assert [job.method.mismatch for job in jobs] == [
        Mismatch(mass=mass, arm_stop=stop, holes=holes) for mass in (1.0, 2.0) for holes in ("none", "shadows")
    ]


@pytest.mark.parametrize(
    ("world", "message"),
    {
        ("friction=two",): "--world friction=two: is not a number$",
        ("friction=1,2",): "--world friction=1,2: is not a number; several values are for mechsearch sweep",
        ("friktion=2",): r"--world friktion=2: friktion is unknown; did you mean friction\?",
        ("friction",): "--world friction: give a key and a value, as friction=2",
        ("mass=1", "mass=2"): "--world mass=2: mass is given twice; a sweep takes several values as mass=1,2",
        ("holes=some",): 'holes "some" is unknown; use none, objects',
        ("arm_stop=0.03",): "arm_stop 0.03 is in degrees, of which 0.2 is the least; is it meant in radians",
    }.items(),
)
def test_what_is_wrong_in_a_world_is_named(jobs_of, world, message):
    with pytest.raises(InputError, match=message):
        jobs_of("evaluate", "one.json", "--world", *world)


def test_settings_that_come_to_the_same_are_run_once(jobs_of):
    jobs = jobs_of("sweep", "one.json", "--preset", "paper", "standard", "--actions", "paper", "--gamma", "0.9", "0.9")
    assert len(jobs) == len({job.key for job in jobs}) == 2
    # The name of a set of actions stands for all of it, one value among others.
    jobs = jobs_of("sweep", "one.json", "--actions", "paper", "standard", "push,pick-and-place", "push")
    assert len(jobs) == 3


FILE = """
scenarios = ["one.json"]
policy = "random"
seed = [0, 1]
gamma = [0.5, 1]
horizon = 2
push_distances = [[0.05, 0.1], [0.1]]
push_directions = [85, -85]
move_target = [true, false]
preset = ["standard"]
recognition = "masks"
"""


def test_a_file_says_it_all_and_what_is_given_goes_before_it(folder, jobs_of):
    (folder / "sweep.toml").write_text(FILE)
    jobs = jobs_of("sweep", "--file", "sweep.toml")
    assert len(jobs) == 16
    fixed = {"horizon": 2, "push_directions": (math.radians(85), math.radians(-85))}
    assert {job.method for job in jobs} == {
        Method("random", standard(gamma=gamma, push_distances=pushes, move_target=again, **fixed), "masks")
        for gamma, pushes, again in itertools.product((0.5, 1.0), ((0.05, 0.1), (0.1,)), (True, False))
    }
    jobs = jobs_of(
        *("sweep", "two.json", "--file", "sweep.toml", "--seed", "5", "--gamma", "0.8", "--recognition", "oracle"),
        *("--method", "search-and-grasp", "--push-distances", "0.2"),
    )
    fixed |= {"gamma": 0.8, "push_distances": (0.2,)}
    assert set(settings_of(jobs)) == {
        ("two", Method("search-and-grasp", standard(move_target=again, **fixed)), 5) for again in (True, False)
    }


@pytest.mark.parametrize(
    ("text", "message"),
    {
        "gama = 0.5": r"sweep.toml:1: gama is unknown; did you mean gamma\?",
        "seed = 0\ngamma = [0.5, 'x']": r"sweep.toml:2: gamma\[1\] must be a number",
        "[planner]\ngamma = 0.5": r"sweep.toml:1: \[planner\] is a table",
        "push_distances = [[0.1], 0.2]": r"sweep.toml:1: push_distances\[1\] must be a list",
        "gamma = 1.5": "gamma 1.5 is outside",
        "recognition = 'eyes'": "recognition must be one of",
        "policy = 'none'": 'policy "none" is unknown',
        "[world]\nmass = [1, 'x']": r"sweep.toml:2: \[world\] mass\[1\] must be a number",
        "push_directions = [1.57, -1.57]": "push_directions 1.57 is in degrees, of which 4 is the least; is it meant",
        "gamma = ": "sweep.toml:1: is not TOML",
    }.items(),
)
def test_what_is_wrong_in_a_file_is_named_with_its_place(folder, jobs_of, text, message):
    (folder / "sweep.toml").write_text(f"{text}\n")
    with pytest.raises(InputError, match=message):
        jobs_of("sweep", "one.json", "--file", "sweep.toml")


def test_every_option_may_be_swept():
    once, twice, usual = [], [], standard().options()
    for option in OPTIONS:
        value = option.outside(usual[option.name])
        given = ",".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
        once += [f"--{option.name.replace('_', '-')}", given]
        twice += [*once[-2:], given]
    one, several = (
        cli.parse(["sweep", "first-light", "--out", "out", *more]).keywords["options"] for more in (once, twice)
    )
    assert [point.settings().config for point in one.points()] == [standard()]
    assert {len(getattr(several, option.name)) for option in OPTIONS} == {2}


def test_what_a_run_would_take_is_printed_and_nothing_is_run(folder, capsys):
    common = ("one.json", "two.json", "--out", "rows", "--workers", "2", "--dry-run")
    gammas = [str(0.5 + 0.005 * i) for i in range(96)]
    cli.parse(["sweep", *common, "--gamma", *gammas])()
    output = capsys.readouterr().out
    assert output.startswith(
        "96 variants, 192 episodes, 0 of them there already, 192 left\n1 compilation of the planner"
    )
    assert "hours in 2 processes" in output
    assert re.search(r"^  standard, oracle, with trials, native simulator: 192 x [\d.]+ s, 1 x ", output, re.M)
    cli.parse(["sweep", *common, "--gamma", "0.5", "1", "--horizon", "2", "3", "--max-steps", "5", "10"])()
    assert "8 variants, 16 episodes, 0 of them there already, 16 left\n2 compilations" in capsys.readouterr().out
    shifts = ("--recognition", "masks", "--world", "camera_shift=0.01,0.02", "depth_noise=0.001,0.002")
    cli.parse(["sweep", *common, *shifts, "mass=1,2"])()
    assert "8 variants, 16 episodes, 0 of them there already, 16 left\n2 compilations" in capsys.readouterr().out
    cli.parse(["evaluate", *common, "--shard", "1/2"])()
    assert capsys.readouterr().out.startswith("1 variant, 1 episode, 0 of them there already, 1 left\n")
    assert not (folder / "rows").exists()


def test_an_estimate_is_of_the_rows_that_are_there(folder):
    assert "gamma" in CONTINUOUS
    assert "horizon" not in CONTINUOUS
    methods = [Method(config=standard(gamma=gamma)) for gamma in (0.5, 0.9)]
    jobs = make_jobs(["one.json", "two.json"], methods, (0,))
    same_code = {"code": present_code(), "device": versions()["device"]}
    rows = [
        dataclasses.replace(
            jobs[i].failed("no"),
            **same_code,
            failure=failure,
            planning_seconds=2.0 + i,
            simulation_seconds=1.0,
            compile_seconds=compiling,
        )
        for i, failure, compiling in ((0, None, 100.0), (1, None, 50.0), (2, "error: no", None))
    ]
    with ShardWriter("rows", "me") as writer:
        writer.append(rows)
    outlines = [SceneOutline.of_scenario(job.scenario) for job in jobs[::2]]
    planned = planned_jobs(outlines, methods, (0,))
    assert [job.key for job in planned] == [job.key for job in jobs]
    estimated = estimate(planned, "rows", 2)
    assert (estimated.variants, estimated.episodes, estimated.there, estimated.compilations) == (2, 4, 3, 1)
    (part,) = estimated.parts
    assert (part.kind, part.seconds) == (Kind.of(Method()), MeasuredSeconds(3.5, 75.0, 2))
    assert part.grounds == "from 2 rows of the folder"
    assert estimated.hours == pytest.approx((1 * 3.5 / 2 + 75.0) / 3600)
    assert estimate(planned, "rows", 2, retry_errors=True).there == 2
    with ShardWriter("other", "me") as writer:
        writer.append([dataclasses.replace(rows[0], code="other")])
    with pytest.raises(InputError, match="its episodes were run by other"):
        estimate(planned, "other", 2)


def test_the_seconds_of_the_package_are_those_of_the_stored_runs():
    results = Path(__file__).parents[1] / "benchmarks/results"
    written = json.loads(SECONDS_FILE.read_text(encoding="utf-8"))
    assert written == entries(stored_runs(results / "runs")), f"run `python -m {entries.__module__}`"
    assert "MjxSimulator" in {entry["simulator"] for entry in written if entry["device"].startswith("gpu")}


def test_outlines_of_sets_are_those_of_their_files(folder):
    (outline,) = outlines_of(["d1-003"])
    assert (outline.name, len(outline.objects), outline.target.shape) == ("d1-003", 2, "cylinder")
    assert outline.content_hash == recorded()["d1"][3]
    assert [outline.name for outline in outlines_of(["one.json", "d3-4"])][:2] == ["one", "d3-4-000"]
    with pytest.raises(InputError, match="two scenes are called d1-003"):
        planned_jobs([outline, outline], [Method()], (0,))
    with pytest.raises(InputError, match="no scenario is given"):
        outlines_of([])
