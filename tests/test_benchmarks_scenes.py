"""What scenes are like: counts against a brute-force count in the image, and figures that are those of the rows."""

import dataclasses
import json
import statistics

import numpy as np
import pytest
from stage import BOX, CYLINDER, HIDDEN, OPEN, TWO

from mechsearch_jax.benchmarks.lab.parts import scenes
from mechsearch_jax.benchmarks.lab.parts.exact_existence import exact_existence
from mechsearch_jax.benchmarks.lab.parts.scenes import SceneRow, look_at_all, nearest_pose, save_scenes, summary
from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.envs.camera.simulated_camera import observe, target_pixels
from mechsearch_jax.envs.world.world import TARGET, from_scenario, true_superquadrics
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.detector import FOUND_PIXELS
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

ROW = SceneRow("a", "one", "0123456789ab", 2, "cylinder", 40, 792, True, 0, 0.0, 2, 0.75)


@pytest.fixture(scope="module")
def looked(problem):
    """Three scenes, looked at with the problem that other tests have built."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenes, "cached_problem", lambda target: problem)
        return {row.scenario: row for row in look_at_all({"stage": [HIDDEN, OPEN, TWO]})}


def test_what_is_seen_is_what_the_image_shows(looked):
    for scene in (HIDDEN, OPEN, TWO):
        owner = np.asarray(observe(Camera(), from_scenario(scene)).segmentation)
        alone = observe(Camera(), from_scenario(Scenario("alone", (), scene.target))).segmentation
        row = looked[scene.name]
        assert row.target_pixels == (owner == TARGET).sum()
        assert row.target_share == pytest.approx(
            (owner == TARGET).sum() / (np.asarray(alone) == TARGET).sum(), abs=1e-4
        )
        shares = []
        for i, body in enumerate(scene.objects):
            one = observe(
                Camera(),
                from_scenario(Scenario("alone", (body,), dataclasses.replace(CYLINDER, position=(-5.0, 0.0, 0.0)))),
            )
            shares.append((owner == i).sum() / (np.asarray(one.segmentation) == 0).sum())
        assert row.objects_share == pytest.approx(np.mean(shares), abs=0.01)
        assert row.visible == len(scene.objects) == row.objects
        assert row.content_hash == scene.content_hash
    assert looked["hidden"].target_share == 0.0
    assert looked["open"].target_share == 1.0


def test_f_is_that_of_a_target_that_is_not_seen(looked):
    # Behind the box the target can be; where nothing hides it, it cannot.
    assert looked["hidden"].truth_possible
    assert not looked["open"].truth_possible
    assert 10 < looked["hidden"].possible < 200
    assert looked["two"].possible > looked["hidden"].possible
    assert {row.candidates for row in looked.values()} == {792}


@pytest.mark.slow
def test_brute_force_finds_the_poses_at_which_the_image_shows_too_few_pixels_to_detect(problem):
    for scene in (HIDDEN, TWO):
        world = from_scenario(scene)
        exists = np.asarray(exact_existence(problem, true_superquadrics(world), side=1))
        cells = np.asarray(exact_existence(problem, true_superquadrics(world), side=3))
        assert not (exists & ~cells).any()
        assert exists.sum() < cells.sum()
        # Half of them where it exists, half elsewhere.
        rng = np.random.default_rng(0)
        chosen = np.concatenate(
            [rng.choice(np.flatnonzero(exists == there), 15, replace=False) for there in (True, False)]
        )
        for i in chosen:
            x, y, _ = np.asarray(problem.poses[i])
            moved = world.replace(position=world.position.at[TARGET, :2].set(np.array([x, y])))
            pixels = int(target_pixels(Camera(), moved))
            # The edges of superquadrics are a little rounder than those of bodies.
            if not 60 < pixels < 160 and not (pixels == 0 and not exists[i]):
                assert exists[i] == (pixels <= FOUND_PIXELS)
            # Where it shows nothing it exists, unless it would stand in an object.
            if pixels == 0 and not exists[i]:
                assert min(np.hypot(*(np.array(b.position[:2]) - (x, y))) for b in scene.objects) < 0.12


def test_rows_by_brute_force_say_how_much_larger_f_is():
    exact = dataclasses.replace(ROW, exact_cells=32, exact_missed=1, exact_poses=20)
    line = summary([exact, dataclasses.replace(exact, possible=30, exact_cells=30), ROW])[0]
    assert line["exact_scenes"] == 2
    assert line["possible_over_exact_cells"] == pytest.approx(70 / 62)
    assert line["exact_cells_over_exact_poses"] == pytest.approx(62 / 40)
    assert line["exact_missed_share"] == pytest.approx(2 / 62)
    assert "exact_scenes" not in summary([ROW])[0]


def test_the_nearest_pose_is_near_in_place_and_yaw():
    shelf = Shelf()
    for target in (Target.cylinder(), Target.box()):
        poses = target.candidate_poses(shelf)
        cell = target.cell(shelf)
        rng = np.random.default_rng(0)
        for index in rng.integers(len(poses), size=50):
            shift = rng.uniform(-0.45, 0.45, 3) * cell
            turned = poses[index] + shift + [0.0, 0.0, np.pi * rng.integers(-2, 3)]
            assert nearest_pose(target, shelf, turned) == index


def test_a_box_is_looked_at_with_its_own_poses(monkeypatch):
    targets = []

    class Stop(Exception):
        pass

    def refuse(target):
        targets.append(target)
        raise Stop

    monkeypatch.setattr(scenes, "cached_problem", refuse)
    boxed = dataclasses.replace(HIDDEN, target=dataclasses.replace(BOX, half_size=(0.015, 0.02, 0.05)))
    with pytest.raises(Stop):
        look_at_all({"boxes": [boxed]})
    assert targets == [Target.box()]


def test_figures_are_those_of_the_rows(tmp_path):
    rows = [
        ROW,
        dataclasses.replace(
            ROW, scenario="two", possible=80, target_pixels=60, target_share=0.02, truth_possible=False
        ),
        dataclasses.replace(ROW, scenario="three", possible=30, target_pixels=101, target_share=0.04, visible=1),
        dataclasses.replace(ROW, scenario="four", objects=8, visible=7),
        dataclasses.replace(ROW, source="other", scenario="five"),
    ]
    lines = summary(rows[::-1])
    assert [(line["source"], line["objects"], line["scenes"]) for line in lines] == [
        ("other", 2, 1), ("a", 2, 3), ("a", 8, 1),
    ]  # fmt: skip
    line = lines[1]
    assert (line["possible_mean"], line["possible_median"]) == (50, 40)
    assert line["possible_standard_error"] == pytest.approx(statistics.stdev([40, 80, 30]) / 3**0.5)
    assert (line["possible_p10"], line["possible_p90"]) == pytest.approx((32, 72))
    assert line["possible_share"] == pytest.approx(50 / 792)
    assert [line[f"target_{name}"] for name in ("hidden", "below_threshold", "found")] == [1, 1, 1]
    assert (line["truth_ruled_out"], line["target_share_mean"]) == (1, pytest.approx(0.02))
    assert (line["visible_mean"], line["objects_share_mean"]) == (pytest.approx(5 / 3), 0.75)
    assert lines[0]["possible_standard_error"] is None

    save_scenes(rows, tmp_path / "scenes.json")
    value = json.loads((tmp_path / "scenes.json").read_text())
    assert value["summary"] == summary(rows)
    assert [SceneRow(**dict(zip(value["columns"], each, strict=True))) for each in value["rows"]] == rows
    assert "jax" in value["versions"]
    assert value["code"] == present_code()
    with pytest.raises(InputError, match="there are no scenes"):
        save_scenes([], tmp_path / "none.json")
