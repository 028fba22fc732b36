"""Where scenarios come from on the command line: files, folders of folders, scenes and sets by name."""

import pytest

from mechsearch_jax.commands import main as cli
from mechsearch_jax.commands import options
from mechsearch_jax.envs.scenes import scene_sets
from mechsearch_jax.runtime import kept_arrays
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Scenario, example_scenarios, load_scenario, save_scenario

BLOCK = scene_sets.SETS["d1"].blocks[0]
NAMES = ["d1-000", "d1-001", "d1-002"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to be in, a cache of its own, and a set of three scenes that take no time."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv(kept_arrays.VARIABLE, str(tmp_path / "cache"))
    few = scene_sets.Block("d1", 3, 2, "cylinder", BLOCK.first_seed, "line")
    three = scene_sets.SceneSet("three", "three scenes", (few,))
    monkeypatch.setattr(scene_sets, "SETS", {**scene_sets.SETS, "three": three})
    return tmp_path / "here"


def test_a_set_stands_for_its_scenes(folder, capsys):
    files = options.find_scenarios(["three"])
    assert [file.stem for file in files] == [load_scenario(file).name for file in files] == NAMES
    assert [load_scenario(file).content_hash for file in files] == list(scene_sets.recorded()["d1"][:3])
    printed = capsys.readouterr()
    assert "generating scenes" in printed.err
    assert printed.out == ""
    # The second time there is nothing to wait for.
    assert options.find_scenarios(["three"]) == files
    assert capsys.readouterr() == ("", "")
    assert list(folder.iterdir()) == []


def test_a_scene_of_a_set_goes_by_its_name(folder):
    name, shipped = next(iter(example_scenarios().items()))
    assert load_scenario(options.find_scenario("d1-001")).content_hash == scene_sets.recorded()["d1"][1]
    assert [file.stem for file in options.find_scenarios(["d1-002", name, "d1-000"])] == ["d1-002", name, "d1-000"]
    assert options.find_scenario(name) == shipped
    for wrong, message in (
        ("three", "three: is a set of 3 scenes; name one of them, as d1-000"),
        ("d1-200", "d1-200: there is no such file, nor a shipped scenario of that name .*, nor a scene set"),
    ):
        with pytest.raises(InputError, match=message):
            options.find_scenario(wrong)


def test_a_file_or_folder_of_that_name_goes_before_and_is_reported(folder, capsys):
    scene = load_scenario(next(iter(example_scenarios().values())))
    save_scenario(scene, "d1-001")
    save_scenario(scene, "three/mine.json")
    assert [str(file) for file in options.find_scenarios(["d1-001", "three"])] == ["d1-001", "three/mine.json"]
    assert capsys.readouterr().err.splitlines() == [
        "d1-001: the file of this name is taken, not the scene set's",
        "three: the folder of this name is taken, not the scene set's",
    ]
    options.find_scenarios(["three/mine.json"])
    assert capsys.readouterr().err == ""


def test_a_folder_of_folders_stands_for_what_is_in_them(folder, capsys):
    scene = load_scenario(next(iter(example_scenarios().values())))
    for name in ("b/two", "a/one", "a/deep/three"):
        save_scenario(Scenario(name.replace("/", "-"), scene.objects, scene.target), f"all/{name}.json")
    assert [str(file) for file in options.find_scenarios(["all"])] == [
        "all/a/deep/three.json", "all/a/one.json", "all/b/two.json",
    ]  # fmt: skip
    # Files of its own go before.
    (folder / "all" / "report.json").write_text("{}")
    assert len(options.find_scenarios(["all"])) == 3
    assert "all/report.json: is not a scenario file and is left out\n" in capsys.readouterr().err
    save_scenario(scene, "all/own.json")
    assert [str(file) for file in options.find_scenarios(["all"])] == ["all/own.json"]
    (folder / "none" / "in" / "it").mkdir(parents=True)
    with pytest.raises(InputError, match="none: there are no scenario files"):
        options.find_scenarios(["none"])


def test_a_set_is_written_into_a_folder_and_nothing_is_overwritten(folder, capsys):
    generate = cli.parse(["scenarios", "generate", "--set", "three", "--out", "new"])
    generate()
    assert capsys.readouterr().out.endswith("3 scenarios generated: new\n")
    assert sorted(file.stem for file in (folder / "new").iterdir()) == NAMES
    before = {file: file.stat().st_mtime_ns for file in (folder / "new").iterdir()}
    (folder / "new" / "d1-001.json").unlink()
    generate()
    after = {file: file.stat().st_mtime_ns for file in (folder / "new").iterdir()}
    assert after.keys() == before.keys()
    assert [file.stem for file in after if after[file] != before[file]] == ["d1-001"]
    (folder / "new" / "d1-002.json").write_text("mine")
    (folder / "new" / "d1-000.json").unlink()
    with pytest.raises(InputError, match=r"new/d1-002\.json: is there already and holds something else"):
        generate()
    assert (folder / "new" / "d1-002.json").read_text() == "mine"
    assert not (folder / "new" / "d1-000.json").exists()


def test_sets_are_listed(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    cli.parse(["scenarios", "list"])()
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    rows = {line[0]: line for line in lines[1:]}
    assert set(rows) == set(scene_sets.SETS)
    assert rows["c2-6"] == ["c2-6", "180", "6", "cylinder", scene_sets.digest(scene_sets.SETS["c2-6"])]
    assert rows["d3"][:5] == ["d3", "80", "4,", "8", "box"]
