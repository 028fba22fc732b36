"""The command line, mostly from outside the checkout: what it does, and how it refuses what is wrong."""

import dataclasses
import importlib.metadata
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from mechsearch_jax.benchmarks.lab import __main__ as lab
from mechsearch_jax.benchmarks.lab.commands import quality
from mechsearch_jax.benchmarks.running import evaluate as evaluation
from mechsearch_jax.benchmarks.store.rows import EpisodeRow, write_rows
from mechsearch_jax.commands import main as cli
from mechsearch_jax.commands import options
from mechsearch_jax.planner import OPTIONS, PRESETS
from mechsearch_jax.problem.settings import Settings, load_settings
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.viz.maps import load_maps
from mechsearch_jax.workspace.scenario import (
    Body,
    Scenario,
    example_scenarios,
    format_scenario,
    load_scenario,
    save_scenario,
)

SCENE = Scenario(
    name="one-box",
    objects=(Body("box", (0.048, 0.028, 0.08), (0.5, 0.135, 0.4845), (1.0, 0.0, 0.0, 0.0)),),
    target=Body("cylinder", (0.02, 0.02, 0.05), (0.62, 0.07, 0.4545), (1.0, 0.0, 0.0, 0.0)),
)


ROW = EpisodeRow(
    "one-box", 1, "cylinder", "search-for-grasp", "oracle", 0.9, 3, 30, "both", 0, 1, 2, True, 3, None, 1.5, 0.5
)


def mechsearch(folder, *arguments):
    """Run the program as a user would, in a folder that has nothing to do with the checkout."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    environment["JAX_COMPILATION_CACHE_DIR"] = str(cache())
    program = (sys.executable, "-m", "mechsearch_jax.commands.main")
    return subprocess.run(
        [*program, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=600
    )


def cache():
    import jax

    return jax.config.jax_compilation_cache_dir


@pytest.fixture
def folder(tmp_path):
    """A folder with a good scenario, several bad ones, and output of an earlier run."""
    save_scenario(SCENE, tmp_path / "good.json")
    (tmp_path / "broken.json").write_text("{")
    value = json.loads(format_scenario(SCENE))
    value["objects"][0]["half_size"][1] = -0.02
    (tmp_path / "negative.json").write_text(json.dumps(value))
    for name in ("episode.json", "filmstrip.png", "one-box.npz", "rows.parquet"):
        (tmp_path / "out" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "out" / name).write_text("from before")
    (tmp_path / "empty").mkdir()
    write_rows([ROW], tmp_path / "table.parquet")
    return tmp_path


WRONG = {
    "no command": ([], "Expected one of"),
    "mistyped command": (["serch"], "did you mean search? (mechsearch --help tells more)"),
    "mistyped option": (
        ["search", "good.json", "--out", "out", "--gama", "1"],
        "--gama, 1; did you mean --gamma? (mechsearch search --help tells more)",
    ),
    "mismatch where nothing is simulated": (
        ["inspect", "first-light", "--out", "maps", "--world", "friction=2"],
        "inspect: simulates no world that could differ; leave --world and --sensor out",
    ),
    "no configuration file": (["search", "good.json", "--out", "out", "--config", "none.toml"], "none.toml: cannot be"),
    "configuration of a set": (
        ["scenarios", "generate", "--set", "d1", "--config", "good.toml", "--out", "new"],
        "nor is --config",
    ),
    "unknown option": (["search", "good.json", "--out", "out", "--speed", "3"], "--speed"),
    "unknown choice": (["search", "good.json", "--out", "out", "--actions", "fly"], '"fly" is unknown'),
    "no number": (["search", "good.json", "--out", "out", "--gamma", "high"], "--gamma"),
    "unknown push model": (["search", "good.json", "--out", "out", "--push-model", "guess"], "'guess'"),
    "impossible gamma": (["search", "good.json", "--out", "out", "--gamma", "1.5"], "gamma 1.5 is outside (0, 1]"),
    "no output": (["search", "good.json"], "--out"),
    "nothing to search": (["search", "--out", "out"], "either a scenario or --objects"),
    "too many objects": (["search", "--objects", "9", "--out", "out"], "9 is not between 1 and 8"),
    "missing file": (["search", "none.json", "--out", "out"], "none.json: there is no such file"),
    "malformed file": (["search", "broken.json", "--out", "out"], "broken.json: is not JSON"),
    "bad among good": (["inspect", "good.json", "negative.json", "--out", "out"], "negative.json: objects[0]"),
    "the same name twice": (["evaluate", "good.json", "good.json", "--out", "new"], "'one-box'"),
    "results in a file": (
        ["evaluate", "good.json", "--out", "out/rows.parquet"],
        "rows.parquet: results are kept in a folder, not in a file",
    ),
    "no worker": (["evaluate", "good.json", "--out", "new", "--workers", "0"], "--workers 0"),
    "half a shard": (["evaluate", "good.json", "--out", "new", "--shard", "1"], "--shard 1 is not K/N"),
    "no cluster": (["evaluate", "good.json", "--out", "new", "--cluster", "slurm"], "--cluster slurm is unknown; give"),
    "what a cluster would take": (
        ["evaluate", "good.json", "--out", "new", "--cluster", "ray", "--dry-run"],
        "--dry-run tells of runs on this machine; leave --cluster out",
    ),
    "batch simulator in workers of a cluster": (
        ["sweep", "good.json", "--out", "new", "--cluster", "ray", "--workers", "1", "--simulator", "mjx"],
        "--workers run the native simulator",
    ),
    "the same table twice": (["report", "table.parquet", "table.parquet"], "report them one by one"),
    "unknown preset": (["search", "good.json", "--out", "out", "--preset", "worst"], "'worst'"),
    "both method and policy": (
        ["search", "good.json", "--out", "out", "--method", "search-for-grasp", "--policy", "random"],
        "search: give either --method or --policy, not both",
    ),
    "unknown policy": (["search", "good.json", "--out", "out", "--policy", "guess"], 'policy "guess"'),
    "no results to report": (["report", "empty"], "empty: there are no results in this folder or those in it"),
    "no scenarios": (["scenarios", "generate", "--objects", "2", "--count", "0", "--out", "new"], "--count 0"),
    "unknown set": (["scenarios", "generate", "--set", "c9", "--out", "new"], "c9: there is no such scene set"),
    "set to search": (
        ["search", "c2-4", "--out", "out"],
        "c2-4: is a set of 180 scenes; name one of them, as c2-4-000",
    ),
    "no scenes to look at": (["lab", "scenes", "none.json"], "none.json: there is no such file"),
    "no reference": (
        ["bench", "guard", "--reference", "none.json", "--out", "new"],
        "none.json: cannot be read",
    ),
    "no repeats": (["bench", "plan", "--repeats", "0"], "--repeats 0"),
    "nothing to predict": (["bench", "predict", "--batch", "0"], "bench predict: --batch 0 must be at least 1"),
    "no weights to time": (
        ["bench", "predict", "--push-model", "learned", "--weights", "none.npz"],
        "none.json: cannot be read",
    ),
    "nothing to scale": (["bench", "scaling"], "give --workers, --shards or --ray"),
    "no real scenes": (["bench", "real", "none"], "none: holds no scenes; name a folder"),
    "nothing to learn from": (["train", "recognition", "--out", "new", "--batch", "0"], "--batch 0 must be at least 1"),
    "file for a folder": (["search", "good.json", "--out", "good.json"], "good.json: cannot be written to"),
}


@pytest.mark.parametrize(("arguments", "message"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_one_line_and_changes_nothing(folder, monkeypatch, capsys, arguments, message):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    monkeypatch.chdir(folder)
    program, arguments = (lab, arguments[1:]) if arguments[:1] == ["lab"] else (cli, arguments)
    monkeypatch.setattr(sys, "argv", ["mechsearch", *arguments])
    with pytest.raises(SystemExit) as end:
        program.main()
    complaint = capsys.readouterr().err
    assert end.value.code == 2
    assert message in complaint
    assert complaint.endswith("\n")
    assert complaint.count("\n") == 1
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_what_a_checkout_alone_has_is_refused_with_the_way_there():
    assert sorted(cli.IN_A_CHECKOUT) == sorted(quality.COMMANDS)
    for name in cli.IN_A_CHECKOUT:
        with pytest.raises(InputError, match=f"run `python -m mechsearch_jax.benchmarks.lab {name}` in one"):
            cli.parse(["bench", name, "--help"])


def test_the_program_says_it_too_outside_the_checkout(folder):
    arguments, message = WRONG["missing file"]
    answer = mechsearch(folder, *arguments)
    assert answer.returncode == 2
    assert answer.stdout == ""
    assert message in answer.stderr
    assert answer.stderr.count("\n") == 1
    assert "Traceback" not in answer.stderr


def test_a_scenario_is_found_by_file_by_folder_and_by_name(folder, monkeypatch):
    monkeypatch.chdir(folder)
    name, shipped = next(iter(example_scenarios().items()))
    assert options.find_scenario("good.json").name == "good.json"
    assert options.find_scenario(name) == shipped
    assert [file.name for file in options.find_scenarios([".", name])] == [
        "broken.json", "good.json", "negative.json", shipped.name,
    ]  # fmt: skip
    with pytest.raises(InputError, match=name):
        options.find_scenario("none")


def test_checking_names_the_bad_and_lists_the_good(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit) as end:
        cli.parse(["scenarios", "check", "."])()
    assert end.value.code == 2
    printed = capsys.readouterr()
    assert "good.json: 1 objects, target cylinder" in printed.out
    assert printed.err.count("\n") == 2


def options_of(*arguments):
    """The options that a command would be called with."""
    return cli.parse(["inspect", "first-light", "--out", "out", *arguments]).keywords["options"]


@pytest.mark.parametrize("preset", list(PRESETS))
def test_what_is_given_goes_before_the_preset(preset):
    assert options_of("--preset", preset).settings().config == PRESETS[preset]()
    given = options_of("--preset", preset, "--gamma", "0.5", "--actions", "push", "--push-distances", "0.1", "0.2")
    assert given.settings().config == PRESETS[preset](gamma=0.5, actions=("push",), push_distances=(0.1, 0.2))


def test_actions_go_by_the_name_of_a_set():
    standard, paper = PRESETS["standard"]().options(), PRESETS["paper"]().options()
    names = ("actions", "push_directions", "push_distances")
    of_paper = {name: paper[name] for name in names}
    assert of_paper != {name: standard[name] for name in names}
    assert options_of("--actions", "paper").settings().config == PRESETS["standard"](**of_paper)
    assert options_of("--preset", "paper", "--actions", "paper").settings().config == PRESETS["paper"]()
    given = options_of("--actions", "paper", "--push-distances", "0.2", "--horizon", "3")
    assert given.settings().config == PRESETS["standard"](**{**of_paper, "push_distances": (0.2,), "horizon": 3})
    with pytest.raises(InputError, match="actions: paper is a whole set of actions; give it alone"):
        options_of("--actions", "push", "paper").settings()


def test_every_option_of_the_configuration_is_one_of_the_command_line():
    given, usual = [], PRESETS["standard"]().options()
    for option in OPTIONS:
        value = usual[option.name]
        usual[option.name] = value = tuple(option.outside(value)) if isinstance(value, list) else value
        values = [str(each) for each in (value if isinstance(value, tuple) else [value])]
        given += [f"--{option.name.replace('_', '-')}", *values]
    parsed = options_of(*given)
    assert {option.name: getattr(parsed, option.name) for option in OPTIONS} == usual
    assert parsed.settings().config == PRESETS["standard"]()


def test_a_policy_goes_by_a_methods_name_or_its_own():
    def policies(*arguments):
        given = cli.parse(["evaluate", "first-light", "--out", "out", *arguments]).keywords
        return tuple(options.chosen_policies("evaluate", given["method"], given["policy"]))

    assert policies() == ("search-for-grasp",)
    assert policies("--method", "search-and-grasp", "search-for-grasp") == ("search-and-grasp", "search-for-grasp")
    assert policies("--policy", "random", "my_lab.policies:Mine") == ("random", "my_lab.policies:Mine")


def test_help_names_options_with_their_defaults(capsys):
    with pytest.raises(SystemExit) as end:
        cli.parse(["bench", "plan", "--help"])
    assert not end.value.code
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "--gamma FLOAT" in shown
    assert "(default: physics, in preset paper none)" in shown
    assert "(default: 100, in preset paper 30)" in shown
    assert "the paper's is 0" not in shown
    assert all(f"--{option.name.replace('_', '-')} " in shown for option in OPTIONS)


def test_the_version_is_printed(capsys):
    with pytest.raises(SystemExit) as end:
        cli.parse(["--version"])
    assert not end.value.code
    assert capsys.readouterr().out == f"mechsearch {importlib.metadata.version('mechsearch-jax')}\n"


def test_an_example_configuration_is_printed(tmp_path, capsys):
    cli.parse(["config"])()
    (tmp_path / "mine.toml").write_text(capsys.readouterr().out)
    assert load_settings(tmp_path / "mine.toml") == Settings()


def test_help_on_what_has_no_such_options_does_without_the_planner():
    code = (
        "import sys; from mechsearch_jax.commands import main\n"
        "try: main.parse(sys.argv[1:])\n"
        "except SystemExit: print({'jax', 'pandas', 'jinja2', 'scipy.stats'} & set(sys.modules))"
    )
    for arguments in (["--help"], ["scenarios", "generate", "--help"], ["bench", "--help"]):
        answer = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
        assert answer.stdout.endswith("set()\n"), answer.stderr


def test_planning_does_without_what_reports_are_made_with():
    code = "import sys, mechsearch_jax.session.searcher; print({'pandas', 'jinja2', 'scipy.stats'} & set(sys.modules))"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.stdout == "set()\n", answer.stderr


def test_many_episodes_are_run_as_the_options_say(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    broken = dataclasses.replace(ROW, failure="error: no", retrieved=False)
    seen = {}

    def evaluate(jobs, out, runner, ended, waiting, retry_errors):
        seen.update(jobs=jobs, out=str(out), limit=runner.time_limit, retry_errors=retry_errors)
        return [ROW, broken]

    monkeypatch.setattr(evaluation, "evaluate", evaluate)
    arguments = ["evaluate", "good.json", "--seed", *map(str, range(5)), "--workers", "2", "--out", "new"]
    cli.parse([*arguments, "--shard", "2/2", "--retry-errors", "--time-limit", "9"])()
    assert (len(seen["jobs"]), seen["out"], seen["limit"], seen["retry_errors"]) == (2, "new", 9.0, True)
    said = capsys.readouterr()
    assert "1 of 2 episodes ended in an error; --retry-errors runs them again" in said.err
    assert said.out.endswith("new\n")
    cli.parse(arguments)()
    assert (len(seen["jobs"]), seen["limit"], seen["retry_errors"]) == (5, 3600.0, False)


@pytest.mark.slow
def test_inspecting_writes_maps_and_a_picture(folder):
    answer = mechsearch(folder, "inspect", "good.json", "--out", "maps")
    assert answer.returncode == 0, answer.stderr
    maps = load_maps(folder / "maps" / "one-box.npz")
    assert maps.poses.shape == (792, 3)
    assert 0 < maps.existence.sum() < 792
    assert maps.graspability.max() == 1
    nearest = np.argmin(np.linalg.norm(maps.poses[:, :2] - SCENE.target.position[:2], axis=1))
    assert maps.existence[nearest]
    assert (folder / "maps" / "one-box.png").stat().st_size > 10_000
    assert sorted(path.name for path in (folder / "maps").iterdir()) == ["one-box.npz", "one-box.png"]


@pytest.mark.slow
def test_generated_scenarios_are_good_and_reproducible(folder):
    for out in ("a", "b"):
        answer = mechsearch(
            folder, "scenarios", "generate", "--objects", "3", "--count", "2", "--seed", "5", "--out", out
        )
        assert answer.returncode == 0, answer.stderr
    names = sorted(path.name for path in (folder / "a").iterdir())
    assert len(names) == 2
    for name in names:
        assert len(load_scenario(folder / "a" / name).objects) == 3
        assert (folder / "a" / name).read_bytes() == (folder / "b" / name).read_bytes()


def test_who_stops_reading_ends_a_command_without_a_word(folder):
    program = (sys.executable, "-m", "mechsearch_jax.commands.main", "bench", "plan", "--help")
    with subprocess.Popen(program, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        running.stdout.close()
        assert running.stderr.read() == b""
    assert running.returncode == 141


def test_a_complaint_is_one_line_on_a_terminal_that_knows_ascii_alone(folder):
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    program = (
        sys.executable,
        "-m",
        "mechsearch_jax.commands.main",
        "scenarios",
        "generate",
        "--out",
        "o",
        "--ojects",
        "3",
    )
    answer = subprocess.run(program, cwd=folder, env=environment, capture_output=True, text=True)
    assert answer.stderr == (
        "mechsearch: Unrecognized options: --ojects, 3; did you mean --objects? "
        "(mechsearch scenarios generate --help tells more)\n"
    )
